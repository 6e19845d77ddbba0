//! What windows of a sequence say of each other's focal length.
//!
//! The formal uncertainty of one adjustment knows noise and nothing else; distortion beyond the model, a wrong track or
//! a motion that hardly turns moves windows apart by more than it admits. They are fused by information weight, with a
//! common misfit that makes their chi-square what it should be (DerSimonian & Laird 1986).

use super::adjust;
use super::calibrate;
use super::model::Model;
use crate::domain::{Grade, Task, Warning, WarningCode};
use crate::solver::Error;
use crate::solver::calibration::{self, Outcome, grade_of_sigma};
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

/// Views of a window where there are many, and of the shortest one: below, a window says little of a focal length.
const VIEWS: usize = 10;
const LEAST_VIEWS: usize = 4;
/// Windows at most, evenly spread over the sequence: a variance of 50 values is known to a fifth.
const MOST_WINDOWS: usize = 50;
/// Observations of a view that a window holds.
pub const OF_VIEW: usize = 150;
/// Growth of sigma from which a warning says why, and the sigma from which anyone minds: a quarter of a METRIC one.
const WORTH_A_WARNING: f64 = 3.0;
const WORTH_MINDING: f64 = 0.005;

/// Log focal length and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    pub log_focal: f64,
    pub sigma: f64,
}

/// Several estimates as one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fused {
    pub log_focal: f64,
    pub sigma: f64,
    /// Standard deviation of what each has beside its own sigma.
    pub misfit: f64,
    /// Chi-square per degree of freedom without it.
    pub chi_square: f64,
}

/// Raises the sigma of a sequence's calibration to what its windows admit, grades it anew and says so.
pub fn reconcile(
    problem: &Problem,
    model: &Model,
    camera: usize,
    outcome: &mut Outcome,
    recorder: &mut Recorder,
) -> Result<(), Error> {
    let Some(own) = outcome.sigma_log_focal else { return Ok(()) };
    let (estimates, shared) = estimates(problem, model, camera, recorder)?;
    let Some(fused) = fuse(&estimates, shared) else { return Ok(()) };
    let apart = (fused.log_focal - model.log_focal(camera, &of_camera(problem, model, camera))).abs();
    raise(outcome, own.max(fused.sigma).max(apart), &fused, &format!("{} windows of the sequence", estimates.len()));
    Ok(())
}

/// Raises the sigma of one block's calibration by what the estimates of all blocks have beside their own.
pub fn admit_misfit(outcome: &mut Outcome, estimates: &[Estimate]) {
    let fused = fuse(estimates, 0.0).zip(outcome.sigma_log_focal);
    if let Some((fused, own)) = fused.filter(|_| outcome.grade != Grade::ProjectiveOnly) {
        raise(outcome, own.hypot(fused.misfit), &fused, &format!("{} blocks of views", estimates.len()));
    }
}

/// Raises the sigma of a calibration, grades it anew and says so.
fn raise(outcome: &mut Outcome, sigma: f64, fused: &Fused, which: &str) {
    let Some(own) = outcome.sigma_log_focal.replace(sigma) else { return };
    outcome.grade = outcome.grade.worse(grade_of_sigma(Some(sigma)));
    if sigma > WORTH_A_WARNING * own && sigma > WORTH_MINDING {
        let detail = format!(
            "{which} differ in focal length by {:.2} % (one standard deviation beside their own), chi-square {:.1} a \
             degree of freedom; sigma was raised from {:.3} to {:.3} %",
            100.0 * fused.misfit,
            fused.chi_square,
            100.0 * own,
            100.0 * sigma
        );
        outcome.warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
    }
}

/// Views of a camera that say something of it, increasing.
fn of_camera(problem: &Problem, model: &Model, camera: usize) -> Vec<usize> {
    model.determined().into_iter().filter(|&view| problem.camera_of[view] == camera).collect()
}

/// What each window says by itself, the rest of the lens as the whole has it; and the share of its views that two of
/// them have in common.
fn estimates(
    problem: &Problem,
    model: &Model,
    camera: usize,
    recorder: &mut Recorder,
) -> Result<(Vec<Estimate>, f64), Error> {
    let views = of_camera(problem, model, camera);
    let whole = model.log_focal(camera, &views);
    let components = model.component_of.iter().copied().max().unwrap_or(0);
    // Views that say nothing are gaps: what lies on either side may share no track.
    let of_component = |component: u32| -> Vec<Vec<usize>> {
        let mut own = model.of_component(component);
        own.retain(|&view| problem.camera_of[view] == camera);
        own.split(|view| views.binary_search(view).is_err()).map(<[usize]>::to_vec).collect()
    };
    let windows = windows(&(0..=components).flat_map(of_component).collect::<Vec<_>>());
    let of_window = |k: usize| {
        let views = windows.get(k).filter(|_| !problem.stop.is_stopped())?;
        let moved = moved_alone(problem, model, camera, views)?;
        Some(Estimate { log_focal: whole + moved.log_focal, ..moved })
    };
    let mut progress = |k: usize| {
        recorder.step(Task::Windows, k + 1, windows.len(), k as f64 / windows.len() as f64);
    };
    let found = problem.threads.map(windows.len(), 1, of_window, &mut progress);
    problem.stopped()?;
    Ok((found.into_iter().flatten().collect(), shared(&windows)))
}

/// By how much the log focal length of these views, their mean where each has its own, moves where they are alone.
fn moved_alone(problem: &Problem, model: &Model, camera: usize, views: &[usize]) -> Option<Estimate> {
    let extract = calibrate::core(problem, model, views, OF_VIEW);
    let (metric, _) = extract.block();
    let (cameras, points) = calibrate::projective(&metric);
    let projective = calibration::Problem {
        cameras: &cameras,
        points: &points,
        observations: &extract.observations,
        noise: model.noise,
        group_of: &metric.group_of,
        focal_priors: &[None],
        focal_per_view: metric.has_own_focals(),
    };
    let prior = adjust::intrinsics_prior(problem, camera, model.noise);
    let (log_focal, sigma) = calibration::focal_alone(&projective, &metric, &prior, problem.stop)?;
    Some(Estimate { log_focal: log_focal - metric.log_focal(), sigma })
}

/// Share of its views that a window has in common with another. Only the halves of a short run overlap.
fn shared(windows: &[Vec<usize>]) -> f64 {
    let [first, second] = windows else { return 0.0 };
    let common = first.iter().filter(|view| second.contains(view)).count();
    common as f64 / first.len().max(second.len()).max(1) as f64
}

/// Runs of each of these runs of consecutive views, not overlapping but for the halves of a short one; one or none says
/// nothing.
fn windows(components: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let long: Vec<&Vec<usize>> = components.iter().filter(|views| views.len() >= LEAST_VIEWS).collect();
    // One component is halved, so that there is something to compare; the halves of a short one overlap.
    if let [views] = long.as_slice()
        && views.len() < 2 * LEAST_VIEWS
    {
        return [&views[..LEAST_VIEWS], &views[views.len() - LEAST_VIEWS..]].map(<[usize]>::to_vec).to_vec();
    }
    let least = if long.len() == 1 { 2 } else { 1 };
    let of_component = |views: &Vec<usize>| -> Vec<Vec<usize>> {
        let count = (views.len() / VIEWS).max(least);
        let run = |k: usize| views[k * views.len() / count..(k + 1) * views.len() / count].to_vec();
        (0..count).map(run).filter(|run| run.len() >= LEAST_VIEWS).collect()
    };
    let all: Vec<Vec<usize>> = long.into_iter().flat_map(of_component).collect();
    let step = all.len().div_ceil(MOST_WINDOWS).max(1);
    all.into_iter().step_by(step).collect()
}

/// Fuses estimates that have this share of their observations in common, and so err alike by as much; `None` for fewer
/// than two.
pub fn fuse(estimates: &[Estimate], shared: f64) -> Option<Fused> {
    if estimates.len() < 2 {
        return None;
    }
    let weights = |misfit: f64| -> Vec<f64> {
        estimates.iter().map(|estimate| (estimate.sigma.powi(2) + misfit * misfit).recip()).collect()
    };
    // Variance of the weighted sum: what two have in common adds up.
    let variance_of_sum = |weight: &[f64], misfit: f64| -> f64 {
        let own = |(weight, estimate): (&f64, &Estimate)| {
            let squared = estimate.sigma.powi(2);
            weight * weight * (squared * (1.0 - shared) + misfit * misfit)
        };
        let in_common: f64 = weight.iter().zip(estimates).map(|(weight, estimate)| weight * estimate.sigma).sum();
        weight.iter().zip(estimates).map(own).sum::<f64>() + shared * in_common * in_common
    };
    let weight = weights(0.0);
    let total: f64 = weight.iter().sum();
    let mean = weight.iter().zip(estimates).map(|(weight, estimate)| weight * estimate.log_focal).sum::<f64>() / total;
    let statistic: f64 =
        weight.iter().zip(estimates).map(|(weight, estimate)| weight * (estimate.log_focal - mean).powi(2)).sum();
    // What it is expected to be: the number of estimates less one, where they have nothing in common.
    let expected = (estimates.len() as f64 - variance_of_sum(&weight, 0.0) / total).max(f64::MIN_POSITIVE);
    let scale = total - weight.iter().map(|weight| weight * weight).sum::<f64>() / total;
    let misfit = ((statistic - expected).max(0.0) / scale).sqrt();
    let weight = weights(misfit);
    let total: f64 = weight.iter().sum();
    let log_focal =
        weight.iter().zip(estimates).map(|(weight, estimate)| weight * estimate.log_focal).sum::<f64>() / total;
    let sigma = variance_of_sum(&weight, misfit).sqrt() / total;
    let usable = sigma.is_finite() && misfit.is_finite() && log_focal.is_finite();
    usable.then_some(Fused { log_focal, sigma, misfit, chi_square: statistic / expected })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimates(values: &[(f64, f64)]) -> Vec<Estimate> {
        values.iter().map(|&(log_focal, sigma)| Estimate { log_focal, sigma }).collect()
    }

    #[test]
    fn estimates_that_agree_fuse_by_information() {
        let fused = fuse(&estimates(&[(0.0, 0.01), (0.005, 0.01), (-0.003, 0.01), (0.002, 0.01)]), 0.0).expect("four");
        assert_eq!(fused.misfit, 0.0);
        assert!((fused.sigma - 0.005).abs() < 1e-12, "{fused:?}");
        assert_eq!(fuse(&estimates(&[(0.0, 0.01)]), 0.0), None);
    }

    #[test]
    fn estimates_that_differ_by_more_than_they_admit_raise_sigma() {
        let fused = fuse(&estimates(&[(0.1, 0.001), (-0.1, 0.001), (0.1, 0.001), (-0.1, 0.001)]), 0.0).expect("four");
        // Four values of standard deviation .115: their mean is known to half of that.
        assert!((fused.misfit - 0.1155).abs() < 1e-3 && (fused.sigma - 0.0577).abs() < 1e-3, "{fused:?}");
        // One that knows nothing refutes nothing.
        let fused = fuse(&estimates(&[(0.0, 0.001), (0.5, 0.6)]), 0.0).expect("two");
        assert_eq!(fused.misfit, 0.0);
    }

    /// Four views twice are no surer than four views, and two windows that share much and yet differ refute each other
    /// sooner.
    #[test]
    fn what_windows_have_in_common_is_counted_once() {
        let twice = estimates(&[(0.2, 0.01), (0.2, 0.01)]);
        let of_run = |count: usize| shared(&windows(&[(0..count).collect()]));
        assert_eq!([4, 5, 6, 7, 8, 12].map(of_run), [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]);
        let fused = |count: usize| fuse(&twice, of_run(count)).expect("two");
        assert!((fused(4).sigma - 0.01).abs() < 1e-12, "{:?}", fused(4));
        assert!((fused(6).sigma - 0.01 * 0.75f64.sqrt()).abs() < 1e-12, "{:?}", fused(6));
        assert!((fused(8).sigma - 0.01 * 0.5f64.sqrt()).abs() < 1e-12, "{:?}", fused(8));
        // Differences of independent estimates of .01 are .014, of those that share three quarters .007.
        let apart = estimates(&[(0.0, 0.01), (0.01, 0.01)]);
        let misfit = |count: usize| fuse(&apart, of_run(count)).expect("two").misfit;
        assert_eq!(misfit(8), 0.0);
        assert!((misfit(5) - 0.005).abs() < 1e-9, "{}", misfit(5));
    }

    #[test]
    fn windows_are_runs_of_about_ten() {
        // Parts of these many views, numbered through.
        let lengths = |components: &[usize]| -> Vec<usize> {
            let mut views = 0..;
            let components: Vec<Vec<usize>> =
                components.iter().map(|&count| views.by_ref().take(count).collect()).collect();
            windows(&components).iter().map(Vec::len).collect()
        };
        assert!(lengths(&[3]).is_empty());
        assert_eq!(lengths(&[6]), [4, 4]);
        assert_eq!(lengths(&[9]), [4, 5]);
        assert_eq!(lengths(&[11]), [5, 6]);
        assert_eq!(lengths(&[40]), [10; 4]);
        assert_eq!(lengths(&[11, 10, 3]), [11, 10]);
        assert_eq!(lengths(&[1000]).len(), MOST_WINDOWS);
    }
}
