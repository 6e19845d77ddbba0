//! What windows of a sequence say of each other's focal length.

use super::model::Model;
use super::options::WindowOptions;
use super::{adjust, calibrated_views};
use crate::domain::Task;
use crate::solver::calibration::{self, Outcome};
use crate::solver::error::Error;
use crate::solver::fusion::{Estimate, fuse, raise};
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

const OPTIONS: WindowOptions = WindowOptions::DEFAULT;

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
    let apart = fused.log_focal - model.log_focal(camera, &of_camera(problem, model, camera));
    // The windows' own formal variance is taken off: only what lies beyond it raises the sigma of the whole.
    let beyond = |value: f64| (value.powi(2) - fused.formal.powi(2)).max(0.0).sqrt();
    // Windows that know little differ, and are apart from the whole, by chance.
    let by_spread = if fused.differ() { own.hypot(of_whole(beyond(fused.sigma), own, fused.formal)) } else { own };
    let is_apart = apart.abs() > OPTIONS.significant_distance * fused.formal && beyond(apart) > by_spread;
    let count = estimates.len();
    let (sigma, reason) = match is_apart {
        true => (
            beyond(apart),
            format!(
                "{count} windows of the sequence together have a focal length that differs by {:.2} % from that of all \
                 views, {:.1} standard deviations of theirs",
                100.0 * apart.abs(),
                apart.abs() / fused.formal
            ),
        ),
        false => (by_spread, fused.spread(&format!("{count} windows of the sequence"))),
    };
    raise(outcome, sigma, &reason, &problem.calibration_options.grades);
    Ok(())
}

/// What the spread of windows about their mean says of the whole, which knows more than they do. Where wrong
/// observations move them, each by some of its own sigmas, the whole is moved by as many of its own (Birge's ratio);
/// where the model is wrong, it may be moved by as much as they are. Which of the two it is they do not tell: the
/// geometric mean of both. Of two windows of four views that knew a tenth of the whole, whose error was .14 %, the
/// first reading made a sigma of .4 %, the second one of 3.6 %. A mean that is off that of the whole counts in full.
///
/// * `spread`: what the sigma of the mean has beyond the formal one
/// * `own`: sigma of the whole
/// * `formal`: sigma of the mean, were the windows to differ by chance
fn of_whole(spread: f64, own: f64, formal: f64) -> f64 {
    spread * (own / formal).min(1.0).sqrt()
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
    let extract = calibrated_views::core(problem, model, views, OPTIONS.of_view);
    let (metric, _) = extract.block(problem);
    let (cameras, points) = calibrated_views::projective(&metric);
    let (observations, group_of) = (&extract.observations, &metric.group_of);
    let to_calibrate = problem.uncalibrated((&cameras, &points), observations, model.noise, group_of, &[None], &|| ());
    let prior = adjust::intrinsics_prior(problem, camera, model.noise);
    let (log_focal, sigma) = calibration::focal_alone(&to_calibrate, &metric, &prior)?;
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
    let long: Vec<&Vec<usize>> = components.iter().filter(|views| views.len() >= OPTIONS.least_views).collect();
    // One component is halved, so that there is something to compare; the halves of a short one overlap.
    if let [views] = long.as_slice()
        && views.len() < 2 * OPTIONS.least_views
    {
        return [&views[..OPTIONS.least_views], &views[views.len() - OPTIONS.least_views..]]
            .map(<[usize]>::to_vec)
            .to_vec();
    }
    let least = if long.len() == 1 { 2 } else { 1 };
    let of_component = |views: &Vec<usize>| -> Vec<Vec<usize>> {
        let count = (views.len() / OPTIONS.views).max(least);
        let run = |k: usize| views[k * views.len() / count..(k + 1) * views.len() / count].to_vec();
        (0..count).map(run).filter(|run| run.len() >= OPTIONS.least_views).collect()
    };
    let all: Vec<Vec<usize>> = long.into_iter().flat_map(of_component).collect();
    let step = all.len().div_ceil(OPTIONS.most_windows).max(1);
    all.into_iter().step_by(step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimates(values: &[(f64, f64)]) -> Vec<Estimate> {
        values.iter().map(|&(log_focal, sigma)| Estimate { log_focal, sigma }).collect()
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
    fn windows_that_know_little_say_little() {
        for (own, expected) in [(0.003, 0.01), (0.012, 0.02), (0.048, 0.04), (0.1, 0.04)] {
            assert!((of_whole(0.04, own, 0.048) - expected).abs() < 1e-12, "{own}");
        }
    }

    #[test]
    fn windows_are_runs_of_about_ten() {
        // Components of these many views, numbered through.
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
        assert_eq!(lengths(&[1000]).len(), OPTIONS.most_windows);
    }
}
