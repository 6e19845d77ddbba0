//! How long ended jobs and begun uploads are kept, as it is written: `30d` or `forever`.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::engine;

/// Seconds of each unit.
const UNITS: [(char, u64); 4] = [('d', 86_400), ('h', 3_600), ('m', 60), ('s', 1)];

/// Longest time to keep anything for, 1000 years of 365.25 days. The end of what is kept is told as a time of the
/// calendar, which ends with the year 9999; who means longer means `forever`.
const MOST_DAYS: u64 = 365_250;

/// How long an ended job, or an upload, is kept; `None`: forever.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Retention(pub Option<Duration>);

impl Default for Retention {
    fn default() -> Self {
        Self(Some(engine::Options::DEFAULT_RETENTION))
    }
}

impl FromStr for Retention {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "forever" {
            return Ok(Self(None));
        }
        let wrong = || {
            format!("`{text}` is no time to keep anything for; right would be `30d`, `12h`, `90m`, `45s` or `forever`")
        };
        let split = |(unit, seconds)| text.strip_suffix(unit).map(|count| (count, seconds));
        let (count, seconds): (_, u64) = UNITS.into_iter().find_map(split).ok_or_else(wrong)?;
        let count: u64 = count.parse().map_err(|_| wrong())?;
        let seconds = count.saturating_mul(seconds);
        if seconds == 0 {
            return Err(wrong());
        }
        if seconds > MOST_DAYS * UNITS[0].1 {
            return Err(format!("`{text}` is above {MOST_DAYS}d, a thousand years; right would be less, or `forever`"));
        }
        Ok(Self(Some(Duration::from_secs(seconds))))
    }
}

impl fmt::Display for Retention {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(kept) = self.0 else { return f.write_str("forever") };
        let seconds = kept.as_secs();
        let (unit, size) = UNITS.into_iter().find(|(_, size)| seconds % size == 0).unwrap_or(('s', 1));
        write!(f, "{}{unit}", seconds / size)
    }
}

impl Serialize for Retention {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Retention {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_as_they_are_written_and_slips_are_refused() {
        for (text, seconds) in [("30d", 2_592_000), ("12h", 43_200), ("90m", 5_400), ("45s", 45)] {
            let read: Retention = text.parse().expect(text);
            assert_eq!((read.0, read.to_string().as_str()), (Some(Duration::from_secs(seconds)), text));
        }
        assert_eq!("forever".parse(), Ok(Retention(None)));
        assert_eq!(Retention(None).to_string(), "forever");
        for slip in ["", "30", "d", "0d", "-1d", "1.5h", "30 d", "30dd", "99999999999999999999d", "213503982334602d"] {
            assert!(slip.parse::<Retention>().is_err(), "{slip}");
        }
        for (longest, above) in [("365250d", "365251d"), ("31557600000s", "31557600001s")] {
            assert!(longest.parse::<Retention>().is_ok(), "{longest}");
            let error = above.parse::<Retention>().expect_err(above);
            assert!(error.contains("365250d") && error.contains("`forever`"), "{error}");
        }
        assert_eq!(Retention::default().to_string(), "30d");
    }
}
