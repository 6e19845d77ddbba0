//! What the whole sequence says of the calibration of each camera.

use nalgebra::Vector4;

use super::adjust::{self, Extract};
use super::model::{Model, Scene};
use super::{own_focals, windows};
use crate::domain::{Task, Warning, WarningCode};
use crate::geometry::Camera;
use crate::geometry::bundle::metric::{Intrinsics, Reconstruction};
use crate::solver::calibration::{self, Outcome};
use crate::solver::recorder::Recorder;
use crate::solver::{Context, Error, block};

/// Views that a calibration is made from at most: the projective adjustment that it is compared with is cubic in them.
/// Of more with one focal length, the stretch with most observations, where the others speak through their windows; a
/// zoom is asked stretch after stretch.
pub const MOST_VIEWS: usize = 40;
/// Observations that a calibration is made from, and of one view at least and at most: other errors than noise bound
/// what more of them would give.
const OBSERVATIONS: usize = 6_000;
const OF_VIEW: (usize, usize) = (50, 300);
/// Squared standard deviations of the core within which an observation takes part: squares know no tails. The .999
/// quantile of two coordinates.
const CORE_SQUARED: f64 = 13.8;
/// Observations that a track must keep to take part.
const LEAST_KEPT: usize = 3;

/// Calibrates each camera from the landmarks and observations that fit best, takes the models over, adjusts everything
/// under them and asks the windows; one outcome a camera.
///
/// # Errors
/// [`Error::Stopped`].
pub fn calibrate(
    scene: &Scene,
    model: &mut Model,
    context: &Context,
    recorder: &mut Recorder,
) -> Result<Vec<Outcome>, Error> {
    if scene.has_own_focals() {
        return own_focals::calibrate(scene, model, context, recorder).map(|outcome| vec![outcome]);
    }
    let mut outcomes = Vec::with_capacity(scene.cameras);
    for camera in 0..scene.cameras {
        recorder.step(Task::Cameras, camera + 1, scene.cameras, 0.0);
        let registered: Vec<usize> =
            model.registered().into_iter().filter(|&view| scene.camera_of[view] == camera).collect();
        let views = densest(scene, model, &registered);
        let outcome = match views.len() < block::LEAST_VIEWS {
            true => too_few(views.len()),
            false => of_camera(scene, model, camera, &views, context, recorder)?,
        };
        outcomes.push(outcome);
    }
    super::structure::triangulate(scene, model, recorder);
    adjust::all(scene, model, recorder);
    report_found(scene, model, recorder);
    for (camera, outcome) in outcomes.iter_mut().enumerate() {
        admit_difference(model.lenses[camera].intrinsics.focal.ln(), outcome);
        windows::reconcile(scene, model, camera, outcome, recorder)?;
    }
    Ok(outcomes)
}

/// Reports the points and the focal length, a mean where views have their own, of the first camera with registered views.
pub fn report_found(scene: &Scene, model: &Model, recorder: &mut Recorder) {
    let mut views = model.registered();
    let first = views.first().map(|&view| scene.camera_of[view]);
    let focal = first.map(|camera| {
        views.retain(|&view| scene.camera_of[view] == camera);
        model.log_focal(camera, &views).exp() * scene.context.scale_px
    });
    recorder.found(adjust::verified(model).len(), focal.filter(|focal| focal.is_finite()));
}

/// What is said of a camera of which fewer views are registered than a calibration needs.
pub fn too_few(views: usize) -> Outcome {
    let detail = format!("only {views} views are registered; a calibration needs {}", block::LEAST_VIEWS);
    Outcome::refused(vec![Warning::new(WarningCode::UnobservableFocal, detail)])
}

/// The calibration of a camera whose views have one focal length, from these of them.
fn of_camera(
    scene: &Scene,
    model: &mut Model,
    camera: usize,
    views: &[usize],
    context: &Context,
    recorder: &mut Recorder,
) -> Result<Outcome, Error> {
    let mut extract = core(scene, model, views, of_view(views));
    let outcome = of_extract(scene, &extract, model.noise, camera, context, &mut || recorder.sign_of_life())?;
    take_over(model, &mut extract, camera, &outcome);
    Ok(outcome)
}

/// The calibration of views of one camera.
///
/// * `told`: called now and then
pub fn of_extract(
    scene: &Scene,
    extract: &Extract,
    noise: f64,
    camera: usize,
    context: &Context,
    told: &mut dyn FnMut(),
) -> Result<Outcome, Error> {
    let (metric, observations) = extract.block();
    let (cameras, points) = projective(&metric);
    let problem = calibration::Problem {
        cameras: &cameras,
        points: &points,
        observations: &observations,
        noise,
        focal_prior: scene.focal_priors[camera],
        focal_per_view: metric.has_own_focals(),
    };
    Ok(calibration::from_metric(&problem, &metric, context.scale_px, context.stop, told)?)
}

/// Has the model go on from the calibration of some views of a camera: its lens, and where these are all views that are
/// registered, the rest too.
pub fn take_over(model: &mut Model, extract: &mut Extract, camera: usize, outcome: &Outcome) {
    let Some(metric) = &outcome.metric else { return };
    let lens = &mut model.lenses[camera];
    lens.free = outcome.model;
    // What the model holds is as the calibration has it, not as the seed had it.
    lens.intrinsics = Intrinsics { focal: lens.intrinsics.focal, ..metric.intrinsics };
    // Some of the views alone would leave the frame of the others.
    if extract.views.len() == model.registered().len() {
        extract.sequence.intrinsics[camera] = metric.intrinsics;
        extract.sequence.focals.clone_from(&metric.focals);
        (extract.sequence.poses, extract.sequence.points) = (metric.poses.clone(), metric.points.clone());
        extract.write_back(model);
    }
}

/// Observations of each of these views that a calibration is made from.
pub fn of_view(views: &[usize]) -> usize {
    (OBSERVATIONS / views.len()).clamp(OF_VIEW.0, OF_VIEW.1)
}

/// Raises sigma to what lies between the focal length that was graded and the one that all observations led to.
fn admit_difference(log_focal: f64, outcome: &mut Outcome) {
    let (Some(metric), Some(sigma)) = (&outcome.metric, outcome.sigma_log_focal) else { return };
    let difference = (log_focal - metric.intrinsics.focal.ln()).abs();
    if difference > sigma {
        outcome.sigma_log_focal = Some(difference);
        outcome.grade = outcome.grade.worse(calibration::grade_of_sigma(Some(difference)));
    }
}

/// The run of at most [`MOST_VIEWS`] of these views that keeps most observations.
fn densest(scene: &Scene, model: &Model, views: &[usize]) -> Vec<usize> {
    let kept = |view: &usize| scene.of_view[*view].iter().filter(|&&k| model.kept[k as usize]).count();
    let counts: Vec<usize> = views.iter().map(kept).collect();
    // No views have no runs.
    let length = views.len().clamp(1, MOST_VIEWS);
    let runs = views.windows(length).zip(counts.windows(length));
    let densest =
        runs.enumerate().max_by_key(|(start, (_, counts))| (counts.iter().sum::<usize>(), std::cmp::Reverse(*start)));
    densest.map_or_else(Vec::new, |(_, (run, _))| run.to_vec())
}

/// The cameras and points of a metric reconstruction without what makes it metric.
pub fn projective(metric: &Reconstruction) -> (Vec<Camera>, Vec<Vector4<f64>>) {
    (metric.cameras(), metric.points.iter().map(|point| point.push(1.0)).collect())
}

/// Landmarks that give every one of these registered views `of_view` observations, with the observations that the core
/// of the noise explains.
pub fn core(scene: &Scene, model: &Model, views: &[usize], of_view: usize) -> Extract {
    let tracks = adjust::covering(scene, model, views, of_view);
    let mut extract = Extract::new(scene, model, views, &tracks);
    let limit = CORE_SQUARED * model.noise * model.noise;
    let fits: Vec<bool> =
        extract.observations.iter().map(|seen| extract.sequence.residual(seen).norm_squared() < limit).collect();
    let mut kept = vec![0usize; extract.tracks.len()];
    for (seen, fits) in extract.observations.iter().zip(&fits) {
        kept[seen.point] += usize::from(*fits);
    }
    let mut fits = fits.into_iter();
    extract.observations.retain(|seen| fits.next().unwrap_or(false) && kept[seen.point] >= LEAST_KEPT);
    extract
}
