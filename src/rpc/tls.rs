//! TLS on the gRPC port: certificates from files that may change.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio_rustls::rustls::client::{verify_server_cert_signed_by_trust_anchor, verify_server_name};
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use tokio_rustls::rustls::server::{ParsedCertificate, WebPkiClientVerifier};
use tokio_rustls::rustls::{CertificateError, Error, RootCertStore, ServerConfig};

use crate::telemetry::metrics::certificate_end;

/// What gRPC speaks, as the handshake names it (RFC 7301).
const HTTP_2: &[u8] = b"h2";

/// PEM files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Files {
    /// The server's certificate, followed by those that lead to its authority.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// Authorities one of which must have signed a client's certificate; `None`: clients need none.
    pub client_ca: Option<PathBuf>,
}

impl Files {
    /// All of them.
    pub fn paths(&self) -> Vec<PathBuf> {
        [&self.certificate, &self.key].into_iter().chain(&self.client_ca).cloned().collect()
    }

    /// The server's own certificate; `None` where it cannot be read.
    pub fn certificate(&self) -> Option<Certificate> {
        Certificate::read(certificates(&self.certificate).ok()?.first()?)
    }

    /// What to offer in a handshake.
    ///
    /// # Errors
    /// A sentence that names the file, and nothing of what a key holds.
    pub fn load(&self) -> Result<ServerConfig, String> {
        let chain = certificates(&self.certificate)?;
        let key = private_key(&self.key)?;
        let provider = Arc::new(ring::default_provider());
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_safe_default_protocol_versions()
            .map_err(|error| format!("TLS: {error}"))?;
        let builder = match &self.client_ca {
            None => builder.with_no_client_auth(),
            Some(path) => {
                let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots(path)?), provider).build();
                builder.with_client_cert_verifier(verifier.map_err(|error| format!("{}: {error}", path.display()))?)
            }
        };
        let mut config = builder.with_single_cert(chain, key).map_err(|error| {
            format!("{} and {} do not belong together: {error}", self.certificate.display(), self.key.display())
        })?;
        config.alpn_protocols.push(HTTP_2.to_vec());
        Ok(config)
    }
}

/// What clients will think of a server's certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Certificate {
    /// From when on it is valid, and until when.
    pub begin: SystemTime,
    pub end: SystemTime,
    /// Whether it names the server as clients ask for it: a subject alternative name.
    pub has_name: bool,
}

impl Certificate {
    /// Reads it as rustls' clients do; `None` where they could not read it at all.
    fn read(der: &CertificateDer<'_>) -> Option<Self> {
        let certificate = ParsedCertificate::try_from(der).ok()?;
        let algorithms = ring::default_provider().signature_verification_algorithms.all;
        // rustls tells the times only where it refuses a certificate for them, which it does before it looks for its
        // authority: at the beginning of time for one, and at its end for the other.
        let refused_at = |seconds| {
            let now = UnixTime::since_unix_epoch(Duration::from_secs(seconds));
            let roots = RootCertStore::empty();
            verify_server_cert_signed_by_trust_anchor(&certificate, &roots, &[], now, algorithms).err()
        };
        let time = |time: UnixTime| SystemTime::UNIX_EPOCH + Duration::from_secs(time.as_secs());
        let begin = match refused_at(0)? {
            Error::InvalidCertificate(CertificateError::NotValidYetContext { not_before, .. }) => time(not_before),
            _ => SystemTime::UNIX_EPOCH,
        };
        let Error::InvalidCertificate(CertificateError::ExpiredContext { not_after, .. }) = refused_at(u64::MAX)?
        else {
            return None;
        };
        let asked = ServerName::try_from("scpsfm.invalid").ok()?;
        let has_name = match verify_server_name(&certificate, &asked) {
            Ok(()) => true,
            Err(Error::InvalidCertificate(CertificateError::NotValidForNameContext { presented, .. })) => {
                !presented.is_empty()
            }
            Err(_) => false,
        };
        Some(Self { begin, end: time(not_after), has_name })
    }

    /// Why clients will refuse it at that time, if they will.
    fn problem(self, now: SystemTime) -> Option<&'static str> {
        if now > self.end {
            Some("it has expired")
        } else if now < self.begin {
            Some("it is not valid yet")
        } else if !self.has_name {
            Some("it has no subject alternative name")
        } else {
            None
        }
    }

    /// Reports its end to the metrics, and to the log where clients will refuse it.
    pub fn report(self) {
        certificate_end(self.end);
        if let Some(problem) = self.problem(SystemTime::now()) {
            tracing::warn!(problem, "clients will refuse the server's certificate (tls.certificate)");
        }
    }
}

/// The certificates of a PEM file, at least one.
///
/// # Errors
/// A sentence that names the file.
pub fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&read(path)?).collect();
    match found {
        Ok(found) if !found.is_empty() => Ok(found),
        _ => Err(format!("{}: holds no certificate in PEM form (-----BEGIN CERTIFICATE-----)", path.display())),
    }
}

/// The private key of a PEM file.
///
/// # Errors
/// A sentence that names the file. The parser's own words are left out: they may repeat a line of the key.
pub fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, String> {
    PrivateKeyDer::from_pem_slice(&read(path)?)
        .map_err(|_| format!("{}: holds no unencrypted private key in PEM form", path.display()))
}

/// The authorities of a PEM file.
fn roots(path: &Path) -> Result<RootCertStore, String> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(path)? {
        roots.add(certificate).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    Ok(roots)
}

fn read(path: &Path) -> Result<Vec<u8>, String> {
    std::fs::read(path).map_err(|error| format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair, date_time_ymd};

    use super::*;

    fn certificate(names: &[&str], begin: i32, end: i32) -> Certificate {
        let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
        let mut params = CertificateParams::new(names).expect("parameters");
        (params.not_before, params.not_after) = (date_time_ymd(begin, 1, 1), date_time_ymd(end, 1, 1));
        let signed = params.self_signed(&KeyPair::generate().expect("a key")).expect("a certificate");
        Certificate::read(signed.der()).expect("readable")
    }

    #[test]
    fn what_clients_will_refuse_is_known_beforehand() {
        // 1 January of 2000 and 2100.
        let [begin, end] =
            [946_684_800, 4_102_444_800].map(|seconds| SystemTime::UNIX_EPOCH + Duration::from_secs(seconds));
        let sound = certificate(&["solver.example", "127.0.0.1"], 2000, 2100);
        assert_eq!(sound, Certificate { begin, end, has_name: true });
        let day = Duration::from_secs(24 * 60 * 60);
        assert_eq!(sound.problem(begin + day), None);
        assert_eq!(sound.problem(begin - day), Some("it is not valid yet"));
        assert_eq!(sound.problem(end + day), Some("it has expired"));
        let addresses = certificate(&["127.0.0.1"], 2000, 2100);
        assert_eq!(addresses.problem(begin + day), None, "an address is a name");
        let nameless = certificate(&[], 2000, 2100);
        assert_eq!(nameless.problem(begin + day), Some("it has no subject alternative name"));
    }
}
