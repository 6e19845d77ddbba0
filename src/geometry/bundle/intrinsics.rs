//! Intrinsics with radial distortion, which of them are free, and what is known of them beforehand.

use nalgebra::{Matrix3, Vector2, Vector3};

/// Steps of Newton's method that undo the distortion; it converges quadratically from the distorted radius.
const UNDISTORT_STEPS: usize = 20;

/// Intrinsics in normalised image units, without skew: `x = f u s + px`, `y = a f v s + py` with `s = 1 + k1 r^2` and
/// `r^2 = u^2 + v^2`, for a point at `(u, v, 1)` in front of the camera.
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
}

impl Intrinsics {
    /// A pinhole with square pixels and the principal point where it was guessed.
    pub fn from_focal(focal: f64) -> Self {
        Self { focal, principal_point: Vector2::zeros(), aspect: 1.0, radial: 0.0 }
    }

    /// The calibration matrix `K`, which knows no distortion.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [px, py] = [self.principal_point.x, self.principal_point.y];
        Matrix3::new(self.focal, 0.0, px, 0.0, self.aspect * self.focal, py, 0.0, 0.0, 1.0)
    }

    /// Image of a point in camera coordinates; infinite or not a number at depth zero.
    #[inline]
    pub fn project(&self, seen: &Vector3<f64>) -> Vector2<f64> {
        let (u, v) = (seen.x / seen.z, seen.y / seen.z);
        let scale = self.focal * (1.0 + self.radial * (u * u + v * v));
        Vector2::new(scale * u, self.aspect * scale * v) + self.principal_point
    }

    /// Derivatives of [`Self::project`]; infinite or not a number at depth zero.
    #[inline]
    pub(super) fn gradients(&self, seen: &Vector3<f64>) -> ImageGradients {
        let scale = seen.z.recip();
        let (u, v) = (seen.x * scale, seen.y * scale);
        let (fx, fy) = (self.focal, self.aspect * self.focal);
        let squared = u * u + v * v;
        let radial = 1.0 + self.radial * squared;
        let (x, y) = (fx * u * radial, fy * v * radial);
        let by_parameter = [[x, 1.0, 0.0, 0.0, fx * u * squared], [y, 0.0, 1.0, y, fy * v * squared]];
        let bend = 2.0 * self.radial;
        // Of the two image coordinates by u and v; by z the image moves as by -u and -v.
        let by_uv =
            [[fx * (radial + bend * u * u), fx * bend * u * v], [fy * bend * u * v, fy * (radial + bend * v * v)]];
        let by_seen = by_uv.map(|[by_u, by_v]| Vector3::new(by_u, by_v, -by_u * u - by_v * v) * scale);
        ImageGradients { by_parameter, by_seen }
    }

    /// Where a pinhole with this `K` would see what the lens images at `xy`.
    ///
    /// Returns `None` where nothing is imaged: beyond the circle at which a barrel distortion folds the image back.
    pub fn undistort(&self, xy: &Vector2<f64>) -> Option<Vector2<f64>> {
        if self.radial == 0.0 {
            return Some(*xy);
        }
        let offset = xy - self.principal_point;
        let distorted = Vector2::new(offset.x / self.focal, offset.y / (self.aspect * self.focal)).norm();
        let mut radius = distorted;
        // The fold, where the derivative of r (1 + k1 r^2) vanishes; below it the function is concave and rises.
        if self.radial < 0.0 {
            let fold = (-3.0 * self.radial).sqrt().recip();
            if distorted > 2.0 / 3.0 * fold {
                return None;
            }
            radius = radius.min(fold);
        }
        for _ in 0..UNDISTORT_STEPS {
            let squared = self.radial * radius * radius;
            let slope = 1.0 + 3.0 * squared;
            if slope <= f64::EPSILON {
                break;
            }
            radius -= (radius * (1.0 + squared) - distorted) / slope;
        }
        let undone = self.principal_point + offset / (1.0 + self.radial * radius * radius);
        undone.iter().all(|value| value.is_finite()).then_some(undone)
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

/// An intrinsic as it is adjusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parameter {
    LogFocal,
    PrincipalX,
    PrincipalY,
    LogAspect,
    Radial,
}

impl Parameter {
    pub const COUNT: usize = 5;
    /// In the order of their discriminants.
    pub const ALL: [Parameter; Self::COUNT] =
        [Self::LogFocal, Self::PrincipalX, Self::PrincipalY, Self::LogAspect, Self::Radial];
}

/// What may be freed beside the focal length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Extension {
    PrincipalPoint,
    Aspect,
    Radial,
}

impl Extension {
    pub const ALL: [Extension; 3] = [Self::PrincipalPoint, Self::Aspect, Self::Radial];

    /// The parameters that it frees.
    pub fn parameters(self) -> &'static [Parameter] {
        match self {
            Extension::PrincipalPoint => &[Parameter::PrincipalX, Parameter::PrincipalY],
            Extension::Aspect => &[Parameter::LogAspect],
            Extension::Radial => &[Parameter::Radial],
        }
    }

    /// What it frees, in words.
    pub fn name(self) -> &'static str {
        match self {
            Extension::PrincipalPoint => "principal point",
            Extension::Aspect => "aspect",
            Extension::Radial => "radial distortion",
        }
    }
}

/// Which intrinsics are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct IntrinsicsModel {
    focal: bool,
    extensions: [bool; Extension::ALL.len()],
}

impl IntrinsicsModel {
    pub const FIXED: Self = Self { focal: false, extensions: [false; 3] };
    pub const FOCAL: Self = Self { focal: true, extensions: [false; 3] };
    pub const FULL: Self = Self { focal: true, extensions: [true; 3] };

    /// Every combination of extensions with the focal length free, the simplest first.
    pub fn all() -> impl Iterator<Item = Self> {
        (0..1usize << Extension::ALL.len())
            .map(|mask| Self { focal: true, extensions: std::array::from_fn(|k| mask >> k & 1 == 1) })
    }

    pub fn contains(self, extension: Extension) -> bool {
        self.extensions[extension as usize]
    }

    /// This model with more freed.
    pub fn with(mut self, extension: Extension) -> Self {
        self.extensions[extension as usize] = true;
        self
    }

    /// This model with the focal length held.
    pub fn without_focal(self) -> Self {
        Self { focal: false, ..self }
    }

    /// Extensions that are free.
    pub fn extensions(self) -> impl Iterator<Item = Extension> {
        Extension::ALL.into_iter().filter(move |extension| self.contains(*extension))
    }

    /// Free parameters, in the order of [`Parameter::ALL`].
    pub fn parameters(self) -> Vec<Parameter> {
        let focal = self.focal.then_some(Parameter::LogFocal);
        focal
            .into_iter()
            .chain(self.extensions().flat_map(|extension| extension.parameters().iter().copied()))
            .collect()
    }

    /// What is free, in words.
    pub fn name(self) -> String {
        let mut names: Vec<&str> = self.focal.then_some("focal length").into_iter().collect();
        names.extend(self.extensions().map(Extension::name));
        match names.as_slice() {
            [] => "nothing".to_owned(),
            [only] => (*only).to_owned(),
            [first @ .., last] => format!("{} and {last}", first.join(", ")),
        }
    }
}

/// Gaussian knowledge of the intrinsics before any observation.
///
/// The cost of an adjustment is in squared image units: an observation of standard deviation `noise` has information
/// `1`, a parameter known to `sigma` has `noise^2 / sigma^2`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntrinsicsPrior {
    /// In the form in which the parameter is adjusted; indexed by [`Parameter`].
    pub mean: [f64; Parameter::COUNT],
    /// 0: nothing is known.
    pub information: [f64; Parameter::COUNT],
}

impl IntrinsicsPrior {
    /// Nothing is known.
    pub const NONE: Self = Self { mean: [0.0; Parameter::COUNT], information: [0.0; Parameter::COUNT] };

    /// Adds knowledge of a parameter of which nothing was known.
    pub fn knowing(mut self, parameter: Parameter, mean: f64, sigma: f64, noise: f64) -> Self {
        self.mean[parameter as usize] = mean;
        self.information[parameter as usize] = (noise / sigma).powi(2);
        self
    }

    /// Without what is known of one parameter.
    pub fn forgetting(mut self, parameter: Parameter) -> Self {
        self.information[parameter as usize] = 0.0;
        self
    }

    /// Present minus expected value; 0 where nothing is known.
    pub fn deviation(&self, parameter: Parameter, intrinsics: &Intrinsics) -> f64 {
        match self.information[parameter as usize] > 0.0 {
            true => intrinsics.value(parameter) - self.mean[parameter as usize],
            false => 0.0,
        }
    }

    /// What the parameters of a model cost where they are.
    pub fn cost(&self, model: IntrinsicsModel, intrinsics: &Intrinsics) -> f64 {
        let cost =
            |parameter: Parameter| self.information[parameter as usize] * self.deviation(parameter, intrinsics).powi(2);
        model.parameters().into_iter().map(cost).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistorting_inverts_the_projection_up_to_the_fold() {
        for radial in [-0.3, -0.05, 0.0, 0.2] {
            let intrinsics = Intrinsics {
                principal_point: Vector2::new(0.03, -0.02),
                aspect: 1.1,
                radial,
                ..Intrinsics::from_focal(1.3)
            };
            for k in 0..10 {
                let seen = Vector3::new(0.09 * f64::from(k), -0.04 * f64::from(k), 1.0);
                let pinhole = intrinsics.matrix() * seen;
                let undone = intrinsics.undistort(&intrinsics.project(&seen)).expect("below the fold");
                assert!((undone - pinhole.xy()).norm() < 1e-9, "k1 {radial}, {k}: {undone} {pinhole}");
            }
        }
        let barrel = Intrinsics { radial: -0.3, ..Intrinsics::from_focal(1.0) };
        assert_eq!(barrel.undistort(&Vector2::new(0.71, 0.0)), None, "beyond 2/3 / sqrt(.9)");
        assert!(barrel.undistort(&Vector2::new(0.70, 0.0)).is_some());
    }

    #[test]
    fn models_count_and_name_what_they_free() {
        let radial = IntrinsicsModel::FOCAL.with(Extension::PrincipalPoint).with(Extension::Radial);
        assert_eq!(radial.name(), "focal length, principal point and radial distortion");
        assert_eq!(radial.parameters().len(), 4);
        assert_eq!(
            (IntrinsicsModel::FIXED.name(), IntrinsicsModel::FIXED.parameters()),
            ("nothing".to_owned(), vec![])
        );
        assert_eq!(IntrinsicsModel::FULL.parameters(), Parameter::ALL);
        assert_eq!(IntrinsicsModel::all().count(), 8);
        assert_eq!(IntrinsicsModel::all().next(), Some(IntrinsicsModel::FOCAL));
    }
}
