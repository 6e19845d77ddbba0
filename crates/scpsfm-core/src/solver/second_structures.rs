//! Whether the tracks that a reconstruction leaves out agree on a motion of their own.

use super::Error;
use super::block::Block;
use super::classification::{Geometry, Judged};
use super::grow::{self, LEAST_INLIERS, LEAST_SUPPORT};
use super::priors;
use super::problem::{Problem, Undone, VERIFIED};
use super::recorder::Recorder;
use super::search::affine::AffineSearch;
use super::sequence::{self, Ended, ProjectiveReconstruction};
use super::view_selection::ViewSelectionOptions;
use crate::domain::result::TrackResults;
use crate::domain::{Method, Silent, SolveSettings, StopToken, Warning, WarningCode};

options! {
    /// What counts as a second structure.
    pub struct SecondStructureOptions {
        /// Gates from which a track counts as left out: nearer ones are of the reconstruction, with an outlier's share
        /// of noise.
        far_gates: f64 = 16.0,
        /// Evidence, at least, as a share of that of the reconstruction. Of 280 photographed scenes, drifting tracks of
        /// four had .01 to .03 in a few views; of 31 second bodies 27 had .07 and more, one .01, and three none.
        least_share: f64 = 0.05,
        /// Tracks of a block from which it is searched only where more than four of them fit affine cameras. In smaller
        /// blocks perspective hides that, and their search takes 10 to 20 ms; that of 190 wrong tracks took five times
        /// as long as the rest of an easy solve.
        affine_check_tracks: usize = ViewSelectionOptions::DEFAULT.wanted_tracks,
        /// Triplets that are searched. Of wrong matches each takes a tenth of a second.
        most_triplets: usize = 2,
    }
}

const OPTIONS: SecondStructureOptions = SecondStructureOptions::DEFAULT;
/// The component with most views.
const LARGEST: u32 = 0;

/// Tracks that agree on another rigid motion.
pub struct SecondStructure {
    /// Whether each track of the input does.
    pub tracks: Vec<bool>,
    /// What it leads to where it explains more of the input than the reconstruction.
    pub rival: Option<Ended>,
}

/// Searches the tracks that a reconstruction leaves out, in its views, for another rigid motion.
///
/// * `evidence`: that of the reconstruction
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn find(
    problem: &Problem,
    geometry: &Geometry,
    judged: &Judged,
    evidence: f64,
) -> Result<Option<SecondStructure>, Error> {
    let Some((tracks, evidence_of_second)) = searched(problem, geometry, judged)? else { return Ok(None) };
    if evidence_of_second < OPTIONS.least_share * evidence {
        return Ok(None);
    }
    // What stands still in the image is no scene where something else moves, however many tracks it has.
    let explains_more = |other: f64| geometry.of_static || other > evidence;
    let rival =
        explains_more(evidence_of_second).then(|| solved_without(problem, &judged.tracks.inlier)).transpose()?;
    let rival = rival.filter(|rival| explains_more(rival.evidence(problem)));
    Ok(Some(SecondStructure { tracks, rival }))
}

/// The tracks of another projective reconstruction and its evidence, if there is one.
fn searched(problem: &Problem, geometry: &Geometry, judged: &Judged) -> Result<Option<(Vec<bool>, f64)>, Error> {
    let is_far = far_from(problem, geometry, judged);
    if is_far.iter().filter(|is_far| **is_far).count() < LEAST_INLIERS {
        return Ok(None);
    }
    let is_registered = |view: usize| geometry.cameras[view].is_some() && geometry.component_of_view[view] == LARGEST;
    let input = problem.input.restricted_to(|k| is_far[problem.track_of(k)] && is_registered(problem.view_of(k)));
    // One detector found all tracks, so that the noise is known.
    let noise_px = Some(geometry.noise * problem.scale_px);
    let settings = SolveSettings { method: Method::Geometry, noise_px, ..problem.settings.clone() };
    let mut rest = problem.of_some(&input, &settings);
    rest.undone = lenses(problem, geometry, &rest);
    let passes = |block: &Block| passes_affine_check(block, rest.stop);
    let views = rest.observed_views().len();
    let triplets = OPTIONS.most_triplets;
    let found = sequence::reconstruct_quickly(&rest, passes, triplets, &mut Recorder::new(&mut Silent, views))?;
    let evidence = |found: &ProjectiveReconstruction| found.evidence(problem.outlier_density);
    let Some(found) = found.filter(|found| found.tracks.len() >= LEAST_INLIERS && evidence(found) > 0.0) else {
        return Ok(None);
    };
    let agrees = |track: usize| {
        let representative = rest.representative[problem.representative[track]];
        found.tracks.binary_search(&representative).is_ok()
    };
    Ok(Some(((0..problem.tracks()).map(agrees).collect(), evidence(&found))))
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

/// Marks these tracks, but for inliers and static ones, which another warning reports, and says so; `None` where they are
/// too few to be verified.
pub fn mark(problem: &Problem, second: &[bool], tracks: &mut TrackResults) -> Option<Warning> {
    let is_marked = |track: usize| second[track] && !tracks.inlier[track] && !problem.is_static[track];
    let marked: Vec<bool> = (0..problem.tracks()).map(is_marked).collect();
    let [second, first] = [&marked, &tracks.inlier].map(|tracks| tracks.iter().filter(|is_of| **is_of).count());
    if second < LEAST_INLIERS {
        return None;
    }
    tracks.second_structure = marked.into_iter().map(u32::from).collect();
    let detail = format!(
        "{second} tracks that are left out agree on another rigid motion: a second moving body, or a repeated \
         structure; the result is of {first} other tracks, not of both"
    );
    Some(Warning::new(WarningCode::SecondStructure, detail))
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
        let gate = OPTIONS.far_gates * grow::gate(seen.len()) * geometry.noise.powi(2);
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
                        grow::LEAST_SUPPORT,
                        &StopToken::default(),
                    );
                    assert_eq!(held.is_some(), count >= grow::LEAST_SUPPORT, "{kind}, seed {seed}: {count}");
                    count
                };
                let (chance, moved) = (count(0.0), count(0.3));
                assert!(chance <= 4, "{kind}, seed {seed}: {chance} agree by chance");
                assert!(moved >= 2 * grow::LEAST_SUPPORT, "{kind}, seed {seed}: {moved} of a second motion agree");
            }
        }
    }
}
