//! Intrinsics with radial distortion.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::intrinsics_model::Parameter;

/// Steps that undo the radial distortion: Newton's method converges quadratically, and where it would leave what
/// encloses the radius, halving settles 64 bits.
const UNDISTORT_STEPS: usize = 64;
/// Relative change of the radius, or of the point, that ends them.
const UNDISTORT_TOLERANCE: f64 = 4.0 * f64::EPSILON;
/// Rounds in which tangential terms are taken away where the last round put the point: each leaves a share of some
/// `p r` of the error, and a lens with more than a tenth of that is none.
const TANGENTIAL_ROUNDS: usize = 20;
/// Inverse of the squared radius of a fold below which there is none: a thousand focal lengths from the axis, and above
/// what rounding leaves of a root at zero.
const LEAST_INVERSE_FOLD: f64 = 1e-6;
/// Doublings of the radius after which one that is imaged so far out is not looked for any more.
const WIDEST_DOUBLINGS: usize = 64;

/// Intrinsics in normalised image units, without skew, behind a lens that distorts radially and tangentially (Brown
/// 1971).
///
/// A point at `(u, v, 1)` in front of the camera, with `r^2 = u^2 + v^2` and `s = 1 + k1 r^2 + k2 r^4 + k3 r^6`, is
/// imaged at `x = f (u s + 2 p1 u v + p2 (r^2 + 2 u^2)) + px`, `y = a f (v s + p1 (r^2 + 2 v^2) + 2 p2 u v) + py`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    pub focal: f64,
    /// Relative to the guessed principal point, which is the origin of normalised coordinates.
    pub principal_point: Vector2<f64>,
    /// Height of the pixels' scale over its width: 1 for square pixels.
    pub aspect: f64,
    /// Radial distortion `k1`, `k2`, `k3`, without unit: they scale powers of the squared tangent of the angle from the
    /// optical axis. All 0 for a pinhole, `k1` below for a barrel.
    pub radial: [f64; 3],
    /// Tangential distortion `p1`, `p2`, of lenses that are not centred on one axis.
    pub tangential: [f64; 2],
}

impl Intrinsics {
    /// A pinhole with square pixels and the principal point where it was guessed.
    pub fn from_focal(focal: f64) -> Self {
        Self { focal, principal_point: Vector2::zeros(), aspect: 1.0, radial: [0.0; 3], tangential: [0.0; 2] }
    }

    /// The calibration matrix `K`, which knows no distortion.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [px, py] = [self.principal_point.x, self.principal_point.y];
        Matrix3::new(self.focal, 0.0, px, 0.0, self.aspect * self.focal, py, 0.0, 0.0, 1.0)
    }

    /// Whether the lens distorts.
    pub fn distorts(&self) -> bool {
        self.radial != [0.0; 3] || self.tangential != [0.0; 2]
    }

    /// The radial scale `s` at a squared radius.
    #[inline(always)]
    fn scale(&self, squared: f64) -> f64 {
        let [k1, k2, k3] = self.radial;
        1.0 + squared * (k1 + squared * (k2 + squared * k3))
    }

    /// Derivative of the scale by the squared radius.
    #[inline(always)]
    fn scale_slope(&self, squared: f64) -> f64 {
        let [k1, k2, k3] = self.radial;
        k1 + squared * (2.0 * k2 + squared * 3.0 * k3)
    }

    /// Derivative of the imaged radius `r s` by the radius: positive before the fold.
    #[inline(always)]
    pub(super) fn radius_slope(&self, squared: f64) -> f64 {
        self.scale(squared) + 2.0 * squared * self.scale_slope(squared)
    }

    /// What tangential distortion adds to a point at unit depth.
    #[inline(always)]
    fn tangential_shift(&self, u: f64, v: f64) -> Vector2<f64> {
        let [p1, p2] = self.tangential;
        let squared = u * u + v * v;
        Vector2::new(2.0 * p1 * u * v + p2 * (squared + 2.0 * u * u), p1 * (squared + 2.0 * v * v) + 2.0 * p2 * u * v)
    }

    /// Image of a point in camera coordinates; infinite or not a number at depth zero.
    #[inline(always)]
    pub fn project(&self, seen: &Vector3<f64>) -> Vector2<f64> {
        let (u, v) = (seen.x / seen.z, seen.y / seen.z);
        let distorted = Vector2::new(u, v) * self.scale(u * u + v * v) + self.tangential_shift(u, v);
        Vector2::new(self.focal * distorted.x, self.aspect * self.focal * distorted.y) + self.principal_point
    }

    /// Gradients of the two coordinates of [`Self::project`] by the intrinsics, in the order of [`Parameter`], and by
    /// the point; infinite or not a number at depth zero.
    #[inline(always)]
    pub(super) fn gradients(&self, seen: &Vector3<f64>) -> ([[f64; Parameter::COUNT]; 2], [Vector3<f64>; 2]) {
        let scale = seen.z.recip();
        let (u, v) = (seen.x * scale, seen.y * scale);
        let (fx, fy) = (self.focal, self.aspect * self.focal);
        let [p1, p2] = self.tangential;
        let squared = u * u + v * v;
        let radial = self.scale(squared);
        let shift = self.tangential_shift(u, v);
        let (x, y) = (fx * (u * radial + shift.x), fy * (v * radial + shift.y));
        let (first_x, first_y) = (fx * u * squared, fy * v * squared);
        let (fourth, uv) = (squared * squared, 2.0 * u * v);
        let by_parameter = [
            [x, 1.0, 0.0, 0.0, first_x, first_x * squared, first_x * fourth, fx * uv, fx * (squared + 2.0 * u * u)],
            [y, 0.0, 1.0, y, first_y, first_y * squared, first_y * fourth, fy * (squared + 2.0 * v * v), fy * uv],
        ];
        // Of the two image coordinates by u and v; by z the image moves as by -u and -v.
        let bend = 2.0 * self.scale_slope(squared);
        let cross = bend * u * v + 2.0 * (p1 * u + p2 * v);
        let by_uv = [
            [fx * (radial + bend * u * u + 2.0 * p1 * v + 6.0 * p2 * u), fx * cross],
            [fy * cross, fy * (radial + bend * v * v + 6.0 * p1 * v + 2.0 * p2 * u)],
        ];
        (by_parameter, by_uv.map(|[by_u, by_v]| Vector3::new(by_u, by_v, -by_u * u - by_v * v) * scale))
    }

    /// Whether a point at this squared tangent of the angle from the optical axis lies before the fold, if there is
    /// one.
    #[cfg(test)]
    pub fn images(&self, squared: f64) -> bool {
        self.fold().is_none_or(|fold| squared < fold)
    }

    /// Squared radius at which the image folds back: the least at which the derivative of `r s`, the cubic `1 + 3 k1 t
    /// + 5 k2 t^2 + 7 k3 t^3` of it, vanishes. Tangential terms, which are small before the radial ones, are left out.
    ///
    /// It is the inverse of the largest root of `s^3 + 3 k1 s^2 + 5 k2 s + 7 k3`, which has a closed form (Cardano's,
    /// and Viete's where there are three).
    fn fold(&self) -> Option<f64> {
        let [k1, k2, k3] = self.radial;
        // Depressed: y^3 + 3 third_p y + 2 half_q with y = s + k1.
        let (third_p, half_q) = ((5.0 * k2 - 3.0 * k1 * k1) / 3.0, k1.powi(3) - 2.5 * k1 * k2 + 3.5 * k3);
        let discriminant = half_q * half_q + third_p.powi(3);
        let root = if discriminant > 0.0 {
            let cube_root = (-half_q - discriminant.sqrt().copysign(half_q)).cbrt();
            cube_root - third_p / cube_root
        } else {
            let radius = (-third_p).max(0.0).sqrt();
            let cosine = if radius > 0.0 { (-half_q / radius.powi(3)).clamp(-1.0, 1.0) } else { 0.0 };
            2.0 * radius * (cosine.acos() / 3.0).cos()
        };
        Some(root - k1).filter(|inverse| *inverse > LEAST_INVERSE_FOLD).map(f64::recip)
    }

    /// Where a pinhole with this `K` would see what the lens images at `xy`.
    ///
    /// Returns `None` where nothing is imaged: beyond the circle at which the distortion folds the image back.
    pub fn undistort(&self, xy: &Vector2<f64>) -> Option<Vector2<f64>> {
        if !self.distorts() {
            return Some(*xy);
        }
        let ray = self.ray(xy)?;
        let undone = self.principal_point + Vector2::new(self.focal * ray.x, self.aspect * self.focal * ray.y);
        undone.iter().all(|value| value.is_finite()).then_some(undone)
    }

    /// The direction `(u, v)` at unit depth that is imaged at `xy`; `None` where the lens images nothing.
    pub fn ray(&self, xy: &Vector2<f64>) -> Option<Vector2<f64>> {
        let offset = xy - self.principal_point;
        let distorted = Vector2::new(offset.x / self.focal, offset.y / (self.aspect * self.focal));
        if !self.distorts() {
            return Some(distorted);
        }
        let fold = self.fold().map(f64::sqrt);
        let mut ray = self.radially_undistorted(&distorted, fold)?;
        let rounds = if self.tangential == [0.0; 2] { 0 } else { TANGENTIAL_ROUNDS };
        for _ in 0..rounds {
            let next = self.radially_undistorted(&(distorted - self.tangential_shift(ray.x, ray.y)), fold)?;
            let moved = (next - ray).norm();
            ray = next;
            if moved <= UNDISTORT_TOLERANCE * ray.norm() {
                break;
            }
        }
        ray.iter().all(|value| value.is_finite()).then_some(ray)
    }

    /// The point that radial distortion alone moves to this one.
    fn radially_undistorted(&self, distorted: &Vector2<f64>, fold: Option<f64>) -> Option<Vector2<f64>> {
        Some(distorted / self.scale(self.undistorted_radius(distorted.norm(), fold)?.powi(2)))
    }

    /// The radius before the fold that is imaged at this one: the root of a function that rises, enclosed.
    fn undistorted_radius(&self, distorted: f64, fold: Option<f64>) -> Option<f64> {
        let imaged = |radius: f64| radius * self.scale(radius * radius);
        let high = match fold {
            Some(fold) => Some(fold).filter(|fold| distorted <= imaged(*fold)),
            None => (0..WIDEST_DOUBLINGS)
                .map(|doublings| distorted * (doublings as f64).exp2())
                .find(|high| distorted <= imaged(*high)),
        };
        let (mut low, mut high) = (0.0, high?);
        let mut radius = distorted.min(high);
        for _ in 0..UNDISTORT_STEPS {
            let excess = imaged(radius) - distorted;
            if excess > 0.0 {
                high = radius;
            } else {
                low = radius;
            }
            let newton = radius - excess / self.radius_slope(radius * radius);
            let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
            let moved = (next - radius).abs();
            radius = next;
            if moved <= UNDISTORT_TOLERANCE * radius {
                break;
            }
        }
        Some(radius)
    }

    /// One parameter, in the form in which it is adjusted.
    pub fn value(&self, parameter: Parameter) -> f64 {
        match parameter {
            Parameter::LogFocal => self.focal.ln(),
            Parameter::PrincipalX => self.principal_point.x,
            Parameter::PrincipalY => self.principal_point.y,
            Parameter::LogAspect => self.aspect.ln(),
            Parameter::RadialK1 => self.radial[0],
            Parameter::RadialK2 => self.radial[1],
            Parameter::RadialK3 => self.radial[2],
            Parameter::TangentialP1 => self.tangential[0],
            Parameter::TangentialP2 => self.tangential[1],
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
            Parameter::RadialK1 => self.radial[0] += by,
            Parameter::RadialK2 => self.radial[1] += by,
            Parameter::RadialK3 => self.radial[2] += by,
            Parameter::TangentialP1 => self.tangential[0] += by,
            Parameter::TangentialP2 => self.tangential[1] += by,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistorting_inverts_the_projection_up_to_the_fold() {
        let radial = [
            [-0.3, 0.0, 0.0],
            [-0.05, 0.0, 0.0],
            [0.0; 3],
            [0.2, 0.0, 0.0],
            [-0.3, 0.1, 0.0],
            [-0.3, 0.05, 0.0],
            [0.3, -0.1, 0.0],
            [0.0, 0.2, 0.0],
            [-0.3, 0.1, -0.02],
            [-0.2, -0.1, 0.1],
            [0.1, 0.1, -0.1],
        ];
        for radial in radial {
            for tangential in [[0.0; 2], [0.004, -0.003], [-0.02, 0.01]] {
                let intrinsics = Intrinsics {
                    principal_point: Vector2::new(0.03, -0.02),
                    aspect: 1.1,
                    radial,
                    tangential,
                    ..Intrinsics::from_focal(1.3)
                };
                for k in 0..10 {
                    let seen = Vector3::new(0.08 * f64::from(k), -0.04 * f64::from(k), 1.0);
                    let pinhole = intrinsics.matrix() * seen;
                    let image = intrinsics.project(&seen);
                    let undone = intrinsics.undistort(&image).expect("below the fold");
                    let ray = intrinsics.ray(&image).expect("below the fold");
                    let off = (undone - pinhole.xy()).norm().max((ray - seen.xy()).norm());
                    assert!(off < 1e-9, "radial {radial:?}, tangential {tangential:?}, {k}: {off}");
                }
            }
        }
        let barrel = Intrinsics { radial: [-0.3, 0.0, 0.0], ..Intrinsics::from_focal(1.0) };
        assert_eq!(barrel.undistort(&Vector2::new(0.71, 0.0)), None, "beyond 2/3 / sqrt(.9)");
        assert!(barrel.undistort(&Vector2::new(0.70, 0.0)).is_some());
        assert!(barrel.images(1.11) && !barrel.images(1.12), "the fold at 1 / .9");
        // 1 + 1.5 r^2 - 2.5 r^4 vanishes at 1, where r s is 1.
        let bent = Intrinsics { radial: [0.5, -0.5, 0.0], ..Intrinsics::from_focal(1.0) };
        assert!(bent.images(0.99) && !bent.images(1.01));
        assert_eq!(bent.undistort(&Vector2::new(1.001, 0.0)), None);
        assert!(bent.undistort(&Vector2::new(0.999, 0.0)).is_some());
        // A second term that holds the first: nothing folds.
        let held = Intrinsics { radial: [-0.3, 0.05, 0.0], ..Intrinsics::from_focal(1.0) };
        assert!(held.images(1e6));
    }

    /// 1 - 7 t^3 / 7 vanishes at 1; (1 - t) (1 - t/2) (1 - t/3) at 1, 2 and 3; (1 + t)^3 nowhere.
    #[test]
    fn the_fold_of_three_terms_is_the_first_root() {
        let lens = |radial: [f64; 3]| Intrinsics { radial, ..Intrinsics::from_focal(1.0) };
        for (radial, fold) in [
            ([0.0, 0.0, -1.0 / 7.0], Some(1.0)),
            ([-11.0 / 18.0, 1.0 / 5.0, -1.0 / 42.0], Some(1.0)),
            ([1.0, 3.0 / 5.0, 1.0 / 7.0], None),
        ] {
            let found = lens(radial).fold();
            match (found, fold) {
                (Some(found), Some(fold)) => assert!((found - fold).abs() < 1e-9, "{radial:?}: {found} for {fold}"),
                _ => assert_eq!(found, fold, "{radial:?}"),
            }
        }
    }
}
