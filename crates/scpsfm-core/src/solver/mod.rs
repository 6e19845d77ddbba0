//! The estimator: from an input to a solution. Stages, priors, hypothesis search, growing, calibration and grading.
//!
//! Depends on `network`, `geometry` and `domain`; knows nothing of jobs, transport or files.
//!
//! The way through: [`duplicates`] keeps one of equal tracks; [`problem`] is the input as all stages see it, in which
//! one track represents its [`near_duplicates`] until all are judged; [`view_selection`] chooses views whose tracks are
//! complete: all of them, or a few; [`attempt`] searches such a block, its [`static_tracks`] last, by [`portfolio`]
//! (proposals, [`search`], [`grow`] to a [`consensus`]; the [`track_sampling`] of many tracks searched, [`a_contrario`]
//! verifies, [`all_tracks`] join; [`depths`] where those verify what image points cannot), [`scpsfm`] or [`baselines`],
//! and [`calibration`] upgrades it. [`sequence`] tries blocks in order of cost and extends what stands to the other
//! views and tracks, projectively or metrically, observation by observation; [`assemble`] has [`classification`] judge
//! every track and observation by the [`noise_model`], has [`second_structures`] search what is left out, and writes it
//! down. A module depends on none that depends on it; what several need stands apart.

pub(crate) mod a_contrario;
mod all_tracks;
mod assemble;
mod attempt;
mod baselines;
pub(crate) mod block;
pub(crate) mod calibration;
mod classification;
pub(crate) mod consensus;
mod depths;
mod duplicates;
mod error;
mod fusion;
pub(crate) mod grow;
mod known_focal;
pub(crate) mod learned;
mod memory;
mod near_duplicates;
mod noise_model;
pub(crate) mod normalization;
mod per_track;
pub(crate) mod portfolio;
pub(crate) mod priors;
mod problem;
mod projective;
mod reconstruction;
mod recorder;
mod scpsfm;
pub(crate) mod search;
mod second_structures;
pub(crate) mod sequence;
pub(crate) mod spread;
mod static_tracks;
#[cfg(test)]
mod tests;
mod track_sampling;
mod view_selection;
mod views;

use crate::domain::duplicates::Duplicates;
use crate::domain::{Input, Observer, Sha256Digest, Solution, SolveSettings, StopToken};
use crate::parallel::Threads;
pub use error::Error;
pub use memory::estimated_bytes;
use problem::Problem;
use recorder::Recorder;
use sequence::Ended;

/// Solves one input on the caller's thread; see [`solve_on`].
///
/// # Errors
/// As [`solve_on`].
pub fn solve(
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    solve_on(Threads::ONE, input, settings, observer, stop)
}

/// Solves one input.
///
/// Deterministic: the same input, settings and build give the same solution, but for times, on any number of threads.
/// Further ones than the caller's help where a reconstruction is extended and tracks are judged.
/// `observer` is told of every iteration, but not of those that look for a second structure; `stop` is asked at least
/// every 50 ms or network iteration.
///
/// AUTO and GEOMETRY judge every observation by itself, but where depths alone verify, and extend a block to every view
/// that can be registered: all views at once where their tracks are complete and that decides quickly, else few of
/// them. By PAPER, SCPSFM and PSFM the best block is solved, and views outside it are left out with a warning.
///
/// Tracks that are [duplicates](Duplicates) of another count once, whatever the method.
///
/// # Errors
/// [`Error::Stopped`] when `stop` fired, [`Error::Internal`] for a defect.
pub fn solve_on(
    threads: Threads,
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    let mut solution = match Duplicates::of(input) {
        None => solve_views(threads, input, settings, observer, stop)?,
        Some(found) => duplicates::solve_once(input, &found, observer, |rest, observer| {
            solve_views(threads, rest, settings, observer, stop)
        })?,
    };
    views::complete(&mut solution, input);
    solution.input_content_sha256 = Some(input.to_raw().sha256());
    solution.joined_tracks = input.joined_tracks();
    solution.trained_network_sha256 = learned::may_be_asked(settings).then(trained_network_sha256);
    Ok(solution)
}

/// Of the trained network that AUTO asks in this process.
pub fn trained_network_sha256() -> Sha256Digest {
    crate::network::subspace::current_sha256()
}

/// The solution but for what [`views::complete`] says of the views.
fn solve_views(
    threads: Threads,
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    // The DAQ loss assumes constant intrinsics, so it is disabled when the focal length varies.
    let settings = &SolveSettings { use_daq: settings.use_daq && !settings.focal_per_view, ..settings.clone() };
    let mut problem = Problem::new(input, settings, threads, stop);
    let mut recorder = Recorder::new(observer, problem.observed_views().len());
    let ended = match problem.is_searched() {
        true => sequence::solve(&mut problem, &mut recorder)?,
        false => {
            let found = attempt::solve_densest(&problem, &mut recorder)?;
            found.map_or(Ended::Block(None), |attempt| Ended::of_block(&problem, attempt))
        }
    };
    problem.stopped()?;
    let solution = assemble::solution(ended, &problem, recorder)?;
    problem.stopped()?;
    Ok(solution)
}
