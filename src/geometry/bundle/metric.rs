//! Metric bundle adjustment: one calibration for all views, rotations, translations and Euclidean points.

use nalgebra::{Matrix3, Matrix3x4, Rotation3, SMatrix, Vector2, Vector3};

pub use super::covariance::{Information, Optimum};
use super::engine::{Belief, Jacobian, Problem, Sink, Step, minimise};
use super::intrinsics::ImageGradients;
pub use super::intrinsics::Intrinsics;
pub use super::intrinsics_model::{Extension, IntrinsicsModel, IntrinsicsPrior, Parameter};
use super::{Observation, Options, Report};
use crate::domain::StopToken;

/// Unknowns of a pose (rotation vector, then translation) and of a point.
pub(super) const POSE: usize = 6;
pub(super) const POINT: usize = 3;

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

    /// Turned about the camera's own centre and moved, `x -> dR x + dt` in camera coordinates, by a rotation vector and a
    /// translation. About the origin of the world, a camera far from it could turn only against the damping of its
    /// lever.
    #[inline]
    pub(crate) fn moved(&self, [a, b, c, x, y, z]: [f64; POSE]) -> Self {
        let turn = Rotation3::from_scaled_axis(Vector3::new(a, b, c));
        Self { rotation: turn * self.rotation, translation: turn * self.translation + Vector3::new(x, y, z) }
    }

    /// The camera matrix `K [R|t]`.
    pub fn camera(&self, intrinsics: &Intrinsics) -> Matrix3x4<f64> {
        let mut camera = Matrix3x4::zeros();
        camera.fixed_columns_mut::<3>(0).copy_from(&self.rotation);
        camera.set_column(3, &self.translation);
        intrinsics.matrix() * camera
    }
}

/// A point as a view sees it, `K [R|t] X` behind a lens.
pub(crate) struct Projection<'a> {
    intrinsics: &'a Intrinsics,
    pose: &'a Pose,
    /// In camera coordinates.
    pub at: Vector3<f64>,
    /// Infinite or not a number at depth zero.
    pub image: Vector2<f64>,
}

/// Gradients of the two coordinates of an image point.
pub(crate) struct ProjectionGradients {
    /// By the intrinsics, in the order of [`Parameter`].
    pub by_parameter: [[f64; Parameter::COUNT]; 2],
    /// As [`Pose::moved`] moves the pose.
    pub by_pose: [[f64; POSE]; 2],
    pub by_point: [Vector3<f64>; 2],
}

impl<'a> Projection<'a> {
    #[inline]
    pub fn new(intrinsics: &'a Intrinsics, pose: &'a Pose, point: &Vector3<f64>) -> Self {
        let at = pose.apply(point);
        Self { intrinsics, pose, at, image: intrinsics.project(&at) }
    }

    #[inline]
    pub fn gradients(&self) -> ProjectionGradients {
        let ImageGradients { by_parameter, by_seen } = self.intrinsics.gradients(&self.at);
        let by_pose = by_seen.map(|by_seen| {
            let turn = self.at.cross(&by_seen);
            [turn.x, turn.y, turn.z, by_seen.x, by_seen.y, by_seen.z]
        });
        ProjectionGradients {
            by_parameter,
            by_pose,
            by_point: by_seen.map(|by_seen| self.pose.rotation.tr_mul(&by_seen)),
        }
    }
}

impl ProjectionGradients {
    /// By these intrinsics, pose and point; of a view with further unknowns, which come after the pose, those by the
    /// parameter `of_view`.
    #[inline]
    pub(super) fn jacobian<const G: usize, const C: usize>(
        &self,
        globals: &[Parameter; G],
        of_view: Parameter,
    ) -> Jacobian<G, C, POINT> {
        Jacobian {
            globals: SMatrix::from_fn(|k, component| self.by_parameter[component][globals[k] as usize]),
            camera: SMatrix::from_fn(|k, component| match self.by_pose[component].get(k) {
                Some(by_pose) => *by_pose,
                None => self.by_parameter[component][of_view as usize],
            }),
            point: SMatrix::from_columns(&self.by_point),
        }
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
    /// The cameras `K [R|t]`.
    pub fn cameras(&self) -> Vec<Matrix3x4<f64>> {
        self.poses.iter().map(|pose| pose.camera(&self.intrinsics)).collect()
    }

    /// Predicted minus observed image point; infinite or not a number at depth zero.
    ///
    /// # Panics
    /// When the observation's indices are out of range.
    pub fn residual(&self, seen: &Observation) -> Vector2<f64> {
        self.intrinsics.project(&self.poses[seen.camera].apply(&self.points[seen.point])) - seen.xy
    }
}

/// A reconstruction with these `G` intrinsics free.
#[derive(Clone)]
pub(super) struct Metric<const G: usize> {
    pub reconstruction: Reconstruction,
    pub free: [Parameter; G],
    pub prior: IntrinsicsPrior,
}

impl<const G: usize> Problem<G, POSE, POINT> for Metric<G> {
    fn camera_count(&self) -> usize {
        self.reconstruction.poses.len()
    }

    fn point_count(&self) -> usize {
        self.reconstruction.points.len()
    }

    #[inline]
    fn observe(&self, observation: &Observation, sink: &mut impl Sink<G, POSE, POINT>) {
        let Reconstruction { intrinsics, poses, points } = &self.reconstruction;
        let seen = Projection::new(intrinsics, &poses[observation.camera], &points[observation.point]);
        sink.take(seen.image - observation.xy, || seen.gradients().jacobian(&self.free, Parameter::LogFocal));
    }

    fn retract(&mut self, from: &Self, step: &Step<G, POSE, POINT>) {
        let (moved, from) = (&mut self.reconstruction, &from.reconstruction);
        moved.intrinsics = from.intrinsics;
        for (parameter, by) in self.free.iter().zip(step.globals.iter()) {
            moved.intrinsics.shift(*parameter, *by);
        }
        for ((pose, from), step) in moved.poses.iter_mut().zip(&from.poses).zip(&step.cameras) {
            *pose = from.moved((*step).into());
        }
        for ((point, from), step) in moved.points.iter_mut().zip(&from.points).zip(&step.points) {
            *point = from + step;
        }
    }

    fn global_beliefs(&self) -> [Belief; G] {
        self.free.map(|parameter| Belief {
            information: self.prior.information[parameter as usize],
            deviation: self.prior.deviation(parameter, &self.reconstruction.intrinsics),
        })
    }
}

/// Minimises the reprojection error over poses, points and the free intrinsics, of which `prior` knows something.
///
/// The cost contains what the prior adds.
///
/// # Pitfall
/// Points may pass behind a camera on the way: residuals know no cheirality, so check it on the result.
pub fn adjust(
    reconstruction: &mut Reconstruction,
    observations: &[Observation],
    model: IntrinsicsModel,
    prior: &IntrinsicsPrior,
    options: &Options,
    stop: &StopToken,
) -> Report {
    let run = Run { observations, prior, options, stop };
    match model.parameters().as_slice() {
        [] => run.with([], reconstruction),
        &[a] => run.with([a], reconstruction),
        &[a, b] => run.with([a, b], reconstruction),
        &[a, b, c] => run.with([a, b, c], reconstruction),
        &[a, b, c, d] => run.with([a, b, c, d], reconstruction),
        &[a, b, c, d, e] => run.with([a, b, c, d, e], reconstruction),
        // The only model left is the one that frees them all.
        _ => run.with(Parameter::ALL, reconstruction),
    }
}

/// What an adjustment works with, whatever is free.
struct Run<'a> {
    observations: &'a [Observation],
    prior: &'a IntrinsicsPrior,
    options: &'a Options,
    stop: &'a StopToken,
}

impl Run<'_> {
    fn with<const G: usize>(&self, free: [Parameter; G], reconstruction: &mut Reconstruction) -> Report {
        let mut problem = Metric { reconstruction: reconstruction.clone(), free, prior: *self.prior };
        let report = minimise(&mut problem, self.observations, self.options, self.stop);
        *reconstruction = problem.reconstruction;
        report
    }
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
        for (radial, second_radial) in [(0.0, 0.0), (-0.1, 0.0), (-0.1, 0.07)] {
            (start.intrinsics.radial, start.intrinsics.second_radial) = (radial, second_radial);
            let with = |reconstruction: &Reconstruction| (reconstruction.clone(), IntrinsicsPrior::NONE);
            let (reconstruction, prior) = with(&start);
            testing::check_jacobian(&Metric { reconstruction, free: [], prior }, &scene.observations);
            let (reconstruction, prior) = with(&start);
            let free = [Parameter::LogFocal, Parameter::Radial];
            testing::check_jacobian(&Metric { reconstruction, free, prior }, &scene.observations);
            let (reconstruction, prior) = with(&start);
            testing::check_jacobian(&Metric { reconstruction, free: Parameter::ALL, prior }, &scene.observations);
        }
    }

    #[test]
    fn converges_from_a_perturbed_start_to_the_noise_floor() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 8, 30, NOISE);
            let mut start = perturbed(&scene, 0.02, seed);
            let report = adjust(
                &mut start,
                &scene.observations,
                IntrinsicsModel::FOCAL,
                &IntrinsicsPrior::NONE,
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
    fn a_prior_moves_its_parameter_by_what_it_is_worth() {
        let scene = testing::scene(4, 6, 20, NOISE);
        let adjusted = |prior: &IntrinsicsPrior| {
            let mut start = truth(&scene);
            let options = Options { max_iterations: 60, relative_tolerance: 1e-12, ..Options::default() };
            let report =
                adjust(&mut start, &scene.observations, IntrinsicsModel::FOCAL, prior, &options, &StopToken::default());
            (start.intrinsics.focal.ln(), report.cost)
        };
        let (free, cost) = adjusted(&IntrinsicsPrior::NONE);
        let mut reconstruction = truth(&scene);
        reconstruction.intrinsics.focal = free.exp();
        let information = Information::new(&reconstruction, &scene.observations).expect("poses");
        let optimum = information.optimum(IntrinsicsModel::FOCAL, &IntrinsicsPrior::NONE);
        let variance = optimum.variance_of(Parameter::LogFocal).expect("observable");
        let sigma = variance.sqrt() * NOISE;
        // As well known as the data say, one sigma away: it pulls half the way, and costs half a chi-square.
        let prior = IntrinsicsPrior::NONE.knowing(Parameter::LogFocal, free + sigma, sigma, NOISE);
        let (pulled, dearer) = adjusted(&prior);
        let (way, rise) = ((pulled - free) / sigma, (dearer - cost) / (NOISE * NOISE));
        println!("way {way}, rise {rise}");
        assert!((way - 0.5).abs() < 0.05 && (rise - 0.5).abs() < 0.05, "way {way}, rise {rise}");
    }

    #[test]
    fn fixed_intrinsics_stay_fixed() {
        let scene = testing::scene(2, 4, 12, NOISE);
        let mut start = perturbed(&scene, 0.01, 2);
        let before = start.intrinsics;
        let options = Options::default();
        let (model, prior) = (IntrinsicsModel::FIXED, IntrinsicsPrior::NONE);
        let report = adjust(&mut start, &scene.observations, model, &prior, &options, &StopToken::default());
        assert!(report.iterations > 0);
        assert_eq!(start.intrinsics, before);
    }

    #[test]
    fn degenerate_input_neither_panics_nor_yields_nan() {
        let scene = testing::scene(3, 4, 8, NOISE);
        let run = |mut start: Reconstruction, observations: &[Observation]| {
            let options = Options::default();
            for model in [IntrinsicsModel::FIXED, IntrinsicsModel::FOCAL, IntrinsicsModel::FULL] {
                let prior = IntrinsicsPrior::NONE;
                let report = adjust(&mut start, observations, model, &prior, &options, &StopToken::default());
                assert!(report.cost.is_finite() && report.cost <= report.initial_cost, "{report:?}");
                if let Some(information) = Information::new(&start, observations) {
                    information.optimum(model, &prior);
                }
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
