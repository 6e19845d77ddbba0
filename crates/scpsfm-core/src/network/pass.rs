//! Forward and backward through the PointNet, written out.
//!
//! The products of matrices are burn's; what lies between them is one pass over each row, which stays in the
//! first-level cache, where a tape would take a pass over the whole array for every operation (a test compares with
//! burn's). Arrays are features x columns, row by row.
//!
//! A normalised layer is `Y = ρ(s ⊙ R + b)` with `R = W X`, `s = gain / sqrt(var(R) + ε)`, all rows of X of zero mean,
//! and `ρ(x) = max(0, x) + slope · min(0, x)`: ReLU with slope 0. With `D` the derivative with respect to `s ⊙ R + b`
//! and `p = Σ_j D_j R_j` along rows: `db = Σ_j D_j`, `dgain = p / sqrt(var + ε)`, `dR = s ⊙ D - s p / (m (var + ε)) ⊙
//! R`, `dW = dR Xᵀ`, `dX = Wᵀ dR`.

use burn_tensor::{Device, Tensor};

use super::Error;
use super::lanes::{dot, maximum, sum};
use super::parameter::Parameter;
use super::pointnet::{LOCAL_LAYER, Layer, PointNet, VARIANCE_FLOOR, constant, values_of};
use crate::simd::vectorised;

/// Derivatives of one loss with respect to every array; `None` where it does not reach the array.
pub type Gradient = PointNet<Option<Vec<f32>>>;

/// What the network said of a cloud, and what its derivatives need.
pub struct Pass {
    /// Logits of the weights, one a column.
    pub logits: Vec<f32>,
    device: Device,
    columns: usize,
    trunk: Vec<Normalised>,
    segmentation: Vec<Normalised>,
    logit: Affine,
    /// Layers of the trunk above the local feature, and of the classification head.
    depths: (usize, usize),
    plane: Option<PlanePass>,
}

/// The way from the local feature to the plane at infinity.
struct PlanePass {
    plane: Vec<f32>,
    /// The trunk's upper layers but for the last.
    upper: Vec<Normalised>,
    /// The trunk's last layer.
    pooled: Pooled,
    classification: Vec<Affine>,
    layer: Affine,
}

/// A layer with batch statistics.
struct Normalised {
    weight: Tensor<2>,
    /// Rows of mean 0.
    input: Tensor<2>,
    /// `W X`.
    response: Vec<f32>,
    statistics: Statistics,
    /// Of the rectifier below 0.
    slope: f32,
}

/// The last layer of the trunk, of which only each row's largest response matters.
struct Pooled {
    weight: Tensor<2>,
    /// Rows of mean 0.
    input: Tensor<2>,
    statistics: Statistics,
    /// Column of each row's largest response, and that response.
    largest: Vec<(usize, f32)>,
}

/// Of each row of a response.
struct Statistics {
    /// `sqrt(var + ε)`
    deviation: Vec<f32>,
    /// Gain over deviation.
    scale: Vec<f32>,
    bias: Vec<f32>,
}

/// A layer without statistics.
struct Affine {
    weight: Tensor<2>,
    input: Tensor<2>,
}

/// Derivatives of a layer's arrays.
type Arrays = Layer<Option<Vec<f32>>>;

impl PointNet<Parameter> {
    /// Runs the network on a cloud (rows x m) whose rows have mean 0.
    ///
    /// * `with_plane`: whether the plane at infinity is computed
    /// * `slope`: of the segmentation head's rectifiers below 0; those of the other layers are ReLU
    ///
    /// # Errors
    /// [`Error::Backend`] for a defect of burn.
    pub fn forward(&self, centred: &Tensor<2>, with_plane: bool, slope: f32, device: &Device) -> Result<Pass, Error> {
        let columns = centred.dims()[1];
        let (lower, upper) = self.trunk.split_at(LOCAL_LAYER + 1);
        let (trunk, local) = chain(lower, centred.clone(), true, 0.0, device)?;
        let (segmentation, features) = chain(&self.segmentation, local.clone(), false, slope, device)?;
        let (logit, logits) = self.logit.affine(features, device)?;
        let depths = (upper.len(), self.classification.len());
        let plane = if with_plane { Some(self.plane_pass(local, device)?) } else { None };
        Ok(Pass { logits, device: device.clone(), columns, trunk, segmentation, logit, depths, plane })
    }

    /// From the local feature, centred, to the plane at infinity.
    fn plane_pass(&self, local: Tensor<2>, device: &Device) -> Result<PlanePass, Error> {
        let (_, upper) = self.trunk.split_at(LOCAL_LAYER + 1);
        let (last, upper) = upper.split_last().ok_or_else(|| Error::Backend("a trunk without layers".into()))?;
        let (upper, local) = chain(upper, local, true, 0.0, device)?;
        let (pooled, mut global) = last.pooled(local, device)?;
        let mut classification = Vec::with_capacity(self.classification.len());
        for layer in &self.classification {
            let input = constant(global, [layer.weight.shape()[1], 1], device);
            let (trace, mut output) = layer.affine(input, device)?;
            output.iter_mut().for_each(|value| *value = rectified(*value, 0.0));
            classification.push(trace);
            global = output;
        }
        let input = constant(global, [self.plane.weight.shape()[1], 1], device);
        let (layer, plane) = self.plane.affine(input, device)?;
        Ok(PlanePass { plane, upper, pooled, classification, layer })
    }
}

impl Pass {
    /// The plane at infinity; `None` where it was not wanted.
    pub fn plane(&self) -> Option<&[f32]> {
        Some(&self.plane.as_ref()?.plane)
    }

    /// Derivatives of a loss from those with respect to the logits and, where it depends on it and was computed, the
    /// plane at infinity.
    ///
    /// # Errors
    /// [`Error::Backend`] for a defect of burn.
    pub fn backward(self, on_logits: Vec<f32>, on_plane: Option<[f32; 3]>) -> Result<Gradient, Error> {
        let Self { device, columns, .. } = self;
        let (logit, on_features) = self.logit.backward(on_logits, columns, &device)?;
        let (segmentation, mut on_local) = backward_chain(self.segmentation, on_features, false, columns, &device)?;

        let mut plane = unreached(false);
        let mut upper: Vec<Arrays> = (0..self.depths.0).map(|_| unreached(true)).collect();
        let mut classification: Vec<Arrays> = (0..self.depths.1).map(|_| unreached(false)).collect();
        if let (Some(on_plane), Some(pass)) = (on_plane, self.plane) {
            let (arrays, mut on_global) = pass.layer.backward(on_plane.to_vec(), 1, &device)?;
            plane = arrays;
            let mut output = values_of(pass.layer.input)?;
            for (place, layer) in pass.classification.into_iter().enumerate().rev() {
                for (slope, value) in on_global.iter_mut().zip(&output) {
                    *slope = if *value > 0.0 { *slope } else { 0.0 };
                }
                let (arrays, on_input) = layer.backward(on_global, 1, &device)?;
                classification[place] = arrays;
                output = values_of(layer.input)?;
                on_global = on_input;
            }
            let (last, on_input) = pass.pooled.backward(&on_global, columns, &device)?;
            let (arrays, on_input) = backward_chain(pass.upper, on_input, true, columns, &device)?;
            upper = arrays;
            upper.push(last);
            for (slope, other) in on_local.iter_mut().zip(on_input) {
                *slope += other;
            }
        }
        let (mut trunk, _) = backward_chain(self.trunk, on_local, true, columns, &device)?;
        trunk.append(&mut upper);
        Ok(PointNet { trunk, segmentation, logit, classification, plane })
    }
}

/// Normalised layers one after the other, each but the last (and that, too, if `centred`) followed by centring.
fn chain(
    layers: &[Layer<Parameter>],
    mut input: Tensor<2>,
    centred: bool,
    slope: f32,
    device: &Device,
) -> Result<(Vec<Normalised>, Tensor<2>), Error> {
    let mut traces = Vec::with_capacity(layers.len());
    for (place, layer) in layers.iter().enumerate() {
        let columns = input.dims()[1];
        let (trace, features) = layer.normalised(input, centred || place + 1 < layers.len(), slope, device)?;
        input = constant(features, [layer.weight.shape()[0], columns], device);
        traces.push(trace);
    }
    Ok((traces, input))
}

/// Backward through [`chain`]; gives the derivatives with respect to its input, too.
fn backward_chain(
    layers: Vec<Normalised>,
    mut slopes: Vec<f32>,
    centred: bool,
    columns: usize,
    device: &Device,
) -> Result<(Vec<Arrays>, Vec<f32>), Error> {
    let mut all = Vec::with_capacity(layers.len());
    for (place, layer) in layers.into_iter().rev().enumerate() {
        let (arrays, on_input) = layer.backward(slopes, centred || place > 0, columns, device)?;
        all.push(arrays);
        slopes = on_input;
    }
    all.reverse();
    Ok((all, slopes))
}

/// The derivatives of a layer that the loss does not reach.
fn unreached(normalised: bool) -> Arrays {
    Layer { weight: None, gain: normalised.then_some(None), bias: None }
}

/// Not `max`: that would make 0 of what is not a number. A product in both cases: a branch would keep the loops around
/// it from being vectorised.
#[inline(always)]
fn rectified(value: f32, slope: f32) -> f32 {
    value * if value <= 0.0 { slope } else { 1.0 }
}

impl Layer<Parameter> {
    /// `W X + b`, row by row.
    fn affine(&self, input: Tensor<2>, device: &Device) -> Result<(Affine, Vec<f32>), Error> {
        let weight = self.weight.tensor(device);
        let columns = input.dims()[1];
        let mut output = values_of(weight.clone().matmul(input.clone()))?;
        for (row, bias) in output.chunks_exact_mut(columns).zip(self.bias.values()) {
            row.iter_mut().for_each(|value| *value += bias);
        }
        Ok((Affine { weight, input }, output))
    }

    /// The layer's output, its rows less their means if `centred`.
    fn normalised(
        &self,
        input: Tensor<2>,
        centred: bool,
        slope: f32,
        device: &Device,
    ) -> Result<(Normalised, Vec<f32>), Error> {
        let weight = self.weight.tensor(device);
        let columns = input.dims()[1];
        let response = values_of(weight.clone().matmul(input.clone()))?;
        let statistics = self.statistics(&response, columns);
        let mut output = vec![0.0; response.len()];
        vectorised(
            #[inline(always)]
            || {
                let rows = output.chunks_exact_mut(columns).zip(response.chunks_exact(columns));
                for (k, (output, response)) in rows.enumerate() {
                    let (scale, bias, slope) = (statistics.scale[k], statistics.bias[k], slope);
                    for (output, response) in output.iter_mut().zip(response) {
                        *output = rectified(response * scale + bias, slope);
                    }
                    if centred {
                        let mean = sum(output) / columns as f32;
                        output.iter_mut().for_each(|value| *value -= mean);
                    }
                }
            },
        );
        Ok((Normalised { weight, input, response, statistics, slope }, output))
    }

    /// The largest output of every row.
    fn pooled(&self, input: Tensor<2>, device: &Device) -> Result<(Pooled, Vec<f32>), Error> {
        let weight = self.weight.tensor(device);
        let columns = input.dims()[1];
        let response = values_of(weight.clone().matmul(input.clone()))?;
        let statistics = self.statistics(&response, columns);
        let mut largest = Vec::with_capacity(statistics.scale.len());
        let mut output = Vec::with_capacity(statistics.scale.len());
        for (k, row) in response.chunks_exact(columns).enumerate() {
            let (scale, bias) = (statistics.scale[k], statistics.bias[k]);
            // A gain may have become negative.
            let sign = if scale < 0.0 { -1.0 } else { 1.0 };
            let highest = vectorised(
                #[inline(always)]
                || maximum(row, sign),
            );
            let place = row.iter().position(|value| value * sign == highest).unwrap_or(0);
            largest.push((place, row[place]));
            output.push(rectified(row[place] * scale + bias, 0.0));
        }
        Ok((Pooled { weight, input, statistics, largest }, output))
    }

    fn statistics(&self, response: &[f32], columns: usize) -> Statistics {
        let mut deviation = vec![0.0; response.len() / columns];
        vectorised(
            #[inline(always)]
            || {
                for (deviation, row) in deviation.iter_mut().zip(response.chunks_exact(columns)) {
                    *deviation = (dot(row, row) / columns as f32 + VARIANCE_FLOOR).sqrt();
                }
            },
        );
        let scale = match &self.gain {
            Some(gain) => gain.values().iter().zip(&deviation).map(|(gain, deviation)| gain / deviation).collect(),
            None => deviation.iter().map(|deviation| deviation.recip()).collect(),
        };
        Statistics { deviation, scale, bias: self.bias.values().to_vec() }
    }
}

impl Affine {
    /// Derivatives of the arrays and with respect to the input, from those with respect to the output.
    fn backward(&self, slopes: Vec<f32>, columns: usize, device: &Device) -> Result<(Arrays, Vec<f32>), Error> {
        let rows = slopes.len() / columns;
        let bias = slopes.chunks_exact(columns).map(sum).collect();
        let slopes = constant(slopes, [rows, columns], device);
        let weight = values_of(slopes.clone().matmul(self.input.clone().transpose()))?;
        let on_input = values_of(self.weight.clone().transpose().matmul(slopes))?;
        Ok((Layer { weight: Some(weight), gain: None, bias: Some(bias) }, on_input))
    }
}

impl Normalised {
    /// Derivatives of the arrays and with respect to the input, from those with respect to the output, which were taken
    /// after centring if `centred`.
    fn backward(
        self,
        mut slopes: Vec<f32>,
        centred: bool,
        columns: usize,
        device: &Device,
    ) -> Result<(Arrays, Vec<f32>), Error> {
        let Statistics { deviation, scale, bias } = &self.statistics;
        let rows = scale.len();
        let (mut on_gain, mut on_bias) = (Vec::with_capacity(rows), Vec::with_capacity(rows));
        let below = self.slope;
        vectorised(
            #[inline(always)]
            || {
                let all = slopes.chunks_exact_mut(columns).zip(self.response.chunks_exact(columns));
                for (k, (slopes, response)) in all.enumerate() {
                    // By value: behind references they would be read again for every number.
                    let (scale, bias, deviation, below) = (scale[k], bias[k], deviation[k], below);
                    let mean = if centred { sum(slopes) / columns as f32 } else { 0.0 };
                    for (slope, response) in slopes.iter_mut().zip(response) {
                        // A product in both cases: a branch would keep the loop from being vectorised.
                        *slope = (*slope - mean) * if response * scale + bias > 0.0 { 1.0 } else { below };
                    }
                    let pull = dot(slopes, response);
                    let along = scale * pull / (columns as f32 * deviation * deviation);
                    on_gain.push(pull / deviation);
                    on_bias.push(sum(slopes));
                    for (slope, response) in slopes.iter_mut().zip(response) {
                        *slope = scale * *slope - along * response;
                    }
                }
            },
        );
        let slopes = constant(slopes, [rows, columns], device);
        let weight = values_of(slopes.clone().matmul(self.input.transpose()))?;
        let on_input = values_of(self.weight.transpose().matmul(slopes))?;
        Ok((Layer { weight: Some(weight), gain: Some(Some(on_gain)), bias: Some(on_bias) }, on_input))
    }
}

impl Pooled {
    /// The same, from the derivatives with respect to the largest outputs.
    ///
    /// `dR` is one entry a row less a multiple of the response, `dR = E - a ⊙ W X`. The widest layer of all is
    /// therefore not multiplied with all columns again: `dW = E Xᵀ - a ⊙ W (X Xᵀ)` and `dX = Wᵀ E - (Wᵀ (a ⊙ W)) X`.
    fn backward(self, slopes: &[f32], columns: usize, device: &Device) -> Result<(Arrays, Vec<f32>), Error> {
        let Statistics { deviation, scale, bias } = &self.statistics;
        let [rows, inputs] = self.weight.dims();
        let (mut on_gain, mut on_bias, mut along) = (vec![0.0; rows], vec![0.0; rows], vec![0.0; rows]);
        let mut entries = vec![0.0; rows];
        for (k, &(_, response)) in self.largest.iter().enumerate() {
            if response * scale[k] + bias[k] > 0.0 {
                let pull = slopes[k] * response;
                along[k] = scale[k] * pull / (columns as f32 * deviation[k] * deviation[k]);
                (on_gain[k], on_bias[k], entries[k]) = (pull / deviation[k], slopes[k], scale[k] * slopes[k]);
            }
        }
        let along = constant(along, [rows, 1], device);
        let scaled = self.weight.clone() * along;
        let scatter = self.input.clone().matmul(self.input.clone().transpose());
        let mut weight = values_of(scaled.clone().matmul(scatter).neg())?;
        let mixed = self.weight.clone().transpose().matmul(scaled);
        let mut on_input = values_of(mixed.matmul(self.input.clone()).neg())?;
        let (input, weights) = (values_of(self.input)?, values_of(self.weight)?);
        for (k, &(place, _)) in self.largest.iter().enumerate().filter(|(k, _)| entries[*k] != 0.0) {
            for feature in 0..inputs {
                weight[k * inputs + feature] += entries[k] * input[feature * columns + place];
                on_input[feature * columns + place] += entries[k] * weights[k * inputs + feature];
            }
        }
        Ok((Layer { weight: Some(weight), gain: Some(Some(on_gain)), bias: Some(on_bias) }, on_input))
    }
}
