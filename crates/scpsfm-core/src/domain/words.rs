//! Counts in sentences.

use std::fmt::Display;

/// A count and what is counted, as in `1 track`, `2 tracks` and `0 wrong matches`.
///
/// * `noun`: in the singular, words before it included
pub fn counted<N: Display + PartialEq + From<u8>>(count: N, noun: &str) -> String {
    if count == N::from(1) {
        return format!("{count} {noun}");
    }
    let letter_before_y = noun.strip_suffix('y').and_then(|stem| stem.chars().next_back());
    match letter_before_y {
        Some(letter) if !"aeiou".contains(letter) => format!("{count} {}ies", &noun[..noun.len() - 1]),
        _ if ["ch", "s", "x"].iter().any(|end| noun.ends_with(end)) => format!("{count} {noun}es"),
        _ => format!("{count} {noun}s"),
    }
}

#[cfg(test)]
mod tests {
    use super::counted;

    #[test]
    fn one_is_singular_and_every_other_count_plural() {
        assert_eq!(counted(1usize, "track"), "1 track");
        assert_eq!(counted(0u32, "track"), "0 tracks");
        assert_eq!(counted(2u64, "inlier track"), "2 inlier tracks");
        assert_eq!(counted(1u8, "match"), "1 match");
        let plurals = ["3 matches", "3 entries", "3 keys", "3 boxes"];
        assert_eq!(["match", "entry", "key", "box"].map(|noun| counted(3usize, noun)), plurals);
    }
}
