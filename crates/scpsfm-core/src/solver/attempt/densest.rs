//! The methods without search (PAPER, SCPSFM and PSFM) on the densest blocks of views.

use super::{Attempt, solve_block};
use crate::solver::error::Error;
use crate::solver::fusion::{self, Estimate};
use crate::solver::portfolio::Effort;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;
use crate::solver::view_selection;

/// Solves the densest blocks of views, one at least and until one is METRIC; the best of them. Blocks that disagree
/// raise its uncertainty; other views are left out.
pub fn solve_densest(problem: &Problem, recorder: &mut Recorder) -> Result<Option<Attempt>, Error> {
    let candidates = view_selection::candidate_views(problem);
    let mut attempts: Vec<Attempt> = Vec::new();
    for (k, views) in candidates.iter().enumerate() {
        problem.stopped()?;
        recorder.begin_block(k, candidates.len());
        attempts.push(solve_block(problem, problem.block(views), Effort::default(), &[], recorder)?);
        // A good block is still checked against a second one.
        if k > 0 && attempts.iter().any(Attempt::is_good) {
            break;
        }
    }
    let estimates: Vec<Estimate> = attempts.iter().filter_map(Attempt::estimate).collect();
    let mut best = attempts.into_iter().reduce(|best, other| if other.merit() > best.merit() { other } else { best });
    if let Some(outcome) = best.as_mut().and_then(|best| best.calibration.as_mut()) {
        fusion::admit_misfit(outcome, &estimates, &problem.calibration_options.grades);
    }
    Ok(best)
}
