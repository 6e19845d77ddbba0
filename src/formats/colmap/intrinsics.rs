//! Our intrinsics as parameters of COLMAP's camera models (`src/colmap/sensor/models.h`), whose coefficients are those
//! of our model.

use super::FIRST_PIXEL;
use crate::domain::{Calibration, LensProjection};

/// Models of perspective lenses and of fisheyes, those with fewer parameters first. The last of each says everything
/// that our model can say.
const PERSPECTIVE: [&str; 6] = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"];
const FISHEYE: [&str; 3] = ["SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"];

/// Model and parameters of a camera: the model that the input gave it where that can say the same, so that a program
/// that goes on refines what it would have refined, else the one with the fewest parameters that can.
pub(super) fn parameters(intrinsics: &Calibration, own: Option<&'static str>) -> (&'static str, Vec<f64>) {
    let (models, most) = match intrinsics.lens_projection {
        LensProjection::Perspective => (&PERSPECTIVE[..], "FULL_OPENCV"),
        LensProjection::Fisheye => (&FISHEYE[..], "OPENCV_FISHEYE"),
    };
    let own = own.filter(|own| models.contains(own));
    let mut tried = own.into_iter().chain(models.iter().copied());
    let said = tried.find_map(|model| Some((model, under(model, intrinsics)?)));
    said.unwrap_or_else(|| (most, every_parameter(intrinsics)))
}

/// The parameters of a model of the lens's projection; `None`: it cannot say the same.
fn under(model: &str, intrinsics: &Calibration) -> Option<Vec<f64>> {
    let [fx, fy, cx, cy] = pinhole(intrinsics);
    let Calibration { radial_k1: k1, radial_k2: k2, radial_k3: k3, tangential_p1: p1, tangential_p2: p2, .. } =
        *intrinsics;
    let is_square = intrinsics.aspect == 1.0;
    let are_zero = |values: &[f64]| values.iter().all(|value| *value == 0.0);
    match model {
        "SIMPLE_PINHOLE" if is_square && are_zero(&[k1, k2, k3, p1, p2]) => Some(vec![fx, cx, cy]),
        "PINHOLE" if are_zero(&[k1, k2, k3, p1, p2]) => Some(vec![fx, fy, cx, cy]),
        "SIMPLE_RADIAL" if is_square && are_zero(&[k2, k3, p1, p2]) => Some(vec![fx, cx, cy, k1]),
        "RADIAL" if is_square && are_zero(&[k3, p1, p2]) => Some(vec![fx, cx, cy, k1, k2]),
        "OPENCV" if k3 == 0.0 => Some(vec![fx, fy, cx, cy, k1, k2, p1, p2]),
        "SIMPLE_RADIAL_FISHEYE" if is_square && are_zero(&[k2, k3]) => Some(vec![fx, cx, cy, k1]),
        "RADIAL_FISHEYE" if is_square && k3 == 0.0 => Some(vec![fx, cx, cy, k1, k2]),
        "FULL_OPENCV" | "OPENCV_FISHEYE" => Some(every_parameter(intrinsics)),
        _ => None,
    }
}

/// The parameters of the last model of the lens's projection.
fn every_parameter(intrinsics: &Calibration) -> Vec<f64> {
    let [fx, fy, cx, cy] = pinhole(intrinsics);
    let [k1, k2, k3] = [intrinsics.radial_k1, intrinsics.radial_k2, intrinsics.radial_k3];
    match intrinsics.lens_projection {
        // The last three are those of a denominator that our model does not have.
        LensProjection::Perspective => {
            vec![fx, fy, cx, cy, k1, k2, intrinsics.tangential_p1, intrinsics.tangential_p2, k3, 0.0, 0.0, 0.0]
        }
        // The last is a fourth term, which our model does not have.
        LensProjection::Fisheye => vec![fx, fy, cx, cy, k1, k2, k3, 0.0],
    }
}

/// Horizontal and vertical focal length, and the principal point in COLMAP's pixels.
pub(super) fn pinhole(intrinsics: &Calibration) -> [f64; 4] {
    let [cx, cy] = intrinsics.principal_point_px.map(|centre| centre + FIRST_PIXEL);
    [intrinsics.focal_px, intrinsics.aspect * intrinsics.focal_px, cx, cy]
}
