//! From a calibrated block to the whole sequence.
//!
//! Tracks of real sequences live a few views: no block of complete tracks holds them all. A block that was solved is
//! the seed; view after view is resected against the points that stand ([`register`]), its tracks are triangulated
//! ([`structure`]), and bundle adjustment with the calibration free keeps the whole straight ([`adjust`]). Views that
//! share no tracks with it become [`parts`] of their own under the same calibration. What the whole says of the
//! calibration is graded anew ([`calibrate`]) and checked between its [`windows`], and every track and observation is
//! judged by it ([`assemble`]).

mod adjust;
mod assemble;
mod calibrate;
mod model;
mod parts;
mod register;
mod structure;
mod windows;
mod zoom;

pub use assemble::solved;

use super::attempt::{self, Attempt};
use super::calibration::Outcome;
use super::grow::LEAST_INLIERS;
use super::recorder::Recorder;
use super::{Context, Error, block};
use crate::domain::{Grade, Method, Stage, Task, Warning, WarningCode};
use model::{Model, Scene};

/// Rounds of adjusting everything and triangulating it anew that end an extension; the third moves nothing that a
/// gate would see.
const FINAL_ROUNDS: usize = 3;
/// Share of an extension's time before its calibration that registering takes, the rounds the rest: .71 and .67 as
/// measured on 1,000 views with 350 and 87 observations a view.
pub const SHARE_OF_REGISTERING: f64 = 0.7;
/// Share of the views that an extension must register for no other seed to be tried: one that carries most of them is a
/// part of whatever another would lead to.
const ENOUGH_REGISTERED: f64 = 0.5;

/// A sequence that stands, with the block that it grew from.
pub struct Extended<'a> {
    seed: Attempt,
    scene: Scene<'a>,
    model: Model,
    /// One a camera of the scene.
    calibrations: Vec<Outcome>,
    /// Views that could not be registered, with the reason.
    unregistered: Vec<register::Unregistered>,
}

/// What came of a sequence.
pub enum Ended<'a> {
    Extended(Box<Extended<'a>>),
    /// Nothing stands beyond a block, if that: the best one that was tried.
    Block(Option<Box<Attempt>>),
}

/// Whether an input is one that is extended beyond a block.
pub fn applies(context: &Context) -> bool {
    matches!(context.settings.method, Method::Auto | Method::Geometry)
        && !context.input.has_depths()
        && block::complete_views(context.input, context.ranges).is_none()
}

/// Solves block after block until one carries an extension over most of the views; the best extension otherwise.
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn solve<'a>(
    candidates: &[Vec<usize>],
    context: &Context<'a>,
    recorder: &mut Recorder,
) -> Result<Ended<'a>, Error> {
    let seeding = Context { seeding: true, ..*context };
    let mut best: Option<Extended> = None;
    let mut unextended: Option<Attempt> = None;
    recorder.expect_extension();
    for (k, views) in candidates.iter().enumerate() {
        context.stopped()?;
        recorder.begin_block(k, candidates.len());
        let block = block::extract(context.input, context.ranges, context.normalization, views);
        let attempt = attempt::solve_block(block, &seeding, recorder)?;
        if attempt.is_good() {
            let extended = extend(attempt, &seeding, recorder)?;
            if !extended.stands() {
                unextended = better(unextended, extended.seed);
                continue;
            }
            let enough = extended.is_firm();
            if best.as_ref().is_none_or(|best| extended.merit() > best.merit()) {
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
        Some(seed) if seed.calibration.as_ref().is_some_and(|calibration| calibration.metric.is_some()) => {
            let extended = extend(seed, &seeding, recorder)?;
            Ok(if extended.stands() {
                Ended::Extended(Box::new(extended))
            } else {
                Ended::Block(Some(Box::new(extended.seed)))
            })
        }
        unextended => Ok(Ended::Block(unextended.map(Box::new))),
    }
}

/// The one of the two that has more merit, the first of equals.
fn better(best: Option<Attempt>, attempt: Attempt) -> Option<Attempt> {
    match best {
        Some(best) if best.merit() >= attempt.merit() => Some(best),
        _ => Some(attempt),
    }
}

/// Extends a block, which must be metric, to every view that can be registered.
fn extend<'a>(seed: Attempt, context: &Context<'a>, recorder: &mut Recorder) -> Result<Extended<'a>, Error> {
    recorder.begin_extension();
    recorder.enter(Stage::Extend);
    let scene = Scene::new(context);
    let mut model = parts::first(&scene, &seed, recorder);
    let mut trials = vec![register::Trial::default(); context.input.view_count()];
    register::join(&scene, &mut model, parts::FIRST, &mut trials, recorder)?;
    parts::others(&scene, &mut model, &seed, &mut trials, recorder)?;
    recorder.end_parts();
    for round in 0..FINAL_ROUNDS {
        context.stopped()?;
        let within = SHARE_OF_REGISTERING + (1.0 - SHARE_OF_REGISTERING) * round as f64 / FINAL_ROUNDS as f64;
        recorder.step(Task::Adjust, round + 1, FINAL_ROUNDS, within);
        adjust::all(&scene, &mut model, recorder);
        structure::triangulate(&scene, &mut model, recorder);
        for part in 0..=model.part_of.iter().copied().max().unwrap_or(parts::FIRST) {
            parts::drop_unsupported(&scene, &mut model, part, recorder);
        }
        recorder.tell(within);
    }
    context.stopped()?;
    recorder.enter(Stage::Calibrate);
    let mut calibrations = calibrate::calibrate(&scene, &mut model, context, recorder)?;
    if model.is_strained {
        calibrations.iter_mut().for_each(|outcome| refuse(outcome, &model, context));
    }
    context.stopped()?;
    parts::largest_first(&mut model);
    let unregistered = register::left(&scene, &model, &trials);
    Ok(Extended { seed, scene, model, calibrations, unregistered })
}

/// Takes back a calibration under which the sequence does not hold together.
fn refuse(outcome: &mut Outcome, model: &Model, context: &Context) {
    let detail = format!(
        "the views together fit much worse than the block that they were registered against: more than {:.2} px",
        model.noise * context.scale_px
    );
    outcome.warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
    outcome.grade = Grade::ProjectiveOnly;
}

impl Extended<'_> {
    /// The worst of the cameras that have enough registered views to be calibrated: a few photographs of another camera
    /// take nothing from the rest.
    fn grade(&self) -> Grade {
        let mut views = vec![0; self.scene.cameras];
        self.model.registered().into_iter().for_each(|view| views[self.scene.camera_of[view]] += 1);
        let grades = self.calibrations.iter().zip(views).filter(|(_, views)| *views >= block::LEAST_VIEWS);
        grades.map(|(outcome, _)| outcome.grade).reduce(Grade::worse).unwrap_or(Grade::ProjectiveOnly)
    }

    /// Larger is better: a calibration before none, then the number of views.
    fn merit(&self) -> (bool, usize) {
        (self.grade() != Grade::ProjectiveOnly, self.model.registered().len())
    }

    /// Whether there is anything that geometry verifies: views that points hold, and enough points.
    fn stands(&self) -> bool {
        self.model.registered().len() >= block::LEAST_VIEWS
            && adjust::verified(&self.model).len() >= LEAST_INLIERS
            && self.calibrations.iter().any(|outcome| outcome.metric.is_some())
    }

    /// Whether no other seed needs to be tried.
    fn is_firm(&self) -> bool {
        let (calibrated, registered) = self.merit();
        let views = registered + self.unregistered.len();
        calibrated && registered as f64 >= ENOUGH_REGISTERED * views as f64
    }
}
