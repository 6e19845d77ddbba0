//! How the cameras of a scene move.

use nalgebra::{Rotation3, Unit, Vector3};
use rand_chacha::ChaCha8Rng;

use super::draw::{chance, in_cube, normals, pick, uniform};
use super::world::{Limits, World};
use crate::synthetic::scene::Pose;

/// The motions and how often each occurs (the prototype's mix).
const MOTIONS: [(Motion, f64); 4] =
    [(Motion::General, 0.5), (Motion::Orbit, 0.2), (Motion::Smooth, 0.22), (Motion::Forward, 0.08)];
/// Depth that every point has at least: nearer ones would be anywhere in the image.
pub const MIN_DEPTH: f64 = 0.3;
/// Depth of the nearest point for a camera that steps back because no other pose was found.
const RETREAT_DEPTH: f64 = 0.5;
/// Poses tried for a view, each smaller than the one before by this factor: the last are a twentieth of the first.
const DRAWS: i32 = 40;
const SHRINK: f64 = 0.93;

/// Range of the largest angle of an orbit. Smooth motions of cameras that would orbit by more than
/// [`TURNS_ABOUT_SCENE`] turn about the scene, the others about themselves.
const ORBIT_RAD: (f64, f64) = (0.3, 1.6);
const TURNS_ABOUT_SCENE: f64 = 0.5;
/// Orbits are mostly about the vertical: weights of the components of the axis.
const ORBIT_AXIS: [f64; 3] = [0.3, 1.0, 0.3];
/// What an orbit leaves to chance: turns in radians, and translations as a share of the travel.
const ORBIT_SWAY_RAD: f64 = 0.1;
const ORBIT_SWAY: f64 = 0.2;
/// Forward motion: turns as a share of the largest, sideways steps and steps back and forth as shares of the travel.
const FORWARD_TURN: f64 = 0.1;
const FORWARD_SWAY: f64 = 0.1;
const FORWARD_RANGE: (f64, f64) = (-1.5, 1.0);
/// Deviations from a smooth path, in radians and in the world's unit.
const SHAKE: f64 = 0.05;

/// Share of the scenes in which the cameras roll about their axes, and the range of the largest angle.
const ROLLS: f64 = 0.25;
const ROLL_RAD: (f64, f64) = (0.3, std::f64::consts::PI);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Motion {
    /// Any turn within the limits, and any translation.
    General,
    /// Around the scene about one axis, at about one distance.
    Orbit,
    /// Turning and moving evenly from the first view to the last, with some shake: a hand-held sequence.
    Smooth,
    /// Mostly along the optical axis.
    Forward,
}

/// A motion with all that its views have in common.
#[derive(Debug, Clone, PartialEq)]
pub struct Path {
    pub motion: Motion,
    centre: Vector3<f64>,
    limits: Limits,
    orbit_rad: f64,
    axis: Unit<Vector3<f64>>,
    /// Largest roll about the optical axis; 0 mostly.
    roll_rad: f64,
}

impl Path {
    pub fn draw(world: &World, rng: &mut ChaCha8Rng) -> Self {
        Self {
            motion: pick(&MOTIONS, rng),
            centre: world.centre,
            limits: world.limits,
            orbit_rad: uniform(ORBIT_RAD, rng),
            axis: Unit::new_normalize(normals(rng).component_mul(&Vector3::from(ORBIT_AXIS))),
            roll_rad: if chance(ROLLS, rng) { uniform(ROLL_RAD, rng) } else { 0.0 },
        }
    }

    /// Poses of so many views on a path of this kind, all of which have the points in front.
    pub fn poses(&self, views: usize, points: &[Vector3<f64>], rng: &mut ChaCha8Rng) -> Vec<Pose> {
        let drift = Drift { turn: normals(rng), step: normals(rng) };
        let pose = |view| {
            let along = 2.0 * view as f64 / (views.max(2) - 1) as f64 - 1.0;
            let pose = (0..DRAWS)
                .map(|draw| self.propose(&drift, along, SHRINK.powi(draw), rng))
                .find(|pose| points.iter().all(|point| pose.apply(point).z > MIN_DEPTH))
                .unwrap_or_else(|| retreat(points));
            let angle = self.roll_rad * uniform((-1.0, 1.0), rng);
            let roll = *Rotation3::from_axis_angle(&Vector3::z_axis(), angle).matrix();
            Pose { rotation: roll * pose.rotation, translation: roll * pose.translation }
        };
        (0..views).map(pose).collect()
    }

    /// A pose `along` the path, from -1 at its start to 1 at its end, with all limits scaled.
    fn propose(&self, drift: &Drift, along: f64, scale: f64, rng: &mut ChaCha8Rng) -> Pose {
        let turn_rad = self.limits.turn_rad * scale;
        let travel = self.limits.travel * scale;
        match self.motion {
            Motion::General => self.about_camera(in_cube(rng) * turn_rad, in_cube(rng) * travel),
            Motion::Orbit => {
                let angle = self.orbit_rad * scale * uniform((-1.0, 1.0), rng);
                let sway = Rotation3::new(in_cube(rng) * ORBIT_SWAY_RAD * scale);
                self.about_scene(
                    Rotation3::from_axis_angle(&self.axis, angle) * sway,
                    in_cube(rng) * ORBIT_SWAY * travel,
                )
            }
            Motion::Smooth => {
                let turn = drift.turn * along * turn_rad + normals(rng) * SHAKE * scale;
                let step = drift.step * along * travel + normals(rng) * SHAKE * scale;
                if self.orbit_rad > TURNS_ABOUT_SCENE {
                    self.about_scene(Rotation3::new(turn), step)
                } else {
                    self.about_camera(turn, step)
                }
            }
            Motion::Forward => {
                let sideways = in_cube(rng) * FORWARD_SWAY;
                let step = Vector3::new(sideways.x, sideways.y, uniform(FORWARD_RANGE, rng)) * travel;
                self.about_camera(in_cube(rng) * FORWARD_TURN * turn_rad, step)
            }
        }
    }

    fn about_camera(&self, turn: Vector3<f64>, translation: Vector3<f64>) -> Pose {
        Pose { rotation: *Rotation3::new(turn).matrix(), translation }
    }

    fn about_scene(&self, rotation: Rotation3<f64>, translation: Vector3<f64>) -> Pose {
        Pose { rotation: *rotation.matrix(), translation: translation + self.centre - rotation * self.centre }
    }
}

/// Turn and step of a smooth path from its middle to its end, in the limits of the motion.
struct Drift {
    turn: Vector3<f64>,
    step: Vector3<f64>,
}

/// An unturned camera as far back as the nearest point asks.
fn retreat(points: &[Vector3<f64>]) -> Pose {
    let nearest = points.iter().map(|point| point.z).fold(f64::INFINITY, f64::min);
    let back = (RETREAT_DEPTH - nearest).max(0.0);
    Pose { rotation: nalgebra::Matrix3::identity(), translation: Vector3::new(0.0, 0.0, back) }
}
