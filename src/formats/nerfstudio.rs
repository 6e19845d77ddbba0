//! Writing nerfstudio's `transforms.json` (nerfstudio, `docs/quickstart/data_conventions.md`).
//!
//! Cameras are OpenCV's: coefficients are those of our model. Poses lead from camera to world, with the axes of OpenGL:
//! x to the right, y up, z backwards. A principal point is measured from the corner of the image, where the centre of
//! the top-left pixel is (.5, .5).

use serde_json::{Map, Value, json};

use super::colmap::FIRST_PIXEL;
use super::metric::{Camera, Image, Model};
use crate::domain::LensProjection;

/// Why a model cannot be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error("perspective lenses and fisheyes do not go into one transforms.json")]
    TwoProjections,
}

/// Name of the file with the points, beside `transforms.json`.
pub const POINTS: &str = "points.ply";

/// `transforms.json` of a model. Where all images share one camera, its intrinsics stand once, else at every frame.
///
/// # Errors
/// The file has one lens projection for all its cameras.
pub fn transforms(model: &Model) -> Result<Value, Error> {
    let projection = |camera: &Camera| camera.intrinsics.lens_projection;
    let mut projections = model.cameras.iter().map(projection);
    let first = projections.next().unwrap_or_default();
    if projections.any(|other| other != first) {
        return Err(Error::TwoProjections);
    }
    let mut file = Map::new();
    let name = match first {
        LensProjection::Perspective => "OPENCV",
        LensProjection::Fisheye => "OPENCV_FISHEYE",
    };
    file.insert("camera_model".into(), name.into());
    let is_shared = model.cameras.len() == 1;
    if let Some(camera) = model.cameras.first().filter(|_| is_shared) {
        file.extend(intrinsics(camera));
    }
    let frame = |image: &Image| {
        let mut frame = if is_shared { Map::new() } else { intrinsics(&model.cameras[image.camera]) };
        frame.insert("file_path".into(), image.name.to_string().into());
        frame.insert("transform_matrix".into(), json!(camera_to_world(image)));
        Value::Object(frame)
    };
    file.insert("frames".into(), model.images.iter().map(frame).collect());
    if !model.points.is_empty() {
        file.insert("ply_file_path".into(), POINTS.into());
    }
    Ok(Value::Object(file))
}

fn intrinsics(camera: &Camera) -> Map<String, Value> {
    let of = &camera.intrinsics;
    let [cx, cy] = of.principal_point_px.map(|centre| centre + FIRST_PIXEL);
    let mut fields: Map<String, Value> = [
        ("w", camera.size.width_px.into()),
        ("h", camera.size.height_px.into()),
        ("fl_x", of.focal_px.into()),
        ("fl_y", (of.aspect * of.focal_px).into()),
        ("cx", cx.into()),
        ("cy", cy.into()),
        ("k1", of.radial_k1.into()),
        ("k2", of.radial_k2.into()),
        ("k3", of.radial_k3.into()),
        // A fourth radial term, which our model does not have.
        ("k4", 0.0.into()),
    ]
    .map(|(name, value): (&str, Value)| (name.to_owned(), value))
    .into_iter()
    .collect();
    if of.lens_projection == LensProjection::Perspective {
        fields.insert("p1".into(), of.tangential_p1.into());
        fields.insert("p2".into(), of.tangential_p2.into());
    }
    fields
}

/// `[R' | -R' t]` with y and z of the camera turned round, row by row, and a last row `0 0 0 1`.
fn camera_to_world(image: &Image) -> [[f64; 4]; 4] {
    let back = image.rotation.inverse().to_rotation_matrix();
    let centre = -(back * nalgebra::Vector3::from(image.translation));
    let row = |axis: usize| [back[(axis, 0)], -back[(axis, 1)], -back[(axis, 2)], centre[axis]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

#[cfg(test)]
#[path = "nerfstudio_tests.rs"]
mod tests;
