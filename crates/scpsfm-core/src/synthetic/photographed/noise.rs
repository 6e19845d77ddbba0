//! The noise of image points: a Gaussian core with tails.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::PhotographedOptions;
use crate::synthetic::scene::normal;

/// Share of the observations in the tails, and their standard deviation in those of the core.
const TAIL_SHARE: f64 = 0.05;
const TAIL_SCALE: f64 = 3.0;
/// Fisher information on the place of a distribution of unit core with these tails: the integral of `p'^2 / p`.
const INFORMATION: f64 = 0.8833;

/// Noise of x and y in pixels. An observation is in the core or in the tails with both.
pub fn draw(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> [f64; 2] {
    let scale = if rng.random::<f64>() < TAIL_SHARE { TAIL_SCALE } else { 1.0 };
    std::array::from_fn(|_| scale * options.noise_px * normal(rng.random(), rng.random()))
}

/// The standard deviation of a Gaussian that says as much of a coordinate as this noise, in units of its core.
pub fn effective_noise() -> f64 {
    INFORMATION.sqrt().recip()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    #[test]
    fn the_information_is_the_integral() {
        let normal = |x: f64, sigma: f64| (-0.5 * (x / sigma).powi(2)).exp() / (sigma * TAU.sqrt());
        let step = 1e-3;
        let at = |x: f64| {
            let (core, tails) = ((1.0 - TAIL_SHARE) * normal(x, 1.0), TAIL_SHARE * normal(x, TAIL_SCALE));
            (x * (core + tails / TAIL_SCALE.powi(2))).powi(2) / (core + tails)
        };
        let information: f64 = (-30_000..30_000).map(|k| step * at(step * f64::from(k))).sum();
        assert!((information - INFORMATION).abs() < 1e-4, "{information}");
    }
}
