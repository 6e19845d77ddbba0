//! Components that are merged by all tracks that they share, where no view sees enough of them to be joined by itself.

use std::collections::{BTreeMap, BTreeSet};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::model::Model;
use super::structure;
use crate::geometry::similarity::{self, CrossObservation, Similarity, Support};
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

options! {
    /// When components are merged.
    pub struct MergingOptions {
        /// Tracks that must agree. Four determine the similarity. Each of the other three agrees with a wrong one by
        /// chance in four cases of ten thousand at a noise of a thousandth of the image, of a thousand at three
        /// thousandths; there are some thousand samples.
        least_tracks: usize = 7,
        /// Share of the tracks that they share which must. Tracks of a second body, or of repeated structure, agree with
        /// something else.
        least_share: f64 = 0.5,
        /// Tracks that must agree beside those of any one camera. A first determines the scale, and two confirm it.
        least_beside: usize = 3,
        /// Standard deviation of the logarithm of the scale at most: that of a focal length of grade WEAK. What is known
        /// less well is not reported either.
        most_sigma_log_scale: f64 = 0.1,
    }
}

const OPTIONS: MergingOptions = MergingOptions::DEFAULT;

/// Merges a component and another one that shares enough tracks with it, where there is one; the component that both
/// are then, the one found first.
///
/// Components of a camera that only turned are not merged.
pub fn merge(problem: &Problem, model: &mut Model, component: u32, recorder: &mut Recorder) -> Option<u32> {
    if model.has_common_centre {
        return None;
    }
    let (into, from, similarity) = sharing(problem, model, component).into_iter().find_map(|other| {
        let (into, from) = (other.min(component), other.max(component));
        Some((into, from, similarity(problem, model, into, from)?))
    })?;
    let views = model.of_component(from);
    model.merge(from, into, &similarity);
    structure::triangulate_seen(problem, model, &views, recorder);
    Some(into)
}

/// The other components that share with this one the tracks that a merger takes, increasing.
fn sharing(problem: &Problem, model: &Model, component: u32) -> Vec<u32> {
    let mut shared: BTreeMap<u32, usize> = BTreeMap::new();
    for track in 0..problem.tracks() {
        let views = problem.of_track(track).map(|k| problem.view_of(k)).filter(|&view| model.poses[view].is_some());
        let of_track: BTreeSet<u32> = views.map(|view| model.component_of[view]).collect();
        if of_track.contains(&component) {
            of_track.into_iter().for_each(|other| *shared.entry(other).or_default() += 1);
        }
    }
    shared.retain(|other, tracks| *other != component && *tracks >= OPTIONS.least_tracks);
    shared.into_keys().collect()
}

/// What takes the second component to the first, where their tracks bear it out.
fn similarity(problem: &Problem, model: &Model, first: u32, second: u32) -> Option<Similarity> {
    let of_track = |track| across(problem, model, first, second, track);
    let observations: Vec<CrossObservation> = (0..problem.tracks()).flat_map(of_track).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(problem.settings.seed);
    let found = similarity::robust(&observations, problem.gate(model.noise), &mut rng, problem.stop)?;
    let support = Support::new(&observations, &found, model.noise);
    let stands = support.agreeing >= OPTIONS.least_tracks
        && support.agreeing as f64 >= OPTIONS.least_share * support.tracks as f64
        && support.beside_one_camera >= OPTIONS.least_beside
        && support.sigma_log_scale <= OPTIONS.most_sigma_log_scale;
    stands.then_some(found.model)
}

/// The observations of a track by views of one of two components, where its landmark is in the other.
fn across<'a>(
    problem: &'a Problem,
    model: &'a Model,
    first: u32,
    second: u32,
    track: usize,
) -> impl Iterator<Item = CrossObservation> + 'a {
    let landmark = model.landmarks[track].filter(|landmark| landmark.supports());
    let across = landmark.and_then(|landmark| match landmark.component {
        of if of == first => Some((landmark, second)),
        of if of == second => Some((landmark, first)),
        _ => None,
    });
    across.into_iter().flat_map(move |(landmark, component)| {
        problem.of_track(track).filter_map(move |k| {
            let view = problem.view_of(k);
            let pose = model.poses[view].filter(|_| model.component_of[view] == component)?;
            let intrinsics = model.intrinsics_of(problem, view);
            let undone = intrinsics.undistorted(&problem.observation(k))?;
            Some(CrossObservation {
                track,
                camera: view,
                pose,
                is_second: component == second,
                point: landmark.position,
                xy: intrinsics.pinhole().ray(&undone.xy)?,
                weight: undone.weight * intrinsics.focal.powi(2),
            })
        })
    })
}
