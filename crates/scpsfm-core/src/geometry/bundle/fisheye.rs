//! Lenses that stand for others: a fisheye for a barrel, a perspective lens for a fisheye, one fisheye for two lenses.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::intrinsics::Intrinsics;

/// Radii at which a lens is fitted to another.
const FITTED_RADII: usize = 32;

/// Radii from the axis to the largest, evenly.
fn radii(largest: f64) -> impl Iterator<Item = f64> {
    (1..=FITTED_RADII).map(move |k| largest * k as f64 / FITTED_RADII as f64)
}

/// The radial terms that fit best: least squares of `imaged - t` by `k1 t^3 + k2 t^5 + k3 t^7`.
///
/// * `samples`: `(t, imaged)`, in focal lengths
fn radial_terms(samples: impl Iterator<Item = (f64, f64)>) -> [f64; 3] {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (t, imaged) in samples {
        let squared = t * t;
        let powers = Vector3::new(squared, squared.powi(2), squared.powi(3)) * t;
        normal += powers * powers.transpose();
        right += powers * (imaged - t);
    }
    normal.lu().solve(&right).map_or([0.0; 3], Into::into)
}

impl Intrinsics {
    /// The equidistant fisheye whose focal length images nearest to this lens.
    ///
    /// * `radius`: at unit depth, up to which it is fitted
    pub fn nearest_fisheye(&self, radius: f64) -> Self {
        let (mut product, mut squares) = (0.0, 0.0);
        for radius in radii(radius) {
            let angle = radius.atan();
            product += angle * radius * self.scale(radius * radius);
            squares += angle * angle;
        }
        Self::equidistant(self.focal * product / squares)
    }

    /// The perspective lens of the same focal length with three radial terms that images nearest to this one.
    ///
    /// * `radius`: at unit depth, up to which it is fitted
    pub fn nearest_perspective(&self, radius: f64) -> Self {
        let radial = radial_terms(radii(radius).map(|radius| (radius, radius * self.scale(radius * radius))));
        Self { radial, ..self.pinhole() }
    }

    /// One fisheye that approximates another lens applied to the images of a camera with these intrinsics.
    ///
    /// * `lens`: what is applied
    /// * `radius`: of its images, normalised, up to which the fisheye is fitted
    pub fn behind(&self, lens: &Self, radius: f64) -> Self {
        let [inner, outer] = [self, lens].map(|lens| Self { principal_point: Vector2::zeros(), ..*lens });
        let sample = |imaged: f64| {
            let undone = outer.ray(&Vector2::new(imaged, 0.0))? * outer.focal;
            Some((inner.ray(&undone)?.x.atan(), imaged / self.focal))
        };
        let radial = radial_terms(radii(radius).map_while(sample));
        let Self { principal_point, aspect, .. } = *self;
        Self { principal_point, aspect, radial, ..Self::equidistant(self.focal) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fisheye_is_its_own_nearest() {
        let nearest = Intrinsics::equidistant(0.5).nearest_fisheye(3.0);
        assert!((nearest.focal - 0.5).abs() < 1e-14 && nearest.is_fisheye(), "{nearest:?}");
    }

    #[test]
    fn up_to_45_degrees_a_perspective_lens_images_as_a_fisheye_does() {
        let fisheye = Intrinsics::equidistant(0.8);
        let nearest = fisheye.nearest_perspective(1.0);
        assert!(!nearest.is_fisheye());
        for k in 0..=10 {
            let ray = Vector3::new(0.1 * f64::from(k), 0.0, 1.0);
            let off = (nearest.project(&ray) - fisheye.project(&ray)).norm();
            // A fifth of a pixel of 1,000.
            assert!(off < 2e-4, "{k}: {off}");
        }
    }

    #[test]
    fn a_lens_behind_another_is_one_fisheye() {
        let outer = Intrinsics::equidistant(0.47);
        for focal in [0.4, 0.5, 0.7] {
            let inner = Intrinsics { radial: [0.03, 0.0, 0.0], ..Intrinsics::from_focal(focal) };
            let both = inner.behind(&outer, 0.6);
            for k in 0..=12 {
                let pinhole = Vector2::new(0.04, 0.03) * f64::from(k);
                let of_outer = outer.project(&(pinhole / outer.focal).push(1.0));
                let ray = inner.ray(&pinhole).expect("nothing folds");
                let off = (both.project(&ray.push(1.0)) - of_outer).norm();
                // Half a pixel of 1,000.
                assert!(off < 5e-4, "focal {focal}, {k}: {off}");
            }
        }
    }
}
