//! What comes of an input: a metric extension, or a block that has none.

use super::extended::{Extended, extend};
use super::options::ExtensionOptions;
use super::starts::extend_projectively;
use crate::domain::{Grade, Stage};
use crate::solver::attempt::{self, Attempt};
use crate::solver::calibration::Outcome;
use crate::solver::error::Error;
use crate::solver::noise_model;
use crate::solver::problem::Problem;
use crate::solver::reconstruction::Reconstruction;
use crate::solver::recorder::Recorder;

/// What came of an input.
pub enum Ended {
    Extended(Box<Extended>),
    /// A block, projective or not, that has no metric extension: the best one that was tried.
    Block(Option<Box<Attempt>>),
}

impl Ended {
    /// A block as the answer.
    pub fn of_block(problem: &Problem, mut attempt: Attempt) -> Self {
        doubt(problem, &mut attempt);
        Self::Block(Some(Box::new(attempt)))
    }

    /// Whether there is a reconstruction without a calibration of most views, which a lens may be missing from.
    pub fn asks_for_lens(&self, problem: &Problem) -> bool {
        if problem.input.has_depths() {
            return false;
        }
        match self {
            Ended::Extended(extended) => !extended.is_calibrated(problem) || !extended.holds_most_views(),
            Ended::Block(attempt) => attempt.as_ref().is_some_and(|attempt| {
                attempt.projective.is_some()
                    && attempt.judges_observations()
                    && (!attempt.is_calibrated() || attempt.leaves_most_views(problem))
            }),
        }
    }

    /// Whether it is an extension that holds most views, see [`Extended::holds_most_views`].
    pub fn holds_most_views(&self) -> bool {
        matches!(self, Ended::Extended(extended) if extended.holds_most_views())
    }

    /// The extension that carries the calibration; `None` where there is none. The calibration of a block takes an
    /// undone lens as exact; only an extension adjusts it in the images.
    pub fn calibrated_extension(&self, problem: &Problem) -> Option<&Extended> {
        match self {
            Ended::Extended(extended) => Some(&**extended).filter(|extended| extended.is_calibrated(problem)),
            Ended::Block(_) => None,
        }
    }

    /// Whether it fits only at a noise far above the assumed one, by image points alone, and has no METRIC calibration,
    /// which structures that were mixed would hardly agree on.
    pub fn may_be_mixed(&self, problem: &Problem) -> bool {
        let (noise, grade) = match self {
            Ended::Extended(extended) => (Some(extended.model.noise), Some(extended.grade(problem))),
            Ended::Block(attempt) => {
                let attempt = attempt.as_ref().filter(|attempt| attempt.judges_observations());
                let noise = attempt.and_then(|attempt| Some(attempt.projective.as_ref()?.noise));
                (noise, attempt.and_then(|attempt| Some(attempt.calibration.as_ref()?.grade)))
            }
        };
        grade != Some(Grade::Metric) && noise.is_some_and(|noise| noise_model::is_high(noise, problem.initial_noise))
    }

    /// How well the observations fit, see [`evidence`](crate::solver::noise_model::evidence).
    pub fn evidence(&self, problem: &Problem) -> f64 {
        match self {
            Ended::Extended(extended) => extended.evidence(problem),
            Ended::Block(attempt) => attempt.as_ref().map_or(0.0, |attempt| attempt.evidence(problem)),
        }
    }

    /// What it is worth, see [`worth`].
    pub fn worth(&self, problem: &Problem) -> f64 {
        match self {
            Ended::Extended(extended) => worth(extended.evidence(problem), extended.is_calibrated(problem)),
            Ended::Block(attempt) => attempt.as_ref().map_or(0.0, |attempt| attempt_worth(attempt, problem)),
        }
    }

    /// What it began from.
    pub fn seed(self) -> Option<Attempt> {
        match self {
            Ended::Extended(extended) => Some(extended.seed),
            Ended::Block(attempt) => attempt.map(|attempt| *attempt),
        }
    }
}

/// What an answer is worth beside others: its evidence, not below 0, and with a calibration
/// [`ExtensionOptions::worth_of_calibration`] times that.
fn worth(evidence: f64, is_calibrated: bool) -> f64 {
    let factor = if is_calibrated { ExtensionOptions::DEFAULT.worth_of_calibration } else { 1.0 };
    factor * evidence.max(0.0)
}

/// The same of an attempt.
pub fn attempt_worth(attempt: &Attempt, problem: &Problem) -> f64 {
    worth(attempt.evidence(problem), attempt.is_calibrated())
}

/// See [`Problem::doubt_implausible`].
fn doubt(problem: &Problem, attempt: &mut Attempt) {
    let Some(intrinsics) = attempt.calibration.as_ref().and_then(Outcome::intrinsics) else { return };
    let (_, cameras) = problem.cameras_of(attempt.views());
    if let Some(outcome) = &mut attempt.calibration
        && let Some(&camera) = cameras.get(outcome.group)
    {
        problem.doubt_implausible(outcome, &intrinsics, camera);
    }
}

/// Extends an attempt metrically where it has a metric reconstruction and that stands.
///
/// An attempt without a calibration has the focal length that happens to fit best, which other views may refute: its
/// extension stands only where it explains more than the projective reconstruction that it began from. One that depths
/// outweigh does not stand, whatever it says of the calibration.
pub fn metric_of(problem: &Problem, attempt: Attempt, recorder: &mut Recorder) -> Result<Ended, Error> {
    if !attempt.has_metric() || attempt.is_beyond_image_points() {
        return Ok(Ended::of_block(problem, attempt));
    }
    let was_calibrated = attempt.is_calibrated();
    let mut extended = extend(problem, attempt, recorder)?;
    if extended.seed.outweighs(&extended.model.registered(), extended.model.noise) {
        return Ok(Ended::of_block(problem, extended.seed));
    }
    let explains_more = || extended.evidence(problem) > extended.seed.evidence(problem);
    // One that takes a calibration back stands in any case: the seed would go on giving it.
    if extended.stands() && (was_calibrated || extended.is_calibrated(problem) || explains_more()) {
        extended.seed.verified_by_image_points();
        Ok(Ended::Extended(Box::new(extended)))
    } else {
        Ok(Ended::of_block(problem, extended.seed))
    }
}

/// An attempt on the whole input, extended where it leaves views aside, where several cameras or a lens that distorts
/// take part, where observations are not equally noisy, and where some are to be gained once each is judged by itself.
pub fn finished(problem: &Problem, mut attempt: Attempt, recorder: &mut Recorder) -> Result<Ended, Error> {
    let is_whole = attempt.views().len() == problem.observed_views().len();
    let is_one_pinhole = !attempt.has_lens() && problem.cameras_of(attempt.views()).1.len() == 1;
    let is_done = is_whole && is_one_pinhole && !problem.input.has_sigmas();
    if !attempt.judges_observations() {
        return Ok(Ended::Block(Some(Box::new(attempt))));
    }
    if is_done {
        doubt(problem, &mut attempt);
    }
    if let Some(found) = Reconstruction::of_attempt(problem, &attempt).filter(|_| is_done) {
        recorder.enter(Stage::Classify);
        let judged = found.judged(problem, &attempt, recorder);
        let retained: usize = attempt.block.tracks.iter().map(|&track| judged.retained[track].len()).sum();
        let known = attempt.projective.as_ref().map_or(0, |found| found.observations.len());
        if retained as f64 <= ExtensionOptions::DEFAULT.worth_extending * known as f64 {
            attempt.judged = Some(judged);
            return Ok(Ended::Block(Some(Box::new(attempt))));
        }
    }
    if !attempt.has_metric() {
        extend_projectively(problem, &mut attempt, true, recorder)?;
        attempt::calibrate(problem, &mut attempt, recorder)?;
    }
    metric_of(problem, attempt, recorder)
}
