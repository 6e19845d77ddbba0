//! Self-calibration with a focal length a view.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::fit::Fit;
use super::models::{CHI_SQUARE_GAIN, Choice};
use super::search::{self, CONVERGED, FIRST_ITERATIONS, FIRST_TOLERANCE, OTHER_FOCALS, converge};
use super::verdict::{UNOBSERVABLE_ABOVE, Verdict};
use super::{Outcome, Problem, Stopped, no_start};
use crate::domain::{Grade, StopToken, Warning, WarningCode};
use crate::geometry::bundle::Options;
use crate::geometry::bundle::metric::{IntrinsicsModel, IntrinsicsPrior, Parameter};
use crate::geometry::bundle::zoom::Zooming;
use crate::geometry::daq::{self, FirstViewFrame, to_first_view_frame};
use crate::geometry::metric::{cheirality, upgrade_zooming};

/// Best quadrics that are adjusted, beside the reconstructions with a constant focal length.
const STARTS: usize = 8;
/// What a lens that is not estimated may add to the log focal lengths, one standard deviation: a k1 of -.03 moved them
/// by 8 %, one of -.05 by 14 %, and neither shows in the fit. No zoom is METRIC for it.
const LENS_SIGMA: f64 = 0.05;
/// Difference in the mean log focal length, and share of the cost, within which minima are the same.
const SAME_MINIMUM: f64 = 0.01;
const SAME_COST: f64 = 0.01;

/// A converged reconstruction.
#[derive(Debug, Clone)]
struct Minimum {
    zooming: Zooming,
    cost: f64,
}

impl Minimum {
    fn adjusted(mut zooming: Zooming, problem: &Problem, options: &Options, stop: &StopToken) -> Self {
        let report = zooming.adjust(problem.observations, options, stop);
        Self { zooming, cost: report.cost }
    }

    fn mean_log_focal(&self) -> f64 {
        self.zooming.mean_log_focal()
    }
}

/// Calibrates with a focal length a view and grades the result; principal point in the centre, square pixels, no
/// distortion, and priors on the focal length are not looked at.
///
/// Sigma is the root mean square over the views of the standard deviations of their log focal lengths, with what an
/// unknown lens adds.
///
/// * `fit`: of the projective cameras
pub(super) fn calibrate(
    frame: &FirstViewFrame,
    choice: &Choice,
    fit: &Fit,
    warnings: Vec<Warning>,
) -> Result<Outcome, Stopped> {
    let minima = minima(frame, choice.problem, choice.stop)?;
    Ok(grade(choice, fit, &minima, warnings))
}

/// The same of a reconstruction that is near a minimum.
pub(super) fn calibrate_near(
    zooming: &Zooming,
    choice: &Choice,
    fit: &Fit,
    warnings: Vec<Warning>,
) -> Result<Outcome, Stopped> {
    let starts = std::iter::once(1.0).chain(OTHER_FOCALS).map(|factor| {
        let focals = zooming.focals.iter().map(|focal| factor * focal).collect();
        Zooming { focals, ..zooming.clone() }
    });
    let minima = converged(starts.collect(), choice.problem, choice.stop)?;
    Ok(grade(choice, fit, &minima, warnings))
}

/// The mean log focal length that a reconstruction has by these observations alone, and the root mean square of the
/// standard deviations of the log focal lengths; `None` where that is not finite.
pub(super) fn alone(problem: &Problem, zooming: &Zooming, stop: &StopToken) -> Option<(f64, f64)> {
    let minimum = Minimum::adjusted(zooming.clone(), problem, &converge(), stop);
    let sigma = deviation(&minimum, fit_of(&minimum, problem).noise, problem)?;
    let log_focal = minimum.mean_log_focal();
    (log_focal.is_finite() && sigma > 0.0 && sigma.is_finite()).then_some((log_focal, sigma))
}

fn fit_of(minimum: &Minimum, problem: &Problem) -> Fit {
    let unknowns = 7 * problem.cameras.len() + 3 * super::observed_points(problem);
    Fit::new(minimum.cost, unknowns.saturating_sub(7), problem)
}

/// Root mean square of the standard deviations of the log focal lengths under this noise.
fn deviation(minimum: &Minimum, noise: f64, problem: &Problem) -> Option<f64> {
    let variances = minimum.zooming.log_focal_variances(problem.observations);
    let sum: Option<f64> = variances.iter().copied().sum();
    sum.map(|sum| (sum / variances.len().max(1) as f64).sqrt() * noise)
}

/// Grades the first of these minima, cheapest first.
fn grade(choice: &Choice, fit: &Fit, minima: &[Minimum], mut warnings: Vec<Warning>) -> Outcome {
    let Choice { problem, scale_px, .. } = *choice;
    let Some((best, others)) = minima.split_first() else {
        warnings.push(no_start());
        return Outcome::refused(warnings);
    };
    let own = fit_of(best, problem);
    let sigma = deviation(best, own.noise, problem);
    let sigma = sigma.map(|sigma| sigma.hypot(LENS_SIGMA)).filter(|sigma| *sigma < UNOBSERVABLE_ABOVE);

    let mut verdict = Verdict::new(warnings);
    verdict.judge_sigma(sigma);
    let close = |other: &&Minimum| other.cost - best.cost < CHI_SQUARE_GAIN * own.noise.powi(2);
    if let Some(rival) = others.iter().find(close) {
        let detail = format!(
            "focal lengths around {:.1} px instead of {:.1} px explain the data about as well",
            rival.mean_log_focal().exp() * scale_px,
            best.mean_log_focal().exp() * scale_px
        );
        verdict.cap(Grade::ProjectiveOnly, WarningCode::SecondMinimum, detail);
    }
    let metric = best.zooming.at_mean_focal();
    let in_front = cheirality(&metric, problem.observations);
    let rms_ratio = verdict.judge_fit(fit, &own, "a focal length a view", scale_px);
    verdict.judge_cheirality(in_front);
    Outcome {
        sigma_log_focal: verdict.told(sigma),
        sigma_ratios: [None; Parameter::COUNT],
        grade: verdict.grade,
        warnings: verdict.warnings,
        model: IntrinsicsModel::FOCAL,
        plane_at_infinity: plane_at_infinity(problem, &best.zooming),
        cheirality: in_front,
        rms_ratio,
        metric: Some(metric),
        focals: Some(best.zooming.focals.clone()),
    }
}

/// The plane at infinity of the caller's cameras that goes best with the reconstruction, in the frame that
/// [`to_first_view_frame`] gives them: `A - a n' ~ K R K1^-1` for every `P = [A|a]`, linear in `n` and the scales.
fn plane_at_infinity(problem: &Problem, zooming: &Zooming) -> Option<Vector3<f64>> {
    let frame = to_first_view_frame(problem.cameras, &[])?;
    let calibration = |focal: f64| Matrix3::from_diagonal(&Vector3::new(focal, focal, 1.0));
    let back = zooming.poses.first()?.rotation.transpose() * calibration(*zooming.focals.first()?).try_inverse()?;
    let (mut normal, mut target) = (Matrix3::zeros(), Vector3::zeros());
    for ((camera, pose), focal) in frame.cameras.iter().zip(&zooming.poses).zip(&zooming.focals) {
        let infinite = calibration(*focal) * pose.rotation * back;
        let infinite = SVector::<f64, 9>::from_column_slice((infinite / infinite.norm()).as_slice());
        // Entry (row, column) of `A` is at 3 column + row, and `a_row n_column` beside it.
        let by_plane =
            SMatrix::<f64, 9, 3>::from_fn(|k, column| if k / 3 == column { camera[(k % 3, 3)] } else { 0.0 });
        let without_scale = by_plane - infinite * (infinite.transpose() * by_plane);
        let left = SVector::<f64, 9>::from_column_slice(camera.fixed_columns::<3>(0).into_owned().as_slice());
        normal += without_scale.transpose() * by_plane;
        target += without_scale.transpose() * left;
    }
    let plane = normal.try_inverse()? * target;
    plane.iter().all(|value| value.is_finite()).then_some(plane)
}

/// Reconstructions that different starts converge to, cheapest first.
fn minima(frame: &FirstViewFrame, problem: &Problem, stop: &StopToken) -> Result<Vec<Minimum>, Stopped> {
    let mut starts: Vec<Zooming> = daq::zoom_starts(&frame.cameras)
        .into_iter()
        .take(STARTS)
        .filter_map(|(daq, _)| upgrade_zooming(frame, &daq, problem.observations))
        .collect();
    let constant = search::minima(frame, problem, &IntrinsicsPrior::NONE, stop)?;
    starts.extend(constant.iter().map(|minimum| Zooming::from(&minimum.reconstruction)));
    converged(starts, problem, stop)
}

/// The minima that these starts converge to, cheapest first.
fn converged(starts: Vec<Zooming>, problem: &Problem, stop: &StopToken) -> Result<Vec<Minimum>, Stopped> {
    let first = Options { max_iterations: FIRST_ITERATIONS, relative_tolerance: FIRST_TOLERANCE, ..Options::default() };
    let mut found = Vec::with_capacity(starts.len());
    for start in starts {
        Stopped::check(stop)?;
        found.push(Minimum::adjusted(start, problem, &first, stop));
    }
    let mut found = distinct(found);
    found.truncate(CONVERGED);
    for minimum in &mut found {
        Stopped::check(stop)?;
        *minimum = Minimum::adjusted(minimum.zooming.clone(), problem, &converge(), stop);
    }
    Ok(distinct(found))
}

/// Cheapest first, without those that repeat a cheaper one.
fn distinct(mut found: Vec<Minimum>) -> Vec<Minimum> {
    found.retain(|minimum| minimum.cost.is_finite() && minimum.mean_log_focal().is_finite());
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let mut kept: Vec<Minimum> = Vec::with_capacity(found.len());
    for candidate in found {
        let repeats = kept.iter().any(|minimum| {
            (candidate.mean_log_focal() - minimum.mean_log_focal()).abs() < SAME_MINIMUM
                && candidate.cost < (1.0 + SAME_COST) * minimum.cost
        });
        if !repeats {
            kept.push(candidate);
        }
    }
    kept
}
