//! Components that are merged by the tracks they share, however few these are for any one view.

use std::collections::BTreeMap;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::model::Model;
use super::structure;
use crate::geometry::similarity::{self, Sighting, Similarity};
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

options! {
    /// When components are merged.
    pub struct MergingOptions {
        /// Tracks that must agree, and sightings. Four sightings of four tracks determine the similarity; each of the
        /// others agrees with a wrong one by chance in one case of ten thousand, and there are some thousand samples.
        least_tracks: usize = 5,
        least_sightings: usize = 8,
        /// Share of the tracks that may agree which must. Below, the samples do not suffice.
        least_share: f64 = 0.3,
    }
}

const OPTIONS: MergingOptions = MergingOptions::DEFAULT;

/// Merges a component into another one that shares enough tracks with it, where there is one; that
/// other one.
///
/// Parts of a camera that only turned stay apart: any view that two tracks hold is registered by itself.
pub fn merge(problem: &Problem, model: &mut Model, component: u32, recorder: &mut Recorder) -> Option<u32> {
    if model.has_common_centre {
        return None;
    }
    let mut others = (0..component).filter(|&other| !model.of_component(other).is_empty());
    let (other, similarity) = others.find_map(|other| Some((other, similarity(problem, model, other, component)?)))?;
    let views = model.of_component(component);
    for &view in &views {
        model.poses[view] = model.poses[view].map(|pose| similarity.pose(&pose));
        model.component_of[view] = other;
    }
    for landmark in model.landmarks.iter_mut().flatten().filter(|landmark| landmark.component == component) {
        landmark.position = similarity.apply(&landmark.position);
        landmark.component = other;
    }
    structure::triangulate_seen(problem, model, &views, recorder);
    Some(other)
}

/// What takes the second component to the first.
fn similarity(problem: &Problem, model: &Model, first: u32, second: u32) -> Option<Similarity> {
    let (tracks, sightings): (Vec<usize>, Vec<Sighting>) = (0..problem.tracks())
        .flat_map(|track| sightings(problem, model, first, second, track).map(move |sighting| (track, sighting)))
        .unzip();
    let mut rng = ChaCha8Rng::seed_from_u64(problem.settings.seed);
    let found = similarity::robust(&sightings, problem.gate(model.noise), &mut rng, problem.stop)?;
    // Of each track, how many of its sightings agree, and how many there are.
    let mut counts: BTreeMap<usize, (usize, usize)> = BTreeMap::new();
    for (track, agrees) in tracks.iter().zip(&found.inlier) {
        let (agreeing, all) = counts.entry(*track).or_default();
        *agreeing += usize::from(*agrees);
        *all += 1;
    }
    let agreeing = counts.values().filter(|(agreeing, all)| 2 * agreeing > *all).count();
    let is_enough = found.inlier_count() >= OPTIONS.least_sightings
        && agreeing >= OPTIONS.least_tracks
        && agreeing as f64 >= OPTIONS.least_share * counts.len() as f64;
    is_enough.then_some(found.model)
}

/// What the views of one of two components see of a track whose landmark is in the other.
fn sightings<'a>(
    problem: &'a Problem,
    model: &'a Model,
    first: u32,
    second: u32,
    track: usize,
) -> impl Iterator<Item = Sighting> + 'a {
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
            Some(Sighting {
                camera: view,
                pose,
                is_second: component == second,
                point: landmark.position,
                seen: intrinsics.pinhole().ray(&undone.xy)?,
                weight: undone.weight * intrinsics.focal.powi(2),
            })
        })
    })
}
