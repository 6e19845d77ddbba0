//! One view's camera: a pinhole with radial distortion, or an equidistant fisheye.

use nalgebra::{Matrix3, Vector3};

use super::motion::Pose;

/// Depth below which a point would be in or behind the camera.
const MIN_DEPTH: f64 = 0.5;
/// Least slope of the distorted radius over the radius: at 0 the image folds, and two points have one image.
const MIN_SLOPE: f64 = 0.1;
/// Steps of Newton's method that find the ray of an image point, and the relative residual at which they have.
const RAY_STEPS: usize = 50;
const RAY_TOLERANCE: f64 = 1e-9;

/// How the distance from the optical axis is imaged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lens {
    /// Radial distortion with two coefficients (Brown 1971): `x_d = x_n (1 + k1 r^2 + k2 r^4)`, where `x_n` is the
    /// pinhole image in normalised camera coordinates (focal lengths from the principal point) and `r` its distance
    /// from the centre.
    Radial([f64; 2]),
    /// An equidistant fisheye (Kannala and Brandt 2006, without their later terms): the distance from the centre is
    /// proportional to the angle from the optical axis.
    Equidistant,
}

impl Lens {
    /// A lens with one coefficient.
    pub fn of_k1(k1: f64) -> Self {
        Lens::Radial([k1, 0.0])
    }

    /// The first radial coefficient; 0 for a fisheye, which has none.
    pub fn k1(&self) -> f64 {
        match *self {
            Lens::Radial([k1, _]) => k1,
            Lens::Equidistant => 0.0,
        }
    }

    /// Whether a point given in the camera's coordinates has an image of its own: it is far enough in front of the
    /// camera and near enough to the axis for the distortion to be one-to-one. The image has no borders, as in the
    /// paper.
    pub fn sees(&self, seen: &Vector3<f64>) -> bool {
        seen.z > MIN_DEPTH && self.slope(squared_radius(seen)) > MIN_SLOPE
    }

    /// By how much the image of a point at this squared radius is farther from the centre than a pinhole's.
    fn magnification(&self, squared: f64) -> f64 {
        match *self {
            Lens::Radial([k1, k2]) => 1.0 + (k1 + k2 * squared) * squared,
            Lens::Equidistant if squared > 0.0 => squared.sqrt().atan() / squared.sqrt(),
            Lens::Equidistant => 1.0,
        }
    }

    /// Derivative of the imaged radius by the radius; of a fisheye, which never folds, 1.
    fn slope(&self, squared: f64) -> f64 {
        match *self {
            Lens::Radial([k1, k2]) => 1.0 + 3.0 * k1 * squared + 5.0 * k2 * squared * squared,
            Lens::Equidistant => 1.0,
        }
    }

    /// The direction `(u, v, 1)` that is imaged at this offset, in focal lengths from the principal point; `None` where
    /// the lens images nothing, or only beyond a fold.
    fn ray(&self, offset: [f64; 2]) -> Option<Vector3<f64>> {
        let imaged = offset[0].hypot(offset[1]);
        let radius = match self {
            Lens::Equidistant => Some(imaged.tan()).filter(|_| imaged < std::f64::consts::FRAC_PI_2),
            Lens::Radial(_) => self.radius(imaged),
        }?;
        let scale = if imaged > 0.0 { radius / imaged } else { 1.0 };
        Some(Vector3::new(scale * offset[0], scale * offset[1], 1.0))
    }

    /// The radius of a pinhole's image that is moved to this one, by Newton's method.
    fn radius(&self, imaged: f64) -> Option<f64> {
        let mut radius = imaged;
        for _ in 0..RAY_STEPS {
            let slope = self.slope(radius * radius);
            let excess = radius * self.magnification(radius * radius) - imaged;
            if slope <= MIN_SLOPE {
                return None;
            }
            if excess.abs() <= RAY_TOLERANCE * imaged {
                return Some(radius);
            }
            radius -= excess / slope;
        }
        None
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
    /// Focal length along y over that along x: 1 for square pixels.
    pub aspect: f64,
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
        let magnification = self.lens.magnification(squared_radius(&seen));
        [
            self.focal_px * seen.x / seen.z * magnification + centre_x,
            self.aspect * self.focal_px * seen.y / seen.z * magnification + centre_y,
            seen.z,
        ]
    }

    /// The direction in camera coordinates, at unit depth, that is imaged at `[x, y]` in pixels; `None` where the lens
    /// images nothing.
    pub fn ray(&self, [x, y]: [f64; 2]) -> Option<Vector3<f64>> {
        let [centre_x, centre_y] = self.principal_point_px;
        self.lens.ray([(x - centre_x) / self.focal_px, (y - centre_y) / (self.aspect * self.focal_px)])
    }
}

/// The matrix, row by row.
pub fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
}
