//! Motions and scenes that carry no calibration, and which of them it is.

use nalgebra::{Matrix3, Vector3};

use super::Uncalibrated;
use super::fit::Fit;
use super::options::{CalibrationOptions, CriticalOptions};
use crate::domain::{StopToken, Warning, WarningCode};
use crate::geometry::bundle::critical::{Rotating, Translating};
use crate::geometry::critical;
use crate::geometry::homography;

/// What carries no calibration, as far as the views show.
pub(super) struct Critical {
    /// Empty where nothing speaks against a calibration.
    pub warnings: Vec<Warning>,
    /// The reconstruction of a camera that moved without turning, where its scene has depth: a focal length that is
    /// known otherwise makes it metric.
    pub translation: Option<Translating>,
}

/// Whether the views of this consensus carry no calibration, and why.
///
/// * `fit`: the projective cameras that every model is tested against
pub(super) fn find(problem: &Uncalibrated, fit: &Fit, scale_px: f64, stop: &StopToken) -> Critical {
    let (observations, views) = (problem.observations, problem.cameras.len());
    let points = problem.points.len();
    let CalibrationOptions { critical: options, fit: fit_options, .. } = problem.options;
    let translation = critical::fit_translation(observations, views, points, fit.noise, options.epipolar_limit, stop)
        .filter(|found| !fit.refutes(&Fit::new(found.cost, found.unknowns, problem), fit_options));
    let flat = homography::median_residual(observations, views, fit.noise, options.homography_limit)
        .and_then(|residual| without_parallax(problem, fit, residual, translation.is_some(), scale_px, stop));
    if let Some(flat) = flat {
        return Critical { warnings: vec![flat], translation: None };
    }
    let Some(translation) = translation else { return Critical { warnings: Vec::new(), translation: None } };
    let detail = "a camera that does not turn leaves the focal length free";
    let warnings =
        vec![pure_translation(&translation.model, options), Warning::new(WarningCode::UnobservableFocal, detail)];
    Critical { warnings, translation: Some(translation.model) }
}

/// What is said where homographies nearly explain the views; `None` where the baselines are short but show depth.
///
/// * `translates`: whether a camera that does not turn explains the views
fn without_parallax(
    problem: &Uncalibrated,
    fit: &Fit,
    residual: f64,
    translates: bool,
    scale_px: f64,
    stop: &StopToken,
) -> Option<Warning> {
    let missed = format!(
        "homographies between the views miss by a median of {residual:.1} standard deviations of the noise ({:.2} px)",
        fit.noise * scale_px
    );
    let (views, points) = (problem.cameras.len(), problem.points.len());
    let fits = critical::fit_without_parallax(problem.observations, views, points, fit.noise, stop);
    let Some((plane, turning)) = fits else {
        let detail = format!("{missed}: the scene is planar, or the camera hardly did more than turn");
        return Some(Warning::new(WarningCode::PlanarOrRotation, detail));
    };
    // The homographies themselves may miss by a little; what a rotation loses is counted from there.
    let by_plane = Fit::new(plane.cost, plane.unknowns, problem);
    let by_turning = Fit::new(turning.cost, turning.unknowns, problem);
    let deviations = by_plane.loss_deviations(by_turning.cost, by_turning.freedom);
    let turns = deviations < problem.options.fit.misfit_deviations;
    let plane_deviations = problem.options.critical.plane_deviations;
    if translates && !turns && fit.loss_deviations(by_plane.cost, by_plane.freedom) > plane_deviations {
        return None;
    }
    let worse = format!("a camera that only turns fits worse than homographies by {deviations:.1} standard deviations");
    let (code, because) = match (turns, translates) {
        (true, true) => (
            WarningCode::PlanarOrRotation,
            "the camera hardly moved, and a turn explains the views as well as a shift".to_owned(),
        ),
        (true, false) => (WarningCode::PureRotation, rotation_in_words(&turning.model, scale_px)),
        (false, _) if problem.focal_per_view => (
            WarningCode::PlanarOrRotation,
            "with a focal length a view, a planar scene and a camera that only turns are not told apart".to_owned(),
        ),
        (false, _) if deviations < plane_deviations => (
            WarningCode::PlanarOrRotation,
            format!("a planar scene is more likely than a camera that only turns; {worse}"),
        ),
        (false, _) => (WarningCode::PlanarScene, format!("the scene is planar; {worse}")),
    };
    Some(Warning::new(code, format!("{missed}: {because}")))
}

fn rotation_in_words(turning: &Rotating, scale_px: f64) -> String {
    format!(
        "a camera that only turns, with a focal length near {:.0} px, explains the views as well as any homographies do",
        turning.intrinsics.focal * scale_px
    )
}

fn pure_translation(translation: &Translating, options: &CriticalOptions) -> Warning {
    let direction = match direction(translation, options.most_off_line) {
        Some(heading) if heading.z != 0.0 && heading.xy().norm() <= options.near_axis * heading.z.abs() => {
            ", along the optical axis"
        }
        Some(_) => ", along a line",
        None => "",
    };
    let detail = format!(
        "the camera moved without turning{direction}: cameras that are not turned to each other explain the views as well \
         as free ones, and every focal length does so alike"
    );
    Warning::new(WarningCode::PureTranslation, detail)
}

/// Direction of the line along which the camera moved, times `K`; `None` where it left the line.
///
/// * `most_off_line`: see [`CriticalOptions`]
fn direction(translation: &Translating, most_off_line: f64) -> Option<Vector3<f64>> {
    let positions = &translation.translations;
    let mean = positions.iter().sum::<Vector3<f64>>() / positions.len().max(1) as f64;
    let mut spread = Matrix3::zeros();
    for position in positions {
        spread += (position - mean) * (position - mean).transpose();
    }
    if spread.iter().any(|value| !value.is_finite()) {
        return None;
    }
    let eigen = spread.symmetric_eigen();
    let along = eigen.eigenvalues.imax();
    let off: f64 = (0..3).filter(|&k| k != along).map(|k| eigen.eigenvalues[k].max(0.0)).sum();
    let is_straight = off <= most_off_line * most_off_line * eigen.eigenvalues[along];
    is_straight.then(|| eigen.eigenvectors.column(along).into_owned())
}
