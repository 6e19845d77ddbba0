//! Where to start: a scan of focal lengths with the plane at infinity in closed form.

use nalgebra::{Matrix3, Matrix3x4, Vector3};

use super::{Daq, residual};

/// Focal lengths of a scan, in image sides: from wider than any rectilinear lens (118 degrees) to a telephoto of 11
/// degrees.
const SCAN_RANGE: (f64, f64) = (0.3, 5.0);

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
    ranked(scanned(cameras, focals, views, &[1.0]), |daq| residual(cameras, daq))
}

/// The same of one focal length, which is known.
pub fn scan_planes(cameras: &[Matrix3x4<f64>], focal: f64, views: usize) -> Vec<(Daq, f64)> {
    ranked(scanned(cameras, [focal], views, &[1.0]), |daq| residual(cameras, daq))
}

/// The quadrics of a scan.
///
/// * `ratios`: of the focal length of the other view to that of the first
pub(super) fn scanned(
    cameras: &[Matrix3x4<f64>],
    focals: impl IntoIterator<Item = f64>,
    views: usize,
    ratios: &[f64],
) -> Vec<Daq> {
    let mut widest: Vec<&Matrix3x4<f64>> = cameras.iter().skip(1).collect();
    widest.sort_by(|a, b| b.column(3).norm().total_cmp(&a.column(3).norm()));
    let mut found = Vec::new();
    for focal in focals {
        for camera in widest.iter().take(views) {
            let planes = ratios.iter().filter_map(|ratio| plane_from_focals(camera, focal, ratio * focal)).flatten();
            let finite = planes.filter(|plane| plane.iter().all(|value| value.is_finite()));
            found.extend(finite.map(|plane| Daq::new(focal, plane)));
        }
    }
    found
}

/// Quadrics with what each costs, best first; without those whose cost is no number.
pub(super) fn ranked(found: Vec<Daq>, cost: impl Fn(&Daq) -> f64) -> Vec<(Daq, f64)> {
    let costs = found.into_iter().map(|daq| (daq, cost(&daq)));
    let mut ranked: Vec<(Daq, f64)> = costs.filter(|(_, cost)| cost.is_finite()).collect();
    ranked.sort_by(|a, b| a.1.total_cmp(&b.1));
    ranked
}

#[cfg(test)]
mod tests {
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
}
