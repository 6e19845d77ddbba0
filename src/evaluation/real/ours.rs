//! This program's side: `solve` in a process of its own, and the files that it writes.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::Sequence;
use super::measures::{Answer, Verdicts};
use crate::domain::counted;
use crate::formats::json;
use crate::formats::result_files::{CAMERAS, OBSERVATIONS, RESULT};

/// The solve of a sequence; its files go to [`files`] of `scratch`.
pub fn command(program: &Path, sequence: &Sequence, scratch: &Path) -> Command {
    let mut command = Command::new(program);
    let observations = sequence.observations_file();
    let (width, height) = (sequence.size.width_px.to_string(), sequence.size.height_px.to_string());
    command.args([OsStr::new("solve"), observations.as_os_str(), OsStr::new("--width"), OsStr::new(&width)]);
    command.args(["--height", &height, "--json", "--quiet", "--out"]).arg(files(scratch));
    command
}

/// Where the solve writes.
pub fn files(scratch: &Path) -> PathBuf {
    scratch.join("answer")
}

/// What is used of `result.json`.
#[derive(Deserialize)]
struct ResultFile {
    grade: Option<String>,
    status: String,
    #[serde(default, deserialize_with = "json::positive")]
    focal_px: Option<f64>,
    #[serde(default, deserialize_with = "json::not_negative")]
    sigma_log_focal: Option<f64>,
    radial_k1: Option<f64>,
    registered_views: usize,
    #[serde(default, deserialize_with = "json::not_negative")]
    reprojection_mean_px: Option<f64>,
    #[serde(default, deserialize_with = "json::not_negative")]
    reprojection_rms_px: Option<f64>,
    warnings: Vec<WarningEntry>,
}

#[derive(Deserialize)]
struct WarningEntry {
    code: String,
}

/// What is used of `cameras.json`.
#[derive(Deserialize)]
struct CamerasFile {
    views: Vec<CameraEntry>,
}

#[derive(Deserialize)]
#[allow(non_snake_case, reason = "the file's names for these matrices")]
struct CameraEntry {
    view: u64,
    part: Option<u32>,
    R: Option<[[f64; 3]; 3]>,
    t: Option<[f64; 3]>,
}

/// Reads the files of a solve that ended with `status`. That there is no reconstruction is an answer too.
///
/// # Errors
/// Why there is no answer, in a sentence.
pub fn answer(sequence: &Sequence, scratch: &Path, status: ExitStatus, complaint: &str) -> Result<Answer, String> {
    let directory = files(scratch);
    if !directory.join(RESULT).is_file() {
        return Err(format!("ended with {status}: {complaint}"));
    }
    let result: ResultFile = read(&directory.join(RESULT))?;
    let cameras: CamerasFile = read(&directory.join(CAMERAS))?;
    let inlier = verdicts(&directory.join(OBSERVATIONS))?;
    if inlier.len() != sequence.inlier.len() {
        return Err(format!(
            "{OBSERVATIONS} has {} for {}",
            counted(inlier.len(), "verdict"),
            counted(sequence.inlier.len(), "observation")
        ));
    }
    Ok(Answer {
        registered: result.registered_views,
        parts: cameras.views.iter().filter_map(|camera| camera.part).collect::<BTreeSet<_>>().len(),
        grade: Some(result.grade.unwrap_or(result.status)),
        focal_px: result.focal_px,
        sigma_log_focal: result.sigma_log_focal,
        radial_k1: result.radial_k1,
        inlier,
        verdicts: Verdicts::Observations,
        mean_px: result.reprojection_mean_px,
        rms_px: result.reprojection_rms_px,
        centres: largest_part(&cameras.views),
        warnings: result.warnings.into_iter().map(|warning| warning.code).collect(),
    })
}

fn read<T: DeserializeOwned>(file: &Path) -> Result<T, String> {
    let text = fs::read(file).map_err(|error| format!("cannot read {}: {error}", file.display()))?;
    json::read(&text).map_err(|error| format!("cannot read {}: {error}", file.display()))
}

/// The column `inlier` of a solve's `observations.csv`, whose lines are in the order of its input.
fn verdicts(file: &Path) -> Result<Vec<bool>, String> {
    let text = fs::read_to_string(file).map_err(|error| format!("cannot read {}: {error}", file.display()))?;
    let mut lines = text.lines();
    let column = lines.next().and_then(|header| header.split(',').position(|name| name == "inlier"));
    let column = column.ok_or_else(|| format!("{} has no column `inlier`", file.display()))?;
    Ok(lines.map(|line| line.split(',').nth(column) == Some("1")).collect())
}

/// Centres of the part with the most metric cameras (the first of several); the other parts have frames of their own.
fn largest_part(cameras: &[CameraEntry]) -> BTreeMap<u64, Vector3<f64>> {
    let mut parts: BTreeMap<u32, BTreeMap<u64, Vector3<f64>>> = BTreeMap::new();
    for camera in cameras {
        if let (Some(part), Some(rotation), Some(translation)) = (camera.part, camera.R, camera.t) {
            let rotation = Matrix3::from_fn(|row, column| rotation[row][column]);
            let centre = -rotation.transpose() * Vector3::from(translation);
            parts.entry(part).or_default().insert(camera.view, centre);
        }
    }
    // Of equals, the last one compared is the largest.
    parts.into_values().rev().max_by_key(BTreeMap::len).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_largest_part_has_one_frame() {
        let entry = |view, part, t: Option<[f64; 3]>| CameraEntry {
            view,
            part,
            R: t.map(|_| [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
            t,
        };
        let cameras = [
            entry(0, Some(0), Some([1.0, 0.0, 0.0])),
            entry(1, Some(1), Some([2.0, 0.0, 0.0])),
            entry(2, Some(1), Some([3.0, 0.0, 0.0])),
            entry(3, None, None),
        ];
        let centres = largest_part(&cameras);
        assert_eq!(centres.keys().copied().collect::<Vec<_>>(), [1, 2]);
        assert_eq!(centres[&2], Vector3::new(-3.0, 0.0, 0.0));
        // Of two that are equal, the first.
        assert_eq!(largest_part(&cameras[..2]).keys().copied().collect::<Vec<_>>(), [0]);
    }
}
