//! One step of the optimiser: Adam with clipped gradients and decoupled weight decay (Loshchilov & Hutter 2019), its
//! rate by a schedule of steps.

use crate::network::Parameter;
use crate::network::subspace::SubspaceNet;

/// Rate after the first steps; twice as much diverges in the prototype's hands.
const RATE: f32 = 3e-3;
/// Rate at the end.
const LAST_RATE: f32 = 1e-5;
/// Steps in which the rate rises to its full value: the first gradients are the largest.
const WARM_UP: f64 = 100.0;
/// Share of the steps after which the rate falls, along half a cosine.
const PLATEAU: f64 = 0.4;
/// Share of the rate by which every weight is drawn to 0 in a step.
const DECAY: f32 = 1e-4;
/// Longest gradient that is followed as it is; a longer one is shortened to this.
const MOST_GRADIENT: f64 = 1.0;

/// Rate of a step, counted from 0.
pub fn rate(step: u64, steps: u64) -> f32 {
    let through = step as f64 / steps.max(1) as f64;
    let warm = ((step + 1) as f64 / WARM_UP).min(1.0) as f32;
    let fallen = ((through - PLATEAU) / (1.0 - PLATEAU)).clamp(0.0, 1.0);
    let share = 0.5 * (1.0 + (std::f64::consts::PI * fallen).cos());
    LAST_RATE + (RATE - LAST_RATE) * share as f32 * warm
}

/// Takes one step along a gradient; none, and `false`, where the gradient is not finite.
pub fn step(network: &mut SubspaceNet<Parameter>, gradient: &SubspaceNet<Vec<f32>>, rate: f32) -> bool {
    let gradients = gradient.arrays();
    let squares = gradients.iter().flat_map(|array| array.iter()).map(|&slope| f64::from(slope).powi(2));
    let length = squares.sum::<f64>().sqrt();
    if !length.is_finite() {
        return false;
    }
    let shortened = (MOST_GRADIENT / length.max(MOST_GRADIENT)) as f32;
    for (parameter, gradient) in network.arrays_mut().into_iter().zip(gradients) {
        let gradient: Vec<f32> = gradient.iter().map(|slope| shortened * slope).collect();
        parameter.scale(1.0 - rate * DECAY);
        parameter.step(&gradient, rate);
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_rises_stays_and_falls() {
        let rates: Vec<f32> = [0, 50, 100, 400, 700, 999].map(|step| rate(step, 1000)).into();
        assert!(rates[0] < 0.02 * RATE && rates[1] < 0.6 * RATE, "{rates:?}");
        assert!((rates[2] - RATE).abs() < 1e-6 && (rates[3] - RATE).abs() < 1e-6, "{rates:?}");
        assert!((rates[4] - 0.5 * RATE).abs() < 1e-4 && rates[5] < 1.1 * LAST_RATE, "{rates:?}");
    }
}
