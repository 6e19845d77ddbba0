//! What the whole sequence says of the calibration.

use nalgebra::Vector4;

use super::adjust::{self, Part};
use super::model::{Model, Scene};
use crate::geometry::Camera;
use crate::solver::calibration::{self, Outcome};
use crate::solver::{Context, Error};

/// Observations that a calibration is made from, and of one view at least and at most: other errors than noise bound
/// what more of them would give.
const OBSERVATIONS: usize = 6_000;
const OF_VIEW: (usize, usize) = (50, 300);
/// Standard deviations of the core within which an observation takes part: squares know no tails. The .999 quantile of
/// two coordinates.
const CORE_SQUARED: f64 = 13.8;
/// Observations that a track must keep to take part.
const LEAST_KEPT: usize = 3;

/// Calibrates from the landmarks and observations that fit best, takes the calibration over into the model and adjusts
/// everything under it.
pub fn calibrate(scene: &Scene, model: &mut Model, context: &Context) -> Result<Outcome, Error> {
    let part = core(scene, model);
    let cameras: Vec<Camera> =
        part.reconstruction.poses.iter().map(|pose| pose.camera(&part.reconstruction.intrinsics)).collect();
    let points: Vec<Vector4<f64>> = part.reconstruction.points.iter().map(|point| point.push(1.0)).collect();
    let views = part.views.iter().map(|&view| &context.input.views()[view]);
    let problem = calibration::Problem {
        cameras: &cameras,
        points: &points,
        observations: &part.observations,
        noise: model.noise,
        focal_prior: crate::solver::attempt::focal_prior(views),
        focal_per_view: false,
    };
    let outcome = calibration::from_metric(&problem, &part.reconstruction, context.scale_px, context.stop)?;
    if let Some(metric) = &outcome.metric {
        let found = Part { reconstruction: metric.clone(), ..part };
        found.write_back(model);
        model.free = outcome.model;
        super::structure::triangulate(scene, model);
        adjust::all(scene, model);
    }
    Ok(outcome)
}

/// The landmarks that hold every view, with the observations that the core of the noise explains.
fn core(scene: &Scene, model: &Model) -> Part {
    let views = model.registered();
    let of_view = (OBSERVATIONS / views.len().max(1)).clamp(OF_VIEW.0, OF_VIEW.1);
    let tracks = adjust::covering(scene, model, of_view);
    let mut part = Part::new(scene, model, &views, &tracks);
    let limit = CORE_SQUARED * model.noise * model.noise;
    let fits: Vec<bool> =
        part.observations.iter().map(|seen| part.reconstruction.residual(seen).norm_squared() < limit).collect();
    let mut kept = vec![0usize; part.tracks.len()];
    for (seen, fits) in part.observations.iter().zip(&fits) {
        kept[seen.point] += usize::from(*fits);
    }
    let stays: Vec<bool> =
        part.observations.iter().zip(&fits).map(|(seen, fits)| *fits && kept[seen.point] >= LEAST_KEPT).collect();
    let mut stay = stays.iter();
    part.observations.retain(|_| stay.next().is_some_and(|stays| *stays));
    let mut stay = stays.iter();
    part.sources.retain(|_| stay.next().is_some_and(|stays| *stays));
    part
}
