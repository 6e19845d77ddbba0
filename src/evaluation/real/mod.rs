//! Real sequences whose answer is known from elsewhere: this program beside another one, on the same files.
//!
//! [`folder`] reads a sequence, [`child`] runs a program and measures what it takes, [`ours`] and [`peer`] are the two
//! sides, [`measures`] scores an answer, [`table`] and [`page`] show the rows. Both sides are child processes, so that
//! both pay for their start and are measured alike.

pub mod child;
pub mod folder;
pub mod measures;
pub mod ours;
pub mod page;
pub mod peer;
pub mod table;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Serialize;

use crate::domain::StopToken;
use child::{Ended, Limits, Usage};
pub use folder::Sequence;
pub use measures::Scores;

/// What is wrong with a file of a sequence.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error("{}: {what}", file.display())]
    File { file: PathBuf, what: String },
    #[error("{}, {place}: {what}", file.display())]
    Place { file: PathBuf, place: String, what: String },
    /// From the reader of observations, which names the file itself.
    #[error("{}: {what}", directory.display())]
    Observations { directory: PathBuf, what: String },
}

impl Error {
    pub(crate) fn file(file: &Path, what: impl std::fmt::Display) -> Self {
        Self::File { file: file.into(), what: what.to_string() }
    }

    pub(crate) fn place(file: &Path, place: impl Into<String>, what: impl std::fmt::Display) -> Self {
        Self::Place { file: file.into(), place: place.into(), what: what.to_string() }
    }
}

scpsfm_core::named! {
    /// Who answered.
    pub enum Side {
        Scpsfm = "scpsfm",
        Peer = "peer",
    }
}

/// One side on one sequence.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    pub sequence: String,
    pub side: Side,
    /// Views of the sequence.
    pub views: usize,
    pub observations: usize,
    /// Whether the cameras that the centres are compared with were estimated from these very tracks.
    pub cameras_estimated: bool,
    /// Why there is no answer.
    pub failure: Option<String>,
    /// `None`: there is no answer.
    pub scores: Option<Scores>,
    pub usage: Usage,
}

/// What to run.
#[derive(Debug, Clone)]
pub struct Options {
    /// This program's file.
    pub program: PathBuf,
    /// The other program and its first arguments; empty: none.
    pub peer: Vec<String>,
    /// Wall time after which a peer is ended.
    pub peer_timeout: Duration,
}

/// Runs every side on every sequence, one after the other; `on_start` hears of each beforehand and `on_row` of each
/// row. A side that fails is a row with its reason. Stops between programs and ends a running one when `stop` says so;
/// the rows so far are returned.
///
/// # Errors
/// No directory for the programs' files can be made.
pub fn run(
    sequences: &[Sequence],
    options: &Options,
    stop: &StopToken,
    on_start: &mut dyn FnMut(&Sequence, Side),
    on_row: &mut dyn FnMut(&Row),
) -> std::io::Result<Vec<Row>> {
    let sides: &[Side] = if options.peer.is_empty() { &[Side::Scpsfm] } else { &[Side::Scpsfm, Side::Peer] };
    let mut rows = Vec::new();
    for sequence in sequences {
        for &side in sides {
            if stop.is_stopped() {
                return Ok(rows);
            }
            on_start(sequence, side);
            let scratch = tempfile::tempdir()?;
            let Some(row) = run_side(sequence, side, options, scratch.path(), stop) else { return Ok(rows) };
            on_row(&row);
            rows.push(row);
        }
    }
    Ok(rows)
}

/// One row; `None` when stopped.
fn run_side(sequence: &Sequence, side: Side, options: &Options, scratch: &Path, stop: &StopToken) -> Option<Row> {
    let (mut command, limit) = match side {
        Side::Scpsfm => (ours::command(&options.program, sequence, scratch), None),
        Side::Peer => {
            let file = sequence.observations_file();
            (peer::command(&options.peer, &file, sequence.size, scratch), Some(options.peer_timeout))
        }
    };
    let limits = Limits { wall: limit, stop };
    let (answer, usage) = match child::run(&mut command, &limits, scratch) {
        Err(error) => (Err(format!("cannot run {}: {error}", command.get_program().display())), Usage::default()),
        Ok(outcome) => {
            let answer = match outcome.ended {
                Ended::Stopped => return None,
                Ended::TimedOut => Err(format!("ended after {} s, its limit", options.peer_timeout.as_secs_f64())),
                Ended::Exited(status) => match side {
                    Side::Scpsfm => ours::answer(sequence, scratch, status, &outcome.complaint),
                    Side::Peer => peer::answer(sequence, scratch, status, &outcome.complaint),
                },
            };
            (answer, outcome.usage)
        }
    };
    let (scores, failure) = match answer {
        Ok(answer) => (Some(Scores::of(sequence, &answer)), None),
        Err(reason) => (None, Some(reason)),
    };
    Some(Row {
        sequence: sequence.name.clone(),
        side,
        views: sequence.views(),
        observations: sequence.inlier.len(),
        cameras_estimated: sequence.cameras_estimated,
        failure,
        scores,
        usage,
    })
}
