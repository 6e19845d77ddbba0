//! Bundle adjustment by Levenberg-Marquardt on the Schur complement of the points, or of the cameras where the points
//! are few; projective and metric.
//!
//! Metric reconstructions are adjusted by `sequence`; projective ones and the models of `critical` by `engine`, whose
//! unknowns have sizes that are known when it is compiled. What both share (robust loss, options, report) lives here.
//! May depend on nothing of `geometry` but `levenberg_marquardt` and `observation`, and on linear algebra.
//!
//! Image coordinates are normalised throughout: pixels minus the guessed principal point, over the larger image side.

mod camera_elimination;
mod cholesky;
mod covariance;
pub mod critical;
mod engine;
mod fisheye;
mod intrinsics;
mod intrinsics_model;
pub mod metric;
mod own_focals;
mod panel;
mod problem;
pub mod projective;
mod reduced;
pub mod sequence;
#[cfg(test)]
pub(crate) mod testing;
mod whitened;
mod without_views;

use super::levenberg_marquardt;
pub use super::levenberg_marquardt::Report;
use super::observation::Observation;

/// What a residual costs, as a function of its norm `r` in normalised image units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Loss {
    /// `r^2`
    Squared,
    /// `s^2 ln(1 + r^2 / s^2)` with `s` the scale; iteratively reweighted.
    Cauchy { scale: f64 },
}

impl Loss {
    /// Cost of a residual of this squared norm.
    #[inline]
    pub fn cost(self, squared: f64) -> f64 {
        match self {
            Loss::Squared => squared,
            Loss::Cauchy { scale } => scale * scale * (squared / (scale * scale)).ln_1p(),
        }
    }

    /// Factor on residual and Jacobian that makes least squares follow the loss: the root of its derivative.
    #[inline]
    pub fn root_weight(self, squared: f64) -> f64 {
        match self {
            Loss::Squared => 1.0,
            Loss::Cauchy { scale } => (1.0 + squared / (scale * scale)).sqrt().recip(),
        }
    }
}

/// How to adjust.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Accepted steps at most.
    pub max_iterations: usize,
    /// Ends when a step lowers the cost by less than this share of it.
    pub relative_tolerance: f64,
    /// First damping, relative to the diagonal of the normal equations.
    pub initial_damping: f64,
    /// Ends as hopeless where it will not get below this cost, see [`levenberg_marquardt::Options::hopeless_above`].
    pub hopeless_above: f64,
    pub loss: Loss,
}

impl Options {
    /// Plain least squares with these iterations.
    pub fn squared(max_iterations: usize) -> Self {
        Self { max_iterations, ..Self::default() }
    }

    /// What the loop asks.
    fn of_loop(&self, min_damping: f64) -> levenberg_marquardt::Options {
        let Self { max_iterations, relative_tolerance, initial_damping, hopeless_above, loss: _ } = *self;
        levenberg_marquardt::Options {
            max_iterations,
            relative_tolerance,
            initial_damping,
            min_damping,
            hopeless_above,
        }
    }
}

impl Default for Options {
    /// Converges from an algebraic solution: 30 steps are rarely used up, and a cost that moves by less than 1e-7 is
    /// far below the noise it is compared with.
    fn default() -> Self {
        Self {
            max_iterations: 30,
            relative_tolerance: 1e-7,
            initial_damping: 1e-4,
            hopeless_above: f64::INFINITY,
            loss: Loss::Squared,
        }
    }
}
