//! What the tests of several modules share: scenes in normalised units, and the check of a Jacobian.

use nalgebra::{Matrix3, Matrix3x4, Matrix4, Rotation3, SMatrix, SVector, Vector2, Vector3, Vector4};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Observation;
use super::metric::{Intrinsics, IntrinsicsModel, MetricReconstruction, Pose};
use super::problem::{BundleProblem, Step};
use crate::synthetic::{Scene, SceneOptions};

/// Noise of the tests, one standard deviation as a share of the image: the paper's .3 %.
pub(crate) const NOISE: f64 = 0.003;
const IMAGE_SIDE_PX: f64 = 1000.0;
/// Points nearer than this redraw a camera, as in the generator.
const MIN_DEPTH: f64 = 0.5;

impl IntrinsicsModel {
    pub(crate) const FULL: Self = Self::FOCAL.with_all_extensions();
}

/// A scene with its truth; image coordinates are normalised.
#[derive(Clone)]
pub(crate) struct TestScene {
    pub intrinsics: Intrinsics,
    pub poses: Vec<Pose>,
    pub points: Vec<Vector3<f64>>,
    pub observations: Vec<Observation>,
}

/// How the cameras of a scene move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Motion {
    General,
    /// One orientation for all views.
    Translation,
    /// One centre for all views.
    Rotation,
    /// Along the optical axis, without turning.
    Forward,
}

pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// The paper's scene without outliers: `views` cameras in general motion, `tracks` points, all seen.
pub(crate) fn scene(seed: u64, views: usize, tracks: usize, noise: f64) -> TestScene {
    scene_of(seed, views, tracks, noise, Motion::General, false)
}

/// The same with another motion, or with the points on a plane.
pub(crate) fn scene_of(seed: u64, views: usize, tracks: usize, noise: f64, motion: Motion, planar: bool) -> TestScene {
    let options = SceneOptions { views, tracks, seed, ..SceneOptions::default() };
    from_options(&options, noise, motion, planar)
}

/// A scene in general motion whose cameras turn by at most this about each axis: little turning, little calibration.
pub(crate) fn scene_turning(seed: u64, tracks: usize, noise: f64, max_rotation_rad: f64) -> TestScene {
    let options = SceneOptions { tracks, max_rotation_rad, seed, ..SceneOptions::default() };
    from_options(&options, noise, Motion::General, false)
}

fn from_options(options: &SceneOptions, noise: f64, motion: Motion, planar: bool) -> TestScene {
    let (seed, views) = (options.seed, options.views);
    let options = SceneOptions { noise: 0.0, outliers: 0.0, ..options.clone() };
    let truth = Scene::generate(&options).expect("valid options").truth;
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed);
    let mut points: Vec<Vector3<f64>> = truth.points.iter().map(|point| Vector3::from(*point)).collect();
    if planar {
        points.iter_mut().for_each(|point| point.z = 3.0 + 0.3 * point.x + 0.2 * point.y);
    }
    let rotation = |view: usize| Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
    let mut poses = Vec::with_capacity(views);
    for view in 0..views {
        let general = Pose { rotation: rotation(view), translation: Vector3::from(truth.translations[view]) };
        poses.push(draw_pose(&general, &rotation(0), &points, motion, &mut rng));
    }
    let intrinsics = Intrinsics::from_focal(truth.focal_px / IMAGE_SIDE_PX);
    let mut scene = TestScene { intrinsics, poses, points, observations: Vec::new() };
    scene.observe(noise, &mut rng);
    scene
}

fn draw_pose(
    general: &Pose,
    first: &Matrix3<f64>,
    points: &[Vector3<f64>],
    motion: Motion,
    rng: &mut ChaCha8Rng,
) -> Pose {
    loop {
        let mut uniform = |range: f64| rng.random_range(-range..range);
        let shift = Vector3::new(uniform(1.0), uniform(1.0), uniform(1.0));
        let turned = Rotation3::from_euler_angles(uniform(0.4), uniform(0.4), uniform(0.4));
        let pose = match motion {
            Motion::General => *general,
            Motion::Translation => Pose { rotation: *first, translation: shift },
            Motion::Rotation => Pose { rotation: *turned.matrix(), translation: Vector3::zeros() },
            Motion::Forward => Pose { rotation: Matrix3::identity(), translation: Vector3::new(0.0, 0.0, shift.z) },
        };
        let depth = |point: &Vector3<f64>| (pose.rotation * point + pose.translation).z;
        // A fixed orientation may never see the scene well; there, only what is behind the camera is redrawn.
        let least = if motion == Motion::General { f64::NEG_INFINITY } else { MIN_DEPTH / 2.0 };
        if points.iter().all(|point| depth(point) > least) {
            return pose;
        }
    }
}

impl TestScene {
    /// Observes every point in every view with this noise.
    pub fn observe(&mut self, noise: f64, rng: &mut ChaCha8Rng) {
        self.observations.clear();
        for (camera, pose) in self.poses.iter().enumerate() {
            for (point, position) in self.points.iter().enumerate() {
                let image = self.intrinsics.project(&(pose.rotation * position + pose.translation));
                let xy = image + noise * Vector2::new(normal(rng), normal(rng));
                self.observations.push(Observation::new(camera, point, xy));
            }
        }
    }

    /// Leaves what falls into the image, and of that what three views see; beyond where the distortion folds the
    /// image back, nothing is seen.
    pub fn crop(&mut self) {
        let (intrinsics, poses, points) = (self.intrinsics, &self.poses, &self.points);
        self.observations.retain(|seen| {
            let direction = poses[seen.view].apply(&points[seen.point]);
            let squared = (direction.xy() / direction.z).norm_squared();
            seen.xy.amax() <= 0.5 && intrinsics.images(squared) && intrinsics.radius_slope(squared) > 0.1
        });
        let mut count = vec![0; self.points.len()];
        self.observations.iter().for_each(|seen| count[seen.point] += 1);
        self.observations.retain(|seen| count[seen.point] >= 3);
    }

    /// The truth, one calibration for all views.
    pub fn reconstruction(&self) -> MetricReconstruction {
        MetricReconstruction::new(self.intrinsics, self.poses.clone(), self.points.clone())
    }

    /// The true cameras, `K [R|t]`.
    pub fn cameras(&self) -> Vec<Matrix3x4<f64>> {
        self.poses.iter().map(|pose| pose.camera(&self.intrinsics)).collect()
    }
}

/// Moves the cameras onto a circle about the centre of the points, turning about one axis by at most so much.
pub(crate) fn orbit(scene: &mut TestScene, max_angle_rad: f64) {
    let count = scene.poses.len() as f64;
    let centre = scene.points.iter().sum::<Vector3<f64>>() / scene.points.len() as f64;
    for (k, pose) in scene.poses.iter_mut().enumerate() {
        let angle = max_angle_rad * (2.0 * k as f64 / (count - 1.0) - 1.0);
        let rotation = Rotation3::from_axis_angle(&Vector3::y_axis(), angle).into_inner();
        *pose = Pose { rotation, translation: Vector3::new(0.0, 0.0, 3.0) - rotation * centre };
    }
}

/// The true cameras and points in a random projective frame, with random scales and signs.
pub(crate) fn projectively_transformed(scene: &TestScene, seed: u64) -> (Vec<Matrix3x4<f64>>, Vec<Vector4<f64>>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xf0a3);
    let (frame, inverse) = loop {
        let frame = Matrix4::from_fn(|_, _| normal(&mut rng));
        // A nearly singular frame would only test the rounding.
        if let Some(inverse) = frame.try_inverse().filter(|inverse| inverse.norm() < 30.0) {
            break (frame, inverse);
        }
    };
    let mut scale = || rng.random_range(0.5..2.0) * if rng.random::<bool>() { 1.0 } else { -1.0 };
    let cameras = scene.cameras().iter().map(|camera| camera * frame * scale()).collect();
    let points = scene.points.iter().map(|point| inverse * point.push(1.0) * scale()).collect();
    (cameras, points)
}

/// Adds Gaussian noise to every value.
pub(crate) fn perturb<'a>(values: impl Iterator<Item = &'a mut f64>, deviation: f64, seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xbad);
    for value in values {
        *value += deviation * normal(&mut rng);
    }
}

/// A reconstruction with points and poses moved by so much, focal lengths by ten times as much.
pub(super) fn perturbed(truth: &MetricReconstruction, deviation: f64, seed: u64) -> MetricReconstruction {
    let mut start = truth.clone();
    perturb(start.intrinsics.iter_mut().map(|intrinsics| &mut intrinsics.focal), 10.0 * deviation, seed);
    perturb(start.points.iter_mut().flat_map(|point| point.iter_mut()), deviation, seed + 1);
    perturb(start.poses.iter_mut().flat_map(|pose| pose.translation.iter_mut()), deviation, seed + 2);
    let mut turns = vec![Vector3::zeros(); start.poses.len()];
    perturb(turns.iter_mut().flat_map(|turn: &mut Vector3<f64>| turn.iter_mut()), deviation, seed + 3);
    for (pose, turn) in start.poses.iter_mut().zip(turns) {
        pose.rotation = Rotation3::from_scaled_axis(turn) * pose.rotation;
    }
    start
}

/// Compares the Jacobian of every observation with central differences through the problem's own retraction.
///
/// # Panics
/// When an entry is off by more than the differences can explain.
pub(super) fn check_jacobian<const C: usize, const P: usize>(
    problem: &impl BundleProblem<C, P>,
    observations: &[Observation],
) {
    const WIDTH: f64 = 1e-6;
    // Central differences of values around 1: truncation 1e-12 and rounding 1e-10, times steep points.
    const TOLERANCE: f64 = 1e-7;
    let mut moved = problem.clone();
    let (cameras, points) = problem.counts();
    let mut compared = 0;
    for seen in observations {
        let (_, jacobian) = problem.evaluate(*seen);
        let jacobian = jacobian();
        let largest = jacobian.camera.amax().max(jacobian.point.amax()).max(1.0);
        let mut difference = |set: &dyn Fn(&mut Step<C, P>, f64)| {
            let mut side = |width: f64| {
                let mut step = Step::zeros(cameras, points);
                set(&mut step, width);
                moved.retract(problem, &step);
                let (residual, _) = moved.evaluate(*seen);
                residual
            };
            (side(WIDTH) - side(-WIDTH)) / (2.0 * WIDTH)
        };
        let mut compare = |analytic: Vector2<f64>, numeric: Vector2<f64>, what: &str, k: usize| {
            compared += 1;
            let error = (analytic - numeric).norm();
            assert!(error < TOLERANCE * largest, "{what} {k}: analytic {analytic}, numeric {numeric}");
        };
        let row = |matrix: &[f64], rows: usize, k: usize| Vector2::new(matrix[k], matrix[rows + k]);
        for k in 0..C {
            let numeric = difference(&|step, width| step.cameras[seen.view][k] = width);
            compare(row(jacobian.camera.as_slice(), C, k), numeric, "camera", k);
        }
        for k in 0..P {
            let numeric = difference(&|step, width| step.points[seen.point][k] = width);
            compare(row(jacobian.point.as_slice(), P, k), numeric, "point", k);
        }
    }
    assert_eq!(compared, observations.len() * (C + P));
}

/// A vector of small random numbers, for tests that need a direction.
pub(crate) fn direction<const N: usize>(seed: u64) -> SVector<f64, N> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    SMatrix::from_fn(|_, _| normal(&mut rng))
}
