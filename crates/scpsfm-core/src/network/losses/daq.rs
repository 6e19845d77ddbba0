//! The DAQ residual: how far the dual images of the absolute conic are from one constant calibration.

use nalgebra::{Matrix3, Vector3};

use super::gauge::CanonicalCameras;

/// Under the square root of each view's residual: the first view's is exactly 0, where a norm has no derivative.
const RESIDUAL_FLOOR: f64 = 1e-10;
/// Under the square root of a DIAC's norm.
const NORM_FLOOR: f64 = 1e-20;

/// L_DAQ and its derivatives.
pub struct Residual {
    pub value: f64,
    /// With respect to every `A_i`.
    pub grad_rotational: Vec<Matrix3<f64>>,
    /// With respect to every `a_i`.
    pub grad_translational: Vec<Vector3<f64>>,
    pub grad_log_focal: f64,
    pub grad_n_inf: Vector3<f64>,
}

/// `Σ_i | S_i/|S_i| - ω/|ω| |` with `S_i = (A_i - a_i nᵀ) ω (A_i - a_i nᵀ)ᵀ` and `ω = diag(f², f², 1)` (the paper's
/// L_DAQ).
///
/// The principal point is the origin and pixels are square: the units of the measurement matrix see to it.
pub fn residual(cameras: &CanonicalCameras, log_focal: f64, n_inf: &Vector3<f64>) -> Residual {
    let focal_squared = (2.0 * log_focal).exp();
    let omega = Matrix3::from_diagonal(&Vector3::new(focal_squared, focal_squared, 1.0));
    let omega_norm = omega.norm();
    let omega_unit = omega / omega_norm;
    let views = cameras.rotational().len();
    let mut result = Residual {
        value: 0.0,
        grad_rotational: Vec::with_capacity(views),
        grad_translational: Vec::with_capacity(views),
        grad_log_focal: 0.0,
        grad_n_inf: Vector3::zeros(),
    };
    let (mut grad_omega, mut grad_omega_unit) = (Matrix3::zeros(), Matrix3::zeros());
    for (view, rotational) in cameras.rotational().iter().enumerate() {
        let translational = cameras.translational(view);
        // The infinite homography from the first view to this one.
        let homography = rotational - translational * n_inf.transpose();
        let diac = homography * omega * homography.transpose();
        let norm = (diac.norm_squared() + NORM_FLOOR).sqrt();
        let difference = diac / norm - omega_unit;
        let distance = (difference.norm_squared() + RESIDUAL_FLOOR).sqrt();
        result.value += distance;

        let grad_unit = difference / distance;
        let grad_diac = grad_unit / norm - diac * (grad_unit.dot(&diac) / norm.powi(3));
        let grad_homography = grad_diac * homography * omega * 2.0;
        grad_omega_unit -= grad_unit;
        grad_omega += homography.transpose() * grad_diac * homography;
        result.grad_n_inf -= grad_homography.transpose() * translational;
        result.grad_translational.push(-grad_homography * n_inf);
        result.grad_rotational.push(grad_homography);
    }
    grad_omega += grad_omega_unit / omega_norm - omega * (grad_omega_unit.dot(&omega) / omega_norm.powi(3));
    result.grad_log_focal = 2.0 * focal_squared * (grad_omega[(0, 0)] + grad_omega[(1, 1)]);
    result
}
