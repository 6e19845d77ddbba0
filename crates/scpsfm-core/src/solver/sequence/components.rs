//! Reconstructions of an input that share no tracks, or too few: each with a frame and a scale of its own, all with one
//! calibration.

use super::growth::Trial;
use super::model::{FIRST, Model};
use super::options::{ComponentOptions, GrowthOptions};
use super::triplets::Pairs;
use super::{merging, register, structure};
use crate::domain::Grade;
use crate::geometry::bundle::metric::Intrinsics;
use crate::solver::attempt::{self, Attempt};
use crate::solver::calibration::Outcome;
use crate::solver::consensus;
use crate::solver::error::Error;
use crate::solver::portfolio::Effort;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;
use crate::solver::view_selection::{self, SeedViews};

const OPTIONS: ComponentOptions = ComponentOptions::DEFAULT;
/// How the block of a further component is searched.
const SEED: Effort = Effort { is_seed: true, is_quick: false };

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

/// Solves and extends what may be a component, one after the other, as long as there is any among the views that are
/// left: blocks of one camera, then of several together, then triplets.
pub fn others(
    problem: &Problem,
    model: &mut Model,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    let mut component = FIRST;
    let mut pairs = Pairs::new(problem);
    for next_seed in [block_of_one_camera, block_of_several, triplet] {
        let mut open: Vec<bool> = model.poses.iter().map(Option::is_none).collect();
        let mut failures = 0;
        while component + 1 < OPTIONS.most_components && failures < OPTIONS.most_failures {
            problem.stopped()?;
            if open.iter().filter(|open| **open).count() < consensus::LEAST_VIEWS {
                break;
            }
            let Some(seed_views) = next_seed(problem, &open) else { break };
            component += 1;
            recorder.begin_component(component);
            let mut attempt = pairs.search(&seed_views, SEED, recorder)?;
            attempt::calibrate(problem, &mut attempt, recorder)?;
            recorder.end_component();
            // Whatever comes of it, it is tried once.
            attempt.block.views.iter().for_each(|&view| open[view] = false);
            let is_added = add(problem, model, component, &attempt, trials, recorder)?;
            failures = if is_added { 0 } else { failures + 1 };
            for (open, pose) in open.iter_mut().zip(&model.poses) {
                *open &= pose.is_none();
            }
        }
    }
    Ok(())
}

/// Adds what was found of a block as a component, joins to it what views it can, and merges it into another one where
/// it shares enough with that; whether anything stands.
fn add(
    problem: &Problem,
    model: &mut Model,
    component: u32,
    attempt: &Attempt,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<bool, Error> {
    // Focal lengths of views that their own block does not determine, no other component can give.
    let is_usable = |calibration: &&Outcome| !problem.has_own_focals() || calibration.grade != Grade::ProjectiveOnly;
    let is_of_static = attempt.projective.as_ref().is_some_and(|found| problem.is_of_static(&found.tracks));
    if attempt.has_common_centre() != model.has_common_centre || is_of_static && !model.of_static {
        return Ok(false);
    }
    let Some(calibration) = attempt.calibration.as_ref().filter(is_usable) else { return Ok(false) };
    let Some(metric) = &calibration.metric else { return Ok(false) };
    model.add_component(problem, component, attempt.views(), metric, calibration.focals.as_deref());
    structure::triangulate_seen(problem, model, attempt.views(), recorder);
    register::join(problem, model, component, trials, recorder)?;
    drop_unsupported(problem, model, component, &GrowthOptions::METRIC, recorder);
    let stands = !model.of_component(component).is_empty();
    let mut grown = component;
    while let Some(into) = merging::merge(problem, model, grown, recorder) {
        register::join(problem, model, into, trials, recorder)?;
        grown = into;
    }
    Ok(stands)
}

/// Joins the views that are left by fewer points, see [`GrowthOptions::LAST`], moves those that another component holds
/// better, and merges components that share enough.
pub fn join_rest(
    problem: &Problem,
    model: &mut Model,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    for component in model.components() {
        // Some were merged into others meanwhile.
        let mut grown = Some(component).filter(|component| !model.of_component(*component).is_empty());
        while let Some(component) = grown {
            register::join_again(problem, model, component, &GrowthOptions::LAST, trials, recorder)?;
            grown = merging::merge(problem, model, component, recorder);
        }
    }
    Ok(())
}

/// The best block of open views.
fn block(problem: &Problem, open: &[bool]) -> Option<SeedViews> {
    view_selection::candidate_views_among(problem, open).into_iter().next().map(SeedViews::Block)
}

/// The best block of open views of one camera, which determines it better than several together are.
fn block_of_one_camera(problem: &Problem, open: &[bool]) -> Option<SeedViews> {
    (0..problem.cameras).find_map(|camera| {
        let is_open = |(open, of): (&bool, &usize)| *open && *of == camera;
        block(problem, &open.iter().zip(&problem.camera_of).map(is_open).collect::<Vec<bool>>())
    })
}

/// The best block of open views of several cameras; of one there is none.
fn block_of_several(problem: &Problem, open: &[bool]) -> Option<SeedViews> {
    (problem.cameras > 1).then(|| block(problem, open)).flatten()
}

/// The best triplet of open views.
fn triplet(problem: &Problem, open: &[bool]) -> Option<SeedViews> {
    view_selection::triplets(problem, open).into_iter().next().map(SeedViews::Triplet)
}

/// Takes back the views of a component that see too few of its points to be held by them, and the whole component if
/// too few are left.
pub fn drop_unsupported(
    problem: &Problem,
    model: &mut Model,
    component: u32,
    options: &GrowthOptions,
    recorder: &mut Recorder,
) {
    let unsupported = |&view: &usize| model.held_by(problem, view) < options.least_agreeing;
    let views = model.of_component(component);
    let mut dropped: Vec<usize> = views.iter().copied().filter(unsupported).collect();
    if views.len() - dropped.len() < consensus::LEAST_VIEWS {
        dropped.clone_from(&views);
    }
    model.unregister(problem, &dropped);
    structure::triangulate_seen(problem, model, &dropped, recorder);
    recorder.registered(model.registered().len());
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
