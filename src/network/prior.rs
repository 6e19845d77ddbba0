//! The optimisation loop: one request's matrix, one network, one step at a time.

use burn::tensor::{Device, Tensor};
use nalgebra::DMatrix;

use super::losses::{self, Evaluation, LossSettings};
use super::parameter::Parameter;
use super::pass::Pass;
use super::pointnet::{self, PointNet};
use super::{Error, NetworkSettings};
use crate::domain::{Backend, Losses};

/// Share of the planned iterations after which L_DAQ acts on the weights. Earlier it pulls them into false minima: mean
/// F1 .80 against .995 at 90 % outliers.
pub const DAQ_ONSET: f64 = 0.6;
/// Learning rate of log f as a multiple of the network's. Adam moves a parameter by about one rate a step, and log f
/// may have to travel .6: at the network's own 1e-3 it does not arrive. Median focal error after 300 iterations at 50,
/// 70 and 90 % outliers (20 scenes each): 1.2, 1.9 and 6.0 % at the network's rate, .1, .2 and .5 % at five times, no
/// better at twenty.
const FOCAL_RATE: f32 = 5.0;
/// Weight of every track before the first step: the network's logits start near 0.
const INITIAL_WEIGHT: f64 = 0.5;

/// What one step saw, before it changed the network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Iteration {
    /// Counted from 1.
    pub iteration: u32,
    /// Unweighted. L_DAQ is reported even where it is not optimised.
    pub losses: Losses,
}

/// The paper's network, optimised on one balanced measurement matrix.
///
/// Deterministic: one matrix, one set of settings and one build give the same bits. Single-threaded.
pub struct PriorNetwork {
    settings: NetworkSettings,
    balanced: DMatrix<f64>,
    /// The network's input, 3n x m: columns scaled so that entries have mean square 1, rows centred.
    cloud: Tensor<2>,
    device: Device,
    network: PointNet<Parameter>,
    log_focal: Parameter,
    weights: Vec<f64>,
    plane_at_infinity: [f64; 3],
    iteration: u32,
    replaced_gradients: u64,
}

/// The losses at one point and the derivatives of their weighted sum with respect to every array of the network.
pub(super) struct Slope {
    pub losses: Losses,
    /// In the order of [`PointNet::arrays`]; none where the loss does not reach the array, which then stays as it is.
    pub arrays: Vec<Option<Vec<f32>>>,
    pub log_focal: f32,
}

/// Derivatives of the weighted loss with respect to what the network puts out.
struct Gradients {
    logits: Vec<f32>,
    plane: [f32; 3],
    log_focal: f32,
}

impl PriorNetwork {
    /// Any four columns have rank 4; the fifth is the first that can contradict them.
    pub const MIN_COLUMNS: usize = 5;

    /// A network with freshly drawn weights.
    ///
    /// * `balanced`: 3n x m, view blocks of equal energy, columns of unit norm; columns of zeros are harmless
    ///
    /// # Errors
    /// [`Error::TooFewColumns`], [`Error::WrongRows`] or [`Error::NotFinite`].
    pub fn new(balanced: &DMatrix<f64>, settings: &NetworkSettings) -> Result<Self, Error> {
        check(balanced)?;
        let device = device(settings.backend);
        let (rows, columns) = balanced.shape();
        Ok(Self {
            cloud: pointnet::constant(centred_cloud(balanced), [rows, columns], &device),
            device,
            network: PointNet::new(rows, settings.width, settings.seed),
            log_focal: pointnet::initial_log_focal(),
            weights: vec![INITIAL_WEIGHT; columns],
            plane_at_infinity: [0.0; 3],
            iteration: 0,
            replaced_gradients: 0,
            balanced: balanced.clone(),
            settings: settings.clone(),
        })
    }

    /// One iteration: forward, losses and their gradients, backward, Adam.
    ///
    /// # Errors
    /// [`Error::Diverged`] when the network's output is not finite, [`Error::NoDecomposition`] when the matrix
    /// overflows, [`Error::Backend`] for a defect of burn.
    pub fn step(&mut self) -> Result<Iteration, Error> {
        let Slope { losses, arrays, log_focal } = self.differentiate()?;
        let rate = self.settings.learning_rate as f32;
        for (gradient, parameter) in arrays.iter().zip(self.network.arrays_mut()) {
            if let Some(gradient) = gradient {
                self.replaced_gradients += parameter.step(gradient, rate);
            }
        }
        if self.settings.use_daq {
            self.replaced_gradients += self.log_focal.step(&[log_focal], FOCAL_RATE * rate);
        }
        self.iteration += 1;
        Ok(Iteration { iteration: self.iteration, losses })
    }

    /// Weights of the latest step, one a column, in [0, 1]; 1/2 before the first.
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// Focal length in the units of the measurement matrix.
    pub fn focal(&self) -> f64 {
        self.log_focal().exp()
    }

    #[cfg(test)]
    /// Plane at infinity of the latest step, in the gauge of [`losses::evaluate`].
    pub fn plane_at_infinity(&self) -> [f64; 3] {
        self.plane_at_infinity
    }

    /// Steps done.
    pub fn iteration(&self) -> u32 {
        self.iteration
    }

    #[cfg(test)]
    /// Gradients so far that were not finite and counted as 0.
    pub fn replaced_gradients(&self) -> u64 {
        self.replaced_gradients
    }

    fn log_focal(&self) -> f64 {
        self.log_focal.values().first().map_or(0.0, |&value| f64::from(value))
    }

    /// Whether the coming step lets L_DAQ act on the weights and on the trunk.
    fn daq_acts_on_weights(&self) -> bool {
        self.settings.use_daq && f64::from(self.iteration) >= DAQ_ONSET * f64::from(self.settings.iterations)
    }

    /// Forward, losses, backward; changes nothing but what the network was last seen to say.
    ///
    /// The backward pass starts from the derivatives with respect to the network's outputs. The focal length is no
    /// output; its derivative is passed on.
    pub(super) fn differentiate(&mut self) -> Result<Slope, Error> {
        let daq_on_weights = self.daq_acts_on_weights();
        let pass = self.network.forward(&self.cloud, !daq_on_weights, &self.device)?;
        self.read(&pass)?;
        let evaluation = losses::evaluate(
            &self.balanced,
            &self.weights,
            self.log_focal(),
            self.plane_at_infinity,
            &LossSettings { min_inliers: self.settings.min_inliers, kappa: self.settings.kappa },
        )?;
        let gradients = self.gradients(&evaluation, daq_on_weights);

        let on_plane = self.settings.use_daq.then_some(gradients.plane);
        let gradient = pass.backward(gradients.logits, on_plane)?;
        Ok(Slope {
            losses: evaluation.losses,
            arrays: gradient.into_arrays().collect(),
            log_focal: gradients.log_focal,
        })
    }

    /// Takes weights and plane from the network's output.
    fn read(&mut self, Pass { logits, plane, .. }: &Pass) -> Result<(), Error> {
        if logits.iter().chain(plane).any(|value| !value.is_finite()) {
            return Err(Error::Diverged { iteration: self.iteration + 1 });
        }
        self.weights = logits.iter().map(|&logit| sigmoid(f64::from(logit))).collect();
        self.plane_at_infinity = [0, 1, 2].map(|axis| f64::from(plane[axis]));
        Ok(())
    }

    /// Weighs and adds up the losses' derivatives, through the sigmoid; what is not finite becomes 0 and is counted.
    fn gradients(&mut self, evaluation: &Evaluation, daq_on_weights: bool) -> Gradients {
        let beta = if self.settings.use_daq { self.settings.beta } else { 0.0 };
        let beta_weights = if daq_on_weights { beta } else { 0.0 };
        let mut replaced = 0;
        let mut finite = |value: f64| {
            let value = value as f32;
            if value.is_finite() {
                value
            } else {
                replaced += 1;
                0.0
            }
        };
        let logits = self.weights.iter().enumerate().map(|(column, w)| {
            let on_weight = evaluation.grad_w_num[column]
                + self.settings.alpha * evaluation.grad_w_proj[column]
                + beta_weights * evaluation.grad_w_daq[column];
            finite(on_weight * w * (1.0 - w))
        });
        let logits = logits.collect();
        let plane = evaluation.grad_n_inf.map(|gradient| finite(beta * gradient));
        let log_focal = finite(beta * evaluation.grad_log_focal);
        self.replaced_gradients += replaced;
        Gradients { logits, plane, log_focal }
    }
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
    if columns < PriorNetwork::MIN_COLUMNS {
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
