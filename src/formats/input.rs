//! An input with the names that its file gives to views and tracks, and the line of every observation.

use std::path::{Path, PathBuf};

use super::error::{Error, Problem, Problems};
use crate::domain::{Input, InvalidInput, Limits, RawInput, Violation};

/// What a file says: dense indices for the solver, the file's own ids for the answers.
#[derive(Debug, Clone, Default)]
pub struct LabelledInput {
    pub raw: RawInput,
    /// The file's id of each view, ascending.
    pub view_labels: Vec<u64>,
    /// The file's id of each track, ascending.
    pub track_labels: Vec<u64>,
    /// Line of each observation, counted from 1.
    pub lines: Vec<u64>,
    pub path: PathBuf,
}

impl LabelledInput {
    /// The input that a program made rather than read: indices stand as labels, observation `k` on line `k + 2`.
    pub fn unlabelled(raw: RawInput, path: &Path) -> Self {
        Self {
            view_labels: (0..raw.views.len() as u64).collect(),
            track_labels: (0..raw.track_count as u64).collect(),
            lines: (0..raw.x.len() as u64).map(|k| k + 2).collect(),
            path: path.into(),
            raw,
        }
    }

    /// The file's name as sentences about it begin.
    pub fn file_name(&self) -> String {
        display_name(&self.path)
    }

    /// Checks the input.
    ///
    /// # Errors
    /// Every violation, by line of the file where it has one.
    pub fn check(&self, limits: &Limits) -> Result<Input, Error> {
        Input::new(self.raw.clone(), limits, "input").map_err(|invalid| self.explain(&invalid))
    }

    /// Violations of this input (found here or by a server), in terms of the file.
    pub fn explain(&self, invalid: &InvalidInput) -> Error {
        self.explain_all(invalid.violations(), invalid.unlisted())
    }

    /// The same for violations that arrived one by one.
    pub fn explain_all(&self, violations: &[Violation], unlisted: usize) -> Error {
        let mut problems = Problems::default();
        for violation in violations {
            problems.push(self.problem(violation));
        }
        problems.add_unlisted(unlisted);
        match problems.into_result(&self.file_name()) {
            Err(error) => error,
            Ok(()) => Error::one(&self.file_name(), Problem::of_file("was refused without a reason")),
        }
    }

    /// A violation's field is a path of the API (`track_set.x`); its last part is the file's column.
    fn problem(&self, violation: &Violation) -> Problem {
        let column = violation.field.rsplit('.').next().unwrap_or_default();
        let place = violation.index.and_then(|index| match column {
            "view" | "track" | "x" | "y" | "depth" => self.lines.get(index).map(|&line| (Some(line), column.into())),
            "views" => self.view_labels.get(index).map(|label| (None, format!("view {label}"))),
            _ => None,
        });
        let (line, column) = place.unwrap_or_else(|| match violation.index {
            Some(_) => (None, violation.path()),
            // The file has no column of these names: the sentence alone says it best.
            None if matches!(column, "x" | "views" | "track_count") => (None, String::new()),
            None => (None, column.into()),
        });
        Problem { line, column, description: violation.description.clone() }
    }
}

/// Name of a file in sentences: its last component, or the whole path where it has none.
pub(super) fn display_name(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
}
