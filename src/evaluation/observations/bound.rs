//! The best that anyone can do where every view has a camera of its own.

use nalgebra::{DMatrix, Matrix3, Rotation3, SMatrix, SVector, Vector2, Vector3};

use crate::geometry::bundle::metric::Parameter;
use crate::solver::calibration::CalibrationOptions;
use crate::synthetic::Scene;
use crate::synthetic::scene::IMAGE_SIDE_PX;

/// Unknowns of a view: log focal length, principal point, k1; then a turn and a shift of the camera.
const VIEW: usize = 10;
/// The intrinsics among them, in this order.
const INTRINSICS: [Parameter; 4] =
    [Parameter::LogFocal, Parameter::PrincipalX, Parameter::PrincipalY, Parameter::RadialK1];
/// Step of the central differences, in units of about one.
const STEP: f64 = 1e-5;
/// Information on what fixes the frame: far above that of any observation, whose noise is 1e-4 or more.
const FIXED: f64 = 1e14;

/// Cramer-Rao bound of the standard deviation of each view's log focal length: focal length, principal point, k1, pose
/// and points unknown, the priors of the intrinsics the solver's. `None`: unobservable.
pub fn sigmas(scene: &Scene) -> Option<Vec<f64>> {
    let (views, noise) = (scene.options.views, scene.options.noise);
    let mut reduced = DMatrix::<f64>::zeros(VIEW * views, VIEW * views);
    for track in (0..scene.options.tracks).filter(|&track| scene.truth.inlier[track]) {
        let point = Vector3::from(scene.truth.points[track]);
        let mut of_point = Matrix3::<f64>::zeros();
        let mut coupling = DMatrix::<f64>::zeros(VIEW * views, 3);
        for view in (0..views).filter(|&view| scene.truth.is_right(view, track)) {
            let (by_view, by_point) = jacobians(scene, view, &point);
            let mut block = reduced.fixed_view_mut::<VIEW, VIEW>(VIEW * view, VIEW * view);
            block += by_view.transpose() * by_view;
            coupling.fixed_view_mut::<VIEW, 3>(VIEW * view, 0).copy_from(&(by_view.transpose() * by_point));
            of_point += by_point.transpose() * by_point;
        }
        reduced -= &coupling * of_point.try_inverse()? * coupling.transpose();
    }
    reduced /= noise * noise;
    let prior = CalibrationOptions::DEFAULT.lenses.prior(1.0, None, f64::from(IMAGE_SIDE_PX));
    for view in 0..views {
        for (k, parameter) in INTRINSICS.into_iter().enumerate() {
            reduced[(VIEW * view + k, VIEW * view + k)] += prior.information[parameter as usize];
        }
    }
    // The first camera stays where it is, and the second at its distance along the axis in which it is farthest.
    let centre = |view: usize| {
        let rotation = Matrix3::from_fn(|row, column| scene.truth.rotations[view][row][column]);
        -rotation.transpose() * Vector3::from(scene.truth.translations[view])
    };
    let farthest = (centre(1) - centre(0)).iamax();
    for k in (INTRINSICS.len()..VIEW).chain([VIEW + VIEW - 3 + farthest]) {
        reduced[(k, k)] += FIXED;
    }
    let covariance = reduced.cholesky()?.inverse();
    Some((0..views).map(|view| covariance[(VIEW * view, VIEW * view)].sqrt()).collect())
}

/// Derivatives of an image point, in image sides, by a view's unknowns and by the point.
fn jacobians(scene: &Scene, view: usize, point: &Vector3<f64>) -> (SMatrix<f64, 2, VIEW>, SMatrix<f64, 2, 3>) {
    let truth = &scene.truth;
    let rotation = Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
    let centre = -rotation.transpose() * Vector3::from(truth.translations[view]);
    let focal = truth.focals_px[view] / f64::from(IMAGE_SIDE_PX);
    let image = |change: &SVector<f64, VIEW>, point: Vector3<f64>| {
        let turn = Rotation3::new(change.fixed_rows::<3>(4).into_owned());
        let seen = turn * (rotation * (point - centre - change.fixed_rows::<3>(7)));
        let uv = seen.xy() / seen.z;
        let scale = focal * change[0].exp() * (1.0 + (truth.radial_k1[view] + change[3]) * uv.norm_squared());
        scale * uv + Vector2::new(change[1], change[2])
    };
    let none = SVector::<f64, VIEW>::zeros();
    let mut by_view = SMatrix::<f64, 2, VIEW>::zeros();
    for k in 0..VIEW {
        let mut step = none;
        step[k] = STEP;
        by_view.set_column(k, &((image(&step, *point) - image(&-step, *point)) / (2.0 * STEP)));
    }
    let mut by_point = SMatrix::<f64, 2, 3>::zeros();
    for k in 0..3 {
        let mut step = Vector3::zeros();
        step[k] = STEP;
        by_point.set_column(k, &((image(&none, point + step) - image(&none, point - step)) / (2.0 * STEP)));
    }
    (by_view, by_point)
}
