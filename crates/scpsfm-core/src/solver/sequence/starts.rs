//! Seeds that are extended to all views without a calibration, and calibrated then.

use super::ended::attempt_worth;
use super::options::{ExtensionOptions, GrowthOptions};
use super::projective_growth;
use super::triplets::Pairs;
use crate::domain::Stage;
use crate::solver::attempt::{self, Attempt};
use crate::solver::consensus::LEAST_INLIERS;
use crate::solver::error::Error;
use crate::solver::learned::TrackScoreOptions;
use crate::solver::portfolio::Effort;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;
use crate::solver::view_selection::SeedViews;

/// How subsets are searched, of which many are tried.
pub const QUICK_SEED: Effort = Effort { is_seed: true, is_quick: true };

/// The best of one that stands and of these: what was found already, and what a quick search of these views finds,
/// each extended to all views without a calibration and calibrated then; the first that is METRIC. Ends where several
/// of them lead to the same one.
///
/// * `found`: with whether it stands as it is where its extension leaves too little
pub fn by_projective_extension(
    problem: &Problem,
    best: Option<Attempt>,
    mut found: Option<(Attempt, bool)>,
    views: &[SeedViews],
    recorder: &mut Recorder,
) -> Result<Option<Attempt>, Error> {
    let (mut best, mut unsolved) = if stands(&best) { (best, None) } else { (None, best) };
    let mut pairs = Pairs::new(problem);
    let options = ExtensionOptions::DEFAULT;
    let first = usize::from(found.is_some());
    let (count, mut repeated) = (first + views.len(), 0);
    for k in 0..count {
        problem.stopped()?;
        let (mut attempt, keeps) = match found.take() {
            Some(found) => found,
            None => {
                recorder.begin_block(k, count);
                (pairs.search(&views[k - first], QUICK_SEED, recorder)?, false)
            }
        };
        extend_projectively(problem, &mut attempt, keeps, recorder)?;
        if attempt.projective.is_none() {
            unsolved = unsolved.or(Some(attempt));
            continue;
        }
        // The same one, reached from elsewhere, or a part of it: calibrating takes longer than all else.
        let grown = best.as_ref().map_or(f64::INFINITY, |best| attempt.evidence(problem) / best.evidence(problem));
        let is_part = |best: &Attempt| attempt.views().iter().all(|view| best.views().binary_search(view).is_ok());
        if grown < options.least_evidence_growth && best.as_ref().is_some_and(is_part) {
            repeated += usize::from(grown * options.least_evidence_growth > 1.0);
            if repeated == options.enough_repeated {
                break;
            }
            continue;
        }
        if best.as_ref().is_some_and(|best| outweighs(best, &attempt)) {
            continue;
        }
        attempt::calibrate(problem, &mut attempt, recorder)?;
        if best.as_ref().is_none_or(|best| {
            outweighs(&attempt, best) || attempt_worth(&attempt, problem) > attempt_worth(best, problem)
        }) {
            (best, repeated) = (Some(attempt), 0);
        }
        if best.as_ref().is_some_and(Attempt::is_good) {
            break;
        }
    }
    Ok(best.or(unsolved))
}

/// Whether an attempt is verified by depths, and worth more than another that is not, see [`Attempt::outweighs`].
fn outweighs(attempt: &Attempt, other: &Attempt) -> bool {
    let of_other = other.projective.as_ref().filter(|_| !other.is_by_depths());
    of_other.is_some_and(|other| attempt.outweighs(&other.views, other.noise))
}

/// Extends what an attempt has found to all views and tracks, as far as image points verify it by themselves.
///
/// * `keeps`: whether what was found stands where that leaves too little, else nothing does; what depths verify stands
///   in any case, and where it outweighs the extension, see [`Attempt::outweighs`]
pub fn extend_projectively(
    problem: &Problem,
    attempt: &mut Attempt,
    keeps: bool,
    recorder: &mut Recorder,
) -> Result<(), Error> {
    if attempt.is_beyond_image_points() {
        return Ok(());
    }
    let Some(start) = attempt.projective.take() else { return Ok(()) };
    recorder.enter(Stage::Extend);
    let by_depths = !attempt.judges_observations();
    // Of few tracks that depths have verified one more may agree by chance.
    let least = if by_depths { TrackScoreOptions::DEFAULT.surely_enough } else { LEAST_INLIERS };
    let before = (keeps || by_depths).then(|| start.clone());
    let mut options = GrowthOptions::PROJECTIVE;
    if keeps && start.views.len() < problem.observed_views().len() {
        // The complete tracks of a whole input have their points: views that join give none and move none.
        options = GrowthOptions { gives_points: false, adjust_growth: f64::INFINITY, final_rounds: 1, ..options };
    }
    let extended = projective_growth::extend(problem, start, &options, recorder)?;
    let is_enough = extended.is_off_lines() && extended.tracks.len() >= least;
    attempt.projective = before;
    if is_enough && !attempt.outweighs(&extended.views, extended.noise) {
        attempt.projective = Some(extended);
        attempt.verified_by_image_points();
    } else if attempt.projective.is_none() {
        // The reason is that of an attempt without a consensus.
        attempt.found.consensus = None;
    }
    Ok(())
}

/// Whether there is a reconstruction.
pub fn stands(attempt: &Option<Attempt>) -> bool {
    attempt.as_ref().is_some_and(|attempt| attempt.projective.is_some())
}
