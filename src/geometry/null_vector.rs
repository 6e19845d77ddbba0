//! The direction that a small system of equations leaves nearly free.

use nalgebra::allocator::Allocator;
use nalgebra::{Const, DefaultAllocator, DimDiff, DimSub, Matrix4, SMatrix, SVector, U1, Vector2, Vector4};

/// What is added to the diagonal, as a share of the trace: it moves no eigenvector, and makes the factorisation of what
/// rounding left singular or indefinite (1e-16 of the trace) safe.
pub(super) const SHIFT: f64 = 1e-14;
/// Change of the unit vector between two iterations that ends them, and iterations at most. Of two eigenvalues within a
/// twentieth of each other no caller minds which mixture of their directions it gets.
pub(super) const TOLERANCE: f64 = 1e-9;
pub(super) const MOST_ITERATIONS: usize = 60;
/// Squarings of the inverse before: each doubles what an iteration does, for the price of four, of which a dozen were
/// needed without.
pub(super) const SQUARINGS: usize = 3;

/// The unit eigenvector to the smallest eigenvalue of a symmetric positive semidefinite matrix, by inverse iteration
/// (Golub & Van Loan, section 8.2.2). A sequence of 1,000 views took a quarter less time with it than with a full
/// decomposition, which had been a third of the whole.
///
/// Returns `None` where the matrix holds what is no number, or is zero.
pub fn null_vector(matrix: &Matrix4<f64>) -> Option<Vector4<f64>> {
    let trace = matrix.trace();
    if !(trace > 0.0 && trace.is_finite()) {
        return None;
    }
    let factor = (matrix + Matrix4::from_diagonal_element(SHIFT * trace)).cholesky()?;
    let mut power = factor.inverse();
    for _ in 0..SQUARINGS {
        // Of trace 1: its squares stay in range.
        power /= power.trace();
        power *= power;
    }
    // One column at least is not orthogonal to what is sought: the longest.
    let longest = (0..4).max_by(|&a, &b| power[(a, a)].total_cmp(&power[(b, b)]))?;
    let mut vector = power.column(longest).normalize();
    for _ in 0..MOST_ITERATIONS {
        // The powers of the inverse are positive definite: the sign stays.
        let next = (power * vector).normalize();
        let moved = (next - vector).norm_squared();
        vector = next;
        if moved < TOLERANCE * TOLERANCE {
            break;
        }
    }
    vector.iter().all(|value| value.is_finite()).then_some(vector)
}

/// The same for any size, and down to the last bits, by a full decomposition.
pub fn smallest_eigenvector<const N: usize>(matrix: &SMatrix<f64, N, N>) -> Option<SVector<f64, N>>
where
    Const<N>: DimSub<U1>,
    DefaultAllocator: Allocator<DimDiff<Const<N>, U1>>,
{
    // Before the decomposition, which would not end on what is no number.
    let trace = matrix.trace();
    if trace.is_nan() || trace <= 0.0 || matrix.iter().any(|entry| !entry.is_finite()) {
        return None;
    }
    let eigen = (matrix / trace).symmetric_eigen();
    Some(eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned())
}

/// Two equations of the direct linear transform (Hartley & Zisserman, eqs. 4.3 and 7.2): by which combinations of the
/// entries of a matrix of three rows, row after row, its image of a homogeneous point misses `image`.
pub(super) fn projection_equations<const D: usize, const N: usize>(
    point: &SVector<f64, D>,
    image: &Vector2<f64>,
) -> [SVector<f64, N>; 2] {
    [0, 1].map(|axis| {
        let mut equation = SVector::<f64, N>::zeros();
        equation.fixed_rows_mut::<D>(D * axis).copy_from(point);
        equation.fixed_rows_mut::<D>(2 * D).copy_from(&(-image[axis] * point));
        equation
    })
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A matrix with these eigenvalues and random eigenvectors.
    fn with_eigenvalues(values: [f64; 4], rng: &mut ChaCha8Rng) -> Matrix4<f64> {
        let basis = Matrix4::from_fn(|_, _| rng.random_range(-1.0..1.0)).qr().q();
        basis * Matrix4::from_diagonal(&values.into()) * basis.transpose()
    }

    #[test]
    fn nothing_is_shrunk_more() {
        let cases = [
            [3.0, 2.0, 1.0, 0.0],
            [3.0, 2.0, 1.0, 1e-9],
            [1.0, 1e-6, 1e-7, 1e-8],
            [1e12, 1.0, 0.1, 0.05],
            [1.0, 1.0, 1.0, 0.9],
            [1e-20, 1e-21, 1e-22, 1e-26],
        ];
        for seed in 0..50 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for values in cases {
                let matrix = with_eigenvalues(values, &mut rng);
                let found = null_vector(&matrix).expect("positive");
                let quotient = (matrix * found).dot(&found);
                let excess = (quotient - values[3]) / (values[2] - values[3]);
                assert!(excess.abs() < 1e-3 + 1e-11 * values[0] / values[2], "seed {seed}, {values:?}: {excess}");
                assert!((found.norm() - 1.0).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn degenerate_matrices_have_some_direction_and_no_number_has_none() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for values in [[1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [1.0; 4]] {
            let matrix = with_eigenvalues(values, &mut rng);
            let found = null_vector(&matrix).expect("a direction");
            assert!((matrix * found).dot(&found) < values[3] + 1e-9, "{values:?}");
        }
        assert_eq!(null_vector(&Matrix4::zeros()), None);
        assert_eq!(null_vector(&Matrix4::from_element(f64::NAN)), None);
        assert_eq!(null_vector(&Matrix4::from_diagonal_element(f64::INFINITY)), None);
    }
}
