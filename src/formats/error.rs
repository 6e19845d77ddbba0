//! What is wrong with an input file, by line.

use std::fmt;

use crate::domain::InvalidInput;

/// One thing wrong with a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Line, counted from 1; `None` where the file as a whole is meant.
    pub line: Option<u64>,
    /// Column of the file (`x`), or empty.
    pub column: String,
    pub description: String,
}

impl Problem {
    /// A problem of the file as a whole.
    pub fn of_file(description: impl Into<String>) -> Self {
        Self { line: None, column: String::new(), description: description.into() }
    }

    /// A problem of one line.
    pub fn at_line(line: u64, column: &str, description: impl Into<String>) -> Self {
        Self { line: Some(line), column: column.into(), description: description.into() }
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

    /// The problems, in the order in which they were found, at most [`InvalidInput::MAX_LISTED`].
    pub fn problems(&self) -> &[Problem] {
        &self.problems
    }

    /// How many more there were than are listed.
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
            if let Some(line) = problem.line {
                write!(f, ", line {line}")?;
            }
            if !problem.column.is_empty() {
                write!(f, ": {}", problem.column)?;
            }
            write!(f, ": {}", problem.description)?;
        }
        if self.unlisted > 0 {
            write!(f, "\n{}: and {} more problems like these", self.file, self.unlisted)?;
        }
        Ok(())
    }
}

/// Collects problems; a file with a million wrong lines needs no million sentences.
#[derive(Debug, Default)]
pub(super) struct Problems {
    listed: Vec<Problem>,
    unlisted: usize,
}

impl Problems {
    pub(super) fn push(&mut self, problem: Problem) {
        if self.listed.len() < InvalidInput::MAX_LISTED {
            self.listed.push(problem);
        } else {
            self.unlisted += 1;
        }
    }

    /// Counts problems that someone else already left unlisted.
    pub(super) fn add_unlisted(&mut self, count: usize) {
        self.unlisted += count;
    }

    pub(super) fn into_result(self, file: &str) -> Result<(), Error> {
        if self.listed.is_empty() {
            Ok(())
        } else {
            Err(Error { file: file.into(), problems: self.listed, unlisted: self.unlisted })
        }
    }
}
