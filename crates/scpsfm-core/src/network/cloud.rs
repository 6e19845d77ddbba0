//! The network on one cloud of columns, with the focal length beside it: what every loss here optimises.

use burn_tensor::{Device, Tensor};
use nalgebra::DMatrix;

use super::parameter::Parameter;
use super::pass::Pass;
use super::pointnet::{self, PointNet};
use super::{Error, MIN_COLUMNS};
use crate::domain::Backend;

/// Learning rate of log f as a multiple of the network's. Adam moves a parameter by about one rate a step, and log f
/// may have to travel .6: at the network's own 1e-3 it does not arrive. Median focal error after 300 iterations at 50,
/// 70 and 90 % outliers (20 scenes each): 1.2, 1.9 and 6.0 % at the network's rate, .1, .2 and .5 % at five times, no
/// better at twenty.
const FOCAL_RATE: f32 = 5.0;

/// Stands for a plane at infinity that was not computed.
const NO_PLANE: [f32; 3] = [0.0; 3];

/// A PointNet and the columns it is shown.
pub struct CloudNetwork {
    /// 3n x m: columns scaled so that entries have mean square 1, rows centred.
    cloud: Tensor<2>,
    device: Device,
    network: PointNet<Parameter>,
    log_focal: Parameter,
    /// Of the segmentation head's rectifiers below 0.
    slope: f32,
}

/// What the network says of its cloud.
pub struct Output {
    pub pass: Pass,
    /// Weights, one a column, in [0, 1].
    pub weights: Vec<f64>,
    /// 0 where it was not wanted: about where freshly drawn networks have it.
    pub plane_at_infinity: [f64; 3],
}

impl CloudNetwork {
    /// A network with freshly drawn weights.
    ///
    /// * `balanced`: 3n x m, columns of unit norm or zero
    /// * `slope`: of the segmentation head's rectifiers below 0
    ///
    /// # Errors
    /// [`Error::TooFewColumns`], [`Error::WrongRows`] or [`Error::NotFinite`].
    pub fn new(balanced: &DMatrix<f64>, width: f64, slope: f32, seed: u64, backend: Backend) -> Result<Self, Error> {
        check(balanced)?;
        let device = device(backend);
        let (rows, columns) = balanced.shape();
        Ok(Self {
            cloud: pointnet::constant(centred_cloud(balanced), [rows, columns], &device),
            device,
            network: PointNet::new(rows, width, seed),
            log_focal: pointnet::initial_log_focal(),
            slope,
        })
    }

    /// Runs the network.
    ///
    /// * `with_plane`: whether the plane at infinity is computed
    /// * `iteration`: counted from 1, for the error
    ///
    /// # Errors
    /// [`Error::Diverged`] when the output is not finite, [`Error::Backend`] for a defect of burn.
    pub fn forward(&self, with_plane: bool, iteration: u32) -> Result<Output, Error> {
        let pass = self.network.forward(&self.cloud, with_plane, self.slope, &self.device)?;
        let plane = pass.plane().unwrap_or(&NO_PLANE);
        if pass.logits.iter().chain(plane).any(|value| !value.is_finite()) {
            return Err(Error::Diverged { iteration });
        }
        let weights = pass.logits.iter().map(|&logit| sigmoid(f64::from(logit))).collect();
        let plane_at_infinity = [0, 1, 2].map(|axis| f64::from(plane[axis]));
        Ok(Output { pass, weights, plane_at_infinity })
    }

    /// One step of Adam in the arrays that have a gradient; returns how many entries were not finite.
    ///
    /// * `arrays`: in the order of [`PointNet::arrays_mut`]
    pub fn descend(&mut self, arrays: &[Option<Vec<f32>>], rate: f32) -> u64 {
        let reached = arrays.iter().zip(self.network.arrays_mut());
        reached.filter_map(|(gradient, parameter)| Some(parameter.step(gradient.as_ref()?, rate))).sum()
    }

    /// The same for the focal length, at the rate that suits it where the network's is `rate`.
    pub fn descend_focal(&mut self, gradient: f32, rate: f32) -> u64 {
        self.log_focal.step(&[gradient], FOCAL_RATE * rate)
    }

    /// Logarithm of the focal length in the units of the measurement matrix.
    pub fn log_focal(&self) -> f64 {
        self.log_focal.values().first().map_or(0.0, |&value| f64::from(value))
    }
}

/// A derivative in the network's precision; what is not finite becomes 0 and is counted.
pub fn finite(value: f64, replaced: &mut u64) -> f32 {
    let value = value as f32;
    if value.is_finite() {
        return value;
    }
    *replaced += 1;
    0.0
}

/// burn marks its ndarray backend deprecated; it is offered because callers ask for it.
#[allow(deprecated)]
fn device(backend: Backend) -> Device {
    match backend {
        Backend::Flex => Device::flex(),
        Backend::Ndarray => Device::ndarray(),
    }
}

fn check(balanced: &DMatrix<f64>) -> Result<(), Error> {
    let (rows, columns) = balanced.shape();
    if rows < 6 || !rows.is_multiple_of(3) {
        return Err(Error::WrongRows { rows });
    }
    if columns < MIN_COLUMNS {
        return Err(Error::TooFewColumns { columns });
    }
    for column in 0..columns {
        for row in 0..rows {
            let value = balanced[(row, column)];
            if !value.is_finite() {
                return Err(Error::NotFinite { row, column, value });
            }
        }
    }
    Ok(())
}

/// `sqrt(3n)` times the matrix, each row less its mean, row by row. Unit columns become entries of mean square 1; the
/// mean is what the first layer's statistics would subtract.
fn centred_cloud(balanced: &DMatrix<f64>) -> Vec<f32> {
    let scale = (balanced.nrows() as f64).sqrt();
    let mut cloud = Vec::with_capacity(balanced.len());
    for row in balanced.row_iter() {
        let mean = row.mean();
        cloud.extend(row.iter().map(|entry| (scale * (entry - mean)) as f32));
    }
    cloud
}

fn sigmoid(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}
