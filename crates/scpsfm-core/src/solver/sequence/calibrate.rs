//! What the whole sequence says of the calibration of each camera.

use nalgebra::Vector3;

use super::adjust::{self, Extract};
use super::model::Model;
use super::options::StretchOptions;
use super::{own_focals, structure, windows};
use crate::domain::{FocalPrior, Grade, Task, VERIFIED, Warning, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, MetricReconstruction};
use crate::geometry::observation::Observation;
use crate::geometry::{Camera, Point};
use crate::solver::calibration::{self, Outcome, Uncalibrated};
use crate::solver::consensus;
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

const OPTIONS: StretchOptions = StretchOptions::DEFAULT;
/// How far off their common centre cameras begin, and how near points at infinity do: their product moves an image by a
/// ten-thousandth of its side, a fifth of a pixel of 2,000, which noise covers.
const OFF_CENTRE: f64 = 0.01;

/// Calibrates each camera from the landmarks and observations that fit best, takes the models over, adjusts everything
/// under them and asks the windows; one outcome a camera.
///
/// The observations are those that fit behind the seed's lens. Where the adjustment of all observations moves a focal
/// length by more than its sigma, and not so far that the calibration is refused, everything is calibrated a second
/// time, from what fits behind the adjusted lens. The second calibration is used unless it grades a camera worse, or
/// the views no longer hold together.
///
/// # Errors
/// [`Error::Stopped`].
pub fn calibrate(problem: &Problem, model: &mut Model, recorder: &mut Recorder) -> Result<Vec<Outcome>, Error> {
    if problem.has_own_focals() {
        return own_focals::calibrate(problem, model, recorder).map(|outcome| vec![outcome]);
    }
    let mut found = calibrate_registered(problem, model, 0, recorder)?;
    if found.focal_moved {
        let mut again = model.clone();
        structure::triangulate(problem, &mut again, recorder);
        let second = calibrate_registered(problem, &mut again, 1, recorder)?;
        if second.is_nowhere_worse_than(&found) && (model.is_strained || !again.is_strained) {
            (*model, found) = (again, second);
        }
    }
    report_found(problem, model, recorder);
    for (camera, outcome) in found.outcomes.iter_mut().enumerate() {
        windows::reconcile(problem, model, camera, outcome, recorder)?;
    }
    Ok(found.outcomes)
}

/// The calibrations of all cameras.
struct Calibrated {
    /// One a camera, with a sigma that admits what lies between its focal length and that of the model.
    outcomes: Vec<Outcome>,
    /// Whether the adjustment of all observations moved a focal length by more than the sigma of its calibration, and
    /// not so far that it is none.
    focal_moved: bool,
}

impl Calibrated {
    fn is_nowhere_worse_than(&self, other: &Self) -> bool {
        let mut pairs = self.outcomes.iter().zip(&other.outcomes);
        pairs.all(|(own, other)| own.grade.is_no_worse_than(other.grade))
    }
}

/// Calibrates the cameras of all registered views, takes the models over and adjusts everything under them.
///
/// All cameras are calibrated together where they have few views, or the stretch of their views that is compared with
/// projective cameras holds enough of each. Where that calibrates none (the stretch may be critical), each is
/// calibrated by itself.
///
/// * `pass`: how many times they were calibrated before
fn calibrate_registered(
    problem: &Problem,
    model: &mut Model,
    pass: usize,
    recorder: &mut Recorder,
) -> Result<Calibrated, Error> {
    let registered = model.registered();
    let mut of_camera = vec![Vec::new(); problem.cameras];
    registered.iter().for_each(|&view| of_camera[problem.camera_of[view]].push(view));
    let is_long = registered.len() > OPTIONS.most_views;
    let stretch = is_long.then(|| densest(problem, model, &registered));
    let holds_enough = |views: &Vec<usize>| {
        let of_stretch = |stretch: &Vec<usize>| views.iter().filter(|view| stretch.binary_search(view).is_ok()).count();
        views.is_empty() || stretch.as_ref().is_none_or(|stretch| of_stretch(stretch) >= OPTIONS.least_of_camera)
    };
    let mut found = Vec::new();
    if registered.len() >= consensus::LEAST_VIEWS && of_camera.iter().all(holds_enough) {
        recorder.step(Task::Cameras, pass + 1, pass + 1, 0.0);
        found.push(of_run(problem, model, &registered, stretch.as_deref(), recorder)?);
    }
    let mut graded = found.iter().flat_map(|(_, outcomes)| outcomes);
    if is_long && problem.cameras > 1 && graded.all(|(_, outcome)| outcome.grade == Grade::ProjectiveOnly) {
        found.clear();
        let runs = of_camera.iter().filter(|views| views.len() >= consensus::LEAST_VIEWS);
        for (k, views) in runs.enumerate() {
            recorder.step(Task::Cameras, pass * problem.cameras + k + 1, (pass + 1) * problem.cameras, 0.0);
            let stretch = (views.len() > OPTIONS.most_views).then(|| densest(problem, model, views));
            found.push(of_run(problem, model, views, stretch.as_deref(), recorder)?);
        }
    }
    let mut outcomes: Vec<Outcome> = of_camera.iter().map(|views| too_few(views.len())).collect();
    for (mut extract, of_run) in found {
        take_over(model, &mut extract, &of_run);
        of_run.into_iter().for_each(|(camera, outcome)| outcomes[camera] = outcome);
    }
    structure::triangulate(problem, model, recorder);
    adjust::all(problem, model, recorder);
    let mut focal_moved = false;
    for (camera, outcome) in outcomes.iter_mut().enumerate() {
        let (Some(graded), Some(sigma)) = (outcome.intrinsics(), outcome.sigma_log_focal) else { continue };
        let difference = (model.lenses[camera].intrinsics.focal / graded.focal).ln().abs();
        if difference > sigma {
            outcome.raise_sigma(difference, &problem.calibration_options.grades);
            focal_moved |= outcome.grade != Grade::ProjectiveOnly;
        }
    }
    Ok(Calibrated { outcomes, focal_moved })
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
    let detail = format!("only {views} views are registered; a calibration needs {}", consensus::LEAST_VIEWS);
    Outcome::refused(vec![Warning::new(WarningCode::UnobservableFocal, detail)])
}

/// The calibrations of the cameras of these views, which have one focal length each, with what they are made from.
///
/// * `stretch`: as of [`of_extract`]
fn of_run(
    problem: &Problem,
    model: &Model,
    views: &[usize],
    stretch: Option<&[usize]>,
    recorder: &mut Recorder,
) -> Result<(Extract, Vec<(usize, Outcome)>), Error> {
    let extract = core(problem, model, views, of_view(views));
    let stretch = stretch.map(|stretch| core(problem, model, stretch, of_view(stretch)));
    let found = of_extract(problem, &extract, stretch.as_ref(), model.noise, &mut || recorder.heartbeat())?;
    Ok((extract, found))
}

/// The calibrations of the cameras of some views.
///
/// * `stretch`: some of them, of the same cameras, where they are many
/// * `heartbeat`: called now and then
pub fn of_extract(
    problem: &Problem,
    extract: &Extract,
    stretch: Option<&Extract>,
    noise: f64,
    heartbeat: &mut dyn FnMut(),
) -> Result<Vec<(usize, Outcome)>, Error> {
    let (metric, of_group) = extract.block();
    let focal_priors: Vec<Option<FocalPrior>> = of_group.iter().map(|&camera| problem.focal_priors[camera]).collect();
    let all = ProjectiveExtract::of(&metric);
    let stretch = stretch.map(|extract| {
        let (metric, _) = extract.block();
        (ProjectiveExtract::of(&metric), metric, &extract.observations)
    });
    let stretch = stretch.as_ref().map(|(projective, metric, observations)| calibration::Stretch {
        problem: projective.uncalibrated(problem, metric, observations, &focal_priors, noise),
        metric,
    });
    let to_calibrate = all.uncalibrated(problem, &metric, &extract.observations, &focal_priors, noise);
    let outcomes =
        calibration::from_metric(&to_calibrate, &metric, stretch, problem.scale_px, problem.stop, heartbeat)?;
    Ok(of_group.into_iter().zip(outcomes).collect())
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
pub fn of_view(views: &[usize]) -> usize {
    (OPTIONS.observations / views.len()).clamp(OPTIONS.of_view.0, OPTIONS.of_view.1)
}

/// The run of at most [`StretchOptions::most_views`] of these views that keeps most observations.
fn densest(problem: &Problem, model: &Model, views: &[usize]) -> Vec<usize> {
    let kept = |view: &usize| problem.of_view[*view].iter().filter(|&&k| model.kept[k as usize]).count();
    let counts: Vec<usize> = views.iter().map(kept).collect();
    // No views have no runs.
    let length = views.len().clamp(1, OPTIONS.most_views);
    let runs = views.windows(length).zip(counts.windows(length));
    let densest =
        runs.enumerate().max_by_key(|(start, (_, counts))| (counts.iter().sum::<usize>(), std::cmp::Reverse(*start)));
    densest.map_or_else(Vec::new, |(_, (run, _))| run.to_vec())
}

/// The cameras and points of a metric reconstruction without what makes it metric.
pub struct ProjectiveExtract {
    cameras: Vec<Camera>,
    points: Vec<Point>,
}

impl ProjectiveExtract {
    pub fn of(metric: &MetricReconstruction) -> Self {
        let mut cameras = metric.cameras();
        if metric.has_common_centre {
            // At one centre the cost is stationary in what parallax would need, a minimum or not: off it, it shows.
            let aside = |view: usize| Vector3::new(view as f64, 2.0 * view as f64, 3.0 * view as f64).map(f64::sin);
            cameras.iter_mut().enumerate().for_each(|(view, camera)| camera.set_column(3, &(aside(view) * OFF_CENTRE)));
        }
        let nearness = |point: usize| if metric.has_common_centre { OFF_CENTRE * (point as f64).cos() } else { 1.0 };
        let points = metric.points.iter().enumerate().map(|(k, point)| point.push(nearness(k))).collect();
        Self { cameras, points }
    }

    /// What there is to calibrate.
    ///
    /// * `metric`: what these are the cameras and points of
    /// * `focal_priors`: one a camera group of it
    pub fn uncalibrated<'a>(
        &'a self,
        problem: &'a Problem,
        metric: &'a MetricReconstruction,
        observations: &'a [Observation],
        focal_priors: &'a [Option<FocalPrior>],
        noise: f64,
    ) -> Uncalibrated<'a> {
        Uncalibrated {
            cameras: &self.cameras,
            points: &self.points,
            observations,
            noise,
            outlier_density: problem.outlier_density,
            group_of: &metric.group_of,
            focal_priors,
            focal_per_view: metric.has_own_focals(),
            options: &problem.calibration_options,
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_calibration_that_grades_any_camera_worse_is_not_used() {
        let graded = |grades: [Grade; 2]| Calibrated {
            outcomes: grades.map(|grade| Outcome { grade, ..Outcome::refused(Vec::new()) }).to_vec(),
            focal_moved: true,
        };
        let (metric, weak, none) = (Grade::Metric, Grade::Weak, Grade::ProjectiveOnly);
        for (second, first, is_used) in [
            ([metric, weak], [metric, weak], true),
            ([metric, metric], [metric, weak], true),
            ([metric, metric], [none, none], true),
            ([weak, metric], [metric, weak], false),
            ([none, metric], [weak, metric], false),
        ] {
            assert_eq!(graded(second).is_nowhere_worse_than(&graded(first)), is_used, "{second:?} after {first:?}");
        }
    }
}
