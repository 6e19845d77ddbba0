//! Self-calibration of a projective reconstruction, with what it is worth.
//!
//! The DAQ residual finds starts, metric bundle adjustment with one calibration for all views decides among them, and
//! nothing is returned without a grade. Planes and rotations have starts of their own; what leaves the focal length
//! free is refused with the reason.

mod averaging;
mod critical;
mod fit;
mod grading;
mod misfit;
mod models;
mod options;
mod profile;
mod search;
#[cfg(test)]
mod tests;
mod verdict;
mod view_focals;

use nalgebra::{Matrix3x4, Vector4};

use crate::domain::{FocalPrior, Grade, StopToken, Warning, WarningCode};
use crate::geometry::bundle::critical::Homographies;
use crate::geometry::bundle::metric::{
    Extension, Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Parameter,
};
use crate::geometry::bundle::{Options, projective};
use crate::geometry::daq::to_canonical_frame;
use crate::geometry::observation::{self, Observation};
use crate::geometry::planar;
use crate::geometry::statistics::root_mean_square;

use super::error::Error;
use critical::Upgrade;
use fit::Fit;
pub use options::{CalibrationOptions, FitOptions, GradeOptions};

/// A projective reconstruction to calibrate; inliers only.
#[derive(Clone, Copy)]
pub struct Uncalibrated<'a> {
    /// 3x4, any projective frame and scale.
    pub cameras: &'a [Matrix3x4<f64>],
    /// Homogeneous.
    pub points: &'a [Vector4<f64>],
    /// Normalised image coordinates.
    pub observations: &'a [Observation],
    /// Assumed standard deviation of a coordinate, in normalised units.
    pub noise: f64,
    /// Density of a wrong coordinate, see [`Problem::outlier_density`](super::problem::Problem::outlier_density).
    pub outlier_density: f64,
    /// Camera group of each camera; the views of a group share their intrinsics.
    pub group_of: &'a [usize],
    /// What is known of the focal length of each group beforehand.
    pub focal_priors: &'a [Option<FocalPrior>],
    /// Whether every view has a focal length of its own.
    pub focal_per_view: bool,
    /// Length of a normalised unit in pixels.
    pub scale_px: f64,
    pub options: &'a CalibrationOptions,
    pub stop: &'a StopToken,
    /// Called after each adjustment, which of a large problem takes some tenths of a second.
    pub heartbeat: &'a dyn Fn(),
}

impl Uncalibrated<'_> {
    /// Camera groups.
    pub fn groups(&self) -> usize {
        self.focal_priors.len()
    }

    /// How many points have an observation.
    fn observed_points(&self) -> usize {
        observation::observed_points(self.observations, self.points.len())
    }

    /// The same with a noise that has a meaning.
    fn with_least_noise(&self) -> Self {
        Self { noise: self.noise.max(self.options.fit.least_noise), ..*self }
    }

    /// No calibration of any group, for these reasons.
    fn refused(&self, warnings: &[Warning]) -> Vec<Outcome> {
        (0..self.groups()).map(|group| Outcome { group, ..Outcome::refused(warnings.to_vec()) }).collect()
    }
}

/// The focal length of a view that has its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewFocal {
    /// Normalised.
    pub focal: f64,
    /// One standard deviation of its natural logarithm, with what an unknown lens adds. `None`: the observations do not
    /// determine it, and neither it nor the view's pose is to be reported.
    pub sigma_log: Option<f64>,
}

impl ViewFocal {
    /// Whether this focal length, which other observations led to, may be reported as that of the view.
    pub fn stands_as(&self, focal: f64, options: &CalibrationOptions) -> bool {
        self.sigma_log.is_some()
            && options.lenses.is_plausible(focal)
            && (focal / self.focal).ln().abs() <= options.grades.weak_up_to
    }
}

/// What came of it, for one of the camera groups.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Among those that were calibrated together.
    pub group: usize,
    /// Of all groups. `None` when no metric reconstruction was found or looked for. With grade PROJECTIVE_ONLY it may
    /// stand but is not to be used as metric.
    pub metric: Option<MetricReconstruction>,
    /// With a focal length a view: these; the intrinsics of `metric` have the geometric mean of those that are
    /// determined.
    pub focals: Option<Vec<ViewFocal>>,
    /// One standard deviation of the natural logarithm of the focal length; `None`: unobservable.
    pub sigma_log_focal: Option<f64>,
    /// The standard deviation of each intrinsic that the model frees over that of the log focal length, indexed by
    /// [`Parameter`]: what raises the latter raises them all. `None`: not free, or not determined.
    pub sigma_ratios: [Option<f64>; Parameter::COUNT],
    pub grade: Grade,
    pub warnings: Vec<Warning>,
    /// Which intrinsics the data could carry.
    pub model: IntrinsicsModel,
    /// Posterior noise of the metric over that of the projective reconstruction; 1 when the calibration is right.
    pub rms_ratio: f64,
}

impl Outcome {
    /// The intrinsics of its group.
    pub fn intrinsics(&self) -> Option<Intrinsics> {
        self.metric.as_ref().map(|metric| metric.intrinsics[self.group])
    }

    /// The worst of those that were calibrated together, the first of equals; none where there is none.
    pub fn worst(outcomes: Vec<Self>) -> Option<Self> {
        let doubt = |outcome: &Self| outcome.sigma_log_focal.unwrap_or(f64::INFINITY);
        let is_worse = |one: &Self, other: &Self| {
            let worse = one.grade.worse(other.grade);
            worse != other.grade || (one.grade == other.grade && doubt(one) > doubt(other))
        };
        outcomes.into_iter().reduce(|worst, outcome| if is_worse(&outcome, &worst) { outcome } else { worst })
    }

    /// One standard deviation of an intrinsic in the form in which it is adjusted; `None`: not free, or unobservable.
    pub fn sigma(&self, parameter: Parameter) -> Option<f64> {
        Some(self.sigma_ratios[parameter as usize]? * self.sigma_log_focal?)
    }

    /// Raises the standard deviation of the log focal length, and lowers the grade to what that is worth; says so where
    /// that is no calibration.
    pub fn raise_sigma(&mut self, sigma: f64, grades: &GradeOptions) {
        let sigma = self.sigma_log_focal.map_or(sigma, |own| own.max(sigma));
        self.sigma_log_focal = Some(sigma);
        let worth = grades.grade(Some(sigma));
        if worth == Grade::ProjectiveOnly && self.grade != worth {
            self.warnings.push(grades.unobservable(Some(sigma)));
        }
        self.grade = self.grade.worse(worth);
    }

    /// Raises the standard deviation of a calibration whose principal point and aspect are implausible, and says so.
    ///
    /// Wrong observations may fit such a camera, and determine it well. What is known of cameras and what the
    /// observations say contradict each other then, and what these say counts less by Birge's ratio, as where the
    /// caller's prior is contradicted: cropped images whose calibration is well determined keep it. Asked twice, it
    /// grows once. With a focal length a view it is larger already by what lenses differ at other focal lengths.
    ///
    /// * `found`: intrinsics of the group
    /// * `known`: what is known of its focal length beforehand
    pub fn doubt_implausible(
        &mut self,
        found: &Intrinsics,
        known: Option<FocalPrior>,
        options: &CalibrationOptions,
        scale_px: f64,
    ) {
        let deviations = options.lenses.deviations(self.model, found);
        let is_calibrated = self.grade != Grade::ProjectiveOnly && self.focals.is_none();
        let calibrated = self.sigma_log_focal.filter(|_| is_calibrated);
        let (Some(sigma), Some(ratio)) = (calibrated, root_mean_square(&deviations)) else { return };
        if deviations.len() as f64 * ratio.powi(2) <= options.models.significant_gain(deviations.len()) {
            return;
        }
        let aspect = match self.model.contains(Extension::Aspect) {
            true => format!(" and pixels of aspect {:.3}", found.aspect),
            false => String::new(),
        };
        let detail = format!(
            "the camera that fits best has its principal point {:.0} px from where it is expected{aspect}, {ratio:.1} \
             times as far off as is usual; what the tracks say of it counts as much less: cropped or stretched images, \
             a wrong image size, or wrong tracks",
            found.principal_point.norm() * scale_px,
        );
        let warning = Warning::new(WarningCode::ModelMismatch, detail);
        if !self.warnings.contains(&warning) {
            self.warnings.push(warning);
            self.raise_sigma(averaging::widened(sigma, ratio, known), &options.grades);
        }
    }

    /// An outcome without a calibration, for these reasons.
    pub fn refused(warnings: Vec<Warning>) -> Self {
        Self {
            group: 0,
            metric: None,
            focals: None,
            sigma_log_focal: None,
            sigma_ratios: [None; Parameter::COUNT],
            grade: Grade::ProjectiveOnly,
            warnings,
            model: IntrinsicsModel::FOCAL,
            rms_ratio: 1.0,
        }
    }
}

/// Calibrates a projective reconstruction and grades the result, one a camera group.
///
/// # Errors
/// [`Error::Stopped`] when the problem's token fired; what stands by then is not worth returning.
pub fn calibrate(problem: &Uncalibrated) -> Result<Vec<Outcome>, Error> {
    let all = &problem.with_least_noise();
    let supported = critical::without_unsupported(all);
    let of_supported = supported.as_ref().map(|observations| Uncalibrated { observations, ..*all });
    let compared = of_supported.as_ref().map(|some| Compared::new(some, some)).transpose()?;
    // What is not supported may be the scene, where all else stands still in the image, and the depth of a camera that
    // moves straight on.
    let (problem, compared) = match of_supported.as_ref().zip(compared) {
        Some(found) if !matches!(found.1.critical.upgrade, Upgrade::None) => found,
        _ => (all, Compared::new(all, all)?),
    };
    let Compared { cameras, points, mut fit, critical, mut warnings } = compared;
    warnings.extend(critical.warnings);
    if let Upgrade::Rotation { free, .. } = &critical.upgrade {
        fit = *free;
    }
    let priors = problem.priors(fit.noise);
    let search = problem.search(&priors);
    let from_plane = |plane: &Homographies| {
        let group_of = if problem.focal_per_view { &vec![0; problem.cameras.len()] } else { problem.group_of };
        let most = problem.options.search.planar_starts;
        let starts = planar::upgrades(plane, group_of, problem.observations, most, problem.stop);
        search.minima_from(starts)
    };
    let minima = match (critical.upgrade, problem.focal_priors) {
        (Upgrade::Quadric(plane), _) => {
            let mut found = match to_canonical_frame(&cameras, &points) {
                Some(frame) => search.minima(&frame)?,
                None => Vec::new(),
            };
            found.extend(plane.as_ref().map(from_plane).transpose()?.into_iter().flatten());
            search::distinct(found, problem)
        }
        (Upgrade::Plane(plane), _) => from_plane(&plane)?,
        (Upgrade::Rotation { metric, .. }, _) => search.minima_from(vec![metric])?,
        (Upgrade::Translation(translation), [Some(focal)]) => {
            search.known_focal(&translation, focal.focal_px / problem.scale_px)
        }
        (Upgrade::Translation(_) | Upgrade::None | Upgrade::Undecided, _) => return Ok(problem.refused(&warnings)),
    };
    if minima.is_empty() {
        warnings.push(no_start());
        return Ok(problem.refused(&warnings));
    }
    let model = IntrinsicsModel::focal(minima[0].reconstruction.has_own_focals());
    let selection = grading::select(problem, &fit, minima, model, priors, &mut warnings)?;
    grading::grade(problem, &fit, None, selection, warnings)
}

/// Some of the views of a reconstruction, which projective cameras are fitted to where they are too many for that.
#[derive(Clone, Copy)]
pub struct Stretch<'a> {
    pub problem: Uncalibrated<'a>,
    pub metric: &'a MetricReconstruction,
}

/// Calibrates a reconstruction that is metric already, as a sequence is that grew from a calibrated block: its focal
/// length is known to be near a minimum, and others are looked for near it where it may be determined.
///
/// * `problem`: the projective cameras and points of `metric`
/// * `stretch`: the views on which it is compared with projective cameras, of the same camera groups; `None`: all
pub fn from_metric(
    problem: &Uncalibrated,
    metric: &MetricReconstruction,
    stretch: Option<Stretch>,
) -> Result<Vec<Outcome>, Error> {
    let problem = &problem.with_least_noise();
    let stretch = stretch.map(|stretch| Stretch { problem: stretch.problem.with_least_noise(), ..stretch });
    let (on, of_stretch) = stretch.as_ref().map_or((problem, metric), |stretch| (&stretch.problem, stretch.metric));
    // Behind a fisheye neither projective cameras nor homographies hold. Behind a perspective lens they are compared
    // with the images as they are: undone, a plane photographed for calibration was refused, on which metric cameras
    // leave 1.26 times what projective ones do.
    let is_fisheye = of_stretch.intrinsics.iter().any(Intrinsics::is_fisheye);
    let undistorted = is_fisheye.then(|| misfit::undistorted(of_stretch, on.observations));
    let on = &Uncalibrated { observations: undistorted.as_deref().unwrap_or(on.observations), ..*on };
    let Compared { fit, critical, mut warnings, .. } = Compared::new(problem, on)?;
    // The distortion of a fisheye may tell the focal length of a camera that did not turn, and the motion is no reason
    // for a refusal then.
    let may_tell_focal = is_fisheye && !metric.has_common_centre && matches!(critical.upgrade, Upgrade::Translation(_));
    let (of_motion, of_refusal) =
        if may_tell_focal { (Vec::new(), critical.warnings) } else { (critical.warnings, Vec::new()) };
    warnings.extend(of_motion);
    let fit = match (critical.upgrade, metric.has_common_centre) {
        (Upgrade::Rotation { free, .. }, true) => free,
        (Upgrade::Quadric(_) | Upgrade::Plane(_), false) => fit,
        (Upgrade::Translation(_), _) if may_tell_focal => fit,
        (upgrade, has_common_centre) => {
            let detail = match (upgrade, has_common_centre) {
                (Upgrade::Rotation { .. }, _) => "the views together are those of a camera that only turned",
                (Upgrade::Quadric(_) | Upgrade::Plane(_) | Upgrade::Translation(_), true) => {
                    "the views together are not those of a camera that only turned"
                }
                _ => return Ok(problem.refused(&warnings)),
            };
            warnings.push(Warning::new(WarningCode::UnobservableFocal, detail));
            return Ok(problem.refused(&warnings));
        }
    };
    let selection = grading::select_near(problem, &fit, metric, stretch.as_ref(), &mut warnings)?;
    let Some(selection) = selection else {
        warnings.push(no_start());
        return Ok(problem.refused(&warnings));
    };
    let mut outcomes = grading::grade(problem, &fit, stretch, selection, warnings)?;
    for outcome in outcomes.iter_mut().filter(|outcome| outcome.grade == Grade::ProjectiveOnly) {
        outcome.warnings.splice(0..0, of_refusal.iter().cloned());
    }
    Ok(outcomes)
}

/// The log focal length that a metric reconstruction has by these observations alone, the mean of those of its views
/// where each has its own, the rest of the lens held, and its standard deviation; `None` where that is not finite.
pub fn focal_alone(
    problem: &Uncalibrated,
    metric: &MetricReconstruction,
    prior: &IntrinsicsPrior,
) -> Option<(f64, f64)> {
    let priors = vec![prior.forgetting(Parameter::LogFocal)];
    let model = IntrinsicsModel::focal(metric.has_own_focals());
    let minimum = problem.search(&priors).converged(metric.clone(), model);
    let candidate = models::Candidate::new(minimum, model, priors, problem);
    let sigma = candidate.sigma(0, Parameter::LogFocal, model, &candidate.priors)?;
    let log_focal = candidate.minimum.log_focal();
    (log_focal.is_finite() && sigma > 0.0).then_some((log_focal, sigma))
}

/// What is said of fewer inliers than image points alone can verify.
pub fn few_inliers(inliers: usize, options: &FitOptions) -> Warning {
    let least = options.least_inliers;
    let detail = format!("{inliers} inlier tracks cannot be verified by image points alone, which takes {least}");
    Warning::new(WarningCode::FewInliers, detail)
}

fn no_start() -> Warning {
    let detail = "no start of the self-calibration led to a metric reconstruction";
    Warning::new(WarningCode::UnobservableFocal, detail)
}

/// What a calibration is compared with.
struct Compared {
    /// The projective reconstruction at its minimum.
    cameras: Vec<Matrix3x4<f64>>,
    points: Vec<Vector4<f64>>,
    /// How well it fits.
    fit: Fit,
    critical: critical::Critical,
    warnings: Vec<Warning>,
}

impl Compared {
    /// * `on`: the problem, or a stretch of it whose projective cameras are fitted
    fn new(problem: &Uncalibrated, on: &Uncalibrated) -> Result<Self, Error> {
        Error::check(problem.stop)?;
        let options = &problem.options.fit;
        let inliers = problem.observed_points();
        let warnings = if inliers < options.least_inliers { vec![few_inliers(inliers, options)] } else { Vec::new() };
        let (mut cameras, mut points) = (on.cameras.to_vec(), on.points.to_vec());
        let adjustment = Options::squared(options.projective_iterations);
        let report = projective::adjust(&mut cameras, &mut points, on.observations, &adjustment, problem.stop);
        let fit = Fit::projective(report.cost, on, on.observed_points(), 0);
        Error::check(problem.stop)?;
        (problem.heartbeat)();
        let critical = critical::find(on, &fit);
        Error::check(problem.stop)?;
        (problem.heartbeat)();
        Ok(Self { cameras, points, fit, critical, warnings })
    }
}
