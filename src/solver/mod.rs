//! The estimator: from an input to a solution. Stages, priors, hypothesis search, growing, calibration and grading.
//!
//! Depends on `network`, `geometry` and `domain`; knows nothing of jobs, transport or files.
//!
//! The way through: [`block`] chooses views whose tracks are complete; [`attempt`] solves one such block, by
//! [`portfolio`] (priors, [`search`], [`grow`]) or [`direct`], and [`calibration`] upgrades it; [`judge`] has the last
//! word on every track and observation; [`assemble`] writes it down.

mod agreement;
mod assemble;
mod attempt;
mod block;
pub mod calibration;
mod direct;
mod grow;
mod judge;
mod portfolio;
mod priors;
mod recorder;
mod search;
#[cfg(test)]
mod tests;

use crate::domain::{Input, Observer, Solution, SolveSettings, StopReason, StopToken, Warning, WarningCode};
use attempt::Attempt;
use recorder::Recorder;

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
/// Solves one block of views over which tracks are complete; views outside it are left out with a warning. Where a
/// block's calibration does not hold, the next best block is tried and the best result returned; blocks that disagree
/// raise its uncertainty.
///
/// # Errors
/// [`Error::Stopped`] when `stop` fired, [`Error::Internal`] for a defect.
pub fn solve(
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    let mut recorder = Recorder::new(observer);
    let ranges = block::track_ranges(input);
    let (normalization, warnings) = block::normalization(input);
    let candidates = block::candidate_views(input, &ranges);
    let mut best: Option<Attempt> = None;
    let mut others = Vec::new();
    for (k, views) in candidates.iter().enumerate() {
        stopped(stop)?;
        recorder.begin_block(k, candidates.len());
        let block = block::extract(input, &ranges, &normalization, views);
        let attempt =
            attempt::solve_block(block, input.track_count(), settings, normalization.scale_px, &mut recorder, stop)?;
        if best.as_ref().is_none_or(|best| attempt.merit() > best.merit()) {
            others.extend(best.replace(attempt));
        } else {
            others.push(attempt);
        }
        // A good block is still asked for a second opinion.
        if k > 0 && best.as_ref().is_some_and(Attempt::is_good) {
            break;
        }
    }
    stopped(stop)?;
    if let Some(best) = &mut best {
        agreement::reconcile(best, &others);
    }
    Ok(match best {
        Some(attempt) if attempt.consensus.is_some() => {
            let solution =
                assemble::solved(input, settings, &ranges, &normalization, attempt, warnings, recorder, stop);
            stopped(stop)?;
            solution
        }
        best => {
            let mut warnings = warnings;
            warnings.push(why_unsolved(input, best.as_ref()));
            assemble::unsolved(input, settings, best.as_ref(), warnings, recorder)
        }
    })
}

fn why_unsolved(input: &Input, best: Option<&Attempt>) -> Warning {
    match best {
        None if input.view_count() < block::LEAST_VIEWS => Warning::new(
            WarningCode::NoConsensus,
            format!("{} views given; a reconstruction needs at least {}", input.view_count(), block::LEAST_VIEWS),
        ),
        None => Warning::new(
            WarningCode::FewInliers,
            format!(
                "no {} views share enough tracks: at least {} must be seen in all of them",
                block::LEAST_VIEWS,
                block::LEAST_TRACKS
            ),
        ),
        Some(attempt) => Warning::new(
            WarningCode::NoConsensus,
            format!(
                "among the {} tracks complete over {} views no {} or more agree on one geometry more than by chance",
                attempt.block.tracks.len(),
                attempt.block.views.len(),
                portfolio::LEAST_INLIERS
            ),
        ),
    }
}

/// `Err` once the token asks for a stop.
fn stopped(stop: &StopToken) -> Result<(), Error> {
    stop.reason().map_or(Ok(()), |reason| Err(Error::Stopped(reason)))
}
