//! The three terms of the paper's loss (its eq. 11) with exact gradients, in f64 and outside any autodiff graph.
//!
//! Pure functions of the balanced matrix, the weights and the calibration; nothing here knows of the network.
//!
//! With `A = M diag(w)` and the eigen-decomposition `A Aᵀ = U Λ Uᵀ`:
//! * L_num, `exp(t - Σ_j s(κ (w_j - 1/2)))` or another [`CountTerm`],
//! * L_proj, `Σ_{k>=5} σ_k(A)` or another [`RankTerm`],
//! * `L_DAQ = Σ_i | S_i/|S_i| - ω/|ω| |` over the views, in the cameras that `gauge.rs` reads off the span of
//!   the first four eigenvectors.

mod count;
mod daq;
mod gauge;
#[cfg(test)]
mod reference_tests;
mod spectrum;
#[cfg(test)]
mod term_tests;
#[cfg(test)]
mod tests;

use nalgebra::{DMatrix, Vector3};

use super::Error;
use crate::domain::Losses;
pub use count::CountTerm;
pub use spectrum::RankTerm;
use spectrum::Spectrum;

/// What the losses are at a point of an optimisation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Terms {
    pub count: CountTerm,
    pub rank: RankTerm,
    /// Whether L_DAQ has a derivative by the weights; its value is always the same.
    pub daq_moves_weights: bool,
}

/// The losses at one point and their derivatives, none of them weighted by alpha or beta.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    pub losses: Losses,
    /// dL_num/dw, one entry a column.
    pub grad_w_num: Vec<f64>,
    /// dL_proj/dw, one entry a column.
    pub grad_w_proj: Vec<f64>,
    /// dL_DAQ/dw through the span, one entry a column; 0 where it has none.
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
    terms: Terms,
) -> Result<Evaluation, Error> {
    debug_assert_eq!(balanced.ncols(), w.len());
    let spectrum = Spectrum::of(balanced, w)?;
    let (num, grad_w_num) = terms.count.evaluate(w);
    let (proj, grad_w_proj) = spectrum.rank_term(terms.rank, w);
    let cameras = gauge::CanonicalCameras::of(spectrum.span());
    let daq = daq::residual(&cameras, log_focal, &Vector3::from(n_inf));
    let grad_w_daq = match terms.daq_moves_weights {
        true => spectrum.pull_back_span(&cameras.pull_back(&daq.grad_rotational, &daq.grad_translational), w),
        false => vec![0.0; w.len()],
    };
    Ok(Evaluation {
        losses: Losses { num, proj, daq: daq.value },
        grad_w_num,
        grad_w_proj,
        grad_w_daq,
        grad_log_focal: daq.grad_log_focal,
        grad_n_inf: daq.grad_n_inf.into(),
    })
}

/// L_proj alone and its derivative, one entry a column.
///
/// * `columns`: 3n x m, each of comparable length, for L_proj is in their unit
/// * `w`: one weight a column
///
/// # Errors
/// [`Error::NoDecomposition`] when the weighted matrix overflows.
pub fn rank_term(columns: &DMatrix<f64>, w: &[f64], term: RankTerm) -> Result<(f64, Vec<f64>), Error> {
    debug_assert_eq!(columns.ncols(), w.len());
    Ok(Spectrum::of(columns, w)?.rank_term(term, w))
}
