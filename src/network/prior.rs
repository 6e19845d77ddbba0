//! The optimisation loop: one request's matrix, one network, one step at a time.

use nalgebra::DMatrix;

use super::cloud::{CloudNetwork, Output, finite};
use super::losses::{self, Evaluation, LossSettings};
use super::pass::PlaneUse;
use super::{Error, NetworkSettings};
use crate::domain::Losses;

/// Share of the planned iterations after which L_DAQ acts on the weights. Earlier it pulls them into false minima: mean
/// F1 .80 against .995 at 90 % outliers.
pub const DAQ_ONSET: f64 = 0.6;
/// Weight of every track before the first step: the network's logits start near 0.
const INITIAL_WEIGHT: f64 = 0.5;

/// Of the rectifiers below 0: PointNet's ReLU.
const SLOPE: f32 = 0.0;

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
    network: CloudNetwork,
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
        Ok(Self {
            network: CloudNetwork::new(balanced, settings.width, SLOPE, settings.seed, settings.backend)?,
            weights: vec![INITIAL_WEIGHT; balanced.ncols()],
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
        self.replaced_gradients += self.network.descend(&arrays, rate);
        if self.settings.use_daq {
            self.replaced_gradients += self.network.descend_focal(log_focal, rate);
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
        self.network.log_focal().exp()
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
        let plane_use = if daq_on_weights { PlaneUse::Joint } else { PlaneUse::Apart };
        let Output { pass, weights, plane_at_infinity } = self.network.forward(plane_use, self.iteration + 1)?;
        (self.weights, self.plane_at_infinity) = (weights, plane_at_infinity);
        let evaluation = losses::evaluate(
            &self.balanced,
            &self.weights,
            self.network.log_focal(),
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

    /// Weighs and adds up the losses' derivatives, through the sigmoid; what is not finite becomes 0 and is counted.
    fn gradients(&mut self, evaluation: &Evaluation, daq_on_weights: bool) -> Gradients {
        let beta = if self.settings.use_daq { self.settings.beta } else { 0.0 };
        let beta_weights = if daq_on_weights { beta } else { 0.0 };
        let mut replaced = 0;
        let logits = self.weights.iter().enumerate().map(|(column, w)| {
            let on_weight = evaluation.grad_w_num[column]
                + self.settings.alpha * evaluation.grad_w_proj[column]
                + beta_weights * evaluation.grad_w_daq[column];
            finite(on_weight * w * (1.0 - w), &mut replaced)
        });
        let logits = logits.collect();
        let plane = evaluation.grad_n_inf.map(|gradient| finite(beta * gradient, &mut replaced));
        let log_focal = finite(beta * evaluation.grad_log_focal, &mut replaced);
        self.replaced_gradients += replaced;
        Gradients { logits, plane, log_focal }
    }
}
