//! How the cameras move: the paper's general motion, and motions for which calibration is impossible or hard.
//!
//! The critical motions of self-calibration are Sturm's (Critical motion sequences for monocular self-calibration and
//! uncalibrated Euclidean reconstruction, CVPR 1997): whatever the images, more than one calibration explains them.

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::SceneOptions;
use super::camera::Lens;
use super::noise::normal;
use super::shape::SCENE_CENTRE;
use super::stream::Stream;
use crate::domain::error::{InvalidInput, Violation};

/// Poses drawn for one view before the options are called impossible.
pub const MAX_DRAWS: usize = 10_000;
/// Rotations above this carry the scene out of view unless the camera orbits it.
const ORBIT_ABOVE_RAD: f64 = 0.5;
/// Distance of an orbiting camera to the scene's centre: far enough to have the box, of radius 1.7, in front, and about
/// the paper's 2 to 4.
const ORBIT_DISTANCE: (f64, f64) = (2.5, 4.0);

named! {
    /// How the cameras of a scene move. Sizes are those of the scene, whose box has sides of 2 at a distance of 3.
    #[derive(Default)]
    pub enum Motion {
        /// Rotations uniform in `+-max_rotation_rad` about each axis, translations uniform in `[-1, 1]^3` (paper,
        /// section 5.1); with rotations above 0.5 the cameras turn about the scene's centre instead of their own.
        #[default]
        General = "general",
        /// Around the scene, the optical axes through its centre: rotations as above, the distance to the centre
        /// uniform in `[2.5, 4]`.
        Orbit = "orbit",
        /// Around the scene about one axis, the vertical, at a distance of 3, the optical axes in one plane and through
        /// the centre: a turntable.
        Turntable = "turntable",
        /// One rotation for all views, translations uniform in `[-1, 1]^3`: images of the plane at infinity do not
        /// move, and no more than an affine reconstruction exists. Critical.
        PureTranslation = "pure-translation",
        /// Along the optical axis by at most 1 either way, without turning: critical as above, and with points near the
        /// axis that show no parallax.
        Forward = "forward",
        /// Side by side without turning, on a square grid with sides of 2 across the optical axis, row by row: critical
        /// as above.
        Grid = "grid",
        /// Rotations about a camera centre that stays: a homography relates any two views, and depths do not show.
        PureRotation = "pure-rotation",
        /// Anywhere on a sphere about the scene, of radius 3, the optical axes through its centre: rotations uniform
        /// among all there are, rolls included. The largest rotation does not matter.
        Sphere = "sphere",
    }
}

impl Motion {
    /// Whether the cameras would all be the same without rotations.
    pub fn needs_rotation(self) -> bool {
        matches!(self, Motion::Orbit | Motion::Turntable | Motion::PureRotation)
    }
}

/// A rigid motion, `rotation * point + translation`: of cameras, from the world to theirs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Pose {
    /// Of a camera at the origin that looks along `z`.
    pub const IDENTITY: Self = Self {
        rotation: Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        translation: Vector3::new(0.0, 0.0, 0.0),
    };

    /// The moved point.
    pub fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    /// The camera's centre in the world.
    pub fn centre(&self) -> Vector3<f64> {
        -(self.rotation.transpose() * self.translation)
    }

    /// The same camera turned by an angle about its optical axis.
    fn rolled(&self, angle_rad: f64) -> Self {
        let roll = *Rotation3::from_axis_angle(&Vector3::z_axis(), angle_rad).matrix();
        Self { rotation: roll * self.rotation, translation: roll * self.translation }
    }

    /// A turn about the scene's centre, then a shift.
    pub fn about_centre(rotation: Matrix3<f64>, translation: Vector3<f64>) -> Self {
        let centre = Vector3::from(SCENE_CENTRE);
        Self { rotation, translation: translation + (centre - rotation * centre) }
    }
}

/// Draws the poses, one a view; each has every point visible. The paper's motion draws from `rng`, every other one from
/// a stream of its own.
///
/// # Errors
/// A rotation or a distortion with which no camera sees the whole cloud.
pub fn draw_poses(
    options: &SceneOptions,
    points: &[Vector3<f64>],
    lens: Lens,
    rng: &mut ChaCha8Rng,
) -> Result<Vec<Pose>, InvalidInput> {
    let max_rotation_rad = options.max_rotation_rad;
    let mut own = Stream::Motion.of(options.seed);
    let rng = if options.motion == Motion::General { rng } else { &mut own };
    let common = match options.motion {
        Motion::PureTranslation => draw_rotation(max_rotation_rad, rng),
        _ => Matrix3::identity(),
    };
    let mut draw = |view| {
        for _ in 0..MAX_DRAWS {
            let pose = propose(options, view, &common, rng);
            if points.iter().all(|point| lens.sees(&pose.apply(point))) {
                return Ok(pose);
            }
        }
        Err(blind(options))
    };
    let poses: Result<Vec<Pose>, InvalidInput> = (0..options.views).map(&mut draw).collect();
    let mut roll = Stream::Roll.of(options.seed);
    // A roll changes neither depths nor distances from the axis: what was seen still is.
    Ok(poses?.iter().map(|pose| pose.rolled(draw_angle(options.max_roll_rad, &mut roll))).collect())
}

/// No camera was found; names what is more likely to be in the way.
fn blind(options: &SceneOptions) -> InvalidInput {
    let (name, because) = if options.radial_k1 < 0.0 {
        ("radial_k1", format!("a distortion of {} that folds the outer image", options.radial_k1))
    } else {
        ("rotation", format!("rotations up to {}", options.max_rotation_rad))
    };
    Violation::of(name, format!("no camera sees the whole scene with {because}")).into()
}

/// One pose of this motion, whatever it sees; `common` is the rotation of all views where they share one.
fn propose(options: &SceneOptions, view: usize, common: &Matrix3<f64>, rng: &mut ChaCha8Rng) -> Pose {
    let max_rotation_rad = options.max_rotation_rad;
    match options.motion {
        Motion::General => {
            let rotation = draw_rotation(max_rotation_rad, rng);
            let translation = draw_translation(rng);
            if max_rotation_rad > ORBIT_ABOVE_RAD {
                Pose::about_centre(rotation, translation)
            } else {
                Pose { rotation, translation }
            }
        }
        Motion::Orbit => {
            let rotation = draw_rotation(max_rotation_rad, rng);
            let distance = rng.random_range(ORBIT_DISTANCE.0..ORBIT_DISTANCE.1);
            Pose::about_centre(rotation, Vector3::new(0.0, 0.0, distance - SCENE_CENTRE[2]))
        }
        Motion::Turntable => {
            let about_y = Rotation3::from_axis_angle(&Vector3::y_axis(), draw_angle(max_rotation_rad, rng));
            Pose::about_centre(*about_y.matrix(), Vector3::zeros())
        }
        // About the centre, so that the scene stays in front whatever the common rotation.
        Motion::PureTranslation => Pose::about_centre(*common, draw_translation(rng)),
        Motion::Forward => Pose { rotation: *common, translation: Vector3::new(0.0, 0.0, rng.random_range(-1.0..1.0)) },
        Motion::Grid => {
            let columns = (options.views as f64).sqrt().ceil() as usize;
            let place = |k: usize| 1.0 - 2.0 * k as f64 / (columns - 1) as f64;
            let translation = Vector3::new(place(view % columns), place(view / columns), 0.0);
            Pose { rotation: *common, translation }
        }
        Motion::PureRotation => Pose { rotation: draw_rotation(max_rotation_rad, rng), translation: Vector3::zeros() },
        Motion::Sphere => Pose::about_centre(draw_any_rotation(rng), Vector3::zeros()),
    }
}

fn draw_angle(max_rotation_rad: f64, rng: &mut ChaCha8Rng) -> f64 {
    if max_rotation_rad > 0.0 { rng.random_range(-max_rotation_rad..max_rotation_rad) } else { 0.0 }
}

/// Turns about x, y and z, each uniform in `+-max_rotation_rad`.
pub fn draw_rotation(max_rotation_rad: f64, rng: &mut ChaCha8Rng) -> Matrix3<f64> {
    let [about_x, about_y, about_z] = std::array::from_fn(|_| draw_angle(max_rotation_rad, rng));
    let rotation = Rotation3::from_axis_angle(&Vector3::x_axis(), about_x)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), about_y)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), about_z);
    *rotation.matrix()
}

/// Uniform among all rotations: the quaternion of four normals (Muller 1959).
fn draw_any_rotation(rng: &mut ChaCha8Rng) -> Matrix3<f64> {
    let [w, x, y, z] = std::array::from_fn(|_| normal(rng.random(), rng.random()));
    *UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix().matrix()
}

/// Uniform in `[-1, 1]^3`.
pub fn draw_translation(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0))
}
