//! The points of a reconstruction, triangulated from tracks with wrong links.

use nalgebra::Vector3;

use super::model::{Landmark, Model};
use super::options::ExtensionOptions;
use crate::domain::VERIFIED;
use crate::geometry::Point;
use crate::geometry::observation::Observation;
use crate::geometry::robust_triangulation::{Triangulator, or_zeros};
use crate::solver::per_track::each_track;
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

const OPTIONS: ExtensionOptions = ExtensionOptions::DEFAULT;

/// Triangulates every track anew.
pub fn triangulate(problem: &Problem, model: &mut Model, recorder: &mut Recorder) {
    let supports = |track: &usize| problem.supports_growth(*track, model.of_static);
    let tracks: Vec<usize> = (0..problem.tracks()).filter(supports).collect();
    triangulate_some(problem, model, &tracks, recorder);
}

/// Triangulates every track that these views see anew.
pub fn triangulate_seen(problem: &Problem, model: &mut Model, views: &[usize], recorder: &mut Recorder) {
    let seen = views.iter().flat_map(|&view| &problem.of_view[view]).map(|&k| problem.track_of(k as usize));
    let mut tracks: Vec<usize> = seen.filter(|&track| problem.supports_growth(track, model.of_static)).collect();
    tracks.sort_unstable();
    tracks.dedup();
    triangulate_some(problem, model, &tracks, recorder);
}

/// Triangulates these tracks anew from the registered views.
fn triangulate_some(problem: &Problem, model: &mut Model, tracks: &[usize], recorder: &mut Recorder) {
    let cameras = or_zeros(&model.cameras(problem));
    let triangulator = Triangulator::new(&cameras);
    let gate = problem.gate(model.noise);
    let find = |model: &Model, track: usize| landmark(problem, model, &triangulator, gate, track);
    each_track(problem, tracks, model, recorder, find, |model, track, found| {
        forget(problem, model, track);
        if let Some((landmark, agreeing)) = found {
            model.landmarks[track] = Some(landmark);
            agreeing.into_iter().for_each(|k| model.kept[k] = true);
        }
    });
}

/// The point of a track, with the observations that agree with it; `None` where there is none.
fn landmark(
    problem: &Problem,
    model: &Model,
    triangulator: &Triangulator,
    gate: f64,
    track: usize,
) -> Option<(Landmark, Vec<usize>)> {
    let component = component_of_track(problem, model, track)?;
    let seen: Vec<(usize, Observation)> = problem
        .of_track(track)
        .filter(|&k| model.component_of[problem.view_of(k)] == component)
        .filter_map(|k| Some((k, model.observation(problem, k)?)))
        .collect();
    if seen.len() < 2 {
        return None;
    }
    let observations: Vec<Observation> = seen.iter().map(|(_, observation)| *observation).collect();
    let found = triangulator.robust(&observations, gate)?;
    let position = if model.has_common_centre { found.point.xyz().normalize() } else { euclidean(&found.point)? };
    let agreeing = || seen.iter().zip(&found.agrees).filter(|(_, agrees)| **agrees).map(|(seen, _)| seen);
    let rays = agreeing().filter_map(|(_, observation)| {
        let pose = model.poses[observation.view]?;
        Some((position + pose.rotation.tr_mul(&pose.translation)).normalize())
    });
    let angle = if model.has_common_centre { std::f64::consts::PI } else { widest_angle(&rays.collect::<Vec<_>>()) };
    let agreeing: Vec<usize> = agreeing().map(|(k, _)| *k).collect();
    let is_enough = agreeing.len() as f64 >= problem.least_share * seen.len() as f64;
    is_enough.then_some((Landmark { position, angle, component, support: agreeing.len() }, agreeing))
}

/// Takes the point of a track away.
fn forget(problem: &Problem, model: &mut Model, track: usize) {
    model.landmarks[track] = None;
    problem.of_track(track).for_each(|k| model.kept[k] = false);
}

/// The component in whose views a track has most observations, the first of equals; `None`: in none.
pub fn component_of_track(problem: &Problem, model: &Model, track: usize) -> Option<u32> {
    let mut counts: Vec<(u32, usize)> = Vec::new();
    for k in problem.of_track(track) {
        let view = problem.view_of(k);
        if model.poses[view].is_none() {
            continue;
        }
        let component = model.component_of[view];
        match counts.iter_mut().find(|(known, _)| *known == component) {
            Some((_, count)) => *count += 1,
            None => counts.push((component, 1)),
        }
    }
    counts.into_iter().max_by(|a, b| a.1.cmp(&b.1).then(b.0.cmp(&a.0))).map(|(component, _)| component)
}

impl Landmark {
    /// Whether it may support the pose of a new view.
    pub fn supports(&self) -> bool {
        self.angle > if self.support >= VERIFIED { OPTIONS.least_angle } else { OPTIONS.least_angle_of_two }
    }

    /// Whether it takes part in adjustments.
    pub fn is_verified(&self) -> bool {
        self.support >= VERIFIED && self.angle > OPTIONS.least_angle
    }
}

/// `None` at infinity.
fn euclidean(point: &Point) -> Option<Vector3<f64>> {
    let position = point.xyz() / point.w;
    position.iter().all(|value| value.is_finite()).then_some(position)
}

/// About the largest angle between two of the unit rays, never more: that between the one farthest from their mean and
/// the one farthest from that, so that long tracks cost no more than short ones.
pub fn widest_angle(rays: &[Vector3<f64>]) -> f64 {
    let farthest = |from: &Vector3<f64>| rays.iter().min_by(|a, b| a.dot(from).total_cmp(&b.dot(from)));
    let mean: Vector3<f64> = rays.iter().sum();
    let ends = farthest(&mean).and_then(|end| Some((end, farthest(end)?)));
    // By the cross product: the arc cosine of a small angle is mostly rounding.
    ends.map_or(0.0, |(a, b)| a.cross(b).norm().atan2(a.dot(b)))
}
