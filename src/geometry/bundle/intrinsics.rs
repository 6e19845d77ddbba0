//! Intrinsics with radial distortion.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::intrinsics_model::Parameter;

/// Steps that undo the distortion: Newton's method converges quadratically, and where it would leave what encloses the
/// radius, halving settles 64 bits.
const UNDISTORT_STEPS: usize = 64;
/// Relative change of the radius that ends them.
const UNDISTORT_TOLERANCE: f64 = 4.0 * f64::EPSILON;
/// How far beyond the distorted radius the undistorted one can lie where the image does not fold: then either neither
/// coefficient is negative and the scale `1 + k1 r^2 + k2 r^4` is 1 at least, or `k1^2 < 20/9 k2` and it is 4/9 at
/// least.
const WIDEST_UNFOLDED: f64 = 9.0 / 4.0;

/// Intrinsics in normalised image units, without skew: `x = f u s + px`, `y = a f v s + py` with
/// `s = 1 + k1 r^2 + k2 r^4` (Brown 1971) and `r^2 = u^2 + v^2`, for a point at `(u, v, 1)` in front of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    pub focal: f64,
    /// Relative to the guessed principal point, which is the origin of normalised coordinates.
    pub principal_point: Vector2<f64>,
    /// Height of the pixels' scale over its width: 1 for square pixels.
    pub aspect: f64,
    /// Radial distortion `k1`, without unit: it scales the squared tangent of the angle from the optical axis. 0 for a
    /// pinhole, below for a barrel.
    pub radial: f64,
    /// The second coefficient, `k2`, of the fourth power.
    pub second_radial: f64,
}

impl Intrinsics {
    /// A pinhole with square pixels and the principal point where it was guessed.
    pub fn from_focal(focal: f64) -> Self {
        Self { focal, principal_point: Vector2::zeros(), aspect: 1.0, radial: 0.0, second_radial: 0.0 }
    }

    /// The calibration matrix `K`, which knows no distortion.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [px, py] = [self.principal_point.x, self.principal_point.y];
        Matrix3::new(self.focal, 0.0, px, 0.0, self.aspect * self.focal, py, 0.0, 0.0, 1.0)
    }

    /// What the lens makes of a squared radius: the scale `s`.
    #[inline]
    fn scale(&self, squared: f64) -> f64 {
        1.0 + squared * (self.radial + squared * self.second_radial)
    }

    /// Image of a point in camera coordinates; infinite or not a number at depth zero.
    #[inline]
    pub fn project(&self, seen: &Vector3<f64>) -> Vector2<f64> {
        let (u, v) = (seen.x / seen.z, seen.y / seen.z);
        let scale = self.focal * self.scale(u * u + v * v);
        Vector2::new(scale * u, self.aspect * scale * v) + self.principal_point
    }

    /// Derivatives of [`Self::project`]; infinite or not a number at depth zero.
    #[inline]
    pub(super) fn gradients(&self, seen: &Vector3<f64>) -> ImageGradients {
        let scale = seen.z.recip();
        let (u, v) = (seen.x * scale, seen.y * scale);
        let (fx, fy) = (self.focal, self.aspect * self.focal);
        let squared = u * u + v * v;
        let radial = self.scale(squared);
        let (x, y) = (fx * u * radial, fy * v * radial);
        let (first_x, first_y) = (fx * u * squared, fy * v * squared);
        let by_parameter =
            [[x, 1.0, 0.0, 0.0, first_x, first_x * squared], [y, 0.0, 1.0, y, first_y, first_y * squared]];
        // Twice the derivative of the scale by the squared radius.
        let bend = 2.0 * (self.radial + 2.0 * squared * self.second_radial);
        // Of the two image coordinates by u and v; by z the image moves as by -u and -v.
        let by_uv =
            [[fx * (radial + bend * u * u), fx * bend * u * v], [fy * bend * u * v, fy * (radial + bend * v * v)]];
        let by_seen = by_uv.map(|[by_u, by_v]| Vector3::new(by_u, by_v, -by_u * u - by_v * v) * scale);
        ImageGradients { by_parameter, by_seen }
    }

    /// Whether a point at this squared tangent of the angle from the optical axis lies before the fold, if there is
    /// one.
    #[cfg(test)]
    pub fn images(&self, squared: f64) -> bool {
        self.fold().is_none_or(|fold| squared < fold)
    }

    /// Squared radius at which the image folds back: the least at which the derivative of `r s`,
    /// `1 + 3 k1 r^2 + 5 k2 r^4`, vanishes.
    fn fold(&self) -> Option<f64> {
        let (half_b, a) = (1.5 * self.radial, 5.0 * self.second_radial);
        let discriminant = half_b * half_b - a;
        if discriminant < 0.0 {
            return None;
        }
        // Of the two roots 1 / (-b/2 +- sqrt(..)) the smaller that is positive, in the form that knows a = 0 too.
        let inverse = discriminant.sqrt() - half_b;
        (inverse > 0.0).then(|| inverse.recip())
    }

    /// Where a pinhole with this `K` would see what the lens images at `xy`.
    ///
    /// Returns `None` where nothing is imaged: beyond the circle at which the distortion folds the image back.
    pub fn undistort(&self, xy: &Vector2<f64>) -> Option<Vector2<f64>> {
        if self.radial == 0.0 && self.second_radial == 0.0 {
            return Some(*xy);
        }
        let offset = xy - self.principal_point;
        let distorted = Vector2::new(offset.x / self.focal, offset.y / (self.aspect * self.focal)).norm();
        let undone = self.principal_point + offset / self.scale(self.undistorted(distorted)?.powi(2));
        undone.iter().all(|value| value.is_finite()).then_some(undone)
    }

    /// The radius before the fold that is imaged at this one: the root of a function that rises, enclosed.
    fn undistorted(&self, distorted: f64) -> Option<f64> {
        let (mut low, mut high) = (0.0, WIDEST_UNFOLDED * distorted);
        if let Some(fold) = self.fold().map(f64::sqrt) {
            if distorted > fold * self.scale(fold * fold) {
                return None;
            }
            high = fold;
        }
        let mut radius = distorted.min(high);
        for _ in 0..UNDISTORT_STEPS {
            let squared = radius * radius;
            let excess = radius * self.scale(squared) - distorted;
            if excess > 0.0 {
                high = radius;
            } else {
                low = radius;
            }
            let slope = 1.0 + squared * (3.0 * self.radial + 5.0 * squared * self.second_radial);
            let newton = radius - excess / slope;
            let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
            let moved = (next - radius).abs();
            radius = next;
            if moved <= UNDISTORT_TOLERANCE * radius {
                break;
            }
        }
        Some(radius)
    }

    /// The direction `(u, v)` at unit depth that is imaged at `xy`; `None` where the lens images nothing.
    pub fn ray(&self, xy: &Vector2<f64>) -> Option<Vector2<f64>> {
        let offset = self.undistort(xy)? - self.principal_point;
        Some(Vector2::new(offset.x / self.focal, offset.y / (self.aspect * self.focal)))
    }

    /// One parameter, in the form in which it is adjusted.
    pub fn value(&self, parameter: Parameter) -> f64 {
        match parameter {
            Parameter::LogFocal => self.focal.ln(),
            Parameter::PrincipalX => self.principal_point.x,
            Parameter::PrincipalY => self.principal_point.y,
            Parameter::LogAspect => self.aspect.ln(),
            Parameter::Radial => self.radial,
            Parameter::SecondRadial => self.second_radial,
        }
    }

    /// Moves one parameter. Focal and aspect move by factors: they stay positive, and a variance is one of the
    /// logarithm.
    pub fn shift(&mut self, parameter: Parameter, by: f64) {
        match parameter {
            Parameter::LogFocal => self.focal *= by.exp(),
            Parameter::PrincipalX => self.principal_point.x += by,
            Parameter::PrincipalY => self.principal_point.y += by,
            Parameter::LogAspect => self.aspect *= by.exp(),
            Parameter::Radial => self.radial += by,
            Parameter::SecondRadial => self.second_radial += by,
        }
    }
}

/// Gradients of the two coordinates of an image point.
pub(super) struct ImageGradients {
    /// With respect to the intrinsics, in the order of [`Parameter`].
    pub by_parameter: [[f64; Parameter::COUNT]; 2],
    /// With respect to the point in camera coordinates.
    pub by_seen: [Vector3<f64>; 2],
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistorting_inverts_the_projection_up_to_the_fold() {
        let lenses = [-0.3, -0.05, 0.0, 0.2].map(|radial| (radial, 0.0));
        for (radial, second_radial) in lenses.into_iter().chain([(-0.3, 0.1), (-0.3, 0.05), (0.3, -0.1), (0.0, 0.2)]) {
            let intrinsics = Intrinsics {
                principal_point: Vector2::new(0.03, -0.02),
                aspect: 1.1,
                radial,
                second_radial,
                ..Intrinsics::from_focal(1.3)
            };
            for k in 0..10 {
                let seen = Vector3::new(0.09 * f64::from(k), -0.04 * f64::from(k), 1.0);
                let pinhole = intrinsics.matrix() * seen;
                let undone = intrinsics.undistort(&intrinsics.project(&seen)).expect("below the fold");
                assert!(
                    (undone - pinhole.xy()).norm() < 1e-9,
                    "k1 {radial}, k2 {second_radial}, {k}: {undone} {pinhole}"
                );
            }
        }
        let barrel = Intrinsics { radial: -0.3, ..Intrinsics::from_focal(1.0) };
        assert_eq!(barrel.undistort(&Vector2::new(0.71, 0.0)), None, "beyond 2/3 / sqrt(.9)");
        assert!(barrel.undistort(&Vector2::new(0.70, 0.0)).is_some());
        assert!(barrel.images(1.11) && !barrel.images(1.12), "the fold at 1 / .9");
        // 1 + 1.5 r^2 - 2.5 r^4 vanishes at 1, where r s is 1.
        let bent = Intrinsics { radial: 0.5, second_radial: -0.5, ..Intrinsics::from_focal(1.0) };
        assert!(bent.images(0.99) && !bent.images(1.01));
        assert_eq!(bent.undistort(&Vector2::new(1.001, 0.0)), None);
        assert!(bent.undistort(&Vector2::new(0.999, 0.0)).is_some());
        // A second term that holds the first: nothing folds.
        let held = Intrinsics { radial: -0.3, second_radial: 0.05, ..Intrinsics::from_focal(1.0) };
        assert!(held.images(1e6));
    }
}
