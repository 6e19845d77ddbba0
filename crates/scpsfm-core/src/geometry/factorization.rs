//! Factorisation of measurement matrices: dominant subspaces, affine and projective.

use nalgebra::{DMatrix, DVector};

use super::measurement::CompleteBlock;
use super::{Camera, Point};

/// Rank of a noise-free measurement matrix with right depths.
pub const RANK: usize = 4;

/// Orthonormal basis of the dominant `rank`-dimensional subspace of the column space, d x rank, by the
/// eigen-decomposition of `M M^T` (d x d; d is far smaller than the number of columns here).
///
/// Returns `None` when the decomposition does not converge or `rank` exceeds d: not to be expected of finite input.
pub fn dominant_subspace(matrix: &DMatrix<f64>, rank: usize) -> Option<DMatrix<f64>> {
    dominant_eigenvectors(&(matrix * matrix.transpose()), rank)
}

/// Orthonormal eigenvectors of the `rank` largest eigenvalues of a symmetric matrix (d x d), d x rank, largest first;
/// only the lower triangle is looked at.
///
/// Returns `None` where [`dominant_subspace`] does.
pub fn dominant_eigenvectors(gram: &DMatrix<f64>, rank: usize) -> Option<DMatrix<f64>> {
    let order = gram.nrows();
    if rank > order || gram.iter().any(|entry| !entry.is_finite()) {
        return None;
    }
    let gram = faer::MatRef::from_column_major_slice(gram.as_slice(), order, order);
    let eigen = gram.self_adjoint_eigen(faer::Side::Lower).ok()?;
    // faer sorts eigenvalues in nondecreasing order.
    let vectors = eigen.U();
    Some(DMatrix::from_fn(order, rank, |i, k| vectors[(i, order - 1 - k)]))
}

/// Sine of the angle between each column and a subspace given by an orthonormal basis (d x rank); 1 for zero columns.
pub fn subspace_residuals(matrix: &DMatrix<f64>, basis: &DMatrix<f64>) -> Vec<f64> {
    let coefficients = basis.tr_mul(matrix);
    matrix
        .column_iter()
        .zip(coefficients.column_iter())
        .map(|(column, inside)| {
            let energy = column.norm_squared();
            if energy > f64::MIN_POSITIVE { (1.0 - inside.norm_squared() / energy).max(0.0).sqrt() } else { 1.0 }
        })
        .collect()
}

/// The 3x4 cameras stacked in a 3n x 4 basis of the measurement matrix's column space.
pub fn cameras_of(basis: &DMatrix<f64>) -> Vec<Camera> {
    (0..basis.nrows() / 3).map(|view| Camera::from_fn(|row, column| basis[(3 * view + row, column)])).collect()
}

/// Affine factorisation (Tomasi & Kanade 1992) of some tracks of a block: cameras with last row (0, 0, 0, 1) and points
/// of unit covariance. A first approximation wherever depths vary moderately.
///
/// Returns `None` for fewer than 4 tracks, or when the decomposition fails.
pub fn affine(block: &CompleteBlock, tracks: &[usize]) -> Option<(Vec<Camera>, Vec<Point>)> {
    if tracks.len() < 4 {
        return None;
    }
    let (views, count) = (block.views(), tracks.len() as f64);
    let stacked = DMatrix::from_fn(2 * views, tracks.len(), |row, k| block.point(row / 2, tracks[k])[row % 2]);
    let centroid = DVector::from_fn(2 * views, |row, _| stacked.row(row).sum() / count);
    let mut centred = stacked;
    for mut column in centred.column_iter_mut() {
        column -= &centroid;
    }
    let basis = dominant_subspace(&centred, 3)?;
    let coordinates = basis.tr_mul(&centred);
    let scales: Vec<f64> =
        (0..3).map(|k| (coordinates.row(k).norm_squared() / count).sqrt().max(f64::MIN_POSITIVE)).collect();
    let cameras = (0..views)
        .map(|view| {
            Camera::from_fn(|row, column| match (row, column) {
                (2, 3) => 1.0,
                (2, _) => 0.0,
                (_, 3) => centroid[2 * view + row],
                _ => basis[(2 * view + row, column)] * scales[column],
            })
        })
        .collect();
    let points = coordinates
        .column_iter()
        .map(|point| Point::new(point[0] / scales[0], point[1] / scales[1], point[2] / scales[2], 1.0))
        .collect();
    Some((cameras, points))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Vector2, Vector4};

    #[test]
    fn finds_the_subspace_that_columns_were_drawn_from() {
        let basis = DMatrix::from_fn(12, 4, |i, k| ((i * 7 + k * 13) as f64).sin());
        let inside = &basis * DMatrix::from_fn(4, 20, |k, j| ((k + 1) as f64 * (j as f64 + 0.5)).cos());
        let found = dominant_subspace(&inside, 4).expect("finite");
        assert!(subspace_residuals(&inside, &found).iter().all(|&residual| residual < 1e-6));
        let outside = DMatrix::from_fn(12, 1, |i, _| if i == 3 { 1.0 } else { 0.0 });
        assert!(subspace_residuals(&outside, &found)[0] > 1e-3);
    }

    #[test]
    fn hostile_matrices_give_none() {
        assert!(dominant_subspace(&DMatrix::from_element(6, 3, f64::NAN), 4).is_none());
        assert!(dominant_subspace(&DMatrix::from_element(3, 3, 1.0), 4).is_none());
    }

    #[test]
    fn affine_views_are_factorised_exactly() {
        let truth: Vec<Camera> = (0..4)
            .map(|view| {
                let angle = 0.3 * view as f64;
                Camera::new(
                    angle.cos(),
                    0.0,
                    angle.sin(),
                    0.1 * view as f64,
                    0.2 * angle,
                    1.0,
                    0.0,
                    0.3,
                    0.0,
                    0.0,
                    0.0,
                    1.0,
                )
            })
            .collect();
        let world: Vec<Vector4<f64>> = (0..9)
            .map(|j| Vector4::new((j as f64).sin(), (1.7 * j as f64).cos(), (0.6 * j as f64).sin(), 1.0))
            .collect();
        let images: Vec<Vector2<f64>> =
            world.iter().flat_map(|x| truth.iter().map(|p| (p * x).xy()).collect::<Vec<_>>()).collect();
        let block = CompleteBlock::new(4, 9, &images, None);
        let all: Vec<usize> = (0..9).collect();
        let (cameras, points) = affine(&block, &all).expect("9 tracks");
        for (track, point) in points.iter().enumerate() {
            for (view, camera) in cameras.iter().enumerate() {
                assert!(((camera * point).xy() - block.point(view, track)).norm() < 1e-10);
            }
        }
        assert!(affine(&block, &[0, 1, 2]).is_none());
    }
}
