//! What the whole sequence says of the calibration.

use nalgebra::Vector4;

use super::adjust::{self, Part};
use super::model::{Model, Scene};
use super::windows;
use crate::geometry::Camera;
use crate::geometry::bundle::metric::Reconstruction;
use crate::solver::calibration::{self, Outcome};
use crate::solver::{Context, Error, attempt};

/// Observations that a calibration is made from, and of one view at least and at most: other errors than noise bound
/// what more of them would give.
const OBSERVATIONS: usize = 6_000;
const OF_VIEW: (usize, usize) = (50, 300);
/// Squared standard deviations of the core within which an observation takes part: squares know no tails. The .999
/// quantile of two coordinates.
const CORE_SQUARED: f64 = 13.8;
/// Observations that a track must keep to take part.
const LEAST_KEPT: usize = 3;

/// Calibrates from the landmarks and observations that fit best, takes the calibration over into the model, adjusts
/// everything under it and asks the windows.
pub fn calibrate(scene: &Scene, model: &mut Model, context: &Context) -> Result<Outcome, Error> {
    let views = model.registered();
    let of_view = (OBSERVATIONS / views.len().max(1)).clamp(OF_VIEW.0, OF_VIEW.1);
    let part = core(scene, model, &views, of_view);
    let (cameras, points) = projective(&part.reconstruction);
    let problem = calibration::Problem {
        cameras: &cameras,
        points: &points,
        observations: &part.observations,
        noise: model.noise,
        focal_prior: attempt::focal_prior(views.iter().map(|&view| &context.input.views()[view])),
        focal_per_view: false,
    };
    let mut outcome = calibration::from_metric(&problem, &part.reconstruction, context.scale_px, context.stop)?;
    if let Some(metric) = &outcome.metric {
        let found = Part { reconstruction: metric.clone(), ..part };
        found.write_back(model);
        model.free = outcome.model;
        super::structure::triangulate(scene, model);
        adjust::all(scene, model);
        windows::reconcile(scene, model, context, &mut outcome)?;
    }
    Ok(outcome)
}

/// The cameras and points of a metric reconstruction without what makes it metric.
pub fn projective(metric: &Reconstruction) -> (Vec<Camera>, Vec<Vector4<f64>>) {
    let cameras = metric.poses.iter().map(|pose| pose.camera(&metric.intrinsics)).collect();
    (cameras, metric.points.iter().map(|point| point.push(1.0)).collect())
}

/// Landmarks that give every one of these registered views `of_view` observations, with the observations that the core
/// of the noise explains.
pub fn core(scene: &Scene, model: &Model, views: &[usize], of_view: usize) -> Part {
    let tracks = adjust::covering(scene, model, views, of_view);
    let mut part = Part::new(scene, model, views, &tracks);
    let limit = CORE_SQUARED * model.noise * model.noise;
    let fits: Vec<bool> =
        part.observations.iter().map(|seen| part.reconstruction.residual(seen).norm_squared() < limit).collect();
    let mut kept = vec![0usize; part.tracks.len()];
    for (seen, fits) in part.observations.iter().zip(&fits) {
        kept[seen.point] += usize::from(*fits);
    }
    let mut fits = fits.into_iter();
    part.observations.retain(|seen| fits.next().unwrap_or(false) && kept[seen.point] >= LEAST_KEPT);
    part
}
