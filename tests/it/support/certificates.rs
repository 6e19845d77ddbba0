//! Certificates made in the test, and the files that hold them.

use std::path::{Path, PathBuf};

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, ExtendedKeyUsagePurpose, IsCa, KeyPair};

/// An authority of the test's own.
pub struct Authority(CertifiedIssuer<'static, KeyPair>);

impl Authority {
    pub fn new(name: &str) -> Self {
        let mut params = CertificateParams::new(vec![]).expect("parameters");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(rcgen::DnType::CommonName, name);
        Self(CertifiedIssuer::self_signed(params, KeyPair::generate().expect("a key")).expect("an authority"))
    }

    /// Writes the authority's own certificate.
    pub fn write(&self, directory: &Path, name: &str) -> PathBuf {
        written(directory, name, &self.0.pem())
    }

    /// Writes the authority's own certificate with its key, as if it were a server's.
    pub fn own(&self, directory: &Path, name: &str) -> Identity {
        Identity {
            certificate: self.write(directory, &format!("{name}.pem")),
            key: written(directory, &format!("{name}.key"), &self.0.key().serialize_pem()),
            der: self.0.der().to_vec(),
        }
    }

    /// Issues a certificate for these names and writes it with its key, as `NAME.pem` and `NAME.key`.
    pub fn issue(&self, directory: &Path, name: &str, subjects: &[&str]) -> Identity {
        let subjects: Vec<String> = subjects.iter().map(|&subject| subject.to_owned()).collect();
        let mut params = CertificateParams::new(subjects).expect("parameters");
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let key = KeyPair::generate().expect("a key");
        let certificate = params.signed_by(&key, &self.0).expect("a certificate");
        Identity {
            certificate: written(directory, &format!("{name}.pem"), &certificate.pem()),
            key: written(directory, &format!("{name}.key"), &key.serialize_pem()),
            der: certificate.der().to_vec(),
        }
    }
}

/// A certificate with its key.
pub struct Identity {
    pub certificate: PathBuf,
    pub key: PathBuf,
    /// The certificate as it goes over the wire.
    pub der: Vec<u8>,
}

pub fn written(directory: &Path, name: &str, text: &str) -> PathBuf {
    let path = directory.join(name);
    std::fs::write(&path, text).expect("written");
    path
}
