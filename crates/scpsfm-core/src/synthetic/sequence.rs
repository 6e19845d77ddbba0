//! Sequences: a camera that travels, and tracks that live a few views each, as real ones do.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::scene::{FOCAL_RANGE_PX, IMAGE_SIDE_PX, SceneOptions, check_focal_range, draw_focal_px, normal, rows};
use crate::domain::error::{InvalidInput, Violation, Violations};
use crate::domain::{ImageSize, RawInput, View};

/// Way from view to view, in the units of the depths below: over ten views the nearest points cross a third of the
/// image.
const STEP: f64 = 0.15;
/// Depths of the points, in the frame of the middle one of the views that see them.
const DEPTH: (f64, f64) = (3.0, 9.0);
/// Swings of the camera about x, y and z, in radians, and their periods in views: without a common divisor, so that no
/// two stretches look alike.
const SWING_RAD: [f64; 3] = [0.2, 0.35, 0.3];
const PERIOD_VIEWS: [f64; 3] = [17.0, 23.0, 31.0];
/// Swing of the path across its direction.
const WEAVE: f64 = 0.3;
/// Views that show either point of a track that joins two: three make a point that can be verified.
const LEAST_SHOWN: usize = 3;
/// Stream of the random numbers that the zoom is drawn from; the rest comes from the first.
const ZOOM_STREAM: u64 = 1;
/// Draws of one point before its views are called impossible.
const MOST_DRAWS: usize = 1_000;

options! {
    /// What to generate.
    #[derive(Serialize, Deserialize)]
    #[serde(default)]
    pub struct SequenceOptions {
        views: usize = 20,
        tracks: usize = 1_000,
        /// Views that a track lives, uniform between the two.
        lifetime: (usize, usize) = (3, 10),
        /// Standard deviation of the noise as a share of the image width.
        noise: f64 = 0.0005,
        /// Share of the tracks that are wrong: each observation is anywhere in its image.
        outliers: f64 = 0.3,
        /// Share of the observations of the other tracks that are anywhere in their image.
        #[serde(alias = "wrong_observations")]
        wrong_share: f64 = 0.05,
        /// Share of the right tracks, of those that are long enough, that go over to another point on their way: one
        /// wrong link joins two points.
        joined: f64 = 0.0,
        /// Radial distortion, as in [`SceneOptions::radial_k1`].
        radial_k1: f64 = 0.0,
        /// Range of the focal length in pixels; equal ends fix it.
        focal_range_px: (f64, f64) = FOCAL_RANGE_PX,
        /// The focal length of each view is uniform in `f (1 +- zoom)`; 0: one focal length for all.
        #[serde(default)]
        zoom: f64 = 0.0,
        /// Whether the focal length grows steadily over that range instead.
        #[serde(default)]
        ramp: bool = false,
        /// Views, the first ones, in which the camera travels and does not turn: what they show is the same under a
        /// wrong calibration.
        #[serde(default)]
        straight: usize = 0,
        seed: u64 = 0,
    }
}

impl Default for SequenceOptions {
    /// A short walk: tracks and noise as feature matching gives them.
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl SequenceOptions {
    /// Views that a track lives where nothing else is asked for: as feature matching gives them, and never more than
    /// there are views.
    pub fn lifetime_within(views: usize) -> (usize, usize) {
        (3.min(views), 10.min(views))
    }

    /// Tracks that one sequence may have: some 10^7 observations.
    pub const MAX_TRACKS: usize = 2_000_000;

    /// Checks every option.
    ///
    /// # Errors
    /// Each violation names its option.
    pub fn validate(&self) -> Result<(), InvalidInput> {
        let mut found = Violations::default();
        if !(2..=SceneOptions::MAX_VIEWS).contains(&self.views) {
            found.push(Violation::of("views", format!("{} is not in 2..={}", self.views, SceneOptions::MAX_VIEWS)));
        }
        if !(1..=Self::MAX_TRACKS).contains(&self.tracks) {
            found.push(Violation::of("tracks", format!("{} is not in 1..={}", self.tracks, Self::MAX_TRACKS)));
        }
        let (least, most) = self.lifetime;
        if least < 2 || most < least || most > self.views {
            let reason = format!("{least} to {most} is not a range within 2..={}, the views", self.views);
            found.push(Violation::of("lifetime", reason));
        }
        let shares = [
            ("noise", self.noise),
            ("outliers", self.outliers),
            ("wrong_share", self.wrong_share),
            ("joined", self.joined),
        ];
        for (name, share) in shares {
            if !(0.0..=1.0).contains(&share) {
                found.push(Violation::of(name, format!("{share} is not a share in 0..=1")));
            }
        }
        if self.straight > self.views {
            found.push(Violation::of("straight", format!("{} is not in 0..={}, the views", self.straight, self.views)));
        }
        check_focal_range(self.focal_range_px, &mut found);
        let limit = SceneOptions::MAX_RADIAL_K1;
        if !(-limit..=limit).contains(&self.radial_k1) {
            found.push(Violation::of("radial_k1", format!("{} is not in -{limit}..={limit}", self.radial_k1)));
        }
        if !(0.0..=SceneOptions::MAX_ZOOM).contains(&self.zoom) {
            let reason = format!("{} is not a share in 0..={}", self.zoom, SceneOptions::MAX_ZOOM);
            found.push(Violation::of("zoom", reason));
        }
        found.into_result()
    }
}

/// What a sequence was made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SequenceTruth {
    /// The focal length of all views; with a zoom, the middle of its range.
    pub focal_px: f64,
    /// One entry a view.
    #[serde(default)]
    pub focals_px: Vec<f64>,
    pub principal_point_px: [f64; 2],
    /// Whether a track is of one point, but for single wrong observations; one entry a track.
    pub inlier: Vec<bool>,
    /// Whether an observation is that of its track's point; one entry an observation, in the input's order. A track
    /// that joins two points has the one that it shows more often, the first of equals.
    pub observation_right: Vec<bool>,
    /// Whether an observation is that of the other point that its track joins.
    #[serde(default)]
    pub observation_of_other: Vec<bool>,
    pub points: Vec<[f64; 3]>,
    /// World-to-camera rotations (row by row) and translations, one a view.
    pub rotations: Vec<[[f64; 3]; 3]>,
    pub translations: Vec<[f64; 3]>,
}

/// A generated sequence.
#[derive(Debug, Clone)]
pub struct Sequence {
    pub options: SequenceOptions,
    pub input: RawInput,
    pub truth: SequenceTruth,
}

/// A point, the first view of its track and its exact images there and in the next ones, in image sides about the
/// centre.
struct Track {
    point: Vector3<f64>,
    first: usize,
    images: Vec<Vector2<f64>>,
}

struct Camera {
    rotation: Matrix3<f64>,
    centre: Vector3<f64>,
    /// In image sides.
    focal: f64,
}

impl Sequence {
    /// Generates the sequence of these options; the same options give the same sequence.
    ///
    /// # Errors
    /// Options out of range.
    pub fn generate(options: &SequenceOptions) -> Result<Self, InvalidInput> {
        options.validate()?;
        let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
        let focal_px = draw_focal_px(options.focal_range_px, &mut rng);
        let focal = focal_px / f64::from(IMAGE_SIDE_PX);
        let mut cameras: Vec<Camera> =
            (0..options.views).map(|view| camera(view, rng.random_range(-0.05..0.05), focal)).collect();
        if let Some(last) = options.straight.checked_sub(1) {
            let rotation = cameras[last].rotation;
            cameras[..last].iter_mut().for_each(|camera| camera.rotation = rotation);
        }
        // A stream of its own: a zoom changes nothing else.
        let mut zoom = ChaCha8Rng::seed_from_u64(options.seed);
        zoom.set_stream(ZOOM_STREAM);
        for (view, camera) in cameras.iter_mut().enumerate() {
            let drawn = zoom.random_range(-1.0..1.0);
            let along = 2.0 * view as f64 / (options.views - 1) as f64 - 1.0;
            camera.focal *= 1.0 + options.zoom * if options.ramp { along } else { drawn };
        }
        let centre_px = (f64::from(IMAGE_SIDE_PX) - 1.0) / 2.0;
        let size = ImageSize { width_px: IMAGE_SIDE_PX, height_px: IMAGE_SIDE_PX };
        let mut input = RawInput {
            views: vec![View { size: Some(size), ..View::default() }; options.views],
            track_count: options.tracks,
            ..RawInput::default()
        };
        let mut truth = SequenceTruth {
            focal_px,
            focals_px: cameras.iter().map(|camera| camera.focal * f64::from(IMAGE_SIDE_PX)).collect(),
            principal_point_px: [centre_px; 2],
            inlier: Vec::with_capacity(options.tracks),
            observation_right: Vec::new(),
            observation_of_other: Vec::new(),
            points: Vec::with_capacity(options.tracks),
            rotations: cameras.iter().map(|camera| rows(&camera.rotation)).collect(),
            translations: cameras.iter().map(|camera| (-(camera.rotation * camera.centre)).into()).collect(),
        };
        for track in 0..options.tracks {
            let mut drawn = draw_track(options, &cameras, &mut rng)?;
            let inlier = rng.random::<f64>() >= options.outliers;
            let joins = inlier && options.joined > 0.0 && rng.random::<f64>() < options.joined;
            let other = if joins { drawn.join_another(options, &cameras, &mut rng) } else { 0..0 };
            let Track { point, first, images } = drawn;
            truth.inlier.push(inlier);
            truth.points.push(point.into());
            for (k, image) in images.iter().enumerate() {
                let right = inlier && rng.random::<f64>() >= options.wrong_share;
                let of_other = other.contains(&k);
                let seen = if right { image + options.noise * normals(&mut rng) } else { anywhere(&mut rng) };
                let [x, y] = (seen * f64::from(IMAGE_SIDE_PX)).into();
                input.view.push((first + k) as u32);
                input.track.push(track as u32);
                input.x.push(x + centre_px);
                input.y.push(y + centre_px);
                truth.observation_right.push(right && !of_other);
                truth.observation_of_other.push(right && of_other);
            }
        }
        Ok(Self { options: options.clone(), input, truth })
    }
}

fn camera(view: usize, jitter: f64, focal: f64) -> Camera {
    let at = |k: usize| SWING_RAD[k] * (TAU * view as f64 / PERIOD_VIEWS[k]).sin();
    let rotation = Rotation3::from_euler_angles(at(0), at(1) + jitter, at(2));
    let along = view as f64;
    let weave = |k: usize| WEAVE * (TAU * along / PERIOD_VIEWS[k]).cos();
    Camera { rotation: *rotation.matrix(), centre: Vector3::new(STEP * along, weave(0), weave(1)), focal }
}

fn draw_track(options: &SequenceOptions, cameras: &[Camera], rng: &mut ChaCha8Rng) -> Result<Track, InvalidInput> {
    for _ in 0..MOST_DRAWS {
        let length = rng.random_range(options.lifetime.0..=options.lifetime.1);
        let first = rng.random_range(0..=cameras.len() - length);
        if let Some((point, images)) = draw_point(options, &cameras[first..first + length], rng) {
            return Ok(Track { point, first, images });
        }
    }
    Err(Violation::of("lifetime", format!("no point stays in view for {} views", options.lifetime.1)).into())
}

/// A point before the middle one of these views, with its exact images in them; `None` if one of them does not see it.
fn draw_point(
    options: &SequenceOptions,
    cameras: &[Camera],
    rng: &mut ChaCha8Rng,
) -> Option<(Vector3<f64>, Vec<Vector2<f64>>)> {
    let middle = &cameras[cameras.len() / 2];
    let uv = anywhere(rng) / middle.focal;
    let point = middle.centre + middle.rotation.tr_mul(&(uv.push(1.0) * rng.random_range(DEPTH.0..DEPTH.1)));
    let image = |camera: &Camera| {
        let seen = camera.rotation * (point - camera.centre);
        let uv = seen.xy() / seen.z;
        let image = camera.focal * uv * (1.0 + options.radial_k1 * uv.norm_squared());
        // Beyond the fold a lens images two points in one place.
        let one_to_one = 1.0 + 3.0 * options.radial_k1 * uv.norm_squared() > 0.0;
        (seen.z > DEPTH.0 / 2.0 && image.amax() < 0.5 && one_to_one).then_some(image)
    };
    let images: Option<Vec<Vector2<f64>>> = cameras.iter().map(image).collect();
    Some((point, images?))
}

impl Track {
    /// Goes over to another point between two views, [`LEAST_SHOWN`] of which show either; returns which observations
    /// show the point that is not the track's then. A track that is too short stays as it is.
    fn join_another(
        &mut self,
        options: &SequenceOptions,
        cameras: &[Camera],
        rng: &mut ChaCha8Rng,
    ) -> std::ops::Range<usize> {
        let length = self.images.len();
        if length < 2 * LEAST_SHOWN {
            return 0..0;
        }
        let cut = rng.random_range(LEAST_SHOWN..=length - LEAST_SHOWN);
        let later = &cameras[self.first + cut..self.first + length];
        let drawn = (0..MOST_DRAWS).find_map(|_| draw_point(options, later, rng));
        let Some((other, images)) = drawn else { return 0..0 };
        self.images.truncate(cut);
        self.images.extend(images);
        if 2 * cut >= length {
            return cut..length;
        }
        self.point = other;
        0..cut
    }
}

/// Uniform over the image, in image sides about its centre.
fn anywhere(rng: &mut ChaCha8Rng) -> Vector2<f64> {
    Vector2::new(rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5))
}

/// Two independent standard normal numbers.
fn normals(rng: &mut ChaCha8Rng) -> Vector2<f64> {
    let (radius, angle) = (rng.random(), rng.random::<f64>());
    // Box-Muller's pair: the cosine of an angle, and its sine as the cosine a quarter of a turn back.
    Vector2::new(normal(radius, angle), normal(radius, angle - 0.25))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Input, Limits};

    #[test]
    fn tracks_live_as_long_as_asked_and_right_ones_reproject() {
        let options = SequenceOptions {
            views: 60,
            tracks: 500,
            radial_k1: -0.1,
            zoom: 0.2,
            seed: 4,
            ..SequenceOptions::default()
        };
        let Sequence { input, truth, .. } = Sequence::generate(&options).expect("valid");
        assert_eq!(Sequence::generate(&options).expect("valid").input.x, input.x, "one seed, one sequence");
        let mut lengths = vec![0; 500];
        let (mut right, mut squared) = (0.0, 0.0);
        for k in 0..input.x.len() {
            let (view, track) = (input.view[k] as usize, input.track[k] as usize);
            lengths[track] += 1;
            if !truth.observation_right[k] {
                continue;
            }
            let rotation = Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
            let seen = rotation * Vector3::from(truth.points[track]) + Vector3::from(truth.translations[view]);
            let uv = seen.xy() / seen.z;
            let image = truth.focals_px[view] * uv * (1.0 + options.radial_k1 * uv.norm_squared())
                + Vector2::from(truth.principal_point_px);
            right += 1.0;
            squared += (image - Vector2::new(input.x[k], input.y[k])).norm_squared();
        }
        let rms: f64 = (squared / right / 2.0f64).sqrt();
        assert!((rms - 0.5).abs() < 0.02, "noise of {rms} px instead of .5");
        assert!(lengths.iter().all(|length| (3..=10).contains(length)));
        let inliers = truth.inlier.iter().filter(|&&inlier| inlier).count();
        assert!((320..=380).contains(&inliers), "{inliers} of 500 for a share of .7");
        assert!(Input::new(input, &Limits::default(), "sequence").is_ok());
    }

    #[test]
    fn a_ramp_grows_steadily_over_the_range_and_leaves_the_rest() {
        let options = SequenceOptions { zoom: 0.2, ramp: true, ..SequenceOptions::default() };
        let truth = Sequence::generate(&options).expect("valid").truth;
        let steps: Vec<f64> = truth.focals_px.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(steps.iter().all(|step| (step - 0.4 * truth.focal_px / 19.0).abs() < 1e-9), "{steps:?}");
        assert!((truth.focals_px[19] / truth.focals_px[0] - 1.5).abs() < 1e-12);
        let drawn = Sequence::generate(&SequenceOptions { ramp: false, ..options }).expect("valid").truth;
        assert_eq!(drawn.rotations, truth.rotations);
    }

    #[test]
    fn views_that_go_straight_do_not_turn() {
        let options = SequenceOptions { straight: 12, ..SequenceOptions::default() };
        let rotations = Sequence::generate(&options).expect("valid").truth.rotations;
        assert!(rotations[..12].iter().all(|rotation| *rotation == rotations[0]));
        assert!(rotations[11..].windows(2).all(|pair| pair[0] != pair[1]));
    }

    #[test]
    fn every_option_out_of_range_is_named() {
        let default = SequenceOptions::default;
        let cases = [
            ("views", SequenceOptions { views: 1, lifetime: (2, 1), ..default() }),
            ("tracks", SequenceOptions { tracks: 0, ..default() }),
            ("lifetime", SequenceOptions { lifetime: (1, 3), ..default() }),
            ("lifetime", SequenceOptions { lifetime: (3, 30), ..default() }),
            ("noise", SequenceOptions { noise: f64::NAN, ..default() }),
            ("outliers", SequenceOptions { outliers: 1.1, ..default() }),
            ("wrong_share", SequenceOptions { wrong_share: -0.1, ..default() }),
            ("joined", SequenceOptions { joined: 2.0, ..default() }),
            ("radial_k1", SequenceOptions { radial_k1: 2.0, ..default() }),
            ("zoom", SequenceOptions { zoom: 1.0, ..default() }),
            ("straight", SequenceOptions { straight: 21, ..default() }),
        ];
        for (name, options) in cases {
            let error = options.validate().expect_err(name);
            assert_eq!(error.violations()[0].field, name, "{error}");
        }
        assert_eq!(default().validate(), Ok(()));
        for views in 2..20 {
            let options = SequenceOptions { views, lifetime: SequenceOptions::lifetime_within(views), ..default() };
            assert_eq!(options.validate(), Ok(()), "{views} views");
        }
    }
}
