//! The result files of a solve: what each holds.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use super::cameras_json::CamerasJson;
use super::export::NotExported;
use super::publish::{Draft, pretty};
use super::result_json::{ResultJson, track_label, view_label};
use super::second_structures::SecondStructuresJson;
use super::{Export, LabelledInput, export, manifest, ply};
use crate::domain::{Solution, Status};
use crate::report;

/// Names of the files, in the order in which they are written; `result.json` comes last, so that whoever waits for it
/// finds the others.
pub const TRACKS: &str = "tracks.csv";
pub const OBSERVATIONS: &str = "observations.csv";
pub const CAMERAS: &str = "cameras.json";
pub const POINTS: &str = "points.ply";
pub const TWO_VIEW_POINTS: &str = "points-two-view.ply";
pub const SECOND_STRUCTURES: &str = "second-structures.json";
pub const REPORT: &str = "report.html";
pub const RESULT: &str = "result.json";

/// `result.json` as text; without the input, warnings name views by their numbers.
///
/// # Errors
/// None is expected: every field is serialisable.
pub fn result_json(solution: &Solution, input: Option<&LabelledInput>) -> io::Result<String> {
    pretty(&ResultJson::new(solution, input))
}

/// Writes the result files, and what is asked for other programs, into `directory`, which is created. Without the
/// input, indices stand for labels, there is no `observations.csv`, the report has no picture of the tracks, and
/// nothing is written for other programs. What a former run left there and this one does not make goes: see
/// [`manifest`].
///
/// Returns what was not written for other programs though it was asked for; that is no failure.
///
/// # Errors
/// The first file that cannot be written, named; until every file is on the disk the former ones stand.
pub fn write(
    directory: &Path,
    solution: &Solution,
    input: Option<&LabelledInput>,
    exports: &[Export],
) -> io::Result<Option<NotExported>> {
    let mut draft = Draft::new(directory, input.map(|input| input.path.as_path()))?;
    draft.add(TRACKS, tracks_csv(solution, input).as_bytes())?;
    if let Some(input) = input {
        draft.add(OBSERVATIONS, observations_csv(solution, input).as_bytes())?;
    }
    draft.add(CAMERAS, pretty(&CamerasJson::new(solution, input))?.as_bytes())?;
    // A file a part: parts have frames of their own, which no program could tell apart in one file.
    for part in 0..solution.part_count().max(1) {
        draft.add(points_of(part), ply::points(solution, input, part).as_bytes())?;
    }
    if let Some(points) = ply::two_view_points(solution, input) {
        draft.add(TWO_VIEW_POINTS, points.as_bytes())?;
    }
    if !solution.second_structures.is_empty() {
        draft.add(SECOND_STRUCTURES, pretty(&SecondStructuresJson::new(solution, input))?.as_bytes())?;
    }
    draft.add(REPORT, report::page(solution, input).as_bytes())?;
    let refused = match input {
        Some(input) => export::add(&mut draft, exports, solution, input)?,
        None => None,
    };
    draft.publish(RESULT, result_json(solution, input)?.as_bytes())?;
    Ok(refused)
}

/// What of an input, a file or the directory of a model, a result in `directory` would replace.
pub fn replaced(directory: &Path, exports: &[Export], input: &Path) -> Option<PathBuf> {
    let input = input.canonicalize().ok()?;
    let names =
        [TRACKS, OBSERVATIONS, CAMERAS, POINTS, TWO_VIEW_POINTS, SECOND_STRUCTURES, REPORT, RESULT, manifest::NAME]
            .map(PathBuf::from);
    let folders = exports.iter().flat_map(|export| {
        let folder = PathBuf::from(export.folder());
        let files: Vec<PathBuf> = export.inputs().iter().map(|file| folder.join(file)).collect();
        files.into_iter().chain([folder])
    });
    names.into_iter().chain(folders).map(|name| directory.join(name)).find(|place| {
        let here = place.canonicalize();
        here.is_ok_and(|here| here == input)
    })
}

/// Name of the file of a part's points: `points.ply` for the largest, `points-part-1.ply` for part 1 of `cameras.json`
/// and `tracks.csv`.
pub fn points_of(part: u32) -> String {
    if part == 0 { POINTS.into() } else { format!("points-part-{part}.ply") }
}

/// Where the files are, in words.
pub fn said(directory: &Path, solution: &Solution) -> String {
    let others = match solution.part_count() {
        0 | 1 => return directory.display().to_string(),
        2 => points_of(1),
        several => format!("{} to {}", points_of(1), points_of(several - 1)),
    };
    format!("{}; {POINTS} holds the points of part 0, {others} those of the others", directory.display())
}

/// `track,weight,inlier`, `network_weight` where a network ran, the `part` that the track has a point in, empty where
/// it has none, `second_structure` where one was found, and `two_view` where tracks that two views see are consistent;
/// one line a track.
fn tracks_csv(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let tracks = &solution.tracks;
    let (has_network, has_second) = (!tracks.network_weight.is_empty(), !tracks.second_structure.is_empty());
    let mut text = String::from("track,weight,inlier");
    text.push_str(if has_network { ",network_weight,part" } else { ",part" });
    text.push_str(if has_second { ",second_structure" } else { "" });
    let two_view: BTreeSet<usize> = solution.two_view_tracks.iter().map(|found| found.track as usize).collect();
    text.push_str(if two_view.is_empty() { "\n" } else { ",two_view\n" });
    for (track, (weight, &inlier)) in tracks.weight.iter().zip(&tracks.inlier).enumerate() {
        text.push_str(&format!("{},{weight},{}", track_label(input, track).csv(), u8::from(inlier)));
        if has_network {
            text.push_str(&format!(",{}", tracks.network_weight.get(track).copied().unwrap_or(0.0)));
        }
        let part = tracks.part_of(track).map_or_else(String::new, |part| part.to_string());
        text.push_str(&format!(",{part}"));
        if has_second {
            text.push_str(&format!(",{}", tracks.second_structure.get(track).copied().unwrap_or(0)));
        }
        if !two_view.is_empty() {
            text.push_str(&format!(",{}", u8::from(two_view.contains(&track))));
        }
        text.push('\n');
    }
    text
}

/// `view,track,inlier,residual_px,weight,split,x_px,y_px,keypoint` in the order of the caller's file; an observation
/// that was not judged has an empty residual, one that shows no other point of its track an empty split, one of a file
/// that has no keypoints (features) an empty keypoint. Pixels are the input's, (0, 0) the centre of the top-left one.
///
/// Where nothing was reconstructed there is no point that an observation could show: its weight is that of its track.
fn observations_csv(solution: &Solution, input: &LabelledInput) -> String {
    let judged = &solution.observations;
    let mut text = String::from("view,track,inlier,residual_px,weight,split,x_px,y_px,keypoint\n");
    for (k, (&view, &track)) in input.raw.view.iter().zip(&input.raw.track).enumerate() {
        let inlier = judged.inlier.get(k).copied().unwrap_or(false);
        let residual = judged.residual_px.get(k).copied().flatten();
        let split = judged.split.get(k).copied().unwrap_or(0);
        let weight = match solution.status {
            Status::Solved => judged.weight.get(k),
            Status::NoReconstruction => solution.tracks.weight.get(track as usize),
        };
        let keypoint = input.keypoints.get(k);
        text.push_str(&format!(
            "{},{},{},{},{},{},{},{},{}\n",
            view_label(solution, Some(input), view as usize).csv(),
            track_label(Some(input), track as usize).csv(),
            u8::from(inlier),
            residual.map_or_else(String::new, |px| px.to_string()),
            weight.copied().unwrap_or(0.0),
            if split > 0 { split.to_string() } else { String::new() },
            input.raw.x[k],
            input.raw.y[k],
            keypoint.map_or_else(String::new, u32::to_string),
        ));
    }
    text
}

#[cfg(test)]
#[path = "result_files_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "result_replacement_tests.rs"]
mod replacement_tests;
