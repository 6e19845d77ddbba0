//! Writing OpenSfM's reconstruction.json (mapillary/OpenSfM, `doc/source/dataset.rst`, `opensfm/io.py`).

use serde_json::{Map, Value, json};

use super::frame;
use crate::domain::LensProjection;
use crate::formats::metric::{Camera, Image, Model, Point};

/// Distance of a principal point from the middle of the image below which it is the middle, in pixels: what is left of
/// a half when a middle is computed.
const MIDDLE_PX: f64 = 1e-6;

/// A list of reconstructions, one a part: cameras, shots and points.
///
/// Lengths of cameras are in units of the larger image side, the origin is the middle of the image; a shot's rotation
/// is an angle-axis vector, world to camera.
pub fn json(models: &[Model]) -> Value {
    models.iter().map(reconstruction).collect()
}

fn reconstruction(model: &Model) -> Value {
    let cameras: Map<String, Value> =
        model.cameras.iter().map(|camera| (camera_name(camera), self::camera(camera))).collect();
    let shots: Map<String, Value> =
        model.images.iter().map(|image| (image.name.to_string(), shot(image, model))).collect();
    let mut points = Map::new();
    // Those of the tracks come first: no name of another point may be that of a track.
    for point in &model.points {
        let mut name = point.label.to_string();
        while points.contains_key(&name) {
            name.push('+');
        }
        points.insert(name, self::point(point));
    }
    json!({ "cameras": cameras, "shots": shots, "points": points })
}

fn camera_name(camera: &Camera) -> String {
    format!("scpsfm camera {}", camera.id)
}

/// `perspective` or `fisheye` where the principal point is the middle, pixels are square and two radial coefficients
/// are all of the distortion, else `brown` or `fisheye_opencv`, whose coefficients are those of our model.
fn camera(camera: &Camera) -> Value {
    let intrinsics = &camera.intrinsics;
    let (middle_px, side_px) = frame(camera.size);
    let focal = intrinsics.focal_px / side_px;
    let [x, y] = intrinsics.principal_point_px;
    let offset_px = [x - middle_px[0], y - middle_px[1]];
    let is_middle = offset_px.iter().all(|offset| offset.abs() < MIDDLE_PX);
    let (width, height) = (camera.size.width_px, camera.size.height_px);
    let others = [intrinsics.radial_k3, intrinsics.tangential_p1, intrinsics.tangential_p2];
    let is_fisheye = intrinsics.lens_projection == LensProjection::Fisheye;
    if is_middle && intrinsics.aspect == 1.0 && others == [0.0; 3] {
        return json!({
            "projection_type": if is_fisheye { "fisheye" } else { "perspective" }, "width": width, "height": height,
            "focal": focal, "k1": intrinsics.radial_k1, "k2": intrinsics.radial_k2,
        });
    }
    let mut camera = json!({
        "projection_type": if is_fisheye { "fisheye_opencv" } else { "brown" }, "width": width, "height": height,
        "focal_x": focal, "focal_y": focal * intrinsics.aspect,
        "c_x": offset_px[0] / side_px, "c_y": offset_px[1] / side_px,
        "k1": intrinsics.radial_k1, "k2": intrinsics.radial_k2, "k3": intrinsics.radial_k3,
    });
    let last = match is_fisheye {
        // A fourth radial term, which our model does not have.
        true => vec![("k4", 0.0)],
        false => vec![("p1", intrinsics.tangential_p1), ("p2", intrinsics.tangential_p2)],
    };
    last.into_iter().for_each(|(name, value)| camera[name] = value.into());
    camera
}

fn shot(image: &Image, model: &Model) -> Value {
    let rotation: [f64; 3] = image.rotation.scaled_axis().into();
    json!({
        "camera": camera_name(&model.cameras[image.camera]),
        "rotation": rotation,
        "translation": image.translation,
    })
}

fn point(point: &Point) -> Value {
    json!({ "coordinates": point.position, "color": point.colour })
}
