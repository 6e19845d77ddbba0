//! What a sequence says of its calibration where every view has a focal length of its own.
//!
//! What one view's focal length is, its neighbours say and no others: the sequence is asked run after run, and views
//! whose focal length nothing determines have none, rather than that of the rest.

use std::cell::RefCell;

use super::adjust::{self, Extract};
use super::calibrated_views::{self, too_few};
use super::model::Model;
use super::options::StretchOptions;
use super::{structure, windows};
use crate::domain::{Grade, Task, Warning, WarningCode};
use crate::geometry::statistics::root_mean_square;
use crate::solver::calibration::Outcome;
use crate::solver::consensus;
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

/// The one camera that there is where views have focal lengths of their own.
const CAMERA: usize = 0;

/// Calibrates run after run, takes the model over, adjusts everything under it and asks the windows.
pub fn calibrate(problem: &Problem, model: &mut Model, recorder: &mut Recorder) -> Result<Outcome, Error> {
    let registered = model.registered();
    let runs = runs(model);
    let of_run = |k: usize, heartbeat: &dyn Fn()| {
        let (extract, found) = calibrated_views::calibrate_views(problem, model, runs.get(k)?, None, heartbeat).ok()?;
        found.into_iter().next().map(|(_, outcome)| (extract, outcome))
    };
    let found = if runs.len() == 1 {
        recorder.step(Task::Cameras, 1, 1, 0.0);
        let recorder = RefCell::new(&mut *recorder);
        vec![of_run(0, &|| recorder.borrow_mut().heartbeat())]
    } else {
        let mut progress = |k: usize| recorder.step(Task::Cameras, k + 1, runs.len(), 0.0);
        problem.threads.map(runs.len(), 1, |k| of_run(k, &|| ()), &mut progress)
    };
    problem.stopped()?;
    let mut found: Vec<(Extract, Outcome)> = found.into_iter().flatten().collect();
    // The lens that all runs share is that of the one that knows its focal lengths best.
    let sigma = |outcome: &Outcome| outcome.sigma_log_focal.unwrap_or(f64::INFINITY);
    if let Some((extract, outcome)) = found.iter_mut().min_by(|a, b| sigma(&a.1).total_cmp(&sigma(&b.1))) {
        calibrated_views::take_over(model, extract, &[(CAMERA, outcome.clone())]);
    }
    structure::triangulate(problem, model, recorder);
    adjust::all(problem, model, recorder);
    calibrated_views::report_found(problem, model, recorder);
    let mut outcome = match found.is_empty() {
        true => too_few(registered.len()),
        false => combined(problem, model, found),
    };
    windows::reconcile(problem, model, CAMERA, &mut outcome, recorder)?;
    Ok(outcome)
}

/// Registered views in runs of one component and about equal length.
fn runs(model: &Model) -> Vec<Vec<usize>> {
    let components = model.component_of.iter().copied().max().unwrap_or(0);
    let of_component = |component: u32| {
        let views = model.of_component(component);
        let count = views.len().div_ceil(StretchOptions::DEFAULT.most_views);
        (0..count).map(move |k| views[k * views.len() / count..(k + 1) * views.len() / count].to_vec())
    };
    (0..=components).flat_map(of_component).filter(|run: &Vec<usize>| run.len() >= consensus::LEAST_VIEWS).collect()
}

/// One calibration of those of the runs, which are not none: as good as the worst that is not refused, with a sigma
/// that admits what lies between a run's focal lengths and those that all observations led to. Says in the model which
/// views have one.
fn combined(problem: &Problem, model: &mut Model, runs: Vec<(Extract, Outcome)>) -> Outcome {
    let registered = model.registered();
    let is_whole = matches!(runs.as_slice(), [(extract, _)] if extract.views == registered);
    model.own_focals.iter_mut().for_each(|own| own.is_determined = false);
    let mut whole = Outcome { grade: Grade::Metric, ..Outcome::refused(Vec::new()) };
    let mut deviations = Vec::with_capacity(registered.len());
    for (extract, outcome) in runs {
        let focals = outcome.focals.filter(|_| outcome.grade != Grade::ProjectiveOnly);
        let mut differences = Vec::new();
        for (&view, own) in extract.views.iter().zip(focals.iter().flatten()) {
            let whole = &mut model.own_focals[view];
            whole.is_determined = own.stands_as(whole.focal, &problem.calibration_options);
            if whole.is_determined {
                differences.push((whole.focal / own.focal).ln());
            }
        }
        if let (Some(difference), Some(own)) = (root_mean_square(&differences), outcome.sigma_log_focal) {
            let sigma = own.max(difference);
            deviations.extend(differences.iter().map(|_| sigma));
            whole.grade = whole.grade.worse(outcome.grade);
            whole.rms_ratio = whole.rms_ratio.max(outcome.rms_ratio);
            whole.sigma_ratios = outcome.sigma_ratios;
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
    let grades = &problem.calibration_options.grades;
    // No rounding makes the whole worse than its worst run.
    let largest = deviations.iter().fold(0.0f64, |largest, sigma| largest.max(*sigma));
    whole.sigma_log_focal = root_mean_square(&deviations).map(|sigma| sigma.min(largest));
    whole.grade = whole.grade.worse(grades.grade(whole.sigma_log_focal));
    if (deviations.len() as f64) < grades.least_determined * registered.len() as f64 {
        whole.grade = Grade::ProjectiveOnly;
    }
    if !is_whole && deviations.len() < registered.len() {
        let detail = format!("only {} of {} views determine their focal length", deviations.len(), registered.len());
        whole.warnings.push(Warning::new(WarningCode::UnobservableFocal, detail));
    }
    whole
}
