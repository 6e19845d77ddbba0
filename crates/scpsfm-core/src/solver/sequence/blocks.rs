//! The blocks that a reconstruction may begin with: they are searched, calibrated, and extended from there.

use super::ended::{Ended, finished, metric_of};
use super::extended::{Extended, extend};
use super::starts::extend_projectively;
use crate::solver::attempt::{self, Attempt, better};
use crate::solver::error::Error;
use crate::solver::portfolio::Effort;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;
use crate::solver::view_selection;

/// Sets of views that a reconstruction may begin with, best first.
pub struct Blocks {
    pub sets: Vec<Vec<usize>>,
    /// Whether it is the one of [`view_selection::whole`].
    pub is_whole: bool,
}

impl Blocks {
    pub fn of(problem: &Problem) -> Self {
        Self { sets: view_selection::candidate_views(problem), is_whole: view_selection::whole(problem).is_some() }
    }

    /// Whether the first search does not try everything. In the one block of a whole input depths decide in the first
    /// round or take all of them. Other blocks are several, of which another may do.
    pub fn begin_quickly(&self, problem: &Problem) -> bool {
        !(self.is_whole && problem.input.has_depths())
    }

    /// Calibrates the blocks and extends them from there; with it, whether nothing else needs to be tried.
    pub fn by_calibration(
        &self,
        problem: &Problem,
        is_quick: bool,
        recorder: &mut Recorder,
    ) -> Result<(Ended, bool), Error> {
        let ended = if self.is_whole {
            let attempt = of_whole(problem, &self.sets[0], is_quick, recorder)?;
            // A second search, which tries everything, has the last word. With depths there is one only, and subsets
            // follow.
            let is_last = !is_quick && !problem.input.has_depths() && attempt.projective.is_some();
            if is_last || attempt.is_trusted() || attempt.is_beyond_image_points() {
                return Ok((finished(problem, attempt, recorder)?, true));
            }
            match attempt.is_calibrated() {
                true => metric_of(problem, attempt, recorder)?,
                false => Ended::Block(Some(Box::new(attempt))),
            }
        } else {
            by_calibrated_blocks(problem, &self.sets, Effort { is_seed: true, is_quick }, recorder)?
        };
        let is_settled = matches!(&ended, Ended::Extended(extended) if extended.is_settled(problem));
        Ok((ended, is_settled))
    }
}

/// The whole input as one block, with the views that its search left aside, and the tracks that depths did not verify.
fn of_whole(problem: &Problem, views: &[usize], is_quick: bool, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let effort = Effort { is_quick, is_seed: false };
    let mut attempt = attempt::search_block(problem, problem.block(views), effort, recorder)?;
    if views.len() < problem.observed_views().len() || !attempt.judges_observations() {
        extend_projectively(problem, &mut attempt, true, recorder)?;
    }
    attempt::calibrate(problem, &mut attempt, recorder)?;
    Ok(attempt)
}

/// Blocks that are calibrated and extended from there.
fn by_calibrated_blocks(
    problem: &Problem,
    candidates: &[Vec<usize>],
    effort: Effort,
    recorder: &mut Recorder,
) -> Result<Ended, Error> {
    let mut best: Option<Extended> = None;
    let mut unextended: Option<Attempt> = None;
    recorder.expect_extension();
    for (k, views) in candidates.iter().enumerate() {
        problem.stopped()?;
        recorder.begin_block(k, candidates.len());
        let attempt = attempt::solve_block(problem, problem.block(views), effort, recorder)?;
        if attempt.is_good() {
            let extended = extend(problem, attempt, recorder)?;
            if !extended.stands() {
                unextended = better(unextended, extended.seed);
                continue;
            }
            let enough = extended.is_calibrated(problem) && extended.holds_most_views();
            if best.as_ref().is_none_or(|best| extended.merit(problem) > best.merit(problem)) {
                best = Some(extended);
            }
            if enough {
                break;
            }
        } else {
            unextended = better(unextended, attempt);
        }
    }
    if let Some(best) = best {
        return Ok(Ended::Extended(Box::new(best)));
    }
    match unextended {
        Some(seed) => metric_of(problem, seed, recorder),
        None => Ok(Ended::Block(None)),
    }
}
