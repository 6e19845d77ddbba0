//! What is told of focal lengths where every view has its own, and whether views have where they were taken to share
//! one.

use super::averaging::Sigmas;
use super::fit::Fit;
use super::models::Candidate;
use super::options::{GradeOptions, LensOptions};
use super::verdict::Verdict;
use super::{Uncalibrated, ViewFocal};
use crate::domain::{Grade, WarningCode};
use crate::geometry::bundle::metric::{Extension, IntrinsicsModel, MetricReconstruction};
use crate::geometry::bundle::sequence;
use crate::geometry::statistics::{median, root_mean_square};

/// The focal length of each view, undetermined where it is.
pub(super) fn of(best: &Candidate, sigmas: &Sigmas, options: &LensOptions) -> Vec<ViewFocal> {
    let focals = best.minimum.reconstruction.focals.iter().zip(&sigmas.view_focals);
    let of_view = |(&focal, sigma): (&f64, &Option<f64>)| {
        let sigma_log = sigma.map(|sigma| sigma.hypot(options.zoom_sigma)).filter(|_| options.is_plausible(focal));
        ViewFocal { focal, sigma_log }
    };
    focals.map(of_view).collect()
}

/// Whether the observations determine the focal length of a view.
pub(super) fn is_determined(view: &ViewFocal, options: &GradeOptions) -> bool {
    view.sigma_log.is_some_and(|sigma| sigma <= options.weak_up_to)
}

/// Leaves what is not determined without a sigma.
pub(super) fn forget_undetermined(view: &mut ViewFocal, options: &GradeOptions) {
    view.sigma_log = view.sigma_log.filter(|sigma| *sigma <= options.weak_up_to);
}

/// Says which of the views are undetermined; returns sigma, the root mean square of that of the others. Where most are,
/// that is the median of all, `None` if it is beyond all bounds.
pub(super) fn judge(verdict: &mut Verdict, focals: &[ViewFocal]) -> Option<f64> {
    let options = &verdict.options.grades;
    let mut all: Vec<f64> = focals.iter().map(|view| view.sigma_log.unwrap_or(f64::INFINITY)).collect();
    let determined: Vec<f64> =
        focals.iter().filter(|view| is_determined(view, options)).filter_map(|view| view.sigma_log).collect();
    let sigma = root_mean_square(&determined);
    if (determined.len() as f64) < options.least_determined * focals.len() as f64 || sigma.is_none() {
        let is_bounded = |sigma: &f64| *sigma > options.weak_up_to && *sigma < options.unobservable_above;
        let typical = Some(median(&mut all)).filter(is_bounded);
        verdict.judge_sigma(typical, 1.0);
        return typical;
    }
    if determined.len() < focals.len() {
        verdict.cap(
            Grade::Weak,
            WarningCode::UnobservableFocal,
            format!(
                "the focal lengths of {} of {} views are not determined: these have neither focal length nor pose",
                focals.len() - determined.len(),
                focals.len()
            ),
        );
    }
    verdict.judge_sigma(sigma, 1.0);
    sigma
}

/// Geometric mean of those that are determined; `None` where none is.
pub(super) fn mean(focals: &[ViewFocal]) -> Option<f64> {
    let logs: Vec<f64> = focals.iter().filter(|view| view.sigma_log.is_some()).map(|view| view.focal.ln()).collect();
    (!logs.is_empty()).then(|| (logs.iter().sum::<f64>() / logs.len() as f64).exp())
}

/// What the views' own focal lengths are where one for all is contradicted.
pub(super) struct Differing {
    /// Root mean square of what lies between the logarithms of theirs and of the one.
    pub shift: f64,
    /// The smallest and the largest, normalised.
    pub range: (f64, f64),
}

/// Asks whether a focal length a view explains the observations better than one for all of `metric`, behind its lens,
/// by more than chance; if so, what they are.
///
/// * `own`: the fit of `metric`
pub(super) fn differing(metric: &MetricReconstruction, own: &Fit, problem: &Uncalibrated) -> Option<Differing> {
    let options = problem.options;
    let priors = vec![options.lenses.prior(own.noise, None, problem.scale_px); problem.groups()];
    let model = IntrinsicsModel::FOCAL_PER_VIEW.with(Extension::PrincipalPoint).with(Extension::RadialK1);
    let mut freed = metric.clone().with_own_focals();
    let report = sequence::adjust_all(
        &mut freed,
        problem.observations,
        model,
        &priors,
        &options.search.to_convergence(),
        problem.stop,
    );
    if !Fit::metric(report.cost, &freed, model, problem).refutes(own, &options.fit) {
        return None;
    }
    let shift = |(view, focal): (usize, &f64)| (focal / metric.intrinsics_of(view).focal).ln();
    let shifts: Vec<f64> = freed.focals.iter().enumerate().map(shift).collect();
    let (least, most) =
        freed.focals.iter().fold((f64::INFINITY, 0.0f64), |(low, high), focal| (low.min(*focal), high.max(*focal)));
    root_mean_square(&shifts).map(|shift| Differing { shift, range: (least, most) })
}
