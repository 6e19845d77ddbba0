//! Intrinsics of a perspective or fisheye lens with distortion.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::domain::LensProjection;
use crate::geometry::observation::Observation;

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
/// Squared radius below which a fisheye's angle and scale are replaced by their series: above it the difference that is
/// the scale's slope keeps ten digits, below it the next terms are under rounding in what they are multiplied with.
const NEAR_AXIS: f64 = 1e-6;

/// An intrinsic as it is adjusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parameter {
    LogFocal,
    PrincipalX,
    PrincipalY,
    LogAspect,
    RadialK1,
    RadialK2,
    RadialK3,
    TangentialP1,
    TangentialP2,
}

impl Parameter {
    pub const COUNT: usize = 9;
    /// In the order of their discriminants.
    pub const ALL: [Parameter; Self::COUNT] = [
        Self::LogFocal,
        Self::PrincipalX,
        Self::PrincipalY,
        Self::LogAspect,
        Self::RadialK1,
        Self::RadialK2,
        Self::RadialK3,
        Self::TangentialP1,
        Self::TangentialP2,
    ];

    /// Whether it bends rays, which no pinhole does.
    pub fn is_of_lens(self) -> bool {
        self as usize >= Self::RadialK1 as usize
    }
}

/// Intrinsics in normalised image units, without skew, behind a lens that distorts.
///
/// A point at `(u, v, 1)` in front of the camera, with `r^2 = u^2 + v^2`, is imaged at
/// * perspective (Brown 1971): `x = f (u s + 2 p1 u v + p2 (r^2 + 2 u^2)) + px`, `y = a f (v s + p1 (r^2 + 2 v^2) + 2
///   p2 u v) + py` with `s = 1 + k1 r^2 + k2 r^4 + k3 r^6`;
/// * fisheye (Kannala & Brandt 2006): `x = f u s + px`, `y = a f v s + py` with `s = t (1 + k1 t^2 + k2 t^4 + k3 t^6) /
///   r` and the angle `t = atan r` from the optical axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    pub projection: LensProjection,
    pub focal: f64,
    /// Relative to the guessed principal point, which is the origin of normalised coordinates.
    pub principal_point: Vector2<f64>,
    /// Height of the pixels' scale over its width: 1 for square pixels.
    pub aspect: f64,
    /// Radial distortion `k1`, `k2`, `k3`, without unit: they scale powers of the squared tangent of the angle from the
    /// optical axis, of a fisheye those of the squared angle. All 0 for a pinhole and for an equidistant fisheye, `k1`
    /// below for a barrel.
    pub radial: [f64; 3],
    /// Tangential distortion `p1`, `p2`, of perspective lenses that are not centred on one axis; ignored for a fisheye.
    pub tangential: [f64; 2],
}

impl Intrinsics {
    /// A pinhole with square pixels and the principal point where it was guessed.
    pub fn from_focal(focal: f64) -> Self {
        Self {
            projection: LensProjection::Perspective,
            focal,
            principal_point: Vector2::zeros(),
            aspect: 1.0,
            radial: [0.0; 3],
            tangential: [0.0; 2],
        }
    }

    /// An equidistant fisheye, with square pixels and the principal point where it was guessed.
    pub fn equidistant(focal: f64) -> Self {
        Self { projection: LensProjection::Fisheye, ..Self::from_focal(focal) }
    }

    /// The lens of this projection and focal length of which nothing else is known.
    pub fn simplest(&self) -> Self {
        Self { projection: self.projection, ..Self::from_focal(self.focal) }
    }

    /// The pinhole that sees what this lens sees once its distortion is undone.
    pub fn pinhole(&self) -> Self {
        Self { projection: LensProjection::Perspective, radial: [0.0; 3], tangential: [0.0; 2], ..*self }
    }

    /// The calibration matrix `K`, which knows no distortion.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [px, py] = [self.principal_point.x, self.principal_point.y];
        Matrix3::new(self.focal, 0.0, px, 0.0, self.aspect * self.focal, py, 0.0, 0.0, 1.0)
    }

    /// Whether it images other than a pinhole.
    pub fn distorts(&self) -> bool {
        self.is_fisheye() || self.radial != [0.0; 3] || self.tangential != [0.0; 2]
    }

    #[inline(always)]
    pub fn is_fisheye(&self) -> bool {
        self.projection == LensProjection::Fisheye
    }

    /// The polynomial `1 + k1 t^2 + k2 t^4 + k3 t^6`.
    ///
    /// * `squared`: of the radius, of a fisheye that of the angle
    #[inline(always)]
    fn polynomial(&self, squared: f64) -> f64 {
        let [k1, k2, k3] = self.radial;
        1.0 + squared * (k1 + squared * (k2 + squared * k3))
    }

    /// Derivative of the polynomial by its argument, `t^2`.
    #[inline(always)]
    fn polynomial_slope(&self, squared: f64) -> f64 {
        let [k1, k2, k3] = self.radial;
        k1 + squared * (2.0 * k2 + squared * 3.0 * k3)
    }

    /// Derivative of `t` times the polynomial by `t`: positive before the fold.
    #[inline(always)]
    fn argument_slope(&self, squared: f64) -> f64 {
        self.polynomial(squared) + 2.0 * squared * self.polynomial_slope(squared)
    }

    /// The polynomial's argument at a squared radius and the factor before it: `r^2` and 1, or of a fisheye `t^2` and
    /// `t / r`.
    #[inline(always)]
    fn argument(&self, squared: f64) -> (f64, f64) {
        match self.projection {
            LensProjection::Perspective => (squared, 1.0),
            LensProjection::Fisheye if squared < NEAR_AXIS => (squared, 1.0 - squared / 3.0),
            LensProjection::Fisheye => {
                let radius = squared.sqrt();
                let angle = radius.atan();
                (angle * angle, angle / radius)
            }
        }
    }

    /// The radial scale `s` at a squared radius.
    #[inline(always)]
    pub(super) fn scale(&self, squared: f64) -> f64 {
        let (argument, factor) = self.argument(squared);
        factor * self.polynomial(argument)
    }

    /// Derivative of the scale by the squared radius.
    #[inline(always)]
    fn scale_slope(&self, squared: f64) -> f64 {
        match self.projection {
            LensProjection::Perspective => self.polynomial_slope(squared),
            LensProjection::Fisheye if squared < NEAR_AXIS => self.radial[0] - 1.0 / 3.0,
            LensProjection::Fisheye => (self.radius_slope(squared) - self.scale(squared)) / (2.0 * squared),
        }
    }

    /// Derivative of the imaged radius `r s` by the radius: positive before the fold.
    #[inline(always)]
    pub(super) fn radius_slope(&self, squared: f64) -> f64 {
        let slope = self.argument_slope(self.argument(squared).0);
        if self.is_fisheye() { slope / (1.0 + squared) } else { slope }
    }

    /// `p1` and `p2` of a perspective lens.
    #[inline(always)]
    fn decentring(&self) -> [f64; 2] {
        if self.is_fisheye() { [0.0; 2] } else { self.tangential }
    }

    /// What tangential distortion adds to a point at unit depth.
    #[inline(always)]
    fn tangential_shift(&self, u: f64, v: f64) -> Vector2<f64> {
        let [p1, p2] = self.decentring();
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
        let [p1, p2] = self.decentring();
        let squared = u * u + v * v;
        let (argument, factor) = self.argument(squared);
        let radial = factor * self.polynomial(argument);
        let shift = self.tangential_shift(u, v);
        let (x, y) = (fx * (u * radial + shift.x), fy * (v * radial + shift.y));
        let first = factor * argument;
        let (first_x, first_y) = (fx * u * first, fy * v * first);
        let fourth = argument * argument;
        // By p1 and p2: zero for a fisheye, which has none.
        let decentred = if self.is_fisheye() { 0.0 } else { 1.0 };
        let (uv, px, py) =
            (2.0 * u * v * decentred, (squared + 2.0 * u * u) * decentred, (squared + 2.0 * v * v) * decentred);
        let by_parameter = [
            [x, 1.0, 0.0, 0.0, first_x, first_x * argument, first_x * fourth, fx * uv, fx * px],
            [y, 0.0, 1.0, y, first_y, first_y * argument, first_y * fourth, fy * py, fy * uv],
        ];
        // Of the two image coordinates by u and v; by z the image moves as by -u and -v.
        let bend = 2.0 * self.scale_slope(squared);
        let cross = bend * u * v + 2.0 * (p1 * u + p2 * v);
        let by_uv = [
            [fx * (radial + bend * u * u + 2.0 * p1 * v + 6.0 * p2 * u), fx * cross],
            [fy * cross, fy * (radial + bend * v * v + 6.0 * p1 * v + 2.0 * p2 * u)],
        ];
        let by_seen = |[by_u, by_v]: [f64; 2]| Vector3::new(by_u, by_v, -by_u * u - by_v * v) * scale;
        (by_parameter, [by_seen(by_uv[0]), by_seen(by_uv[1])])
    }

    /// Squared radius, of a fisheye squared angle, at which the image folds back: the least at which the derivative of
    /// `t` times the polynomial, the cubic `1 + 3 k1 t^2 + 5 k2 t^4 + 7 k3 t^6`, vanishes. Tangential terms, which are
    /// small before the radial ones, are left out.
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

    /// The observation where a pinhole with this `K` would have made it; `None` where the lens images nothing.
    ///
    /// Undoing the distortion scales noise as it scales areas, a fisheye's 40-fold at 75 degrees from the axis. The
    /// weight makes up for that, so that weighted residuals are those of the image to first order, and as a geometric
    /// mean where radial and tangential scales differ; tangential terms, which are small, take no part in it.
    pub fn undistorted(&self, seen: &Observation) -> Option<Observation> {
        if !self.distorts() {
            return Some(*seen);
        }
        let ray = self.ray(&seen.xy)?;
        let xy = self.principal_point + Vector2::new(self.focal * ray.x, self.aspect * self.focal * ray.y);
        let squared = ray.norm_squared();
        let area = self.scale(squared) * self.radius_slope(squared);
        xy.iter().all(|value| value.is_finite()).then_some(Observation { xy, weight: seen.weight * area, ..*seen })
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
        let rounds = if self.decentring() == [0.0; 2] { 0 } else { TANGENTIAL_ROUNDS };
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
        let imaged = distorted.norm();
        let argument = self.undistorted_argument(imaged, fold)?;
        match self.projection {
            LensProjection::Perspective => Some(distorted / self.polynomial(argument.powi(2))),
            // Beyond a right angle from the axis nothing is in front of the camera.
            LensProjection::Fisheye if argument >= FRAC_PI_2 => None,
            LensProjection::Fisheye if imaged == 0.0 => Some(*distorted),
            LensProjection::Fisheye => Some(distorted * (argument.tan() / imaged)),
        }
    }

    /// The radius, of a fisheye the angle, before the fold that is imaged at this radius: the root of a function that
    /// rises, enclosed.
    fn undistorted_argument(&self, distorted: f64, fold: Option<f64>) -> Option<f64> {
        let imaged = |radius: f64| radius * self.polynomial(radius * radius);
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
            let newton = radius - excess / self.argument_slope(radius * radius);
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

    impl Intrinsics {
        /// Whether a point at this squared tangent of the angle from the optical axis lies before the fold, if there is
        /// one.
        pub(crate) fn images(&self, squared: f64) -> bool {
            self.fold().is_none_or(|fold| self.argument(squared).0 < fold)
        }
    }

    /// Where a pinhole would have seen it.
    fn undone(lens: &Intrinsics, xy: Vector2<f64>) -> Option<Vector2<f64>> {
        lens.undistorted(&Observation::new(0, 0, xy)).map(|seen| seen.xy)
    }

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
        let kinds = [
            (LensProjection::Perspective, [0.0; 2]),
            (LensProjection::Perspective, [0.004, -0.003]),
            (LensProjection::Perspective, [-0.02, 0.01]),
            // A fisheye does not look at tangential terms.
            (LensProjection::Fisheye, [0.3, 0.2]),
        ];
        for radial in radial {
            for (projection, tangential) in kinds {
                let intrinsics = Intrinsics {
                    projection,
                    principal_point: Vector2::new(0.03, -0.02),
                    aspect: 1.1,
                    radial,
                    tangential,
                    ..Intrinsics::from_focal(1.3)
                };
                for k in 0..10 {
                    // Fisheyes to 52 degrees off the axis: the strongest barrel folds at 1.05 radians.
                    let reach = if intrinsics.is_fisheye() { 0.13 } else { 0.08 };
                    let seen = Vector3::new(reach * f64::from(k), -0.5 * reach * f64::from(k), 1.0);
                    let pinhole = intrinsics.matrix() * seen;
                    let image = intrinsics.project(&seen);
                    let undone = undone(&intrinsics, image).expect("below the fold");
                    let ray = intrinsics.ray(&image).expect("below the fold");
                    let off = (undone - pinhole.xy()).norm().max((ray - seen.xy()).norm());
                    assert!(off < 1e-9, "radial {radial:?}, tangential {tangential:?}, {k}: {off}");
                }
            }
        }
        let barrel = Intrinsics { radial: [-0.3, 0.0, 0.0], ..Intrinsics::from_focal(1.0) };
        assert_eq!(undone(&barrel, Vector2::new(0.71, 0.0)), None, "beyond 2/3 / sqrt(.9)");
        assert!(undone(&barrel, Vector2::new(0.70, 0.0)).is_some());
        assert!(barrel.images(1.11) && !barrel.images(1.12), "the fold at 1 / .9");
        // 1 + 1.5 r^2 - 2.5 r^4 vanishes at 1, where r s is 1.
        let bent = Intrinsics { radial: [0.5, -0.5, 0.0], ..Intrinsics::from_focal(1.0) };
        assert!(bent.images(0.99) && !bent.images(1.01));
        assert_eq!(undone(&bent, Vector2::new(1.001, 0.0)), None);
        assert!(undone(&bent, Vector2::new(0.999, 0.0)).is_some());
        // A second term that holds the first: nothing folds.
        let held = Intrinsics { radial: [-0.3, 0.05, 0.0], ..Intrinsics::from_focal(1.0) };
        assert!(held.images(1e6));
    }

    #[test]
    fn an_equidistant_fisheye_images_the_angle() {
        let fisheye = Intrinsics::equidistant(0.5);
        for degrees in [0.0f64, 1e-5, 0.05, 0.06, 10.0, 45.0, 80.0, 89.0] {
            let angle = degrees.to_radians();
            let image = fisheye.project(&Vector3::new(0.6 * angle.sin(), 0.8 * angle.sin(), angle.cos()));
            let expected = Vector2::new(0.3 * angle, 0.4 * angle);
            assert!((image - expected).norm() < 1e-15, "{degrees} degrees: {image}");
        }
        assert_eq!(fisheye.ray(&Vector2::new(0.79, 0.0)), None, "beyond a right angle");
        assert_eq!(fisheye.ray(&Vector2::zeros()), Some(Vector2::zeros()));
    }

    /// A square about a point, as small as its noise, imaged and undone.
    #[test]
    fn weights_undo_what_undistorting_does_to_noise() {
        let barrel = Intrinsics { radial: [-0.2, 0.02, 0.0], ..Intrinsics::from_focal(0.7) };
        let fisheye = Intrinsics::equidistant(0.5);
        for lens in [barrel, fisheye] {
            for xy in [Vector2::new(0.1, 0.05), Vector2::new(-0.3, 0.3), Vector2::new(0.5, 0.1)] {
                const SIDE: f64 = 1e-5;
                let at = |x: f64, y: f64| undone(&lens, xy + SIDE * Vector2::new(x, y)).expect("imaged");
                let (right, down) = (at(0.5, 0.0) - at(-0.5, 0.0), at(0.0, 0.5) - at(0.0, -0.5));
                let area = right.perp(&down) / (SIDE * SIDE);
                let weight = lens.undistorted(&Observation::new(0, 0, xy)).expect("imaged").weight;
                assert!((weight * area - 1.0).abs() < 1e-6, "{lens:?} at {xy}: {weight} of {area}");
            }
        }
    }

    /// On both sides of where the series begins, against central differences.
    #[test]
    fn the_slope_of_a_fisheyes_scale_has_no_seam() {
        let lens = Intrinsics { radial: [0.1, -0.05, 0.02], ..Intrinsics::equidistant(0.5) };
        for squared in [1e-9, 0.9 * NEAR_AXIS, 1.1 * NEAR_AXIS, 1e-3, 0.5, 9.0] {
            // Of the angle over the radius in twice the digits that differences of the scale leave near the axis.
            let expected = if squared < 1e-3 {
                // s = (1 - r^2/3 + r^4/5) (1 + k1 t^2 + k2 t^4) with t^2 = r^2 - 2/3 r^4
                let [k1, k2, _] = lens.radial;
                (k1 - 1.0 / 3.0) + 2.0 * squared * (0.2 - k1 + k2)
            } else {
                let width = 1e-4 * squared;
                (lens.scale(squared + width) - lens.scale(squared - width)) / (2.0 * width)
            };
            let slope = lens.scale_slope(squared);
            assert!((slope - expected).abs() < 1e-6, "{squared}: {slope}, {expected}");
        }
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
