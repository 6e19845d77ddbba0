//! Metric bundle adjustment: one calibration for all views, rotations, translations and Euclidean points.

use nalgebra::{Matrix3, Matrix3x4, Rotation3, SMatrix, Vector2, Vector3};

pub use super::covariance::{IntrinsicsVariance, intrinsics_variance};
use super::engine::{Jacobian, Problem, Sink, Step, minimise};
use super::{Observation, Options, Report};
use crate::domain::StopToken;

/// Unknowns of a pose (rotation vector, then translation) and of a point.
pub(super) const POSE: usize = 6;
pub(super) const POINT: usize = 3;

/// Pinhole intrinsics in normalised image units, without skew: `x = f u + px`, `y = a f v + py` for a point at
/// `(u, v, 1)` in front of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    pub focal: f64,
    /// Relative to the guessed principal point, which is the origin of normalised coordinates.
    pub principal_point: Vector2<f64>,
    /// Height of the pixels' scale over its width: 1 for square pixels.
    pub aspect: f64,
}

impl Intrinsics {
    /// Square pixels and the principal point where it was guessed.
    pub fn from_focal(focal: f64) -> Self {
        Self { focal, principal_point: Vector2::zeros(), aspect: 1.0 }
    }

    /// The calibration matrix `K`.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [px, py] = [self.principal_point.x, self.principal_point.y];
        Matrix3::new(self.focal, 0.0, px, 0.0, self.aspect * self.focal, py, 0.0, 0.0, 1.0)
    }

    /// Image of a point in camera coordinates; infinite or not a number at depth zero.
    #[inline]
    pub fn project(&self, seen: &Vector3<f64>) -> Vector2<f64> {
        let (u, v) = (seen.x / seen.z, seen.y / seen.z);
        Vector2::new(self.focal * u, self.aspect * self.focal * v) + self.principal_point
    }
}

/// Which intrinsics are free; each model contains the one before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum IntrinsicsModel {
    Fixed,
    Focal,
    FocalPrincipalPoint,
    FocalPrincipalPointAspect,
}

impl IntrinsicsModel {
    /// Number of free intrinsics.
    pub fn freedom(self) -> usize {
        match self {
            IntrinsicsModel::Fixed => 0,
            IntrinsicsModel::Focal => 1,
            IntrinsicsModel::FocalPrincipalPoint => 3,
            IntrinsicsModel::FocalPrincipalPointAspect => 4,
        }
    }

    /// What is free, in words.
    pub fn name(self) -> &'static str {
        match self {
            IntrinsicsModel::Fixed => "nothing",
            IntrinsicsModel::Focal => "focal length",
            IntrinsicsModel::FocalPrincipalPoint => "focal length and principal point",
            IntrinsicsModel::FocalPrincipalPointAspect => "focal length, principal point and aspect",
        }
    }
}

/// World to camera: `x = R X + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Pose {
    /// A world point in camera coordinates.
    #[inline]
    pub fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    /// The camera matrix `K [R|t]`.
    pub fn camera(&self, intrinsics: &Intrinsics) -> Matrix3x4<f64> {
        let mut camera = Matrix3x4::zeros();
        camera.fixed_columns_mut::<3>(0).copy_from(&self.rotation);
        camera.set_column(3, &self.translation);
        intrinsics.matrix() * camera
    }
}

/// A metric reconstruction, up to a similarity.
#[derive(Debug, Clone, PartialEq)]
pub struct Reconstruction {
    pub intrinsics: Intrinsics,
    pub poses: Vec<Pose>,
    pub points: Vec<Vector3<f64>>,
}

impl Reconstruction {
    /// Predicted minus observed image point; infinite or not a number at depth zero.
    ///
    /// # Panics
    /// When the observation's indices are out of range.
    pub fn residual(&self, seen: &Observation) -> Vector2<f64> {
        self.intrinsics.project(&self.poses[seen.camera].apply(&self.points[seen.point])) - seen.xy
    }
}

/// A reconstruction whose first `G` intrinsics are free, in the order log focal, principal point, log aspect.
///
/// Focal and aspect move by factors: they stay positive, and a variance is one of the logarithm.
#[derive(Clone)]
pub(super) struct Metric<const G: usize>(pub Reconstruction);

impl<const G: usize> Problem<G, POSE, POINT> for Metric<G> {
    fn camera_count(&self) -> usize {
        self.0.poses.len()
    }

    fn point_count(&self) -> usize {
        self.0.points.len()
    }

    #[inline]
    fn observe(&self, observation: &Observation, sink: &mut impl Sink<G, POSE, POINT>) {
        let pose = &self.0.poses[observation.camera];
        let turned = pose.rotation * self.0.points[observation.point];
        let seen = turned + pose.translation;
        let intrinsics = &self.0.intrinsics;
        sink.take(intrinsics.project(&seen) - observation.xy, || {
            let scale = seen.z.recip();
            let (u, v) = (seen.x * scale, seen.y * scale);
            let (fx, fy) = (intrinsics.focal, intrinsics.aspect * intrinsics.focal);
            // Gradients of the two image coordinates with respect to the intrinsics and to the camera coordinates.
            let by_intrinsics = [[fx * u, 1.0, 0.0, 0.0], [fy * v, 0.0, 1.0, fy * v]];
            let by_seen =
                [Vector3::new(fx * scale, 0.0, -fx * u * scale), Vector3::new(0.0, fy * scale, -fy * v * scale)];
            let mut camera = SMatrix::<f64, POSE, 2>::zeros();
            let mut point = SMatrix::<f64, POINT, 2>::zeros();
            for (component, by_seen) in by_seen.iter().enumerate() {
                camera.fixed_view_mut::<3, 1>(0, component).copy_from(&turned.cross(by_seen));
                camera.fixed_view_mut::<3, 1>(3, component).copy_from(by_seen);
                point.set_column(component, &pose.rotation.tr_mul(by_seen));
            }
            let globals = SMatrix::from_fn(|parameter, component| by_intrinsics[component][parameter]);
            Jacobian { globals, camera, point }
        });
    }

    fn retract(&mut self, from: &Self, step: &Step<G, POSE, POINT>) {
        let free = |parameter: usize| if parameter < G { step.globals[parameter] } else { 0.0 };
        let intrinsics = &from.0.intrinsics;
        self.0.intrinsics = Intrinsics {
            focal: intrinsics.focal * free(0).exp(),
            principal_point: intrinsics.principal_point + Vector2::new(free(1), free(2)),
            aspect: intrinsics.aspect * free(3).exp(),
        };
        for ((pose, from), step) in self.0.poses.iter_mut().zip(&from.0.poses).zip(&step.cameras) {
            let turn = Rotation3::from_scaled_axis(step.fixed_rows::<3>(0).into_owned());
            pose.rotation = turn * from.rotation;
            pose.translation = from.translation + step.fixed_rows::<3>(3);
        }
        for ((point, from), step) in self.0.points.iter_mut().zip(&from.0.points).zip(&step.points) {
            *point = from + step;
        }
    }
}

/// Minimises the reprojection error over poses, points and the free intrinsics.
///
/// # Pitfall
/// Points may pass behind a camera on the way: residuals know no cheirality, so check it on the result.
pub fn adjust(
    reconstruction: &mut Reconstruction,
    observations: &[Observation],
    model: IntrinsicsModel,
    options: &Options,
    stop: &StopToken,
) -> Report {
    match model {
        IntrinsicsModel::Fixed => adjust_free::<0>(reconstruction, observations, options, stop),
        IntrinsicsModel::Focal => adjust_free::<1>(reconstruction, observations, options, stop),
        IntrinsicsModel::FocalPrincipalPoint => adjust_free::<3>(reconstruction, observations, options, stop),
        IntrinsicsModel::FocalPrincipalPointAspect => adjust_free::<4>(reconstruction, observations, options, stop),
    }
}

fn adjust_free<const G: usize>(
    reconstruction: &mut Reconstruction,
    observations: &[Observation],
    options: &Options,
    stop: &StopToken,
) -> Report {
    let mut problem = Metric::<G>(reconstruction.clone());
    let report = minimise(&mut problem, observations, options, stop);
    *reconstruction = problem.0;
    report
}

#[cfg(test)]
mod tests {
    use super::super::testing::{self, NOISE, TestScene};
    use super::*;

    fn truth(scene: &TestScene) -> Reconstruction {
        Reconstruction { intrinsics: scene.intrinsics, poses: scene.poses.clone(), points: scene.points.clone() }
    }

    fn perturbed(scene: &TestScene, deviation: f64, seed: u64) -> Reconstruction {
        let mut start = truth(scene);
        testing::perturb(std::iter::once(&mut start.intrinsics.focal), 10.0 * deviation, seed);
        testing::perturb(start.points.iter_mut().flat_map(|point| point.iter_mut()), deviation, seed + 1);
        testing::perturb(start.poses.iter_mut().flat_map(|pose| pose.translation.iter_mut()), deviation, seed + 2);
        for (k, pose) in start.poses.iter_mut().enumerate() {
            let turn = deviation * testing::direction::<3>(seed + 3 + k as u64);
            pose.rotation = Rotation3::from_scaled_axis(turn) * pose.rotation;
        }
        start
    }

    #[test]
    fn jacobians_of_all_models_agree_with_finite_differences() {
        let scene = testing::scene(1, 4, 8, NOISE);
        let mut start = perturbed(&scene, 0.01, 1);
        start.intrinsics.principal_point = Vector2::new(0.03, -0.02);
        start.intrinsics.aspect = 1.1;
        testing::check_jacobian(&Metric::<0>(start.clone()), &scene.observations);
        testing::check_jacobian(&Metric::<1>(start.clone()), &scene.observations);
        testing::check_jacobian(&Metric::<3>(start.clone()), &scene.observations);
        testing::check_jacobian(&Metric::<4>(start), &scene.observations);
    }

    #[test]
    fn converges_from_a_perturbed_start_to_the_noise_floor() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 8, 30, NOISE);
            let mut start = perturbed(&scene, 0.02, seed);
            let report = adjust(
                &mut start,
                &scene.observations,
                IntrinsicsModel::Focal,
                &Options { max_iterations: 60, ..Options::default() },
                &StopToken::default(),
            );
            let freedom = 2 * scene.observations.len() - (6 * 8 + 3 * 30 - 7 + 1);
            let ratio = report.cost / (freedom as f64 * NOISE * NOISE);
            let focal_error = start.intrinsics.focal / scene.intrinsics.focal - 1.0;
            println!("seed {seed}: {report:?}, chi2 per degree of freedom {ratio:.3}, focal off by {focal_error:.4}");
            assert!((0.7..1.3).contains(&ratio), "seed {seed}: {ratio}");
            assert!(focal_error.abs() < 0.03, "seed {seed}: {focal_error}");
            let orthogonal = start
                .poses
                .iter()
                .all(|pose| (pose.rotation * pose.rotation.transpose() - Matrix3::identity()).norm() < 1e-10);
            assert!(orthogonal);
        }
    }

    #[test]
    fn fixed_intrinsics_stay_fixed() {
        let scene = testing::scene(2, 4, 12, NOISE);
        let mut start = perturbed(&scene, 0.01, 2);
        let before = start.intrinsics;
        let options = Options::default();
        let report = adjust(&mut start, &scene.observations, IntrinsicsModel::Fixed, &options, &StopToken::default());
        assert!(report.iterations > 0);
        assert_eq!(start.intrinsics, before);
    }

    #[test]
    fn degenerate_input_neither_panics_nor_yields_nan() {
        let scene = testing::scene(3, 4, 8, NOISE);
        let run = |mut start: Reconstruction, observations: &[Observation]| {
            let options = Options::default();
            for model in [IntrinsicsModel::Focal, IntrinsicsModel::FocalPrincipalPointAspect] {
                let report = adjust(&mut start, observations, model, &options, &StopToken::default());
                assert!(report.cost.is_finite() && report.cost <= report.initial_cost, "{report:?}");
                intrinsics_variance(&start, observations, model);
            }
            start
        };
        run(Reconstruction { poses: vec![], points: vec![], ..truth(&scene) }, &scene.observations);
        run(truth(&scene), &[]);
        let mut odd = truth(&scene);
        // Depth zero, far away, and a camera that sees a single point.
        odd.points[0] = odd.poses[0].rotation.tr_mul(&-odd.poses[0].translation);
        odd.points[1] *= 1e9;
        let few: Vec<_> =
            scene.observations.iter().filter(|seen| seen.camera != 2 || seen.point == 3).copied().collect();
        let odd = run(odd, &few);
        assert!(odd.intrinsics.focal.is_finite() && odd.points.iter().all(|point| point.norm().is_finite()));
        let mut broken = truth(&scene);
        broken.poses[1].translation.fill(f64::NAN);
        run(broken, &scene.observations);
    }
}
