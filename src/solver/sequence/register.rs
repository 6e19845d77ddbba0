//! Views joined to what stands, one after the other.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::adjust;
use super::model::{Model, Scene};
use super::structure;
use crate::geometry::pose;
use crate::solver::Error;
use crate::solver::recorder::Recorder;

/// Points that a view must see before it is tried, and that must agree with its pose: three determine it, and each of
/// the other five agrees with a wrong one by chance in one case of a hundred.
const LEAST_POINTS: usize = 8;
/// Share of the points seen that must agree.
const LEAST_SHARE: f64 = 0.1;
/// Points of a view beyond which a pose is not made better.
const MOST_POINTS: usize = 2_000;
/// Growth of the points that a view sees after which a failed one is tried again.
const RETRY_GROWTH: f64 = 1.2;
/// Trials of a view.
const MOST_TRIALS: usize = 4;
/// Growth of the registered views after which all are adjusted.
const ADJUST_GROWTH: f64 = 1.1;

/// A view left out, and why.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unregistered {
    pub view: usize,
    /// Points of the reconstruction that it sees.
    pub points: usize,
    /// How many of these agreed with its best pose.
    pub agreeing: usize,
}

#[derive(Debug, Clone, Copy, Default)]
struct Trial {
    count: usize,
    points: usize,
    agreeing: usize,
}

/// Registers every view that can be, those that see most points first; returns those that cannot.
///
/// # Errors
/// [`Error::Stopped`].
pub fn all(scene: &Scene, model: &mut Model, recorder: &mut Recorder) -> Result<Vec<Unregistered>, Error> {
    let views = super::super::block::observed_views(scene.context.input);
    let mut rng = ChaCha8Rng::seed_from_u64(scene.context.settings.seed);
    let mut trials = vec![Trial::default(); model.poses.len()];
    settle(scene, model);
    let mut adjusted_at = model.registered().len();
    loop {
        scene.context.stopped()?;
        let Some((view, seen)) = next(scene, model, &trials) else {
            // What a last adjustment moves may let a view fit that did not.
            if model.registered().len() == adjusted_at {
                break;
            }
            settle(scene, model);
            adjusted_at = model.registered().len();
            continue;
        };
        let agreeing = register(scene, model, view, &seen, &mut rng);
        trials[view] = Trial { count: trials[view].count + 1, points: seen.len(), agreeing };
        let registered = model.registered().len();
        if registered as f64 >= ADJUST_GROWTH * adjusted_at as f64 {
            settle(scene, model);
            adjusted_at = registered;
        }
        recorder.standing.inliers =
            model.landmarks.iter().flatten().filter(|landmark| landmark.is_verified()).count() as u32;
        recorder.standing.focal_px = Some(model.intrinsics.focal * scene.context.scale_px);
        recorder.tell(registered as f64 / views.len().max(1) as f64);
    }
    let left = views.into_iter().filter(|&view| model.poses[view].is_none());
    Ok(left
        .map(|view| Unregistered { view, points: supported(scene, model, view).len(), agreeing: trials[view].agreeing })
        .collect())
}

/// Adjusts what stands and triangulates it anew.
fn settle(scene: &Scene, model: &mut Model) {
    adjust::while_growing(scene, model);
    adjust::rescale(scene, model);
    structure::triangulate(scene, model);
}

/// Observations of a view whose track has a point that may support a pose.
fn supported(scene: &Scene, model: &Model, view: usize) -> Vec<usize> {
    let supports = |k: &usize| model.landmarks[scene.track_of(*k)].is_some_and(|landmark| landmark.supports());
    scene.of_view[view].iter().map(|&k| k as usize).filter(supports).collect()
}

/// The view to try next, the one that sees most points, with these observations.
fn next(scene: &Scene, model: &Model, trials: &[Trial]) -> Option<(usize, Vec<usize>)> {
    let open = (0..model.poses.len()).filter(|&view| model.poses[view].is_none()).filter_map(|view| {
        let trial = trials[view];
        if trial.count >= MOST_TRIALS {
            return None;
        }
        let seen = supported(scene, model, view);
        let worth = trial.count == 0 || seen.len() as f64 >= RETRY_GROWTH * trial.points as f64;
        (seen.len() >= LEAST_POINTS && worth).then_some((view, seen))
    });
    // The first of equals, so that one input has one answer.
    open.max_by(|a, b| a.1.len().cmp(&b.1.len()).then(b.0.cmp(&a.0)))
}

/// Registers a view if enough of the points it sees agree; returns how many do.
fn register(scene: &Scene, model: &mut Model, view: usize, seen: &[usize], rng: &mut ChaCha8Rng) -> usize {
    let step = seen.len().div_ceil(MOST_POINTS);
    let pairs: Vec<(usize, nalgebra::Vector2<f64>)> =
        seen.iter().step_by(step).filter_map(|&k| Some((k, model.ray(scene, k)?))).collect();
    let points: Vec<_> =
        pairs.iter().filter_map(|(k, _)| Some(model.landmarks[scene.track_of(*k)]?.position)).collect();
    let rays: Vec<_> = pairs.iter().map(|(_, ray)| *ray).collect();
    let gate = model.gate(scene) / model.intrinsics.focal.powi(2);
    let Some(found) = pose::robust(&points, &rays, gate, rng) else { return 0 };
    let agreeing = found.inlier.iter().filter(|&&inlier| inlier).count();
    if agreeing >= LEAST_POINTS && agreeing as f64 >= LEAST_SHARE * points.len() as f64 {
        model.poses[view] = Some(found.pose);
        let tracks: Vec<usize> = scene.of_view[view].iter().map(|&k| scene.track_of(k as usize)).collect();
        structure::triangulate_some(scene, model, &tracks);
    }
    agreeing
}
