//! Observations and their noise.

use std::f64::consts::{SQRT_2, TAU};

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{IMAGE_SIDE_PX, SceneOptions};

/// Share of the heavy noise that is in the tails, and their standard deviation in those of the core.
const TAIL_SHARE: f64 = 0.1;
const TAIL_SCALE: f64 = 3.0;

/// How the noise of image points and depths is distributed; the option `noise` is its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NoiseKind {
    /// Gaussian (paper, section 5.1).
    #[default]
    Gaussian,
    /// Laplacian, of the same standard deviation.
    Laplace,
    /// A core and tails: 90 % Gaussian with the option's standard deviation, 10 % with thrice that. The option is the
    /// core's, the standard deviation of all is 1.34 times that.
    Heavy,
    /// Uniform, of the same standard deviation: up to 1.73 times that.
    Uniform,
}

impl NoiseKind {
    /// A sample, in the option's standard deviations. Every kind takes two numbers from the stream, so that what else
    /// is drawn from it does not depend on the kind.
    fn draw(self, rng: &mut ChaCha8Rng) -> f64 {
        let (first, second) = (rng.random::<f64>(), rng.random::<f64>());
        match self {
            NoiseKind::Gaussian => normal(first, second),
            NoiseKind::Laplace => (1.0 - first).ln() / SQRT_2 * if second < 0.5 { 1.0 } else { -1.0 },
            // The share picks the part, and what is left of the number is uniform again.
            NoiseKind::Heavy if second < TAIL_SHARE => TAIL_SCALE * normal(first, second / TAIL_SHARE),
            NoiseKind::Heavy => normal(first, (second - TAIL_SHARE) / (1.0 - TAIL_SHARE)),
            NoiseKind::Uniform => 3f64.sqrt() * (2.0 * first - 1.0),
        }
    }
}

/// Box-Muller, of two numbers uniform in `[0, 1)`; one of the pair is enough here.
pub fn normal(first: f64, second: f64) -> f64 {
    let radius = (-2.0 * (1.0 - first).ln()).sqrt();
    radius * (TAU * second).cos()
}

/// An observation in the making.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Exact image of some point: x and y in pixels, and the depth.
    pub image: [f64; 3],
    /// Noise of the three, in standard deviations.
    pub noise: [f64; 3],
    /// Whether the image is that of the track's own point on the first body.
    pub right: bool,
}

impl Observation {
    /// The exact image of a point with noise to come.
    pub fn draw(image: [f64; 3], right: bool, kind: NoiseKind, rng: &mut ChaCha8Rng) -> Self {
        Self { image, noise: std::array::from_fn(|_| kind.draw(rng)), right }
    }

    /// What is seen: x and y in pixels, and the depth, whose noise is relative.
    pub fn noisy(&self, options: &SceneOptions) -> [f64; 3] {
        let noise_px = options.noise * f64::from(IMAGE_SIDE_PX);
        let ([x, y, depth], [in_x, in_y, in_depth]) = (self.image, self.noise);
        [x + noise_px * in_x, y + noise_px * in_y, depth * (1.0 + options.noise * in_depth)]
    }
}

#[cfg(test)]
mod tests {
    use super::super::stream::Stream;
    use super::*;

    #[test]
    fn every_kind_has_its_spread_and_its_tails() {
        // Expected: standard deviation, kurtosis, share beyond 2 and beyond 3 of the option's standard deviations.
        let cases = [
            (NoiseKind::Gaussian, 1.0, 3.0, 0.0455, 0.0027),
            (NoiseKind::Laplace, 1.0, 6.0, (-2.0 * SQRT_2).exp(), (-3.0 * SQRT_2).exp()),
            (NoiseKind::Heavy, 1.8f64.sqrt(), 8.333, 0.0914, 0.0342),
            (NoiseKind::Uniform, 1.0, 1.8, 0.0, 0.0),
        ];
        for (kind, deviation, kurtosis, beyond_2, beyond_3) in cases {
            for seed in 0..3 {
                let mut rng = Stream::Paper.of(seed);
                let samples: Vec<f64> = (0..200_000).map(|_| kind.draw(&mut rng)).collect();
                let mean_of = |of: &dyn Fn(f64) -> f64| samples.iter().map(|&x| of(x)).sum::<f64>() / 200_000.0;
                let variance = mean_of(&|x| x * x);
                let found = mean_of(&|x| x.powi(4)) / (variance * variance);
                assert!(mean_of(&|x| x).abs() < 0.01, "{kind:?} seed {seed} has a bias");
                assert!((variance.sqrt() - deviation).abs() < 0.01, "{kind:?} seed {seed}: {}", variance.sqrt());
                assert!((found / kurtosis - 1.0).abs() < 0.08, "{kind:?} seed {seed}: kurtosis {found}");
                for (limit, expected) in [(2.0, beyond_2), (3.0, beyond_3)] {
                    let share = mean_of(&|x| f64::from(u8::from(x.abs() > limit)));
                    assert!((share - expected).abs() < 0.002, "{kind:?} seed {seed}: {share} beyond {limit}");
                }
            }
        }
    }
}
