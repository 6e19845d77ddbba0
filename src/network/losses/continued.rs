//! The paper's losses as the continuation optimises them: each is the paper's own at one end of its schedule.

use nalgebra::{DMatrix, Vector3};

use super::spectrum::Spectrum;
use super::{Error, MAX_EXPONENT, daq, gauge};
use crate::domain::Losses;

/// What L_proj is at a point of the continuation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RankTerm {
    /// `Σ_{k>=5} σ_k + leading · Σ_{k<=4} σ_k` of `M diag(w)`: with 1 the nuclear norm, convex in w, with 0 the paper's
    /// L_proj.
    SingularValues { leading: f64 },
    /// `Σ_{k>=5} σ_k²`, the squared distance to the nearest matrix of rank 4 (paper, eq. 8).
    Energy,
}

/// The losses at one point and their derivatives, none of them weighted. L_DAQ has none by the weights, but moves the
/// plane at infinity through layers that the weights share.
#[derive(Debug, Clone, PartialEq)]
pub struct ContinuedEvaluation {
    pub losses: Losses,
    /// dL_num/dw, the same for every column.
    pub grad_w_num: f64,
    /// dL_proj/dw, one entry a column.
    pub grad_w_proj: Vec<f64>,
    /// dL_DAQ/d log f.
    pub grad_log_focal: f64,
    /// dL_DAQ/d n_inf.
    pub grad_n_inf: [f64; 3],
}

/// Evaluates the continued losses and their derivatives; the arguments are those of [`super::evaluate`].
///
/// * `min_inliers`: the paper's `t` at this point
///
/// # Errors
/// [`Error::NoDecomposition`] when the weighted matrix overflows.
pub fn evaluate_continued(
    balanced: &DMatrix<f64>,
    w: &[f64],
    log_focal: f64,
    n_inf: [f64; 3],
    min_inliers: f64,
    term: RankTerm,
) -> Result<ContinuedEvaluation, Error> {
    debug_assert_eq!(balanced.ncols(), w.len());
    let spectrum = Spectrum::of(balanced, w)?;
    let (num, grad_w_num) = soft_count(w, min_inliers);
    let (proj, grad_w_proj) = match term {
        RankTerm::SingularValues { leading } => {
            let (tail, mut gradient) = spectrum.tail_sum(w);
            let (leading_sum, of_leading) = spectrum.leading_sum(w);
            gradient.iter_mut().zip(of_leading).for_each(|(entry, of_leading)| *entry += leading * of_leading);
            (tail + leading * leading_sum, gradient)
        }
        RankTerm::Energy => spectrum.tail_energy(w),
    };
    let cameras = gauge::CanonicalCameras::of(spectrum.span());
    let daq = daq::residual(&cameras, log_focal, &Vector3::from(n_inf));
    Ok(ContinuedEvaluation {
        losses: Losses { num, proj, daq: daq.value },
        grad_w_num,
        grad_w_proj,
        grad_log_focal: daq.grad_log_focal,
        grad_n_inf: daq.grad_n_inf.into(),
    })
}

/// L_num, `exp(t - N)` up to `N = Σ_j w_j = t` and its tangent `1 + t - N` beyond, and its derivative by every weight.
fn soft_count(w: &[f64], min_inliers: f64) -> (f64, f64) {
    let missing = min_inliers - w.iter().sum::<f64>();
    if missing > 0.0 {
        let value = missing.min(MAX_EXPONENT).exp();
        (value, -value)
    } else {
        (1.0 + missing, -1.0)
    }
}
