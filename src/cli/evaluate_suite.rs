//! What the suites of `scpsfm evaluate` share: which scenes are wanted, how runs are done, recorded and shown, and what
//! tells one build's figures from another's.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use super::print;
use super::progress::RunsView;
use crate::domain::{Sha256Digest, StopToken, counted};
use crate::evaluation::records::{self, Records};
use crate::formats::publish::{create_directory, pretty, write_atomically};
use scpsfm_core::subspace;

/// Seeds of one evaluation at most: more would take weeks.
pub const MOST_SEEDS: u64 = 10_000;

/// Which scenes of a suite.
#[derive(Debug, Clone, clap::Args)]
pub struct SceneFilter {
    /// The scenes of these names, or all whose names hold these texts, separated by commas; a comma before a space is
    /// part of a name. With --photographed, of the scenes of the --seeds seeds [default: all]
    #[arg(long, value_name = "TEXTS", value_parser = naming, requires = "suite", conflicts_with = "real")]
    scenes: Option<String>,
}

/// Refuses what names no scene: an empty variable of a shell is not to start all of them.
fn naming(texts: &str) -> Result<String, &'static str> {
    if texts.split(',').all(str::is_empty) { Err("names no scene") } else { Ok(texts.to_owned()) }
}

impl SceneFilter {
    /// The texts of `--scenes`: a comma before a space belongs to a name, such as `complete 0.5, K 1`.
    pub fn texts(&self) -> Vec<&str> {
        let mut texts = Vec::new();
        let mut rest = self.scenes.as_deref().unwrap_or_default();
        while let Some((at, _)) = rest.match_indices(',').find(|(at, _)| !rest[at + 1..].starts_with(' ')) {
            texts.push(&rest[..at]);
            rest = &rest[at + 1..];
        }
        texts.push(rest);
        texts.retain(|text| !text.is_empty());
        texts
    }
}

/// The scenes of these names, or all whose names hold these texts; without a text all.
///
/// * `there_are`: what a refusal says that names hold, where listing all of them says too much
///
/// # Errors
/// A text that no scene has in its name, as wrong usage.
pub fn chosen<T>(
    mut all: Vec<T>,
    name: impl Fn(&T) -> String,
    texts: &[&str],
    there_are: Option<String>,
) -> Result<Vec<T>, Failure> {
    let names: Vec<String> = all.iter().map(name).collect();
    let exact = |text: &str| names.iter().any(|name| name == text);
    let is_of = |name: &str, text: &str| if exact(text) { name == text } else { name.contains(text) };
    if let Some(text) = texts.iter().find(|text| !names.iter().any(|name| is_of(name, text))) {
        let there_are = there_are.unwrap_or_else(|| names.join("; "));
        return Err(Failure::usage(format!("--scenes {text}: no scenes have it in their name; there are {there_are}")));
    }
    let wanted: Vec<bool> =
        names.iter().map(|name| texts.is_empty() || texts.iter().any(|text| is_of(name, text))).collect();
    let mut wanted = wanted.into_iter();
    all.retain(|_| wanted.next() == Some(true));
    Ok(all)
}

/// Where and how the runs of a suite are done, and how they are shown.
pub struct SuiteRunner<'a> {
    pub out: &'a Path,
    pub threads: usize,
    pub quiet: bool,
    /// Figures on stdout as JSON, not as a table.
    pub json: bool,
}

impl SuiteRunner<'_> {
    /// Does what the records of this name lack, and writes and prints the figures of all that is recorded.
    ///
    /// * `file`: that of the figures
    /// * `figures`: as JSON and as a table
    ///
    /// # Errors
    /// Files that cannot be read or written, a defect of the solver; interrupted, after the figures so far were given.
    pub fn run<R, M>(
        &self,
        name: &str,
        runs: &[R],
        measure: fn(&R, &StopToken) -> Result<Option<M>, String>,
        file: &str,
        figures: impl FnOnce(&Records<R, M>) -> (Value, String),
    ) -> Result<Exit, Failure>
    where
        R: Serialize + DeserializeOwned + Sync,
        M: Serialize + DeserializeOwned + Clone + Send,
    {
        self.run_described(name, runs, measure, |_| String::new(), file, |records, _| Ok(figures(records)))
    }

    /// The same where runs differ so much in time that the progress has to say which is done, and where more than one
    /// file of figures is written.
    ///
    /// * `describe`: what the progress says of a finished run
    /// * `figures`: as JSON and as a table, given what there is to note of runs that are missing
    ///
    /// # Errors
    /// See [`run`](Self::run).
    pub fn run_described<R, M>(
        &self,
        name: &str,
        runs: &[R],
        measure: fn(&R, &StopToken) -> Result<Option<M>, String>,
        describe: fn(&R) -> String,
        file: &str,
        figures: impl FnOnce(&Records<R, M>, Option<&str>) -> Result<(Value, String), Failure>,
    ) -> Result<Exit, Failure>
    where
        R: Serialize + DeserializeOwned + Sync,
        M: Serialize + DeserializeOwned + Clone + Send,
    {
        let stop = StopToken::default();
        // Before anything else: an interruption while records are read ends in order, too.
        let interrupt = Interrupt::listen()?;
        let relay = interrupt.stops(&stop);
        create_directory(self.out)?;
        let mut records: Records<R, M> = Records::open(self.out, name, &build()?)?;
        let done = runs.iter().filter(|run| records.get(run).is_some()).count();
        let bar = RunsView::new(self.quiet, runs.len(), done);
        let outcome = tokio::task::block_in_place(|| {
            records.run(runs, self.threads, &stop, &|run| measure(run, &stop), &mut |run| {
                bar.show(describe(run));
                bar.finished();
            })
        });
        relay.abort();
        bar.finish();
        outcome?;
        let done = runs.iter().filter(|run| records.get(run).is_some()).count();
        let counts = RunCounts { done, planned: runs.len() };
        let note = counts.note();
        let (mut json, table) = figures(&records, note.as_deref())?;
        counts.add_to(&mut json);
        let json = written(self.out, file, json)?;
        print(&if self.json { json.trim_end().to_owned() } else { with_note(table, note) })?;
        if stop.is_stopped() {
            return Err(Failure::interrupted_with("interrupted; called again with the same --out it goes on"));
        }
        Ok(Exit::Done)
    }
}

/// How many runs of an evaluation are done.
#[derive(Debug, Clone, Copy)]
pub struct RunCounts {
    pub done: usize,
    pub planned: usize,
}

impl RunCounts {
    fn is_complete(self) -> bool {
        self.done >= self.planned
    }

    /// What figures say where runs are missing.
    pub fn note(self) -> Option<String> {
        let Self { done, planned } = self;
        (!self.is_complete()).then(|| format!("Incomplete: {done} of {} are done.", counted(planned, "run")))
    }

    /// Adds the same to figures for programs.
    pub fn add_to(self, figures: &mut Value) {
        figures["complete"] = json!(self.is_complete());
        figures["runs_done"] = json!(self.done);
        figures["runs_planned"] = json!(self.planned);
    }
}

/// A table and below it what there is to note.
pub fn with_note(table: String, note: Option<String>) -> String {
    [Some(table.trim_end().to_owned()), note].into_iter().flatten().collect::<Vec<_>>().join("\n\n")
}

/// Writes figures with the version and the network that they are of; returns the JSON.
fn written(out: &Path, name: &str, mut figures: Value) -> Result<String, Failure> {
    let network = subspace::current();
    figures["version"] = json!(env!("CARGO_PKG_VERSION"));
    figures["network"] = json!({ "origin": network.origin, "sha256": subspace::current_sha256().to_string() });
    let text = pretty(&figures)?;
    write_atomically(out, name, text.as_bytes())?;
    Ok(text)
}

/// What tells this program from any other that might have written the records: its version, the digest of its file and
/// that of the network it asks.
fn build() -> Result<String, Failure> {
    let program = std::fs::read(std::env::current_exe()?)?;
    let program = Sha256Digest(Sha256::digest(&program).into());
    // Another network gives other figures.
    let network = subspace::current_sha256();
    Ok(format!("{} {program:.16} {network:.16}", env!("CARGO_PKG_VERSION")))
}

impl From<records::Error> for Failure {
    fn from(error: records::Error) -> Self {
        match error {
            records::Error::Io { .. } | records::Error::Failed { .. } => Failure::internal(error),
            records::Error::OtherBuild { .. }
            | records::Error::Malformed { .. }
            | records::Error::NotRecords { .. }
            | records::Error::Busy { .. } => Failure::bad_input(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen_of(texts: &[&str]) -> Result<Vec<&'static str>, Failure> {
        chosen(vec!["orbit", "orbit/fisheye", "drive/fisheye", "drive"], |name| name.to_string(), texts, None)
    }

    #[test]
    fn a_whole_name_is_that_scene_and_a_part_all_that_hold_it() {
        assert_eq!(chosen_of(&[]).expect("all").len(), 4);
        assert_eq!(chosen_of(&["orbit"]).expect("one"), ["orbit"]);
        assert_eq!(chosen_of(&["fish"]).expect("two"), ["orbit/fisheye", "drive/fisheye"]);
        assert_eq!(chosen_of(&["drive", "orbit"]).expect("two"), ["orbit", "drive"]);
        let failure = chosen_of(&["drive", "zeppelin"]).expect_err("no such scene");
        assert!(failure.message.contains("zeppelin") && failure.message.contains("orbit; orbit/fisheye"), "{failure}");
    }
}
