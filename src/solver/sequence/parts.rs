//! Reconstructions of an input that share no tracks, or too few: each with a frame and a scale of its own, all with one
//! calibration.

use super::model::{Model, Scene};
use super::register::{self, Trial};
use super::structure;
use crate::domain::{FocalPrior, Grade};
use crate::geometry::bundle::metric::Intrinsics;
use crate::solver::attempt::{self, Attempt};
use crate::solver::calibration::Outcome;
use crate::solver::recorder::Recorder;
use crate::solver::{Context, Error, block};

/// The part that the calibration comes from.
pub const FIRST: u32 = 0;
/// Blocks that are tried for parts at most, and how many may fail one after the other: the best come first, and an
/// input without overlap has any number of hopeless ones.
const MOST_PARTS: u32 = 100;
const MOST_FAILURES: usize = 3;
/// Deviation of the log focal length that other parts are told of, at least, where the first has one: parts differ by
/// more than each admits. And where the first has none: it only keeps them from running away.
const PRIOR_SIGMA: f64 = 0.02;
const VAGUE_SIGMA: f64 = 0.5;

/// The model that a block begins.
pub fn first(scene: &Scene, seed: &Attempt, recorder: &mut Recorder) -> Model {
    let metric = seed.calibration.as_ref().and_then(|calibration| calibration.metric.as_ref());
    let noise = seed.projective.as_ref().map_or(0.0, |found| found.noise);
    let intrinsics = metric.map_or_else(|| Intrinsics::from_focal(1.0), |metric| metric.intrinsics[0]);
    let mut model = Model::new(scene, intrinsics, noise);
    if let Some(metric) = metric {
        let focals = seed.calibration.as_ref().and_then(|calibration| calibration.focals.as_deref());
        model.add_part(scene, FIRST, seed.views(), metric, focals);
    }
    structure::triangulate(scene, &mut model, recorder);
    model
}

/// Solves and extends block after block of the views that are left, as long as there are any.
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn others(
    scene: &Scene,
    model: &mut Model,
    seed: &Attempt,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    let first_camera = seed.block.views.first().map_or(0, |&view| scene.camera_of[view]);
    let prior = prior_of(scene, seed, model, first_camera);
    let mut open: Vec<bool> = model.poses.iter().map(Option::is_none).collect();
    let mut failures = 0;
    for part in FIRST + 1..MOST_PARTS {
        scene.context.stopped()?;
        if failures == MOST_FAILURES {
            break;
        }
        let Some(views) = next_block(scene, &open) else { break };
        let told = prior.filter(|_| scene.camera_of[views[0]] == first_camera);
        let context = Context { focal_prior: told, ..scene.context };
        let block = block::extract(context.input, context.ranges, context.normalization, &views);
        recorder.begin_part(part);
        let attempt = attempt::solve_block(block, &context, recorder)?;
        recorder.end_part();
        // Whatever comes of it, a block is tried once.
        views.iter().for_each(|&view| open[view] = false);
        // Focal lengths of views that their own block does not determine, no other part can tell.
        let usable = |calibration: &&Outcome| !scene.has_own_focals() || calibration.grade != Grade::ProjectiveOnly;
        let Some((calibration, metric)) = attempt
            .calibration
            .as_ref()
            .filter(usable)
            .and_then(|calibration| Some((calibration, calibration.metric.as_ref()?)))
        else {
            failures += 1;
            continue;
        };
        model.add_part(scene, part, attempt.views(), metric, calibration.focals.as_deref());
        structure::triangulate_seen(scene, model, attempt.views(), recorder);
        register::join(scene, model, part, trials, recorder)?;
        drop_unsupported(scene, model, part, recorder);
        failures = if model.of_part(part).is_empty() { failures + 1 } else { 0 };
        for (open, pose) in open.iter_mut().zip(&model.poses) {
            *open &= pose.is_none();
        }
    }
    Ok(())
}

/// The best block of open views of one camera.
fn next_block(scene: &Scene, open: &[bool]) -> Option<Vec<usize>> {
    let context = &scene.context;
    (0..scene.cameras).find_map(|camera| {
        let of_camera: Vec<bool> = open.iter().zip(&scene.camera_of).map(|(open, of)| *open && *of == camera).collect();
        if of_camera.iter().filter(|&&open| open).count() < block::LEAST_VIEWS || context.stop.is_stopped() {
            return None;
        }
        let found = block::candidate_views_among(context.input, context.ranges, &of_camera, context.stop);
        found.into_iter().next()
    })
}

/// What the first part says of the focal length of the others; nothing where views have their own.
fn prior_of(scene: &Scene, seed: &Attempt, model: &Model, camera: usize) -> Option<FocalPrior> {
    let calibration = seed.calibration.as_ref().filter(|_| !scene.has_own_focals())?;
    let sigma = calibration.sigma_log_focal.filter(|_| calibration.grade != Grade::ProjectiveOnly);
    let focal_px = model.lenses[camera].intrinsics.focal * scene.context.scale_px;
    Some(FocalPrior { focal_px, sigma_log: sigma.map_or(VAGUE_SIGMA, |sigma| sigma.max(PRIOR_SIGMA)) })
}

/// Takes back the views of a part that see too few of its points to be held by them, and the whole part if too few are
/// left.
pub fn drop_unsupported(scene: &Scene, model: &mut Model, part: u32, recorder: &mut Recorder) {
    let unsupported = |&view: &usize| {
        let kept = scene.of_view[view].iter().filter(|&&k| {
            let k = k as usize;
            model.kept[k] && model.landmarks[scene.track_of(k)].is_some_and(|landmark| landmark.is_verified())
        });
        kept.count() < register::LEAST_POINTS
    };
    let views = model.of_part(part);
    let mut dropped: Vec<usize> = views.iter().copied().filter(unsupported).collect();
    if views.len() - dropped.len() < block::LEAST_VIEWS {
        dropped.clone_from(&views);
    }
    model.unregister(scene, &dropped);
    structure::triangulate_seen(scene, model, &dropped, recorder);
    recorder.registered(model.registered().len());
}

/// Numbers the parts anew, the one with most views first; of equals the one found first.
pub fn largest_first(model: &mut Model) {
    let most = model.part_of.iter().copied().max().unwrap_or(0);
    let mut parts: Vec<(usize, u32)> = (0..=most).map(|part| (model.of_part(part).len(), part)).collect();
    parts.sort_by_key(|&(views, part)| (std::cmp::Reverse(views), part));
    let mut number = vec![0; parts.len()];
    for (rank, &(_, part)) in parts.iter().enumerate() {
        number[part as usize] = rank as u32;
    }
    for (part, pose) in model.part_of.iter_mut().zip(&model.poses) {
        *part = if pose.is_some() { number[*part as usize] } else { 0 };
    }
    model.landmarks.iter_mut().flatten().for_each(|landmark| landmark.part = number[landmark.part as usize]);
}
