//! Multi-view geometry as pure functions and types: cameras, measurements, epipolar geometry, factorisation,
//! triangulation, the dual absolute quadric, bundle adjustment, degeneracy.
//!
//! f64 throughout. May depend on `domain` (the stop token) and linear algebra; knows nothing of networks, jobs or I/O.

pub(crate) mod bundle;
pub(crate) mod critical;
pub(crate) mod daq;
pub(crate) mod epipolar_depths;
pub(crate) mod factorization;
pub(crate) mod fundamental;
pub(crate) mod homography;
mod levenberg_marquardt;
pub(crate) mod measurement;
pub(crate) mod metric;
mod null_vector;
pub(crate) mod observation;
pub(crate) mod planar;
pub(crate) mod pose;
pub(crate) mod procrustes;
mod ransac;
pub(crate) mod resection;
pub(crate) mod robust_triangulation;
pub(crate) mod similarity;
pub mod statistics;
pub(crate) mod three_views;
pub(crate) mod triangulation;

use nalgebra::{Matrix3x4, Vector4};

/// Projective camera, 3x4, defined up to scale.
pub type Camera = Matrix3x4<f64>;

/// Homogeneous point, defined up to scale.
pub type Point = Vector4<f64>;
