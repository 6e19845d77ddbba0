//! Words of commands that are printed for a shell.

/// A word as a shell reads it whole.
pub fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_./:@%+=,".contains(c);
    if !word.is_empty() && word.chars().all(plain) { word.into() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_shell_would_split_or_expand_is_quoted() {
        assert_eq!((quoted("a/b.csv"), quoted("it's").as_str()), ("a/b.csv".to_owned(), "'it'\\''s'"));
        assert_eq!((quoted(""), quoted("a b"), quoted("$HOME")), ("''".into(), "'a b'".into(), "'$HOME'".into()));
    }
}
