//! What the whole sequence says of the calibration of each camera.

use std::cell::RefCell;

use super::calibrated_views::{calibrate_views, report_found, take_over, too_few};
use super::model::Model;
use super::options::StretchOptions;
use super::{adjust, own_focals, structure, windows};
use crate::domain::{Grade, Task};
use crate::solver::calibration::Outcome;
use crate::solver::consensus;
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

const OPTIONS: StretchOptions = StretchOptions::DEFAULT;

/// Calibrates each camera from the landmarks and observations that fit best, takes the models over, adjusts everything
/// under them and asks the windows; one outcome a camera.
///
/// The observations are those that fit behind the seed's lens. Where the adjustment of all observations moves a focal
/// length by more than its sigma, and not so far that the calibration is refused, everything is calibrated a second
/// time, from what fits behind the adjusted lens. The second calibration is used unless it grades a camera worse, or
/// the views no longer hold together.
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
    let calibrate_run = |views: &[usize], stretch: Option<&[usize]>, recorder: &mut Recorder| {
        let recorder = RefCell::new(recorder);
        calibrate_views(problem, model, views, stretch, &|| recorder.borrow_mut().heartbeat())
    };
    let mut found = Vec::new();
    if registered.len() >= consensus::LEAST_VIEWS && of_camera.iter().all(holds_enough) {
        recorder.step(Task::Cameras, pass + 1, pass + 1, 0.0);
        found.push(calibrate_run(&registered, stretch.as_deref(), recorder)?);
    }
    let mut graded = found.iter().flat_map(|(_, outcomes)| outcomes);
    if is_long && problem.cameras > 1 && graded.all(|(_, outcome)| outcome.grade == Grade::ProjectiveOnly) {
        found.clear();
        let runs = of_camera.iter().filter(|views| views.len() >= consensus::LEAST_VIEWS);
        for (k, views) in runs.enumerate() {
            recorder.step(Task::Cameras, pass * problem.cameras + k + 1, (pass + 1) * problem.cameras, 0.0);
            let stretch = (views.len() > OPTIONS.most_views).then(|| densest(problem, model, views));
            found.push(calibrate_run(views, stretch.as_deref(), recorder)?);
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
