//! The calibration of some views of a sequence, and what of it goes back into the model.

use nalgebra::Vector3;

use super::adjust::{self, Extract};
use super::model::Model;
use super::options::StretchOptions;
use crate::domain::{FocalPrior, VERIFIED, Warning, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, MetricReconstruction};
use crate::geometry::{Camera, Point};
use crate::solver::calibration::{self, Outcome, Uncalibrated};
use crate::solver::consensus::LEAST_VIEWS;
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

const OPTIONS: StretchOptions = StretchOptions::DEFAULT;
/// How far off their common centre cameras begin, and how near points at infinity do: their product moves an image by a
/// ten-thousandth of its side, a fifth of a pixel of 2,000, which noise covers.
const OFF_CENTRE: f64 = 0.01;

/// The calibrations of the cameras of some views, with what they are made from.
///
/// * `stretch`: some of the views, of the same cameras, where they are many
/// * `heartbeat`: as of [`Uncalibrated`]
pub fn calibrate_views(
    problem: &Problem,
    model: &Model,
    views: &[usize],
    stretch: Option<&[usize]>,
    heartbeat: &dyn Fn(),
) -> Result<(Extract, Vec<(usize, Outcome)>), Error> {
    let block = |views: &[usize]| {
        let extract = core(problem, model, views, observations_per_view(views));
        let (metric, of_group) = extract.block(problem);
        (extract, projective(&metric), metric, of_group)
    };
    let (extract, (cameras, points), metric, of_group) = block(views);
    let focal_priors: Vec<Option<FocalPrior>> = of_group.iter().map(|&camera| problem.focal_priors[camera]).collect();
    let (observations, group_of) = (&extract.observations, &metric.group_of);
    let to_calibrate =
        problem.uncalibrated((&cameras, &points), observations, model.noise, group_of, &focal_priors, heartbeat);
    let stretch = stretch.map(block);
    let stretch = stretch.as_ref().map(|(extract, (cameras, points), metric, _)| calibration::Stretch {
        problem: Uncalibrated {
            cameras,
            points,
            observations: &extract.observations,
            group_of: &metric.group_of,
            ..to_calibrate
        },
        metric,
    });
    let outcomes = calibration::from_metric(&to_calibrate, &metric, stretch)?;
    Ok((extract, of_group.into_iter().zip(outcomes).collect()))
}

/// Has the model go on from the calibrations of the cameras of some views: their lenses, and where these are all views
/// that are registered, the rest too.
pub fn take_over(model: &mut Model, extract: &mut Extract, found: &[(usize, Outcome)]) {
    for (camera, outcome) in found {
        let Some(intrinsics) = outcome.intrinsics() else { return };
        let lens = &mut model.lenses[*camera];
        lens.free = outcome.model;
        // What the model holds is as the calibration has it, not as the seed had it.
        lens.intrinsics = Intrinsics { focal: lens.intrinsics.focal, ..intrinsics };
        extract.sequence.intrinsics[*camera] = intrinsics;
    }
    let Some(metric) = found.first().and_then(|(_, outcome)| outcome.metric.as_ref()) else { return };
    // Some of the views alone would leave the frame of the others.
    if extract.views.len() == model.registered().len() {
        extract.sequence.focals.clone_from(&metric.focals);
        (extract.sequence.poses, extract.sequence.points) = (metric.poses.clone(), metric.points.clone());
        extract.write_back(model);
    }
}

/// Observations of each of these views that a calibration is made from.
fn observations_per_view(views: &[usize]) -> usize {
    (OPTIONS.observations / views.len()).clamp(OPTIONS.of_view.0, OPTIONS.of_view.1)
}

/// The cameras and points of a metric reconstruction without what makes it metric.
pub fn projective(metric: &MetricReconstruction) -> (Vec<Camera>, Vec<Point>) {
    let mut cameras = metric.cameras();
    if metric.has_common_centre {
        // At one centre the cost is stationary in what parallax would need, a minimum or not: off it, it shows.
        let aside = |view: usize| Vector3::new(view as f64, 2.0 * view as f64, 3.0 * view as f64).map(f64::sin);
        cameras.iter_mut().enumerate().for_each(|(view, camera)| camera.set_column(3, &(aside(view) * OFF_CENTRE)));
    }
    let nearness = |point: usize| if metric.has_common_centre { OFF_CENTRE * (point as f64).cos() } else { 1.0 };
    let points = metric.points.iter().enumerate().map(|(k, point)| point.push(nearness(k))).collect();
    (cameras, points)
}

/// Landmarks that give every one of these registered views `of_view` observations, with the observations that the core
/// of the noise explains.
pub fn core(problem: &Problem, model: &Model, views: &[usize], of_view: usize) -> Extract {
    let tracks = adjust::covering(problem, model, views, of_view);
    let mut extract = Extract::new(problem, model, views, &tracks);
    let limit = OPTIONS.core_squared * model.noise * model.noise;
    let fits: Vec<bool> =
        extract.observations.iter().map(|seen| extract.sequence.weighted_squared(seen) < limit).collect();
    let mut kept = vec![0usize; extract.tracks.len()];
    for (seen, fits) in extract.observations.iter().zip(&fits) {
        kept[seen.point] += usize::from(*fits);
    }
    let mut fits = fits.into_iter();
    extract.observations.retain(|seen| fits.next().unwrap_or(false) && kept[seen.point] >= VERIFIED);
    extract
}

/// Reports the points and the focal length, a mean where views have their own, of the first camera with registered
/// views.
pub fn report_found(problem: &Problem, model: &Model, recorder: &mut Recorder) {
    let mut views = model.registered();
    let first = views.first().map(|&view| problem.camera_of[view]);
    let focal = first.map(|camera| {
        views.retain(|&view| problem.camera_of[view] == camera);
        model.log_focal(camera, &views).exp() * problem.scale_px
    });
    recorder.found(adjust::verified(model).len(), focal.filter(|focal| focal.is_finite()));
}

/// What is said of a camera of which fewer views are registered than a calibration needs.
pub fn too_few(views: usize) -> Outcome {
    let detail = format!("only {views} views are registered; a calibration needs {}", LEAST_VIEWS);
    Outcome::refused(vec![Warning::new(WarningCode::UnobservableFocal, detail)])
}
