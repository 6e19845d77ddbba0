//! Self-calibrating projective structure from motion, as a library and as a long-running gRPC service.
//!
//! After R. Gong, D. P. Paudel, A. Chhatkuli, L. Van Gool: Self-Calibration Supported Robust Projective
//! Structure-from-Motion, 2020; called "the paper" from here on, its equations by its own numbers.
//!
//! Tracks of uncalibrated images go in, most of them possibly wrong; which tracks are right, the intrinsics with
//! their uncertainty, the plane at infinity and the projective and metric reconstruction come out, or the honest
//! statement that the motion carries no calibration.
//!
//! Direction of dependence, top to bottom; nothing points upwards:
//!
//! ```text
//! cli -> http -> rpc -> engine -> { store, solver } -> { network, geometry } -> domain
//! ```
//!
//! Beside them `evaluation` holds the methods against the truth of [`synthetic`] scenes.
//!
//! Only [`rpc`], [`http`] and the client side of [`cli`] see prost and tonic, only [`store`] sees SQL
//! (but for `formats`, which reads COLMAP's databases), only `network` sees burn; `geometry` is plain f64 linear
//! algebra.

#[macro_use]
mod lists;

pub mod cli;
pub mod config;
pub mod domain;
pub mod engine;
pub(crate) mod evaluation;
pub(crate) mod formats;
pub(crate) mod geometry;
pub mod http;
pub(crate) mod network;
pub(crate) mod parallel;
pub(crate) mod report;
pub mod rpc;
mod simd;
pub mod solver;
pub mod store;
pub mod synthetic;
pub mod telemetry;
pub(crate) mod training;
