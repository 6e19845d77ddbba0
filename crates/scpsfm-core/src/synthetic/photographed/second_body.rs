//! A second rigid body: before the camera of every view, with a smooth motion of its own.

use std::f64::consts::TAU;

use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::PhotographedOptions;
use super::motion::{DISTANCE, Path, within};
use super::stream::Stream;
use crate::synthetic::scene::Pose;

/// Half the side of the box that the body's points lie in.
const HALF_SIDE: f64 = 0.22 * DISTANCE;
/// Largest turn about each axis and largest shift along it, to either side.
const TURN_RAD: f64 = 0.5;
const SHIFT: f64 = 0.15 * DISTANCE;
/// How much nearer it is than what the camera looks at.
const NEARER: f64 = 0.15;
/// How often the body goes to and fro over all views.
const SWINGS: (f64, f64) = (0.5, 1.5);

/// The body in every view, from its own frame to the world.
///
/// It goes where the camera looks, a little nearer than that: about the middle of a scene, or ahead of a camera that
/// travels, as another car does.
pub fn motions(options: &PhotographedOptions, path: &Path) -> Vec<Pose> {
    let mut rng = Stream::SecondBody.of(options.seed);
    let waves: [(f64, f64, f64); 6] = std::array::from_fn(|k| {
        let most = if k < 3 { TURN_RAD } else { SHIFT };
        (most * rng.random_range(0.5..1.0), rng.random_range(SWINGS.0..SWINGS.1), rng.random_range(0.0..TAU))
    });
    let motion = |(view, (focus, pose)): (usize, (&Vector3<f64>, &Pose))| {
        let way = view as f64 / (options.views - 1) as f64;
        let at = waves.map(|(most, swings, phase)| most * (TAU * swings * way + phase).sin());
        let nearer = (pose.centre() - focus) * NEARER;
        let rotation = *Rotation3::from_scaled_axis(Vector3::new(at[0], at[1], at[2])).matrix();
        Pose { rotation, translation: focus + nearer + Vector3::new(at[3], at[4], at[5]) }
    };
    path.focus.iter().zip(&path.poses).enumerate().map(motion).collect()
}

/// A point of the body in its own frame.
pub fn draw_point(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| within(HALF_SIDE, rng))
}
