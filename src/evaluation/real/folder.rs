//! Reading the folder of a sequence: its tracks, its image size and calibration, which observations are right, and
//! where the cameras were.
//!
//! * `observations.csv`: `view,track,x,y`, whole numbers from 0 as ids, pixels
//! * `meta.json`: `width` and `height` (or `image_width` and `image_height`, or `image_size`: `[width, height]`) and
//!   `K`, the calibration in pixels: 3×3, or a list of such, one a view
//! * `labels.csv`: a header with `view`, `track` and `inlier` (0 or 1) in any order, one line an observation
//! * `cameras.json`, if there is one: `P`, a 3×4 matrix or null for each view, and `estimated`, true where they were
//!   found from these tracks rather than measured

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3x4, Vector3};
use serde_json::Value;

use super::Error;
use crate::domain::error::quoted;
use crate::domain::{ImageSize, Limits, counted};
use crate::formats::{self, LabelledInput, Reading};

pub const OBSERVATIONS: &str = "observations.csv";
pub const META: &str = "meta.json";
pub const LABELS: &str = "labels.csv";
pub const CAMERAS: &str = "cameras.json";

/// Focal lengths of a list of `K` that differ by no more than this are one: calibrations are given to about that.
const SAME_FOCAL: f64 = 1e-3;
/// A camera centre is at infinity where the determinant of P's left half is below this share of what its rows allow.
const SINGULAR: f64 = 1e-12;

/// A sequence with what is known of it.
#[derive(Debug, Clone)]
pub struct Sequence {
    pub name: String,
    pub directory: PathBuf,
    pub input: LabelledInput,
    pub size: ImageSize,
    /// Horizontal focal length; `None` where the views have different ones.
    pub focal_px: Option<f64>,
    /// Whether an observation is right, in the order of `observations.csv`.
    pub inlier: Vec<bool>,
    /// Centre of each view's camera, by the view's id; `None`: no centre is known.
    pub centres: Vec<Option<Vector3<f64>>>,
    /// Whether the cameras were found from these tracks.
    pub cameras_estimated: bool,
}

impl Sequence {
    pub fn views(&self) -> usize {
        self.input.raw.views.len()
    }

    pub fn observations_file(&self) -> PathBuf {
        self.directory.join(OBSERVATIONS)
    }

    /// The ids of view and track of observation `k`.
    pub fn ids(&self, k: usize) -> (u64, u64) {
        let id = |labels: &[formats::Label], index: u32| {
            labels.get(index as usize).and_then(formats::Label::number).unwrap_or(u64::from(index))
        };
        let raw = &self.input.raw;
        (id(&self.input.view_labels, raw.view[k]), id(&self.input.track_labels, raw.track[k]))
    }

    /// Reads a folder.
    ///
    /// # Errors
    /// The file, and the field or line in it, that is missing or wrong.
    pub fn read(directory: &Path) -> Result<Self, Error> {
        let (size, focal_px) = meta(&directory.join(META))?;
        let file = directory.join(OBSERVATIONS);
        let reading = Reading { size: Some(size), ..Reading::default() };
        let input = formats::read(&file, &Limits::default(), &reading)
            .map_err(|error| Error::Observations { directory: directory.into(), what: error.to_string() })?;
        let name = fs::canonicalize(directory)
            .ok()
            .and_then(|path| path.file_name().map(|name| name.to_string_lossy().into_owned()))
            .unwrap_or_else(|| directory.display().to_string());
        let (centres, cameras_estimated) = cameras(&directory.join(CAMERAS))?;
        let mut sequence = Self {
            name,
            directory: directory.into(),
            size,
            focal_px,
            inlier: Vec::new(),
            centres,
            cameras_estimated,
            input,
        };
        sequence.inlier = sequence.labels(&directory.join(LABELS))?;
        sequence.check_cameras()?;
        Ok(sequence)
    }

    /// What `labels.csv` says of each observation.
    fn labels(&self, file: &Path) -> Result<Vec<bool>, Error> {
        let said = labels(file)?;
        let label = |k: usize| {
            let (view, track) = self.ids(k);
            said.get(&(view, track)).copied().ok_or_else(|| {
                Error::file(file, format_args!("says nothing of view {view}, track {track}, which {OBSERVATIONS} has"))
            })
        };
        (0..self.input.raw.x.len()).map(label).collect()
    }

    fn check_cameras(&self) -> Result<(), Error> {
        let last = self.input.view_labels.last().and_then(formats::Label::number).unwrap_or(0);
        if self.centres.is_empty() || (self.centres.len() as u64) > last {
            return Ok(());
        }
        let entries = counted(self.centres.len(), "entry");
        let what = format!("has {entries}, but {OBSERVATIONS} has a view {last}: one a view is needed");
        Err(Error::place(&self.directory.join(CAMERAS), "`P`", what))
    }
}

/// The sequence folders that these folders are or hold, each once, in the order given and by name.
///
/// # Errors
/// A folder that is none and holds none.
pub fn find(directories: &[PathBuf]) -> Result<Vec<PathBuf>, Error> {
    let is_sequence = |directory: &Path| directory.join(OBSERVATIONS).is_file();
    let mut found: Vec<PathBuf> = Vec::new();
    for directory in directories {
        let mut here = vec![directory.clone()];
        if !is_sequence(directory) {
            let entries = fs::read_dir(directory)
                .map_err(|error| Error::file(directory, format_args!("cannot be read: {error}")))?;
            here = entries.flatten().map(|entry| entry.path()).filter(|path| is_sequence(path)).collect();
            here.sort();
            if here.is_empty() {
                return Err(Error::file(directory, format_args!("has no {OBSERVATIONS}, nor has a folder in it")));
            }
        }
        here.retain(|path| !found.contains(path));
        found.append(&mut here);
    }
    Ok(found)
}

fn json(file: &Path) -> Result<Value, Error> {
    let text = fs::read_to_string(file).map_err(|error| Error::file(file, format_args!("cannot be read: {error}")))?;
    serde_json::from_str(&text).map_err(|error| Error::file(file, format_args!("is not JSON: {error}")))
}

/// The image size and the focal length.
fn meta(file: &Path) -> Result<(ImageSize, Option<f64>), Error> {
    let meta = json(file)?;
    let sides = 1..=ImageSize::MAX_SIDE_PX;
    let side = |value: &Value| value.as_u64().and_then(|px| u32::try_from(px).ok()).filter(|px| sides.contains(px));
    let wanted = format!("must be a whole number of pixels, 1 to {}", ImageSize::MAX_SIDE_PX);
    let given = |place: String, value: &Value| side(value).ok_or_else(|| Error::place(file, place, wanted.as_str()));
    let named = [("width", "height"), ("image_width", "image_height")];
    let size = if let Some((width, height)) = named.into_iter().find(|(width, _)| meta.get(width).is_some()) {
        (given(format!("`{width}`"), &meta[width])?, given(format!("`{height}`"), &meta[height])?)
    } else if let Some(size) = meta.get("image_size") {
        let wanted = || Error::place(file, "`image_size`", "must be [width, height] in pixels");
        let [width, height] = size.as_array().map(Vec::as_slice).ok_or_else(wanted)? else { return Err(wanted()) };
        (side(width).ok_or_else(wanted)?, side(height).ok_or_else(wanted)?)
    } else {
        return Err(Error::place(file, "`width`", "is missing: the image size in pixels, with `height`, is needed"));
    };
    Ok((ImageSize { width_px: size.0, height_px: size.1 }, focal(file, meta.get("K"))?))
}

/// The focal length of one K or of a list; `None` where those of a list differ.
fn focal(file: &Path, given: Option<&Value>) -> Result<Option<f64>, Error> {
    let given =
        given.ok_or_else(|| Error::place(file, "`K`", "is missing: a 3x3 matrix in pixels, or a list of such"))?;
    let one = |value: &Value, place: String| {
        let rows = matrix::<3>(value).filter(|rows| rows[0][0] > 0.0 && rows[1][1] > 0.0);
        rows.map(|rows| rows[0][0])
            .ok_or_else(|| Error::place(file, place, "must be a 3x3 matrix with focal lengths above 0, row by row"))
    };
    let is_list = given.get(0).and_then(|entry| entry.get(0)).is_some_and(Value::is_array);
    if !is_list {
        return one(given, "`K`".into()).map(Some);
    }
    let entries = given.as_array().map_or(&[][..], Vec::as_slice);
    let focals: Vec<f64> =
        entries.iter().enumerate().map(|(k, value)| one(value, format!("`K[{k}]`"))).collect::<Result<_, _>>()?;
    let (least, most) = focals.iter().fold((f64::MAX, 0.0_f64), |(least, most), &f| (least.min(f), most.max(f)));
    Ok((most <= (1.0 + SAME_FOCAL) * least).then(|| focals.iter().sum::<f64>() / focals.len() as f64))
}

/// Three rows of `N` finite numbers.
fn matrix<const N: usize>(value: &Value) -> Option<[[f64; N]; 3]> {
    let rows: Vec<Vec<f64>> = serde_json::from_value(value.clone()).ok()?;
    let rows: Vec<[f64; N]> = rows.into_iter().map(|row| row.try_into().ok()).collect::<Option<_>>()?;
    rows.try_into().ok().filter(|rows: &[[f64; N]; 3]| rows.iter().flatten().all(|entry| entry.is_finite()))
}

/// What is said of each view and track.
fn labels(file: &Path) -> Result<HashMap<(u64, u64), bool>, Error> {
    let text = fs::read_to_string(file).map_err(|error| Error::file(file, format_args!("cannot be read: {error}")))?;
    let mut lines = text.trim_start_matches('\u{feff}').lines().zip(1u64..).filter(|(line, _)| !line.trim().is_empty());
    let (header, number) =
        lines.next().ok_or_else(|| Error::file(file, "is empty; a header `view,track,inlier` is needed"))?;
    let names: Vec<&str> = header.split(',').map(str::trim).collect();
    let column = |wanted: &str| {
        names.iter().position(|&name| name == wanted).ok_or_else(|| {
            Error::place(file, format!("line {number}"), format_args!("the header has no column `{wanted}`"))
        })
    };
    let (view, track, inlier) = (column("view")?, column("track")?, column("inlier")?);
    let mut said = HashMap::new();
    for (line, number) in lines {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let at = |column: &str| format!("line {number}, `{column}`");
        let field = |column: usize| fields.get(column).copied().unwrap_or_default();
        let id = |column: usize, name: &str| {
            let text = field(column);
            text.parse::<u64>()
                .map_err(|_| Error::place(file, at(name), format_args!("{} is not a whole number", quoted(text))))
        };
        let verdict = match field(inlier).to_ascii_lowercase().as_str() {
            "1" | "true" => true,
            "0" | "false" => false,
            other => {
                return Err(Error::place(file, at("inlier"), format_args!("{} is neither 0 nor 1", quoted(other))));
            }
        };
        let ids = (id(view, "view")?, id(track, "track")?);
        if said.insert(ids, verdict).is_some() {
            let what = format!("view {}, track {} are there twice", ids.0, ids.1);
            return Err(Error::place(file, format!("line {number}"), what));
        }
    }
    Ok(said)
}

/// Centre of each view's camera, where the file has one.
type Centres = Vec<Option<Vector3<f64>>>;

/// Camera centres, and whether they were estimated from the tracks; none where there is no such file.
fn cameras(file: &Path) -> Result<(Centres, bool), Error> {
    if !file.exists() {
        return Ok((Vec::new(), false));
    }
    let cameras = json(file)?;
    let entries = cameras["P"].as_array().ok_or_else(|| {
        Error::place(file, "`P`", "must be a list of 3x4 matrices, one a view, null where none is known")
    })?;
    let centre = |(view, value): (usize, &Value)| {
        if value.is_null() {
            return Ok(None);
        }
        let found = matrix::<4>(value).and_then(|rows| centre(&Matrix3x4::from_fn(|row, column| rows[row][column])));
        found.map(Some).ok_or_else(|| {
            Error::place(
                file,
                format!("`P[{view}]`"),
                "must be a 3x4 matrix of a camera that is not at infinity, or null",
            )
        })
    };
    let centres = entries.iter().enumerate().map(centre).collect::<Result<_, _>>()?;
    Ok((centres, cameras["estimated"].as_bool().unwrap_or(false)))
}

/// Where a camera `[M|p]` is: `-M⁻¹ p` (Hartley & Zisserman 2004, 6.2.4); `None` at infinity.
fn centre(camera: &Matrix3x4<f64>) -> Option<Vector3<f64>> {
    let left = camera.fixed_view::<3, 3>(0, 0).into_owned();
    let most: f64 = left.row_iter().map(|row| row.norm()).product();
    (left.determinant().abs() > SINGULAR * most).then_some(())?;
    let centre = -(left.try_inverse()? * camera.column(3));
    centre.iter().all(|entry| entry.is_finite()).then_some(centre)
}
