//! Views joined to what stands, one after the other.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::adjust;
use super::model::{Model, Scene};
use super::structure;
use crate::geometry::bundle::metric::{Intrinsics, Pose};
use crate::geometry::pose;
use crate::solver::recorder::Recorder;
use crate::solver::{Error, block};

/// Points that a view must see before it is tried, and that must agree with its pose: three determine it, and each of
/// the other five agrees with a wrong one by chance in one case of a hundred.
pub const LEAST_POINTS: usize = 8;
/// Share of the points seen that must agree: below, the robust pose's samples do not suffice.
const LEAST_SHARE: f64 = 0.1;
/// Points of a view beyond which a pose is not made better.
const MOST_POINTS: usize = 2_000;
/// Growth of the points that a view sees after which a failed one is tried again: fewer new ones hardly change its
/// odds.
const RETRY_GROWTH: f64 = 1.2;
/// Trials of a view a part: by the last it sees some 1.7 times the points of the first.
const MOST_TRIALS: usize = 4;
/// Growth of the registered views after which all are adjusted; in between, only what is around each new one. A
/// geometric growth keeps the cost of all adjustments together at six times that of the last.
const ADJUST_GROWTH: f64 = 1.2;
/// Focal lengths that a view of a lens that is not known yet is tried with, as factors on that of another one: a
/// quarter of an octave apart, from a third to three times.
const OTHER_FOCALS: std::ops::RangeInclusive<i32> = -6..=6;
const FOCALS_PER_OCTAVE: f64 = 4.0;

/// A view left out, and why.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unregistered {
    pub view: usize,
    /// Points of the reconstruction that it sees.
    pub points: usize,
    /// How many of these agreed with a pose.
    pub agreeing: usize,
}

/// What came of the trials of a view.
#[derive(Debug, Clone, Copy, Default)]
pub struct Trial {
    count: usize,
    /// Points that it saw at the last, how many of them were asked, and how many agreed.
    seen: usize,
    points: usize,
    agreeing: usize,
}

/// Joins to a part every view that can be, those that see most of its points first.
///
/// # Errors
/// [`Error::Stopped`].
pub fn join(
    scene: &Scene,
    model: &mut Model,
    part: u32,
    trials: &mut [Trial],
    recorder: &mut Recorder,
) -> Result<(), Error> {
    let views = block::observed_views(scene.context.input).len().max(1) as f64;
    let mut rng = ChaCha8Rng::seed_from_u64(scene.context.settings.seed);
    // Views that another part could not take may fit this one.
    trials.iter_mut().for_each(|trial| trial.count = 0);
    model.turn_to(scene, part);
    settle(scene, model, part, recorder);
    let mut adjusted_at = model.of_part(part).len();
    loop {
        scene.context.stopped()?;
        let Some((view, seen)) = next(scene, model, part, trials) else {
            // What a last adjustment moves may let a view fit that did not.
            if model.of_part(part).len() == adjusted_at {
                break;
            }
            settle(scene, model, part, recorder);
            adjusted_at = model.of_part(part).len();
            continue;
        };
        let (points, agreeing) = register(scene, model, part, view, &seen, &mut rng, recorder);
        let trial = &mut trials[view];
        *trial = Trial { count: trial.count + 1, seen: seen.len(), points, agreeing };
        let grown = model.of_part(part).len();
        if grown as f64 >= ADJUST_GROWTH * adjusted_at as f64 {
            settle(scene, model, part, recorder);
            adjusted_at = grown;
            recorder.standing.inliers = adjust::verified(model).len() as u32;
        }
        let registered = model.registered();
        let focal = model.log_focal(scene.camera_of[view], &registered).exp();
        recorder.standing.focal_px = Some(focal * scene.context.scale_px);
        recorder.registered(registered.len());
        recorder.tell(super::SHARE_OF_REGISTERING * registered.len() as f64 / views);
    }
    Ok(())
}

/// The views that were not registered, with what came of the last trial of each.
pub fn left(scene: &Scene, model: &Model, trials: &[Trial]) -> Vec<Unregistered> {
    let views = block::observed_views(scene.context.input).into_iter();
    views
        .filter(|&view| model.poses[view].is_none())
        .map(|view| Unregistered { view, points: trials[view].points, agreeing: trials[view].agreeing })
        .collect()
}

/// Adjusts a part and triangulates it anew.
fn settle(scene: &Scene, model: &mut Model, part: u32, recorder: &mut Recorder) {
    adjust::while_growing(scene, model, part, recorder);
    adjust::rescale(scene, model, part);
    structure::triangulate_seen(scene, model, &model.of_part(part), recorder);
}

/// Observations of a view whose track has a point of the part that may support a pose.
fn supported(scene: &Scene, model: &Model, part: u32, view: usize) -> Vec<usize> {
    let supports = |k: &usize| {
        model.landmarks[scene.track_of(*k)].is_some_and(|landmark| landmark.part == part && landmark.supports())
    };
    scene.of_view[view].iter().map(|&k| k as usize).filter(supports).collect()
}

/// The view to try next, the one that sees most points, with these observations.
fn next(scene: &Scene, model: &Model, part: u32, trials: &[Trial]) -> Option<(usize, Vec<usize>)> {
    let is_open = |&view: &usize| {
        let trial = trials[view];
        let worth = trial.count == 0 || model.supported[view] as f64 >= RETRY_GROWTH * trial.seen as f64;
        model.poses[view].is_none() && trial.count < MOST_TRIALS && worth && model.supported[view] >= LEAST_POINTS
    };
    let mut open: Vec<usize> = (0..model.poses.len()).filter(is_open).collect();
    // The first of equals, so that one input has one answer.
    open.sort_by_key(|&view| (std::cmp::Reverse(model.supported[view]), view));
    open.into_iter().find_map(|view| {
        let seen = supported(scene, model, part, view);
        let worth = trials[view].count == 0 || seen.len() as f64 >= RETRY_GROWTH * trials[view].seen as f64;
        (seen.len() >= LEAST_POINTS && worth).then_some((view, seen))
    })
}

/// Registers a view if enough of the points it sees agree; returns how many were asked and how many do.
fn register(
    scene: &Scene,
    model: &mut Model,
    part: u32,
    view: usize,
    seen: &[usize],
    rng: &mut ChaCha8Rng,
    recorder: &mut Recorder,
) -> (usize, usize) {
    let is_new_lens = model.is_focal_unknown(scene, view);
    let step = seen.len().div_ceil(MOST_POINTS).max(1);
    let seen: Vec<usize> = seen.iter().copied().step_by(step).collect();
    let found = guesses(scene, model, view)
        .into_iter()
        .filter_map(|intrinsics| Some((intrinsics, robust_pose(scene, model, &intrinsics, &seen, rng)?)))
        // The first of equals.
        .rev()
        .max_by_key(|(_, (_, agreeing))| *agreeing);
    let Some((intrinsics, (pose, agreeing))) = found else { return (seen.len(), 0) };
    if agreeing < LEAST_POINTS || (agreeing as f64) < LEAST_SHARE * seen.len() as f64 {
        return (seen.len(), agreeing);
    }
    model.set_intrinsics(scene, view, intrinsics);
    model.register(scene, view, part, pose);
    structure::triangulate_seen(scene, model, &[view], recorder);
    adjust::around(scene, model, view, is_new_lens, recorder);
    structure::triangulate_seen(scene, model, &[view], recorder);
    (seen.len(), agreeing)
}

/// Lenses to try a view with: its camera's own, or, of one that is not known yet, pinholes of what the input says, give
/// or take its deviation, or of a scan. Where views have focal lengths of their own, the scan is about that of the
/// nearest view, behind the lens that they share: a zoom takes time.
fn guesses(scene: &Scene, model: &Model, view: usize) -> Vec<Intrinsics> {
    let lens = &model.lenses[scene.camera_of[view]];
    if !model.is_focal_unknown(scene, view) {
        return vec![lens.intrinsics];
    }
    if let Some(prior) = scene.context.input.views()[view].focal_prior.filter(|_| !scene.has_own_focals()) {
        let focal = prior.focal_px / scene.context.scale_px;
        return [0.0, -1.0, 1.0].map(|by| Intrinsics::from_focal(focal * (by * prior.sigma_log).exp())).to_vec();
    }
    let nearest = model.determined().into_iter().min_by_key(|other| other.abs_diff(view));
    let nearest = nearest.filter(|_| scene.has_own_focals());
    let about = nearest.map_or(lens.intrinsics, |nearest| model.intrinsics_of(scene, nearest));
    let focal = |step: i32| about.focal * (f64::from(step) / FOCALS_PER_OCTAVE).exp2();
    // Of equals the first counts: from the middle outwards.
    let mut steps: Vec<i32> = OTHER_FOCALS.collect();
    steps.sort_by_key(|step| (step.abs(), *step));
    let guess = |step: i32| match nearest {
        Some(_) => Intrinsics { focal: focal(step), ..about },
        None => Intrinsics::from_focal(focal(step)),
    };
    steps.into_iter().map(guess).collect()
}

/// The pose that most of these observations agree with, and how many do.
fn robust_pose(
    scene: &Scene,
    model: &Model,
    intrinsics: &Intrinsics,
    seen: &[usize],
    rng: &mut ChaCha8Rng,
) -> Option<(Pose, usize)> {
    let pair = |&k: &usize| Some((model.landmarks[scene.track_of(k)]?.position, intrinsics.ray(&scene.xy[k])?));
    let (points, rays): (Vec<_>, Vec<_>) = seen.iter().filter_map(pair).unzip();
    let gate = model.gate(scene) / intrinsics.focal.powi(2);
    let found = pose::robust(&points, &rays, gate, rng, scene.stop())?;
    Some((found.model, found.inlier_count()))
}
