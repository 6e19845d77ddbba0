//! Where the points are: what a view sees at a pixel.

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::motion::{DISTANCE, within};
use super::{IMAGE_SIZE, PhotographedMotion, PhotographedOptions};
use crate::synthetic::scene::Camera;

/// Half the width and the height of a corridor, and how far what is on its walls stands out of them, as a share of the
/// distance.
const CORRIDOR: [f64; 2] = [1.3, 1.1];
const STANDING_OUT: f64 = 0.15;
/// Relief of the ground under an aerial camera, to either side, as a share of its height.
const RELIEF: f64 = 0.12;
/// Depths of what stands before the camera, nearest and farthest. What goes about an object has it, and what is before
/// and behind it.
const ROOM: (f64, f64) = (2.5, 8.0);
const STREET: (f64, f64) = (4.0, 30.0);
const OBJECT: (f64, f64) = (0.65 * DISTANCE, 1.4 * DISTANCE);
/// Depth beyond which a corridor or the ground is not observed.
const FARTHEST: f64 = 32.0;
/// Largest angle between the rays of a point from two views that both observe it: features do not match beyond.
const WIDEST_ANGLE_RAD: f64 = 0.9;
/// Least and largest depth at which a view observes a point, relative to the depth in the view that it was drawn in:
/// features change with the scale.
const SCALES: (f64, f64) = (0.4, 2.5);

/// Uniform in the image but for a border.
pub fn pixel(border_px: f64, rng: &mut ChaCha8Rng) -> [f64; 2] {
    [IMAGE_SIZE.width_px, IMAGE_SIZE.height_px]
        .map(|side| rng.random_range(border_px - 0.5..f64::from(side) - 0.5 - border_px))
}

/// Whether a place is within the image but for a border.
pub fn is_within([x, y]: [f64; 2], border_px: f64) -> bool {
    let inside = |value: f64, side: u32| value >= border_px - 0.5 && value <= f64::from(side) - 0.5 - border_px;
    inside(x, IMAGE_SIZE.width_px) && inside(y, IMAGE_SIZE.height_px)
}

/// Image of a point where a view has one but for a border.
pub fn image(camera: &Camera, point: &Vector3<f64>, border_px: f64) -> Option<[f64; 2]> {
    let [x, y, _] = camera.sees(point).then(|| camera.project(point))?;
    Some([x, y]).filter(|&image| is_within(image, border_px))
}

/// A point that a view sees; `None` where nothing is, or nothing near enough.
pub fn draw(
    options: &PhotographedOptions,
    camera: &Camera,
    border_px: f64,
    rng: &mut ChaCha8Rng,
) -> Option<Vector3<f64>> {
    let ray = camera.ray(pixel(border_px, rng))?;
    let (centre, direction) = (camera.pose.centre(), camera.pose.rotation.tr_mul(&ray));
    // The ray has unit depth: a multiple of it is a depth.
    let on_plane = |axis: usize, at: f64| (at - centre[axis]) / direction[axis];
    let depth = match options.motion {
        PhotographedMotion::Orbit | PhotographedMotion::WalkAround => log_uniform(OBJECT, rng),
        PhotographedMotion::Drive => log_uniform(STREET, rng),
        PhotographedMotion::AerialGrid => on_plane(2, within(RELIEF, rng) * DISTANCE),
        PhotographedMotion::PlanarScene => on_plane(2, 0.0),
        PhotographedMotion::Corridor => {
            let wall = |axis: usize| on_plane(axis, CORRIDOR[axis].copysign(direction[axis]));
            wall(0).min(wall(1)) * (1.0 - rng.random_range(0.0..STANDING_OUT))
        }
        PhotographedMotion::HandHeld
        | PhotographedMotion::NearRotation
        | PhotographedMotion::PureRotation
        | PhotographedMotion::Translation => log_uniform(ROOM, rng),
    };
    // What is farther shows nothing in the other views, and a plane that the ray leaves has no point on it.
    let point = (0.0..FARTHEST).contains(&depth).then(|| centre + direction * depth)?;
    camera.sees(&point).then_some(point)
}

/// Whether a view observes a point that was drawn in another one as it does, by its direction and scale.
pub fn is_alike(drawn_in: &Camera, other: &Camera, point: &Vector3<f64>) -> bool {
    let (from, to) = (point - drawn_in.pose.centre(), point - other.pose.centre());
    let scale = drawn_in.pose.apply(point).z / other.pose.apply(point).z;
    from.angle(&to) < WIDEST_ANGLE_RAD && (SCALES.0..SCALES.1).contains(&scale)
}

fn log_uniform((least, most): (f64, f64), rng: &mut ChaCha8Rng) -> f64 {
    rng.random_range(least.ln()..most.ln()).exp()
}
