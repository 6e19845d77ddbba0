//! What a problem has to say for it to be adjusted.

use nalgebra::{SMatrix, SVector, Vector2, Vector3};

use super::Observation;

/// Squared residual at which an observation counts as undefined (depth zero or nearly so, not a number): a million
/// image sides. It then costs just this and has no gradient, so that costs stay finite and comparable.
pub(super) const UNDEFINED_SQUARED: f64 = 1e12;

/// Derivatives of one residual, transposed: column `k` is the gradient of residual component `k`.
#[derive(Debug, Clone)]
pub(crate) struct Jacobian<const C: usize, const P: usize> {
    pub camera: SMatrix<f64, C, 2>,
    pub point: SMatrix<f64, P, 2>,
}

impl<const C: usize, const P: usize> Jacobian<C, P> {
    pub fn zeros() -> Self {
        Self { camera: SMatrix::zeros(), point: SMatrix::zeros() }
    }
}

/// A change of the unknowns in the tangent space.
#[derive(Debug, Clone)]
pub(crate) struct Step<const C: usize, const P: usize> {
    pub cameras: Vec<SVector<f64, C>>,
    pub points: Vec<SVector<f64, P>>,
}

impl<const C: usize, const P: usize> Step<C, P> {
    pub fn zeros(cameras: usize, points: usize) -> Self {
        Self { cameras: vec![SVector::zeros(); cameras], points: vec![SVector::zeros(); points] }
    }

    pub(super) fn is_finite(&self) -> bool {
        let Self { cameras, points } = self;
        cameras.iter().flatten().chain(points.iter().flatten()).all(|value| value.is_finite())
    }
}

/// A bundle adjustment: `C` unknowns a camera, `P` a point.
pub(crate) trait BundleProblem<const C: usize, const P: usize>: Clone {
    fn counts(&self) -> (usize, usize);
    /// The residual of one observation, predicted minus observed, and what calculates its Jacobian.
    fn evaluate(&self, seen: Observation) -> (Vector2<f64>, impl FnOnce() -> Jacobian<C, P>);
    /// Overwrites `self` with `from` moved by `step`; both have the same counts.
    fn retract(&mut self, from: &Self, step: &Step<C, P>);
    /// Direction in which a homogeneous camera moves without changing any residual; zero where there is none.
    fn camera_gauge(&self, _camera: usize) -> SVector<f64, C> {
        SVector::zeros()
    }
    /// The same for a homogeneous point.
    fn point_gauge(&self, _point: usize) -> SVector<f64, P> {
        SVector::zeros()
    }
}

/// Overwrites each of some unknowns by what it was, moved by its part of a step.
pub(super) fn move_each<T, S>(moved: &mut [T], from: &[T], steps: &[S], by: impl Fn(&T, &S) -> T) {
    for ((moved, from), step) in moved.iter_mut().zip(from).zip(steps) {
        *moved = by(from, step);
    }
}

/// The homogeneous quantity at unit norm; left alone where it has none.
pub(super) fn unit_norm<const R: usize, const C: usize>(homogeneous: &SMatrix<f64, R, C>) -> SMatrix<f64, R, C> {
    let norm = homogeneous.norm();
    if norm > 0.0 && norm.is_finite() { homogeneous / norm } else { *homogeneous }
}

/// Image `seen.xy / seen.z`, and the gradients of its two coordinates with respect to `seen`.
#[inline(always)]
pub(super) fn image(seen: &Vector3<f64>) -> (Vector2<f64>, [Vector3<f64>; 2]) {
    let image = Vector2::new(seen.x / seen.z, seen.y / seen.z);
    let scale = seen.z.recip();
    (image, [Vector3::new(scale, 0.0, -image.x * scale), Vector3::new(0.0, scale, -image.y * scale)])
}

/// Observations sorted by point, then camera; observations of point `j` are `starts[j]..starts[j + 1]`.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    pub observations: Vec<Observation>,
    pub starts: Vec<usize>,
}

impl Layout {
    pub fn new(observations: &[Observation], cameras: usize, points: usize) -> Self {
        let usable = observations.iter().filter(|seen| seen.is_usable(cameras, points));
        Self::sorted(usable.copied().collect(), points)
    }

    /// * `observations`: of so many points, all usable
    pub fn sorted(mut observations: Vec<Observation>, points: usize) -> Self {
        observations.sort_by_key(|seen| (seen.point, seen.view));
        let starts = (0..=points).map(|point| observations.partition_point(|seen| seen.point < point)).collect();
        Self { observations, starts }
    }
}

/// Whether a residual can be used: finite, and not at a depth of (nearly) zero.
pub(super) fn usable_squared_norm(residual: &Vector2<f64>) -> Option<f64> {
    let squared = residual.norm_squared();
    // Written so that NaN fails.
    (squared < UNDEFINED_SQUARED).then_some(squared)
}
