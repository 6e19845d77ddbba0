//! The linear algebra of the ridge regressions.

use super::rows::{affine, row};
use crate::network::lanes::dot;

/// `(Y diag(shares) Yᵀ + ridge I)⁻¹`, row by row; of what rounding has made singular, zeros, which predict nothing.
#[inline(always)]
pub fn inverse_scatter(columns: &[f32], shares: &[f32], ridge: f32) -> Vec<f32> {
    let tracks = shares.len();
    let rows = columns.len() / tracks;
    let mut scatter = vec![0.0f64; rows * rows];
    let mut weighted = vec![0.0; tracks];
    for a in 0..rows {
        for (weighted, (value, share)) in weighted.iter_mut().zip(row(columns, tracks, a).iter().zip(shares)) {
            *weighted = value * share;
        }
        for b in 0..=a {
            let sum = f64::from(dot(&weighted, row(columns, tracks, b)));
            (scatter[a * rows + b], scatter[b * rows + a]) = (sum, sum);
        }
        scatter[a * rows + a] += f64::from(ridge);
    }
    match invert(&mut scatter, rows) {
        true => scatter.iter().map(|&value| value as f32).collect(),
        false => vec![0.0; rows * rows],
    }
}

/// Inverts a symmetric positive definite matrix in place, row by row; `false` where it is not one.
///
/// Gauss-Jordan elimination, which needs no pivoting for such matrices (Higham 2002, section 14.4): every loop runs
/// along a whole row. At 30 rows it takes a sixth of the time of a factorisation whose columns are solved one by one.
#[inline(always)]
pub fn invert(matrix: &mut [f64], rows: usize) -> bool {
    let mut scaled = vec![0.0; rows];
    for k in 0..rows {
        let pivot = matrix[k * rows + k];
        // Written so that NaN fails.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return false;
        }
        for (scaled, value) in scaled.iter_mut().zip(&matrix[k * rows..(k + 1) * rows]) {
            *scaled = value / pivot;
        }
        for (_, row) in matrix.chunks_exact_mut(rows).enumerate().filter(|(i, _)| *i != k) {
            let factor = row[k];
            for (value, scaled) in row.iter_mut().zip(&scaled) {
                *value -= factor * scaled;
            }
            row[k] = -factor / pivot;
        }
        matrix[k * rows..(k + 1) * rows].copy_from_slice(&scaled);
        matrix[k * rows + k] = pivot.recip();
    }
    true
}

/// Square matrix, row by row, times columns.
#[inline(always)]
pub fn product(matrix: &[f32], columns: &[f32], tracks: usize) -> Vec<f32> {
    let rows: Vec<&[f32]> = columns.chunks_exact(tracks).collect();
    affine(matrix, &vec![0.0; rows.len()], &rows, tracks)
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn inverses_are_those_of_another_library() {
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (rows, tracks) = (3 * rng.random_range(1..=20), rng.random_range(1..=200));
            let columns: Vec<f32> = (0..rows * tracks).map(|_| rng.random_range(-5.0..5.0)).collect();
            let shares: Vec<f32> = (0..tracks).map(|_| rng.random_range(0.0..1.0)).collect();
            let found = inverse_scatter(&columns, &shares, 0.01);
            let matrix = DMatrix::from_row_slice(rows, tracks, &columns).map(f64::from);
            let weights =
                DMatrix::from_diagonal(&shares.iter().map(|&share| f64::from(share)).collect::<Vec<_>>().into());
            let scatter = &matrix * weights * matrix.transpose() + 0.01f32 as f64 * DMatrix::identity(rows, rows);
            let expected = scatter.cholesky().expect("positive definite").inverse();
            let size = expected.amax();
            let apart = DMatrix::from_row_slice(rows, rows, &found).map(f64::from) - expected;
            assert!(apart.amax() < 1e-3 * size, "seed {seed}: {} of {size}", apart.amax());
        }
    }

    #[test]
    fn what_has_no_inverse_predicts_nothing() {
        assert_eq!(inverse_scatter(&[1.0, 2.0, 3.0], &[0.0], 0.0), [0.0; 9]);
        assert_eq!(inverse_scatter(&[f32::NAN, 2.0, 3.0], &[1.0], 1.0), [0.0; 9]);
    }
}
