//! From a seed to a consensus: projective bundle adjustment of a growing support, without depths.
//!
//! A seed is a set of cameras with a few tracks that may be right. Bundle adjustment of the support, triangulation of
//! every track and ranking by reprojection residual alternate, the support growing by half at a time, until the set of
//! tracks under the gate stands still. Then a polish: the gate inflated and tightened again, which frees consensuses
//! that grew into a corner (mean F1 .90 -> 1.00 at 90 % outliers). [`refine`] settles the noise of the result.

mod noise;
mod options;

pub use noise::{estimate_noise, refine};
pub use options::{ConsensusOptions, NoiseOptions};

use super::search::Seed;
use crate::domain::StopToken;
use crate::geometry::bundle::{self, Loss, projective};
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::chi_square_gate;
use crate::geometry::triangulation::batch::{Batch, LANES};
use crate::geometry::{Camera, Point};

const OPTIONS: ConsensusOptions = ConsensusOptions::DEFAULT;
/// Tracks below which projective cameras of three views or more are not determined by image points:
/// `2nk > 11n + 3k - 15`.
pub const LEAST_SUPPORT: usize = 7;
/// Inliers that geometry can verify: one track more than determine the cameras.
pub const LEAST_INLIERS: usize = LEAST_SUPPORT + 1;

/// Cameras, and every track of the block judged by them.
#[derive(Debug, Clone)]
pub struct Consensus {
    pub cameras: Vec<Camera>,
    /// Triangulated point of every track.
    pub points: Vec<Point>,
    /// Sum of squared reprojection residuals of every track, normalised units.
    pub squared: Vec<f64>,
    pub inlier: Vec<bool>,
    /// Noise that the gate assumes: one standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Truncated cost as a share of the cost of calling every track an outlier, 0 to 1.
    pub score: f64,
}

impl Consensus {
    /// The inlier tracks, increasing.
    pub fn inliers(&self) -> Vec<usize> {
        (0..self.inlier.len()).filter(|&track| self.inlier[track]).collect()
    }

    pub fn inlier_count(&self) -> usize {
        self.inlier.iter().filter(|&&inlier| inlier).count()
    }
}

/// Constraints that `tracks` complete tracks in `views` views leave to a projective reconstruction.
pub fn constraint_count(views: usize, tracks: usize) -> f64 {
    (2 * views * tracks) as f64 - (11 * views + 3 * tracks) as f64 + 15.0
}

/// Squared-residual gate of a complete track in units of the variance.
pub fn gate(views: usize) -> f64 {
    chi_square_gate((2 * views) as f64 - 3.0)
}

/// Judges every track of a block by cameras.
///
/// Once `stop` fires the remaining tracks are outliers: nobody will look at the result.
pub fn judge(block: &CompleteBlock, cameras: Vec<Camera>, noise: f64, stop: &StopToken) -> Consensus {
    let gate = gate(block.views()) * noise * noise;
    let mut points = Vec::with_capacity(block.tracks());
    let mut squared = Vec::with_capacity(block.tracks());
    for first in (0..block.tracks()).step_by(LANES) {
        if stop.is_stopped() {
            points.resize(block.tracks(), Point::new(0.0, 0.0, 0.0, 1.0));
            squared.resize(block.tracks(), f64::MAX);
            break;
        }
        let tracks: Vec<_> = (first..block.tracks().min(first + LANES)).map(|track| block.track(track)).collect();
        let batch = Batch::new(&cameras, &tracks);
        let start = batch.linear();
        let found = batch.refine(start, |track| start.cost(track) < OPTIONS.hopeless_gates * gate, OPTIONS.point_steps);
        points.extend((0..batch.tracks()).map(|track| found.point(track)));
        let finite = |cost: f64| if cost.is_finite() { cost } else { f64::MAX };
        squared.extend((0..batch.tracks()).map(|track| finite(found.cost(track))));
    }
    let inlier: Vec<bool> = squared.iter().map(|&cost| cost < gate).collect();
    let score = squared.iter().map(|&cost| (cost / gate).min(1.0)).sum::<f64>() / block.tracks().max(1) as f64;
    Consensus { cameras, points, squared, inlier, noise, score }
}

/// Fits at one noise level, and where those ended that converged: the same support under the same loss ends there
/// again, so that it is looked up instead.
///
/// Growing and polishing come back to a support that stands still several times each: with 100 right tracks in 11
/// views, 37 adjustments become 11.
struct Fits<'a> {
    block: &'a CompleteBlock,
    noise: f64,
    stop: &'a StopToken,
    converged: Vec<Converged>,
}

/// A fit that more iterations would not change.
struct Converged {
    support: Vec<usize>,
    loss: Loss,
    judged: Consensus,
}

impl<'a> Fits<'a> {
    pub fn new(block: &'a CompleteBlock, noise: f64, stop: &'a StopToken) -> Self {
        Self { block, noise, stop, converged: Vec::new() }
    }

    /// Every track judged by the cameras that fit a support, found from a start near by; whether more iterations could
    /// change them.
    ///
    /// * `points`: of the support, in its order
    fn fit(
        &mut self,
        cameras: &[Camera],
        points: Vec<Point>,
        support: &[usize],
        loss: Loss,
        iterations: usize,
    ) -> (Consensus, bool) {
        if let Some(known) = self.converged.iter().find(|known| known.loss == loss && known.support == support) {
            return (known.judged.clone(), true);
        }
        let (mut cameras, mut points) = (cameras.to_vec(), points);
        let observations = observations_of(self.block, support);
        let options = bundle::Options { max_iterations: iterations, loss, ..bundle::Options::default() };
        let report = projective::adjust(&mut cameras, &mut points, &observations, &options, self.stop);
        let judged = judge(self.block, cameras, self.noise, self.stop);
        let converged = report.iterations < iterations && !self.stop.is_stopped();
        if converged {
            self.converged.push(Converged { support: support.to_vec(), loss, judged: judged.clone() });
        }
        (judged, converged)
    }

    /// The same from where a consensus stands.
    fn refit(&mut self, from: &Consensus, support: &[usize], loss: Loss, iterations: usize) -> Consensus {
        let points = support.iter().map(|&track| from.points[track]).collect();
        self.fit(&from.cameras, points, support, loss, iterations).0
    }

    /// Grows a seed; the best consensus met.
    pub fn grow(&mut self, seed: Seed) -> Option<Consensus> {
        if seed.support.len() < LEAST_SUPPORT || self.block.views() < 2 {
            return None;
        }
        let Seed { mut cameras, mut points, mut support } = seed;
        let mut best: Option<Consensus> = None;
        let mut idle = 0;
        for round in 0..OPTIONS.rounds {
            let loss = if support.len() > OPTIONS.plain_support { OPTIONS.loss(self.noise) } else { Loss::Squared };
            let iterations =
                if round < OPTIONS.first_rounds { OPTIONS.first_iterations } else { OPTIONS.later_iterations };
            let (judged, converged) = self.fit(&cameras, points, &support, loss, iterations);
            cameras = judged.cameras.clone();
            let next = next_support(&judged, support.len(), self.block.views());
            points = next.iter().map(|&track| judged.points[track]).collect();
            if best.as_ref().is_none_or(|best| judged.score < best.score - 1e-12) {
                best = Some(judged);
                idle = 0;
            } else {
                idle += 1;
            }
            let stands_still = next == support && (converged || round > 1);
            if idle >= OPTIONS.idle_rounds || stands_still || self.stop.is_stopped() {
                break;
            }
            support = next;
        }
        best
    }

    /// Inflates the gate and tightens it again, keeping what gets better.
    pub fn polish(&mut self, consensus: Consensus) -> Consensus {
        let (block, noise) = (self.block, self.noise);
        let gate = gate(block.views()) * noise * noise;
        let mut best = consensus;
        for _ in 0..OPTIONS.polish_rounds {
            let before = best.score;
            let mut current = best.clone();
            let mut fitted = current.inliers();
            for inflation in OPTIONS.polish_inflations {
                let support: Vec<usize> =
                    (0..block.tracks()).filter(|&track| current.squared[track] < inflation * gate).collect();
                let too_many = inflation > 1.0 && support.len() > 3 * best.inlier_count().max(LEAST_SUPPORT);
                if support.len() < LEAST_SUPPORT || too_many || self.stop.is_stopped() {
                    continue;
                }
                let loss = if inflation > 1.0 { OPTIONS.loss(noise) } else { Loss::Squared };
                current = self.refit(&current, &support, loss, OPTIONS.later_iterations);
                if current.score < best.score {
                    best = current.clone();
                }
                // Fitted to what the gate admits, and the same again: the remaining steps would repeat it.
                if inflation <= 1.0 && support == fitted {
                    break;
                }
                fitted = support;
            }
            if best.score > before - 1e-6 {
                break;
            }
        }
        best
    }
}

/// The observations of some tracks; point `k` is `support[k]`.
pub fn observations_of(block: &CompleteBlock, support: &[usize]) -> Vec<Observation> {
    support
        .iter()
        .enumerate()
        .flat_map(|(point, &track)| block.track(track).iter().map(move |seen| Observation { point, ..*seen }))
        .collect()
}

/// Grows a seed to a consensus and polishes it.
///
/// Returns the best consensus met; `None` when the seed is too small or nothing finite came of it.
pub fn grow(block: &CompleteBlock, seed: Seed, noise: f64, stop: &StopToken) -> Option<Consensus> {
    let mut fits = Fits::new(block, noise, stop);
    fits.grow(seed).map(|consensus| fits.polish(consensus))
}

/// The tracks to fit next, increasing: by half more than now while the gate admits them, all admitted ones once the
/// support has caught up, else carefully more as long as the next track is not far off.
fn next_support(judged: &Consensus, size: usize, views: usize) -> Vec<usize> {
    let mut ranked: Vec<usize> = (0..judged.squared.len()).collect();
    ranked.sort_by(|&a, &b| judged.squared[a].total_cmp(&judged.squared[b]).then(a.cmp(&b)));
    let admitted = judged.inlier_count();
    let grown = |factor: f64| (factor * size as f64) as usize;
    let wanted = if size < admitted {
        (size + 1).max(admitted.min(grown(OPTIONS.fast_growth)))
    } else if admitted as f64 >= OPTIONS.caught_up * size as f64 && admitted >= LEAST_SUPPORT {
        admitted
    } else {
        let more = grown(OPTIONS.careful_growth);
        let far = OPTIONS.near_gates * gate(views) * judged.noise * judged.noise;
        let reaches = ranked.get(more.min(ranked.len() - 1)).is_some_and(|&track| judged.squared[track] < far);
        LEAST_SUPPORT.max(if reaches { more } else { size })
    };
    ranked.truncate(wanted);
    ranked.sort_unstable();
    ranked
}
