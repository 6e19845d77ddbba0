//! How a command proves who it is, and makes sure whom it talks to.

use std::fmt;
use std::path::{Path, PathBuf};

use clap::Args;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity};
use tonic::{Request, Status};

use super::{CONNECT_TIMEOUT, Error};
use crate::domain::job::{DEFAULT_TENANT, JobName};
use crate::rpc::{keys, tls};

/// The variable that may hold the API key. No flag does: other users of the machine see flags.
const KEY_VARIABLE: &str = "SCPSFM_API_KEY";

/// Heading of the flags that say who calls. Given flag by flag: set for the whole, it would go on to flags of the
/// command.
const ACCESS: &str = "Access to the server";

/// Who calls, and whom to trust.
#[derive(Debug, Clone, Default, Args)]
pub struct AccessArgs {
    /// Tenant whose jobs these are [default: default]
    #[arg(long, help_heading = ACCESS, value_name = "ID", env = "SCPSFM_TENANT")]
    pub tenant: Option<String>,

    /// File with the API key; without it, the variable SCPSFM_API_KEY
    #[arg(long, help_heading = ACCESS, value_name = "FILE")]
    pub api_key_file: Option<PathBuf>,

    /// Authorities that the server's certificate must lead to (PEM) [default: those of the system]
    #[arg(long, help_heading = ACCESS, value_name = "FILE")]
    pub tls_ca: Option<PathBuf>,

    /// Certificate to show to a server that asks for one (PEM)
    #[arg(long, help_heading = ACCESS, value_name = "FILE", requires = "tls_key")]
    pub tls_cert: Option<PathBuf>,

    /// Private key of that certificate (PEM)
    #[arg(long, help_heading = ACCESS, value_name = "FILE", requires = "tls_cert")]
    pub tls_key: Option<PathBuf>,

    /// Send the API key to another machine without TLS: whoever listens in has it
    #[arg(long, help_heading = ACCESS)]
    pub plaintext_keys: bool,
}

impl AccessArgs {
    /// Whether anything was said that has no meaning without a server.
    pub fn is_given(&self) -> bool {
        self.api_key_file.is_some() || self.tls_ca.is_some() || self.tls_cert.is_some() || self.plaintext_keys
    }

    /// The tenant.
    ///
    /// # Errors
    /// [`Error::Usage`] for what is no tenant's id.
    pub fn tenant(&self) -> Result<String, Error> {
        let tenant = self.tenant.as_deref().unwrap_or(DEFAULT_TENANT);
        match JobName::is_id(tenant) {
            true => Ok(tenant.to_owned()),
            false => Err(Error::Usage(format!("--tenant: {tenant:?} is not 1 to 63 of a-z, 0-9 and -"))),
        }
    }

    /// The key, from the file or the environment.
    fn key(&self) -> Result<Option<String>, Error> {
        let (source, text) = match &self.api_key_file {
            Some(path) => {
                let read = std::fs::read_to_string(path);
                let text =
                    read.map_err(|error| Error::Usage(format!("--api-key-file: {}: {error}", path.display())))?;
                (format!("--api-key-file: {}", path.display()), text)
            }
            None => match std::env::var(KEY_VARIABLE) {
                Ok(text) if !text.is_empty() => (KEY_VARIABLE.to_owned(), text),
                Err(std::env::VarError::NotUnicode(_)) => {
                    return Err(Error::Usage(format!("{KEY_VARIABLE} holds no text")));
                }
                _ => return Ok(None),
            },
        };
        let key = keys::checked(text.trim()).map_err(|problem| Error::Usage(format!("{source} {problem}")))?;
        Ok(Some(key.to_owned()))
    }

    /// What every call carries.
    ///
    /// # Errors
    /// [`Error::Usage`] for a key that cannot be read or is none, and for one that would travel readable.
    pub(super) fn bearer(&self, endpoint: &Endpoint) -> Result<Bearer, Error> {
        let Some(key) = self.key()? else { return Ok(Bearer(None)) };
        let uri = endpoint.uri();
        if uri.scheme_str() != Some("https") && !self.plaintext_keys && !is_loopback(uri.host().unwrap_or_default()) {
            return Err(Error::Usage(format!(
                "the API key would travel readable to {uri}: use https://, or --plaintext-keys where nobody can listen in"
            )));
        }
        // Only characters that a header may hold are left in a key.
        let mut value: MetadataValue<Ascii> =
            format!("Bearer {key}").parse().map_err(|_| Error::Usage("the API key is none".into()))?;
        value.set_sensitive(true);
        Ok(Bearer(Some(value)))
    }

    /// Adds TLS to an `https://` endpoint.
    ///
    /// # Errors
    /// [`Error::Usage`] for files that cannot be used, or that have no meaning for `http://`.
    pub(super) fn secure(&self, endpoint: Endpoint) -> Result<Endpoint, Error> {
        if endpoint.uri().scheme_str() != Some("https") {
            return match self.tls_ca.is_some() || self.tls_cert.is_some() {
                true => Err(Error::Usage("--tls-ca and --tls-cert need a server with https://".into())),
                false => Ok(endpoint),
            };
        }
        let mut config = ClientTlsConfig::new().timeout(CONNECT_TIMEOUT);
        config = match &self.tls_ca {
            None => config.with_native_roots(),
            Some(path) => config.ca_certificate(Certificate::from_pem(certificates("--tls-ca", path)?)),
        };
        if let Some((certificate, key)) = self.tls_cert.as_ref().zip(self.tls_key.as_ref()) {
            let chain = certificates("--tls-cert", certificate)?;
            tls::private_key(key).map_err(|error| Error::Usage(format!("--tls-key: {error}")))?;
            config = config.identity(Identity::from_pem(chain, read("--tls-key", key)?));
        }
        endpoint.tls_config(config).map_err(|error| {
            let cause = super::error::root_cause(&error);
            let hint = if self.tls_ca.is_none() { "; --tls-ca says which authorities to trust" } else { "" };
            Error::Usage(format!("TLS cannot be set up: {cause}{hint}"))
        })
    }
}

/// The bytes of a PEM file that holds certificates.
fn certificates(flag: &str, path: &Path) -> Result<Vec<u8>, Error> {
    tls::certificates(path).map_err(|error| Error::Usage(format!("{flag}: {error}")))?;
    read(flag, path)
}

fn read(flag: &str, path: &Path) -> Result<Vec<u8>, Error> {
    std::fs::read(path).map_err(|error| Error::Usage(format!("{flag}: {}: {error}", path.display())))
}

fn is_loopback(host: &str) -> bool {
    let address = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || address.parse().is_ok_and(|ip: std::net::IpAddr| ip.to_canonical().is_loopback())
}

/// Puts the API key into every call.
#[derive(Clone)]
pub struct Bearer(Option<MetadataValue<Ascii>>);

impl fmt::Debug for Bearer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "Bearer(***)" } else { "Bearer(none)" })
    }
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(value) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_goes_in_the_clear_to_this_machine_only() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("key");
        let key = "0123456789abcdef0123456789abcdef";
        std::fs::write(&path, format!("{key}\n")).expect("written");
        let mut access = AccessArgs { api_key_file: Some(path), ..AccessArgs::default() };
        let allowed = |access: &AccessArgs, url: &'static str| access.bearer(&Endpoint::from_static(url));
        for near in ["http://127.0.0.1:1", "http://localhost:1", "http://[::1]:1", "https://far.example"] {
            let bearer = allowed(&access, near).expect(near);
            assert!(bearer.0.is_some() && !format!("{bearer:?}").contains(key), "{near}");
        }
        for far in ["http://far.example:1", "http://10.0.0.1:1", "http://localhost.far.example:1"] {
            let error = allowed(&access, far).expect_err(far).to_string();
            assert!(error.contains("https://") && !error.contains(key), "{error}");
        }
        access.plaintext_keys = true;
        assert!(allowed(&access, "http://far.example:1").is_ok());
    }
}
