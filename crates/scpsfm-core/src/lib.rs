//! The numerical part of scpsfm: self-calibrating projective structure from motion, without files and transport.
//!
//! After R. Gong, D. P. Paudel, A. Chhatkuli, L. Van Gool: Self-Calibration Supported Robust Projective
//! Structure-from-Motion, 2020; called "the paper" from here on, its equations by its own numbers.
//!
//! Tracks of uncalibrated images go in, most of them possibly wrong; which tracks are right, the intrinsics with
//! their uncertainty, the plane at infinity and the projective and metric reconstruction come out, or the honest
//! statement that the motion carries no calibration: [`solver::solve`].
//!
//! Direction of dependence, top to bottom; nothing points upwards:
//!
//! ```text
//! evaluation -> solver -> network -> geometry -> domain
//! ```
//!
//! `training` makes the network's parameters, [`synthetic`] the scenes that training and evaluation need. Only `network`
//! and `training` see burn; `geometry` is plain f64 linear algebra.

#[macro_use]
mod lists;

pub mod domain;
pub mod evaluation;
pub(crate) mod geometry;
pub(crate) mod network;
pub mod parallel;
mod simd;
pub mod solver;
pub mod synthetic;
pub mod training;

pub use geometry::{fundamental::matrix_of_cameras, statistics};
pub use network::subspace;
