//! The caller's names as a page shows them.

use crate::formats::result_json::{track_label, view_label};
use crate::formats::{Label, LabelledInput};

/// Longest name that a page shows, in characters: names may have 4,096 bytes, and stand in it several times.
const LONGEST: usize = 48;

/// The name of view `index`.
pub fn view(input: Option<&LabelledInput>, index: usize) -> String {
    cut(&view_label(input, index))
}

/// The name of track `index`.
pub fn track(input: Option<&LabelledInput>, index: usize) -> String {
    cut(&track_label(input, index))
}

/// The whole name, or its end, where the names of one folder differ.
fn cut(label: &Label) -> String {
    let name = label.to_string();
    let excess = name.chars().count().saturating_sub(LONGEST);
    if excess == 0 { name } else { format!("\u{2026}{}", name.chars().skip(excess + 1).collect::<String>()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_names_lose_their_beginning() {
        assert_eq!(cut(&Label::Number(7)), "7");
        let long = format!("{}/IMG_1.jpg", "\u{e9}".repeat(200));
        let shown = cut(&Label::Name(long.into()));
        assert_eq!(shown.chars().count(), LONGEST);
        assert!(shown.starts_with("\u{2026}\u{e9}") && shown.ends_with("\u{e9}/IMG_1.jpg"), "{shown}");
    }
}
