//! Where to start: a scan of focal lengths with the plane at infinity in closed form, one focal length for all views or
//! one of each.

use nalgebra::{Matrix3, Matrix3x4, Vector3};

use super::{Daq, infinite_homography, residual};

/// Focal lengths of a scan, in image sides: from wider than any rectilinear lens (118 degrees) to a telephoto of 11
/// degrees.
const SCAN_RANGE: (f64, f64) = (0.3, 5.0);
/// Focal lengths of the first view that are tried, views that the plane at infinity is taken from, and the ratios of
/// the focal lengths of the two.
const FOCALS: usize = 20;
const VIEWS: usize = 4;
const RATIOS: [f64; 5] = [0.5, 0.71, 1.0, 1.41, 2.0];

/// Plane at infinity from a second view when the focal lengths of both are known (Gherardi & Fusiello 2010, section 3).
///
/// Two planes, one for each sign of the camera; none when the views share their centre.
fn plane_from_focals(camera: &Matrix3x4<f64>, first: f64, second: f64) -> Option<[Vector3<f64>; 2]> {
    let calibration = Matrix3::from_diagonal(&Vector3::new(first, first, 1.0));
    let uncalibrate = |focal: f64| Matrix3::from_diagonal(&Vector3::new(focal.recip(), focal.recip(), 1.0));
    let translation = uncalibrate(second) * camera.column(3);
    let length = translation.norm();
    if !(length > 1e-9 && length.is_finite()) {
        return None;
    }
    // A rotation that takes the translation to the first axis.
    let along = translation / length;
    let across = along.cross(&Vector3::ith(along.iamin(), 1.0)).normalize();
    let turn = Matrix3::from_rows(&[along.transpose(), across.transpose(), along.cross(&across).transpose()]);
    let rows = turn * uncalibrate(second) * camera.fixed_columns::<3>(0) * calibration;
    let back = uncalibrate(first);
    let plane = |sign: f64| {
        let [first, second, third] = [0, 1, 2].map(|row| sign * rows.row(row).transpose());
        let direction = (second.cross(&third) / third.norm() - first) / length;
        -sign * back * direction
    };
    Some([plane(1.0), plane(-1.0)])
}

/// One of the focal lengths of a scan of so many, evenly spaced in their logarithm.
pub fn scan_focal(step: usize, focals: usize) -> f64 {
    let spacing = (SCAN_RANGE.1 / SCAN_RANGE.0).ln() / focals.saturating_sub(1).max(1) as f64;
    SCAN_RANGE.0 * (spacing * step as f64).exp()
}

/// Tries `focals` focal lengths, each with the planes at infinity that the `views` views with the widest baseline to
/// the first give in closed form. Returns them with their residual, best first.
pub fn scan(cameras: &[Matrix3x4<f64>], focals: usize, views: usize) -> Vec<(Daq, f64)> {
    let focals = (0..focals).map(|step| scan_focal(step, focals));
    ranked(cameras, focals, views, &[1.0], |daq| residual(cameras, daq))
}

/// The same of one focal length, which is known.
pub fn scan_planes(cameras: &[Matrix3x4<f64>], focal: f64, views: usize) -> Vec<(Daq, f64)> {
    ranked(cameras, [focal], views, &[1.0], |daq| residual(cameras, daq))
}

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
    ranked(cameras, focals, VIEWS, &RATIOS, |daq| {
        cameras.iter().map(|camera| view_focal(camera, daq).map_or(1.0, |(_, cost)| cost.min(1.0))).sum()
    })
}

/// The quadrics of a scan with what each costs, best first; without those whose cost is no number.
///
/// * `ratios`: of the focal length of the other view to that of the first
fn ranked(
    cameras: &[Matrix3x4<f64>],
    focals: impl IntoIterator<Item = f64>,
    views: usize,
    ratios: &[f64],
    cost: impl Fn(&Daq) -> f64,
) -> Vec<(Daq, f64)> {
    let mut widest: Vec<&Matrix3x4<f64>> = cameras.iter().skip(1).collect();
    widest.sort_by(|a, b| b.column(3).norm().total_cmp(&a.column(3).norm()));
    let mut found = Vec::new();
    for focal in focals {
        for camera in widest.iter().take(views) {
            let planes = ratios.iter().filter_map(|ratio| plane_from_focals(camera, focal, ratio * focal)).flatten();
            let finite = planes.filter(|plane| plane.iter().all(|value| value.is_finite()));
            let costs = finite.map(|plane| Daq::new(focal, plane)).map(|daq| (daq, cost(&daq)));
            found.extend(costs.filter(|(_, cost)| cost.is_finite()));
        }
    }
    found.sort_by(|a, b| a.1.total_cmp(&b.1));
    found
}

#[cfg(test)]
mod tests {
    use super::super::super::bundle::metric::Intrinsics;
    use super::super::super::bundle::testing;
    use super::super::to_canonical_frame;
    use super::*;

    #[test]
    fn the_true_focal_length_gives_the_true_plane_from_every_view() {
        let scene = testing::scene(4, 6, 20, 0.0);
        let (cameras, _) = testing::projectively_transformed(&scene, 4);
        let frame = to_canonical_frame(&cameras, &[]).expect("rank 3");
        let focal = scene.intrinsics.focal;
        for camera in &frame.cameras[1..] {
            let planes = plane_from_focals(camera, focal, focal).expect("a baseline");
            let costs = planes.map(|plane| residual(&frame.cameras, &Daq::new(focal, plane)));
            assert!(costs[0].min(costs[1]) < 1e-12, "{costs:?}");
        }
    }

    #[test]
    fn views_without_a_baseline_give_no_plane() {
        assert_eq!(plane_from_focals(&Matrix3x4::identity(), 1.0, 1.0), None);
        assert!(scan(&[Matrix3x4::identity(); 3], 4, 2).is_empty());
    }

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
