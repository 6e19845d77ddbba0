//! One learnable array and its Adam state.

use burn_tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::simd::vectorised;

/// Decay of the mean of gradients (Kingma & Ba 2015, algorithm 1).
const BETA_1: f32 = 0.9;
/// Decay of the mean of squared gradients (same source).
const BETA_2: f32 = 0.999;
/// Kingma and Ba's value, which the paper's framework has too; burn's own Adam defaults to 1e-5, at which layers with
/// small gradients hardly move.
const EPSILON: f32 = 1e-8;
/// Larger gradients than this have squares that f32 cannot hold.
const MAX_GRADIENT: f32 = 1e18;

/// A learnable `rows` x `columns` array, row by row, with its Adam state.
///
/// Adam is written out because one pass over the four arrays does what burn's optimizer does with eight tensor
/// operations, and so that both backends take bit-identical steps from identical gradients.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    shape: [usize; 2],
    values: Vec<f32>,
    mean: Vec<f32>,
    mean_square: Vec<f32>,
    steps: i32,
}

impl Parameter {
    /// An array of `shape`, its values row by row.
    pub fn new(shape: [usize; 2], values: Vec<f32>) -> Self {
        debug_assert_eq!(shape[0] * shape[1], values.len());
        let zeros = vec![0.0; values.len()];
        Self { shape, values, mean: zeros.clone(), mean_square: zeros, steps: 0 }
    }

    /// An array with one value everywhere.
    pub fn constant(shape: [usize; 2], value: f32) -> Self {
        Self::new(shape, vec![value; shape[0] * shape[1]])
    }

    /// The values, row by row.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Rows and columns.
    pub fn shape(&self) -> [usize; 2] {
        self.shape
    }

    /// The array on a device.
    pub fn tensor(&self, device: &Device) -> Tensor<2> {
        Tensor::from_data(TensorData::new(self.values.clone(), self.shape), device)
    }

    /// Whether a parameter that was read from a file has as many numbers as it says.
    pub fn is_whole(&self) -> bool {
        let size = self.shape[0].checked_mul(self.shape[1]);
        [&self.values, &self.mean, &self.mean_square].into_iter().all(|array| Some(array.len()) == size)
    }

    /// Multiplies every value, and leaves Adam's state alone: weight decay.
    pub fn scale(&mut self, factor: f32) {
        self.values.iter_mut().for_each(|value| *value *= factor);
    }

    /// One Adam step. Entries of the gradient that are not finite count as 0; returns how many there were.
    pub fn step(&mut self, gradient: &[f32], learning_rate: f32) -> u64 {
        debug_assert_eq!(gradient.len(), self.values.len());
        self.steps = self.steps.saturating_add(1);
        let correction = (1.0 - BETA_2.powi(self.steps)).sqrt();
        let rate = learning_rate * correction / (1.0 - BETA_1.powi(self.steps));
        let epsilon = EPSILON * correction;
        let Self { values, mean, mean_square, .. } = self;
        vectorised(
            #[inline(always)]
            move || {
                let mut replaced = 0u32;
                let state = values.iter_mut().zip(mean).zip(mean_square);
                for (((value, mean), mean_square), &gradient) in state.zip(gradient) {
                    let finite = gradient.is_finite();
                    replaced += u32::from(!finite);
                    let gradient = if finite { gradient.clamp(-MAX_GRADIENT, MAX_GRADIENT) } else { 0.0 };
                    *mean = BETA_1 * *mean + (1.0 - BETA_1) * gradient;
                    *mean_square = BETA_2 * *mean_square + (1.0 - BETA_2) * gradient * gradient;
                    *value -= rate * *mean / (mean_square.sqrt() + epsilon);
                }
                u64::from(replaced)
            },
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first steps of Adam from the formulas of the paper, in f64 and without the rearranged bias correction.
    #[test]
    fn follows_kingma_and_ba() {
        let gradients = [0.5, -0.1, 0.3, 1e-6];
        let mut parameter = Parameter::constant([1, 1], 1.0);
        let (mut value, mut mean, mut square) = (1.0f64, 0.0f64, 0.0f64);
        for (step, &gradient) in gradients.iter().enumerate() {
            parameter.step(&[gradient as f32], 0.01);
            mean = 0.9 * mean + 0.1 * gradient;
            square = 0.999 * square + 0.001 * gradient * gradient;
            let power = step as i32 + 1;
            let corrected = (square / (1.0 - 0.999f64.powi(power))).sqrt();
            value -= 0.01 * mean / (1.0 - 0.9f64.powi(power)) / (corrected + 1e-8);
            assert!((f64::from(parameter.values()[0]) - value).abs() < 1e-5, "step {step}");
        }
    }

    #[test]
    fn replaces_and_counts_what_is_not_finite() {
        let mut parameter = Parameter::constant([1, 3], 1.0);
        assert_eq!(parameter.step(&[f32::NAN, f32::INFINITY, 1e30], 0.1), 2);
        assert_eq!(parameter.values()[..2], [1.0, 1.0]);
        assert!((parameter.values()[2] - 0.9).abs() < 1e-3, "a huge gradient is a step like any other");
    }
}
