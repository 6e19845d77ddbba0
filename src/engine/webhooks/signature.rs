//! Secrets and signatures of webhooks, as Standard Webhooks has them (standardwebhooks.com, symmetric signatures).

use std::fmt;
use std::str::FromStr;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, Mac};
use serde::{Deserialize, Deserializer};
use sha2::Sha256;

use crate::domain::job::JobName;

/// What a secret begins with.
const PREFIX: &str = "whsec_";

/// Bytes of a secret, as Standard Webhooks bounds them.
const SECRET_BYTES: std::ops::RangeInclusive<usize> = 24..=64;

/// The secrets that deliveries are signed with: those of a tenant, and those of all tenants that have none of their
/// own. With several, a delivery carries the signature of each, so that receivers can change theirs one by one.
#[derive(Clone, PartialEq, Eq, Default)]
pub struct Secrets(Vec<(Option<String>, Vec<u8>)>);

impl Secrets {
    /// Those of a tenant.
    pub fn of(&self, tenant: &str) -> Vec<&[u8]> {
        let owned_by = |owner: Option<&str>| -> Vec<&[u8]> {
            let own = self.0.iter().filter(|(of, _)| of.as_deref() == owner);
            own.map(|(_, secret)| secret.as_slice()).collect()
        };
        let own = owned_by(Some(tenant));
        if own.is_empty() { owned_by(None) } else { own }
    }

    /// These and others.
    pub fn with(mut self, others: &Self) -> Self {
        self.0.extend_from_slice(&others.0);
        self
    }
}

impl FromStr for Secrets {
    type Err = String;

    /// Reads `SECRET` or `TENANT:SECRET`, separated by commas or lines; `#` begins a comment. Errors repeat nothing.
    fn from_str(text: &str) -> Result<Self, String> {
        let lines = text.lines().map(|line| line.split('#').next().unwrap_or_default());
        let entries = lines.flat_map(|line| line.split(',')).map(str::trim).filter(|entry| !entry.is_empty());
        let read = |(number, entry): (usize, &str)| {
            let wrong = |what: &str| format!("entry {number} {what}");
            let (tenant, secret) = match entry.split_once(':') {
                Some((tenant, secret)) => (Some(tenant.trim()), secret.trim()),
                None => (None, entry),
            };
            if tenant.is_some_and(|tenant| !JobName::is_id(tenant)) {
                return Err(wrong("does not begin with a tenant's id and a colon"));
            }
            let secret = secret.strip_prefix(PREFIX).and_then(|encoded| STANDARD.decode(encoded).ok());
            match secret.filter(|secret| SECRET_BYTES.contains(&secret.len())) {
                Some(secret) => Ok((tenant.map(str::to_owned), secret)),
                None => Err(wrong("is not whsec_ followed by the base64 of 24 to 64 bytes")),
            }
        };
        let secrets = (1..).zip(entries).map(read).collect::<Result<Vec<_>, _>>()?;
        if secrets.is_empty() { Err("holds no secret".into()) } else { Ok(Self(secrets)) }
    }
}

impl fmt::Debug for Secrets {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Secrets({})", self.0.len())
    }
}

impl<'de> Deserialize<'de> for Secrets {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// The header `webhook-signature`: a signature for each secret.
pub(super) fn signatures(secrets: &[&[u8]], id: &str, timestamp: u64, body: &[u8]) -> String {
    let sign = |secret: &&[u8]| {
        // HMAC takes keys of every length.
        let mut mac = Hmac::<Sha256>::new_from_slice(secret).ok()?;
        mac.update(format!("{id}.{timestamp}.").as_bytes());
        mac.update(body);
        Some(format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes())))
    };
    secrets.iter().filter_map(sign).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Example of the libraries of Standard Webhooks.
    const SECRET: &str = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw";
    const OTHER: &str = "whsec_AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA";

    #[test]
    fn a_signature_is_that_of_the_reference() {
        let secrets: Secrets = SECRET.parse().expect("a secret");
        let body = br#"{"test": 2432232314}"#;
        let signed =
            |secrets: &Secrets| signatures(&secrets.of("default"), "msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, body);
        let expected = "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=";
        assert_eq!(signed(&secrets), expected);
        let both = signed(&secrets.with(&OTHER.parse().expect("a secret")));
        assert!(both.starts_with(&format!("{expected} v1,")) && both.matches("v1,").count() == 2, "{both}");
    }

    #[test]
    fn a_tenants_own_secrets_are_used_instead_of_those_of_all() {
        let secrets: Secrets = format!("# all\n{OTHER}\nnorth:{SECRET}, # its own\n").parse().expect("two secrets");
        let others: Secrets = OTHER.parse().expect("a secret");
        assert_ne!(secrets.of("north"), secrets.of("south"));
        assert_eq!(secrets.of("south"), others.of("north"));
        let alone: Secrets = format!("north:{SECRET}").parse().expect("a secret");
        assert!(alone.of("south").is_empty());
        assert_eq!(format!("{secrets:?}"), "Secrets(2)");
    }

    #[test]
    fn what_is_no_secret_is_refused_and_not_repeated() {
        for wrong in ["", "#", "hunter2", "whsec_hunter2", "A:whsec_hunter2", "whsec_AAAA", "whsec_!hunter2", ":x"] {
            let error = wrong.parse::<Secrets>().expect_err(wrong);
            assert!(!error.contains("hunter2"), "{error}");
        }
        let error = format!("{SECRET},{SECRET}x").parse::<Secrets>().expect_err("a second entry that is wrong");
        assert!(error.starts_with("entry 2 ") && !error.contains("MfKQ"), "{error}");
    }
}
