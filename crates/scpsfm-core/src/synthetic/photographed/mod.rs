//! Scenes as people photograph them: cameras with a lens and an image border that move as a photographer, a car or a
//! drone does, tracks that some of the views show, and wrong tracks of the kinds that feature matching makes. One file
//! a subject: the options, how they are drawn from a seed, the motion, the points, the lens, which views observe a
//! point, the noise, and what is wrong.

mod draw;
mod lens;
pub mod long;
mod motion;
mod noise;
mod options;
mod points;
mod second_body;
mod stream;
#[cfg(test)]
mod tests;
mod visibility;
mod wrong;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

pub use self::noise::effective_noise;
pub use self::options::{FocalKind, LensKind, PhotographedMotion, PhotographedOptions, VisibilityKind, WrongKind};
use self::stream::Stream;
use super::scene::{Camera, rows};
use crate::domain::error::InvalidInput;
use crate::domain::{ImageSize, RawInput, View};

/// Size of all images.
pub const IMAGE_SIZE: ImageSize = ImageSize { width_px: 1600, height_px: 1200 };
/// Right observations that make a track verifiable: two agree on a point whatever they show.
pub const VERIFIABLE: usize = 3;

/// What a scene was made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotographedTruth {
    /// True focal length of each view (along x), and its camera group.
    pub focals_px: Vec<f64>,
    pub camera_groups: Vec<u32>,
    pub principal_point_px: [f64; 2],
    /// Whether most observations of a track are right; one entry a track.
    pub inlier: Vec<bool>,
    /// Whether a track belongs to the second rigid body; such a track is no inlier.
    pub second_body: Vec<bool>,
    /// Whether an observation is that of its track's own point in the scene; one entry an observation, in the input's
    /// order.
    pub observation_right: Vec<bool>,
    /// Whether an observation is that of the other point that its track goes over to.
    pub observation_of_other: Vec<bool>,
    /// World points, one a track; of the second body, in its own frame.
    pub points: Vec<[f64; 3]>,
    /// World-to-camera rotations (row by row) and translations, one a view.
    pub rotations: Vec<[[f64; 3]; 3]>,
    pub translations: Vec<[f64; 3]>,
}

impl PhotographedTruth {
    /// Where the camera of each view is, in the world.
    pub fn centres(&self) -> Vec<Vector3<f64>> {
        let poses = self.rotations.iter().zip(&self.translations);
        let centre = |(rotation, translation): (&[[f64; 3]; 3], &[f64; 3])| {
            let rotation = Matrix3::from_fn(|row, column| rotation[row][column]);
            -(rotation.tr_mul(&Vector3::from(*translation)))
        };
        poses.map(centre).collect()
    }

    /// Whether each observation is right and of a track with [`VERIFIABLE`] right ones.
    ///
    /// * `track`: the track of each observation
    pub fn verifiable(&self, track: &[u32]) -> Vec<bool> {
        let mut count = vec![0; self.inlier.len()];
        let right = || self.observation_right.iter().zip(track);
        right().filter(|(right, _)| **right).for_each(|(_, &track)| count[track as usize] += 1);
        right().map(|(&right, &track)| right && count[track as usize] >= VERIFIABLE).collect()
    }
}

/// A generated scene.
#[derive(Debug, Clone)]
pub struct Photographed {
    pub options: PhotographedOptions,
    pub input: RawInput,
    pub truth: PhotographedTruth,
}

/// A track in the making.
#[derive(Debug, Clone)]
struct Track {
    /// Of the second body, in its own frame.
    point: Vector3<f64>,
    second_body: bool,
    /// In the order of the views.
    seen: Vec<Seen>,
}

/// One observation of a track.
#[derive(Debug, Clone, Copy)]
struct Seen {
    view: usize,
    /// Exact image of what the observation shows, in pixels.
    image: [f64; 2],
    right: bool,
    /// Whether it shows the other point of a track that joins two.
    of_other: bool,
    /// Factor on its noise.
    noise: f64,
}

impl Photographed {
    /// Generates the scene of these options; the same options give the same scene.
    ///
    /// # Errors
    /// Options out of range, or a motion under which no two views see a common point.
    pub fn generate(options: &PhotographedOptions) -> Result<Self, InvalidInput> {
        options.validate()?;
        let path = motion::draw(options);
        let cameras = lens::cameras(options, &path);
        let mut tracks = visibility::draw_tracks(options, &cameras)?;
        wrong::apply(options, &path, &cameras, &mut tracks);
        Ok(assemble(options, &cameras, &tracks))
    }
}

/// The input and the truth, by track, then by view.
fn assemble(options: &PhotographedOptions, cameras: &[Camera], tracks: &[Track]) -> Photographed {
    let camera_groups = lens::camera_groups(options);
    let views =
        camera_groups.iter().map(|&camera_group| View { size: Some(IMAGE_SIZE), camera_group, ..View::default() });
    let mut input = RawInput { views: views.collect(), track_count: tracks.len(), ..RawInput::default() };
    let mut truth = PhotographedTruth {
        focals_px: cameras.iter().map(|camera| camera.focal_px).collect(),
        camera_groups,
        principal_point_px: cameras[0].principal_point_px,
        inlier: Vec::new(),
        second_body: tracks.iter().map(|track| track.second_body).collect(),
        observation_right: Vec::new(),
        observation_of_other: Vec::new(),
        points: tracks.iter().map(|track| track.point.into()).collect(),
        rotations: cameras.iter().map(|camera| rows(&camera.pose.rotation)).collect(),
        translations: cameras.iter().map(|camera| camera.pose.translation.into()).collect(),
    };
    let mut rng = Stream::Noise.of(options.seed);
    for (index, track) in tracks.iter().enumerate() {
        let right = track.seen.iter().filter(|seen| seen.right).count();
        truth.inlier.push(2 * right > track.seen.len());
        for seen in &track.seen {
            let [in_x, in_y] = noise::draw(options, &mut rng);
            input.view.push(seen.view as u32);
            input.track.push(index as u32);
            input.x.push(seen.image[0] + seen.noise * in_x);
            input.y.push(seen.image[1] + seen.noise * in_y);
            truth.observation_right.push(seen.right);
            truth.observation_of_other.push(seen.of_other);
        }
    }
    Photographed { options: options.clone(), input, truth }
}
