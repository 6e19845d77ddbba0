//! Reading OpenSfM's tracks.csv: one observation a line, columns separated by tabs.
//!
//! Version 0 has no header and the columns `image track feature x y r g b`; version 1 adds `scale` after `y`, version 2
//! `segmentation instance` at the end (mapillary/OpenSfM, `opensfm/src/map/src/tracks_manager.cc`). Only image, track,
//! feature, x and y are used. x and y are relative to the image size, which the file does not hold.

use std::collections::{BTreeSet, HashMap};
use std::io::BufRead;
use std::path::Path;

use super::frame;
use super::sizes::Sizes;
use crate::domain::{ImageSize, Limits, RawInput, View};
use crate::formats::error::{Error, Problem, Problems};
use crate::formats::input::{LabelledInput, display_path};
use crate::formats::label::{Label, dense};
use crate::formats::text::{self, Lines, number, quote};

/// What a header says before the number of its version.
const HEADER: &str = "OPENSFM_TRACKS_VERSION_v";
/// Columns of the versions 0, 1 and 2.
const COLUMNS: [usize; 3] = [8, 9, 11];

/// Reads the tracks; views are image names, in ascending order.
///
/// * `path`: of the file, for sentences and for what stands beside it
/// * `size`: of the images that the data set around the file knows none of; see [`Sizes`]
///
/// # Errors
/// A file that is no such table, is above `limits` or has wrong values; an image without a size; by line.
pub fn read(
    reader: impl BufRead,
    path: &Path,
    limits: &Limits,
    size: Option<ImageSize>,
) -> Result<LabelledInput, Error> {
    let file = display_path(path);
    let one = |problem: Problem| Error::one(&file, problem);
    let mut lines = Lines::new(reader, text::MAX_TABLE_LINE_BYTES);
    let mut table = Table::new(Sizes::beside(path), size);
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
            return Err(one(Problem::too_many_observations(number, limits.max_observations)));
        }
        if let Err((column, what)) = table.push(line, columns, number) {
            problems.push(Problem::at_line(number, column, what));
        }
    }
    Error::check(&file, problems)?;
    if table.lines.is_empty() {
        return Err(Error::whole(&file, "has no observations"));
    }
    let labelled = table.into_labelled(path);
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
    sizes: Sizes,
    /// Where the data set gives none.
    size: Option<ImageSize>,
    /// Of each image; `None`: no size is known, which was told when it came.
    shots: Vec<Option<Shot>>,
    images: Names,
    tracks: Names,
    view: Vec<u32>,
    track: Vec<u32>,
    /// OpenSfM's number of the feature in its image; `None`: it is no such number.
    feature: Vec<Option<u32>>,
    x: Vec<f64>,
    y: Vec<f64>,
    lines: Vec<u64>,
}

/// What is known of an image beside its points.
struct Shot {
    size: ImageSize,
    camera: Option<String>,
    /// Whether the data set gives the size.
    is_own: bool,
}

impl Table {
    fn new(sizes: Sizes, size: Option<ImageSize>) -> Self {
        Self {
            sizes,
            size,
            shots: Vec::new(),
            images: Names::default(),
            tracks: Names::default(),
            view: Vec::new(),
            track: Vec::new(),
            feature: Vec::new(),
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
        if view as usize == self.shots.len() {
            let (shot, problem) = match self.shot(fields[0]) {
                Ok(shot) => (Some(shot), Ok(())),
                Err(what) => (None, Err(("image", what))),
            };
            self.shots.push(shot);
            problem?;
        }
        let Some(Some(shot)) = self.shots.get(view as usize) else { return Ok(()) };
        let (middle_px, side_px) = frame(shot.size);
        self.view.push(view);
        self.track.push(track);
        self.feature.push(fields[2].trim().parse().ok());
        self.x.push(x * side_px + middle_px[0]);
        self.y.push(y * side_px + middle_px[1]);
        self.lines.push(number_of_line);
        Ok(())
    }

    /// What is known of an image that comes for the first time.
    fn shot(&self, image: &str) -> Result<Shot, String> {
        if let Some(exif) = self.sizes.of(image)? {
            return Ok(Shot { size: exif.size(), camera: exif.camera, is_own: true });
        }
        let size = self.size.ok_or_else(|| {
            format!("no size is known of {}: give it with --width and --height, or as exif/IMAGE.exif", quote(image))
        })?;
        Ok(Shot { size, camera: None, is_own: false })
    }

    /// The views in the order of their labels: the sizes of their images, and a group a camera that the data set names.
    fn views(&self, positions: &[u32]) -> Vec<View> {
        let shots = || self.shots.iter().zip(positions).filter_map(|(shot, at)| Some((shot.as_ref()?, *at as usize)));
        let cameras: BTreeSet<Option<&str>> = shots().map(|(shot, _)| shot.camera.as_deref()).collect();
        let cameras: Vec<Option<&str>> = cameras.into_iter().collect();
        let mut views = vec![View::default(); positions.len()];
        for (shot, position) in shots() {
            let group = cameras.partition_point(|camera| *camera < shot.camera.as_deref());
            views[position] = View { size: Some(shot.size), camera_group: group as u32, ..View::default() };
        }
        views
    }

    /// The name of each view's camera, in the order of their labels.
    fn cameras(&self, positions: &[u32]) -> Vec<Option<Box<str>>> {
        let mut cameras = vec![None; positions.len()];
        for (shot, &position) in self.shots.iter().zip(positions) {
            // A name that would break a line is none.
            let name = shot.as_ref().and_then(|shot| shot.camera.as_deref());
            cameras[position as usize] = name.filter(|name| Label::name(name).is_ok()).map(Box::from);
        }
        cameras
    }

    /// That a size that was given is not that of every image.
    fn note(&self) -> Option<String> {
        let own = self.shots.iter().flatten().filter(|shot| shot.is_own).count();
        let others = self.size.filter(|_| own > 0)?;
        let (width, height) = (others.width_px, others.height_px);
        let count = self.shots.len();
        if own == count {
            return Some(format!("all image sizes were read from exif/; {width} x {height} px was not used"));
        }
        Some(format!("{own} of {count} image sizes were read from exif/; {width} x {height} px is that of the others"))
    }

    fn into_labelled(self, path: &Path) -> LabelledInput {
        let (view_labels, view_positions) = dense(&self.images.labels);
        let (track_labels, track_positions) = dense(&self.tracks.labels);
        let views = self.views(&view_positions);
        let cameras = self.cameras(&view_positions);
        let notes = self.note().into_iter().collect();
        let moved = |ids: &[u32], positions: &[u32]| ids.iter().map(|&id| positions[id as usize]).collect();
        LabelledInput {
            raw: RawInput {
                views,
                track_count: track_labels.len(),
                view: moved(&self.view, &view_positions),
                track: moved(&self.track, &track_positions),
                x: self.x,
                y: self.y,
                depth: Vec::new(),
                sigma: Vec::new(),
            },
            view_labels,
            track_labels,
            opensfm_cameras: cameras,
            lines: self.lines,
            // One that is no index is none of OpenSfM's, and then the others say nothing either.
            keypoints: self.feature.into_iter().collect::<Option<_>>().unwrap_or_default(),
            notes,
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
