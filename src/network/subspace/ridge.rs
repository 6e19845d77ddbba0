//! The linear algebra of the ridge regressions.

use nalgebra::DMatrix;

use super::rows::row;
use crate::network::lanes::dot;

/// `(Y diag(shares) Yᵀ + ridge I)⁻¹`, row by row.
#[inline(always)]
pub fn inverse_scatter(columns: &[f32], shares: &[f32], ridge: f32) -> Vec<f32> {
    let tracks = shares.len();
    let rows = columns.len() / tracks;
    let mut scatter = DMatrix::<f64>::zeros(rows, rows);
    let mut weighted = vec![0.0; tracks];
    for a in 0..rows {
        for (weighted, (value, share)) in weighted.iter_mut().zip(row(columns, tracks, a).iter().zip(shares)) {
            *weighted = value * share;
        }
        for b in 0..=a {
            let sum = f64::from(dot(&weighted, row(columns, tracks, b)));
            (scatter[(a, b)], scatter[(b, a)]) = (sum, sum);
        }
        scatter[(a, a)] += f64::from(ridge);
    }
    inverse(scatter).iter().map(|&value| value as f32).collect()
}

/// Inverse of a symmetric positive definite matrix; of one that rounding has made singular, zeros, which predict
/// nothing.
pub fn inverse(scatter: DMatrix<f64>) -> DMatrix<f64> {
    let size = scatter.nrows();
    scatter.cholesky().map_or_else(|| DMatrix::zeros(size, size), |factor| factor.inverse())
}

/// Square matrix, row by row, times columns.
#[inline(always)]
pub fn product(matrix: &[f32], columns: &[f32], tracks: usize) -> Vec<f32> {
    let rows = columns.len() / tracks;
    let mut output = vec![0.0; columns.len()];
    for (output, factors) in output.chunks_exact_mut(tracks).zip(matrix.chunks_exact(rows)) {
        for (column, &factor) in columns.chunks_exact(tracks).zip(factors) {
            for (output, value) in output.iter_mut().zip(column) {
                *output += factor * value;
            }
        }
    }
    output
}
