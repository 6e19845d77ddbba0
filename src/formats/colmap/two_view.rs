//! Two-view geometries of the matches that a result keeps, from its cameras: what COLMAP's geometric verification would
//! have found among them.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix3x4, Rotation3, Unit, UnitQuaternion, Vector3};

use super::FIRST_PIXEL;
use super::intrinsics::pinhole;
use crate::domain::result::ViewResult;
use crate::domain::{Calibration, Solution};
use crate::formats::LabelledInput;
use crate::formats::metric::shown;
use crate::matrix_of_cameras;

/// Matches in all, 8 bytes each in memory and in the file. As many are read of a database at most.
const MOST_MATCHES: usize = super::database::MAX_MATCHES;
/// Distance of two camera centres, as a share of their translations, below which they coincide but for rounding.
const SAME_CENTRE: f64 = 1e-12;

/// Matches of two images and what relates these.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Ids of the images, ascending.
    pub images: [u32; 2],
    /// Keypoints of the first and of the second image.
    pub matches: Vec<[u32; 2]>,
    pub geometry: Geometry,
}

/// What relates two images; matrices in COLMAP's pixels, lens distortion undone.
#[derive(Debug, Clone, PartialEq)]
pub enum Geometry {
    /// `x2' F x1 = 0`, and the pose of the second camera in the frame of the first, its translation of length 1.
    Calibrated {
        fundamental: Matrix3<f64>,
        essential: Matrix3<f64>,
        rotation: UnitQuaternion<f64>,
        translation: Vector3<f64>,
    },
    /// `x2 ~ H x1`: the cameras have one centre.
    Panoramic {
        homography: Matrix3<f64>,
        rotation: Option<UnitQuaternion<f64>>,
    },
    Uncalibrated {
        fundamental: Matrix3<f64>,
    },
}

/// The pairs of images that see a point together, with every match between observations of one point, found by the
/// descriptors or not; those between images far apart on long tracks are left out where there would be too many.
///
/// Empty where the result has no cameras, and for an input without COLMAP's keypoints.
pub fn pairs(solution: &Solution, input: &LabelledInput) -> Vec<Pair> {
    let camera = |view: &ViewResult| Camera::of(view, solution.calibration_of(view.camera_group));
    let cameras: Vec<Option<Camera>> = solution.views.iter().map(camera).collect();
    let matches = matches(solution, input, &cameras);
    let of_pair = |(views, matches): ([u32; 2], Vec<[u32; 2]>)| {
        let [first, second] = views.map(|view| view as usize);
        let geometry = Geometry::between(cameras[first].as_ref()?, cameras[second].as_ref()?)?;
        let images = [first, second].map(|view| input.colmap_images[view].id);
        Some(Pair { images, matches, geometry })
    };
    matches.into_iter().filter_map(of_pair).collect()
}

/// Matches by pair of views; the image of the first has the smaller id.
fn matches(
    solution: &Solution,
    input: &LabelledInput,
    cameras: &[Option<Camera>],
) -> BTreeMap<[u32; 2], Vec<[u32; 2]>> {
    let raw = &input.raw;
    let mut of_points: Vec<(usize, u32, u32)> = (0..raw.x.len().min(input.keypoints.len()))
        .filter(|&k| matches!(cameras.get(raw.view[k] as usize), Some(Some(_))))
        .filter(|&k| input.colmap_images.len() > raw.view[k] as usize)
        .filter_map(|k| Some((shown(solution, input, k)?, raw.view[k], input.keypoints[k])))
        .collect();
    of_points.sort_unstable();
    let tracks: Vec<&[(usize, u32, u32)]> = of_points.chunk_by(|a, b| a.0 == b.0).collect();
    let reach = reach(tracks.iter().map(|track| track.len()), MOST_MATCHES);
    let mut matches: BTreeMap<[u32; 2], Vec<[u32; 2]>> = BTreeMap::new();
    for track in tracks {
        for (place, &(_, view, keypoint)) in track.iter().enumerate() {
            for &(_, other_view, other) in track[place + 1..].iter().take(reach) {
                let id = |view: u32| input.colmap_images[view as usize].id;
                let (views, keypoints) = match id(view) < id(other_view) {
                    true => ([view, other_view], [keypoint, other]),
                    false => ([other_view, view], [other, keypoint]),
                };
                matches.entry(views).or_default().push(keypoints);
            }
        }
    }
    matches
}

/// How many of the observations that follow one on its track are matched with it, so that there are at most `most`
/// matches.
fn reach(lengths: impl Iterator<Item = usize> + Clone, most: usize) -> usize {
    let count = |reach: usize| -> usize {
        let of_track = |length: usize| {
            let whole = length.saturating_sub(reach);
            let rest = length - whole;
            // The last `rest` observations have 0 to `rest - 1` behind them.
            whole * reach + rest * rest.saturating_sub(1) / 2
        };
        lengths.clone().map(of_track).sum()
    };
    let mut reach = lengths.clone().max().unwrap_or(0).max(1);
    while reach > 1 && count(reach) > most {
        reach /= 2;
    }
    reach
}

/// A registered view.
struct Camera {
    part: u32,
    projection: Matrix3x4<f64>,
    metric: Option<Metric>,
}

/// Calibration matrix in COLMAP's pixels, and pose.
struct Metric {
    intrinsics: Matrix3<f64>,
    rotation: Rotation3<f64>,
    translation: Vector3<f64>,
}

impl Camera {
    fn of(view: &ViewResult, calibration: Option<&Calibration>) -> Option<Self> {
        let rows = view.projection?;
        let shift = Matrix3::new(1.0, 0.0, FIRST_PIXEL, 0.0, 1.0, FIRST_PIXEL, 0.0, 0.0, 1.0);
        let projection = shift * Matrix3x4::from_fn(|row, column| rows[row][column]);
        let metric = || {
            let (rotation, translation, calibration) = (view.rotation?, view.translation?, calibration?);
            let own = Calibration { focal_px: view.focal_px.unwrap_or(calibration.focal_px), ..*calibration };
            let [fx, fy, cx, cy] = pinhole(&own);
            Some(Metric {
                intrinsics: Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
                rotation: Rotation3::from_matrix_unchecked(Matrix3::from_fn(|row, column| rotation[row][column])),
                translation: translation.into(),
            })
        };
        Some(Self { part: view.part, projection: projection / projection.norm(), metric: metric() })
    }
}

impl Geometry {
    /// `None`: the cameras are of different parts, or no finite matrix relates them.
    fn between(first: &Camera, second: &Camera) -> Option<Self> {
        if first.part != second.part {
            return None;
        }
        match (&first.metric, &second.metric) {
            (Some(first), Some(second)) => Self::of_poses(first, second),
            _ => Self::of_projections(&first.projection, &second.projection),
        }
    }

    fn of_poses(first: &Metric, second: &Metric) -> Option<Self> {
        let rotation = second.rotation * first.rotation.inverse();
        let translation = second.translation - rotation * first.translation;
        let back = first.intrinsics.try_inverse()?;
        let turned = UnitQuaternion::from_rotation_matrix(&rotation);
        if translation.norm() <= SAME_CENTRE * (first.translation.norm() + second.translation.norm()) {
            let homography = unit(second.intrinsics * rotation * back)?;
            return Some(Self::Panoramic { homography, rotation: Some(turned) });
        }
        let translation = Unit::new_normalize(translation).into_inner();
        let essential = translation.cross_matrix() * rotation.matrix();
        let fundamental = unit(second.intrinsics.try_inverse()?.transpose() * essential * back)?;
        Some(Self::Calibrated { fundamental, essential, rotation: turned, translation })
    }

    fn of_projections(first: &Matrix3x4<f64>, second: &Matrix3x4<f64>) -> Option<Self> {
        let fundamental = matrix_of_cameras(first, second);
        if fundamental.norm() > SAME_CENTRE {
            return Some(Self::Uncalibrated { fundamental: unit(fundamental)? });
        }
        let left = |camera: &Matrix3x4<f64>| camera.fixed_columns::<3>(0).into_owned();
        let homography = unit(left(second) * left(first).try_inverse()?)?;
        Some(Self::Panoramic { homography, rotation: None })
    }
}

/// The matrix with a Frobenius norm of 1; `None` where it is zero or not finite.
fn unit(matrix: Matrix3<f64>) -> Option<Matrix3<f64>> {
    let norm = matrix.norm();
    (norm.is_finite() && norm > 0.0).then(|| matrix / norm)
}

#[cfg(test)]
#[path = "two_view_tests.rs"]
mod tests;
