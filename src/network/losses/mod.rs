//! The three terms of the paper's loss (its eq. 11) with exact gradients, in f64 and outside any autodiff graph.
//!
//! Pure functions of the balanced matrix, the weights and the calibration; nothing here knows of the network.
//!
//! With `A = M diag(w)` and the eigen-decomposition `A Aᵀ = U Λ Uᵀ`:
//! * `L_num = exp(t - Σ_j s(κ (w_j - 1/2)))`,
//! * `L_proj = Σ_{k>=5} σ_k(A)`, in `spectrum.rs`,
//! * `L_DAQ = Σ_i | S_i/|S_i| - ω/|ω| |` over the views, in the cameras that `gauge.rs` reads off the span of
//!   the first four eigenvectors.
//!
//! `continued.rs` has what becomes of them in a continuation.

mod continued;
#[cfg(test)]
mod continued_tests;
mod daq;
mod gauge;
#[cfg(test)]
mod reference_tests;
mod spectrum;
#[cfg(test)]
mod tests;

use nalgebra::{DMatrix, Vector3};

use super::Error;
use crate::domain::Losses;
pub use continued::{RankTerm, evaluate_continued};
use spectrum::Spectrum;

/// Largest exponent of L_num: e³⁰ is about 1e13, and its gradient still fits into the f32 of the network. The gradient
/// keeps the capped value instead of vanishing, or weights that collapsed could never come back.
const MAX_EXPONENT: f64 = 30.0;

/// Settings that the losses themselves contain; alpha and beta only weigh them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossSettings {
    /// The paper's `t`.
    pub min_inliers: f64,
    /// Slope of the sigmoid in L_num.
    pub kappa: f64,
}

/// The losses at one point and their derivatives, none of them weighted by alpha or beta.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    pub losses: Losses,
    /// dL_num/dw, one entry a column.
    pub grad_w_num: Vec<f64>,
    /// dL_proj/dw, one entry a column.
    pub grad_w_proj: Vec<f64>,
    /// dL_DAQ/dw through the span, one entry a column.
    pub grad_w_daq: Vec<f64>,
    /// dL_DAQ/d log f.
    pub grad_log_focal: f64,
    /// dL_DAQ/d n_inf.
    pub grad_n_inf: [f64; 3],
}

/// Evaluates the losses and all their derivatives.
///
/// * `balanced`: 3n x m, at least 2 views
/// * `w`: one weight a column
/// * `log_focal`: natural logarithm of the focal length in the units of `balanced`
/// * `n_inf`: plane at infinity in the gauge of the weighted span: first camera `[I|0]`, the fourth columns of the
///   others scaled to the norm of their first three
///
/// # Errors
/// [`Error::NoDecomposition`] when the weighted matrix overflows.
///
/// # Pitfall
/// A gauge fixes the unit of `n_inf`: it cannot be carried over to cameras that are scaled otherwise.
pub fn evaluate(
    balanced: &DMatrix<f64>,
    w: &[f64],
    log_focal: f64,
    n_inf: [f64; 3],
    settings: &LossSettings,
) -> Result<Evaluation, Error> {
    debug_assert_eq!(balanced.ncols(), w.len());
    let spectrum = Spectrum::of(balanced, w)?;
    let RankTerms { num, proj, grad_w_num, grad_w_proj } = RankTerms::of(&spectrum, w, settings);
    let cameras = gauge::CanonicalCameras::of(spectrum.span());
    let daq = daq::residual(&cameras, log_focal, &Vector3::from(n_inf));
    let grad_span = cameras.pull_back(&daq.grad_rotational, &daq.grad_translational);
    let grad_w_daq = spectrum.pull_back_span(&grad_span, w);
    Ok(Evaluation {
        losses: Losses { num, proj, daq: daq.value },
        grad_w_num,
        grad_w_proj,
        grad_w_daq,
        grad_log_focal: daq.grad_log_focal,
        grad_n_inf: daq.grad_n_inf.into(),
    })
}

/// The two terms that know of no calibration, and their derivatives, one entry a column.
#[derive(Debug, Clone, PartialEq)]
pub struct RankTerms {
    pub num: f64,
    pub proj: f64,
    pub grad_w_num: Vec<f64>,
    pub grad_w_proj: Vec<f64>,
}

impl RankTerms {
    fn of(spectrum: &Spectrum, w: &[f64], settings: &LossSettings) -> Self {
        let (num, grad_w_num) = inlier_count(w, settings);
        let (proj, grad_w_proj) = spectrum.tail_sum(w);
        Self { num, proj, grad_w_num, grad_w_proj }
    }
}

/// L_num and L_proj alone, for points whose coordinates no calibration is known to fit.
///
/// * `columns`: 3n x m, each of comparable length, for L_proj is in their unit
/// * `w`: one weight a column
///
/// # Errors
/// [`Error::NoDecomposition`] when the weighted matrix overflows.
pub fn rank_terms(columns: &DMatrix<f64>, w: &[f64], settings: &LossSettings) -> Result<RankTerms, Error> {
    debug_assert_eq!(columns.ncols(), w.len());
    Ok(RankTerms::of(&Spectrum::of(columns, w)?, w, settings))
}

/// The sum of the singular values past the fourth of a matrix as it is.
///
/// # Errors
/// [`Error::NoDecomposition`] when its scatter matrix overflows.
pub fn tail_sum(matrix: &DMatrix<f64>) -> Result<f64, Error> {
    let w = vec![1.0; matrix.ncols()];
    Ok(Spectrum::of(matrix, &w)?.tail_sum(&w).0)
}

/// L_num and its derivative `-κ s_j (1 - s_j) L_num`.
fn inlier_count(w: &[f64], settings: &LossSettings) -> (f64, Vec<f64>) {
    let soft: Vec<f64> = w.iter().map(|w| 1.0 / (1.0 + (-settings.kappa * (w - 0.5)).exp())).collect();
    let value = (settings.min_inliers - soft.iter().sum::<f64>()).min(MAX_EXPONENT).exp();
    let gradient = soft.iter().map(|s| -settings.kappa * s * (1.0 - s) * value).collect();
    (value, gradient)
}
