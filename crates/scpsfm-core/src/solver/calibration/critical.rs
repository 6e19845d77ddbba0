//! Motions and scenes of which projective cameras do not tell the calibration, and which of them it is.

use std::ops::ControlFlow;

use super::Uncalibrated;
use super::fit::Fit;
use super::misfit;
use super::options::CalibrationOptions;
use crate::domain::{VERIFIED, Warning, WarningCode};
use crate::geometry::bundle::critical::{Homographies, Translating};
use crate::geometry::bundle::metric::{Extension, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction};
use crate::geometry::bundle::projective;
use crate::geometry::critical;
use crate::geometry::homography::{self, LEAST_COMMON};
use crate::geometry::observation::{Observation, observed_points};
use crate::geometry::statistics::{CHI_SQUARE_OF_TWO, core_noise};
use crate::solver::noise_model::evidence;

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
    /// Nothing: the camera did not turn, or hardly moved.
    None,
    /// Nothing: a plane and a rotation explain the views, and give them other focal lengths.
    Undecided,
}

/// The observations that homographies explain, with the points that enough of them verify, where homographies with these
/// are more likely than projective cameras with all; otherwise `None`.
///
/// Behind homographies the fourth columns of the cameras and the depths of the points are free, and fit some of what is
/// wrong: a track that slid along the epipolar lines of a view, or jumped. The evidence asks whether it is more than as
/// many unknowns would fit by chance.
pub(super) fn without_unsupported(problem: &Uncalibrated) -> Option<Vec<Observation>> {
    let Uncalibrated { observations, noise, outlier_density, .. } = *problem;
    let (views, points) = (problem.cameras.len(), problem.points.len());
    homography::median_residual(observations, views, noise, problem.options.critical.lens_limit)?;
    let start = critical::reference_homographies(observations, views, points, noise)?;
    let squared = critical::squared_residuals(&start, observations, noise, problem.stop);
    let unknowns = critical::unknowns_of_homographies(views, observed_points(observations, points));
    let noise_of_homographies = core_noise(squared.iter().map(|squared| squared.sqrt()).collect(), unknowns)?;
    let limit = CHI_SQUARE_OF_TWO * noise_of_homographies.powi(2);
    let mut explained = vec![0; points];
    for (seen, _) in observations.iter().zip(&squared).filter(|(_, squared)| **squared < limit) {
        explained[seen.point] += 1;
    }
    let is_kept = |(seen, squared): &(&Observation, &f64)| **squared < limit && explained[seen.point] >= VERIFIED;
    let kept: Vec<Observation> = observations.iter().zip(&squared).filter(is_kept).map(|(seen, _)| *seen).collect();
    let options = problem.options;
    let [inliers, kept_inliers] = [observations, &kept].map(|seen| observed_points(seen, points));
    let least = (1.0 - options.critical.most_unsupported) * observations.len() as f64;
    let mut of_view = vec![0; views];
    kept.iter().for_each(|seen| of_view[seen.view] += 1);
    let is_enough = kept.len() as f64 >= least
        && kept_inliers >= options.fit.least_inliers
        && of_view.iter().all(|count| *count >= LEAST_COMMON);
    if !is_enough || kept.len() == observations.len() {
        return None;
    }
    let unknowns = unknowns.saturating_sub(2 * (inliers - kept_inliers));
    let of_homographies = evidence(kept.len(), unknowns, noise_of_homographies, outlier_density);
    let of_all = evidence(observations.len(), projective::unknowns(views, inliers), noise, outlier_density);
    (of_homographies > of_all).then_some(kept)
}

/// What kind of motion and scene the views of this consensus show.
///
/// * `fit`: the projective cameras that every model is tested against
pub(super) fn find(problem: &Uncalibrated, fit: &Fit) -> Critical {
    let Uncalibrated { observations, stop, .. } = *problem;
    let (views, points) = (problem.cameras.len(), problem.points.len());
    let CalibrationOptions { critical: options, fit: fit_options, .. } = problem.options;
    let translation = critical::fit_translation(observations, views, points, fit.noise, options.epipolar_limit, stop)
        .filter(|found| !fit.refutes(&Fit::new(found.cost, found.unknowns, problem), fit_options));
    let mut plane = None;
    if let Some(residual) = homography::median_residual(observations, views, fit.noise, options.lens_limit) {
        match without_parallax(problem, fit, residual, translation.is_some()) {
            ControlFlow::Break(found) => return found,
            ControlFlow::Continue(homographies) => plane = homographies,
        }
    }
    let Some(translation) = translation else {
        return Critical { warnings: Vec::new(), upgrade: Upgrade::Quadric(plane) };
    };
    let warnings = vec![pure_translation(), not_turning()];
    Critical { warnings, upgrade: Upgrade::Translation(translation.model) }
}

fn not_turning() -> Warning {
    Warning::new(WarningCode::UnobservableFocal, "a camera that does not turn leaves the focal length free")
}

/// Either a plane or a rotation, and which of them decides on the focal length.
fn undecided(detail: String, reason: &str) -> Critical {
    let warnings =
        vec![Warning::new(WarningCode::PlanarOrRotation, detail), Warning::new(WarningCode::UnobservableFocal, reason)];
    Critical { warnings, upgrade: Upgrade::Undecided }
}

/// What the views show where homographies nearly explain them; otherwise the homographies, if there are any.
///
/// * `residual`: by how much homographies miss, see [`homography::median_residual`]
/// * `translates`: whether a camera that does not turn explains the views
fn without_parallax(
    problem: &Uncalibrated,
    fit: &Fit,
    residual: f64,
    translates: bool,
) -> ControlFlow<Critical, Option<Homographies>> {
    let CalibrationOptions { critical: options, fit: fit_options, .. } = problem.options;
    let is_flat = residual < options.homography_limit;
    let missed = format!(
        "homographies between the views miss by a median of {residual:.1} standard deviations of the noise ({:.2} px)",
        fit.noise * problem.scale_px
    );
    let Uncalibrated { observations, group_of, focal_per_view, stop, .. } = *problem;
    let (views, points) = (problem.cameras.len(), problem.points.len());
    let priors = problem.priors(fit.noise);
    let fits = || {
        let plane = critical::reference_homographies(observations, views, points, fit.noise)?;
        let start = critical::rotation_start(observations, views, points, fit.noise)?;
        let model = IntrinsicsModel::focal(focal_per_view).with_all_extensions();
        let rotation = critical::fit_rotation(&start, observations, group_of, model, &priors, stop)?;
        Some((critical::fit_homographies(plane, observations, critical::ADJUSTMENT_ITERATIONS, stop), rotation, start))
    };
    let Some((plane, rotation, start)) = fits() else {
        if !is_flat {
            return ControlFlow::Continue(None);
        }
        let detail = format!("{missed}: the scene is planar, or the camera hardly did more than turn");
        let reason = "the views share too few points for homographies to tie them together";
        return ControlFlow::Break(undecided(detail, reason));
    };
    let by_plane = Fit::new(plane.cost, plane.unknowns, problem);
    let by_rotation = Fit::new(rotation.cost, rotation.unknowns, problem);
    let has_depth = fit.parallax_deviations(&by_plane, problem) > options.plane_deviations;
    // What a rotation loses is counted from homographies where these hold: they may miss by a little themselves.
    let free = if has_depth { *fit } else { by_plane };
    let deviations = free.loss_deviations(by_rotation.cost, by_rotation.freedom);
    // Of few views it may have more unknowns than what it is tested against, and neither shows parallax behind a lens:
    // projective cameras do, once that is undone.
    let turns = by_rotation.freedom > free.freedom && deviations < fit_options.misfit_deviations && {
        let by_views = misfit::projective_without_lens(&rotation.model, problem);
        by_views.parallax_deviations(&by_rotation, problem) < options.plane_deviations
    };
    if !turns && (!is_flat || translates && has_depth) {
        return ControlFlow::Continue(Some(plane.model));
    }
    if !turns && !translates && !has_depth && !focal_per_view && turns_and_zooms(problem, &start, &by_plane, &priors) {
        let detail = format!("{missed}: a camera that turns and zooms explains the views as well as they do");
        let reason = "a camera that turned and zoomed has other focal lengths than one that moved before a plane: solve \
                      with a focal length a view (focal_per_view) if it zoomed";
        return ControlFlow::Break(undecided(detail, reason));
    }
    let reference = if has_depth { "free cameras" } else { "homographies" };
    let worse = format!("a camera that only turns fits worse than {reference} by {deviations:.1} standard deviations");
    let (code, because) = match (turns, translates) {
        (true, true) => (
            WarningCode::LittleMotion,
            "the camera hardly moved, and a turn explains the views as well as a shift".to_owned(),
        ),
        (true, false) => {
            let behind_lens = "a camera that only turns, behind a lens, explains the views as well as free cameras";
            let as_well = "a camera that only turns explains the views as well as they do";
            (WarningCode::PureRotation, if has_depth { behind_lens } else { as_well }.to_owned())
        }
        (false, _) if deviations < options.plane_deviations => (
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
        (true, true) => {
            let detail = "views that hardly differ leave the focal length free";
            warnings.push(Warning::new(WarningCode::UnobservableFocal, detail));
            Upgrade::None
        }
        (false, true) => {
            warnings.push(not_turning());
            Upgrade::None
        }
    };
    ControlFlow::Break(Critical { warnings, upgrade })
}

/// Whether a camera that only turns, with a focal length of each view, fits as well as homographies.
fn turns_and_zooms(
    problem: &Uncalibrated,
    start: &MetricReconstruction,
    by_plane: &Fit,
    priors: &[IntrinsicsPrior],
) -> bool {
    // What a lens adds to these would explain a plane too.
    let model = IntrinsicsModel::FOCAL_PER_VIEW.with(Extension::PrincipalPoint);
    let of_one = vec![0; problem.cameras.len()];
    let found = critical::fit_rotation(start, problem.observations, &of_one, model, &priors[..1], problem.stop);
    found.is_some_and(|found| {
        let fit = Fit::new(found.cost, found.unknowns, problem);
        fit.freedom > by_plane.freedom && !by_plane.refutes(&fit, &problem.options.fit)
    })
}

fn pure_translation() -> Warning {
    let detail = "the camera moved without turning: cameras that are not turned to each other explain the views as \
                  well as free ones, and every focal length does so alike";
    Warning::new(WarningCode::PureTranslation, detail)
}
