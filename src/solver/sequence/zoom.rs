//! What a sequence says of its calibration where every view has a focal length of its own.

use super::adjust::Extract;
use super::calibrate;
use super::model::{Model, Scene};
use super::windows;
use crate::geometry::bundle::zoom::Zooming;
use crate::solver::agreement::Estimate;
use crate::solver::calibration::{self, Outcome, Problem};
use crate::solver::recorder::Recorder;
use crate::solver::{Context, Error};

/// The calibration of these views.
///
/// # Errors
/// [`Error::Stopped`].
pub fn of_camera(
    scene: &Scene,
    model: &mut Model,
    views: &[usize],
    context: &Context,
    recorder: &mut Recorder,
) -> Result<Outcome, Error> {
    let mut extract = calibrate::core(scene, model, views, calibrate::of_view(views));
    let outcome = of_extract(&extract, model.noise, |problem, zooming| {
        calibration::from_zooming(problem, zooming, context.scale_px, context.stop, &mut || recorder.sign_of_life())
    })?;
    // Some of the views alone would leave the frame of the others.
    if let (Some(metric), Some(focals)) = (&outcome.metric, &outcome.focals)
        && extract.views.len() == model.registered().len()
    {
        for (&view, &focal) in extract.views.iter().zip(focals) {
            extract.sequence.intrinsics[scene.lens_of[view]].focal = focal;
        }
        (extract.sequence.poses, extract.sequence.points) = (metric.poses.clone(), metric.points.clone());
        extract.write_back(model);
    }
    Ok(outcome)
}

/// What a window says by itself of the mean log focal length of the whole: that one, moved by as much as the window's
/// own views move where they are alone.
pub fn of_window(scene: &Scene, model: &Model, views: &[usize], whole: f64) -> Option<Estimate> {
    let extract = calibrate::core(scene, model, views, windows::OF_VIEW);
    let alone = of_extract(&extract, model.noise, |problem, zooming| {
        let (log_focal, sigma) = calibration::focals_alone(problem, zooming, scene.stop())?;
        Some((log_focal - zooming.mean_log_focal(), sigma))
    });
    alone.map(|(moved, sigma)| Estimate { log_focal: whole + moved, sigma })
}

/// Asks of an extract as of a problem of its own.
fn of_extract<T>(extract: &Extract, noise: f64, ask: impl FnOnce(&Problem, &Zooming) -> T) -> T {
    let (zooming, observations) = extract.zooming();
    let points: Vec<_> = zooming.points.iter().map(|point| point.push(1.0)).collect();
    let problem = Problem {
        cameras: &zooming.cameras(),
        points: &points,
        observations: &observations,
        noise,
        focal_prior: None,
        focal_per_view: true,
    };
    ask(&problem, &zooming)
}
