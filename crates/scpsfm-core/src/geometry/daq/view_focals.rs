//! The quadric where every view has a focal length of its own.

use nalgebra::Matrix3x4;

use super::starts::{ranked, scan_focal, scanned};
use super::{Daq, infinite_homography};

/// Focal lengths of the first view that are tried, views that the plane at infinity is taken from, and the ratios of
/// the focal lengths of the two.
const FOCALS: usize = 20;
const VIEWS: usize = 4;
const RATIOS: [f64; 5] = [0.5, 0.71, 1.0, 1.41, 2.0];

/// Focal length that the quadric gives a view, and how far the view is from zero skew, square pixels and a principal
/// point in the origin: a squared distance without unit.
///
/// Returns `None` where the quadric gives no focal length.
pub fn view_focal(camera: &Matrix3x4<f64>, daq: &Daq) -> Option<(f64, f64)> {
    let homography = infinite_homography(camera, daq);
    let seen = homography * daq.diac() * homography.transpose();
    let squared = 0.5 * (seen.m11 + seen.m22) / seen.m33;
    let unit = 0.5 * (seen.m11 + seen.m22);
    let skew = (seen.m12 / unit).powi(2) + (0.5 * (seen.m11 - seen.m22) / unit).powi(2);
    let centre = (seen.m13 * seen.m13 + seen.m23 * seen.m23) / (unit * seen.m33).abs();
    let usable = squared > 0.0 && squared.is_finite() && skew.is_finite() && centre.is_finite();
    usable.then(|| (squared.sqrt(), skew + centre))
}

/// Quadrics to start from, best first: the planes at infinity that pairs of focal lengths give in closed form.
/// `daq.intrinsics` is the first view's.
pub fn view_focal_starts(cameras: &[Matrix3x4<f64>]) -> Vec<(Daq, f64)> {
    let focals = (0..FOCALS).map(|step| scan_focal(step, FOCALS));
    ranked(scanned(cameras, focals, VIEWS, &RATIOS), |daq| {
        cameras.iter().map(|camera| view_focal(camera, daq).map_or(1.0, |(_, cost)| cost.min(1.0))).sum()
    })
}

#[cfg(test)]
mod tests {
    use super::super::super::bundle::metric::Intrinsics;
    use super::super::super::bundle::testing;
    use super::super::to_canonical_frame;
    use super::*;

    #[test]
    fn a_start_is_near_every_focal_length() {
        let mut near = 0;
        for seed in 0..10 {
            let scene = testing::scene(seed, 8, 20, 0.0);
            let focals: Vec<f64> = (0..8).map(|view| 1.0 + 0.1 * view as f64).collect();
            let camera = |(view, focal): (usize, &f64)| scene.poses[view].camera(&Intrinsics::from_focal(*focal));
            let cameras: Vec<_> = focals.iter().enumerate().map(camera).collect();
            let frame = to_canonical_frame(&cameras, &[]).expect("rank 3");
            let (best, cost) = view_focal_starts(&frame.cameras)[0];
            let worst = frame.cameras.iter().zip(&focals).map(|(camera, focal)| {
                view_focal(camera, &best).map_or(f64::INFINITY, |(found, _)| (found / focal).ln().abs())
            });
            let worst = worst.fold(0.0, f64::max);
            println!("seed {seed}: cost {cost:.2e}, worst focal length off by {worst:.3}");
            near += usize::from(worst < 0.3);
        }
        assert!(near >= 8, "{near} of 10");
    }
}
