//! Points from tracks of which some observations are wrong.

use nalgebra::Vector3;

use super::model::{Landmark, Model, Scene};
use crate::geometry::measurement::Sighting;
use crate::geometry::{Camera, Point, triangulation};

/// Sightings that a hypothesis is made of: links of a track are made between neighbouring views, so that a wrong one
/// parts it into runs that are right each.
const RUNS: [usize; 2] = [3, 2];
/// Sightings beyond which the hypotheses of a track are thinned: its rest decides as well.
const MOST_HYPOTHESES: usize = 30;
/// Refinement steps of a point.
const POINT_STEPS: usize = 8;
/// Observations that two views and one that verifies them make.
const VERIFIED: usize = 3;
/// Angle between the rays from which the depth of a point is known well enough to support a pose, radians: .3 degrees
/// leave a fifth of the depth open at the noise of feature detectors.
const LEAST_ANGLE: f64 = 0.005;
/// The same for points that only two views see, which nothing verifies.
const LEAST_ANGLE_OF_TWO: f64 = 0.02;
/// Tracks between two looks at the stop token.
const TRACKS_PER_LOOK: usize = 64;

/// Triangulates every track anew.
pub fn triangulate(scene: &Scene, model: &mut Model) {
    let tracks: Vec<usize> = (0..scene.tracks()).collect();
    triangulate_some(scene, model, &tracks);
}

/// Triangulates these tracks anew from the registered views.
pub fn triangulate_some(scene: &Scene, model: &mut Model, tracks: &[usize]) {
    let cameras = model.cameras();
    let gate = model.gate(scene);
    for (place, &track) in tracks.iter().enumerate() {
        if place.is_multiple_of(TRACKS_PER_LOOK) && scene.stop().is_stopped() {
            return;
        }
        let seen: Vec<(usize, Sighting)> =
            scene.of_track(track).filter_map(|k| Some((k, model.sighting(scene, k)?))).collect();
        scene.of_track(track).for_each(|k| model.kept[k] = false);
        model.landmarks[track] = None;
        if seen.len() < 2 {
            continue;
        }
        let sightings: Vec<Sighting> = seen.iter().map(|(_, sighting)| *sighting).collect();
        let Some((position, agrees)) = consensus(&cameras, &sightings, gate) else { continue };
        let rays = seen.iter().zip(&agrees).filter(|(_, agrees)| **agrees).filter_map(|((_, sighting), _)| {
            let pose = model.poses[sighting.view]?;
            Some((position + pose.rotation.tr_mul(&pose.translation)).normalize())
        });
        let landmark = Landmark {
            position,
            angle: widest_angle(&rays.collect::<Vec<_>>()),
            support: agrees.iter().filter(|&&agrees| agrees).count(),
        };
        model.landmarks[track] = Some(landmark);
        for ((k, _), agrees) in seen.iter().zip(agrees) {
            model.kept[*k] = agrees;
        }
    }
}

impl Landmark {
    /// Whether it may support the pose of a new view.
    pub fn supports(&self) -> bool {
        self.angle > if self.support >= VERIFIED { LEAST_ANGLE } else { LEAST_ANGLE_OF_TWO }
    }

    /// Whether it takes part in adjustments.
    pub fn is_verified(&self) -> bool {
        self.support >= VERIFIED && self.angle > LEAST_ANGLE
    }
}

/// The point that most sightings agree with, in front of their cameras, and which do; `None` where no two do.
fn consensus(cameras: &[Camera], sightings: &[Sighting], gate: f64) -> Option<(Vector3<f64>, Vec<bool>)> {
    let all = triangulation::linear(cameras, sightings);
    let (all, _) = triangulation::refine(cameras, sightings, all, POINT_STEPS);
    let agrees = agreeing(cameras, sightings, &all, gate);
    if agrees.iter().all(|&agrees| agrees) {
        return Some((euclidean(&all)?, agrees));
    }
    let mut best: Option<(Point, f64)> = None;
    let mut offer = |point: Point| {
        let cost = truncated(cameras, sightings, &point, gate);
        if best.is_none_or(|(_, least)| cost < least) {
            best = Some((point, cost));
        }
    };
    offer(all);
    for run in RUNS {
        let starts = (sightings.len() + 1).saturating_sub(run);
        for start in (0..starts).step_by(starts.div_ceil(MOST_HYPOTHESES).max(1)) {
            offer(triangulation::linear(cameras, &sightings[start..start + run]));
        }
    }
    // The widest pair of a track whose neighbours are all too near.
    if let [first, .., last] = sightings {
        offer(triangulation::linear(cameras, &[*first, *last]));
    }
    let (point, _) = best?;
    let mut agrees = agreeing(cameras, sightings, &point, gate);
    let right = chosen(sightings, &agrees);
    if right.len() < 2 {
        return None;
    }
    let (point, _) = triangulation::refine(cameras, &right, point, POINT_STEPS);
    let refined = agreeing(cameras, sightings, &point, gate);
    let count = |flags: &[bool]| flags.iter().filter(|&&flag| flag).count();
    if count(&refined) < count(&agrees).min(2) {
        return None;
    }
    agrees = refined;
    (count(&agrees) >= 2).then_some((euclidean(&point)?, agrees))
}

fn chosen(sightings: &[Sighting], which: &[bool]) -> Vec<Sighting> {
    sightings.iter().zip(which).filter(|(_, chosen)| **chosen).map(|(sighting, _)| *sighting).collect()
}

/// Whether each sighting is within the gate of the point, and the point in front of its camera.
fn agreeing(cameras: &[Camera], sightings: &[Sighting], point: &Point, gate: f64) -> Vec<bool> {
    sightings.iter().map(|sighting| squared(cameras, sighting, point) < gate).collect()
}

/// Squared residual, infinite behind the camera.
fn squared(cameras: &[Camera], sighting: &Sighting, point: &Point) -> f64 {
    let camera = &cameras[sighting.view];
    let depth = (camera.row(2) * point).x * point.w.signum();
    if depth <= 0.0 {
        return f64::INFINITY;
    }
    triangulation::reprojection(camera, point, &sighting.xy).norm_squared()
}

fn truncated(cameras: &[Camera], sightings: &[Sighting], point: &Point, gate: f64) -> f64 {
    sightings.iter().map(|sighting| squared(cameras, sighting, point).min(gate)).sum()
}

/// `None` at infinity.
fn euclidean(point: &Point) -> Option<Vector3<f64>> {
    let position = point.xyz() / point.w;
    position.iter().all(|value| value.is_finite()).then_some(position)
}

/// Largest angle between two of the unit rays: from their mean, twice the largest, so that long tracks cost no more.
fn widest_angle(rays: &[Vector3<f64>]) -> f64 {
    let Some(mean) = rays.iter().sum::<Vector3<f64>>().try_normalize(f64::MIN_POSITIVE) else { return 0.0 };
    2.0 * rays.iter().map(|ray| ray.dot(&mean).clamp(-1.0, 1.0).acos()).fold(0.0, f64::max)
}
