//! JSON that is read from files: an error names the field, and numbers are in their range.

use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer};

/// The value of a text.
///
/// # Errors
/// What is wrong, behind the path of the field where there is one: `` `views[2].t`: invalid type ... ``.
pub fn read<T: DeserializeOwned>(text: &[u8]) -> Result<T, String> {
    let mut json = serde_json::Deserializer::from_slice(text);
    let value = serde_path_to_error::deserialize(&mut json).map_err(|error| match error.path().iter().next() {
        Some(_) => format!("`{}`: {}", error.path(), error.inner()),
        None => error.inner().to_string(),
    })?;
    json.end().map_err(|error| error.to_string())?;
    Ok(value)
}

/// A number above 0, or null.
///
/// # Errors
/// For anything else.
pub fn positive<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    within(deserializer, |number| number > 0.0, "above 0")
}

/// A number from 0 on, or null.
///
/// # Errors
/// For anything else.
pub fn not_negative<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    within(deserializer, |number| number >= 0.0, "from 0 on")
}

fn within<'de, D: Deserializer<'de>>(
    deserializer: D,
    is_right: fn(f64) -> bool,
    right: &str,
) -> Result<Option<f64>, D::Error> {
    let number = Option::<f64>::deserialize(deserializer)?;
    match number.filter(|&number| !is_right(number)) {
        Some(wrong) => Err(D::Error::custom(format_args!("{wrong} is not a number {right}"))),
        None => Ok(number),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize)]
    struct Camera {
        #[serde(default, deserialize_with = "positive")]
        focal_px: Option<f64>,
        #[serde(default, deserialize_with = "not_negative")]
        sigma: Option<f64>,
    }

    #[derive(Debug, Deserialize)]
    struct File {
        cameras: Vec<Camera>,
    }

    #[test]
    fn what_is_wrong_is_told_with_the_path_of_its_field() {
        let read = |text: &str| read::<File>(text.as_bytes());
        let good = read(r#"{"cameras": [{"focal_px": 2.5, "sigma": 0}, {"focal_px": null}]}"#).expect("good");
        assert_eq!((good.cameras[0].focal_px, good.cameras[0].sigma), (Some(2.5), Some(0.0)));
        assert_eq!((good.cameras[1].focal_px, good.cameras[1].sigma), (None, None));
        let cases = [
            (r#"{"cameras": [{}, {"focal_px": -3}]}"#, "`cameras[1].focal_px`: -3 is not a number above 0"),
            (r#"{"cameras": [{"focal_px": 0}]}"#, "`cameras[0].focal_px`: 0 is not"),
            (r#"{"cameras": [{"sigma": -1e-3}]}"#, "`cameras[0].sigma`: -0.001 is not a number from 0 on"),
            (r#"{"cameras": [{"focal_px": 1e999}]}"#, "`cameras[0].focal_px`: number out of range"),
            (r#"{"cameras": [{"focal_px": "wide"}]}"#, "`cameras[0].focal_px`: invalid type"),
            (r#"{"views": []}"#, "missing field `cameras`"),
            (r#"{"cameras": []} 7"#, "trailing characters"),
        ];
        for (text, expected) in cases {
            let told = read(text).expect_err(text);
            assert!(told.starts_with(expected), "{told}");
        }
    }
}
