//! Writing the result files into a directory: each appears whole or not at all.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::cameras_json::CamerasJson;
use super::result_json::{ResultJson, track_label, view_label};
use super::{LabelledInput, former, ply};
use crate::domain::{Solution, Status};
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
/// no `observations.csv` and the report has no picture of the tracks. What a former run left there and this one does not
/// make goes, but for other programs' files: see [`super::export`].
///
/// # Errors
/// The first file that cannot be written, named; until every file is on the disk the former ones stand.
pub fn write(directory: &Path, solution: &Solution, input: Option<&LabelledInput>) -> io::Result<()> {
    create_directory(directory)?;
    let mut draft = Draft::new(directory);
    draft.add(TRACKS, tracks_csv(solution, input).as_bytes())?;
    if let Some(input) = input {
        draft.add(OBSERVATIONS, observations_csv(solution, input).as_bytes())?;
    }
    draft.add(CAMERAS, pretty(&CamerasJson::new(solution, input))?.as_bytes())?;
    // A file a part: parts have frames of their own, which no program could tell apart in one file.
    for part in 0..solution.part_count().max(1) {
        draft.add(&points_of(part), ply::points(solution, input, part).as_bytes())?;
    }
    draft.add(REPORT, report::page(solution, input).as_bytes())?;
    draft.publish(RESULT, result_json(solution, input)?.as_bytes())
}

/// Name of the file of a part's points: `points.ply` for the largest, `points-part-1.ply` for part 1 of `cameras.json` and
/// `tracks.csv`.
pub fn points_of(part: u32) -> String {
    if part == 0 { POINTS.into() } else { format!("points-part-{part}.ply") }
}

/// The part whose file has this name, but the largest.
pub(super) fn part_of_points(name: &str) -> Option<u32> {
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
    TemporaryFile::write(directory, name, bytes)?.rename()
}

/// Files of one run that are to stand together: all are on the disk before the first takes its name.
pub struct Draft<'a> {
    directory: &'a Path,
    files: Vec<TemporaryFile>,
}

impl<'a> Draft<'a> {
    /// Nothing yet; the directory exists.
    pub fn new(directory: &'a Path) -> Self {
        Self { directory, files: Vec::new() }
    }

    /// Writes a file under a temporary name.
    ///
    /// # Errors
    /// The file cannot be written; the message names it.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> io::Result<()> {
        self.files.push(TemporaryFile::write(self.directory, name, bytes)?);
        Ok(())
    }

    /// Gives the files their names, and takes away what former runs left beside them. The file that says that the others
    /// are there goes before any other changes, and comes last.
    ///
    /// # Errors
    /// The first file that cannot be written or removed, named.
    pub fn publish(mut self, last: &str, bytes: &[u8]) -> io::Result<()> {
        let complete = TemporaryFile::write(self.directory, last, bytes)?;
        if !complete.target.is_dir() {
            remove(&complete.target)?;
        }
        let mut names = vec![last.to_owned()];
        for file in self.files.drain(..) {
            names.extend(file.target.file_name().and_then(|name| name.to_str()).map(str::to_owned));
            file.rename()?;
        }
        former::remove_beside(self.directory, &names)?;
        complete.rename()
    }
}

/// A file that is on the disk under a temporary name, and is removed when dropped; after the rename there is nothing left
/// to remove.
struct TemporaryFile {
    temporary: PathBuf,
    target: PathBuf,
}

impl TemporaryFile {
    fn write(directory: &Path, name: &str, bytes: &[u8]) -> io::Result<Self> {
        let file =
            Self { temporary: directory.join(format!(".{name}.{}", std::process::id())), target: directory.join(name) };
        let attempt = || {
            let mut open = File::create(&file.temporary)?;
            open.write_all(bytes)?;
            open.sync_all()
        };
        attempt().map_err(|error| file.failed(&error))?;
        Ok(file)
    }

    fn rename(self) -> io::Result<()> {
        fs::rename(&self.temporary, &self.target).map_err(|error| self.failed(&error))
    }

    fn failed(&self, error: &io::Error) -> io::Error {
        named(error, &format!("cannot write {}", self.target.display()))
    }
}

impl Drop for TemporaryFile {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.temporary);
    }
}

/// Removes a file if it is there.
///
/// # Errors
/// It cannot be removed; the message names it.
pub(super) fn remove(file: &Path) -> io::Result<()> {
    match fs::remove_file(file) {
        Err(error) if !matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            Err(named(&error, &format!("cannot remove {}", file.display())))
        }
        _ => Ok(()),
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
///
/// Where nothing was reconstructed there is no point that an observation could show: its weight is that of its track.
fn observations_csv(solution: &Solution, input: &LabelledInput) -> String {
    let judged = &solution.observations;
    let mut text = String::from("view,track,inlier,residual_px,weight,split\n");
    for (k, (&view, &track)) in input.raw.view.iter().zip(&input.raw.track).enumerate() {
        let inlier = judged.inlier.get(k).copied().unwrap_or(false);
        let residual = judged.residual_px.get(k).copied().flatten();
        let split = judged.split.get(k).copied().unwrap_or(0);
        let weight = match solution.status {
            Status::Solved => judged.weight.get(k),
            Status::NoReconstruction => solution.tracks.weight.get(track as usize),
        };
        text.push_str(&format!(
            "{},{},{},{},{},{}\n",
            view_label(Some(input), view as usize).csv(),
            track_label(Some(input), track as usize).csv(),
            u8::from(inlier),
            residual.map_or_else(String::new, |px| px.to_string()),
            weight.copied().unwrap_or(0.0),
            if split > 0 { split.to_string() } else { String::new() },
        ));
    }
    text
}

#[cfg(test)]
#[path = "result_files_tests.rs"]
mod tests;
