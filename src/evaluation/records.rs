//! Runs a list on several threads and records every answer as it comes, so that a stopped evaluation goes on.

use std::collections::HashMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::domain::{StopReason, StopToken};
use crate::formats::json;

/// Why an evaluation cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// Two processes would each lose what the other writes.
    #[error("{} is being written by another process: wait for it, or give another directory", path.display())]
    Busy { path: PathBuf },
    /// Figures of two builds, or of two networks, do not mix.
    #[error(
        "{} was recorded by another build or with another network ({recorded}; this is {current}): remove it, or give another directory",
        path.display()
    )]
    OtherBuild { path: PathBuf, recorded: String, current: String },
    #[error("{} line {line}: {what}; remove this line, and its run is done again", path.display())]
    Malformed { path: PathBuf, line: usize, what: String },
    /// The first line says who recorded.
    #[error("{} line 1: {what}; remove the file, or give another directory", path.display())]
    NotRecords { path: PathBuf, what: String },
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
pub struct Record<R, M> {
    #[serde(flatten)]
    pub run: R,
    pub measures: M,
}

/// The records of a directory, in memory and on disk, one a line after the header: what was run, and what was measured.
pub struct Records<R, M> {
    path: PathBuf,
    file: File,
    by_key: HashMap<String, M>,
    runs: PhantomData<R>,
}

/// What makes a run the same as another: its own text.
pub fn key(run: &impl Serialize) -> String {
    // Plain data: serialisation cannot fail.
    serde_json::to_string(run).unwrap_or_default()
}

impl<R: Serialize + DeserializeOwned + Sync, M: Serialize + DeserializeOwned + Clone + Send> Records<R, M> {
    /// Opens the records of this name in a directory, or begins them.
    ///
    /// A last line without an end, as a killed process leaves it, is dropped and its run done again.
    ///
    /// * `build`: identity of the program; records of another one are refused
    ///
    /// # Errors
    /// The file cannot be read or written, or is not one of this build's.
    pub fn open(directory: &Path, name: &str, build: &str) -> Result<Self, Error> {
        let path = directory.join(name);
        let at = |source| Error::Io { path: path.clone(), source };
        let mut by_key = HashMap::new();
        let mut file = OpenOptions::new().create(true).read(true).append(true).open(&path).map_err(at)?;
        // Held until the file is closed, by a killed process, too.
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(Error::Busy { path }),
            // Where the file system knows no locks, whoever shares its directories looks after them.
            Err(TryLockError::Error(source)) if source.kind() == ErrorKind::Unsupported => {}
            Err(TryLockError::Error(source)) => return Err(at(source)),
        }
        let whole = whole_lines(&file).map_err(at)?;
        if let Some((first, rest)) = whole.split_first() {
            let header: Header = json::read(first).map_err(|what| Error::NotRecords { path: path.clone(), what })?;
            if header.build != build {
                return Err(Error::OtherBuild { path, recorded: header.build, current: build.to_owned() });
            }
            for (index, line) in rest.iter().enumerate() {
                let record: Record<R, M> =
                    json::read(line).map_err(|what| Error::Malformed { path: path.clone(), line: index + 2, what })?;
                by_key.insert(key(&record.run), record.measures);
            }
        }
        let length: u64 = whole.iter().map(|line| line.len() as u64 + 1).sum();
        file.set_len(length).map_err(at)?;
        if whole.is_empty() {
            write_line(&mut file, &Header { build: build.to_owned() }).map_err(at)?;
        }
        Ok(Self { path, file, by_key, runs: PhantomData })
    }

    /// What was measured in a run, if it was done.
    pub fn get(&self, run: &R) -> Option<&M> {
        self.by_key.get(&key(run))
    }

    /// Number of runs recorded, those of other plans included.
    #[cfg(test)]
    pub fn len(&self) -> usize {
        self.by_key.len()
    }

    fn add(&mut self, record: &Record<&R, M>) -> Result<(), Error> {
        write_line(&mut self.file, record).map_err(|source| Error::Io { path: self.path.clone(), source })?;
        self.by_key.insert(key(record.run), record.measures.clone());
        Ok(())
    }

    /// Runs what is not recorded yet, on `threads` threads; `told` hears of every finished run.
    ///
    /// Stops after the runs in progress once `stop` fires; what was finished is recorded.
    ///
    /// * `measure`: one run; `None` when it was stopped, and an error in words
    ///
    /// # Errors
    /// The first run that fails, or a record that cannot be written, ends the evaluation.
    pub fn run(
        &mut self,
        runs: &[R],
        threads: usize,
        stop: &StopToken,
        measure: &(dyn Fn(&R) -> Result<Option<M>, String> + Sync),
        told: &mut dyn FnMut(&R),
    ) -> Result<(), Error> {
        let missing: Vec<&R> = runs.iter().filter(|run| self.get(run).is_none()).collect();
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
                        let Some(&run) = missing.get(next.fetch_add(1, Ordering::Relaxed)) else { break };
                        // The receiver goes away only after an error of its own.
                        if sender.send((run, measure(run))).is_err() {
                            break;
                        }
                    }
                });
            }
            drop(sender);
            let mut outcome = Ok(());
            for (run, measured) in receiver {
                let added = match measured {
                    Ok(None) => Ok(()),
                    Ok(Some(measures)) => {
                        told(run);
                        self.add(&Record { run, measures })
                    }
                    Err(what) => Err(Error::Failed { run: key(run), what }),
                };
                if outcome.is_ok() && added.is_err() {
                    outcome = added;
                    failed.stop(StopReason::Cancelled);
                }
            }
            outcome
        })
    }
}

/// The lines of a file that end, without their ends.
fn whole_lines(file: &File) -> std::io::Result<Vec<Vec<u8>>> {
    let mut reader = BufReader::new(file);
    let mut lines = Vec::new();
    loop {
        let mut line = Vec::new();
        reader.read_until(b'\n', &mut line)?;
        if line.pop() != Some(b'\n') {
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
