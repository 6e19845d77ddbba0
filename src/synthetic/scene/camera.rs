//! One view's camera: pinhole with radial distortion.

use nalgebra::{Matrix3, Vector3};

use super::motion::Pose;

/// Depth below which a point would be in or behind the camera.
const MIN_DEPTH: f64 = 0.5;
/// Least slope of the distorted radius over the radius: at 0 the image folds, and two points have one image.
const MIN_SLOPE: f64 = 0.1;

/// Radial distortion with one coefficient (Brown 1971): `x_d = x_n (1 + k1 r^2)`, where `x_n` is the pinhole image in
/// normalised camera coordinates (focal lengths from the principal point) and `r` its distance from the centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    pub k1: f64,
}

impl Lens {
    /// Whether a point given in the camera's coordinates has an image of its own: it is far enough in front of the
    /// camera and near enough to the axis for the distortion to be one-to-one. The image has no borders, as in the
    /// paper.
    pub fn sees(&self, seen: &Vector3<f64>) -> bool {
        seen.z > MIN_DEPTH && 1.0 + 3.0 * self.k1 * squared_radius(seen) > MIN_SLOPE
    }

    /// By how much the image of a point given in the camera's coordinates is farther from the centre than a pinhole's.
    fn magnification(&self, seen: &Vector3<f64>) -> f64 {
        1.0 + self.k1 * squared_radius(seen)
    }
}

fn squared_radius(seen: &Vector3<f64>) -> f64 {
    (seen.x * seen.x + seen.y * seen.y) / (seen.z * seen.z)
}

/// A posed camera with its calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    pub pose: Pose,
    pub focal_px: f64,
    pub principal_point_px: [f64; 2],
    pub lens: Lens,
}

impl Camera {
    /// Whether a world point has an image.
    pub fn sees(&self, point: &Vector3<f64>) -> bool {
        self.lens.sees(&self.pose.apply(point))
    }

    /// Image of a world point: x and y in pixels, and the depth along the optical axis.
    pub fn project(&self, point: &Vector3<f64>) -> [f64; 3] {
        let seen = self.pose.apply(point);
        let [centre_x, centre_y] = self.principal_point_px;
        let magnification = self.lens.magnification(&seen);
        [
            self.focal_px * seen.x / seen.z * magnification + centre_x,
            self.focal_px * seen.y / seen.z * magnification + centre_y,
            seen.z,
        ]
    }
}

/// The matrix, row by row.
pub fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
}
