//! Whether a consensus may be chance: the expected number of such among tracks without structure.
//!
//! Two bounds. Residuals are compared with the spread of the image points, as if the reconstructions of a set of tracks
//! were a plane among their coordinates. That they are not: cameras bend it, and where the gate is as wide as a tenth
//! of the image, random tracks in three views fit some cameras or other. So the cameras that were found are tried on
//! random tracks too: what residuals these leave takes the place of the spread. This bound is the coarser one: it has a
//! veto, where it does not hold, and the other one ranks.
//!
//! Tracks that lie within the noise of each other in every view are one track for both, where they are more than lie
//! there by chance: they tell nothing of the cameras that one of them does not.

mod random;

use nalgebra::Vector2;

use super::consensus::{self, Consensus, LEAST_INLIERS, LEAST_SUPPORT};
use crate::domain::StopToken;
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::statistics::{chi_square_gate, ln_choose};
use crate::geometry::triangulation;
use random::{Tail, constraints_of_track, gate};

options! {
    /// When a consensus is not held to be chance, and how the tracks without structure are tried that say so.
    pub struct FalseAlarmOptions {
        /// Logarithm of the expected number of false alarms at which a consensus is decisive, for that is never by
        /// chance, and at which it may be accepted once the search has ended.
        ln_decisive: f64 = -40.0,
        ln_acceptable: f64 = -7.0,
        /// The same by the cameras, above which nothing is accepted. Refining makes them fit more than the seven tracks
        /// that determine them. Of 200 entirely wrong inputs of 3 to 10 views none is answered, and eight right tracks
        /// among 200 in ten views are.
        ln_by_cameras: f64 = -10.0,
        /// Noise levels that a consensus is grown and settled at, each a test of its own. Five of the search, one of
        /// the refinement.
        noise_levels: f64 = 6.0,
        /// Neighbours of a point that are no near-duplicates: as many as of points anywhere in the image, and so many
        /// standard deviations of their number (Poisson's).
        usual_sigmas: f64 = 2.0,
        /// Random tracks that cameras are tried on. Some milliseconds at 10 views, for the few consensuses that may be
        /// accepted.
        random_tracks: usize = 500,
        /// Share of random tracks whose residual is measured, and the standard normal quantile of that share; smaller
        /// residuals are extrapolated from there. Ten of 500 tracks: known to a third.
        measured_share: f64 = 0.02,
        measured_quantile: f64 = -2.053_749,
        /// What those residuals are at least, a constraint, as a share of the variance of the image points. Cameras
        /// that verify by that much need not be tried. Cameras that do not bend the images of a set of tracks leave a
        /// fiftieth of random tracks .06 (three views) to .4 (ten) of it, and what bends them is allowed to take most
        /// of that.
        least_measured: f64 = 0.01,
        /// Residuals that stand for those of the smallest share, and the least of them as a share of what the inliers
        /// leave. Ratios of 1.02 to 1.3 where cameras may be doubted.
        extrapolated: i32 = 64,
        /// What is smaller has next to no probability.
        least_extrapolated: f64 = 0.25,
        /// Bisections of the tilt of the distribution. Three digits.
        tilt_steps: usize = 12,
    }
}

const OPTIONS: FalseAlarmOptions = FalseAlarmOptions::DEFAULT;

/// Natural logarithm of the number of such consensuses to be expected in data without structure: by residuals, and
/// [`FalseAlarmOptions::ln_acceptable`] or more where the cameras say that it may be chance. They are asked only where
/// the residuals would have it accepted.
///
/// * `spread`: see [`Consensus::ln_false_alarms_by_residuals`]
pub fn ln_false_alarms(block: &CompleteBlock, consensus: &Consensus, spread: f64, stop: &StopToken) -> f64 {
    let distinct = consensus.distinct_count(spread);
    let by_residuals = consensus.ln_false_alarms_by_residuals(spread, distinct);
    if by_residuals >= OPTIONS.ln_acceptable {
        return by_residuals;
    }
    let by_cameras = by_cameras(block, consensus, distinct, spread, stop);
    if by_cameras < OPTIONS.ln_by_cameras { by_residuals } else { by_cameras.max(OPTIONS.ln_acceptable) }
}

/// The same by the cameras: a-contrario as by Moisan & Stival (2004, section 3). Of `k` inliers [`LEAST_SUPPORT`]
/// determine the cameras, and the others are admitted by chance and leave as little on average with a probability of
/// `a` each: for every noise level and size of set,
///
/// `C(m, k) C(k, 7) a^(k - 7)`
///
/// `a` is the probability to be admitted at most, and less where the gate is so wide that it tells nothing: see
/// [`random::ln_as_good`].
///
/// * `inliers`: that differ, see [`Consensus::distinct_count`]
fn by_cameras(block: &CompleteBlock, consensus: &Consensus, inliers: usize, spread: f64, stop: &StopToken) -> f64 {
    let tracks = consensus.inlier.len();
    if inliers < LEAST_INLIERS {
        return f64::INFINITY;
    }
    let tests =
        ln_choose(tracks, inliers) + ln_choose(inliers, LEAST_SUPPORT) + (tracks as f64 * OPTIONS.noise_levels).ln();
    let at = |ln_by_chance: f64| tests + (inliers - LEAST_SUPPORT) as f64 * ln_by_chance;
    let constraints = constraints_of_track(block);
    let variance = spread * spread;
    let measured = OPTIONS.least_measured * constraints * variance;
    let least = Tail { constraints, variance, measured };
    let at_most = at(least.ln_below(gate(block, consensus)));
    if at_most < OPTIONS.ln_by_cameras {
        return at_most;
    }
    match random::residuals(block, consensus, stop) {
        Some(squared) => at(random::ln_as_good(block, consensus, &squared, variance)),
        // To stop is to accept nothing.
        None => f64::INFINITY,
    }
}

/// Natural logarithm of the number of false alarms by residuals, `m C(m, k) p`: the sizes and sets of inliers, times
/// the probability that unstructured coordinates leave residuals this small.
///
/// * `tracks`, `inliers`: m and k
/// * `constraints`: that the inliers leave over
/// * `rms`: of the residuals, one coordinate; `spread`: standard deviation of unstructured coordinates, same unit
pub fn ln_false_alarms_of(tracks: usize, inliers: usize, constraints: f64, rms: f64, spread: f64) -> f64 {
    let ln_probability = 0.5 * constraints * (1.0 + 2.0 * (rms.max(f64::MIN_POSITIVE) / spread).ln()).min(0.0);
    ln_choose(tracks, inliers) + (tracks as f64).ln() + ln_probability
}

impl Consensus {
    /// Natural logarithm of the number of such consensuses to be expected in data without structure (Moisan & Stival
    /// 2004, a-contrario): all subsets of that size, times the probability that unstructured coordinates of standard
    /// deviation `spread` leave residuals this small in all constraints that the model does not absorb.
    ///
    /// * `inliers`: that differ, see [`Self::distinct_count`]
    fn ln_false_alarms_by_residuals(&self, spread: f64, inliers: usize) -> f64 {
        let (views, tracks) = (self.cameras.len(), self.inlier.len());
        let constraints = consensus::constraint_count(views, inliers);
        let Some(rms) = self.rms() else { return f64::INFINITY };
        if constraints <= 0.0 {
            return f64::INFINITY;
        }
        ln_false_alarms_of(tracks, inliers, constraints, rms, spread)
    }

    /// Root mean square residual of the inliers, one coordinate; `None` where they leave no constraints.
    fn rms(&self) -> Option<f64> {
        let inliers = self.inliers();
        let constraints = consensus::constraint_count(self.cameras.len(), inliers.len());
        let cost: f64 = inliers.into_iter().map(|track| self.squared[track]).sum();
        (constraints > 0.0).then(|| (cost / constraints).sqrt())
    }

    /// How many inliers are images of points that the noise tells apart; of those that it does not, one counts, unless
    /// no more of them are near each other than of points anywhere in the image.
    ///
    /// Two tracks of one point differ, as their points are projected, by the noise of two points: with 3 degrees of
    /// freedom, whatever the views. The noise is that of the inliers' own residuals: whatever it is that makes them
    /// differ from one point by no more than from the cameras, it says nothing of these.
    ///
    /// * `spread`: standard deviation of the image points: what is near may be anywhere where noise is strong
    pub fn distinct_count(&self, spread: f64) -> usize {
        let Some(rms) = self.rms() else { return self.inlier_count() };
        let near = 2.0 * rms * rms * chi_square_gate(3.0);
        let images = |track: usize| -> Vec<Vector2<f64>> {
            let image = |camera| triangulation::reprojection(camera, &self.points[track], &Vector2::zeros());
            self.cameras.iter().map(image).collect()
        };
        let images: Vec<Vec<Vector2<f64>>> = self.inliers().into_iter().map(images).collect();
        let mut neighbours = vec![0; images.len()];
        for (track, first) in images.iter().enumerate() {
            for (other, second) in images.iter().enumerate().skip(track + 1) {
                if are_near(first, second, near) {
                    neighbours[track] += 1;
                    neighbours[other] += 1;
                }
            }
        }
        // Of normally distributed points in one view: those that are near in every view are fewer.
        let by_chance = -(-near / (4.0 * spread * spread * self.cameras.len() as f64)).exp_m1();
        let expected = by_chance * images.len() as f64;
        let usual = expected + OPTIONS.usual_sigmas * expected.sqrt();
        let counted: f64 = neighbours.iter().map(|&count| 1.0 / (1.0 + (f64::from(count) - usual).max(0.0))).sum();
        counted.round() as usize
    }
}

/// Whether squared distances sum up to no more than this.
fn are_near(a: &[Vector2<f64>], b: &[Vector2<f64>], most: f64) -> bool {
    let mut sum = 0.0;
    a.iter().zip(b).all(|(a, b)| {
        sum += (a - b).norm_squared();
        sum <= most
    })
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::domain::{Input, Limits};
    use crate::geometry::{Camera, Point};
    use crate::solver::search::affine;
    use crate::solver::{block, grow, spread};
    use crate::synthetic::{Scene, SceneOptions};

    /// Those of right tracks and those that random tracks were bent to.
    #[test]
    fn cameras_that_need_not_be_tried_would_admit_no_more() {
        let (mut tried, mut least) = (0, f64::INFINITY);
        for (views, seed) in [3, 4, 5, 7, 10].into_iter().flat_map(|views| (0..4).map(move |seed| (views, seed))) {
            for outliers in [0.3, 1.0] {
                let options = SceneOptions { views, tracks: 60, outliers, seed, ..SceneOptions::default() };
                let scene = Scene::generate(&options).expect("valid options");
                let input = Input::new(scene.input, &Limits::default(), "scene").expect("valid scene");
                let complete = block::of_all_views(&input).complete;
                let spread = spread::spread(&complete);
                let stop = StopToken::default();
                for noise in [0.003, 0.02, 0.08] {
                    let Some(start) = affine::seed(&complete, (0..12).collect()) else { continue };
                    let grown = grow::grow(&complete, start, noise, &stop);
                    let Some(consensus) = grown else { continue };
                    let squared = random::residuals(&complete, &consensus, &stop).expect("not stopped");
                    let share = random::measured(&squared) / (constraints_of_track(&complete) * spread * spread);
                    assert!(share > OPTIONS.least_measured, "{views} views, seed {seed}, outliers {outliers}: {share}");
                    (tried, least) = (tried + 1, share.min(least));
                }
            }
        }
        assert!(tried > 60, "{tried}");
        println!("{tried} consensuses, least share {least}");
    }

    /// Five cameras on a line before these points, all of them inliers; the noise of their residuals, normalised units.
    fn consensus_of(points: Vec<Point>, noise: f64) -> Consensus {
        let cameras: Vec<Camera> = (0..5)
            .map(|view| {
                let t = f64::from(view);
                Camera::new(1.2, 0.0, 0.0, 0.5 * t, 0.0, 1.2, 0.0, 0.2 * t, 0.0, 0.0, 1.0, 3.0)
            })
            .collect();
        let tracks = points.len();
        let squared = noise * noise * consensus::constraint_count(cameras.len(), tracks) / tracks as f64;
        Consensus {
            cameras,
            points,
            squared: vec![squared; tracks],
            inlier: vec![true; tracks],
            noise: 5.0 * noise,
            score: 0.5,
        }
    }

    #[test]
    fn of_points_that_the_noise_does_not_tell_apart_one_counts() {
        let noise = 1e-3;
        let count = |distance: f64| {
            let apart = (0..10).map(|k| Point::new(0.1 * f64::from(k), 0.0, 0.0, 1.0));
            let group = (0..30).map(|k| Point::new(0.5, 0.5 + distance * f64::from(k), 0.0, 1.0));
            let consensus = consensus_of(apart.chain(group).collect(), noise);
            let distinct = consensus.distinct_count(0.3);
            (distinct, consensus.ln_false_alarms_by_residuals(0.3, distinct))
        };
        let (near, apart) = (count(0.1 * noise), count(20.0 * noise));
        assert_eq!((near.0, apart.0), (11, 40));
        assert!(near.1 > apart.1 && apart.1 < OPTIONS.ln_decisive, "{near:?} {apart:?}");
    }

    /// Where the noise is a tenth of the image, what is anywhere is near something.
    #[test]
    fn of_points_all_over_the_image_all_count_whatever_the_noise() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut anywhere = || Point::new(rng.random_range(-0.7..0.7), rng.random_range(-0.7..0.7), 0.0, 1.0);
        let points: Vec<Point> = (0..20).map(|_| anywhere()).collect();
        let counted: Vec<usize> =
            [0.001, 0.03, 0.1].map(|noise| consensus_of(points.clone(), noise).distinct_count(0.25)).to_vec();
        assert!(counted[0] == 20 && counted.iter().all(|&count| count >= 16), "{counted:?}");
    }
}
