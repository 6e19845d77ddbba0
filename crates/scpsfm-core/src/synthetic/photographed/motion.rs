//! How the camera moves: the pose of every view, and what it looks at.

use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::stream::Stream;
use super::{IMAGE_SIZE, PhotographedMotion, PhotographedOptions};
use crate::synthetic::scene::Pose;

/// Distance of what the camera looks at where it goes about an object or stands before a scene.
pub const DISTANCE: f64 = 4.0;
/// Steps of the camera from view to view in a corridor and on a street.
const CORRIDOR_STEP: f64 = 0.35;
const DRIVE_STEP: f64 = 0.8;
/// Distance ahead of what a driver looks at.
const AHEAD: f64 = 8.0;
/// Places of neighbouring views of an aerial grid along and across the flight direction, as shares of what an image
/// covers: overlaps of 75 and 60 %, as survey flights have them.
const ALONG: f64 = 0.25;
const ACROSS: f64 = 0.4;

/// The poses of a scene and what is about them.
#[derive(Debug)]
pub struct Path {
    pub poses: Vec<Pose>,
    /// What each view looks at, but for the shaking of the hand.
    pub focus: Vec<Vector3<f64>>,
}

impl Path {
    fn new(views: impl Iterator<Item = (Pose, Vector3<f64>)>) -> Self {
        let (poses, focus) = views.unzip();
        Self { poses, focus }
    }
}

/// Draws the poses, one a view.
pub fn draw(options: &PhotographedOptions) -> Path {
    let mut rng = Stream::Motion.of(options.seed);
    let rng = &mut rng;
    match options.motion {
        PhotographedMotion::Orbit => orbit(options, rng),
        PhotographedMotion::WalkAround => walk_around(options, rng),
        PhotographedMotion::HandHeld => hand_held(options, rng),
        PhotographedMotion::Corridor => corridor(options, rng),
        PhotographedMotion::Drive => drive(options, rng),
        PhotographedMotion::AerialGrid => aerial_grid(options, rng),
        PhotographedMotion::NearRotation | PhotographedMotion::PureRotation => on_the_spot(options, rng),
        PhotographedMotion::Translation => translation(options, rng),
        PhotographedMotion::PlanarScene => planar_scene(options, rng),
    }
}

/// Share of the way at a view: 0 at the first, 1 at the last.
fn along(options: &PhotographedOptions, view: usize) -> f64 {
    view as f64 / (options.views - 1) as f64
}

fn orbit(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let height = rng.random_range(0.1..0.6);
    let views = (0..options.views).map(|view| {
        let azimuth = options.turn_rad * along(options, view);
        let distance = DISTANCE * (1.0 + within(0.03, rng));
        let centre = about(azimuth, height + within(0.03, rng), distance);
        (shaken(looking(centre, Vector3::zeros()), 0.03, rng), Vector3::zeros())
    });
    Path::new(views)
}

fn walk_around(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let (phase, rise) = (rng.random_range(0.0..TAU), rng.random_range(0.0..TAU));
    let views = (0..options.views).map(|view| {
        let way = along(options, view);
        let step = 0.3 / options.views as f64;
        let azimuth = options.turn_rad * (way + within(step, rng));
        let distance = DISTANCE * (1.0 + 0.2 * (2.0 * azimuth + phase).sin());
        let height = 0.25 + 0.15 * (3.0 * azimuth + rise).sin();
        let focus = Vector3::from_fn(|_, _| within(0.4, rng));
        (shaken(looking(about(azimuth, height, distance), focus), 0.08, rng), Vector3::zeros())
    });
    Path::new(views)
}

fn hand_held(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let focus = Vector3::new(0.0, 0.0, DISTANCE);
    let views = (0..options.views).map(|_| {
        let centre = Vector3::new(within(1.2, rng), within(0.5, rng), within(0.6, rng));
        let at = focus + Vector3::new(within(0.6, rng), within(0.4, rng), 0.0);
        (shaken(looking(centre, at), options.turn_rad, rng), focus)
    });
    Path::new(views)
}

fn corridor(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let (period, phase) = (rng.random_range(8.0..20.0), rng.random_range(0.0..TAU));
    let views = (0..options.views).map(|view| {
        let swing = (TAU * view as f64 / period + phase).sin();
        let centre = Vector3::new(0.3 * swing + within(0.05, rng), within(0.05, rng), CORRIDOR_STEP * view as f64);
        let yaw = options.turn_rad * (1.3 * TAU * view as f64 / period).sin();
        let ahead = Vector3::new(yaw.sin(), 0.0, yaw.cos()) * DISTANCE;
        (shaken(looking(centre, centre + ahead), 0.03, rng), centre + Vector3::z() * DISTANCE)
    });
    Path::new(views)
}

fn drive(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    // Three bends at most, each over a fifth of the way; their turns sum up to the whole.
    let bends: Vec<(f64, f64)> = (0..3).map(|_| (rng.random_range(0.1..0.9), rng.random_range(-0.3..1.0))).collect();
    let sum: f64 = bends.iter().map(|(_, turn)| turn.abs()).sum();
    let heading = |way: f64| {
        let bent = bends.iter().map(|(at, turn)| turn / sum * smooth_step((way - at) / 0.2 + 0.5));
        options.turn_rad * bent.sum::<f64>()
    };
    let mut centre = Vector3::zeros();
    let mut views = Vec::new();
    for view in 0..options.views {
        let heading = heading(along(options, view));
        let ahead = Vector3::new(heading.sin(), 0.0, heading.cos());
        let bumped = centre + Vector3::from_fn(|_, _| within(0.03, rng));
        views.push((shaken(looking(bumped, bumped + ahead), 0.015, rng), bumped + ahead * AHEAD));
        centre += ahead * DRIVE_STEP * (1.0 + within(0.2, rng));
    }
    Path::new(views.into_iter())
}

/// The ground is the plane `z = 0`, the camera above it at negative `z`.
fn aerial_grid(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let nadir = options.views.div_ceil(2);
    let width = DISTANCE * f64::from(IMAGE_SIZE.width_px) / options.focal_px;
    let height = width * f64::from(IMAGE_SIZE.height_px) / f64::from(IMAGE_SIZE.width_px);
    let views = (0..options.views).map(|view| {
        let (oblique, place, count) =
            if view < nadir { (false, view, nadir) } else { (true, view - nadir, options.views - nadir) };
        let columns = (count as f64).sqrt().ceil() as usize;
        let lines = count.div_ceil(columns);
        // A line back and a line forth; about the middle of the area.
        let (line, step) = (place / columns, place % columns);
        let step = if line % 2 == 1 { columns - 1 - step } else { step };
        let forth = (step as f64 - 0.5 * (columns - 1) as f64) * ALONG * height;
        let aside = (line as f64 - 0.5 * (lines - 1) as f64) * ACROSS * width;
        let (forth, aside) = (forth + within(0.03, rng) * height, aside + within(0.03, rng) * width);
        let (yaw, tilt) = if oblique { (FRAC_PI_2, options.turn_rad) } else { (0.0, 0.0) };
        let flight = Vector3::new(yaw.cos(), yaw.sin(), 0.0);
        let focus = flight * forth + Vector3::z().cross(&flight) * aside;
        let height = DISTANCE * (1.0 + within(0.02, rng));
        let centre = focus - Vector3::z() * height - flight * height * tilt.tan();
        // The top of the image is ahead.
        let forward = (focus - centre).normalize();
        let right = forward.cross(&flight).normalize();
        let rotation = Matrix3::from_rows(&[right.transpose(), forward.cross(&right).transpose(), forward.transpose()]);
        (shaken(pose(rotation, centre), 0.03, rng), focus)
    });
    Path::new(views)
}

fn on_the_spot(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let focus = Vector3::new(0.0, 0.0, DISTANCE);
    let reach = match options.motion {
        PhotographedMotion::NearRotation => options.baseline * DISTANCE,
        _ => 0.0,
    };
    let views = (0..options.views).map(|_| {
        let centre = Vector3::from_fn(|_, _| within(reach, rng));
        let turn = options.turn_rad;
        let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), within(0.5 * turn, rng))
            * Rotation3::from_axis_angle(&Vector3::x_axis(), within(0.6 * turn, rng))
            * Rotation3::from_axis_angle(&Vector3::y_axis(), within(turn, rng));
        (pose(*rotation.matrix(), centre), focus)
    });
    Path::new(views)
}

fn translation(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let turn = Vector3::from_fn(|_, _| within(0.3, rng));
    let rotation = *Rotation3::from_scaled_axis(turn).matrix();
    let focus = rotation.transpose() * Vector3::new(0.0, 0.0, DISTANCE);
    let views = (0..options.views).map(|_| {
        let centre = Vector3::new(within(1.0, rng), within(0.7, rng), within(0.7, rng));
        (pose(rotation, centre), focus)
    });
    Path::new(views)
}

/// The plane is `z = 0`, seen from negative `z`.
fn planar_scene(options: &PhotographedOptions, rng: &mut ChaCha8Rng) -> Path {
    let views = (0..options.views).map(|_| {
        let tilt = within(options.turn_rad, rng);
        let direction = rng.random_range(0.0..TAU);
        let distance = DISTANCE * (1.0 + within(0.25, rng));
        let focus = Vector3::new(within(0.7, rng), within(0.7, rng), 0.0);
        let away = Vector3::new(tilt.sin() * direction.cos(), tilt.sin() * direction.sin(), -tilt.cos());
        let roll = *Rotation3::from_axis_angle(&Vector3::z_axis(), within(0.5, rng)).matrix();
        let Pose { rotation, translation } = looking(focus + away * distance, focus);
        (Pose { rotation: roll * rotation, translation: roll * translation }, Vector3::zeros())
    });
    Path::new(views)
}

/// A place about the origin, `y` down.
fn about(azimuth: f64, height: f64, distance: f64) -> Vector3<f64> {
    distance * Vector3::new(height.cos() * azimuth.sin(), -height.sin(), -height.cos() * azimuth.cos())
}

/// A camera at a place that looks at another one, upright: `y` of the world is down.
fn looking(centre: Vector3<f64>, at: Vector3<f64>) -> Pose {
    let forward = (at - centre).normalize();
    let right = Vector3::y().cross(&forward).normalize();
    let down = forward.cross(&right);
    pose(Matrix3::from_rows(&[right.transpose(), down.transpose(), forward.transpose()]), centre)
}

fn pose(rotation: Matrix3<f64>, centre: Vector3<f64>) -> Pose {
    Pose { rotation, translation: -(rotation * centre) }
}

/// The same camera, turned by up to so much about each of its axes.
fn shaken(camera: Pose, most_rad: f64, rng: &mut ChaCha8Rng) -> Pose {
    let turn = *Rotation3::from_scaled_axis(Vector3::from_fn(|_, _| within(most_rad, rng))).matrix();
    Pose { rotation: turn * camera.rotation, translation: turn * camera.translation }
}

/// Uniform between `-most` and `most`.
pub fn within(most: f64, rng: &mut ChaCha8Rng) -> f64 {
    most * rng.random_range(-1.0..1.0)
}

/// From 0 to 1 while `x` does so, with level ends.
fn smooth_step(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}
