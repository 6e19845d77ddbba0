//! The estimator: from an input to a solution. Stages, priors, hypothesis search, growing, calibration and grading.
//!
//! Depends on `network`, `geometry` and `domain`; knows nothing of jobs, transport or files.

pub mod calibration;

use crate::domain::{Input, Observer, Solution, SolveSettings, StopReason, StopToken};

/// Why a solve ended without a solution. A scene that cannot be solved is a solution, not an error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// The stop token asked for it.
    #[error("stopped before a result stood: {0:?}")]
    Stopped(StopReason),
    /// A defect of ours, not of the input.
    #[error("internal solver error: {0}")]
    Internal(String),
}

/// Solves one input.
///
/// Single-threaded and deterministic: the same input, settings and build give the same solution, but for times.
/// `observer` is told of every iteration; `stop` is asked at least every 50 ms or network iteration.
///
/// # Errors
/// [`Error::Stopped`] when `stop` fired, [`Error::Internal`] for a defect.
pub fn solve(
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    let _ = (input, settings, observer, stop);
    Err(Error::Internal("the solver is not built yet".into()))
}
