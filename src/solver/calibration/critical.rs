//! Motions and scenes of which projective cameras do not tell the calibration, and which of them it is.

use nalgebra::{Matrix3, Vector3};

use super::Uncalibrated;
use super::fit::Fit;
use super::misfit;
use super::models::Choice;
use super::options::{CalibrationOptions, CriticalOptions};
use crate::domain::{Warning, WarningCode};
use crate::geometry::bundle::critical::{Homographies, Translating};
use crate::geometry::bundle::metric::MetricReconstruction;
use crate::geometry::critical;
use crate::geometry::homography;

/// What kind of motion and scene the views show.
pub(super) struct Critical {
    /// What describes it; empty where it is nothing special.
    pub warnings: Vec<Warning>,
    pub upgrade: Upgrade,
}

/// What a metric reconstruction may be found from.
pub(super) enum Upgrade {
    /// The dual absolute quadric of projective cameras, and, where the scene may be a plane behind a lens, or nearly
    /// one, its homographies.
    Quadric(Option<Homographies>),
    /// Homographies: a plane (Triggs 1998).
    Plane(Homographies),
    /// A camera that only turned (Hartley 1997), and the fit of what it is a special case of.
    Rotation { metric: MetricReconstruction, free: Fit },
    /// A camera that moved without turning, where its scene has depth: a focal length that is known otherwise makes it
    /// metric.
    Translation(Translating),
    /// Nothing.
    None,
}

/// What kind of motion and scene the views of this consensus show.
///
/// * `fit`: the projective cameras that every model is tested against
pub(super) fn find(choice: &Choice, fit: &Fit) -> Critical {
    let Choice { problem, stop, .. } = *choice;
    let (observations, views) = (problem.observations, problem.cameras.len());
    let points = problem.points.len();
    let CalibrationOptions { critical: options, fit: fit_options, .. } = problem.options;
    let translation = critical::fit_translation(observations, views, points, fit.noise, options.epipolar_limit, stop)
        .filter(|found| !fit.refutes(&Fit::new(found.cost, found.unknowns, problem), fit_options));
    let mut plane = None;
    if let Some(residual) = homography::median_residual(observations, views, fit.noise, options.lens_limit) {
        match without_parallax(choice, fit, residual, translation.is_some()) {
            Ok(flat) => return flat,
            Err(homographies) => plane = homographies,
        }
    }
    let Some(translation) = translation else {
        return Critical { warnings: Vec::new(), upgrade: Upgrade::Quadric(plane) };
    };
    let warnings = vec![pure_translation(&translation.model, options), not_turning()];
    Critical { warnings, upgrade: Upgrade::Translation(translation.model) }
}

fn not_turning() -> Warning {
    Warning::new(WarningCode::UnobservableFocal, "a camera that does not turn leaves the focal length free")
}

/// What the views show where homographies nearly explain them; otherwise the homographies, if there are any.
///
/// * `residual`: by how much homographies miss, see [`homography::median_residual`]
/// * `translates`: whether a camera that does not turn explains the views
fn without_parallax(
    choice: &Choice,
    fit: &Fit,
    residual: f64,
    translates: bool,
) -> Result<Critical, Option<Homographies>> {
    let Choice { problem, scale_px, stop } = *choice;
    let CalibrationOptions { critical: options, fit: fit_options, .. } = problem.options;
    let is_flat = residual < options.homography_limit;
    let missed = format!(
        "homographies between the views miss by a median of {residual:.1} standard deviations of the noise ({:.2} px)",
        fit.noise * scale_px
    );
    let Uncalibrated { observations, group_of, focal_per_view, points, .. } = *problem;
    let priors = choice.priors(fit.noise);
    let fits =
        critical::fit_without_parallax(observations, group_of, focal_per_view, &priors, points.len(), fit.noise, stop);
    let Some((plane, rotation)) = fits else {
        if !is_flat {
            return Err(None);
        }
        let detail = format!("{missed}: the scene is planar, or the camera hardly did more than turn");
        let reason = "the views share too few points for homographies to tie them together";
        let warnings = vec![
            Warning::new(WarningCode::PlanarOrRotation, detail),
            Warning::new(WarningCode::UnobservableFocal, reason),
        ];
        return Ok(Critical { warnings, upgrade: Upgrade::None });
    };
    // The homographies themselves may miss by a little; what a rotation loses is counted from there. They are those of
    // pinholes, though.
    let by_plane = Fit::new(plane.cost, plane.unknowns, problem);
    let by_rotation = Fit::new(rotation.cost, rotation.unknowns, problem);
    let free = if is_flat { by_plane } else { *fit };
    let deviations = free.loss_deviations(by_rotation.cost, by_rotation.freedom);
    let plane_deviations = options.plane_deviations;
    // Of few views it may have more unknowns than what it is tested against, and neither shows parallax behind a lens:
    // projective cameras do, once that is undone.
    let turns = by_rotation.freedom > free.freedom && deviations < fit_options.misfit_deviations && {
        let by_views = misfit::projective_without_lens(&rotation.model, problem, stop);
        by_views.loss_deviations(by_rotation.cost, by_rotation.freedom) < plane_deviations
    };
    let has_depth = fit.loss_deviations(by_plane.cost, by_plane.freedom) > plane_deviations;
    if !turns && (!is_flat || translates && has_depth) {
        return Err(Some(plane.model));
    }
    let worse = format!("a camera that only turns fits worse than homographies by {deviations:.1} standard deviations");
    let (code, because) = match (turns, translates) {
        (true, true) => (
            WarningCode::PlanarOrRotation,
            "the camera hardly moved, and a turn explains the views as well as a shift".to_owned(),
        ),
        (true, false) => (
            WarningCode::PureRotation,
            match is_flat {
                true => "a camera that only turns explains the views as well as they do".to_owned(),
                false => {
                    "a camera that only turns, behind a lens, explains the views as well as free cameras".to_owned()
                }
            },
        ),
        (false, _) if deviations < plane_deviations => (
            WarningCode::PlanarOrRotation,
            format!("a planar scene is more likely than a camera that only turns; {worse}"),
        ),
        (false, _) => (WarningCode::PlanarScene, format!("the scene is planar; {worse}")),
    };
    let mut warnings = vec![Warning::new(code, format!("{missed}: {because}"))];
    let upgrade = match (turns, translates) {
        (true, false) => Upgrade::Rotation { metric: rotation.model, free },
        (false, false) if has_depth => Upgrade::Quadric(Some(plane.model)),
        (false, false) => Upgrade::Plane(plane.model),
        (_, true) => {
            warnings.push(not_turning());
            Upgrade::None
        }
    };
    Ok(Critical { warnings, upgrade })
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
        "the camera moved without turning{direction}: cameras that are not turned to each other explain the views as \
         well as free ones, and every focal length does so alike"
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
