//! Runs a plan on several threads and records every answer as it comes, so that a stopped evaluation goes on.

use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

use serde::{Deserialize, Serialize};

use super::measures::Measures;
use super::oracle;
use super::plan::Run;
use crate::domain::{Input, Limits, Silent, StopToken};
use crate::solver;
use crate::synthetic::Scene;

/// The file of records, one a line after the header.
pub const RECORDS: &str = "runs.jsonl";

/// Why an evaluation cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// Figures of two builds do not mix.
    #[error(
        "{} was recorded by another build ({recorded}; this is {current}): remove it, or give another directory",
        path.display()
    )]
    OtherBuild { path: PathBuf, recorded: String, current: String },
    #[error("{} line {line}: {what}; remove the file, or give another directory", path.display())]
    Malformed { path: PathBuf, line: usize, what: String },
    /// A scene that cannot be made, or a defect of the solver; the run is named.
    #[error("{run}: {what}")]
    Failed { run: String, what: String },
}

/// First line of the records.
#[derive(Debug, Serialize, Deserialize)]
struct Header {
    /// What identifies the program that recorded.
    build: String,
}

/// One finished run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    #[serde(flatten)]
    pub run: Run,
    pub measures: Measures,
}

/// The records of a directory, in memory and on disk.
pub struct Records {
    path: PathBuf,
    file: File,
    by_key: HashMap<String, Measures>,
}

impl Records {
    /// Opens the records of a directory, or begins them.
    ///
    /// A last line without an end, as a killed process leaves it, is dropped and its run done again.
    ///
    /// * `build`: identity of the program; records of another one are refused
    ///
    /// # Errors
    /// The file cannot be read or written, or is not one of this build's.
    pub fn open(directory: &Path, build: &str) -> Result<Self, Error> {
        let path = directory.join(RECORDS);
        let at = |source| Error::Io { path: path.clone(), source };
        let mut by_key = HashMap::new();
        let whole = if path.exists() { whole_lines(&path).map_err(at)? } else { Vec::new() };
        if let Some((first, rest)) = whole.split_first() {
            let malformed = |line: usize, error: serde_json::Error| Error::Malformed {
                path: path.clone(),
                line,
                what: error.to_string(),
            };
            let header: Header = serde_json::from_str(first).map_err(|error| malformed(1, error))?;
            if header.build != build {
                return Err(Error::OtherBuild { path, recorded: header.build, current: build.to_owned() });
            }
            for (index, line) in rest.iter().enumerate() {
                let record: Record = serde_json::from_str(line).map_err(|error| malformed(index + 2, error))?;
                by_key.insert(record.run.key(), record.measures);
            }
        }
        let mut file = OpenOptions::new().create(true).append(true).open(&path).map_err(at)?;
        let length: u64 = whole.iter().map(|line| line.len() as u64 + 1).sum();
        file.set_len(length).map_err(at)?;
        if whole.is_empty() {
            write_line(&mut file, &Header { build: build.to_owned() }).map_err(at)?;
        }
        Ok(Self { path, file, by_key })
    }

    /// What was measured in a run, if it was done.
    pub fn get(&self, run: &Run) -> Option<&Measures> {
        self.by_key.get(&run.key())
    }

    /// Number of runs recorded, those of other plans included.
    pub fn len(&self) -> usize {
        self.by_key.len()
    }

    pub fn is_empty(&self) -> bool {
        self.by_key.is_empty()
    }

    fn add(&mut self, record: Record) -> Result<(), Error> {
        write_line(&mut self.file, &record).map_err(|source| Error::Io { path: self.path.clone(), source })?;
        self.by_key.insert(record.run.key(), record.measures);
        Ok(())
    }
}

/// The lines of a file that end, without their ends.
fn whole_lines(path: &Path) -> std::io::Result<Vec<String>> {
    let mut reader = BufReader::new(File::open(path)?);
    let mut lines = Vec::new();
    loop {
        let mut line = String::new();
        reader.read_line(&mut line)?;
        if line.pop() != Some('\n') {
            return Ok(lines);
        }
        lines.push(line);
    }
}

/// One write a line: a killed process leaves whole lines but for the last.
fn write_line(file: &mut File, value: &impl Serialize) -> std::io::Result<()> {
    let mut line = serde_json::to_string(value).map_err(std::io::Error::other)?;
    line.push('\n');
    file.write_all(line.as_bytes())
}

/// Runs what is not recorded yet, on `threads` threads; `told` hears of every finished run.
///
/// Stops after the runs in progress once `stop` fires; what was finished is recorded.
///
/// # Errors
/// The first run that fails, or a record that cannot be written, ends the evaluation.
pub fn run(
    runs: &[Run],
    records: &mut Records,
    threads: usize,
    stop: &StopToken,
    told: &mut dyn FnMut(&Record),
) -> Result<(), Error> {
    let missing: Vec<&Run> = runs.iter().filter(|run| records.get(run).is_none()).collect();
    let next = AtomicUsize::new(0);
    // Ends the other threads when one has failed.
    let failed = StopToken::default();
    let (sender, receiver) = mpsc::channel();
    std::thread::scope(|scope| {
        for _ in 0..threads.clamp(1, missing.len().max(1)) {
            let sender = sender.clone();
            let (missing, next, failed) = (&missing, &next, &failed);
            scope.spawn(move || {
                while !stop.is_stopped() && !failed.is_stopped() {
                    let Some(run) = missing.get(next.fetch_add(1, Ordering::Relaxed)) else { break };
                    // The receiver goes away only after an error of its own.
                    if sender.send(measure(run, stop)).is_err() {
                        break;
                    }
                }
            });
        }
        drop(sender);
        let mut outcome = Ok(());
        for measured in receiver {
            let added = measured.and_then(|record| {
                let Some(record) = record else { return Ok(()) };
                told(&record);
                records.add(record)
            });
            if outcome.is_ok() && added.is_err() {
                outcome = added;
                failed.stop(crate::domain::StopReason::Cancelled);
            }
        }
        outcome
    })
}

/// One run; `None` when it was stopped.
fn measure(run: &Run, stop: &StopToken) -> Result<Option<Record>, Error> {
    let failed = |what: String| Error::Failed { run: run.key(), what };
    let scene = Scene::generate(&run.scene).map_err(|error| failed(error.to_string()))?;
    let measures = match run.settings() {
        None => oracle::measure(&scene),
        Some(settings) => {
            let input = Input::new(scene.input.clone(), &Limits::default(), "scene")
                .map_err(|error| failed(error.to_string()))?;
            match solver::solve(&input, &settings, &mut Silent, stop) {
                Ok(solution) => Measures::of(&scene, &solution),
                Err(solver::Error::Stopped(_)) => return Ok(None),
                Err(error) => return Err(failed(error.to_string())),
            }
        }
    };
    Ok(Some(Record { run: run.clone(), measures }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::plan::Contestant;
    use crate::synthetic::SceneOptions;

    fn runs(seeds: u64) -> Vec<Run> {
        (0..seeds)
            .flat_map(|seed| {
                let scene =
                    SceneOptions { views: 5, tracks: 40, outliers: 0.3, with_depths: true, seed, ..Default::default() };
                let oracle = Run::oracle(scene);
                [oracle.clone(), Run { contestant: Contestant::Psfm, ..oracle }]
            })
            .collect()
    }

    fn run_all(directory: &Path, seeds: u64) -> usize {
        let mut records = Records::open(directory, "a build").expect("a writable directory");
        let mut done = 0;
        run(&runs(seeds), &mut records, 2, &StopToken::default(), &mut |_| done += 1).expect("runs");
        assert_eq!(records.len(), 2 * seeds as usize);
        done
    }

    #[test]
    fn a_second_evaluation_does_only_what_is_missing() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        assert_eq!(run_all(directory.path(), 2), 4);
        assert_eq!(run_all(directory.path(), 3), 2);
        assert_eq!(run_all(directory.path(), 3), 0);
        // A killed process leaves half a line: its run is done again.
        let path = directory.path().join(RECORDS);
        let text = std::fs::read_to_string(&path).expect("records");
        std::fs::write(&path, &text[..text.len() - 20]).expect("writable");
        assert_eq!(run_all(directory.path(), 3), 1);
        assert_eq!(run_all(directory.path(), 3), 0);
    }

    #[test]
    fn records_of_another_build_and_garbage_are_refused() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        run_all(directory.path(), 1);
        let other = Records::open(directory.path(), "another build");
        assert!(matches!(other, Err(Error::OtherBuild { .. })));
        let path = directory.path().join(RECORDS);
        let mut text = std::fs::read_to_string(&path).expect("records");
        text.push_str("{\"scene\": 3}\n");
        std::fs::write(&path, text).expect("writable");
        let Err(Error::Malformed { line, .. }) = Records::open(directory.path(), "a build") else {
            panic!("garbage was accepted")
        };
        assert_eq!(line, 4);
    }

    #[test]
    fn a_stopped_evaluation_ends_and_keeps_what_it_has() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut records = Records::open(directory.path(), "a build").expect("a writable directory");
        let stop = StopToken::default();
        let mut done = 0;
        run(&runs(20), &mut records, 1, &stop, &mut |_| {
            done += 1;
            stop.stop(crate::domain::StopReason::Cancelled);
        })
        .expect("stopping is no error");
        assert!(done < 40, "{done}");
        drop(records);
        assert_eq!(Records::open(directory.path(), "a build").expect("records").len(), done);
    }

    #[test]
    fn an_impossible_scene_is_named() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut records = Records::open(directory.path(), "a build").expect("a writable directory");
        let mut impossible = runs(1);
        impossible[0].scene.views = 1;
        let error = run(&impossible, &mut records, 2, &StopToken::default(), &mut |_| {}).expect_err("one view");
        assert!(error.to_string().contains("views"), "{error}");
    }
}
