//! The solved scene of the fixture behind other lenses, for tests of what is written for other programs.

use super::{LabelledInput, fixture};
use crate::domain::{Calibration, ImageSize, LensProjection, Solution};

/// The solved scene of the fixture under another lens: the observations are exactly those of the result.
pub(crate) fn scene_of(calibration: Calibration, size: ImageSize) -> (LabelledInput, Solution) {
    let (mut input, mut solution) = fixture::solved();
    solution.calibrations = vec![calibration];
    input.raw.views.iter_mut().for_each(|view| view.size = Some(size));
    for k in (0..input.raw.x.len()).filter(|&k| solution.observations.inlier[k]) {
        let view = &solution.views[input.raw.view[k] as usize];
        let point = solution.tracks.point[input.raw.track[k] as usize].expect("an inlier");
        let (rotation, translation) = (view.rotation.expect("a pose"), view.translation.expect("a pose"));
        let seen: [f64; 3] = std::array::from_fn(|row| {
            (0..3).map(|axis| rotation[row][axis] * point[axis]).sum::<f64>() + translation[row]
        });
        let [x, y] = calibration.distort(seen[0] / seen[2], seen[1] / seen[2]);
        let [px, py] = calibration.principal_point_px;
        input.raw.x[k] = calibration.focal_px * x + px;
        input.raw.y[k] = calibration.aspect * calibration.focal_px * y + py;
    }
    (input, solution)
}

/// Under a fisheye, which has no tangential distortion.
pub(crate) fn fisheye(aspect: f64, radial: [f64; 3], principal_point_px: [f64; 2]) -> Calibration {
    let [k1, k2, k3] = radial;
    Calibration { lens_projection: LensProjection::Fisheye, ..lens(aspect, [k1, k2, k3, 0.0, 0.0], principal_point_px) }
}

/// * `coefficients`: `k1`, `k2`, `k3`, `p1`, `p2`
pub(crate) fn lens(aspect: f64, coefficients: [f64; 5], principal_point_px: [f64; 2]) -> Calibration {
    let [radial_k1, radial_k2, radial_k3, tangential_p1, tangential_p2] = coefficients;
    Calibration {
        camera_group: 0,
        focal_px: 900.0,
        sigma_log_focal: Some(0.01),
        principal_point_px,
        aspect,
        lens_projection: LensProjection::Perspective,
        radial_k1,
        radial_k2,
        radial_k3,
        tangential_p1,
        tangential_p2,
        grade: None,
        sigmas: Default::default(),
    }
}
