//! Bundle adjustment by Levenberg-Marquardt on the Schur complement of the points, or of the cameras where the points
//! are few; projective and metric.
//!
//! Metric reconstructions are adjusted by `sequence`; projective ones and the models of `critical` by `engine`, whose
//! unknowns have sizes that are known when it is compiled. Both are minimised by the loop of
//! `levenberg_marquardt`, whose options and loss they share. May depend on nothing of `geometry` but that and
//! `observation`, and on linear algebra.
//!
//! Image coordinates are normalised throughout: pixels minus the guessed principal point, over the larger image side.

mod camera_elimination;
mod covariance;
pub mod critical;
mod dense;
mod engine;
mod fisheye;
mod intrinsics;
mod intrinsics_model;
pub mod metric;
mod problem;
pub mod projective;
pub mod sequence;
#[cfg(test)]
pub(crate) mod testing;
mod whitened;
mod without_views;

pub use super::levenberg_marquardt::{Loss, Options, Report};
use super::observation::Observation;
