//! What is wrong with an input or a setting, named so that the caller can mend it.

use std::fmt;

/// One rule that one field breaks.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Violation {
    /// Path of the field in the API's spelling, without an index: `track_set.xs`, `job.settings.alpha`.
    pub field: String,
    /// Element of a repeated field, counted from 0.
    pub index: Option<usize>,
    /// Field of that element: `name`, `size.width_px`.
    pub part: Option<String>,
    /// What is wrong and what would be right, in lower case.
    pub description: String,
}

impl Violation {
    /// A violation of a field as a whole.
    pub fn of(field: impl Into<String>, description: impl Into<String>) -> Self {
        Self { field: field.into(), index: None, part: None, description: description.into() }
    }

    /// A violation of one element of a repeated field.
    pub fn at(field: impl Into<String>, index: usize, description: impl Into<String>) -> Self {
        Self { field: field.into(), index: Some(index), part: None, description: description.into() }
    }

    /// The same of a field of the element.
    pub fn within(self, part: &str) -> Self {
        Self { part: Some(part.to_owned()), ..self }
    }

    /// The field with its index, as it is shown to callers: `track_set.xs[17]`, `track_set.views[2].name`.
    pub fn path(&self) -> String {
        let index = self.index.map_or_else(String::new, |index| format!("[{index}]"));
        let part = self.part.as_ref().map_or_else(String::new, |part| format!(".{part}"));
        format!("{}{index}{part}", self.field)
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path(), self.description)
    }
}

/// A caller's text as an error repeats it: quoted, and cut where it would fill the error.
pub fn quoted(text: &str) -> String {
    /// Long enough to be recognised; errors travel in headers that hold some thousand bytes.
    const MOST_CHARACTERS: usize = 80;
    match text.char_indices().nth(MOST_CHARACTERS) {
        Some((end, _)) => format!("{:?}... ({} bytes)", &text[..end], text.len()),
        None => format!("{text:?}"),
    }
}

/// An input or a setting that no solver may see, with every violation found (at most [`InvalidInput::MAX_LISTED`]).
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", self.sentence())]
pub struct InvalidInput {
    violations: Vec<Violation>,
    unlisted: usize,
}

impl InvalidInput {
    /// Violations that are listed one by one; a file with a million wrong lines needs no million sentences.
    pub const MAX_LISTED: usize = 20;

    /// The violations, grouped by rule.
    pub fn violations(&self) -> &[Violation] {
        &self.violations
    }

    /// How many more there were than are listed.
    pub fn unlisted(&self) -> usize {
        self.unlisted
    }

    fn sentence(&self) -> String {
        let mut text = self.violations.iter().map(Violation::to_string).collect::<Vec<_>>().join("; ");
        if self.unlisted > 0 {
            text.push_str(&format!("; and {} more", self.unlisted));
        }
        text
    }
}

/// Collects violations; an empty collection is a pass.
#[derive(Debug, Default)]
pub struct Violations {
    listed: Vec<Violation>,
    unlisted: usize,
}

impl Violations {
    /// Adds one; past [`InvalidInput::MAX_LISTED`] it is only counted.
    pub fn push(&mut self, violation: Violation) {
        if self.listed.len() < InvalidInput::MAX_LISTED {
            self.listed.push(violation);
        } else {
            self.unlisted += 1;
        }
    }

    /// `Err` with everything found, `Ok` when there is nothing.
    pub fn into_result(self) -> Result<(), InvalidInput> {
        if self.listed.is_empty() {
            Ok(())
        } else {
            Err(InvalidInput { violations: self.listed, unlisted: self.unlisted })
        }
    }
}

impl From<Violation> for InvalidInput {
    fn from(violation: Violation) -> Self {
        Self { violations: vec![violation], unlisted: 0 }
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn long_texts_are_cut_at_a_character() {
        assert_eq!(super::quoted("a\n"), "\"a\\n\"");
        let long = super::quoted(&"\u{e9}".repeat(5000));
        assert!(long.len() < 300 && long.ends_with("... (10000 bytes)"), "{long}");
    }
}
