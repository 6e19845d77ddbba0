//! Writing OpenSfM's reconstruction.json and camera_models.json (mapillary/OpenSfM, `doc/source/dataset.rst`,
//! `opensfm/io.py`).

use std::collections::{HashMap, HashSet};

use serde_json::{Map, Value, json};

use super::{frame, shot_names};
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
    let names = CameraNames::of(models);
    models.iter().zip(shot_names(models)).map(|(model, shots)| reconstruction(model, &names, shots)).collect()
}

/// `camera_models.json`: every camera of the reconstructions under its name in these.
pub fn camera_models(models: &[Model]) -> Value {
    Value::Object(CameraNames::of(models).cameras)
}

fn reconstruction(model: &Model, names: &CameraNames, shots: Vec<String>) -> Value {
    let names = names.of_model(model);
    let cameras: Map<String, Value> =
        names.iter().zip(&model.cameras).map(|(name, camera)| ((*name).to_owned(), self::camera(camera))).collect();
    let shots: Map<String, Value> =
        shots.into_iter().zip(&model.images).map(|(name, image)| (name, shot(image, names[image.camera]))).collect();
    let points: Map<String, Value> = point_names(model).into_iter().zip(model.points.iter().map(point)).collect();
    json!({ "cameras": cameras, "shots": shots, "points": points })
}

/// What the points of a model are called: those of the tracks, which come first, like these.
pub(super) fn point_names(model: &Model) -> Vec<String> {
    let mut taken = HashSet::with_capacity(model.points.len());
    let name = |point: &Point| {
        let mut name = point.label.to_string();
        while !taken.insert(name.clone()) {
            name.push('+');
        }
        name
    };
    model.points.iter().map(name).collect()
}

/// Cameras of all parts by name: the data set's own where it is that of one camera, else numbered from 1.
#[derive(Default)]
struct CameraNames {
    cameras: Map<String, Value>,
    /// By the camera as the file has it and the data set's name of it.
    names: HashMap<(String, Option<Box<str>>), String>,
}

impl CameraNames {
    fn of(models: &[Model]) -> Self {
        let mut names = Self::default();
        let mut numbered = (1..).map(|number| format!("scpsfm camera {number}"));
        for of in models.iter().flat_map(|model| &model.cameras) {
            let json = camera(of);
            let key = (json.to_string(), of.opensfm_name.clone());
            if names.names.contains_key(&key) {
                continue;
            }
            let own = of.opensfm_name.as_deref().map(str::to_owned);
            let mut candidates = own.into_iter().chain(numbered.by_ref());
            // The numbers do not end.
            let name = candidates.find(|name| !names.cameras.contains_key(name)).unwrap_or_default();
            names.cameras.insert(name.clone(), json);
            names.names.insert(key, name);
        }
        names
    }

    /// The names of a model's cameras.
    fn of_model(&self, model: &Model) -> Vec<&str> {
        let name = |of: &Camera| {
            // Every camera was given a name.
            self.names.get(&(camera(of).to_string(), of.opensfm_name.clone())).map_or("", String::as_str)
        };
        model.cameras.iter().map(name).collect()
    }
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

fn shot(image: &Image, camera: &str) -> Value {
    let rotation: [f64; 3] = image.rotation.scaled_axis().into();
    json!({
        "camera": camera,
        "rotation": rotation,
        "translation": image.translation,
    })
}

fn point(point: &Point) -> Value {
    json!({ "coordinates": point.position, "color": point.colour })
}
