//! Whether the tracks that a reconstruction leaves out agree on motions of their own, and on which ([`motion`]).
//!
//! Only `assemble` depends on this; it solves subsets of the input as the rest of the solver does.

mod motion;

use std::cmp::Reverse;

pub use motion::describe;

use super::block::Block;
use super::calibration::FitOptions;
use super::classification::{Geometry, Judged};
use super::consensus::{self, LEAST_INLIERS, LEAST_SUPPORT};
use super::error::Error;
use super::priors;
use super::problem::{Problem, Undone};
use super::projective::ProjectiveReconstruction;
use super::recorder::Recorder;
use super::search::affine::AffineSearch;
use super::sequence::{self, Ended, ExtensionOptions};
use super::view_selection::ViewSelectionOptions;
use crate::domain::second_structure::{SecondStructure, SecondStructureKind};
use crate::domain::{Method, Silent, SolveSettings, StopToken, VERIFIED, Warning, WarningCode};

options! {
    /// What counts as a second structure, and what is said of its motion.
    pub struct SecondStructureOptions {
        /// Searches at most, each among the tracks that are left, and structures at most. Without a second structure
        /// the first is the last.
        most_searches: u64 = 6,
        /// Searches that may fail once a structure was found: as a rule there is one body, and each costs what the first
        /// did.
        most_failures: u32 = 1,
        /// Gates from which a track counts as left out: nearer ones are of the reconstruction, with an outlier's share
        /// of noise.
        far_gates: f64 = 16.0,
        /// Evidence, at least, as a share of that of the reconstruction. Of 600 photographed scenes 58 of 61 bodies that
        /// were found had .07 and more, wrong tracks of five scenes up to .033.
        least_share: f64 = 0.05,
        /// The same of a structure that explains the rest. The other three bodies had .013 and more.
        least_share_of_rest: f64 = 0.01,
        /// Share of the tracks left out, of those that three of its views see, from which a structure explains the rest.
        /// The bodies had .94 and more, the wrong tracks up to .88 in three scenes, and 1 in two: drifting ones, and
        /// static ones before a camera that hardly moved.
        explains_rest: f64 = 0.9,
        /// Share of the views of a reconstruction from which another one may be the scene in its place: many tracks in
        /// few views are less of it.
        most_views: f64 = 0.5,
        /// Tracks of a block from which the first structure is searched only where more than four of them fit affine
        /// cameras. In smaller blocks perspective hides that, and their search takes 10 to 20 ms; that of 190 wrong
        /// tracks took five times as long as the rest of an easy solve.
        affine_check_tracks: usize = ViewSelectionOptions::DEFAULT.wanted_tracks,
        /// Triplets that are searched. Of wrong matches each takes a tenth of a second.
        most_triplets: usize = 2,
        /// Views that the plane at infinity of a structure is taken from, and planes that are refined and compared: as
        /// many views as of the scan of a calibration; a body that is nearly a plane has two planes, and one is to
        /// spare.
        plane_views: usize = 4,
        planes: usize = 3,
        /// Iterations of its poses and points under the calibration: those of an algebraic solution.
        iterations: usize = 30,
        /// Root mean square of a point, in the noise of the scene, up to which it fits: that of a metric reconstruction
        /// up to which it is used.
        most_rms: f64 = FitOptions::DEFAULT.rms_ratio_refusal,
        /// Angle between the rays of its points, in the median, from which its poses are determined, radians: as that
        /// from which the depth of a point supports a pose. Below, it has only turned before the camera.
        least_angle: f64 = ExtensionOptions::DEFAULT.least_angle,
        /// Difference in the rotation of a view against the first, radians, from which another reconstruction that fits
        /// about as well has other poses. One minimum is reached to a millionth.
        other_poses: f64 = 0.02,
        /// Points by which it is compared with the scene, evenly chosen, and pairs of views that the ratio of the two
        /// scales is taken from. A median of 20 is known to a quarter of their spread; of five copies a fifth of the
        /// pairs is of one.
        compared_points: usize = 20,
        compared_scales: usize = 30,
        /// Share of all pairs of its views between which it must rest against the scene to count as a repeated
        /// structure. Of `k` copies, each in as many views, it rests between one pair in `k`; a body that moves rests
        /// between views that follow each other.
        least_resting: f64 = 0.2,
    }
}

const OPTIONS: SecondStructureOptions = SecondStructureOptions::DEFAULT;
/// The component with most views.
const LARGEST: u32 = 0;

/// Tracks that agree on another rigid motion.
pub struct Structure {
    /// Whether each track of the input does.
    pub tracks: Vec<bool>,
    /// What they make, up to a projective transform; `None` where nothing came of it.
    reconstruction: Option<ProjectiveReconstruction>,
}

impl Structure {
    /// That of these tracks, in the views of another reconstruction.
    pub fn of_tracks(problem: &Problem, geometry: &Geometry, tracks: Vec<bool>) -> Result<Self, Error> {
        let reconstruction = reconstructed(problem, geometry, &tracks, 0, |_| true)?.map(|(found, _)| found);
        Ok(Self { tracks, reconstruction })
    }

    /// As [`ProjectiveReconstruction::evidence`].
    fn evidence(&self, problem: &Problem) -> f64 {
        self.reconstruction.as_ref().map_or(0.0, |found| found.evidence(problem.outlier_density))
    }

    /// Which share of these tracks it explains, near-duplicates apart, of those that enough of its views see to verify
    /// them.
    fn explained_share(&self, problem: &Problem, tracks: &[bool]) -> f64 {
        let Some(reconstruction) = &self.reconstruction else { return 0.0 };
        let is_seen = |k: &usize| reconstruction.views.binary_search(&problem.view_of(*k)).is_ok();
        let may_be_of_it = |&track: &usize| {
            let takes_part = tracks[track] && !problem.is_near_duplicate(track);
            takes_part && problem.of_track(track).filter(is_seen).count() >= VERIFIED
        };
        let (explained, others): (Vec<usize>, Vec<usize>) =
            (0..tracks.len()).filter(may_be_of_it).partition(|&track| self.tracks[track]);
        explained.len() as f64 / (explained.len() + others.len()).max(1) as f64
    }
}

/// Searches the tracks that a reconstruction leaves out, in its views, for other rigid motions, one after the other:
/// the next among the tracks of none before.
///
/// * `evidence`: that of the reconstruction
/// * `known`: tracks that are not searched
pub fn find(
    problem: &Problem,
    geometry: &Geometry,
    judged: &Judged,
    evidence: f64,
    known: &[bool],
) -> Result<Vec<Structure>, Error> {
    let mut is_left = far_from(problem, geometry, judged);
    let leave_out = |is_left: &mut [bool], tracks: &[bool]| {
        is_left.iter_mut().zip(tracks).for_each(|(is_left, is_known)| *is_left &= !is_known);
    };
    leave_out(&mut is_left, known);
    let mut found = Vec::new();
    let mut failures = 0;
    for search in 0..OPTIONS.most_searches {
        // Of several bodies none need have most of what is left.
        let checks_affine = found.is_empty();
        let Some(next) = searched(problem, geometry, &is_left, search, checks_affine)? else {
            failures += 1;
            // Where there is one, another may have been missed among several: other samples may find it.
            if found.is_empty() || failures > OPTIONS.most_failures {
                break;
            }
            continue;
        };
        let explains_rest = next.explained_share(problem, &is_left) >= OPTIONS.explains_rest;
        let least_share = if explains_rest { OPTIONS.least_share_of_rest } else { OPTIONS.least_share };
        leave_out(&mut is_left, &next.tracks);
        // A weak one may have been found before a strong one.
        if next.evidence(problem) >= least_share * evidence {
            found.push(next);
        }
    }
    Ok(found)
}

/// What the input leads to without the inliers of a reconstruction, where one of its second structures has more tracks
/// in most of its views: then that may be the scene, and the reconstruction a second structure.
///
/// Tracks, not observations: a camera that walks round a body sees it all the time, and each point of the scene for a
/// while.
pub fn rival(
    problem: &Problem,
    geometry: &Geometry,
    judged: &Judged,
    structures: &[Structure],
) -> Result<Option<Ended>, Error> {
    let inliers = distinct_count(problem, &judged.tracks.inlier);
    let may_be_scene = |structure: &Structure| {
        let views = structure.reconstruction.as_ref().map_or(0, |found| found.views.len());
        let in_most_views = are_most(views, geometry);
        // What stands still in the image is no scene where something else moves, however many tracks it has.
        geometry.of_static || in_most_views && distinct_count(problem, &structure.tracks) > inliers
    };
    structures.iter().any(may_be_scene).then(|| solved_without(problem, &judged.tracks.inlier)).transpose()
}

/// Whether so many views are most of those of a reconstruction.
pub fn are_most(views: usize, of: &Geometry) -> bool {
    views as f64 >= OPTIONS.most_views * views_of_largest(of) as f64
}

/// Registered views of the largest component.
pub fn views_of_largest(geometry: &Geometry) -> usize {
    let views = geometry.component_of_view.iter().zip(&geometry.cameras);
    views.filter(|(component, camera)| **component == LARGEST && camera.is_some()).count()
}

/// How many of these tracks there are, near-duplicates counted once.
pub fn distinct_count(problem: &Problem, tracks: &[bool]) -> usize {
    (0..tracks.len()).filter(|&track| tracks[track] && !problem.is_near_duplicate(track)).count()
}

/// Those of some tracks that make another projective reconstruction.
///
/// * `search`: how many there were before
/// * `checks_affine`: whether large blocks must pass a check first
fn searched(
    problem: &Problem,
    geometry: &Geometry,
    is_left: &[bool],
    search: u64,
    checks_affine: bool,
) -> Result<Option<Structure>, Error> {
    if is_left.iter().filter(|is_left| **is_left).count() < LEAST_INLIERS {
        return Ok(None);
    }
    let passes = |block: &Block| !checks_affine || passes_affine_check(block, problem.stop);
    let Some((found, representative)) = reconstructed(problem, geometry, is_left, search, passes)? else {
        return Ok(None);
    };
    let agrees = |track: usize| found.tracks.binary_search(&representative[problem.representative[track]]).is_ok();
    let tracks = (0..problem.tracks()).map(agrees).collect();
    let is_enough = found.tracks.len() >= LEAST_INLIERS;
    let structure = Structure { tracks, reconstruction: Some(found) };
    Ok(Some(structure).filter(|structure| is_enough && structure.evidence(problem) > 0.0))
}

/// A projective reconstruction of some tracks in the registered views of the largest component, behind the lenses of
/// these, with the track that represents each; near-duplicates take no part.
///
/// * `search`: by which samples
/// * `is_promising`: which blocks are worth a search
fn reconstructed(
    problem: &Problem,
    geometry: &Geometry,
    tracks: &[bool],
    search: u64,
    is_promising: impl Fn(&Block) -> bool,
) -> Result<Option<(ProjectiveReconstruction, Vec<usize>)>, Error> {
    let is_registered = |view: usize| geometry.cameras[view].is_some() && geometry.component_of_view[view] == LARGEST;
    let takes_part = |track: usize| tracks[track] && !problem.is_near_duplicate(track);
    let input = problem.input.restricted_to(|k| takes_part(problem.track_of(k)) && is_registered(problem.view_of(k)));
    // One detector found all tracks, so that the noise is known.
    let noise_px = Some(geometry.noise * problem.scale_px);
    let seed = problem.settings.seed.wrapping_add(search);
    let settings = SolveSettings { method: Method::Geometry, noise_px, seed, ..problem.settings.clone() };
    let mut some = problem.of_some(&input, &settings);
    some.undone = lenses(problem, geometry, &some);
    let views = some.observed_views().len();
    let triplets = OPTIONS.most_triplets;
    let found = sequence::reconstruct_quickly(&some, is_promising, triplets, &mut Recorder::new(&mut Silent, views))?;
    Ok(found.map(|found| (found, some.representative)))
}

/// Whether a block is small, or more of its tracks fit affine cameras than determine projective ones. Any four tracks
/// fit some, and of wrong ones no fifth does (a test counts them).
fn passes_affine_check(block: &Block, stop: &StopToken) -> bool {
    let fits = || priors::affine_irls(AffineSearch::new(&block.complete).centred(), LEAST_SUPPORT, stop).is_some();
    block.tracks.len() < OPTIONS.affine_check_tracks || fits()
}

/// The input without these tracks, solved.
fn solved_without(problem: &Problem, tracks: &[bool]) -> Result<Ended, Error> {
    let input = problem.input.restricted_to(|k| !tracks[problem.track_of(k)]);
    let mut rest = problem.of_some(&input, problem.settings);
    let views = rest.observed_views().len();
    let mut ended = sequence::solve(&mut rest, &mut Recorder::new(&mut Silent, views))?;
    if let Ended::Block(Some(attempt)) = &mut ended {
        // All tracks are to be judged, not those of the rest alone.
        attempt.judged = None;
    }
    Ok(ended)
}

/// Those of some structures that enough tracks verify, most tracks first: inliers are of none, nor are static tracks,
/// which another warning reports.
pub fn verified(problem: &Problem, mut structures: Vec<Structure>, inlier: &[bool]) -> Vec<Structure> {
    let count = |structure: &Structure| structure.tracks.iter().filter(|is_of| **is_of).count();
    for structure in &mut structures {
        for (track, is_of) in structure.tracks.iter_mut().enumerate() {
            *is_of &= !inlier[track] && !problem.is_static[track];
        }
    }
    structures.retain(|structure| count(structure) >= LEAST_INLIERS);
    structures.sort_by_key(|structure| Reverse(count(structure)));
    structures.truncate(OPTIONS.most_searches as usize);
    structures
}

/// The number of the structure of each track, from 1; 0 for none, empty where there is none.
pub fn numbers(structures: &[Structure]) -> Vec<u32> {
    let mut numbers: Vec<u32> = structures.first().map_or_else(Vec::new, |first| vec![0; first.tracks.len()]);
    for (number, structure) in (1..).zip(structures) {
        let of_structure = numbers.iter_mut().zip(&structure.tracks).filter(|(_, is_of)| **is_of);
        of_structure.for_each(|(slot, _)| *slot = number);
    }
    numbers
}

/// Says of how many tracks these structures are, and what they are; `None` where there is none.
///
/// * `numbers`: that of the structure of each track
/// * `inliers`: tracks of the result
pub fn warning(structures: &[SecondStructure], numbers: &[u32], inliers: usize) -> Option<Warning> {
    let one = |structure: &SecondStructure| {
        let tracks = numbers.iter().filter(|number| **number == structure.number).count();
        let kind = match structure.kind {
            Some(SecondStructureKind::MovingBody) => "a body that moves against the scene of the result",
            Some(SecondStructureKind::RepeatedStructure) => {
                "a repeated structure, or a body that stands still at times"
            }
            None => "a second moving body, or a repeated structure",
        };
        format!("{tracks} tracks that are left out agree on another rigid motion: {kind}")
    };
    let each: Vec<String> = structures.iter().map(one).collect();
    let detail = format!("{}; the result is of {inliers} other tracks", each.join("; "));
    (!each.is_empty()).then(|| Warning::new(WarningCode::SecondStructure, detail))
}

/// Whether each track is far from the largest component of the reconstruction, of those that a search may go by. What
/// is far from another component may be of the largest.
fn far_from(problem: &Problem, geometry: &Geometry, judged: &Judged) -> Vec<bool> {
    let squared = |k: usize| {
        let residual_px = judged.observations.residual_px[problem.input.caller_index(k)];
        let squared = residual_px.map_or(f64::INFINITY, |residual_px| (residual_px / problem.scale_px).powi(2));
        geometry.given_weight(problem, k) * squared
    };
    let is_far = |track: usize| {
        let seen = geometry.of_track(problem, track);
        let gate = OPTIONS.far_gates * consensus::gate(seen.len()) * geometry.noise.powi(2);
        seen.len() >= VERIFIED && seen.iter().map(|&k| squared(k)).sum::<f64>() > gate
    };
    let is_asked = |track: usize| {
        let is_of_largest = geometry.component_of_track[track] == LARGEST;
        is_of_largest && !judged.tracks.inlier[track] && problem.supports_growth(track, false)
    };
    (0..problem.tracks()).map(|track| is_asked(track) && is_far(track)).collect()
}

/// The lenses of a reconstruction, to be undone before others are looked for.
fn lenses(problem: &Problem, geometry: &Geometry, rest: &Problem) -> Option<Undone> {
    let lens = |camera: usize| {
        let is_of = |view: &usize| problem.camera_of[*view] == camera && geometry.cameras[*view].is_some();
        let view = (0..problem.views()).find(is_of)?;
        Some((camera, *geometry.lenses.get(view)?))
    };
    Undone::new(rest, None, (0..problem.cameras).filter_map(lens))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Input, Limits};
    use crate::geometry::measurement::CompleteBlock;
    use crate::solver::block;
    use crate::synthetic::{Motion, Scene, SceneOptions};

    /// The tracks of a scene that are not of its first motion.
    fn left_out(options: &SceneOptions) -> CompleteBlock {
        let scene = Scene::generate(options).expect("valid options");
        let input = Input::new(scene.input, &Limits::default(), "scene").expect("a valid scene");
        let whole = block::of_all_views(&input);
        let wrong = |place: &usize| !scene.truth.inlier[whole.tracks[*place]];
        whole.complete.select(&(0..whole.tracks.len()).filter(wrong).collect::<Vec<_>>())
    }

    #[test]
    fn a_second_motion_has_more_tracks_that_agree_than_wrong_tracks_have_by_chance() {
        let base = SceneOptions { outliers: 0.6, ..SceneOptions::default() };
        let turned = SceneOptions { max_rotation_rad: 3.1, ..base.clone() };
        let kinds = [
            ("as it comes", base.clone()),
            ("20 views", SceneOptions { views: 20, ..base.clone() }),
            ("noisy", SceneOptions { noise: 0.01, ..base }),
            ("turned", turned.clone()),
            ("orbit", SceneOptions { motion: Motion::Orbit, ..turned }),
        ];
        for (kind, options) in kinds {
            for seed in 30_000..30_008 {
                let count = |second_motion: f64| {
                    let rest = left_out(&SceneOptions { second_motion, seed, ..options.clone() });
                    let ranking = priors::affine_irls(AffineSearch::new(&rest).centred(), 0, &StopToken::default());
                    let count = priors::agreeing(&ranking.expect("finite points"));
                    let held = priors::affine_irls(
                        AffineSearch::new(&rest).centred(),
                        consensus::LEAST_SUPPORT,
                        &StopToken::default(),
                    );
                    assert_eq!(held.is_some(), count >= consensus::LEAST_SUPPORT, "{kind}, seed {seed}: {count}");
                    count
                };
                let (chance, moved) = (count(0.0), count(0.3));
                assert!(chance <= 4, "{kind}, seed {seed}: {chance} agree by chance");
                assert!(moved >= 2 * consensus::LEAST_SUPPORT, "{kind}, seed {seed}: {moved} of a second motion agree");
            }
        }
    }
}
