//! Reconstructions of an input that share no tracks, or too few: each with a frame and a scale of its own, all with one
//! calibration.

use super::growth::Trial;
use super::model::Model;
use super::options::{ComponentOptions, GrowthOptions};
use super::{merging, register, structure};
use crate::domain::{FocalPrior, Grade};
use crate::geometry::bundle::metric::Intrinsics;
use crate::solver::attempt::{self, Attempt, Effort};
use crate::solver::calibration::Outcome;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;
use crate::solver::{Error, view_selection};

const OPTIONS: ComponentOptions = ComponentOptions::DEFAULT;
/// How the block of a further component is searched.
const SEED: Effort = Effort { is_seed: true, is_quick: false };
/// The component that the calibration comes from.
pub const FIRST: u32 = 0;

/// The model that a block begins.
pub fn first(problem: &Problem, seed: &Attempt, recorder: &mut Recorder) -> Model {
    let metric = seed.calibration.as_ref().and_then(|calibration| calibration.metric.as_ref());
    let noise = seed.projective.as_ref().map_or(0.0, |found| found.noise);
    let intrinsics = metric.map_or_else(|| Intrinsics::from_focal(1.0), |metric| metric.intrinsics[0]);
    let mut model = Model::new(problem, intrinsics, noise);
    if let Some(metric) = metric {
        model.has_common_centre = metric.has_common_centre;
        let focals = seed.calibration.as_ref().and_then(|calibration| calibration.focals.as_deref());
        model.add_component(problem, FIRST, seed.views(), metric, focals);
    }
    model.of_static = seed.projective.as_ref().is_some_and(|found| problem.is_of_static(&found.tracks));
    structure::triangulate(problem, &mut model, recorder);
    model
}

/// Solves and extends block after block of the views that are left, as long as there are any.
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn others(
    problem: &Problem,
    model: &mut Model,
    seed: &Attempt,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    let first_camera = seed.block.views.first().map_or(0, |&view| problem.camera_of[view]);
    let prior = prior_of(problem, seed, model, first_camera);
    let mut open: Vec<bool> = model.poses.iter().map(Option::is_none).collect();
    let mut failures = 0;
    for component in FIRST + 1..OPTIONS.most_components {
        problem.stopped()?;
        if failures == OPTIONS.most_failures {
            break;
        }
        let Some(views) = next_block(problem, &open) else { break };
        let known = prior.filter(|_| problem.camera_of[views[0]] == first_camera);
        recorder.begin_component(component);
        let attempt = attempt::solve_block(problem, problem.block(&views), SEED, known, recorder)?;
        recorder.end_component();
        // Whatever comes of it, a block is tried once.
        views.iter().for_each(|&view| open[view] = false);
        // Focal lengths of views that their own block does not determine, no other component can give.
        let usable = |calibration: &&Outcome| !problem.has_own_focals() || calibration.grade != Grade::ProjectiveOnly;
        let Some((calibration, metric)) = attempt
            .calibration
            .as_ref()
            .filter(usable)
            .filter(|_| attempt.has_common_centre() == model.has_common_centre)
            .filter(|_| {
                let found = attempt.projective.as_ref();
                model.of_static || !found.is_some_and(|found| problem.is_of_static(&found.tracks))
            })
            .and_then(|calibration| Some((calibration, calibration.metric.as_ref()?)))
        else {
            failures += 1;
            continue;
        };
        model.add_component(problem, component, attempt.views(), metric, calibration.focals.as_deref());
        structure::triangulate_seen(problem, model, attempt.views(), recorder);
        register::join(problem, model, component, trials, recorder)?;
        drop_unsupported(problem, model, component, recorder);
        failures = if model.of_component(component).is_empty() { failures + 1 } else { 0 };
        if let Some(into) = merging::merge(problem, model, component, recorder) {
            register::join(problem, model, into, trials, recorder)?;
        }
        for (open, pose) in open.iter_mut().zip(&model.poses) {
            *open &= pose.is_none();
        }
    }
    Ok(())
}

/// The best block of open views of one camera.
fn next_block(problem: &Problem, open: &[bool]) -> Option<Vec<usize>> {
    (0..problem.cameras).find_map(|camera| {
        let of_camera: Vec<bool> =
            open.iter().zip(&problem.camera_of).map(|(open, of)| *open && *of == camera).collect();
        if of_camera.iter().filter(|&&open| open).count() < view_selection::LEAST_VIEWS || problem.stop.is_stopped() {
            return None;
        }
        let found = view_selection::candidate_views_among(problem, &of_camera);
        found.into_iter().next()
    })
}

/// What the first component says of the focal length of the others; nothing where views have their own.
fn prior_of(problem: &Problem, seed: &Attempt, model: &Model, camera: usize) -> Option<FocalPrior> {
    let calibration = seed.calibration.as_ref().filter(|_| !problem.has_own_focals())?;
    let sigma = calibration.sigma_log_focal.filter(|_| calibration.grade != Grade::ProjectiveOnly);
    let focal_px = model.lenses[camera].intrinsics.focal * problem.scale_px;
    Some(FocalPrior { focal_px, sigma_log: sigma.map_or(OPTIONS.vague_sigma, |sigma| sigma.max(OPTIONS.prior_sigma)) })
}

/// Takes back the views of a component that see too few of its points to be held by them, and the whole component if
/// too few are left. Returns the views taken back.
pub fn drop_unsupported(problem: &Problem, model: &mut Model, component: u32, recorder: &mut Recorder) -> Vec<usize> {
    let unsupported = |&view: &usize| {
        let kept = problem.of_view[view].iter().filter(|&&k| {
            let k = k as usize;
            model.kept[k] && model.landmarks[problem.track_of(k)].is_some_and(|landmark| landmark.is_verified())
        });
        kept.count() < GrowthOptions::METRIC.least_agreeing
    };
    let views = model.of_component(component);
    let mut dropped: Vec<usize> = views.iter().copied().filter(unsupported).collect();
    if views.len() - dropped.len() < view_selection::LEAST_VIEWS {
        dropped.clone_from(&views);
    }
    model.unregister(problem, &dropped);
    structure::triangulate_seen(problem, model, &dropped, recorder);
    recorder.registered(model.registered().len());
    dropped
}

/// Numbers the components anew, the one with most views first; of equals the one found first.
pub fn largest_first(model: &mut Model) {
    let most = model.component_of.iter().copied().max().unwrap_or(0);
    let mut components: Vec<(usize, u32)> =
        (0..=most).map(|component| (model.of_component(component).len(), component)).collect();
    components.sort_by_key(|&(views, component)| (std::cmp::Reverse(views), component));
    let mut number = vec![0; components.len()];
    for (rank, &(_, component)) in components.iter().enumerate() {
        number[component as usize] = rank as u32;
    }
    for (component, pose) in model.component_of.iter_mut().zip(&model.poses) {
        *component = if pose.is_some() { number[*component as usize] } else { 0 };
    }
    model.landmarks.iter_mut().flatten().for_each(|landmark| landmark.component = number[landmark.component as usize]);
}
