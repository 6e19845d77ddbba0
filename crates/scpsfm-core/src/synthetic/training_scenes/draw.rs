//! Random draws of the training scenes.

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Uniform between two bounds.
pub fn uniform((low, high): (f64, f64), rng: &mut ChaCha8Rng) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Uniform in the logarithm between two positive bounds.
pub fn log_uniform((low, high): (f64, f64), rng: &mut ChaCha8Rng) -> f64 {
    uniform((low.ln(), high.ln()), rng).exp()
}

pub fn chance(probability: f64, rng: &mut ChaCha8Rng) -> bool {
    rng.random::<f64>() < probability
}

/// One of several things with these weights, which need not sum to one. There is at least one.
pub fn pick<T: Copy>(weighted: &[(T, f64)], rng: &mut ChaCha8Rng) -> T {
    let mut left = rng.random::<f64>() * weighted.iter().map(|(_, weight)| weight).sum::<f64>();
    for &(thing, weight) in weighted {
        left -= weight;
        if left < 0.0 {
            return thing;
        }
    }
    weighted[weighted.len() - 1].0
}

/// Standard normal.
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    crate::synthetic::scene::normal(rng.random(), rng.random())
}

/// Three standard normals.
pub fn normals(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| normal(rng))
}

/// Uniform in `[-1, 1]^3`.
pub fn in_cube(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| uniform((-1.0, 1.0), rng))
}

/// Poisson, by the product of uniform numbers (Knuth 1969, volume 2); for small means.
pub fn poisson(mean: f64, rng: &mut ChaCha8Rng) -> usize {
    let limit = (-mean).exp();
    let mut product = rng.random::<f64>();
    let mut count = 0;
    while product > limit {
        product *= rng.random::<f64>();
        count += 1;
    }
    count
}
