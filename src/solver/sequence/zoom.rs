//! What a sequence says of its calibration where every view has a focal length of its own.
//!
//! What one view's focal length is, its neighbours say and no others: the sequence is asked run after run, and views
//! whose focal length nothing determines have none, rather than that of the rest.

use super::adjust::{self, Extract};
use super::calibrate::{self, too_few};
use super::model::{Model, Scene};
use super::{structure, windows};
use crate::domain::{Grade, Task, Warning, WarningCode};
use crate::geometry::bundle::zoom::Zooming;
use crate::geometry::statistics::root_mean_square;
use crate::solver::agreement::Estimate;
use crate::solver::calibration::{self, LEAST_DETERMINED, Outcome, Problem};
use crate::solver::recorder::Recorder;
use crate::solver::{Context, Error, block};

/// Calibrates run after run, takes the model over, adjusts everything under it and asks the windows.
///
/// # Errors
/// [`Error::Stopped`].
pub fn calibrate(
    scene: &Scene,
    model: &mut Model,
    context: &Context,
    recorder: &mut Recorder,
) -> Result<Outcome, Error> {
    let registered = model.registered();
    let runs = runs(model);
    let of_run = |k: usize, told: &mut dyn FnMut()| {
        let extract = calibrate::core(scene, model, runs.get(k)?, calibrate::of_view(&runs[k]));
        let outcome = of_extract(&extract, model.noise, |problem, zooming| {
            calibration::from_zooming(problem, zooming, context.scale_px, context.stop, told)
        });
        outcome.ok().map(|outcome| (extract, outcome))
    };
    let found = if runs.len() == 1 {
        recorder.step(Task::Cameras, 1, 1, 0.0);
        vec![of_run(0, &mut || recorder.sign_of_life())]
    } else {
        let mut told = |k: usize| recorder.step(Task::Cameras, k + 1, runs.len(), 0.0);
        scene.context.threads.map(runs.len(), 1, |k| of_run(k, &mut || {}), &mut told)
    };
    scene.context.stopped()?;
    let mut found: Vec<(Extract, Outcome)> = found.into_iter().flatten().collect();
    if let [(extract, outcome)] = found.as_mut_slice()
        && extract.views == registered
    {
        take_over(scene, model, extract, outcome);
    }
    structure::triangulate(scene, model, recorder);
    adjust::all(scene, model, recorder);
    calibrate::report_found(scene, model, recorder);
    let mut outcome = match found.is_empty() {
        true => too_few(registered.len()),
        false => combined(scene, model, found),
    };
    windows::reconcile(scene, model, 0, &mut outcome, recorder)?;
    Ok(outcome)
}

/// Registered views in runs of one part and about equal length.
fn runs(model: &Model) -> Vec<Vec<usize>> {
    let parts = model.part_of.iter().copied().max().unwrap_or(0);
    let of_part = |part: u32| {
        let views = model.of_part(part);
        let count = views.len().div_ceil(calibrate::MOST_VIEWS);
        (0..count).map(move |k| views[k * views.len() / count..(k + 1) * views.len() / count].to_vec())
    };
    (0..=parts).flat_map(of_part).filter(|run: &Vec<usize>| run.len() >= block::LEAST_VIEWS).collect()
}

/// Has the model go on from the calibration of all its views. Some of them alone would leave the frame of the others.
fn take_over(scene: &Scene, model: &mut Model, extract: &mut Extract, outcome: &Outcome) {
    let (Some(metric), Some(focals)) = (&outcome.metric, &outcome.focals) else { return };
    for (&view, own) in extract.views.iter().zip(focals) {
        extract.sequence.intrinsics[scene.lens_of[view]].focal = own.focal;
    }
    (extract.sequence.poses, extract.sequence.points) = (metric.poses.clone(), metric.points.clone());
    extract.write_back(model);
}

/// One calibration of those of the runs, which are not none: as good as the worst that is not refused, with a sigma
/// that admits what lies between a run's focal lengths and those that all observations led to. Says in the model which
/// views have one.
fn combined(scene: &Scene, model: &mut Model, runs: Vec<(Extract, Outcome)>) -> Outcome {
    let registered = model.registered();
    let is_whole = matches!(runs.as_slice(), [(extract, _)] if extract.views == registered);
    model.lenses.iter_mut().for_each(|lens| lens.is_determined = false);
    let mut whole = Outcome { grade: Grade::Metric, cheirality: 1.0, ..Outcome::refused(Vec::new()) };
    let mut deviations = Vec::with_capacity(registered.len());
    for (extract, outcome) in runs {
        let focals = outcome.focals.filter(|_| outcome.grade != Grade::ProjectiveOnly);
        let mut differences = Vec::new();
        for (&view, own) in extract.views.iter().zip(focals.iter().flatten()) {
            let lens = &mut model.lenses[scene.lens_of[view]];
            lens.is_determined = own.stands_as(lens.intrinsics.focal);
            if lens.is_determined {
                differences.push((lens.intrinsics.focal / own.focal).ln());
            }
        }
        if let (Some(difference), Some(own)) = (root_mean_square(&differences), outcome.sigma_log_focal) {
            let sigma = own.max(difference);
            deviations.extend(differences.iter().map(|_| sigma));
            whole.grade = whole.grade.worse(outcome.grade);
            whole.cheirality = whole.cheirality.min(outcome.cheirality);
            whole.rms_ratio = whole.rms_ratio.max(outcome.rms_ratio);
        }
        whole.metric = whole.metric.or(outcome.metric);
        let named = |warning: Warning| match is_whole {
            true => warning,
            false => {
                let run = format!("in a run of {} views", extract.views.len());
                Warning::new(warning.code, format!("{run}: {}", warning.detail))
            }
        };
        whole.warnings.extend(outcome.warnings.into_iter().map(named));
    }
    // No rounding makes the whole worse than its worst run.
    let largest = deviations.iter().fold(0.0f64, |largest, sigma| largest.max(*sigma));
    whole.sigma_log_focal = root_mean_square(&deviations).map(|sigma| sigma.min(largest));
    whole.grade = whole.grade.worse(calibration::grade_of_sigma(whole.sigma_log_focal));
    if (deviations.len() as f64) < LEAST_DETERMINED * registered.len() as f64 {
        whole.grade = Grade::ProjectiveOnly;
    }
    if !is_whole && deviations.len() < registered.len() {
        let detail = format!("only {} of {} views determine their focal length", deviations.len(), registered.len());
        whole.warnings.push(Warning::new(WarningCode::UnobservableFocal, detail));
    }
    whole
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
