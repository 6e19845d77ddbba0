//! Whether the tracks left out agree on a motion of their own.

use super::a_contrario::{self, FalseAlarmOptions};
use super::grow::{self, Consensus, Fits};
use super::portfolio;
use super::priors;
use super::search::{affine, rigid};
use crate::domain::{StopToken, Warning, WarningCode};
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::statistics::chi_square_gate;

/// Gates of the first consensus from which a track counts as left out: nearer ones are its own, with an outlier's share
/// of noise.
const FAR_GATES: f64 = 16.0;
/// Tracks of a second structure, at least, as a share of the first: a handful that moves together is no second body.
const LEAST_SHARE: f64 = 0.1;

/// Searches the tracks that a consensus leaves out for another; the tracks of the block that agree, where they are
/// enough.
pub fn find(block: &CompleteBlock, consensus: &Consensus, stop: &StopToken) -> Option<Vec<usize>> {
    let gate = FAR_GATES * chi_square_gate((2 * block.views()) as f64 - 3.0) * consensus.noise * consensus.noise;
    let left: Vec<usize> =
        (0..block.tracks()).filter(|&track| !consensus.inlier[track] && consensus.squared[track] > gate).collect();
    if left.len() < grow::LEAST_INLIERS {
        return None;
    }
    let rest = block.select(&left);
    let second = match rest.has_depths() {
        true => by_depths(&rest, consensus.noise, stop),
        false => by_image_points(&rest, consensus.noise, stop),
    };
    let second: Vec<usize> = second?.into_iter().map(|track| left[track]).collect();
    let least = LEAST_SHARE * consensus.inlier_count() as f64;
    (second.len() >= grow::LEAST_INLIERS && second.len() as f64 >= least).then_some(second)
}

/// What is said of tracks that agree on a motion of their own, unless the result holds most of them: a lens that the
/// search did not know may have brought them in.
///
/// * `second`: of the input, as [`find`] has found them
/// * `inlier`: the verdict on every track of the input
pub fn warning(second: &[usize], inlier: &[bool]) -> Option<Warning> {
    let left = second.iter().filter(|track| !inlier[**track]).count();
    let first = inlier.iter().filter(|inlier| **inlier).count();
    (left >= grow::LEAST_INLIERS && 2 * left >= second.len()).then(|| {
        let detail = format!(
            "about {left} tracks that are left out agree on another rigid motion: a second moving body, or a repeated \
             structure; the result is that of the set that was found first, {first} tracks, not of both"
        );
        Warning::new(WarningCode::SecondStructure, detail)
    })
}

/// Tracks of another rigid shape, where depths are given.
fn by_depths(rest: &CompleteBlock, noise: f64, stop: &StopToken) -> Option<Vec<usize>> {
    let search = rigid::RigidSearch::new(rest, portfolio::spread(rest), stop)?;
    let found = search.run(noise)?;
    let is_decisive = found.ln_false_alarms(search.spread()) < FalseAlarmOptions::DEFAULT.ln_decisive;
    is_decisive.then(|| (0..found.inlier.len()).filter(|&track| found.inlier[track]).collect())
}

/// Tracks of another projective reconstruction: one ranking, grown; a structure that takes more to be found is not
/// worth the time that every solve would spend.
///
/// Nothing is grown where the ranking holds fewer tracks than determine cameras. Any four tracks agree on affine
/// cameras, and of wrong ones no fifth does (a test counts them); growing from those by chance took nearly as long as
/// the rest of a solve.
fn by_image_points(rest: &CompleteBlock, noise: f64, stop: &StopToken) -> Option<Vec<usize>> {
    let ranking = priors::affine_irls(affine::AffineSearch::new(rest).centred(), grow::LEAST_SUPPORT, stop)?;
    let costs: Vec<f64> = ranking.iter().map(|weight| -weight).collect();
    let spread = portfolio::spread(rest);
    affine::seeds_from_ranking(rest, &costs).into_iter().find_map(|seed| {
        let mut fits = Fits::new(rest, noise, stop);
        let rough = fits.grow(seed)?;
        if rough.inlier_count() < grow::LEAST_SUPPORT {
            return None;
        }
        let found = fits.polish(rough);
        let is_decisive = found.inlier_count() >= grow::LEAST_INLIERS
            && a_contrario::ln_false_alarms(rest, &found, spread, stop) < FalseAlarmOptions::DEFAULT.ln_decisive;
        is_decisive.then(|| found.inliers())
    })
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
                    let ranking =
                        priors::affine_irls(affine::AffineSearch::new(&rest).centred(), 0, &StopToken::default());
                    let count = priors::agreeing(&ranking.expect("finite points"));
                    let held = priors::affine_irls(
                        affine::AffineSearch::new(&rest).centred(),
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
