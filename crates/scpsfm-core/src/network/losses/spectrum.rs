//! Eigen-decomposition of the weighted scatter matrix, and derivatives with respect to the weights through it.

use faer::{Mat, Side};
use nalgebra::{DMatrix, MatrixXx4};

use super::Error;
use crate::geometry::factorization::RANK;

/// Added under the square root of an eigenvalue: keeps the derivative of a vanishing singular value finite. Columns
/// have unit norm, so this is far below any noise.
const EIGENVALUE_FLOOR: f64 = 1e-10;
/// Least gap between an eigenvalue of the span and one of the tail, as a share of the fourth: where the two touch, the
/// span has no derivative, and a bounded one is the better guess.
const RELATIVE_GAP_FLOOR: f64 = 1e-3;
/// The same where even the fourth eigenvalue vanishes.
const ABSOLUTE_GAP_FLOOR: f64 = 1e-12;

/// What L_proj is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RankTerm {
    /// `Σ_{k>=5} σ_k + leading · Σ_{k<=4} σ_k` of `M diag(w)`: with 1 the nuclear norm, convex in w, with 0 the paper's
    /// L_proj (eq. 11).
    SingularValues { leading: f64 },
    /// `Σ_{k>=5} σ_k²`, the squared distance to the nearest matrix of rank 4 (paper, eq. 8).
    Energy,
}

impl RankTerm {
    /// The paper's own.
    pub const TAIL: Self = Self::SingularValues { leading: 0.0 };
}

/// `M diag(w)² Mᵀ = U Λ Uᵀ`, eigenvalues in descending order, with the columns of M in the basis U.
pub struct Spectrum {
    values: Vec<f64>,
    vectors: DMatrix<f64>,
    /// `Uᵀ M`, 3n x m.
    coordinates: DMatrix<f64>,
}

impl Spectrum {
    /// Decomposes `M diag(w)` for the 3n x m matrix `M`.
    ///
    /// faer takes a quarter of nalgebra's time at 300 x 300.
    ///
    /// # Errors
    /// [`Error::NoDecomposition`] when the scatter matrix is not finite.
    pub fn of(balanced: &DMatrix<f64>, w: &[f64]) -> Result<Self, Error> {
        let rows = balanced.nrows();
        let mut weighted = balanced.clone();
        for (mut column, &w) in weighted.column_iter_mut().zip(w) {
            column *= w;
        }
        let scatter = &weighted * weighted.transpose();
        if scatter.iter().any(|entry| !entry.is_finite()) {
            return Err(Error::NoDecomposition { rows });
        }
        // The decomposition is of the matrix at unit scale: it does not converge on subnormal numbers.
        let largest = scatter.amax();
        let scale = if largest > f64::MIN_POSITIVE { largest } else { f64::INFINITY };
        let scatter = Mat::from_fn(rows, rows, |row, column| scatter[(row, column)] / scale);
        let eigen = scatter.self_adjoint_eigen(Side::Lower).map_err(|_| Error::NoDecomposition { rows })?;
        let (ascending, vectors) = (eigen.S().column_vector(), eigen.U());
        let values = (0..rows).map(|k| largest * ascending[rows - 1 - k].max(0.0)).collect();
        let vectors = DMatrix::from_fn(rows, rows, |row, k| vectors[(row, rows - 1 - k)]);
        // Not `tr_mul`: nalgebra takes that one by scalar products, three and a half times as long.
        let coordinates = vectors.transpose() * balanced;
        Ok(Self { values, vectors, coordinates })
    }

    /// The first four eigenvectors, 3n x 4.
    pub fn span(&self) -> MatrixXx4<f64> {
        self.vectors.fixed_columns::<RANK>(0).into_owned()
    }

    /// L_proj and its derivative by each weight: `w_j Σ_k f_k (u_kᵀ m_j)²`, where f_k is `1 / σ_k` of a singular value
    /// that counts once, and 2 of one that counts squared.
    pub fn rank_term(&self, term: RankTerm, w: &[f64]) -> (f64, Vec<f64>) {
        let sigma = |value: &f64| (value + EIGENVALUE_FLOOR).sqrt();
        let (value, factors): (f64, Vec<f64>) = match term {
            RankTerm::SingularValues { leading } => {
                let share = |k: usize| if k < RANK { leading } else { 1.0 };
                let shared = self.values.iter().enumerate().map(|(k, value)| (share(k), sigma(value)));
                let value = shared.clone().map(|(share, sigma)| share * sigma).sum();
                (value, shared.map(|(share, sigma)| share / sigma).collect())
            }
            RankTerm::Energy => {
                let factor = |k: usize| if k < RANK { 0.0 } else { 2.0 };
                (self.values[RANK..].iter().sum(), (0..self.values.len()).map(factor).collect())
            }
        };
        let gradient = self.coordinates.column_iter().zip(w).map(|(column, w)| {
            w * column.iter().zip(&factors).map(|(coordinate, factor)| factor * coordinate.powi(2)).sum::<f64>()
        });
        (value, gradient.collect())
    }

    /// Derivative with respect to the weights of a function of the span whose derivative with respect to
    /// [`Self::span`] is `grad_span` (3n x 4).
    ///
    /// First-order perturbation `dZ = U_t [(U_tᵀ dG U_4) / (λ_i - λ_k)]` of the subspace: with
    /// `C = (U_tᵀ dL/dZ) / (λ_i - λ_k)`, `dL/dw_j = 2 w_j (U_tᵀ m_j)ᵀ C (U_4ᵀ m_j)`. Rotations within the span, where
    /// gaps may vanish, do not enter: the function must not depend on the basis.
    pub fn pull_back_span(&self, grad_span: &MatrixXx4<f64>, w: &[f64]) -> Vec<f64> {
        let tail = self.values.len() - RANK;
        let floor = RELATIVE_GAP_FLOOR * self.values[RANK - 1] + ABSOLUTE_GAP_FLOOR;
        let mut c = self.vectors.columns(RANK, tail).tr_mul(grad_span);
        for (k, mut row) in c.row_iter_mut().enumerate() {
            for (entry, value) in row.iter_mut().zip(&self.values) {
                *entry /= (value - self.values[RANK + k]).max(floor);
            }
        }
        let moved = c * self.coordinates.rows(0, RANK);
        let columns = moved.column_iter().zip(self.coordinates.column_iter()).zip(w);
        columns.map(|((moved, column), w)| 2.0 * w * moved.dot(&column.rows(RANK, tail))).collect()
    }
}
