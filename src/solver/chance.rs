//! Whether a consensus may be chance: the expected number of such among tracks without structure.
//!
//! Two bounds. Residuals are compared with the spread of the image points, as if the reconstructions of a set of tracks
//! were a plane among their coordinates. That they are not: cameras bend it, and where the gate is as wide as a tenth of
//! the image, random tracks in three views fit some cameras or other. So the cameras that were found are tried on random
//! tracks too: what share of those they admit bounds the probability that the inliers are admitted by chance, and what
//! residuals they leave takes the place of the spread. These bounds are the coarser ones: they have a veto, where neither
//! holds, and the other one ranks.
//!
//! Tracks that lie within the noise of each other in every view are one track for both: they tell nothing of the cameras
//! that one of them does not.

use nalgebra::Vector2;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::grow::{self, Consensus, LEAST_INLIERS, LEAST_SUPPORT};
use crate::domain::StopToken;
use crate::geometry::measurement::{CompleteBlock, Sighting};
use crate::geometry::statistics::{chi_square_gate, ln_choose};
use crate::geometry::triangulation;

/// Logarithm of the expected number of false alarms at which a consensus is decisive (e^-40: never by chance), and at
/// which it may be accepted once the search has ended.
pub const LN_DECISIVE: f64 = -40.0;
pub const LN_ACCEPTABLE: f64 = -7.0;
/// The same by the cameras, above which nothing is accepted: refining makes them fit more than the seven tracks that
/// determine them. In 35 random inputs of three views no consensus had less than -5.2 by both bounds; eight right tracks
/// among 200 in ten views have -15 to -20 by the cameras.
const LN_BY_CAMERAS: f64 = -10.0;
/// Random tracks that cameras are tried on: some milliseconds at 10 views, for the few consensuses that may be accepted.
const RANDOM_TRACKS: usize = 500;
/// Share of them whose residual is measured; smaller ones are extrapolated from there. Of 500, a fiftieth is known to
/// a third.
const MEASURED_SHARE: f64 = 0.02;
/// So many tell enough of most cameras: the smallest residual of these is above that of a fiftieth of all one time in
/// fifty (.98^200), and the probability that follows from it is too large rather than too small.
const FIRST_TRACKS: usize = 200;
/// What those residuals are at least, a constraint, as a share of the variance of the image points: cameras that do not
/// bend the images of a set of tracks leave a fiftieth of random tracks .06 (three views) to .4 (ten) of it, and what bends them
/// is allowed to take most of that. Cameras that verify by that much need not be tried.
const LEAST_MEASURED: f64 = 0.01;
/// Noise levels that a consensus is grown and settled at, each a test of its own: five of the search, three of the
/// refinement.
const NOISE_LEVELS: f64 = 8.0;
/// Where the random numbers begin: one consensus, one answer.
const SEED: u64 = 0;

/// Natural logarithm of the number of such consensuses to be expected in data without structure: by residuals, and
/// [`LN_ACCEPTABLE`] or more where the cameras say that it may be chance. They are asked only where the residuals would
/// have it accepted.
///
/// * `spread`: see [`Consensus::ln_false_alarms_by_residuals`]
pub fn ln_false_alarms(block: &CompleteBlock, consensus: &Consensus, spread: f64, stop: &StopToken) -> f64 {
    let by_residuals = consensus.ln_false_alarms_by_residuals(spread);
    if by_residuals >= LN_ACCEPTABLE {
        return by_residuals;
    }
    let by_cameras = by_cameras(block, consensus, spread, stop);
    if by_cameras < LN_BY_CAMERAS { by_residuals } else { by_cameras.max(LN_ACCEPTABLE) }
}

/// The same by the cameras: a-contrario as by Moisan & Stival (2004, section 3). Of `k` inliers [`LEAST_SUPPORT`] determine
/// the cameras, and each other one is admitted by chance with probability `a`: for every noise level and size of set,
///
/// `C(m, k) C(k, 7) a^(k - 7)`
///
/// The coordinates of a track without structure are independent and distributed like those of the block, view by view.
fn by_cameras(block: &CompleteBlock, consensus: &Consensus, spread: f64, stop: &StopToken) -> f64 {
    let (tracks, inliers) = (consensus.inlier.len(), consensus.distinct_count());
    if inliers < LEAST_INLIERS {
        return f64::INFINITY;
    }
    let tests = ln_choose(tracks, inliers) + ln_choose(inliers, LEAST_SUPPORT) + (tracks as f64 * NOISE_LEVELS).ln();
    let at = |ln_admitted: f64| tests + (inliers - LEAST_SUPPORT) as f64 * ln_admitted;
    let constraints = constraints_of_track(block);
    let least_measured = LEAST_MEASURED * constraints * spread * spread;
    let at_most = at(ln_below(constraints, gate(block, consensus), least_measured));
    if at_most < LN_BY_CAMERAS {
        return at_most;
    }
    let mut random = RandomTracks::new(block, consensus);
    // To stop is to accept nothing.
    if !random.try_until(FIRST_TRACKS, stop) {
        return f64::INFINITY;
    }
    if let Some(by_first) = random.ln_admitted_by_first().map(at)
        && by_first < LN_BY_CAMERAS
    {
        return by_first;
    }
    if !random.try_until(RANDOM_TRACKS, stop) {
        return f64::INFINITY;
    }
    // Where noise is strong the gate admits so many that their number tells nothing; how well they fit still does,
    // compared with what random tracks leave to the same cameras.
    let left_by_random = (random.measured() / constraints).sqrt();
    let by_fit = consensus.ln_false_alarms_by_residuals(left_by_random) + NOISE_LEVELS.ln();
    at(random.ln_admitted()).min(by_fit)
}

/// Constraints that a complete track leaves to cameras.
fn constraints_of_track(block: &CompleteBlock) -> f64 {
    (2 * block.views()) as f64 - 3.0
}

/// Squared residual up to which the cameras of a consensus admit a track.
fn gate(block: &CompleteBlock, consensus: &Consensus) -> f64 {
    grow::gate(block.views()) * consensus.noise * consensus.noise
}

/// Natural logarithm of the probability of a squared residual below `gate`, where [`MEASURED_SHARE`] are below `measured`.
///
/// It falls with the power of the gate that a track leaves constraints.
fn ln_below(constraints: f64, gate: f64, measured: f64) -> f64 {
    MEASURED_SHARE.ln() + 0.5 * constraints * (gate / measured).ln()
}

/// Tracks without structure, as the cameras of a consensus see them.
struct RandomTracks<'a> {
    block: &'a CompleteBlock,
    consensus: &'a Consensus,
    rng: ChaCha8Rng,
    /// Squared residuals, ascending.
    squared: Vec<f64>,
}

impl<'a> RandomTracks<'a> {
    fn new(block: &'a CompleteBlock, consensus: &'a Consensus) -> Self {
        let squared = Vec::with_capacity(RANDOM_TRACKS);
        Self { block, consensus, rng: ChaCha8Rng::seed_from_u64(SEED), squared }
    }

    /// Tries so many in all; `false` once it is to stop.
    fn try_until(&mut self, tracks: usize, stop: &StopToken) -> bool {
        let Self { block, consensus: Consensus { cameras, .. }, rng, squared } = self;
        while squared.len() < tracks {
            if stop.is_stopped() {
                return false;
            }
            let of_view = |view| Sighting { view, xy: block.point(view, rng.random_range(0..block.tracks())) };
            let track: Vec<Sighting> = (0..block.views()).map(of_view).collect();
            let start = triangulation::linear(cameras, &track);
            let (_, cost) = triangulation::refine(cameras, &track, start, grow::POINT_STEPS);
            squared.push(if cost.is_finite() { cost } else { f64::MAX });
        }
        squared.sort_by(f64::total_cmp);
        true
    }

    /// The residual that [`MEASURED_SHARE`] of those that were tried have at most.
    fn measured(&self) -> f64 {
        self.squared[(MEASURED_SHARE * self.squared.len() as f64) as usize]
    }

    /// No less than what [`ln_admitted`](Self::ln_admitted) is likely to say of more of them; `None` where some are
    /// admitted.
    fn ln_admitted_by_first(&self) -> Option<f64> {
        let (gate, smallest) = (gate(self.block, self.consensus), self.squared[0]);
        (smallest > gate).then(|| ln_below(constraints_of_track(self.block), gate, smallest))
    }

    /// Natural logarithm of the probability that the cameras admit a track without structure.
    fn ln_admitted(&self) -> f64 {
        let (gate, measured) = (gate(self.block, self.consensus), self.measured());
        if measured > gate {
            return ln_below(constraints_of_track(self.block), gate, measured);
        }
        let admitted = self.squared.partition_point(|&cost| cost < gate) as f64 / self.squared.len() as f64;
        admitted.ln()
    }
}

impl Consensus {
    /// Natural logarithm of the number of such consensuses to be expected in data without structure (Moisan & Stival
    /// 2004, a-contrario): all subsets of that size, times the probability that unstructured coordinates of standard
    /// deviation `spread` leave residuals this small in all constraints that the model does not absorb.
    pub fn ln_false_alarms_by_residuals(&self, spread: f64) -> f64 {
        let (views, tracks) = (self.cameras.len(), self.inlier.len());
        let inliers = self.distinct_count();
        let constraints = grow::constraint_count(views, inliers);
        let Some(rms) = self.rms() else { return f64::INFINITY };
        if constraints <= 0.0 {
            return f64::INFINITY;
        }
        let ln_probability = 0.5 * constraints * (1.0 + 2.0 * (rms.max(f64::MIN_POSITIVE) / spread).ln()).min(0.0);
        ln_choose(tracks, inliers) + (tracks as f64).ln() + ln_probability
    }

    /// Root mean square residual of the inliers, one coordinate; `None` where they leave no constraints.
    fn rms(&self) -> Option<f64> {
        let inliers = self.inliers();
        let constraints = grow::constraint_count(self.cameras.len(), inliers.len());
        let cost: f64 = inliers.into_iter().map(|track| self.squared[track]).sum();
        (constraints > 0.0).then(|| (cost / constraints).sqrt())
    }

    /// How many inliers are images of points that the noise tells apart; of those that it does not, one counts.
    ///
    /// Two tracks of one point differ, as their points are projected, by the noise of two points: with 3 degrees of
    /// freedom, whatever the views. The noise is that of the inliers' own residuals: whatever it is that makes them
    /// differ from one point by no more than from the cameras, it says nothing of these.
    pub fn distinct_count(&self) -> usize {
        let Some(rms) = self.rms() else { return self.inlier_count() };
        let near = 2.0 * rms * rms * chi_square_gate(3.0);
        let images = |track: usize| -> Vec<Vector2<f64>> {
            let image = |camera| triangulation::reprojection(camera, &self.points[track], &Vector2::zeros());
            self.cameras.iter().map(image).collect()
        };
        let mut distinct: Vec<Vec<Vector2<f64>>> = Vec::new();
        for track in self.inliers() {
            let images = images(track);
            if !distinct.iter().any(|other| are_near(&images, other, near)) {
                distinct.push(images);
            }
        }
        distinct.len()
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
    use super::*;
    use crate::domain::{Input, Limits};
    use crate::geometry::{Camera, Point};
    use crate::solver::search::affine;
    use crate::solver::{block, portfolio};
    use crate::synthetic::{Scene, SceneOptions};

    /// Those of right tracks and those that random tracks were bent to.
    #[test]
    fn cameras_that_need_not_be_tried_would_admit_no_more() {
        let (mut tried, mut least) = (0, f64::INFINITY);
        let (mut decided, mut too_low) = (0, 0);
        for (views, seed) in [3, 4, 5, 7, 10].into_iter().flat_map(|views| (0..4).map(move |seed| (views, seed))) {
            for outliers in [0.3, 1.0] {
                let options = SceneOptions { views, tracks: 60, outliers, seed, ..SceneOptions::default() };
                let scene = Scene::generate(&options).expect("valid options");
                let input = Input::new(scene.input, &Limits::default(), "scene").expect("valid scene");
                let (normalization, _) = block::normalization(&input);
                let all: Vec<usize> = (0..views).collect();
                let complete = block::extract(&input, &input.track_ranges(), &normalization, &all).complete;
                let spread = portfolio::spread(&complete);
                let stop = StopToken::default();
                for noise in [0.003, 0.02, 0.08] {
                    let Some(start) = affine::seed(&complete, (0..12).collect()) else { continue };
                    let grown = grow::grow(&complete, start.cameras, start.points, start.support, noise, &stop);
                    let Some(consensus) = grown else { continue };
                    let mut random = RandomTracks::new(&complete, &consensus);
                    assert!(random.try_until(FIRST_TRACKS, &stop));
                    let by_first = random.ln_admitted_by_first();
                    assert!(random.try_until(RANDOM_TRACKS, &stop));
                    decided += usize::from(by_first.is_some());
                    too_low += usize::from(by_first.is_some_and(|first| first < random.ln_admitted()));
                    let share = random.measured() / (constraints_of_track(&complete) * spread * spread);
                    assert!(share > LEAST_MEASURED, "{views} views, seed {seed}, outliers {outliers}: {share}");
                    (tried, least) = (tried + 1, share.min(least));
                }
            }
        }
        assert!(tried > 60, "{tried}");
        println!("{tried} consensuses, least share {least}; by the first {decided}, too low {too_low} times");
        // The first are to tell too little rather than too much: one time in fifty they may not.
        assert!(decided > tried / 3 && too_low <= decided / 25, "{too_low} of {decided} of {tried}");
    }

    #[test]
    fn of_points_that_the_noise_does_not_tell_apart_one_counts() {
        let cameras: Vec<Camera> = (0..5)
            .map(|view| {
                let t = f64::from(view);
                Camera::new(1.2, 0.0, 0.0, 0.5 * t, 0.0, 1.2, 0.0, 0.2 * t, 0.0, 0.0, 1.0, 3.0)
            })
            .collect();
        let noise = 1e-3;
        let count = |distance: f64| {
            let apart = (0..10).map(|k| Point::new(0.1 * f64::from(k), 0.0, 0.0, 1.0));
            let crowd = (0..30).map(|k| Point::new(0.5, 0.5 + distance * f64::from(k), 0.0, 1.0));
            let points: Vec<Point> = apart.chain(crowd).collect();
            let tracks = points.len();
            let squared = noise * noise * grow::constraint_count(cameras.len(), tracks) / tracks as f64;
            let consensus = Consensus {
                cameras: cameras.clone(),
                points,
                squared: vec![squared; tracks],
                inlier: vec![true; tracks],
                noise: 5.0 * noise,
                score: 0.5,
            };
            (consensus.distinct_count(), consensus.ln_false_alarms_by_residuals(0.3))
        };
        let (near, apart) = (count(0.1 * noise), count(20.0 * noise));
        assert_eq!((near.0, apart.0), (11, 40));
        assert!(near.1 > apart.1 && apart.1 < LN_DECISIVE, "{near:?} {apart:?}");
    }
}
