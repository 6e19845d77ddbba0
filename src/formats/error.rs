//! What is wrong with an input file, by line or byte.

use std::fmt;

use crate::domain::error::{Groupable, Listing, are_alike};

/// Where in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// The file as a whole.
    File,
    /// Line of a text, counted from 1.
    Line(u64),
    /// Bytes before the place in a binary file.
    Byte(u64),
}

/// One thing wrong with a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    pub place: Place,
    /// Column (`x`), record (`camera 3`) or row of a table (`table keypoints, image_id 3`) of the file, or empty.
    pub column: String,
    pub description: String,
}

impl Problem {
    /// A problem of the file as a whole.
    pub fn of_file(description: impl Into<String>) -> Self {
        Self { place: Place::File, column: String::new(), description: description.into() }
    }

    /// A problem of one line.
    pub fn at_line(line: u64, column: &str, description: impl Into<String>) -> Self {
        Self { place: Place::Line(line), column: column.into(), description: description.into() }
    }

    /// A problem of a binary file, found at this offset.
    pub fn at_byte(offset: u64, record: &str, description: impl Into<String>) -> Self {
        Self { place: Place::Byte(offset), column: record.into(), description: description.into() }
    }

    /// A line that is not text.
    pub fn not_text(line: u64) -> Self {
        Self::at_line(line, "", "is not text; the file may be damaged")
    }

    /// A file that cannot be opened or read, for this reason.
    pub fn unreadable(reason: impl fmt::Display) -> Self {
        Self::of_file(format!("cannot be read: {reason}"))
    }

    /// The line from which a file is above the limit of observations.
    pub fn too_many_observations(line: u64, most: usize) -> Self {
        Self::at_line(line, "", format!("more observations than the limit of {most}"))
    }

    /// A problem of a record that has no line, such as a row of a database.
    pub fn of_record(record: impl Into<String>, description: impl Into<String>) -> Self {
        Self { place: Place::File, column: record.into(), description: description.into() }
    }
}

/// An input file that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Error {
    file: String,
    problems: Vec<Problem>,
    unlisted: usize,
}

impl Error {
    /// An error with one problem.
    pub fn one(file: &str, problem: Problem) -> Self {
        Self { file: file.into(), problems: vec![problem], unlisted: 0 }
    }

    /// An error of the file as a whole.
    pub fn whole(file: &str, description: impl Into<String>) -> Self {
        Self::one(file, Problem::of_file(description))
    }

    /// The problems, in the order in which they were found, a bounded number.
    pub fn problems(&self) -> &[Problem] {
        &self.problems
    }

    /// How many more there were of kinds that are not listed.
    pub fn unlisted(&self) -> usize {
        self.unlisted
    }
}

impl std::error::Error for Error {}

/// One sentence a line: `observations.csv, line 18: x: NaN is not a finite number`.
impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (position, problem) in self.problems.iter().enumerate() {
            if position > 0 {
                writeln!(f)?;
            }
            f.write_str(&self.file)?;
            match problem.place {
                Place::File => {}
                Place::Line(line) => write!(f, ", line {line}")?,
                Place::Byte(offset) => write!(f, ", byte {offset}")?,
            }
            if !problem.column.is_empty() {
                write!(f, ": {}", problem.column)?;
            }
            write!(f, ": {}", problem.description)?;
        }
        if self.unlisted > 0 {
            write!(f, "\n{}: and {} more problems", self.file, self.unlisted)?;
        }
        Ok(())
    }
}

impl Groupable for Problem {
    fn is_same_kind(&self, other: &Self) -> bool {
        are_alike(&self.column, &other.column) && are_alike(&self.description, &other.description)
    }

    fn append(&mut self, text: &str) {
        self.description.push_str(text);
    }
}

/// Collects problems; a file with a million wrong lines needs no million sentences.
pub(super) type Problems = Listing<Problem>;

impl Error {
    /// `Err` with all problems of a file, `Ok` when there are none.
    pub(super) fn check(file: &str, problems: Problems) -> Result<(), Self> {
        match problems.into_parts() {
            (problems, _) if problems.is_empty() => Ok(()),
            (problems, unlisted) => Err(Self { file: file.into(), problems, unlisted }),
        }
    }
}
