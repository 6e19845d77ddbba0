//! Tracks without structure, and what residuals they leave to the cameras of a consensus.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::OPTIONS;
use crate::domain::StopToken;
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::chi_square_quantile;
use crate::geometry::triangulation::batch::{Batch, LANES};
use crate::solver::consensus::{self, Consensus};

/// Where the random numbers begin: one consensus, one answer.
const SEED: u64 = 0;

/// Constraints that a complete track leaves to cameras.
pub fn constraints_of_track(block: &CompleteBlock) -> f64 {
    (2 * block.views()) as f64 - 3.0
}

/// Squared residual up to which the cameras of a consensus admit a track.
pub fn gate(block: &CompleteBlock, consensus: &Consensus) -> f64 {
    consensus::gate(block.views()) * consensus.noise * consensus.noise
}

/// Distribution of the squared residuals of such tracks where few are so small that they could be counted: that of
/// normally distributed coordinates (chi square), scaled to have a share of them below what was measured.
#[derive(Debug, Clone, Copy)]
pub struct Tail {
    /// Constraints that a track leaves to the cameras.
    pub constraints: f64,
    /// Variance of the coordinates, that of the image points at most: cameras that bend leave less.
    pub variance: f64,
    /// The residual that [`measured_share`](super::FalseAlarmOptions::measured_share) of them have at most.
    pub measured: f64,
}

impl Tail {
    /// Natural logarithm of the probability of a squared residual of at most `x`; 0, a bound, beyond what was measured.
    ///
    /// It falls with the power of `x` that a track leaves constraints; the incomplete gamma function has a factor
    /// `exp(-x / 2 variance)` beside it. The variance is the smaller one of the image points' and of the one that has
    /// as many residuals below what was measured: too large a one would make small residuals too improbable.
    pub fn ln_below(&self, x: f64) -> f64 {
        // In units of the variance; beyond the mean of all it would be no tail.
        let least = chi_square_quantile(self.constraints, OPTIONS.measured_quantile).min(self.constraints);
        let measured = (self.measured / self.variance).clamp(least, self.constraints);
        let ratio = x / self.measured;
        if ratio > 1.0 {
            return 0.0;
        }
        OPTIONS.measured_share.ln() + 0.5 * self.constraints * ratio.ln() + 0.5 * measured * (1.0 - ratio)
    }
}

/// Squared residuals, ascending, that tracks without structure leave to the cameras of a consensus: their coordinates
/// are independent and distributed like those of the block, view by view. `None` once it is to stop.
pub fn residuals(block: &CompleteBlock, consensus: &Consensus, stop: &StopToken) -> Option<Vec<f64>> {
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut squared: Vec<f64> = Vec::with_capacity(OPTIONS.random_tracks);
    while squared.len() < OPTIONS.random_tracks {
        if stop.is_stopped() {
            return None;
        }
        let some = LANES.min(OPTIONS.random_tracks - squared.len());
        let drawn: Vec<_> = (0..some).map(|_| random_track(block, &mut rng)).collect();
        let drawn: Vec<&[Observation]> = drawn.iter().map(Vec::as_slice).collect();
        let batch = Batch::new(&consensus.cameras, &drawn);
        let found = batch.refine(batch.linear(), |_| true, consensus::ConsensusOptions::DEFAULT.point_steps);
        let finite = |cost: f64| if cost.is_finite() { cost } else { f64::MAX };
        squared.extend((0..batch.tracks()).map(|track| finite(found.cost(track))));
    }
    squared.sort_by(f64::total_cmp);
    Some(squared)
}

/// The residual that [`measured_share`](super::FalseAlarmOptions::measured_share) of these [`residuals`] have at most.
pub fn measured(squared: &[f64]) -> f64 {
    squared[(OPTIONS.measured_share * squared.len() as f64) as usize]
}

/// Natural logarithm of the probability `a` of which `a^n` bounds that `n` tracks without structure are all admitted
/// and leave no more on average than the inliers of the consensus do: see [`ln_as_small`].
///
/// * `squared`: as of [`residuals`]
/// * `variance`: of the image points
pub fn ln_as_good(block: &CompleteBlock, consensus: &Consensus, squared: &[f64], variance: f64) -> f64 {
    let tail = Tail { constraints: constraints_of_track(block), variance, measured: measured(squared) };
    // By the constraints of all inliers together: what they leave once the cameras are not fitted to them.
    let mean = consensus.rms().map_or(f64::INFINITY, |rms| rms * rms * tail.constraints);
    ln_as_small(squared, &tail, gate(block, consensus), mean)
}

/// A point of each view, of as many tracks as there are: points of one track have structure.
fn random_track(block: &CompleteBlock, rng: &mut ChaCha8Rng) -> Vec<Observation> {
    let mut drawn: Vec<usize> = Vec::with_capacity(block.views());
    while drawn.len() < block.views() {
        let track = rng.random_range(0..block.tracks());
        if drawn.len() >= block.tracks() || !drawn.contains(&track) {
            drawn.push(track);
        }
    }
    drawn.iter().enumerate().map(|(view, &track)| Observation::new(view, track, block.point(view, track))).collect()
}

/// Chernoff's bound (1952), a track, on the probability that squared residuals are all below `gate` and at most `mean`
/// on average: the least over `t >= 0` of
///
/// `ln E[exp(t (mean - x)); x <= gate]`
///
/// At `t` = 0 it is the probability to be below the gate.
///
/// * `squared`: what is known of the distribution, ascending; what is smaller than was measured the tail tells
fn ln_as_small(squared: &[f64], tail: &Tail, gate: f64, mean: f64) -> f64 {
    let largest = gate.min(tail.measured);
    // The share of each step stands at its lower end, that of the last at none at all: never too small a bound.
    let step = (OPTIONS.least_extrapolated * (mean / largest).min(1.0)).powf(f64::from(OPTIONS.extrapolated).recip());
    let end = |place: i32| largest * step.powi(place);
    let below = |place: i32| tail.ln_below(end(place)).exp();
    let at = |place: i32| match place < OPTIONS.extrapolated {
        true => (end(place + 1), below(place) - below(place + 1)),
        false => (0.0, below(place)),
    };
    let counted = &squared[squared.partition_point(|&x| x <= tail.measured)..];
    let share = (1.0 - OPTIONS.measured_share) / counted.len() as f64;
    let tried = counted.iter().take_while(|&&x| x <= gate).map(|&x| (x, share));
    let residuals: Vec<(f64, f64)> = (0..=OPTIONS.extrapolated).map(at).chain(tried).collect();
    // Of the tilted distribution the probability, and whether its mean is below that of the inliers.
    let probability = |t: f64| residuals.iter().map(|(x, share)| share * (t * (mean - x)).exp()).sum::<f64>();
    let is_below =
        |t: f64| residuals.iter().map(|(x, share)| share * (t * (mean - x)).exp() * (x - mean)).sum::<f64>() <= 0.0;
    // Any `t` gives a bound: the best one is where the tilted mean is that of the inliers, or at an end.
    let (mut low, mut high) = (0.0, tail.constraints / mean);
    if !f64::is_finite(high) {
        return probability(0.0).ln();
    }
    for _ in 0..OPTIONS.tilt_steps {
        let middle = 0.5 * (low + high);
        if is_below(middle) { high = middle } else { low = middle }
    }
    probability(low).min(probability(0.0)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Squared residuals of an even number of constraints, standard deviation 1.
    fn chi_square(constraints: usize, count: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
        // Two squared normal numbers are exponentially distributed.
        let one = |_| (0..constraints / 2).map(|_| -2.0 * (1.0 - rng.random::<f64>()).ln()).sum();
        (0..count).map(one).collect()
    }

    /// Many of them, ascending, and their tail.
    fn distribution(constraints: usize, rng: &mut ChaCha8Rng) -> (Vec<f64>, Tail) {
        let mut squared = chi_square(constraints, 20_000, rng);
        squared.sort_by(f64::total_cmp);
        let measured = squared[(OPTIONS.measured_share * squared.len() as f64) as usize];
        (squared, Tail { constraints: constraints as f64, variance: 1.0, measured })
    }

    #[test]
    fn of_normal_residuals_it_is_the_bound_of_the_chi_square_distribution() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        for constraints in [4, 16, 56] {
            let (squared, tail) = distribution(constraints, &mut rng);
            let freedom = constraints as f64;
            for ratio in [0.05f64, 0.1, 0.4, 0.6, 0.8] {
                let bound = ln_as_small(&squared, &tail, f64::INFINITY, ratio * freedom);
                let exact = 0.5 * freedom * (1.0 - ratio + ratio.ln());
                let within = 0.2 + 0.05 * exact.abs();
                assert!((bound - exact).abs() < within, "{constraints} constraints, {ratio}: {bound}, not {exact}");
            }
            // Of cameras that bend the image points vary more than what the tracks leave.
            for ratio in [0.1, 0.4] {
                let bent = Tail { variance: 5.0, ..tail };
                let bounds = [&tail, &bent].map(|tail| ln_as_small(&squared, tail, f64::INFINITY, ratio * freedom));
                assert!((bounds[0] - bounds[1]).abs() < 0.1, "{constraints} constraints, {ratio}: {bounds:?}");
            }
            // What they leave on average is no surprise, and the gate then tells all.
            assert!(ln_as_small(&squared, &tail, f64::INFINITY, freedom * 1.1).abs() < 1e-9);
            assert!(ln_as_small(&squared, &tail, 0.1 * freedom, 0.0).is_finite());
            let half = squared[squared.len() / 2];
            assert!((ln_as_small(&squared, &tail, half, half) - 0.5f64.ln()).abs() < 0.01);
            let low = squared[squared.len() / 200];
            let by_gate = ln_as_small(&squared, &tail, low, low);
            assert!((by_gate - 0.005f64.ln()).abs() < 0.2, "{constraints} constraints: {by_gate}");
        }
    }

    #[test]
    fn beyond_what_was_measured_a_tail_is_no_bound_but_one() {
        let tail = Tail { constraints: 3.0, variance: 1.0, measured: 0.03 };
        assert_eq!(tail.ln_below(0.03), OPTIONS.measured_share.ln());
        assert!(tail.ln_below(0.02) < OPTIONS.measured_share.ln() && tail.ln_below(0.04) == 0.0);
    }

    /// Four that are all admitted and leave so little on average: as often as said at most, and not much more seldom.
    #[test]
    fn it_bounds_how_often_it_happens() {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        const COUNT: usize = 4;
        for (constraints, shares) in [(4, &[0.3, 0.5, 0.8][..]), (8, &[0.5, 0.8])] {
            let (squared, tail) = distribution(constraints, &mut rng);
            let gate = squared[squared.len() / 2];
            let sets: Vec<f64> = (0..40_000)
                .map(|_| chi_square(constraints, COUNT, &mut rng))
                .map(|set| if set.iter().all(|&x| x <= gate) { set.iter().sum() } else { f64::INFINITY })
                .collect();
            for share in shares {
                let mean = share * gate;
                let bound = COUNT as f64 * ln_as_small(&squared, &tail, gate, mean);
                let often = sets.iter().filter(|&&sum| sum <= mean * COUNT as f64).count() as f64 / sets.len() as f64;
                println!("{constraints} constraints, {share}: {often:e} of {:e}", bound.exp());
                assert!(
                    often > 0.0 && often <= 1.1 * bound.exp(),
                    "{constraints}, {share}: {often} of {}",
                    bound.exp()
                );
                assert!(bound.exp() < 30.0 * often, "{constraints}, {share}: {often} of {}", bound.exp());
            }
        }
    }
}
