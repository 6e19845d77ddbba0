//! Digests: bytes inside and on the wire, hexadecimal digits where people read them.

use std::fmt;

use serde::{Deserialize, Serialize};

/// A SHA-256, shown in hexadecimal digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sha256Digest(pub [u8; 32]);

impl fmt::Display for Sha256Digest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0.map(|byte| format!("{byte:02x}")).concat())
    }
}

#[cfg(test)]
mod tests {
    use super::Sha256Digest;

    #[test]
    fn a_digest_is_shown_in_hexadecimal_digits() {
        let digest = Sha256Digest(std::array::from_fn(|place| 8 * place as u8));
        let shown = "0008101820283038404850586068707880889098a0a8b0b8c0c8d0d8e0e8f0f8";
        assert_eq!((digest.to_string(), format!("{digest:.5}")), (shown.to_owned(), "00081".to_owned()));
    }
}
