//! Dense reduced systems: the product by which many points are eliminated at a time, and the factorisation.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::prelude::ReborrowMut;
use faer::{Accum, MatMut, MatRef, Par};

/// Share of all pairs of point and camera that must be observed for the points to be eliminated by panels, which
/// calculate with zeros for the others: a product of panels takes a quarter of the time of its pairs or less, whose
/// number falls with the square of the share. A step of 37 views that see .53 of 390 points takes 4.9 ms by panels and
/// 8.0 by pairs.
pub(super) const PANEL_SHARE: f64 = 0.5;
/// Columns of a panel: enough for the product to run at full speed, few enough for a second-level cache.
pub(super) const PANEL_COLUMNS: usize = 256;

/// Subtracts the product of a panel with its transpose from the lower triangle of a square matrix.
///
/// * `panel`, `matrix`: column-major, of so many rows
pub(super) fn subtract_panel(panel: &[f64], rows: usize, matrix: &mut [f64]) {
    let mut block = MatMut::from_column_major_slice_mut(matrix, rows, rows);
    for columns in panel.chunks(PANEL_COLUMNS * rows.max(1)) {
        let columns = MatRef::from_column_major_slice(columns, rows, columns.len() / rows.max(1));
        triangular::matmul(
            block.rb_mut(),
            BlockStructure::TriangularLower,
            Accum::Add,
            columns,
            BlockStructure::Rectangular,
            columns.transpose(),
            BlockStructure::Rectangular,
            -1.0,
            Par::Seq,
        );
    }
}

/// Solves `A x = b` in place of `b`; `false` when `A` is not positive definite.
///
/// * `matrix`: `A`, column-major, as many rows as `b` has, lower triangle; overwritten by its factor
/// * `vector`: `b`
pub(super) fn solve(matrix: &mut [f64], vector: &mut [f64]) -> bool {
    let n = vector.len();
    // One column: its allocation takes nothing beside the factorisation.
    let scratch = llt::factor::cholesky_in_place_scratch::<f64>(n, Par::Seq, Default::default());
    let mut memory = MemBuffer::new(scratch);
    let stack = MemStack::new(&mut memory);
    let whole = MatMut::from_column_major_slice_mut(matrix, n, n);
    if llt::factor::cholesky_in_place(whole, Default::default(), Par::Seq, stack, Default::default()).is_err() {
        return false;
    }
    llt::solve::solve_in_place(
        MatRef::from_column_major_slice(matrix, n, n),
        MatMut::from_column_major_slice_mut(vector, n, 1),
        Par::Seq,
        stack,
    );
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn solves_small_and_large_systems() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for n in [0, 1, 3, 4, 5, 61, 97, 240] {
            let root = DMatrix::from_fn(n, n + 2, |_, _| rng.random_range(-1.0..1.0));
            let matrix = &root * root.transpose();
            let expected = DVector::from_fn(n, |_, _| rng.random_range(-1.0..1.0));
            let mut vector = (&matrix * &expected).as_slice().to_vec();
            let mut lower = matrix.lower_triangle();
            assert!(solve(lower.as_mut_slice(), &mut vector), "n {n}");
            let error = (DVector::from_vec(vector) - expected).norm();
            assert!(error < 1e-6, "n {n}: {error}");
        }
    }

    #[test]
    fn refuses_what_is_not_positive_definite() {
        for n in [3, 97] {
            for wrong in [-1.0, f64::NAN] {
                let mut matrix = DMatrix::<f64>::identity(n, n);
                matrix[(n / 2, n / 2)] = wrong;
                assert!(!solve(matrix.as_mut_slice(), &mut vec![1.0; n]), "n {n}, {wrong}");
            }
        }
    }
}
