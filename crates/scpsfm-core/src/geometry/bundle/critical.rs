//! Bundle adjustment of planes and of cameras that do not turn: models with fewer unknowns than projective cameras, to
//! be tested against them.
//!
//! A point is `(x, y, 1)`, and `(x, y, 1, w)` where it has an inverse depth `w`, in the frame of the view in which the
//! starts were taken: that keeps points at infinity apart from nothing.

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::Observation;
pub(crate) use super::engine::minimise;
use super::problem::{BundleProblem, Jacobian, Step, image, move_each, unit_norm};

/// Views of a plane, or of anything from one centre: `x ~ H (x, y, 1)`.
#[derive(Debug, Clone)]
pub struct Homographies {
    /// One a view, any scale.
    pub views: Vec<Matrix3<f64>>,
    pub points: Vec<Vector2<f64>>,
}

/// A camera that moves without turning: `x ~ (x, y, 1) + w t`.
///
/// `t` is `K` times the metric translation, and the point `K` times the metric one: every `K` explains the views alike.
#[derive(Debug, Clone)]
pub struct Translating {
    pub translations: Vec<Vector3<f64>>,
    /// `(x, y, w)`
    pub points: Vec<Vector3<f64>>,
}

/// Unknowns that no observation determines: homographies of the plane; position and scale.
pub const HOMOGRAPHIES_GAUGE: usize = 8;
pub const TRANSLATING_GAUGE: usize = 4;

impl BundleProblem<9, 2> for Homographies {
    fn counts(&self) -> (usize, usize) {
        (self.views.len(), self.points.len())
    }

    #[inline]
    fn evaluate(&self, seen: Observation) -> (Vector2<f64>, impl FnOnce() -> Jacobian<9, 2>) {
        let homography = &self.views[seen.view];
        let point = self.points[seen.point].push(1.0);
        let (image, by_seen) = image(&(homography * point));
        let jacobian = move || {
            let mut jacobian = Jacobian::<9, 2>::zeros();
            for (component, by_seen) in by_seen.iter().enumerate() {
                let by_entry = SMatrix::<f64, 9, 1>::from_fn(|k, _| by_seen[k / 3] * point[k % 3]);
                jacobian.camera.set_column(component, &by_entry);
                jacobian.point.set_column(component, &homography.tr_mul(by_seen).xy());
            }
            jacobian
        };
        (image - seen.xy, jacobian)
    }

    fn retract(&mut self, from: &Self, step: &Step<9, 2>) {
        move_each(&mut self.views, &from.views, &step.cameras, |view, step| {
            unit_norm(&(view + Matrix3::from_row_slice(step.as_slice())))
        });
        move_each(&mut self.points, &from.points, &step.points, |point, step| point + step);
    }

    fn camera_gauge(&self, camera: usize) -> SVector<f64, 9> {
        SVector::from_column_slice(self.views[camera].transpose().as_slice())
    }
}

impl BundleProblem<3, 3> for Translating {
    fn counts(&self) -> (usize, usize) {
        (self.translations.len(), self.points.len())
    }

    #[inline]
    fn evaluate(&self, seen: Observation) -> (Vector2<f64>, impl FnOnce() -> Jacobian<3, 3>) {
        let translation = &self.translations[seen.view];
        let point = &self.points[seen.point];
        let (image, by_seen) = image(&(point.xy().push(1.0) + translation * point.z));
        let jacobian = move || {
            let mut jacobian = Jacobian::<3, 3>::zeros();
            for (component, by_seen) in by_seen.iter().enumerate() {
                jacobian.camera.set_column(component, &(by_seen * point.z));
                jacobian.point.set_column(component, &by_seen.xy().push(by_seen.dot(translation)));
            }
            jacobian
        };
        (image - seen.xy, jacobian)
    }

    fn retract(&mut self, from: &Self, step: &Step<3, 3>) {
        move_each(&mut self.translations, &from.translations, &step.cameras, |translation, step| translation + step);
        move_each(&mut self.points, &from.points, &step.points, |point, step| point + step);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::super::testing::{self, NOISE};
    use super::*;

    #[test]
    fn jacobians_agree_with_finite_differences() {
        let scene = testing::scene(1, 4, 8, NOISE);
        let near = |seed: u64| 0.1 * testing::direction::<3>(seed);
        let turned = |view: u64| Rotation3::from_scaled_axis(near(view)).into_inner();
        let points: Vec<Vector2<f64>> = scene.observations[..8].iter().map(|seen| seen.xy).collect();
        testing::check_jacobian(
            &Homographies { views: (0..4).map(turned).collect(), points: points.clone() },
            &scene.observations,
        );
        let with_depths = points.iter().enumerate().map(|(j, point)| point.push(0.2 + 0.05 * j as f64)).collect();
        testing::check_jacobian(
            &Translating { translations: (0..4).map(near).collect(), points: with_depths },
            &scene.observations,
        );
    }
}
