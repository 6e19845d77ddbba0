//! How far from their epipolar lines right matches are, and wrong ones.

use std::f64::consts::{SQRT_2, TAU};

use crate::geometry::fundamental::Match;
use crate::geometry::statistics::ln_choose;

/// Share of right matches in the tail of the noise, and its width in units of the core: feature detectors have tails
/// that a Gaussian of their core would call impossible. A share of .2 ranks real matches no differently.
const TAIL: (f64, f64) = (0.05, 3.0);
/// Core noise below which residuals are rounding: a fiftieth of a pixel of an image of a thousand. Without a bound,
/// exact matches would make a density without one.
const LEAST_NOISE: f64 = 2e-5;
/// Bounds of the share of right matches, which must not be a certainty: it could never leave it again.
const SHARE_BOUNDS: (f64, f64) = (0.01, 0.99);
/// Largest spread that points of an image can have: half its side.
const MOST_SPREAD: f64 = 0.5;
/// Core deviations within which a match counts as agreeing with a pair's matrix.
const AGREEING: f64 = 3.0;
/// Matches that a matrix always fits.
const FITTED: usize = 8;

/// Signed Sampson distances of a pair's matches, squared, and how they are distributed: a share of them is right, with
/// Gaussian noise of a core and a tail; the others may be anywhere.
#[derive(Debug, Clone)]
pub struct Residuals {
    pub squared: Vec<f64>,
    /// Density of a wrong match's signed distance.
    wrong: f64,
    /// Share of right matches.
    share: f64,
}

impl Residuals {
    /// * `squared`: squared Sampson distances of the matches, in their order
    pub fn new(matches: &[Match], squared: Vec<f64>) -> Self {
        Self { squared, wrong: density_of_wrong(matches), share: 0.5 }
    }

    /// One step of expectation and maximisation: the weights of the matches in a refit, and what the noise is estimated
    /// from, the sum of the core variances that they show and their number.
    pub fn expect(&mut self, noise: f64) -> (Vec<f64>, [f64; 2]) {
        let mut sums = [0.0; 2];
        let mut right = 0.0;
        let weights: Vec<f64> = self
            .squared
            .iter()
            .map(|&squared| {
                let [core, tail] = densities(squared, noise);
                let all = self.share * (core + tail) + (1.0 - self.share) * self.wrong;
                let [core, tail] = [core, tail].map(|density| self.share * density / all);
                // A match of the tail says as much of the noise as one of the core, in its own units.
                let information = core + tail / TAIL.1.powi(2);
                // Residuals may be infinite, and one that is no number must not take the noise of all with it.
                if information > 0.0 && squared.is_finite() {
                    sums[0] += information * squared;
                    sums[1] += core + tail;
                    right += core + tail;
                    information
                } else {
                    0.0
                }
            })
            .collect();
        let share = right / self.squared.len().max(1) as f64;
        self.share = if share.is_finite() { share.clamp(SHARE_BOUNDS.0, SHARE_BOUNDS.1) } else { SHARE_BOUNDS.0 };
        (weights, sums)
    }

    /// Logarithm of the expected number of matrices with as many agreeing matches among wrong ones: Moisan & Stival
    /// 2004, `(m - 8) C(m, k) C(k, 8) p^(k-8)` for k of m matches within a distance that a wrong one has with
    /// probability p.
    pub fn ln_false_alarms(&self, noise: f64) -> f64 {
        let gate = AGREEING * noise;
        let (all, agreeing) =
            (self.squared.len(), self.squared.iter().filter(|&&squared| squared < gate * gate).count());
        if agreeing <= FITTED {
            return f64::INFINITY;
        }
        let by_chance = (2.0 * gate * self.wrong).min(1.0);
        ((all - FITTED) as f64).ln()
            + ln_choose(all, agreeing)
            + ln_choose(agreeing, FITTED)
            + (agreeing - FITTED) as f64 * by_chance.ln()
    }

    /// Logarithm of how much likelier this distance is of a right match than of a wrong one.
    pub fn ln_ratio(&self, squared: f64, noise: f64) -> f64 {
        let ln_part = |(share, width): (f64, f64)| {
            let deviation = width * noise;
            share.ln() - 0.5 * TAU.ln() - deviation.ln() - 0.5 * squared / (deviation * deviation)
        };
        let [core, tail] = parts().map(ln_part);
        // Far out both are 0 as numbers, not as logarithms.
        core.max(tail) + (-(core - tail).abs()).exp().ln_1p() - self.wrong.ln()
    }
}

/// The core noise from the sums of [`Residuals::expect`] over all pairs, `most` at most.
pub fn noise_of(sums: [f64; 2], most: f64) -> f64 {
    let noise = (sums[0] / sums[1]).sqrt();
    if noise.is_finite() { noise.clamp(LEAST_NOISE.min(most), most) } else { most }
}

/// Share and width of the core and of the tail.
fn parts() -> [(f64, f64); 2] {
    [(1.0 - TAIL.0, 1.0), TAIL]
}

/// Densities of a right match's signed distance, by core and by tail, with their shares.
fn densities(squared: f64, noise: f64) -> [f64; 2] {
    parts().map(|(share, width)| {
        let deviation = width * noise;
        share * (-0.5 * squared / (deviation * deviation)).exp() / (TAU.sqrt() * deviation)
    })
}

/// Density of the signed Sampson distance of two unrelated points, each uniform over as wide a range as these matches:
/// that of a coordinate across the line, `1 / (sqrt 12 spread)`, times `sqrt 2`, for the distance is shared by two
/// views.
fn density_of_wrong(matches: &[Match]) -> f64 {
    let count = matches.len().max(1) as f64;
    let variance = |point: fn(&Match) -> nalgebra::Vector2<f64>| {
        let mean = matches.iter().map(point).sum::<nalgebra::Vector2<f64>>() / count;
        matches.iter().map(|seen| (point(seen) - mean).norm_squared()).sum::<f64>() / (2.0 * count)
    };
    let spread = (0.5 * (variance(|seen| seen.from) + variance(|seen| seen.to))).sqrt();
    SQRT_2 / (12.0f64.sqrt() * spread.clamp(LEAST_NOISE, MOST_SPREAD))
}
