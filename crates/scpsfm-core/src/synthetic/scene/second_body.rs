//! A second rigid body, with a motion of its own.

use nalgebra::Vector3;
use rand_chacha::ChaCha8Rng;

use super::SceneOptions;
use super::camera::Camera;
use super::motion::{MAX_DRAWS, Pose, draw_rotation, draw_translation};
use super::stream::Stream;
use crate::domain::error::{InvalidInput, Violation};

/// Largest rotation of the second body about each axis: half of the cameras' in the paper.
const MAX_ROTATION_RAD: f64 = 0.2;
/// Largest translation of the second body along each axis: seen from a distance of 3 it moves by a tenth of the image,
/// which is far above the noise and far below the motion of the cameras.
const MAX_TRANSLATION: f64 = 0.3;

/// Draws where the second body is in each view: its motion about the scene's centre, relative to where its points are
/// on the first body. Every point stays visible.
///
/// # Errors
/// A view in which no motion keeps the body in front of the camera.
pub fn draw_motions(
    options: &SceneOptions,
    cameras: &[Camera],
    points: &[Vector3<f64>],
    members: &[bool],
) -> Result<Vec<Pose>, InvalidInput> {
    let mut rng = Stream::SecondBody.of(options.seed);
    let body: Vec<&Vector3<f64>> = points.iter().zip(members).filter(|(_, member)| **member).map(|(p, _)| p).collect();
    cameras.iter().enumerate().map(|(view, camera)| draw_motion(view, camera, &body, &mut rng)).collect()
}

fn draw_motion(
    view: usize,
    camera: &Camera,
    body: &[&Vector3<f64>],
    rng: &mut ChaCha8Rng,
) -> Result<Pose, InvalidInput> {
    for _ in 0..MAX_DRAWS {
        let motion = Pose::about_centre(draw_rotation(MAX_ROTATION_RAD, rng), draw_translation(rng) * MAX_TRANSLATION);
        if body.iter().all(|point| camera.sees(&motion.apply(point))) {
            return Ok(motion);
        }
    }
    Err(Violation::of("second_motion", format!("no motion keeps the second body in front of view {view}")).into())
}
