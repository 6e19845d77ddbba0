//! One optimisation of the network on one measurement matrix, called a head (not a head of the PointNet): forward,
//! losses, backward, Adam, by the paper's own objective or by the [continued](continuation) one.

mod continuation;
mod options;
#[cfg(test)]
mod tests;

use nalgebra::DMatrix;

use super::cloud::{CloudNetwork, Output, finite};
use super::losses::{self, CountTerm, RankTerm, Terms};
use super::{Error, NetworkSettings};
use crate::domain::{Losses, Phase};
use continuation::Continuation;
pub use continuation::{ContinuedStart, wrong_residual};
pub use options::ContinuationOptions;

/// Weight of every track before the first step: the network's logits start near 0.
const INITIAL_WEIGHT: f64 = 0.5;
/// Slope below 0 of PointNet's rectifiers.
const RELU: f32 = 0.0;

/// What is optimised.
#[derive(Debug, Clone, PartialEq)]
pub enum HeadObjective {
    /// The paper's objective as printed: its equations from the first iteration to the last.
    Literal,
    Continued {
        start: ContinuedStart,
        options: ContinuationOptions,
    },
}

/// One optimisation of the network on one balanced measurement matrix.
///
/// Deterministic: one matrix, one seed, one objective, one set of settings and one build give the same bits.
/// Single-threaded.
pub struct Head {
    settings: NetworkSettings,
    balanced: DMatrix<f64>,
    network: CloudNetwork,
    weights: Vec<f64>,
    plane_at_infinity: [f64; 3],
    /// `None`: literal.
    continuation: Option<Continuation>,
    iteration: u32,
    replaced_gradients: u64,
}

/// What one step saw, before it changed the network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeadIteration {
    /// Counted from 1.
    pub iteration: u32,
    /// Of the continuation; `None` by the literal objective.
    pub phase: Option<Phase>,
    /// Unweighted. L_DAQ is reported even where it is not optimised, then at the focal length and plane of the start.
    pub losses: Losses,
    /// Residual at which the growth of the consensus ends; `None` outside the growth.
    pub tolerance: Option<f64>,
}

/// What a step optimises.
struct Objective<'a> {
    matrix: &'a DMatrix<f64>,
    terms: Terms,
    /// Weight of L_proj.
    alpha: f64,
}

/// The losses at one point and the derivatives of their weighted sum with respect to every array of the network.
pub(super) struct Slope {
    pub losses: Losses,
    /// In the order of [`PointNet::arrays`](super::pointnet::PointNet::arrays); none where the loss does not reach the
    /// array, which then stays as it is.
    pub arrays: Vec<Option<Vec<f32>>>,
    /// `None` where L_DAQ does not move it.
    pub log_focal: Option<f32>,
}

impl Head {
    /// A network with freshly drawn weights.
    ///
    /// * `balanced`: 3n x m, view blocks of equal energy, columns of unit norm; columns of zeros are harmless
    /// * `seed`: of the initial weights, in place of that of the settings
    /// * `settings`: of the continuation, `alpha` and `min_inliers` are those of the first iteration, and `kappa` has
    ///   no effect
    ///
    /// # Errors
    /// [`Error::TooFewColumns`], [`Error::WrongRows`] or [`Error::NotFinite`].
    pub fn new(
        balanced: &DMatrix<f64>,
        settings: &NetworkSettings,
        seed: u64,
        objective: HeadObjective,
    ) -> Result<Self, Error> {
        let (slope, continuation) = match objective {
            HeadObjective::Literal => (RELU, None),
            HeadObjective::Continued { start, options } => {
                (options.leak as f32, Some(Continuation::new(balanced, settings, start, options)))
            }
        };
        Ok(Self {
            network: CloudNetwork::new(balanced, settings.width, slope, seed, settings.backend)?,
            weights: vec![INITIAL_WEIGHT; balanced.ncols()],
            plane_at_infinity: [0.0; 3],
            continuation,
            iteration: 0,
            replaced_gradients: 0,
            balanced: balanced.clone(),
            settings: settings.clone(),
        })
    }

    /// Whether all planned iterations are done.
    pub fn is_finished(&self) -> bool {
        self.iteration >= self.settings.iterations
    }

    /// One iteration: forward, losses and their gradients, backward, Adam.
    ///
    /// # Errors
    /// [`Error::Diverged`] when the network's output is not finite, [`Error::NoDecomposition`] when the matrix
    /// overflows, [`Error::Backend`] for a defect of burn.
    pub fn step(&mut self) -> Result<HeadIteration, Error> {
        let phase = self.continuation.as_ref().map(|continuation| continuation.phase(self.iteration));
        let Slope { losses, arrays, log_focal } = self.differentiate()?;
        let rate = self.settings.learning_rate as f32;
        self.replaced_gradients += self.network.descend(&arrays, rate);
        if let Some(gradient) = log_focal {
            self.replaced_gradients += self.network.descend_focal(gradient, rate);
        }
        self.iteration += 1;
        let growing = self.continuation.as_ref().filter(|_| phase == Some(Phase::Growth));
        let tolerance = growing.map(Continuation::tolerance);
        Ok(HeadIteration { iteration: self.iteration, phase, losses, tolerance })
    }

    /// Has the network say its weights after the latest step; [`Self::weights`] are those before it.
    ///
    /// # Errors
    /// As [`Self::step`].
    pub fn update_weights(&mut self) -> Result<(), Error> {
        self.weights = self.network.forward(false, self.iteration)?.weights;
        Ok(())
    }

    /// Weights that the latest step saw, one a column, in [0, 1]; 1/2 before the first.
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// Focal length in the units of the measurement matrix; that of the start where L_DAQ has no part.
    pub fn focal(&self) -> f64 {
        self.network.log_focal().exp()
    }

    /// Residual (sine of the angle to the span) at which the growth of the consensus ended; `None` by the literal
    /// objective, which asks for none.
    pub fn tolerance(&self) -> Option<f64> {
        self.continuation.as_ref().map(Continuation::tolerance)
    }

    #[cfg(test)]
    /// Plane at infinity of the latest step, in the gauge of [`losses::evaluate`].
    pub fn plane_at_infinity(&self) -> [f64; 3] {
        self.plane_at_infinity
    }

    #[cfg(test)]
    /// Gradients so far that were not finite and counted as 0.
    pub fn replaced_gradients(&self) -> u64 {
        self.replaced_gradients
    }

    /// Forward, losses, backward; changes nothing but what the network was last seen to say, and where a phase begins,
    /// what the continuation takes from that.
    ///
    /// The backward pass starts from the derivatives with respect to the network's outputs. The focal length is no
    /// output; its derivative is passed on.
    pub(super) fn differentiate(&mut self) -> Result<Slope, Error> {
        let moves_calibration = self.settings.use_daq
            && self.continuation.as_ref().is_none_or(|continuation| continuation.uses_daq(self.iteration));
        let output = self.network.forward(moves_calibration, self.iteration + 1)?;
        let Output { pass, weights, plane_at_infinity } = output;
        (self.weights, self.plane_at_infinity) = (weights, plane_at_infinity);
        if let Some(continuation) = &mut self.continuation {
            continuation.begin_phases(self.iteration, &self.balanced, &self.weights)?;
        }
        let objective = self.objective();
        let log_focal = self.network.log_focal();
        let evaluation =
            losses::evaluate(objective.matrix, &self.weights, log_focal, plane_at_infinity, objective.terms)?;
        let beta = self.settings.beta;
        // What is not finite becomes 0 and is counted.
        let mut replaced = 0;
        let on_logits = self.weights.iter().enumerate().map(|(column, w)| {
            let on_weight = evaluation.grad_w_num[column]
                + objective.alpha * evaluation.grad_w_proj[column]
                + beta * evaluation.grad_w_daq[column];
            finite(on_weight * w * (1.0 - w), &mut replaced)
        });
        let on_logits = on_logits.collect();
        let on_plane =
            moves_calibration.then(|| evaluation.grad_n_inf.map(|gradient| finite(beta * gradient, &mut replaced)));
        let on_focal = moves_calibration.then(|| finite(beta * evaluation.grad_log_focal, &mut replaced));
        self.replaced_gradients += replaced;
        let arrays = pass.backward(on_logits, on_plane)?.into_arrays().collect();
        Ok(Slope { losses: evaluation.losses, arrays, log_focal: on_focal })
    }

    /// What the coming step optimises.
    fn objective(&self) -> Objective<'_> {
        let NetworkSettings { alpha, min_inliers, kappa, use_daq, .. } = self.settings;
        match &self.continuation {
            None => {
                let count = CountTerm::Sigmoid { min_inliers, kappa };
                let terms = Terms { count, rank: RankTerm::TAIL, daq_moves_weights: use_daq };
                Objective { matrix: &self.balanced, terms, alpha }
            }
            Some(continuation) => {
                let count = CountTerm::Tangent { min_inliers: continuation.min_inliers(self.iteration) };
                let (matrix, alpha, rank) = continuation.rank_term(self.iteration, &self.balanced);
                Objective { matrix, terms: Terms { count, rank, daq_moves_weights: false }, alpha }
            }
        }
    }
}
