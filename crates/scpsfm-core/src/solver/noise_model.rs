//! How the residuals of right observations are distributed, and what tells them from wrong ones.

use nalgebra::Vector2;

use super::spread::{MOST_SPREAD, spread_of};
use crate::domain::{Warning, WarningCode};
use crate::geometry::statistics::median;

options! {
    /// How the residuals of right observations are distributed.
    pub struct NoiseModelOptions {
        /// Share of right observations in the tail, before it is known, and the tail's width in units of the core.
        /// Feature detectors have a core of .1 to .3 px and tails that a Gaussian of that width would call impossible;
        /// together with the uniform outliers this puts the gate at 12 to 17 core deviations, where real sequences want
        /// it (15 to 20).
        tail_share: f64 = 0.05,
        tail_width: f64 = 3.0,
        /// Bounds of the share that is estimated. Noise without a tail still has a rare blunder that is no wrong match.
        tail_bounds: (f64, f64) = (0.001, 0.2),
        /// Observations from which the share is estimated, and those that it is estimated from at most, evenly taken.
        least_tail_observations: usize = 100,
        /// They tell a share of .05 to .0015.
        most_tail_observations: usize = 20_000,
        /// Rounds of the estimation. It converges in five.
        tail_rounds: usize = 10,
        /// Prior probability that a single observation of a right track is wrong.
        wrong_observation: f64 = 0.05,
        /// Least spread of the points of an image, image sides. Half of them within a thousandth are no picture of
        /// anything.
        least_spread: f64 = 1e-3,
        /// Points from which a view counts for the density of wrong observations. The spread of eight is known to a
        /// third.
        least_points: usize = 8,
        /// Noise of a result, in units of the assumed one, above which HIGH_NOISE is given. What is assumed is meant as
        /// an upper bound, and twice that is more than an inexact guess.
        high_noise_ratio: f64 = 2.0,
    }
}

const OPTIONS: NoiseModelOptions = NoiseModelOptions::DEFAULT;

/// Density of a wrong coordinate in an image: one over the width of a uniform distribution that is spread like the
/// points of a view, the median over the views with enough of them; without any, like all points.
///
/// * `of_view`: places of each view's points among all
pub fn outlier_density(of_view: &[Vec<u32>], points: &[Vector2<f64>]) -> f64 {
    let views = of_view.iter().filter(|places| places.len() >= OPTIONS.least_points);
    let mut spreads: Vec<f64> =
        views.map(|places| spread_of(&places.iter().map(|&k| points[k as usize]).collect::<Vec<_>>())).collect();
    let spread = if spreads.is_empty() { spread_of(points) } else { median(&mut spreads) };
    // A uniform distribution is so many standard deviations wide.
    1.0 / (12.0f64.sqrt() * spread.clamp(OPTIONS.least_spread, MOST_SPREAD))
}

/// Logarithm of how much better this many observations fit than points anywhere in the image would, summed over the
/// constraints that the unknowns leave: what one reconstruction of an input is preferred to another by.
///
/// * `noise`: one standard deviation of a coordinate
/// * `outlier_density`: see [`outlier_density`]
pub fn evidence(observations: usize, unknowns: usize, noise: f64, outlier_density: f64) -> f64 {
    let constraints = (2 * observations) as f64 - unknowns as f64;
    -constraints * (outlier_density * noise * (std::f64::consts::TAU * std::f64::consts::E).sqrt()).ln()
}

/// Whether the noise of a result is far above the assumed one.
pub fn is_high(noise: f64, assumed: f64) -> bool {
    noise > OPTIONS.high_noise_ratio * assumed
}

/// HIGH_NOISE, where a result fits only at a noise far above the assumed one: a result that mixes two structures has such
/// noise, and so do points that were measured roughly.
///
/// * `noise`, `assumed`: one standard deviation of a coordinate, in units of `scale_px` pixels
pub fn warning(noise: f64, assumed: f64, scale_px: f64) -> Option<Warning> {
    if !is_high(noise, assumed) {
        return None;
    }
    let ratio = noise / assumed;
    let [noise_px, assumed_px] = [noise, assumed].map(|noise| noise * scale_px);
    let detail = format!(
        "the inliers fit at a noise of {noise_px:.2} px, {ratio:.1} times the {assumed_px:.2} px that were assumed: wrong \
         observations may be among them, unless the points were measured that roughly"
    );
    Some(Warning::new(WarningCode::HighNoise, detail))
}

/// How the residuals of right observations are distributed.
///
/// A core of Gaussian noise and a tail of three times that width, beside wrong observations that may be anywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseModel {
    /// Core, one standard deviation of a coordinate.
    core: f64,
    tail_share: f64,
    /// Density of a wrong coordinate.
    outlier_density: f64,
}

impl NoiseModel {
    /// The model while nothing is known of the tail.
    pub fn new(core: f64, outlier_density: f64) -> Self {
        Self { core, tail_share: OPTIONS.tail_share, outlier_density }
    }

    /// The model with the tail that these squared residuals of right observations, in core variances, show: the share
    /// by expectation and maximisation. `None` for too few of them.
    pub fn with_tail(self, squared: &[f64]) -> Option<Self> {
        if squared.len() < OPTIONS.least_tail_observations {
            return None;
        }
        let step = squared.len().div_ceil(OPTIONS.most_tail_observations).max(1);
        let squared: Vec<f64> = squared.iter().copied().step_by(step).collect();
        let mut share = OPTIONS.tail_share;
        for _ in 0..OPTIONS.tail_rounds {
            let of_tail = |squared: &f64| {
                let core = (1.0 - share) * (-0.5 * squared).exp();
                let tail = share * (-0.5 * squared / OPTIONS.tail_width.powi(2)).exp() / OPTIONS.tail_width.powi(2);
                tail / (core + tail).max(f64::MIN_POSITIVE)
            };
            share = squared.iter().map(of_tail).sum::<f64>() / squared.len() as f64;
        }
        Some(Self { tail_share: share.clamp(OPTIONS.tail_bounds.0, OPTIONS.tail_bounds.1), ..self })
    }

    /// Squared residual at which an observation is as likely wrong as right: by its core or by its tail, whichever
    /// reaches farther. Strong noise has a core that reaches farther than a rare tail.
    pub fn gate(&self) -> f64 {
        let wrong = OPTIONS.wrong_observation * self.outlier_density.powi(2);
        let reach = |(share, width): (f64, f64)| {
            let variance = (width * self.core).powi(2);
            let right = (1.0 - OPTIONS.wrong_observation) * share / (std::f64::consts::TAU * variance);
            2.0 * variance * (right / wrong).ln().max(0.0)
        };
        let [core, tail] = self.parts().map(reach);
        core.max(tail)
    }

    /// Probability that an observation with this squared residual is right, of a track that is.
    pub fn weight(&self, squared: f64) -> f64 {
        let wrong = OPTIONS.wrong_observation * self.outlier_density.powi(2);
        let density = |(share, width): (f64, f64)| {
            let variance = (width * self.core).powi(2);
            (1.0 - OPTIONS.wrong_observation) * share * (-0.5 * squared / variance).exp()
                / (std::f64::consts::TAU * variance)
        };
        let right: f64 = self.parts().map(density).iter().sum();
        right / (right + wrong).max(f64::MIN_POSITIVE)
    }

    /// Log of the odds that a track is right whose prior probability is `share`: the density of its residuals under
    /// core and tail, over that of coordinates anywhere, times the price of every dropped observation.
    ///
    /// * `cost`: sum of the squared residuals of the `retained` observations about their point
    pub fn ln_odds(&self, cost: f64, retained: usize, dropped: usize, share: f64) -> f64 {
        let dof = (2 * retained) as f64 - 3.0;
        let ln_density = |(share, width): (f64, f64)| {
            let variance = (width * self.core).powi(2);
            share.ln() - 0.5 * dof * (std::f64::consts::TAU * variance).ln() - 0.5 * cost / variance
        };
        let [core, tail] = self.parts().map(ln_density);
        let ln_right =
            core.max(tail) + (-(core - tail).abs()).exp().ln_1p() + dropped as f64 * OPTIONS.wrong_observation.ln();
        let ln_wrong = dof * self.outlier_density.ln();
        (share / (1.0 - share)).ln() + ln_right - ln_wrong
    }

    /// Share and width of the core and of the tail.
    fn parts(&self) -> [(f64, f64); 2] {
        [(1.0 - self.tail_share, 1.0), (self.tail_share, OPTIONS.tail_width)]
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn views_of_single_points_do_not_make_every_point_a_wrong_one() {
        let points: Vec<Vector2<f64>> =
            (0..220).map(|k| Vector2::new((k % 20) as f64 / 20.0 - 0.5, (k / 20) as f64 / 20.0 - 0.5)).collect();
        let full: Vec<Vec<u32>> = (0..10).map(|view| (20 * view..20 * view + 20).collect()).collect();
        let alone = outlier_density(&full, &points[..200]);
        let stubs = full.iter().cloned().chain((200..220).map(|k| vec![k])).collect::<Vec<_>>();
        let beside = outlier_density(&stubs, &points);
        assert!((beside / alone - 1.0).abs() < 1e-12, "{alone} {beside}");
        let nothing = outlier_density(&[Vec::new(), vec![0]], &points);
        assert!(nothing.is_finite() && outlier_density(&[], &[]).is_finite(), "{nothing}");
    }

    #[test]
    fn twice_the_assumed_noise_is_high() {
        let is_told = |ratio: f64| warning(0.004 * ratio, 0.004, 1000.0).is_some();
        assert!(!is_told(0.1) && !is_told(1.99) && is_told(2.01) && is_told(50.0));
        let detail = warning(0.01, 0.004, 1000.0).expect("high").detail;
        assert!(detail.contains("10.00 px, 2.5 times the 4.00 px"), "{detail}");
    }

    #[test]
    fn the_tail_is_read_from_the_residuals() {
        let model = NoiseModel::new(0.001, 1.0);
        for (seed, share) in [(0, 0.0), (1, 0.02), (2, 0.1), (3, 0.5)] {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            // A squared residual of two Gaussian coordinates is exponential, of mean 2 variances.
            let squared: Vec<f64> = (0..5_000)
                .map(|_| {
                    let width = if rng.random::<f64>() < share { OPTIONS.tail_width } else { 1.0 };
                    -2.0 * width * width * (1.0 - rng.random::<f64>()).ln()
                })
                .collect();
            let found = model.with_tail(&squared).expect("enough").tail_share;
            let expected = share.clamp(OPTIONS.tail_bounds.0, OPTIONS.tail_bounds.1);
            println!("seed {seed}: share {found} of {share}");
            assert!((found - expected).abs() < 0.01 + 0.2 * expected, "seed {seed}: {found} instead of {expected}");
            assert_eq!(model.with_tail(&squared[..OPTIONS.least_tail_observations - 1]), None);
        }
    }

    #[test]
    fn the_gate_lets_the_core_of_any_noise_through() {
        for core in [1e-4, 0.003, 0.02, 0.05] {
            for tail_share in [OPTIONS.tail_bounds.0, OPTIONS.tail_share, OPTIONS.tail_bounds.1] {
                let noise = NoiseModel { core, tail_share, outlier_density: 1.0 };
                let gate = noise.gate().sqrt() / core;
                assert!((2.5..25.0).contains(&gate), "noise {core}, tail {tail_share}: {gate} deviations");
                let weight = |deviations: f64| noise.weight((deviations * core).powi(2));
                assert!(
                    weight(0.0) > 0.9 && weight(gate - 0.5) > 0.5 && weight(gate + 3.0) < 0.5,
                    "{core} {tail_share}"
                );
            }
        }
    }
}
