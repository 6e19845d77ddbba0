//! An input with the names that its file gives to views and tracks, and the line of every observation.

use std::path::{Path, PathBuf};

use super::colmap::{ColmapImage, FIRST_PIXEL};
use super::error::{Error, Place, Problem, Problems};
use super::label::Label;
use super::source::{Format, STANDARD_INPUT};
use crate::domain::{Input, InvalidInput, Limits, PairMatches, RawInput, RawMatches, Violation};

/// What a file says: dense indices for the solver, the file's own ids for the answers.
#[derive(Debug, Clone, Default)]
pub struct LabelledInput {
    pub raw: RawInput,
    /// The file's id of each view, ascending.
    pub view_labels: Vec<Label>,
    /// The file's id of each track, ascending.
    pub track_labels: Vec<Label>,
    /// Line of each observation, counted from 1; empty where the file has no lines.
    pub lines: Vec<u64>,
    /// What COLMAP's files say of each view's image, kept for what is exported to COLMAP; empty for other files.
    pub colmap_images: Vec<ColmapImage>,
    /// OpenSfM's name of each view's camera, where its data set has one; empty for other files.
    pub opensfm_cameras: Vec<Option<Box<str>>>,
    /// Index of each observation's keypoint in its image; empty where the file has no such indices.
    pub keypoints: Vec<u32>,
    /// The matches that the tracks were joined from, where they were; keypoints are those of `colmap_images`.
    pub matches: Option<PairMatches>,
    /// What reading changed or left out, a sentence each.
    pub notes: Vec<String>,
    pub path: PathBuf,
    /// Kind of the file; `None`: none was read.
    pub format: Option<Format>,
}

impl LabelledInput {
    /// The input that a program made rather than read: indices stand as labels, observation `k` on line `k + 2`.
    pub fn unlabelled(raw: RawInput, path: &Path) -> Self {
        Self {
            view_labels: (0..raw.views.len() as u64).map(Label::Number).collect(),
            track_labels: (0..raw.track_count as u64).map(Label::Number).collect(),
            lines: (0..raw.x.len() as u64).map(|k| k + 2).collect(),
            path: path.into(),
            raw,
            ..Self::default()
        }
    }

    /// Has the names of images travel with the input, where the file has names for them.
    pub(super) fn name_views(&mut self) {
        for (view, label) in self.raw.views.iter_mut().zip(&self.view_labels) {
            if let Label::Name(name) = label {
                view.name = Some(name.clone());
            }
        }
    }

    /// The keypoints and the matches that the tracks were joined from, where they were.
    pub fn raw_matches(&self) -> Option<RawMatches> {
        let pairs = self.matches.clone()?;
        let points = || self.colmap_images.iter().flat_map(|image| &image.keypoints);
        Some(RawMatches {
            views: self.raw.views.clone(),
            keypoint_counts: self.colmap_images.iter().map(|image| image.keypoints.len() as u32).collect(),
            x: points().map(|&[x, _]| f64::from(x) - FIRST_PIXEL).collect(),
            y: points().map(|&[_, y]| f64::from(y) - FIRST_PIXEL).collect(),
            pairs,
        })
    }

    /// The file as sentences about it begin.
    pub fn display_path(&self) -> String {
        display_path(&self.path)
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
        match Error::check(&self.display_path(), problems) {
            Err(error) => error,
            Ok(()) => Error::whole(&self.display_path(), "was refused without a reason"),
        }
    }

    /// A violation's field is a path of the API, such as `track_set.xs`; its last part names the file's column.
    fn problem(&self, violation: &Violation) -> Problem {
        if violation.field.starts_with("match_set.") && !violation.field.ends_with(".views") {
            // Of keypoints and matches, which no column of a file has.
            return Problem {
                place: Place::File,
                column: violation.path(),
                description: violation.description.clone(),
            };
        }
        let column = match violation.field.rsplit('.').next().unwrap_or_default() {
            "view_indices" => "view",
            "track_indices" => "track",
            "xs" => "x",
            "ys" => "y",
            "depths" => "depth",
            "sigmas_px" => "sigma",
            other => other,
        };
        let place = violation.index.and_then(|index| match column {
            "view" | "track" | "x" | "y" | "depth" | "sigma" => self.place(index, column),
            "views" => self.view_labels.get(index).map(|label| (Place::File, format!("view {label}"))),
            _ => None,
        });
        let (place, column) = place.unwrap_or_else(|| match violation.index {
            Some(_) => (Place::File, violation.path()),
            // The file has no column of these names: the sentence alone says it best.
            None if matches!(column, "x" | "views" | "track_count") => (Place::File, String::new()),
            None => (Place::File, column.into()),
        });
        Problem { place, column, description: violation.description.clone() }
    }

    /// Where an observation stands: its line, or its view and track where the file has no lines.
    fn place(&self, observation: usize, column: &str) -> Option<(Place, String)> {
        if !self.lines.is_empty() {
            return self.lines.get(observation).map(|&line| (Place::Line(line), column.into()));
        }
        let label = |labels: &[Label], indices: &[u32]| {
            let index = *indices.get(observation)? as usize;
            labels.get(index).cloned()
        };
        let view = label(&self.view_labels, &self.raw.view)?;
        let track = label(&self.track_labels, &self.raw.track)?;
        Some((Place::File, format!("view {view}, track {track}: {column}")))
    }

    /// Refuses a second observation of a track in a view. The domain does too, but by index; here both lines can be
    /// named.
    pub(super) fn refuse_duplicates(&self) -> Result<(), Error> {
        let (view, track) = (&self.raw.view, &self.raw.track);
        let mut order: Vec<usize> = (0..self.lines.len()).collect();
        order.sort_unstable_by_key(|&k| (track[k], view[k], k));
        let mut duplicates: Vec<(usize, usize)> = order
            .windows(2)
            .map(|pair| (pair[1], pair[0]))
            .filter(|&(later, first)| (track[later], view[later]) == (track[first], view[first]))
            .collect();
        duplicates.sort_unstable();
        let mut problems = Problems::default();
        for (later, first) in duplicates {
            let what = format!(
                "track {} is observed a second time in view {} (first on line {})",
                self.track_labels[track[later] as usize], self.view_labels[view[later] as usize], self.lines[first]
            );
            problems.push(Problem::at_line(self.lines[later], "track", what));
        }
        Error::check(&self.display_path(), problems)
    }
}

/// Name of a file in sentences: as the caller gave it, so that of several files it tells the one.
pub(super) fn display_path(path: &Path) -> String {
    if path == Path::new(STANDARD_INPUT) { "standard input".into() } else { path.display().to_string() }
}
