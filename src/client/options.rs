//! How a client proves who it is, and makes sure whom it talks to.

use std::fmt;
use std::path::{Path, PathBuf};

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity};
use tonic::{Request, Status};

use super::CONNECT_TIMEOUT;
use super::error::{self, Error, ErrorKind};
use crate::domain::job::{DEFAULT_TENANT, JobName};
use crate::rpc::{keys, tls};

/// What stands in names for the tenant of the key, which the server knows.
pub const OWN_TENANT: &str = "-";

/// Who calls, and whom to trust. The default sends no key and trusts the authorities of the system.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// Tenant whose jobs are created and listed; `None`: that of the key, without a key `default`.
    pub tenant: Option<String>,
    /// What every call carries, where the server asks for keys.
    pub api_key: Option<ApiKey>,
    /// File of the authorities that the server's certificate must lead to (PEM); `None`: those of the system.
    pub tls_ca: Option<PathBuf>,
    /// File of the certificate to show to a server that asks for one (PEM); of use with `tls_key` only.
    pub tls_cert: Option<PathBuf>,
    /// File of the private key of that certificate (PEM).
    pub tls_key: Option<PathBuf>,
    /// Send the key to another machine without TLS: whoever listens in has it.
    pub plaintext_keys: bool,
}

/// What an error is about: the server's address, or a field of [`Options`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Setting {
    /// The address.
    Server,
    /// [`Options::tenant`].
    Tenant,
    /// [`Options::api_key`].
    ApiKey,
    /// [`Options::tls_ca`].
    TlsCa,
    /// [`Options::tls_cert`].
    TlsCert,
    /// [`Options::tls_key`].
    TlsKey,
    /// [`Options::plaintext_keys`].
    PlaintextKeys,
}

impl Setting {
    /// Its name in messages, which has it in backquotes.
    pub fn name(self) -> &'static str {
        match self {
            Setting::Server => "server",
            Setting::Tenant => "tenant",
            Setting::ApiKey => "api_key",
            Setting::TlsCa => "tls_ca",
            Setting::TlsCert => "tls_cert",
            Setting::TlsKey => "tls_key",
            Setting::PlaintextKeys => "plaintext_keys",
        }
    }

    /// An error that begins with the name.
    fn error(self, problem: impl fmt::Display) -> Error {
        ErrorKind::Usage.error(format!("`{}` {problem}", self.name())).about(self)
    }

    /// A problem of a file.
    fn file_error(self, problem: impl fmt::Display) -> Error {
        ErrorKind::Usage.error(format!("`{}`: {problem}", self.name())).about(self)
    }
}

impl Options {
    /// The tenant as names have it: `-` is that of the key.
    ///
    /// # Errors
    /// [`ErrorKind::Usage`] for what is no tenant's id.
    pub fn tenant(&self) -> Result<&str, Error> {
        match self.tenant.as_deref() {
            None if self.api_key.is_some() => Ok(OWN_TENANT),
            None => Ok(DEFAULT_TENANT),
            Some(tenant) if JobName::is_id(tenant) => Ok(tenant),
            Some(tenant) => Err(Setting::Tenant.error(format_args!("{tenant:?} is not 1 to 63 of a-z, 0-9 and -"))),
        }
    }

    /// What every call carries.
    ///
    /// # Errors
    /// [`ErrorKind::Usage`] for a key that would travel readable.
    pub(super) fn bearer(&self, endpoint: &Endpoint) -> Result<Bearer, Error> {
        let uri = endpoint.uri();
        let is_readable = uri.scheme_str() != Some("https") && !is_loopback(uri.host().unwrap_or_default());
        if self.api_key.is_some() && is_readable && !self.plaintext_keys {
            let words = format!(
                "the API key would travel readable to {uri}: use https://, or `plaintext_keys` where nobody can listen in"
            );
            return Err(ErrorKind::Usage.error(words).about(Setting::PlaintextKeys));
        }
        Ok(Bearer(self.api_key.clone()))
    }

    /// Adds TLS to an `https://` endpoint.
    ///
    /// # Errors
    /// [`ErrorKind::Usage`] for files that cannot be used, or that have no meaning for `http://`.
    pub(super) fn secure(&self, endpoint: Endpoint) -> Result<Endpoint, Error> {
        if endpoint.uri().scheme_str() != Some("https") {
            let useless =
                [(&self.tls_ca, Setting::TlsCa), (&self.tls_cert, Setting::TlsCert), (&self.tls_key, Setting::TlsKey)];
            return match useless.into_iter().find(|(file, _)| file.is_some()) {
                Some((_, setting)) => Err(setting.error("needs a server with https://")),
                None => Ok(endpoint),
            };
        }
        let mut config = ClientTlsConfig::new().timeout(CONNECT_TIMEOUT);
        config = match &self.tls_ca {
            None => config.with_native_roots(),
            Some(path) => config.ca_certificate(Certificate::from_pem(certificates(Setting::TlsCa, path)?)),
        };
        config = match (&self.tls_cert, &self.tls_key) {
            (Some(certificate), Some(key)) => {
                let chain = certificates(Setting::TlsCert, certificate)?;
                tls::private_key(key).map_err(|error| Setting::TlsKey.file_error(error))?;
                config.identity(Identity::from_pem(chain, read(Setting::TlsKey, key)?))
            }
            (None, None) => config,
            (Some(_), None) => return Err(Setting::TlsKey.error("is missing: that of the certificate")),
            (None, Some(_)) => return Err(Setting::TlsCert.error("is missing: that of the key")),
        };
        endpoint.tls_config(config).map_err(|error| {
            let hint = if self.tls_ca.is_none() { "; `tls_ca` says which authorities to trust" } else { "" };
            let words = format!("TLS cannot be set up: {}{hint}", error::root_cause(&error));
            ErrorKind::Usage.error(words).about(Setting::TlsCa)
        })
    }
}

/// The bytes of a PEM file that holds certificates.
fn certificates(setting: Setting, path: &Path) -> Result<Vec<u8>, Error> {
    tls::certificates(path).map_err(|error| setting.file_error(error))?;
    read(setting, path)
}

fn read(setting: Setting, path: &Path) -> Result<Vec<u8>, Error> {
    std::fs::read(path).map_err(|error| setting.file_error(format_args!("{}: {error}", path.display())))
}

fn is_loopback(host: &str) -> bool {
    let address = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || address.parse().is_ok_and(|ip: std::net::IpAddr| ip.to_canonical().is_loopback())
}

/// An API key, which is shown nowhere.
#[derive(Clone)]
pub struct ApiKey(MetadataValue<Ascii>);

impl ApiKey {
    /// Takes a key as the server's operator gave it.
    ///
    /// # Errors
    /// [`ErrorKind::Usage`] for what is no key; the message repeats nothing of it.
    pub fn new(key: &str) -> Result<Self, Error> {
        let key = keys::checked(key).map_err(|problem| Setting::ApiKey.error(problem))?;
        // Only characters that a header may hold are left in a key.
        let header = format!("Bearer {key}").parse();
        let mut value: MetadataValue<Ascii> = header.map_err(|_| Setting::ApiKey.error("has no key"))?;
        value.set_sensitive(true);
        Ok(Self(value))
    }
}

impl fmt::Debug for ApiKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ApiKey(***)")
    }
}

/// Puts the API key into every call.
#[derive(Debug, Clone)]
pub struct Bearer(Option<ApiKey>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(ApiKey(value)) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEY: &str = "0123456789abcdef0123456789abcdef";

    #[test]
    fn a_key_goes_in_the_clear_to_this_machine_only() {
        let mut options = Options { api_key: Some(ApiKey::new(KEY).expect("a key")), ..Options::default() };
        let allowed = |options: &Options, url: &'static str| options.bearer(&Endpoint::from_static(url));
        for near in ["http://127.0.0.1:1", "http://localhost:1", "http://[::1]:1", "https://far.example"] {
            let bearer = allowed(&options, near).expect(near);
            assert!(bearer.0.is_some() && !format!("{bearer:?}").contains(KEY), "{near}");
        }
        for far in ["http://far.example:1", "http://10.0.0.1:1", "http://localhost.far.example:1"] {
            let error = allowed(&options, far).expect_err(far);
            assert_eq!((error.kind, error.setting), (ErrorKind::Usage, Some(Setting::PlaintextKeys)));
            assert!(error.message.contains("https://") && !error.message.contains(KEY), "{error}");
        }
        options.plaintext_keys = true;
        assert!(allowed(&options, "http://far.example:1").is_ok());
    }

    #[test]
    fn the_key_names_the_tenant_unless_one_is_given() {
        let api_key = Some(ApiKey::new(KEY).expect("a key"));
        let tenant = |tenant: Option<&str>, api_key: &Option<ApiKey>| {
            let options = Options { tenant: tenant.map(Into::into), api_key: api_key.clone(), ..Options::default() };
            options.tenant().map(str::to_owned)
        };
        assert_eq!(tenant(None, &None).as_deref(), Ok("default"));
        assert_eq!(tenant(None, &api_key).as_deref(), Ok("-"));
        assert_eq!(tenant(Some("north"), &api_key).as_deref(), Ok("north"));
        assert_eq!(tenant(Some("-"), &api_key).expect_err("no id").setting, Some(Setting::Tenant));
    }

    #[test]
    fn what_is_no_key_is_not_repeated() {
        for wrong in [&KEY[..20], "0123456789abcdef 0123456789abcdef"] {
            let error = ApiKey::new(wrong).expect_err(wrong);
            assert!(error.message.starts_with("`api_key` has a key") && !error.message.contains(wrong), "{error}");
        }
    }
}
