//! A metric result as other programs' files need it: cameras, posed images, points with the keypoints that see them.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::LabelledInput;
use super::colmap::{FIRST_PIXEL, Frame};
use super::label::Label;
use super::ply::colour;
use super::result_json::{track_label, view_label};
use crate::domain::result::{TrackSplit, ViewResult};
use crate::domain::{Calibration, ImageSize, Solution};

/// Why a result cannot be exported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error(
        "the result is not metric: it has no focal length, no poses and no distances, which these files are made of"
    )]
    NotMetric,
    #[error("no view of the result has a pose")]
    NoPose,
}

/// Cameras, images and points of one part, in the pixels and the metric frame of that part.
#[derive(Debug)]
pub struct Model {
    /// See [`ViewResult::part`].
    pub part: u32,
    pub cameras: Vec<Camera>,
    pub images: Vec<Image>,
    pub points: Vec<Point>,
}

/// Intrinsics of images that share them, see [`Calibration`], and the images' size.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    pub id: u32,
    pub size: ImageSize,
    pub intrinsics: Calibration,
    /// COLMAP's model that the input gave the camera.
    pub colmap_model: Option<&'static str>,
    /// OpenSfM's name that the input gave the camera.
    pub opensfm_name: Option<Box<str>>,
}

/// A view with a pose, `x ~ K (R X + t)`.
#[derive(Debug)]
pub struct Image {
    pub id: u32,
    pub name: Label,
    /// COLMAP's frame of the image, where the input has one of its own for each.
    pub colmap_frame: Option<Frame>,
    /// Position among the cameras.
    pub camera: usize,
    pub rotation: UnitQuaternion<f64>,
    pub translation: [f64; 3],
    /// Every observation of the view in the order of the input, with the position of its point where it is right; where
    /// the input knows all keypoints of the image ([`LabelledInput::colmap_images`]), these, in their order.
    pub keypoints: Vec<Keypoint>,
}

/// An observation or another keypoint: pixels, and the position of its point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keypoint {
    pub x: f64,
    pub y: f64,
    /// The input's own index of it in the image; else its position.
    pub index: u32,
    pub point: Option<usize>,
}

/// A point that two images see or more: the own point of a track, or another that the track joins to it.
#[derive(Debug)]
pub struct Point {
    pub id: u64,
    /// The track's, for another point of it with `+` and the number behind.
    pub label: Label,
    /// 0: the track's own; else see [`TrackSplit::number`].
    pub number: u32,
    pub position: [f64; 3],
    pub colour: [u8; 3],
    /// Mean reprojection error over its keypoints, a distance.
    pub error_px: f64,
    /// Positions of the image and, in that, of the keypoint.
    pub seen: Vec<(usize, usize)>,
}

impl Model {
    /// The models of a metric result, one a part, the largest first.
    ///
    /// # Errors
    /// The result is not metric, or has no poses.
    pub fn of_parts(solution: &Solution, input: &LabelledInput) -> Result<Vec<Self>, Error> {
        if !solution.is_metric() {
            return Err(Error::NotMetric);
        }
        let models: Vec<Self> =
            (0..solution.part_count()).filter_map(|part| Self::new(solution, input, part)).collect();
        if models.is_empty() { Err(Error::NoPose) } else { Ok(models) }
    }

    /// The model of a part of a metric result; `None` where no view of it has a pose.
    fn new(solution: &Solution, input: &LabelledInput, part: u32) -> Option<Self> {
        let (cameras, mut images, image_of_view) = images(solution, input, part);
        if images.is_empty() {
            return None;
        }
        let points = points(solution, input, &image_of_view, &mut images);
        let mut model = Self { part, cameras, images, points };
        model.measure();
        Some(model)
    }

    /// Gives every point its error under these cameras. The residuals of the result are those of the projective
    /// reconstruction, which has more freedom and fits a little better.
    fn measure(&mut self) {
        for point in &mut self.points {
            let distance = |&(image, keypoint): &(usize, usize)| {
                let image = &self.images[image];
                let [x, y] = image.project(&self.cameras[image.camera], point.position);
                let seen = &image.keypoints[keypoint];
                (x - seen.x).hypot(y - seen.y)
            };
            point.error_px = point.seen.iter().map(distance).sum::<f64>() / point.seen.len() as f64;
        }
    }
}

impl Image {
    /// Where a point is imaged, in pixels.
    fn project(&self, camera: &Camera, position: [f64; 3]) -> [f64; 2] {
        let seen = self.rotation * Vector3::from(position) + Vector3::from(self.translation);
        let [x, y] = camera.intrinsics.distort(seen.x / seen.z, seen.y / seen.z);
        let Calibration { focal_px, principal_point_px: [px, py], aspect, .. } = camera.intrinsics;
        [focal_px * x + px, aspect * focal_px * y + py]
    }
}

/// What sets cameras apart: group, size, and the view that has its own focal length.
type CameraKey = (u32, u32, ImageKey, Option<usize>);
type ImageKey = Option<(u32, u32)>;

/// Cameras and images without keypoints of a part, and the image of each view.
fn images(solution: &Solution, input: &LabelledInput, part: u32) -> (Vec<Camera>, Vec<Image>, Vec<Option<usize>>) {
    let mut cameras = Vec::new();
    let mut known: BTreeMap<CameraKey, usize> = BTreeMap::new();
    let mut images: Vec<Image> = Vec::new();
    let mut image_of_view = vec![None; solution.views.len()];
    let mut own_groups = Vec::new();
    for (view, result) in solution.views.iter().enumerate().filter(|(_, result)| result.part == part) {
        let calibration = solution.calibration_of(result.camera_group);
        let (Some(rotation), Some(translation), Some(calibration)) = (result.rotation, result.translation, calibration)
        else {
            continue;
        };
        let size = input.raw.views.get(view).and_then(|view| view.size);
        let own_group = input.raw.views.get(view).map_or(0, |view| view.camera_group);
        let sides = size.map(|size| (size.width_px, size.height_px));
        let key = (result.camera_group, own_group, sides, result.focal_px.map(|_| view));
        let camera = *known.entry(key).or_insert_with(|| {
            cameras.push(Camera {
                colmap_model: input.colmap_images.get(view).and_then(|image| image.camera_model),
                opensfm_name: input.opensfm_cameras.get(view).cloned().flatten(),
                ..camera(cameras.len(), size, calibration, result)
            });
            own_groups.push(own_group);
            cameras.len() - 1
        });
        image_of_view[view] = Some(images.len());
        let of_colmap = input.colmap_images.get(view);
        images.push(Image {
            // Without ids of its own, an input's views are numbered from 1, as COLMAP does.
            id: of_colmap.map_or(view as u32 + 1, |image| image.id),
            name: view_label(solution, Some(input), view),
            colmap_frame: of_colmap.and_then(|image| image.frame),
            camera,
            rotation: quaternion(rotation),
            translation,
            keypoints: known_keypoints(input, view),
        });
    }
    if !input.colmap_images.is_empty() {
        take_back_ids(&mut cameras, &own_groups, input);
    }
    (cameras, images, image_of_view)
}

/// Cameras of COLMAP go back under their own ids; of one that became several, as many focal lengths do, the first does,
/// and the others get ids that are free.
fn take_back_ids(cameras: &mut [Camera], own_groups: &[u32], input: &LabelledInput) {
    let mut taken: BTreeSet<u32> = input.raw.views.iter().map(|view| view.camera_group).collect();
    let mut given = BTreeSet::new();
    let mut next = 1;
    for (camera, group) in cameras.iter_mut().zip(own_groups) {
        camera.id = match given.insert(*group) {
            true => *group,
            false => {
                while !taken.insert(next) {
                    next += 1;
                }
                next
            }
        };
    }
}

/// Every keypoint that the input knows of a view's image, of no point yet.
fn known_keypoints(input: &LabelledInput, view: usize) -> Vec<Keypoint> {
    let known = input.colmap_images.get(view).map(|image| image.keypoints.as_slice()).unwrap_or_default();
    let keypoint = |(index, at): (u32, &[f32; 2])| {
        let [x, y] = at.map(|px| f64::from(px) - FIRST_PIXEL);
        Keypoint { x, y, index, point: None }
    };
    (0..).zip(known).map(keypoint).collect()
}

/// Camera `position`; without a size, the principal point is taken as the middle.
fn camera(position: usize, size: Option<ImageSize>, calibration: &Calibration, view: &ViewResult) -> Camera {
    // A cast of a float saturates; an image has a pixel at least.
    let side = |principal: f64| ((2.0 * principal).round() as u32).saturating_add(1).max(1);
    let [x, y] = calibration.principal_point_px;
    Camera {
        id: position as u32 + 1,
        size: size.unwrap_or(ImageSize { width_px: side(x), height_px: side(y) }),
        intrinsics: Calibration { focal_px: view.focal_px.unwrap_or(calibration.focal_px), ..*calibration },
        colmap_model: None,
        opensfm_name: None,
    }
}

/// The rotation as a unit quaternion with a scalar part that is not negative.
fn quaternion(rows: [[f64; 3]; 3]) -> UnitQuaternion<f64> {
    let matrix = Matrix3::from_fn(|row, column| rows[row][column]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
    if rotation.w < 0.0 { UnitQuaternion::new_unchecked(-rotation.into_inner()) } else { rotation }
}

/// The points that two images of the part see or more, those that tracks join to their own at the end; hangs every
/// observation on its image.
fn points(
    solution: &Solution,
    input: &LabelledInput,
    image_of_view: &[Option<usize>],
    images: &mut [Image],
) -> Vec<Point> {
    let raw = &input.raw;
    let image_of = |k: usize| image_of_view.get(raw.view[k] as usize).copied().flatten();
    let mut seen_by = vec![0u32; raw.track_count + solution.splits.len()];
    for place in (0..raw.x.len()).filter(|&k| image_of(k).is_some()).filter_map(|k| shown(solution, input, k)) {
        seen_by[place] += 1;
    }
    let mut position_of = vec![None; seen_by.len()];
    let mut points = Vec::new();
    for place in (0..seen_by.len()).filter(|&place| seen_by[place] >= 2) {
        if let Some(point) = point(solution, input, place) {
            position_of[place] = Some(points.len());
            points.push(point);
        }
    }
    for k in 0..raw.x.len() {
        let Some(image) = image_of(k) else { continue };
        let point = shown(solution, input, k).and_then(|place| position_of[place]);
        let keypoint = place(&mut images[image].keypoints, input, k, point);
        if let Some(point) = point {
            points[point].seen.push((image, keypoint));
        }
    }
    number(&mut points, input);
    points
}

/// Puts an observation among the keypoints of its image: at its own place where the input knows all of them, else at
/// the end. Returns the place.
fn place(keypoints: &mut Vec<Keypoint>, input: &LabelledInput, k: usize, point: Option<usize>) -> usize {
    let index = input.keypoints.get(k).copied().unwrap_or(keypoints.len() as u32);
    let observation = Keypoint { x: input.raw.x[k], y: input.raw.y[k], index, point };
    let own = input.keypoints.get(k).map(|&own| own as usize).filter(|_| !input.colmap_images.is_empty());
    match own.filter(|&own| own < keypoints.len()) {
        Some(own) => {
            keypoints[own] = observation;
            own
        }
        None => {
            keypoints.push(observation);
            keypoints.len() - 1
        }
    }
}

/// Which point an observation shows: the index of its track for the track's own, behind all tracks the position among
/// the splits for another; `None`: none.
pub(super) fn shown(solution: &Solution, input: &LabelledInput, k: usize) -> Option<usize> {
    let track = input.raw.track[k];
    if solution.observations.inlier.get(k) == Some(&true) {
        return Some(track as usize);
    }
    let number = solution.observations.split.get(k).copied().filter(|number| *number > 0)?;
    let split = solution.splits.binary_search_by_key(&(track, number), |split| (split.track, split.number)).ok()?;
    Some(input.raw.track_count + split)
}

/// The point of this place, see [`shown`], without id, error and observations.
fn point(solution: &Solution, input: &LabelledInput, place: usize) -> Option<Point> {
    let (track, number, weight, position) = match place.checked_sub(input.raw.track_count) {
        None => {
            let weight = solution.tracks.weight.get(place).copied().unwrap_or(0.0);
            (place, 0, weight, solution.tracks.point.get(place).copied().flatten()?)
        }
        Some(split) => {
            let TrackSplit { track, number, weight, point } = *solution.splits.get(split)?;
            (track as usize, number, weight, point?)
        }
    };
    let label = match number {
        0 => track_label(Some(input), track),
        number => Label::Name(format!("{}+{number}", track_label(Some(input), track)).into()),
    };
    Some(Point { id: 0, label, number, position, colour: colour(weight), error_px: 0.0, seen: Vec::new() })
}

/// Ids of points: those of the tracks where all are numbers that COLMAP takes, else their positions from 1. A point
/// that is not its track's own gets one behind those of all tracks, right or wrong.
fn number(points: &mut [Point], input: &LabelledInput) {
    // COLMAP reads ids of text files as signed.
    const MOST: u64 = i64::MAX as u64;
    let of_tracks = || points.iter().filter(|point| point.number == 0);
    let own: Option<Vec<u64>> = of_tracks().map(|point| point.label.number()).collect();
    let count = of_tracks().count() as u64;
    let others = points.len() as u64 - count;
    let largest = input.track_labels.iter().filter_map(Label::number).max().unwrap_or(0);
    let (own, last) = match own {
        Some(own) if largest <= MOST - others => (own, largest),
        _ => ((1..=count).collect(), count),
    };
    for (point, id) in points.iter_mut().zip(own.into_iter().chain(last + 1..)) {
        point.id = id;
    }
}
