//! Whether the tracks that a reconstruction leaves out agree on a motion of their own.

use super::Error;
use super::block::Block;
use super::classification::{Geometry, Judged};
use super::grow::{self, LEAST_INLIERS, LEAST_SUPPORT};
use super::problem::{Problem, Undone, VERIFIED};
use super::recorder::Recorder;
use super::search::affine::AffineSearch;
use super::sequence::{self, Ended};
use super::view_selection::ViewSelectionOptions;
use super::{near_duplicates, priors};
use crate::domain::{Method, Silent, SolveSettings, StopToken, Warning, WarningCode};

options! {
    /// What counts as a second structure.
    pub struct SecondStructureOptions {
        /// Gates from which a track counts as left out: nearer ones are of the reconstruction, with an outlier's share
        /// of noise.
        far_gates: f64 = 16.0,
        /// Evidence, at least, as a share of that of the reconstruction. Of 280 photographed scenes, drifting tracks of
        /// four had .01 to .03 in a few views; 27 of 31 second bodies had .07 and more.
        least_share: f64 = 0.05,
        /// Tracks of a block from which affine cameras are asked first whether it is worth searching. Of fewer than
        /// blocks should have, which perspective bends more than so few tell, a search takes some milliseconds; of 190
        /// wrong ones five times as long as the rest of an easy solve.
        asked_tracks: usize = ViewSelectionOptions::DEFAULT.wanted_tracks,
        /// Triplets that are tried. Of wrong matches each takes a tenth of a second.
        most_triplets: usize = 2,
    }
}

const OPTIONS: SecondStructureOptions = SecondStructureOptions::DEFAULT;

/// Tracks that agree on another rigid motion.
pub struct SecondStructure {
    /// Whether each track of the input does.
    pub tracks: Vec<bool>,
    /// What it leads to where it explains more of the input than the reconstruction: it is the scene then.
    pub scene: Option<Ended>,
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
    let is_far = far_from(problem, geometry, judged);
    if is_far.iter().filter(|is_far| **is_far).count() < LEAST_INLIERS {
        return Ok(None);
    }
    // What several parts of a reconstruction leave out may be what would join them.
    let is_seen = |view: usize| geometry.cameras[view].is_some() && geometry.component_of_view[view] == 0;
    let input = problem.input.only(|k| is_far[problem.track_of(k)] && is_seen(problem.view_of(k)));
    // The detector is the same.
    let noise_px = Some(geometry.noise * problem.scale_px);
    let settings = SolveSettings { method: Method::Geometry, noise_px, ..problem.settings.clone() };
    let mut rest = problem.of_some(&input, &settings);
    rest.undone = lenses(problem, geometry, &rest);
    let is_promising = |block: &Block| is_promising(&near_duplicates::without(&rest, block.clone()), rest.stop);
    let mut silent = Silent;
    let mut recorder = Recorder::new(&mut silent, rest.observed_views().len());
    let second = sequence::reconstruct_quickly(&rest, is_promising, OPTIONS.most_triplets, &mut recorder)?;
    let Some(second) = second else { return Ok(None) };
    let evidence_of_second = second.evidence(problem.outlier_density);
    if evidence_of_second < OPTIONS.least_share * evidence {
        return Ok(None);
    }
    let agrees = |track: usize| second.tracks.binary_search(&problem.representative[track]).is_ok();
    let tracks = (0..problem.tracks()).map(agrees).collect();
    let scene = (evidence_of_second > evidence).then(|| of_the_rest(problem, judged)).transpose()?;
    let scene = scene.filter(|scene| scene.evidence(problem) > evidence);
    Ok(Some(SecondStructure { tracks, scene }))
}

/// Whether a search is worth its time: where that is short, or more tracks agree on affine cameras than determine
/// projective ones. Any four do, and of wrong ones no fifth does (a test counts them).
fn is_promising(block: &Block, stop: &StopToken) -> bool {
    let agree = || priors::affine_irls(AffineSearch::new(&block.complete).centred(), LEAST_SUPPORT, stop).is_some();
    block.tracks.len() < OPTIONS.asked_tracks || agree()
}

/// The tracks that are no inliers, solved as an input of its own.
fn of_the_rest(problem: &Problem, judged: &Judged) -> Result<Ended, Error> {
    let input = problem.input.only(|k| !judged.tracks.inlier[problem.track_of(k)]);
    let mut rest = problem.of_some(&input, problem.settings);
    let views = rest.observed_views().len();
    let mut ended = sequence::solve(&mut rest, &mut Recorder::new(&mut Silent, views))?;
    if let Ended::Block(Some(attempt)) = &mut ended {
        // Of the rest alone.
        attempt.judged = None;
    }
    Ok(ended)
}

/// What is said of tracks that agree on another motion.
///
/// * `second`: whether each track does
/// * `first`: whether each is of the result
pub fn warning(second: &[bool], first: &[bool]) -> Warning {
    let [second, first] = [second, first].map(|tracks| tracks.iter().filter(|is_of| **is_of).count());
    let detail = format!(
        "{second} tracks that are left out agree on another rigid motion: a second moving body, or a repeated \
         structure; the result is that of the set that explains more, {first} tracks, not of both"
    );
    Warning::new(WarningCode::SecondStructure, detail)
}

/// Whether each track is far from the reconstruction, of those that a search may go by.
fn far_from(problem: &Problem, geometry: &Geometry, judged: &Judged) -> Vec<bool> {
    let is_far = |track: usize| {
        let seen = geometry.of_track(problem, track);
        let squared: f64 = seen
            .iter()
            .map(|&k| judged.observations.residual_px[problem.input.caller_index(k)])
            .map(|residual| residual.map_or(f64::INFINITY, |residual| (residual / problem.scale_px).powi(2)))
            .sum();
        let gate = OPTIONS.far_gates * grow::gate(seen.len()) * geometry.noise.powi(2);
        seen.len() >= VERIFIED && squared > gate
    };
    (0..problem.tracks())
        .map(|track| !judged.tracks.inlier[track] && problem.supports_growth(track, false) && is_far(track))
        .collect()
}

/// The lenses of a reconstruction, to be undone before others are looked for.
fn lenses(problem: &Problem, geometry: &Geometry, rest: &Problem) -> Option<Undone> {
    let mut undone = None;
    for camera in 0..problem.cameras {
        let view =
            (0..problem.views()).find(|&view| problem.camera_of[view] == camera && geometry.cameras[view].is_some());
        let lens = view.and_then(|view| geometry.lenses.get(view)).filter(|lens| lens.distorts());
        if let Some(lens) = lens {
            undone = Undone::new(rest, undone.as_ref(), camera, *lens).or(undone);
        }
    }
    undone
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
