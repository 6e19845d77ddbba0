//! From a calibrated block of views to the whole sequence.
//!
//! Tracks of real sequences live a few views: no block of complete tracks holds them all. A block that was solved is the
//! seed; view after view is resected against the points that stand ([`register`]), its tracks are triangulated
//! ([`structure`]), and bundle adjustment with the calibration free keeps the whole straight ([`adjust`]). What the
//! whole says of the calibration is graded anew ([`calibrate`]) and checked between its [`windows`], and every track and observation is judged by it
//! ([`assemble`]).

mod adjust;
mod assemble;
mod calibrate;
mod model;
mod register;
mod structure;
mod windows;

pub use assemble::solved;

use super::attempt::Attempt;
use super::calibration::Outcome;
use super::recorder::Recorder;
use super::{Context, Error};
use crate::domain::{Grade, Method, Stage};
use model::{Model, Scene};

/// Rounds of adjusting everything and triangulating it anew that end an extension; the third moves nothing that a
/// gate would see.
const FINAL_ROUNDS: usize = 3;

/// A sequence that stands.
pub struct Extended<'a> {
    scene: Scene<'a>,
    model: Model,
    pub calibration: Outcome,
    /// Views that could not be registered, with the reason.
    unregistered: Vec<register::Unregistered>,
}

/// Whether an input is one that is extended beyond a block.
pub fn applies(context: &Context) -> bool {
    matches!(context.settings.method, Method::Auto | Method::Geometry)
        && !context.settings.focal_per_view
        && !context.input.has_depths()
        && super::block::complete_views(context.input, context.ranges).is_none()
}

/// Extends a block to every view that can be registered; `None` where the block is not metric or nothing stands beyond
/// it.
///
/// # Errors
/// [`Error::Stopped`].
pub fn extend<'a>(
    seed: &Attempt,
    context: &Context<'a>,
    recorder: &mut Recorder,
) -> Result<Option<Extended<'a>>, Error> {
    let Some(metric) = seed.calibration.as_ref().and_then(|calibration| calibration.metric.as_ref()) else {
        return Ok(None);
    };
    let Some(consensus) = &seed.consensus else { return Ok(None) };
    recorder.enter(Stage::Extend);
    let scene = Scene::new(context);
    let mut model = Model::new(&scene, &seed.block.views, metric, consensus.noise);
    structure::triangulate(&scene, &mut model);
    let unregistered = register::all(&scene, &mut model, recorder)?;
    for _ in 0..FINAL_ROUNDS {
        context.stopped()?;
        adjust::all(&scene, &mut model);
        structure::triangulate(&scene, &mut model);
    }
    context.stopped()?;
    recorder.enter(Stage::Calibrate);
    let calibration = calibrate::calibrate(&scene, &mut model, context)?;
    context.stopped()?;
    let stands = model.registered().len() >= seed.block.views.len() && calibration.metric.is_some();
    Ok(stands.then_some(Extended { scene, model, calibration, unregistered }))
}

impl Extended<'_> {
    /// Whether this says more than the block that it began from.
    pub fn improves_on(&self, seed: &Attempt) -> bool {
        let usable = |grade: Grade| grade != Grade::ProjectiveOnly;
        let seed_usable = seed.calibration.as_ref().is_some_and(|calibration| usable(calibration.grade));
        self.model.registered().len() > seed.block.views.len() || usable(self.calibration.grade) || !seed_usable
    }
}
