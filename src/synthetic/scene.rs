//! The generator: a random cloud, random cameras with one calibration, noise, and tracks whose points are exchanged.

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::domain::error::{InvalidInput, Violation, Violations};
use crate::domain::{ImageSize, RawInput, View};

/// Side of the square images in pixels (paper, section 5.1).
pub const IMAGE_SIDE_PX: u32 = 1000;
/// Range of the focal length in pixels (paper, section 5.1).
pub const FOCAL_RANGE_PX: (f64, f64) = (800.0, 1600.0);
/// Depth below which a point would be in or behind the camera; the camera is drawn again.
const MIN_DEPTH: f64 = 0.5;
/// Cameras drawn for one view before the options are called impossible.
const MAX_DRAWS: usize = 10_000;
/// Rotations above this carry the scene out of view unless the camera orbits it.
const ORBIT_ABOVE_RAD: f64 = 0.5;
/// Centre of the cloud in front of the first camera.
const SCENE_CENTRE: [f64; 3] = [0.0, 0.0, 3.0];

/// What to generate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneOptions {
    pub views: usize,
    pub tracks: usize,
    /// Standard deviation of the noise as a share of the image width.
    pub noise: f64,
    /// Share of the tracks that are outliers.
    pub outliers: f64,
    /// Largest rotation about each axis, in radians; above 0.5 the cameras orbit the scene.
    pub max_rotation_rad: f64,
    /// Whether projective depths are part of the input.
    pub with_depths: bool,
    pub seed: u64,
}

impl Default for SceneOptions {
    /// The paper's centre of all sweeps, without depths.
    fn default() -> Self {
        Self { views: 10, tracks: 200, noise: 0.003, outliers: 0.9, max_rotation_rad: 0.4, with_depths: false, seed: 0 }
    }
}

impl SceneOptions {
    /// Views and tracks that one scene may have, so that a slip of the finger does not fill the memory.
    pub const MAX_VIEWS: usize = 1_000;
    pub const MAX_TRACKS: usize = 100_000;

    /// Checks every option.
    ///
    /// # Errors
    /// Each violation names its option.
    pub fn validate(&self) -> Result<(), InvalidInput> {
        let mut found = Violations::default();
        if !(2..=Self::MAX_VIEWS).contains(&self.views) {
            found.push(Violation::of("views", format!("{} is not in 2..={}", self.views, Self::MAX_VIEWS)));
        }
        if !(1..=Self::MAX_TRACKS).contains(&self.tracks) {
            found.push(Violation::of("tracks", format!("{} is not in 1..={}", self.tracks, Self::MAX_TRACKS)));
        }
        if !(0.0..=1.0).contains(&self.noise) {
            found.push(Violation::of("noise", format!("{} is not a share in 0..=1 of the width", self.noise)));
        }
        if !(0.0..=1.0).contains(&self.outliers) {
            found.push(Violation::of("outliers", format!("{} is not a share in 0..=1", self.outliers)));
        }
        if !(0.0..=std::f64::consts::PI).contains(&self.max_rotation_rad) {
            found.push(Violation::of("rotation", format!("{} is not in 0..=pi", self.max_rotation_rad)));
        }
        found.into_result()
    }
}

/// What a scene was made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    pub focal_px: f64,
    pub principal_point_px: [f64; 2],
    /// One entry a track.
    pub inlier: Vec<bool>,
    /// World points, one a track.
    pub points: Vec<[f64; 3]>,
    /// World-to-camera rotations (row by row) and translations, one a view.
    pub rotations: Vec<[[f64; 3]; 3]>,
    pub translations: Vec<[f64; 3]>,
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
    /// Points are uniform in `[-1, 1] x [-1, 1] x [2, 4]`, rotations uniform in `+-max_rotation_rad` about each axis,
    /// translations uniform in `[-1, 1]^3`. Outliers: in every view, the image points (and depths) of the outlier
    /// tracks are exchanged among each other by a random permutation. Points may fall outside the image, as in the
    /// paper.
    ///
    /// # Errors
    /// Options out of range, or a rotation for which no camera sees the whole cloud.
    pub fn generate(options: &SceneOptions) -> Result<Self, InvalidInput> {
        options.validate()?;
        let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
        let focal_px = rng.random_range(FOCAL_RANGE_PX.0..FOCAL_RANGE_PX.1);
        let centre_px = (f64::from(IMAGE_SIDE_PX) - 1.0) / 2.0;
        let points: Vec<Vector3<f64>> = (0..options.tracks)
            .map(|_| Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(2.0..4.0)))
            .collect();
        let mut cameras = Vec::with_capacity(options.views);
        for _ in 0..options.views {
            cameras.push(draw_camera(&points, options.max_rotation_rad, &mut rng)?);
        }
        let mut outliers: Vec<usize> = (0..options.tracks).collect();
        outliers.shuffle(&mut rng);
        outliers.truncate((options.outliers * options.tracks as f64).round() as usize);
        outliers.sort_unstable();

        let mut input = RawInput { track_count: options.tracks, ..RawInput::default() };
        for (view, (rotation, translation)) in cameras.iter().enumerate() {
            input.views.push(View {
                size: Some(ImageSize { width_px: IMAGE_SIDE_PX, height_px: IMAGE_SIDE_PX }),
                ..View::default()
            });
            let mut image: Vec<[f64; 3]> = points
                .iter()
                .map(|point| {
                    let seen = rotation * point + translation;
                    let noise_px = options.noise * f64::from(IMAGE_SIDE_PX);
                    [
                        focal_px * seen.x / seen.z + centre_px + noise_px * standard_normal(&mut rng),
                        focal_px * seen.y / seen.z + centre_px + noise_px * standard_normal(&mut rng),
                        seen.z * (1.0 + options.noise * standard_normal(&mut rng)),
                    ]
                })
                .collect();
            let mut exchanged = outliers.clone();
            exchanged.shuffle(&mut rng);
            let original = image.clone();
            for (&to, &from) in outliers.iter().zip(&exchanged) {
                image[to] = original[from];
            }
            for (track, [x, y, depth]) in image.into_iter().enumerate() {
                input.view.push(view as u32);
                input.track.push(track as u32);
                input.x.push(x);
                input.y.push(y);
                if options.with_depths {
                    input.depth.push(depth);
                }
            }
        }
        let mut inlier = vec![true; options.tracks];
        for &track in &outliers {
            inlier[track] = false;
        }
        let truth = Truth {
            focal_px,
            principal_point_px: [centre_px, centre_px],
            inlier,
            points: points.iter().map(|point| (*point).into()).collect(),
            rotations: cameras.iter().map(|(rotation, _)| rows(rotation)).collect(),
            translations: cameras.iter().map(|(_, translation)| (*translation).into()).collect(),
        };
        Ok(Self { options: options.clone(), input, truth })
    }
}

fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
}

/// A camera that has every point at least [`MIN_DEPTH`] in front of it.
fn draw_camera(
    points: &[Vector3<f64>],
    max_rotation_rad: f64,
    rng: &mut ChaCha8Rng,
) -> Result<(Matrix3<f64>, Vector3<f64>), InvalidInput> {
    for _ in 0..MAX_DRAWS {
        let mut angle =
            || if max_rotation_rad > 0.0 { rng.random_range(-max_rotation_rad..max_rotation_rad) } else { 0.0 };
        let (about_x, about_y, about_z) = (angle(), angle(), angle());
        let rotation = Rotation3::from_axis_angle(&Vector3::x_axis(), about_x)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), about_y)
            * Rotation3::from_axis_angle(&Vector3::z_axis(), about_z);
        let mut translation =
            Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
        if max_rotation_rad > ORBIT_ABOVE_RAD {
            let centre = Vector3::from(SCENE_CENTRE);
            translation += centre - rotation * centre;
        }
        if points.iter().all(|point| (rotation * point + translation).z > MIN_DEPTH) {
            return Ok((*rotation.matrix(), translation));
        }
    }
    Err(Violation::of("rotation", format!("no camera sees the whole scene with rotations up to {max_rotation_rad}"))
        .into())
}

/// Box-Muller; one of the pair is enough here.
fn standard_normal(rng: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Input, Limits};

    #[test]
    fn inliers_project_to_their_observations_and_outliers_do_not() {
        let options = SceneOptions { noise: 0.0, with_depths: true, ..SceneOptions::default() };
        let scene = Scene::generate(&options).expect("valid options");
        let input = Input::new(scene.input.clone(), &Limits::default(), "scene").expect("valid scene");
        let mut far = vec![0usize; options.tracks];
        for k in 0..input.observation_count() {
            let (view, track) = (input.view_of(k), input.track_of(k));
            let rotation = Matrix3::from_fn(|row, column| scene.truth.rotations[view][row][column]);
            let seen =
                rotation * Vector3::from(scene.truth.points[track]) + Vector3::from(scene.truth.translations[view]);
            let [px, py] = scene.truth.principal_point_px;
            let x = scene.truth.focal_px * seen.x / seen.z + px;
            let y = scene.truth.focal_px * seen.y / seen.z + py;
            let [u, v] = input.point_px(k);
            if (x - u).hypot(y - v) > 1e-9 {
                far[track] += 1;
            }
        }
        let near: Vec<bool> = far.iter().map(|&views| views == 0).collect();
        assert_eq!(near, scene.truth.inlier);
        assert_eq!(scene.truth.inlier.iter().filter(|&&inlier| inlier).count(), 20);
    }

    #[test]
    fn one_seed_one_scene() {
        let generate =
            |seed| Scene::generate(&SceneOptions { seed, ..SceneOptions::default() }).expect("valid").input.x;
        assert_eq!(generate(3), generate(3));
        assert_ne!(generate(3), generate(4));
    }

    #[test]
    fn an_orbit_is_possible() {
        let options = SceneOptions { max_rotation_rad: 3.1, ..SceneOptions::default() };
        assert!(Scene::generate(&options).is_ok());
    }
}
