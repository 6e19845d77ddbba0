//! What a file calls its views and tracks: numbers or names.

use std::fmt;

use serde::Serialize;

use crate::domain::View;

/// The caller's own id of a view or a track. Numbers come before names.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(untagged)]
pub enum Label {
    Number(u64),
    Name(Box<str>),
}

impl Label {
    /// Longest name that a page or a sentence shows, in characters: a page shows a name several times.
    pub const LONGEST_SHOWN: usize = 48;

    /// A name, as of an image.
    ///
    /// # Errors
    /// As [`View::check_name`].
    pub fn name(text: &str) -> Result<Self, String> {
        View::check_name(text).map(|()| Label::Name(text.into()))
    }

    /// An id that is a number or a name: a number where it is written as numbers are, so that no two ids become one.
    ///
    /// # Errors
    /// As [`Label::name`].
    pub fn parse(text: &str) -> Result<Self, String> {
        match text.parse::<u64>() {
            Ok(number) if number.to_string() == text => Ok(Label::Number(number)),
            _ => Self::name(text),
        }
    }

    /// The number, where the label is one.
    pub fn number(&self) -> Option<u64> {
        match self {
            Label::Number(number) => Some(*number),
            Label::Name(_) => None,
        }
    }

    /// The label as a page or a sentence shows it: whole, or where it is long its end, where the names of one folder
    /// differ.
    pub fn shown(&self) -> String {
        let name = self.to_string();
        let excess = name.chars().count().saturating_sub(Self::LONGEST_SHOWN);
        if excess == 0 { name } else { format!("\u{2026}{}", name.chars().skip(excess + 1).collect::<String>()) }
    }

    /// The label as a field of a CSV: quoted where a comma or a quote would break the line (RFC 4180).
    pub fn csv(&self) -> String {
        match self {
            Label::Name(name) if name.contains([',', '"']) || name.trim().len() != name.len() => {
                format!("\"{}\"", name.replace('"', "\"\""))
            }
            label => label.to_string(),
        }
    }
}

impl From<u64> for Label {
    fn from(number: u64) -> Self {
        Label::Number(number)
    }
}

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Label::Number(number) => number.fmt(f),
            Label::Name(name) => name.fmt(f),
        }
    }
}

/// The distinct labels, ascending, and the position of each entry's label among them.
pub(super) fn dense<L: Ord + Clone>(labels: &[L]) -> (Vec<L>, Vec<u32>) {
    let mut distinct = labels.to_vec();
    distinct.sort_unstable();
    distinct.dedup();
    // Every entry is among the distinct ones, and the limits keep their number within 32 bits.
    let positions = labels.iter().map(|label| distinct.partition_point(|other| other < label) as u32).collect();
    (distinct, positions)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_written_as_a_number_is_one() {
        assert_eq!(Label::parse("7"), Ok(Label::Number(7)));
        for name in ["07", "+7", "7.jpg", "18446744073709551616"] {
            assert_eq!(Label::parse(name), Ok(Label::Name(name.into())), "{name}");
        }
        assert!(Label::parse("").is_err() && Label::name("a\nb").is_err());
        assert!(Label::name(&"x".repeat(View::MAX_NAME_BYTES + 1)).is_err());
    }

    #[test]
    fn long_names_lose_their_beginning() {
        assert_eq!(Label::Number(7).shown(), "7");
        let long = format!("{}/IMG_1.jpg", "\u{e9}".repeat(200));
        let shown = Label::Name(long.into()).shown();
        assert_eq!(shown.chars().count(), Label::LONGEST_SHOWN);
        assert!(shown.starts_with("\u{2026}\u{e9}") && shown.ends_with("\u{e9}/IMG_1.jpg"), "{shown}");
    }

    #[test]
    fn a_name_stays_one_field_of_a_csv() {
        let csv = |name: &str| Label::Name(name.into()).csv();
        assert_eq!(csv("a b.jpg"), "a b.jpg");
        assert_eq!(csv("a,\"b\".jpg"), "\"a,\"\"b\"\".jpg\"");
        assert_eq!(Label::Number(3).csv(), "3");
    }

    #[test]
    fn positions_are_among_the_ascending_labels() {
        assert_eq!(dense(&[9u64, 7, 9]), (vec![7, 9], vec![1, 0, 1]));
    }
}
