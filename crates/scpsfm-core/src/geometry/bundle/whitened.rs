//! The reduced normal equations of the views in coordinates in which they are as well conditioned as views can be.
//!
//! A turn and a shift of a view move its observations alike, the more so the farther it is from the origin, and units
//! decide how the two compare: neither says anything of the scene, and both make eigenvalues small. Here the block of
//! every view is the identity, whatever the unit of the poses is, and the directions of a similarity, which no
//! observation sees, have unit information. What is then small is what the observations hardly determine.

use faer::{MatRef, Side};
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector, Vector3};

use super::metric::{POSE, Pose};

/// Dimensions of a similarity: directions of the poses that no observation sees.
const GAUGE: usize = 7;
/// Eigenvalue, relative to the largest, at which rounding of the normal equations hides what the observations say:
/// 1e-16 times the square root of the number of terms summed, with a margin.
const ROUNDING: f64 = 1e-13;
/// Part of a direction of the similarity that must be left after the others are taken off for it to be another: of
/// views with one centre, scale is a translation.
const ANOTHER_DIRECTION: f64 = 1e-7;

/// Moves the world's origin into the middle of the cameras: far from it, what tells a turn of a view from a shift of it
/// drowns in rounding.
pub(super) fn centre(poses: &mut [Pose], points: &mut [Vector3<f64>]) {
    let middle = middle(poses);
    poses.iter_mut().for_each(|pose| pose.translation += pose.rotation * middle);
    points.iter_mut().for_each(|point| *point -= middle);
}

/// Mean of the camera centres.
fn middle(poses: &[Pose]) -> Vector3<f64> {
    -poses.iter().map(|pose| pose.rotation.tr_mul(&pose.translation)).sum::<Vector3<f64>>() / poses.len().max(1) as f64
}

/// Coordinates of one view in which its block of the normal equations is the identity.
struct Basis<const C: usize> {
    /// Columns are the new directions in the old unknowns; zero where the view's observations do not see one at all.
    directions: SMatrix<f64, C, C>,
    /// Rows give the new coordinates of old unknowns.
    coordinates: SMatrix<f64, C, C>,
    /// Share of each old unknown in the directions that the view's observations do not see.
    unseen: [f64; C],
}

impl<const C: usize> Basis<C> {
    /// `None` where a decomposition fails.
    fn new(block: &SMatrix<f64, C, C>) -> Option<Self> {
        let unit = SVector::<f64, C>::from_fn(|k, _| match block[(k, k)] > 0.0 {
            true => block[(k, k)].sqrt(),
            false => 1.0,
        });
        let scaled = DMatrix::from_fn(C, C, |row, column| block[(row, column)] / (unit[row] * unit[column]));
        let (values, vectors) = eigen(&scaled)?;
        let mut basis = Self { directions: SMatrix::zeros(), coordinates: SMatrix::zeros(), unseen: [0.0; C] };
        for (k, value) in values.iter().enumerate() {
            let is_seen = *value > ROUNDING * values[C - 1];
            for row in 0..C {
                let entry = vectors[(row, k)];
                if is_seen {
                    basis.directions[(row, k)] = entry / (unit[row] * value.sqrt());
                    basis.coordinates[(k, row)] = entry * unit[row] * value.sqrt();
                } else {
                    basis.unseen[row] += entry * entry;
                }
            }
        }
        Some(basis)
    }
}

/// Eigenvalues of a symmetric matrix that is not empty, in ascending order, and their vectors; `None` where it holds
/// what is no number.
fn eigen(matrix: &DMatrix<f64>) -> Option<(Vec<f64>, DMatrix<f64>)> {
    if matrix.iter().any(|value| !value.is_finite()) {
        return None;
    }
    let n = matrix.nrows();
    let eigen = MatRef::from_column_major_slice(matrix.as_slice(), n, n).self_adjoint_eigen(Side::Lower).ok()?;
    let values = (0..n).map(|k| eigen.S()[k]).collect();
    Some((values, DMatrix::from_fn(n, n, |row, k| eigen.U()[(row, k)])))
}

/// The information on the views, by its eigenvalues in the new coordinates.
pub(super) struct WhitenedViews<const C: usize> {
    bases: Vec<Basis<C>>,
    values: Vec<f64>,
    vectors: DMatrix<f64>,
}

impl<const C: usize> WhitenedViews<C> {
    /// * `matrix`: symmetric: other unknowns, `first` of them, then `C` a view, of which those of its pose come first
    ///
    /// `None` without views, or where the matrix holds what is no number.
    pub fn new(matrix: &DMatrix<f64>, first: usize, poses: &[Pose]) -> Option<Self> {
        let n = C * poses.len();
        let block = |a: usize, b: usize| matrix.fixed_view::<C, C>(first + C * a, first + C * b).into_owned();
        if n == 0 || matrix.iter().any(|value| !value.is_finite()) {
            return None;
        }
        let bases = (0..poses.len()).map(|view| Basis::new(&block(view, view))).collect::<Option<Vec<_>>>()?;
        let mut whitened = DMatrix::identity(n, n);
        for a in 0..poses.len() {
            for b in 0..a {
                let pair = bases[a].directions.tr_mul(&block(a, b)) * bases[b].directions;
                whitened.fixed_view_mut::<C, C>(C * a, C * b).copy_from(&pair);
                whitened.fixed_view_mut::<C, C>(C * b, C * a).copy_from(&pair.transpose());
            }
        }
        for direction in similarity(poses, &bases) {
            whitened.ger(1.0, &direction, &direction, 1.0);
        }
        let (values, vectors) = eigen(&whitened)?;
        Some(Self { bases, values, vectors })
    }

    /// A linear function of the views' unknowns in the new coordinates.
    ///
    /// * `of_view`: its gradient by the unknowns of a view
    pub fn function(&self, of_view: impl Fn(usize) -> SVector<f64, C>) -> DVector<f64> {
        let mut whitened = DVector::zeros(C * self.bases.len());
        for (view, basis) in self.bases.iter().enumerate() {
            whitened.fixed_rows_mut::<C>(C * view).copy_from(&basis.directions.tr_mul(&of_view(view)));
        }
        whitened
    }

    /// Share of an unknown of a view in the directions that the view's observations do not see.
    pub fn unseen(&self, view: usize, unknown: usize) -> f64 {
        self.bases[view].unseen[unknown]
    }

    /// Directions with the information on each; `None` where rounding hides it, and that is little.
    pub fn directions(&self) -> impl Iterator<Item = (Option<f64>, nalgebra::DVectorView<'_, f64>)> {
        let largest = self.values.last().copied().unwrap_or(0.0);
        let known = move |value: &f64| Some(*value).filter(|value| *value > ROUNDING * largest);
        self.values.iter().map(known).zip(self.vectors.column_iter())
    }
}

/// Orthonormal directions in which all views move when the world turns, moves or grows.
fn similarity<const C: usize>(poses: &[Pose], bases: &[Basis<C>]) -> Vec<DVector<f64>> {
    let middle = middle(poses);
    let mut found: Vec<DVector<f64>> = Vec::with_capacity(GAUGE);
    for k in 0..GAUGE {
        let mut direction = DVector::zeros(C * poses.len());
        for (view, (pose, basis)) in poses.iter().zip(bases).enumerate() {
            let unit = Matrix3::identity().column(k % 3).into_owned();
            let (turned, translation) = match k {
                0..3 => (Vector3::zeros(), pose.rotation * unit),
                // The world turns about the middle of the views.
                3..6 => (pose.rotation * unit, pose.rotation * middle.cross(&unit)),
                // About the origin: exact, however near to each other the views are.
                _ => (Vector3::zeros(), pose.translation),
            };
            let mut step = SVector::<f64, C>::zeros();
            step.fixed_rows_mut::<3>(0).copy_from(&turned);
            step.fixed_rows_mut::<3>(POSE / 2).copy_from(&translation);
            direction.fixed_rows_mut::<C>(C * view).copy_from(&(basis.coordinates * step));
        }
        let length = direction.norm();
        // Twice: what the first pass leaves of the others is rounding.
        for _ in 0..2 {
            for other in &found {
                let along = other.dot(&direction);
                direction.axpy(-along, other, 1.0);
            }
        }
        let left = direction.norm();
        if left > ANOTHER_DIRECTION * length && left.is_finite() {
            found.push(direction / left);
        }
    }
    found
}
