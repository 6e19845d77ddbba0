//! The generator: a random cloud, random cameras, noise, and wrong tracks. One file a subject: where the points lie
//! (`shape`), how the cameras move (`motion`) and project (`camera`), which views observe a track (`visibility`), what
//! is wrong with the tracks (`contamination`, `second_body`), the noise.

mod camera;
mod contamination;
mod motion;
mod noise;
mod options;
mod second_body;
mod shape;
pub(super) mod stream;
#[cfg(test)]
mod tests;
mod visibility;

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

pub(super) use self::camera::{Camera, Lens, rows};
use self::contamination::Contamination;
pub use self::contamination::OutlierKind;
pub(super) use self::contamination::slide;
pub use self::motion::Motion;
pub(super) use self::motion::Pose;
pub use self::noise::NoiseKind;
use self::noise::Observation;
pub(super) use self::noise::normal;
pub use self::options::SceneOptions;
pub(super) use self::options::check_focal_range;
pub use self::shape::Shape;
use self::stream::Stream;
use crate::domain::error::InvalidInput;
use crate::domain::{ImageSize, RawInput, View};

/// Side of the square images in pixels (paper, section 5.1).
pub const IMAGE_SIDE_PX: u32 = 1000;
/// Range of the focal length in pixels (paper, section 5.1).
pub const FOCAL_RANGE_PX: (f64, f64) = (800.0, 1600.0);
/// Where every view has a camera of its own: how far the principal points are from the common one along each axis, as a
/// share of the width, and the distortions from the common one, relatively, as among copies of one camera.
const OWN_PRINCIPAL_POINT: f64 = 0.02;
const OWN_RADIAL_K1: f64 = 0.05;

/// What a scene was made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// The focal length of all views; with a zoom, the middle of its range.
    pub focal_px: f64,
    /// One entry a view.
    #[serde(default)]
    pub focals_px: Vec<f64>,
    pub principal_point_px: [f64; 2],
    /// The same of each view, and its radial distortion: those of all, unless every view has its own camera.
    #[serde(default)]
    pub principal_points_px: Vec<[f64; 2]>,
    #[serde(default)]
    pub radial_k1: Vec<f64>,
    /// Whether a track is all right, one entry a track.
    pub inlier: Vec<bool>,
    /// Whether a track belongs to the second body, one entry a track; such a track is no inlier.
    #[serde(default)]
    pub second_body: Vec<bool>,
    /// Whether an observation is that of its track's own point on the first body, one entry an observation in the order
    /// of the scene's input: by view, then by track.
    #[serde(default)]
    pub observation_right: Vec<bool>,
    /// World points, one a track; of the second body, where they would be without its motion.
    pub points: Vec<[f64; 3]>,
    /// World-to-camera rotations (row by row) and translations, one a view.
    pub rotations: Vec<[[f64; 3]; 3]>,
    pub translations: Vec<[f64; 3]>,
}

impl Truth {
    /// Whether the observation of this track in this view is right, in a scene whose tracks are complete.
    ///
    /// # Panics
    /// When there is no such view or track.
    pub fn is_right(&self, view: usize, track: usize) -> bool {
        self.observation_right[view * self.inlier.len() + track]
    }
}

/// A generated scene.
#[derive(Debug, Clone)]
pub struct Scene {
    pub options: SceneOptions,
    pub input: RawInput,
    pub truth: Truth,
}

impl Scene {
    /// Generates the scene of these options; the same options give the same scene.
    ///
    /// Unless asked for otherwise every track is observed in every view, also where its point falls outside the image,
    /// as in the paper.
    ///
    /// # Errors
    /// Options out of range, or under which no camera sees the whole cloud.
    pub fn generate(options: &SceneOptions) -> Result<Self, InvalidInput> {
        options.validate()?;
        let mut rng = Stream::Paper.of(options.seed);
        let focal_px = draw_focal_px(options.focal_range_px, &mut rng);
        let points = shape::draw_points(options, &mut rng);
        let cameras = draw_cameras(options, focal_px, &points, &mut rng)?;
        let visible = visibility::draw_visibility(options, &cameras);
        let mut contamination = Contamination::draw(options, &visible, &mut rng);
        let second_body = contamination.second_body().to_vec();
        let body_motions = second_body::draw_motions(options, &cameras, &points, &second_body)?;

        let mut input = RawInput { track_count: options.tracks, ..RawInput::default() };
        let mut deleted_rng = Stream::DeletedObservations.of(options.seed);
        let count = options.deleted_observations;
        let deleted = contamination::draw_observations(options.views, &visible, count, &mut deleted_rng);
        let is_kept = |view: usize, track: usize| visible[track].contains(&view) && !deleted[view][track];
        let mut observation_right = Vec::with_capacity(options.views * options.tracks);
        for (view, (camera, motion)) in cameras.iter().zip(&body_motions).enumerate() {
            let observe = |(point, &second)| {
                let image = if second { camera.project(&motion.apply(point)) } else { camera.project(point) };
                Observation::draw(image, !second, options.noise_kind, &mut rng)
            };
            let mut image: Vec<Observation> = points.iter().zip(&second_body).map(observe).collect();
            contamination.apply(view, &cameras, &points, &mut image, &mut rng);
            let kept = || image.iter().enumerate().filter(|&(track, _)| is_kept(view, track));
            observation_right.extend(kept().map(|(_, observation)| observation.right));
            let noisy = kept().map(|(track, observation)| (track, observation.noisy(options)));
            append(&mut input, noisy, options.with_depths);
        }
        let truth = Truth {
            focal_px,
            focals_px: cameras.iter().map(|camera| camera.focal_px).collect(),
            principal_point_px: principal_point_px(options),
            principal_points_px: cameras.iter().map(|camera| camera.principal_point_px).collect(),
            radial_k1: cameras.iter().map(|camera| camera.lens.k1()).collect(),
            inlier: contamination.inlier(),
            second_body,
            observation_right,
            points: points.iter().map(|point| (*point).into()).collect(),
            rotations: cameras.iter().map(|camera| rows(&camera.pose.rotation)).collect(),
            translations: cameras.iter().map(|camera| camera.pose.translation.into()).collect(),
        };
        if options.own_cameras {
            input.views.iter_mut().zip(0..).for_each(|(view, group)| view.camera_group = group);
        }
        Ok(Self { options: options.clone(), input, truth })
    }
}

/// A focal length of a range. One that is known takes a random number as well, so that all else stays as it is.
pub(super) fn draw_focal_px((least, most): (f64, f64), rng: &mut ChaCha8Rng) -> f64 {
    if least < most {
        return rng.random_range(least..most);
    }
    let _: f64 = rng.random();
    least
}

fn principal_point_px(options: &SceneOptions) -> [f64; 2] {
    let side_px = f64::from(IMAGE_SIDE_PX);
    options.principal_point.map(|displacement| (side_px - 1.0) / 2.0 + displacement * side_px)
}

/// Draws the cameras, one a view; the zoom and what each has for itself from streams of their own.
///
/// # Errors
/// Options under which no camera sees the whole cloud.
fn draw_cameras(
    options: &SceneOptions,
    focal_px: f64,
    points: &[Vector3<f64>],
    rng: &mut ChaCha8Rng,
) -> Result<Vec<Camera>, InvalidInput> {
    let lens = Lens::of_k1(options.radial_k1);
    let principal_point_px = principal_point_px(options);
    let mut zoom_rng = Stream::Zoom.of(options.seed);
    let mut own_rng = Stream::OwnCameras.of(options.seed);
    let mut own = |pose| {
        let focal_px = draw_focal_px(options.focal_range_px, &mut own_rng);
        let mut shift = || own_rng.random_range(-1.0..1.0);
        let [x, y, bend] = [shift(), shift(), shift()];
        let shift_px = OWN_PRINCIPAL_POINT * f64::from(IMAGE_SIDE_PX);
        Camera {
            pose,
            focal_px,
            aspect: 1.0,
            principal_point_px: [principal_point_px[0] + shift_px * x, principal_point_px[1] + shift_px * y],
            lens: Lens::of_k1(options.radial_k1 * (1.0 + OWN_RADIAL_K1 * bend)),
        }
    };
    let mut pose_camera = |pose| {
        if options.own_cameras {
            return own(pose);
        }
        let zoom = options.zoom * zoom_rng.random_range(-1.0..1.0);
        Camera { pose, focal_px: focal_px * (1.0 + zoom), aspect: 1.0, principal_point_px, lens }
    };
    Ok(motion::draw_poses(options, points, lens, rng)?.into_iter().map(&mut pose_camera).collect())
}

/// Appends a view with its observations, each with its track.
fn append(input: &mut RawInput, image: impl Iterator<Item = (usize, [f64; 3])>, with_depths: bool) {
    let view = input.views.len() as u32;
    let size = ImageSize { width_px: IMAGE_SIDE_PX, height_px: IMAGE_SIDE_PX };
    input.views.push(View { size: Some(size), ..View::default() });
    for (track, [x, y, depth]) in image {
        input.view.push(view);
        input.track.push(track as u32);
        input.x.push(x);
        input.y.push(y);
        if with_depths {
            input.depth.push(depth);
        }
    }
}
