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
    /// Violations that are listed at most; a file with a million wrong lines needs no million sentences.
    pub const MAX_LISTED: usize = 20;

    /// The violations, grouped by rule.
    pub fn violations(&self) -> &[Violation] {
        &self.violations
    }

    /// How many more there were of kinds that are not listed.
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

/// What is collected in a [`Listing`].
pub trait Groupable {
    /// Whether both say the same of other values.
    fn is_same_kind(&self, other: &Self) -> bool;

    /// Adds to the description.
    fn append(&mut self, text: &str);
}

impl Groupable for Violation {
    fn is_same_kind(&self, other: &Self) -> bool {
        self.field == other.field && are_alike(&self.description, &other.description)
    }

    fn append(&mut self, text: &str) {
        self.description.push_str(text);
    }
}

/// Whether two sentences differ in their values alone: in numbers and in quoted words.
pub fn are_alike(one: &str, other: &str) -> bool {
    let is_value = |word: &&str| {
        word.contains(|sign: char| sign.is_ascii_digit() || sign == '"' || sign == '`')
            || ["NaN", "inf", "-inf"].contains(word)
    };
    let words = |text| str::split_whitespace(text).filter(|word| !is_value(word));
    words(one).eq(words(other))
}

/// Lists problems: of each kind the first few and a count, so that a thousand of one kind hide none of another.
#[derive(Debug)]
pub struct Listing<T> {
    listed: Vec<T>,
    kinds: Vec<Kind>,
    /// Of kinds that have no place any more.
    unlisted: usize,
}

/// Problems of one kind: places in the list, and how many there were.
#[derive(Debug)]
struct Kind {
    first: usize,
    last: usize,
    count: usize,
    unlisted: usize,
}

impl<T> Default for Listing<T> {
    fn default() -> Self {
        Self { listed: Vec::new(), kinds: Vec::new(), unlisted: 0 }
    }
}

impl<T: Groupable> Listing<T> {
    /// Problems of one kind that are listed one by one: enough to see what they have in common.
    pub const MAX_ALIKE: usize = 3;

    /// Adds one.
    pub fn push(&mut self, problem: T) {
        let is_full = self.listed.len() >= InvalidInput::MAX_LISTED;
        let place = self.listed.len();
        match self.kinds.iter_mut().find(|kind| self.listed[kind.first].is_same_kind(&problem)) {
            Some(kind) if is_full || kind.count >= Self::MAX_ALIKE => {
                kind.unlisted += 1;
                return;
            }
            Some(kind) => (kind.last, kind.count) = (place, kind.count + 1),
            None if is_full => {
                self.unlisted += 1;
                return;
            }
            None => self.kinds.push(Kind { first: place, last: place, count: 1, unlisted: 0 }),
        }
        self.listed.push(problem);
    }

    /// Counts some that someone else already left unlisted.
    pub fn add_unlisted(&mut self, count: usize) {
        self.unlisted += count;
    }

    /// What is listed, the last of each kind with how many more there were, and how many there were of other kinds.
    pub fn into_parts(mut self) -> (Vec<T>, usize) {
        for kind in self.kinds.iter().filter(|kind| kind.unlisted > 0) {
            self.listed[kind.last].append(&format!("; and {} more like this", kind.unlisted));
        }
        (self.listed, self.unlisted)
    }
}

/// Collects violations; an empty collection is a pass.
pub type Violations = Listing<Violation>;

impl Violations {
    /// `Err` with everything found, `Ok` when there is nothing.
    pub fn into_result(self) -> Result<(), InvalidInput> {
        match self.into_parts() {
            (violations, _) if violations.is_empty() => Ok(()),
            (violations, unlisted) => Err(InvalidInput { violations, unlisted }),
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
    use super::*;

    #[test]
    fn many_of_one_kind_hide_none_of_another() {
        let mut found = Violations::default();
        for k in 0..1000 {
            found.push(Violation::at(
                "xs",
                k,
                format!("{} is not a finite number", if k == 1 { "NaN" } else { "inf" }),
            ));
        }
        found.push(Violation::at("ys", 7, "inf is not a finite number"));
        found.push(Violation::at("xs", 9, "1e9 px is beyond 1e7 px"));
        let error = found.into_result().expect_err("violations");
        let told: Vec<String> = error.violations().iter().map(Violation::to_string).collect();
        assert_eq!(
            told,
            [
                "xs[0]: inf is not a finite number",
                "xs[1]: NaN is not a finite number",
                "xs[2]: inf is not a finite number; and 997 more like this",
                "ys[7]: inf is not a finite number",
                "xs[9]: 1e9 px is beyond 1e7 px",
            ]
        );
        assert_eq!(error.unlisted(), 0);
    }

    #[test]
    fn kinds_without_end_are_counted() {
        let mut found = Violations::default();
        for k in 0..50 {
            found.push(Violation::of(format!("field_{k}"), "is wrong"));
        }
        found.push(Violation::of("field_3", "is wrong"));
        let error = found.into_result().expect_err("violations");
        assert_eq!((error.violations().len(), error.unlisted()), (InvalidInput::MAX_LISTED, 30));
        assert_eq!(error.violations()[3].description, "is wrong; and 1 more like this");
    }

    #[test]
    fn long_texts_are_cut_at_a_character() {
        assert_eq!(quoted("a\n"), "\"a\\n\"");
        let long = quoted(&"\u{e9}".repeat(5000));
        assert!(long.len() < 300 && long.ends_with("... (10000 bytes)"), "{long}");
    }
}
