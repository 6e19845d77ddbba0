//! Numbers as compact text for the page's script: little-endian bytes in base64.

/// The alphabet of RFC 4648, section 4.
const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

/// Bytes to be read by the script in the order they were pushed.
#[derive(Default)]
pub struct Packed(Vec<u8>);

impl Packed {
    pub fn push_u8(&mut self, value: u8) {
        self.0.push(value);
    }

    pub fn push_u16(&mut self, value: u16) {
        self.0.extend(value.to_le_bytes());
    }

    pub fn push_f32(&mut self, value: f32) {
        self.0.extend(value.to_le_bytes());
    }

    /// The bytes in base64, padded: four characters for three bytes.
    pub fn text(&self) -> String {
        let mut text = String::with_capacity(self.0.len().div_ceil(3) * 4);
        for three in self.0.chunks(3) {
            let bits = (0..3).fold(0u32, |bits, k| bits << 8 | u32::from(three.get(k).copied().unwrap_or(0)));
            for k in 0..4 {
                let six = (bits >> (18 - 6 * k)) as usize & 63;
                text.push(if k <= three.len() { char::from(ALPHABET[six]) } else { '=' });
            }
        }
        text
    }
}

/// A value within `low..=high` in 16 bits; what is beyond lies on the border.
pub fn quantised(value: f64, low: f64, high: f64) -> u16 {
    let share = if high > low { ((value - low) / (high - low)).clamp(0.0, 1.0) } else { 0.0 };
    (share * f64::from(u16::MAX)).round() as u16
}

/// The code of a residual that is unknown.
pub const NO_RESIDUAL: u16 = 0x3fff;
/// Codes a factor of e; with it a code holds residuals to a thousandth, and up to 130,000 px in 14 bits.
const CODES_AN_E: f64 = 1000.0;
/// Below the reciprocal of this many pixels, residuals are coded linearly rather than by their logarithm.
const LINEAR_BELOW: f64 = 100.0;

/// A residual in 14 bits: `1000 ln(1 + 100 r)`, `r` in pixels.
pub fn residual_code(px: Option<f64>) -> u16 {
    match px {
        Some(px) if px.is_finite() => {
            ((LINEAR_BELOW * px.max(0.0)).ln_1p() * CODES_AN_E).round().min(f64::from(NO_RESIDUAL - 1)) as u16
        }
        _ => NO_RESIDUAL,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_that_of_the_rfc() {
        // RFC 4648, section 10.
        for (bytes, text) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(Packed(bytes.into()).text(), text);
        }
        let mut packed = Packed::default();
        packed.push_u16(0x6f66);
        packed.push_u8(b'o');
        assert_eq!(packed.text(), "Zm9v");
    }

    #[test]
    fn codes_keep_what_a_picture_shows() {
        for px in [0.0, 0.004, 0.35, 12.5, 9e4] {
            let back = (f64::from(residual_code(Some(px))) / CODES_AN_E).exp_m1() / LINEAR_BELOW;
            assert!((back - px).abs() <= 1e-3 * px + 1e-4, "{px} came back as {back}");
        }
        assert!(residual_code(Some(1e300)) < NO_RESIDUAL);
        assert_eq!(residual_code(None), NO_RESIDUAL);
        assert_eq!(residual_code(Some(f64::NAN)), NO_RESIDUAL);
        assert_eq!([-9.0, 0.0, 1.0, 7.0].map(|value| quantised(value, 0.0, 1.0)), [0, 0, 65535, 65535]);
    }
}
