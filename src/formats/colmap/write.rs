//! Writing a COLMAP sparse model, text and binary (COLMAP, `reconstruction_io_{text,binary}.cc`).
//!
//! An image's keypoints are those of the database or the model that was read, all of them and under their indices, or
//! else the input's observations of it, outliers too, in the order of the input; a point's colour is that of its
//! weight. Rigs and frames are in [`super::write_frames`].

use std::fmt::Write;

use super::cameras::Model as CameraModel;
use super::{FIRST_PIXEL, intrinsics};
use crate::formats::metric::{Image, Model, Point};

/// What the text files begin with; other programs write other comments.
const CAMERAS_TXT: &str = "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n";
const IMAGES_TXT: &str = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as X Y POINT3D_ID\n";
const POINTS_TXT: &str = "# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX\n";
/// COLMAP's id of no point in space.
const NO_POINT: u64 = u64::MAX;

/// `cameras.bin`, `images.bin` and `points3D.bin`.
pub fn binary(model: &Model) -> [Vec<u8>; 3] {
    let mut cameras = count(model.cameras.len());
    for camera in &model.cameras {
        let (name, parameters) = intrinsics::parameters(&camera.intrinsics, camera.colmap_model);
        // The table has every name that `parameters` gives.
        let id = CameraModel::of_name(name).map_or(-1, |model| model.id) as i32;
        cameras.extend(camera.id.to_le_bytes());
        cameras.extend(id.to_le_bytes());
        cameras
            .extend([camera.size.width_px, camera.size.height_px].map(u64::from).map(u64::to_le_bytes).as_flattened());
        parameters.iter().for_each(|value| cameras.extend(value.to_le_bytes()));
    }
    let mut images = count(model.images.len());
    for image in &model.images {
        images.extend(image.id.to_le_bytes());
        pose(image).iter().for_each(|value| images.extend(value.to_le_bytes()));
        images.extend(model.cameras[image.camera].id.to_le_bytes());
        images.extend(image.name.to_string().into_bytes());
        images.push(0);
        images.extend(count(image.keypoints.len()));
        for keypoint in &image.keypoints {
            images.extend([keypoint.x, keypoint.y].map(|value| (value + FIRST_PIXEL).to_le_bytes()).as_flattened());
            images.extend(keypoint.point.map_or(NO_POINT, |point| model.points[point].id).to_le_bytes());
        }
    }
    let mut points = count(model.points.len());
    for point in &model.points {
        points.extend(point.id.to_le_bytes());
        points.extend(point.position.map(f64::to_le_bytes).as_flattened());
        points.extend(point.colour);
        points.extend(point.error_px.to_le_bytes());
        points.extend(count(point.seen.len()));
        for [image, keypoint] in track(point, model) {
            points.extend([image, keypoint].map(u32::to_le_bytes).as_flattened());
        }
    }
    [cameras, images, points]
}

pub(super) fn count(count: usize) -> Vec<u8> {
    (count as u64).to_le_bytes().to_vec()
}

/// `cameras.txt`, `images.txt` and `points3D.txt`.
pub fn text(model: &Model) -> [String; 3] {
    // Writing to a String cannot fail. A number is written with as many digits as bring it back.
    let mut cameras = String::from(CAMERAS_TXT);
    for camera in &model.cameras {
        let (name, parameters) = intrinsics::parameters(&camera.intrinsics, camera.colmap_model);
        let _ = write!(cameras, "{} {name} {} {}", camera.id, camera.size.width_px, camera.size.height_px);
        parameters.iter().for_each(|value| _ = write!(cameras, " {value}"));
        cameras.push('\n');
    }
    let mut images = String::from(IMAGES_TXT);
    for image in &model.images {
        let _ = write!(images, "{}", image.id);
        pose(image).iter().for_each(|value| _ = write!(images, " {value}"));
        let _ = writeln!(images, " {} {}", model.cameras[image.camera].id, image.name);
        for (k, keypoint) in image.keypoints.iter().enumerate() {
            let gap = if k == 0 { "" } else { " " };
            let _ = write!(images, "{gap}{} {} ", keypoint.x + FIRST_PIXEL, keypoint.y + FIRST_PIXEL);
            let _ = match keypoint.point {
                Some(point) => write!(images, "{}", model.points[point].id),
                None => write!(images, "-1"),
            };
        }
        images.push('\n');
    }
    let mut points = String::from(POINTS_TXT);
    for point in &model.points {
        let ([x, y, z], [red, green, blue]) = (point.position, point.colour);
        let _ = write!(points, "{} {x} {y} {z} {red} {green} {blue} {}", point.id, point.error_px);
        track(point, model).for_each(|[image, keypoint]| _ = write!(points, " {image} {keypoint}"));
        points.push('\n');
    }
    [cameras, images, points]
}

/// Rotation `w x y z` and translation, world to camera.
pub(super) fn pose(image: &Image) -> [f64; 7] {
    let (q, [x, y, z]) = (&image.rotation, image.translation);
    [q.w, q.i, q.j, q.k, x, y, z]
}

/// Ids of the images and positions of the keypoints that see a point.
fn track(point: &Point, model: &Model) -> impl Iterator<Item = [u32; 2]> {
    // An image has at most one keypoint an observation, which the limits hold within 32 bits.
    point.seen.iter().map(|&(image, keypoint)| [model.images[image].id, keypoint as u32])
}
