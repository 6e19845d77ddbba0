//! Self-calibration of a projective reconstruction, with what it is worth.
//!
//! The DAQ residual finds starts, metric bundle adjustment with one calibration for all views decides among them, and
//! nothing is returned without a grade: a motion or scene that carries no calibration is said to.

mod critical;
mod fit;
mod grading;
mod misfit;
mod models;
mod options;
mod search;
#[cfg(test)]
mod tests;
mod verdict;
mod view_focals;

use nalgebra::{Matrix3x4, Vector3, Vector4};

use crate::domain::{FocalPrior, Grade, StopReason, StopToken, Warning, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, IntrinsicsModel, IntrinsicsPrior, Parameter, Reconstruction};
use crate::geometry::bundle::{Options, projective};
use crate::geometry::daq::to_canonical_frame;
use crate::geometry::metric::plane_at_infinity;
use crate::geometry::observation::Observation;

use fit::Fit;
use options::FitOptions;
pub use options::{CalibrationOptions, GradeOptions};

/// A projective reconstruction to calibrate; inliers only.
#[derive(Debug, Clone, Copy)]
pub struct Uncalibrated<'a> {
    /// 3x4, any projective frame and scale.
    pub cameras: &'a [Matrix3x4<f64>],
    /// Homogeneous.
    pub points: &'a [Vector4<f64>],
    /// Normalised image coordinates.
    pub observations: &'a [Observation],
    /// Assumed standard deviation of a coordinate, in normalised units.
    pub noise: f64,
    /// Camera group of each camera; the views of a group share their intrinsics.
    pub group_of: &'a [usize],
    /// What is known of the focal length of each group beforehand.
    pub focal_priors: &'a [Option<FocalPrior>],
    /// Whether every view has a focal length of its own.
    pub focal_per_view: bool,
    pub options: &'a CalibrationOptions,
}

impl Uncalibrated<'_> {
    /// Camera groups.
    pub fn groups(&self) -> usize {
        self.focal_priors.len()
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
    pub metric: Option<Reconstruction>,
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
    /// `n` of the plane `(n, 1)`, in the frame that [`to_canonical_frame`] gives the problem's cameras.
    pub plane_at_infinity: Option<Vector3<f64>>,
    /// Share of the observations in front of their cameras.
    pub cheirality: f64,
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
            plane_at_infinity: None,
            cheirality: 0.0,
            rms_ratio: 1.0,
        }
    }
}

/// The stop token ended the calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped while calibrating: {0:?}")]
pub struct Stopped(pub StopReason);

impl Stopped {
    fn check(stop: &StopToken) -> Result<(), Self> {
        stop.reason().map_or(Ok(()), |reason| Err(Self(reason)))
    }
}

impl From<Stopped> for super::Error {
    fn from(Stopped(reason): Stopped) -> Self {
        Self::Stopped(reason)
    }
}

/// Calibrates a projective reconstruction and grades the result, one a camera group.
///
/// `scale_px` is the length of a normalised unit in pixels, for the words of the warnings.
///
/// # Errors
/// [`Stopped`] when `stop` fired; what stands by then is not worth returning.
pub fn calibrate(problem: &Uncalibrated, scale_px: f64, stop: &StopToken) -> Result<Vec<Outcome>, Stopped> {
    Stopped::check(stop)?;
    let nothing = vec![None; problem.groups()];
    // What is known of one focal length says nothing of a zoom.
    let focal_priors = if problem.focal_per_view { &nothing } else { problem.focal_priors };
    let problem = &Uncalibrated { noise: problem.noise.max(problem.options.fit.least_noise), focal_priors, ..*problem };
    let mut warnings = Vec::new();
    let inliers = observed_points(problem);
    if inliers < problem.options.fit.least_inliers {
        warnings.push(few_inliers(inliers, &problem.options.fit));
    }
    let (cameras, points, fit) = projectively_adjusted(problem, inliers, stop);
    Stopped::check(stop)?;
    let critical = critical::find(problem, &fit, scale_px, stop);
    Stopped::check(stop)?;
    let is_critical = !critical.warnings.is_empty();
    warnings.extend(critical.warnings);
    let choice = models::Choice { problem, scale_px, stop };
    let priors = choice.priors(fit.noise);
    let minima = match (critical.translation, problem.focal_priors) {
        (Some(translation), [Some(focal)]) => {
            search::known_focal(&translation, focal.focal_px / scale_px, problem, &priors, stop)
        }
        _ if is_critical => return Ok(problem.refused(&warnings)),
        _ => match to_canonical_frame(&cameras, &points) {
            Some(frame) => search::minima(&frame, problem, &priors, stop)?,
            None => Vec::new(),
        },
    };
    if minima.is_empty() {
        warnings.push(no_start());
        return Ok(problem.refused(&warnings));
    }
    let mut outcomes = grading::grade(&choice, &fit, minima, warnings)?;
    for outcome in &mut outcomes {
        outcome.plane_at_infinity =
            outcome.metric.as_ref().and_then(|metric| plane_at_infinity(problem.cameras, &metric.cameras()));
    }
    Ok(outcomes)
}

/// Calibrates a reconstruction that is metric already, as a sequence is that grew from a calibrated block: its focal
/// length is known to be near a minimum, and others are looked for only where this one is not certain.
///
/// * `problem`: the projective cameras and points of `metric`
/// * `heartbeat`: called after each of its steps, of which a large problem takes some tenths of a second
///
/// # Errors
/// As [`calibrate`].
pub fn from_metric(
    problem: &Uncalibrated,
    metric: &Reconstruction,
    scale_px: f64,
    stop: &StopToken,
    heartbeat: &mut dyn FnMut(),
) -> Result<Vec<Outcome>, Stopped> {
    Stopped::check(stop)?;
    let nothing = vec![None; problem.groups()];
    let focal_priors = if metric.has_own_focals() { &nothing } else { problem.focal_priors };
    let problem = &Uncalibrated { noise: problem.noise.max(problem.options.fit.least_noise), focal_priors, ..*problem };
    let mut warnings = Vec::new();
    let inliers = observed_points(problem);
    if inliers < problem.options.fit.least_inliers {
        warnings.push(few_inliers(inliers, &problem.options.fit));
    }
    let (_, _, fit) = projectively_adjusted(problem, inliers, stop);
    Stopped::check(stop)?;
    heartbeat();
    let critical = critical::find(problem, &fit, scale_px, stop);
    Stopped::check(stop)?;
    heartbeat();
    // A plane under tilted views determines a focal length (Triggs 1998): of a reconstruction that is metric already,
    // sigma says how well, and the warning describes the scene.
    let is_critical = critical.warnings.iter().any(|warning| warning.code != WarningCode::PlanarScene);
    warnings.extend(critical.warnings);
    if is_critical {
        return Ok(problem.refused(&warnings));
    }
    let choice = models::Choice { problem, scale_px, stop };
    let minima = search::minima_near(metric, problem, &choice.priors(fit.noise), stop, heartbeat)?;
    if minima.is_empty() {
        warnings.push(no_start());
        return Ok(problem.refused(&warnings));
    }
    grading::grade(&choice, &fit, minima, warnings)
}

/// The log focal length that a metric reconstruction has by these observations alone, the mean of those of its views
/// where each has its own, the rest of the lens held, and its standard deviation; `None` where that is not finite.
pub fn focal_alone(
    problem: &Uncalibrated,
    metric: &Reconstruction,
    prior: &IntrinsicsPrior,
    stop: &StopToken,
) -> Option<(f64, f64)> {
    let start = search::Minimum { reconstruction: metric.clone(), cost: f64::INFINITY, cheirality: 0.0 };
    let priors = vec![prior.forgetting(Parameter::LogFocal)];
    let model = IntrinsicsModel::focal(metric.has_own_focals());
    let minimum = start.adjusted(problem, model, &priors, stop);
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

/// The projective reconstruction at its minimum, and how well it fits.
fn projectively_adjusted(
    problem: &Uncalibrated,
    inliers: usize,
    stop: &StopToken,
) -> (Vec<Matrix3x4<f64>>, Vec<Vector4<f64>>, Fit) {
    let (mut cameras, mut points) = (problem.cameras.to_vec(), problem.points.to_vec());
    let options = Options::squared(problem.options.fit.projective_iterations);
    let report = projective::adjust(&mut cameras, &mut points, problem.observations, &options, stop);
    (cameras, points, Fit::projective(report.cost, problem, inliers, 0))
}

/// Points with an observation.
fn observed_points(problem: &Uncalibrated) -> usize {
    let mut seen = vec![false; problem.points.len()];
    for observation in problem.observations {
        if let Some(seen) = seen.get_mut(observation.point) {
            *seen = true;
        }
    }
    seen.iter().filter(|seen| **seen).count()
}
