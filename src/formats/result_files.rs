//! Writing the result files into a directory: each appears whole or not at all.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::LabelledInput;
use super::cameras_json::CamerasJson;
use super::ply;
use super::result_json::{ResultJson, track_label, view_label};
use crate::domain::Solution;
use crate::report;

/// Names of the files, in the order in which they are written; `result.json` comes last, so that whoever waits for it
/// finds the others.
pub const TRACKS: &str = "tracks.csv";
pub const OBSERVATIONS: &str = "observations.csv";
pub const CAMERAS: &str = "cameras.json";
pub const POINTS: &str = "points.ply";
pub const REPORT: &str = "report.html";
pub const RESULT: &str = "result.json";

/// `result.json` as text; without the input, warnings name views by their numbers.
///
/// # Errors
/// None is expected: every field is serialisable.
pub fn result_json(solution: &Solution, input: Option<&LabelledInput>) -> io::Result<String> {
    pretty(&ResultJson::new(solution, input))
}

/// Writes the result files into `directory`, which is created. Without the input, indices stand for labels, there is
/// no `observations.csv` and the report has no picture of the tracks.
///
/// # Errors
/// The first file that cannot be written, named.
pub fn write(directory: &Path, solution: &Solution, input: Option<&LabelledInput>) -> io::Result<()> {
    create_directory(directory)?;
    write_atomically(directory, TRACKS, tracks_csv(solution, input).as_bytes())?;
    if let Some(input) = input {
        write_atomically(directory, OBSERVATIONS, observations_csv(solution, input).as_bytes())?;
    }
    write_atomically(directory, CAMERAS, pretty(&CamerasJson::new(solution, input))?.as_bytes())?;
    write_points(directory, solution, input)?;
    write_atomically(directory, REPORT, report::page(solution, input).as_bytes())?;
    write_atomically(directory, RESULT, result_json(solution, input)?.as_bytes())
}

/// The points, a file a part: parts have frames of their own, which no program could tell apart in one file. Files of a
/// former result's parts are removed.
fn write_points(directory: &Path, solution: &Solution, input: Option<&LabelledInput>) -> io::Result<()> {
    let parts = solution.part_count().max(1);
    for part in 0..parts {
        write_atomically(directory, &points_of(part), ply::points(solution, input, part).as_bytes())?;
    }
    for entry in fs::read_dir(directory)? {
        let name = entry?.file_name();
        if name.to_str().and_then(part_of_points).is_some_and(|part| part >= parts) {
            fs::remove_file(directory.join(&name))
                .map_err(|error| named(&error, &format!("cannot remove {}", directory.join(&name).display())))?;
        }
    }
    Ok(())
}

/// Name of the file of a part's points: `points.ply` for the largest, `points-part-1.ply` for part 1 of `cameras.json` and
/// `tracks.csv`.
pub fn points_of(part: u32) -> String {
    if part == 0 { POINTS.into() } else { format!("points-part-{part}.ply") }
}

/// The part whose file has this name, but the largest.
fn part_of_points(name: &str) -> Option<u32> {
    let part = name.strip_prefix("points-part-")?.strip_suffix(".ply")?.parse().ok()?;
    (points_of(part) == name).then_some(part)
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

/// Creates a directory and what is above it.
///
/// # Errors
/// The directory cannot be created; the message names it.
pub fn create_directory(directory: &Path) -> io::Result<()> {
    fs::create_dir_all(directory)
        .map_err(|error| named(&error, &format!("cannot create the directory {}", directory.display())))
}

/// Writes a file under a temporary name and renames it, so that no reader sees half of it and a full disk leaves the
/// old one standing.
///
/// # Errors
/// The file cannot be written; the message names it.
pub fn write_atomically(directory: &Path, name: &str, bytes: &[u8]) -> io::Result<()> {
    let target = directory.join(name);
    let temporary = TemporaryFile(directory.join(format!(".{name}.{}", std::process::id())));
    let attempt = || {
        let mut file = File::create(&temporary.0)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&temporary.0, &target)
    };
    attempt().map_err(|error| named(&error, &format!("cannot write {}", target.display())))
}

/// Removes the file when dropped; after the rename there is nothing left to remove.
struct TemporaryFile(PathBuf);

impl Drop for TemporaryFile {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

fn named(error: &io::Error, what: &str) -> io::Error {
    io::Error::new(error.kind(), format!("{what}: {error}"))
}

/// JSON for people too: indented, with a newline at the end.
pub fn pretty(value: &impl serde::Serialize) -> io::Result<String> {
    let mut text = serde_json::to_string_pretty(value).map_err(io::Error::other)?;
    text.push('\n');
    Ok(text)
}

/// `track,weight,inlier`, `network_weight` where a network ran, and the `part` that the track has a point in, empty where it
/// has none; one line a track.
fn tracks_csv(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let tracks = &solution.tracks;
    let has_network = !tracks.network_weight.is_empty();
    let mut text = String::from("track,weight,inlier");
    text.push_str(if has_network { ",network_weight,part\n" } else { ",part\n" });
    for (track, (weight, &inlier)) in tracks.weight.iter().zip(&tracks.inlier).enumerate() {
        text.push_str(&format!("{},{weight},{}", track_label(input, track).csv(), u8::from(inlier)));
        if has_network {
            text.push_str(&format!(",{}", tracks.network_weight.get(track).copied().unwrap_or(0.0)));
        }
        let part = tracks.part_of(track).map_or_else(String::new, |part| part.to_string());
        text.push_str(&format!(",{part}\n"));
    }
    text
}

/// `view,track,inlier,residual_px,weight,split` in the order of the caller's file; an observation that was not judged has
/// an empty residual, one that shows no other point of its track an empty split.
fn observations_csv(solution: &Solution, input: &LabelledInput) -> String {
    let judged = &solution.observations;
    let mut text = String::from("view,track,inlier,residual_px,weight,split\n");
    for (k, (&view, &track)) in input.raw.view.iter().zip(&input.raw.track).enumerate() {
        let inlier = judged.inlier.get(k).copied().unwrap_or(false);
        let residual = judged.residual_px.get(k).copied().flatten();
        let split = judged.split.get(k).copied().unwrap_or(0);
        text.push_str(&format!(
            "{},{},{},{},{},{}\n",
            view_label(Some(input), view as usize).csv(),
            track_label(Some(input), track as usize).csv(),
            u8::from(inlier),
            residual.map_or_else(String::new, |px| px.to_string()),
            judged.weight.get(k).copied().unwrap_or(0.0),
            if split > 0 { split.to_string() } else { String::new() },
        ));
    }
    text
}

#[cfg(test)]
#[path = "result_files_tests.rs"]
mod tests;
