//! The direction that a small system of equations leaves nearly free.

use nalgebra::allocator::Allocator;
use nalgebra::{Const, DefaultAllocator, DimDiff, DimSub, SMatrix, SVector, U1, Vector2};

/// The unit eigenvector to the smallest eigenvalue of a symmetric positive semidefinite matrix, down to the last bits,
/// by a full decomposition.
///
/// Returns `None` where the matrix holds what is no number, or is zero.
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
