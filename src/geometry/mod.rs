//! Multi-view geometry as pure functions and types: cameras, measurements, epipolar geometry, factorisation,
//! triangulation, the dual absolute quadric, bundle adjustment, degeneracy.
//!
//! f64 throughout. May depend on `domain` (the stop token) and linear algebra; knows nothing of networks, jobs or I/O.

pub mod bundle;
pub mod critical;
pub mod daq;
pub mod epipolar_depths;
pub mod factorization;
pub mod fundamental;
pub mod homography;
mod levenberg_marquardt;
pub mod measurement;
pub mod metric;
mod null_vector;
pub mod observation;
pub mod planar;
pub mod pose;
pub mod procrustes;
mod ransac;
pub mod resection;
pub mod robust_triangulation;
pub mod statistics;
pub mod triangulation;

use nalgebra::{Matrix3x4, Vector4};

/// Projective camera, 3x4, defined up to scale.
pub type Camera = Matrix3x4<f64>;

/// Homogeneous point, defined up to scale.
pub type Point = Vector4<f64>;
