//! Reading OpenSfM's tracks.csv: one observation a line, columns separated by tabs.
//!
//! Version 0 has no header and the columns `image track feature x y r g b`; version 1 adds `scale` after `y`, version 2
//! `segmentation instance` at the end (mapillary/OpenSfM, `opensfm/src/map/src/tracks_manager.cc`). Only image, track, x
//! and y are used.

use std::collections::HashMap;
use std::io::BufRead;
use std::path::Path;

use super::frame;
use crate::domain::{ImageSize, Limits, RawInput, View};
use crate::formats::error::{Error, Problem, Problems};
use crate::formats::input::{LabelledInput, display_name};
use crate::formats::label::{Label, dense};
use crate::formats::text::{self, Lines, number, quote};

/// What a header says before the number of its version.
const HEADER: &str = "OPENSFM_TRACKS_VERSION_v";
/// Columns of the versions 0, 1 and 2.
const COLUMNS: [usize; 3] = [8, 9, 11];

/// Reads the tracks; views are image names, in ascending order.
///
/// * `size`: of every image; the file has none
///
/// # Errors
/// A file that cannot be opened, is no such table, is above `limits` or has wrong values; by line.
pub fn read(path: &Path, limits: &Limits, size: ImageSize) -> Result<LabelledInput, Error> {
    parse(text::open_table(path, limits)?, path, limits, size)
}

/// Reads the tracks from anything.
fn parse(reader: impl BufRead, path: &Path, limits: &Limits, size: ImageSize) -> Result<LabelledInput, Error> {
    let file = display_name(path);
    let one = |problem: Problem| Error::one(&file, problem);
    let mut lines = Lines::new(reader, text::MAX_TABLE_LINE_BYTES);
    let mut table = Table::new(size);
    let mut columns = COLUMNS[0];
    let mut problems = Problems::default();
    while lines.advance().map_err(one)? {
        let number = lines.number();
        let line = if number == 1 { lines.expect_text().map_err(one)? } else { lines.text().unwrap_or("\0") };
        if number == 1 && line.starts_with("OPENSFM_TRACKS") {
            columns = columns_of_version(line).map_err(|what| one(Problem::at_line(1, "", what)))?;
            continue;
        }
        if line.trim().is_empty() {
            continue;
        }
        if table.lines.len() == limits.max_observations {
            let what = format!("more observations than the limit of {}", limits.max_observations);
            return Err(one(Problem::at_line(number, "", what)));
        }
        if let Err((column, what)) = table.push(line, columns, number) {
            problems.push(Problem::at_line(number, column, what));
        }
    }
    problems.into_result(&file)?;
    if table.lines.is_empty() {
        return Err(one(Problem::of_file("has no observations")));
    }
    let labelled = table.into_labelled(path, size);
    labelled.refuse_duplicates()?;
    labelled.check(limits)?;
    Ok(labelled)
}

/// Number of columns under this header.
fn columns_of_version(header: &str) -> Result<usize, String> {
    let version = header.strip_prefix(HEADER).and_then(|version| version.trim().parse::<usize>().ok());
    version
        .and_then(|version| COLUMNS.get(version))
        .copied()
        .ok_or_else(|| format!("{} is not a known version of OpenSfM's tracks; {HEADER}0 to 2 are", quote(header)))
}

/// Observations as they are read, images and tracks numbered as they come.
struct Table {
    middle_px: [f64; 2],
    side_px: f64,
    images: Names,
    tracks: Names,
    view: Vec<u32>,
    track: Vec<u32>,
    x: Vec<f64>,
    y: Vec<f64>,
    lines: Vec<u64>,
}

impl Table {
    fn new(size: ImageSize) -> Self {
        let (middle_px, side_px) = frame(size);
        Self {
            middle_px,
            side_px,
            images: Names::default(),
            tracks: Names::default(),
            view: Vec::new(),
            track: Vec::new(),
            x: Vec::new(),
            y: Vec::new(),
            lines: Vec::new(),
        }
    }

    /// Takes one line; an error names the column and says what is wrong.
    fn push(&mut self, line: &str, columns: usize, number_of_line: u64) -> Result<(), (&'static str, String)> {
        if line == "\0" {
            return Err(("", "is not text; the file may be damaged".into()));
        }
        let fields: Vec<&str> = line.split('\t').collect();
        if fields.len() != columns {
            let hint = if fields.len() < columns { "; the file may be truncated" } else { "" };
            let count = fields.len();
            return Err(("", format!("{count} fields where this version has {columns}, separated by tabs{hint}")));
        }
        let x = number(fields[3].trim()).map_err(|what| ("x", what))?;
        let y = number(fields[4].trim()).map_err(|what| ("y", what))?;
        let view = self.images.id(fields[0], Label::name).map_err(|what| ("image", what))?;
        let track = self.tracks.id(fields[1], Label::parse).map_err(|what| ("track_id", what))?;
        self.view.push(view);
        self.track.push(track);
        self.x.push(x * self.side_px + self.middle_px[0]);
        self.y.push(y * self.side_px + self.middle_px[1]);
        self.lines.push(number_of_line);
        Ok(())
    }

    fn into_labelled(self, path: &Path, size: ImageSize) -> LabelledInput {
        let (view_labels, view_positions) = dense(&self.images.labels);
        let (track_labels, track_positions) = dense(&self.tracks.labels);
        let moved = |ids: &[u32], positions: &[u32]| ids.iter().map(|&id| positions[id as usize]).collect();
        LabelledInput {
            raw: RawInput {
                views: vec![View { size: Some(size), ..View::default() }; view_labels.len()],
                track_count: track_labels.len(),
                view: moved(&self.view, &view_positions),
                track: moved(&self.track, &track_positions),
                x: self.x,
                y: self.y,
                depth: Vec::new(),
            },
            view_labels,
            track_labels,
            lines: self.lines,
            path: path.into(),
            ..LabelledInput::default()
        }
    }
}

/// Numbers names in the order in which they come.
#[derive(Default)]
struct Names {
    ids: HashMap<Box<str>, u32>,
    labels: Vec<Label>,
}

impl Names {
    fn id(&mut self, name: &str, label: impl Fn(&str) -> Result<Label, String>) -> Result<u32, String> {
        if let Some(&id) = self.ids.get(name) {
            return Ok(id);
        }
        // At most one new name an observation, whose number the limits hold within 32 bits.
        let id = self.labels.len() as u32;
        self.labels.push(label(name)?);
        self.ids.insert(name.into(), id);
        Ok(id)
    }
}

#[cfg(test)]
#[path = "tracks_tests.rs"]
mod tests;
