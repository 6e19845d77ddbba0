//! From blocks of complete tracks to a reconstruction of all views.
//!
//! Tracks of real sequences live a few views, and a right track may hold wrong observations: no block of complete
//! tracks holds them all. A block that was searched is the seed. Where it is calibrated, view after view is resected
//! against the points that stand ([`register`], [`growth`]), its tracks are triangulated ([`structure`]), and bundle
//! adjustment with the calibration free keeps the whole straight ([`adjust`]); where it is not, the same is done
//! without a calibration ([`projective_growth`]), and the whole is calibrated then. Where no block leads to most views,
//! three that share tracks in pairs are the seed ([`triplets`]). Views that share too few tracks with it become
//! [`components`] of their own under the same calibration, and are merged where all that they share tells how
//! ([`merging`]). What the whole says of the calibration is graded anew ([`calibrate`]) and checked between its
//! [`windows`].
//!
//! Which seeds are tried: [`quick_pass`] has the order, [`blocks`] those that are calibrated first, [`starts`] those
//! that are extended without a calibration; [`lens`] has all of it done again behind sampled lenses. [`extended`] is
//! the metric extension of one seed, [`ended`] the answer that is kept.

mod adjust;
mod blocks;
mod calibrate;
mod calibrated_views;
mod components;
mod ended;
mod extended;
mod growth;
mod lens;
mod merging;
mod model;
mod options;
mod own_focals;
mod projective_growth;
mod quick_pass;
mod register;
mod starts;
mod structure;
mod triplets;
mod windows;

pub use ended::Ended;
pub use merging::MergingOptions;
pub use options::{ExtensionOptions, GrowthOptions};
pub use quick_pass::reconstruct_quickly;
pub use structure::widest_angle;

use super::error::Error;
use super::problem::Problem;
use super::recorder::Recorder;
use quick_pass::QuickPass;

/// Solves an input, and once more from a lower noise where structures may be mixed, see [`Ended::may_be_mixed`]: there
/// they are told apart. The answer that is worth more is kept.
pub fn solve(problem: &mut Problem, recorder: &mut Recorder) -> Result<Ended, Error> {
    let ended = solve_from_noise(problem, recorder)?;
    if !ended.may_be_mixed(problem) {
        return Ok(ended);
    }
    recorder.begin_again();
    let assumed = problem.initial_noise;
    let (worth, undone) = (ended.worth(problem), problem.undone.take());
    problem.initial_noise = ExtensionOptions::DEFAULT.lower_noise * assumed;
    let again = solve_from_noise(problem, recorder)?;
    problem.initial_noise = assumed;
    if again.worth(problem) > worth {
        return Ok(again);
    }
    problem.undone = undone;
    Ok(ended)
}

/// Solves an input from the assumed noise. Where pinholes give no calibration of most views, solves it once more with the
/// lenses undone that explain seeds better, before anything else is tried of pinholes, and where that calibrates a part,
/// with the lenses undone that were calibrated; what is undone stays so in the problem where that answer stands.
fn solve_from_noise(problem: &mut Problem, recorder: &mut Recorder) -> Result<Ended, Error> {
    let quick = QuickPass::new(problem, recorder)?;
    let mut behind = None;
    // An extension to most views shows how much pinholes explain, which what else there is to try hardly changes.
    let lenses_first = quick.ended.asks_for_lens(problem) && quick.ended.holds_most_views();
    if lenses_first {
        behind = lens::solve_behind(problem, &quick.ended, recorder)?;
        let replaces = |found: &Ended| found.holds_most_views() && lens::replaces(found, &quick.ended, problem);
        if let Some((found, undone)) = behind.take_if(|(found, _)| replaces(found)) {
            problem.undone = undone;
            return Ok(found);
        }
        recorder.begin_again();
    }
    let ended = quick.finish(problem, recorder)?;
    if !ended.asks_for_lens(problem) {
        return Ok(ended);
    }
    if !lenses_first {
        behind = lens::solve_behind(problem, &ended, recorder)?;
    }
    let Some((found, undone)) = behind.filter(|(found, _)| lens::replaces(found, &ended, problem)) else {
        return Ok(ended);
    };
    problem.undone = undone;
    Ok(found)
}
