//! Self-calibration with a focal length a view.

use super::fit::Fit;
use super::lens::{LENS_SIGMA, LensTrial};
use super::models::{CHI_SQUARE_GAIN, Choice};
use super::search::{self, CONVERGED, FIRST_ITERATIONS, FIRST_TOLERANCE, FOLLOWING, OTHER_FOCALS, converge};
use super::verdict::{CHEIRALITY_LIMIT, METRIC_BELOW, UNOBSERVABLE_ABOVE, Verdict, WEAK_UP_TO, is_plausible};
use super::{Outcome, Problem, Stopped, ViewFocal, no_start};
use crate::domain::{Grade, StopToken, Warning, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, IntrinsicsModel, IntrinsicsPrior, Parameter, Reconstruction};
use crate::geometry::bundle::zoom::Zooming;
use crate::geometry::bundle::{Observation, Options};
use crate::geometry::daq::{self, FirstViewFrame};
use crate::geometry::metric::{cheirality, plane_at_infinity, upgrade_zooming};
use crate::geometry::statistics::{median, root_mean_square};

/// Best quadrics that are adjusted, beside the reconstructions with a constant focal length.
const STARTS: usize = 8;
/// Difference in log focal length, and share of the cost, within which minima are the same.
const SAME_MINIMUM: f64 = 0.01;
const SAME_COST: f64 = 0.01;
/// Difference in log focal length from which another minimum is another calibration: less is within what even METRIC
/// admits.
const OTHER_CALIBRATION: f64 = METRIC_BELOW;
/// Share of the views whose focal length must be determined: of fewer, what most of the images show says nothing of
/// the camera.
pub const LEAST_DETERMINED: f64 = 0.5;

/// A converged reconstruction.
#[derive(Debug, Clone)]
struct Minimum {
    zooming: Zooming,
    cost: f64,
    cheirality: f64,
}

impl Minimum {
    fn adjusted(mut zooming: Zooming, problem: &Problem, options: &Options, stop: &StopToken) -> Self {
        let report = zooming.adjust(problem.observations, options, stop);
        let cheirality = cheirality(&zooming.at_mean_focal(), problem.observations);
        Self { zooming, cost: report.cost, cheirality }
    }

    fn mean_log_focal(&self) -> f64 {
        self.zooming.mean_log_focal()
    }

    /// Root mean square difference in log focal length of the views that count: not those that no observation
    /// determines.
    fn apart(&self, other: &Self, counts: &[bool]) -> f64 {
        let focals = self.zooming.focals.iter().zip(&other.zooming.focals).zip(counts).filter(|(_, counts)| **counts);
        let differences: Vec<f64> = focals.map(|((own, other), _)| (own / other).ln()).collect();
        root_mean_square(&differences).unwrap_or(0.0)
    }

    /// Geometric mean of the focal lengths of the views that count.
    fn mean_focal(&self, counts: &[bool]) -> f64 {
        let counted = self.zooming.focals.iter().zip(counts).filter(|(_, counts)| **counts);
        let logs: Vec<f64> = counted.map(|(focal, _)| focal.ln()).collect();
        (logs.iter().sum::<f64>() / logs.len() as f64).exp()
    }

    /// Of which views the observations determine the focal length; all where they do of none.
    fn determined(&self, problem: &Problem) -> Vec<bool> {
        let noise = fit_of(self, problem).noise;
        let variances = self.zooming.log_focal_variances(problem.observations);
        let is_determined =
            |variance: &Option<f64>| variance.is_some_and(|variance| variance.sqrt() * noise <= WEAK_UP_TO);
        let determined: Vec<bool> = variances.iter().map(is_determined).collect();
        if determined.contains(&true) { determined } else { vec![true; determined.len()] }
    }
}

/// Calibrates with a focal length a view and grades the result; principal point in the centre, square pixels, no
/// distortion, and priors on the focal length are not looked at.
///
/// Sigma is the root mean square of the standard deviations of the log focal lengths, with what an unknown lens adds,
/// over the views that determine theirs.
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
    told: &mut dyn FnMut(),
) -> Result<Outcome, Stopped> {
    let mut starts = vec![zooming.clone()];
    for factor in OTHER_FOCALS {
        Stopped::check(choice.stop)?;
        told();
        starts.push(scaled(zooming, factor, choice.problem.observations, choice.stop));
    }
    let minima = converged(starts, choice.problem, choice.stop)?;
    told();
    Ok(grade(choice, fit, &minima, warnings))
}

/// The reconstruction with other focal lengths, which its poses and points have followed: freed at once, these would
/// only go back to where they were.
fn scaled(zooming: &Zooming, factor: f64, observations: &[Observation], stop: &StopToken) -> Zooming {
    let mut scaled = zooming.clone();
    scaled.focals.iter_mut().for_each(|focal| *focal *= factor);
    let options = Options { max_iterations: FOLLOWING, ..Options::default() };
    scaled.adjust_held(observations, &options, stop);
    scaled
}

/// The mean log focal length that a reconstruction has by these observations alone, and its standard deviation; `None`
/// where that is not finite.
pub(super) fn alone(problem: &Problem, zooming: &Zooming, stop: &StopToken) -> Option<(f64, f64)> {
    let minimum = Minimum::adjusted(zooming.clone(), problem, &converge(), stop);
    let variance = minimum.zooming.mean_log_focal_variance(problem.observations)?;
    let sigma = variance.sqrt() * fit_of(&minimum, problem).noise;
    let log_focal = minimum.mean_log_focal();
    (log_focal.is_finite() && sigma > 0.0 && sigma.is_finite()).then_some((log_focal, sigma))
}

fn fit_of(minimum: &Minimum, problem: &Problem) -> Fit {
    let unknowns = 7 * problem.cameras.len() + 3 * super::observed_points(problem);
    Fit::new(minimum.cost, unknowns.saturating_sub(7), problem)
}

/// What this noise leaves of each focal length, and what a lens of which more is known would move.
fn focals(minimum: &Minimum, noise: f64, lens: &LensTrial, problem: &Problem) -> Vec<ViewFocal> {
    let variances = minimum.zooming.log_focal_variances(problem.observations);
    let of_view = |((&focal, variance), shift): ((&f64, Option<f64>), &f64)| {
        let sigma = variance.map(|variance| (variance.sqrt() * noise).hypot(LENS_SIGMA).hypot(*shift));
        ViewFocal { focal, sigma_log: sigma.filter(|_| is_plausible(focal)) }
    };
    minimum.zooming.focals.iter().zip(variances).zip(&lens.shifts).map(of_view).collect()
}

/// Leaves those of the views undetermined that are, and says so; returns sigma. Where most are, that is their median,
/// `None` if it is beyond all bounds.
fn judge_focals(verdict: &mut Verdict, focals: &mut [ViewFocal]) -> Option<f64> {
    let mut all: Vec<f64> = focals.iter().map(|view| view.sigma_log.unwrap_or(f64::INFINITY)).collect();
    for view in focals.iter_mut() {
        view.sigma_log = view.sigma_log.filter(|sigma| *sigma <= WEAK_UP_TO);
    }
    let determined: Vec<f64> = focals.iter().filter_map(|view| view.sigma_log).collect();
    let sigma = root_mean_square(&determined);
    if (determined.len() as f64) < LEAST_DETERMINED * focals.len() as f64 || sigma.is_none() {
        let typical = Some(median(&mut all)).filter(|sigma| *sigma > WEAK_UP_TO && *sigma < UNOBSERVABLE_ABOVE);
        verdict.judge_sigma(typical);
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
    verdict.judge_sigma(sigma);
    sigma
}

/// Geometric mean of those that are determined; `None` where none is.
fn mean_focal(focals: &[ViewFocal]) -> Option<f64> {
    let logs: Vec<f64> = focals.iter().filter(|view| view.sigma_log.is_some()).map(|view| view.focal.ln()).collect();
    (!logs.is_empty()).then(|| (logs.iter().sum::<f64>() / logs.len() as f64).exp())
}

/// Grades the first of these minima, cheapest first.
fn grade(choice: &Choice, fit: &Fit, minima: &[Minimum], mut warnings: Vec<Warning>) -> Outcome {
    let Choice { problem, scale_px, .. } = *choice;
    // The cheapest in front of the cameras, if the data do not tell it from the cheapest.
    let in_front = |minimum: &Minimum| minimum.cheirality >= CHEIRALITY_LIMIT;
    let near =
        |of: &Minimum, minimum: &Minimum| minimum.cost - of.cost < CHI_SQUARE_GAIN * fit_of(of, problem).noise.powi(2);
    let place = minima.iter().position(|minimum| in_front(minimum) && near(&minima[0], minimum)).unwrap_or(0);
    let Some(best) = minima.get(place) else {
        warnings.push(no_start());
        return Outcome::refused(warnings);
    };
    let own = fit_of(best, problem);
    let lens = LensTrial::new(&best.zooming, &own, choice);
    let mut focals = focals(best, own.noise, &lens, problem);
    let mut verdict = Verdict::new(warnings);
    verdict.warnings.extend(lens.warning());
    let sigma = judge_focals(&mut verdict, &mut focals);
    let counts: Vec<bool> = focals.iter().map(|view| view.sigma_log.is_some()).collect();
    let is_rival = |other: &&Minimum| {
        other.apart(best, &counts) > OTHER_CALIBRATION && (in_front(other) || !in_front(best)) && near(best, other)
    };
    if let Some(rival) = minima.iter().find(is_rival) {
        let detail = format!(
            "focal lengths around {:.1} px instead of {:.1} px explain the data about as well",
            rival.mean_focal(&counts) * scale_px,
            best.mean_focal(&counts) * scale_px
        );
        let worst = if rival.apart(best, &counts) > WEAK_UP_TO { Grade::ProjectiveOnly } else { Grade::Weak };
        verdict.cap(worst, WarningCode::SecondMinimum, detail);
    }
    let focal = mean_focal(&focals).unwrap_or_else(|| best.mean_log_focal().exp());
    let metric = Reconstruction { intrinsics: Intrinsics::from_focal(focal), ..best.zooming.at_mean_focal() };
    let rms_ratio = verdict.judge_fit(fit, &own, "a focal length a view", scale_px);
    if verdict.is_misfit {
        lens.judge_misfit(&mut verdict, fit);
    }
    verdict.judge_cheirality(best.cheirality);
    Outcome {
        sigma_log_focal: verdict.told(sigma),
        sigma_ratios: [None; Parameter::COUNT],
        grade: verdict.grade,
        warnings: verdict.warnings,
        model: IntrinsicsModel::FOCAL,
        plane_at_infinity: plane_at_infinity(problem.cameras, &best.zooming.cameras()),
        cheirality: best.cheirality,
        rms_ratio,
        metric: Some(metric),
        focals: Some(focals),
    }
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
    let mut found = distinct(found, problem);
    found.truncate(CONVERGED);
    for minimum in &mut found {
        Stopped::check(stop)?;
        *minimum = Minimum::adjusted(minimum.zooming.clone(), problem, &converge(), stop);
    }
    Ok(distinct(found, problem))
}

/// Cheapest first, without those that repeat a cheaper one.
fn distinct(mut found: Vec<Minimum>, problem: &Problem) -> Vec<Minimum> {
    found.retain(|minimum| minimum.cost.is_finite() && minimum.mean_log_focal().is_finite());
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let counts = found.first().map(|cheapest| cheapest.determined(problem)).unwrap_or_default();
    let mut kept: Vec<Minimum> = Vec::with_capacity(found.len());
    for candidate in found {
        let repeats = kept.iter().any(|minimum| {
            candidate.apart(minimum, &counts) < SAME_MINIMUM && candidate.cost < (1.0 + SAME_COST) * minimum.cost
        });
        if !repeats {
            kept.push(candidate);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::bundle::testing::{self, NOISE, TestScene};
    use crate::solver::calibration::tests::of_one_lens;

    fn truth(scene: &TestScene) -> Zooming {
        let focals = vec![scene.intrinsics.focal; scene.poses.len()];
        Zooming { focals, poses: scene.poses.clone(), points: scene.points.clone() }
    }

    fn of_scene<T>(scene: &TestScene, ask: impl FnOnce(&Choice, &Fit) -> T) -> T {
        let (cameras, points) = (scene.cameras(), scene.points.iter().map(|point| point.push(1.0)).collect::<Vec<_>>());
        let problem = Problem { focal_per_view: true, ..of_one_lens(&cameras, &points, &scene.observations, NOISE) };
        let stop = StopToken::default();
        let choice = Choice { problem: &problem, prior: &IntrinsicsPrior::NONE, scale_px: 1000.0, stop: &stop };
        let minimum = Minimum::adjusted(truth(scene), &problem, &converge(), &stop);
        ask(&choice, &fit_of(&minimum, &problem))
    }

    #[test]
    fn another_minimum_that_explains_as_much_is_told() {
        let scene = testing::scene(1, 10, 40, NOISE);
        of_scene(&scene, |choice, fit| {
            let best = Minimum::adjusted(truth(&scene), choice.problem, &converge(), choice.stop);
            let graded_in = |views: usize, factor: f64, cost: f64, cheirality: f64| {
                let mut rival = best.clone();
                rival.zooming.focals.iter_mut().take(views).for_each(|focal| *focal *= factor);
                rival = Minimum { cost: cost * best.cost, cheirality, ..rival };
                let outcome = grade(choice, fit, &[best.clone(), rival], Vec::new());
                (outcome.grade, outcome.warnings.iter().any(|warning| warning.code == WarningCode::SecondMinimum))
            };
            let graded = |factor: f64, cost: f64, cheirality: f64| graded_in(10, factor, cost, cheirality);
            assert_eq!(graded(1.5, 1.0001, 1.0), (Grade::ProjectiveOnly, true));
            // Also one that agrees with it on most of the views.
            assert_eq!(graded_in(4, 1.5, 1.0001, 1.0), (Grade::ProjectiveOnly, true));
            assert_eq!(graded(0.95, 1.0001, 1.0), (Grade::Weak, true));
            // The same one, one that fits worse, and one of points behind the cameras.
            assert_eq!(graded(1.001, 1.0001, 1.0), (Grade::Weak, false));
            assert_eq!(graded(1.5, 2.0, 1.0), (Grade::Weak, false));
            assert_eq!(graded(1.5, 1.0001, 0.5), (Grade::Weak, false));
        });
    }

    #[test]
    fn poses_and_points_follow_focal_lengths_that_are_held() {
        let scene = testing::scene_turning(2, 40, NOISE, 0.1);
        let stop = StopToken::default();
        for factor in OTHER_FOCALS {
            let start = truth(&scene);
            let followed = scaled(&start, factor, &scene.observations, &stop);
            let focals = followed.focals.iter().zip(&start.focals);
            assert!(focals.clone().all(|(scaled, focal)| (scaled / focal - factor).abs() < 1e-12), "{factor}");
            let cost = |zooming: &Zooming| {
                let options = Options { max_iterations: 0, ..Options::default() };
                zooming.clone().adjust(&scene.observations, &options, &stop).cost
            };
            let at_once = Zooming { focals: followed.focals.clone(), ..start };
            println!("{factor}: {} at once, {} followed", cost(&at_once), cost(&followed));
            assert!(cost(&followed) < 0.1 * cost(&at_once), "{factor}");
        }
    }

    #[test]
    fn the_calibration_is_found_from_wrong_focal_lengths_that_all_else_has_followed() {
        for seed in 0..3 {
            let scene = testing::scene(seed, 10, 40, NOISE);
            of_scene(&scene, |choice, fit| {
                for factor in OTHER_FOCALS {
                    let wrong = scaled(&truth(&scene), factor, choice.problem.observations, choice.stop);
                    let outcome =
                        calibrate_near(&wrong, choice, fit, Vec::new(), &mut || {}).expect("nothing stops it");
                    let focal = outcome.metric.map_or(f64::NAN, |metric| metric.intrinsics.focal);
                    let error = (focal / scene.intrinsics.focal).ln().abs();
                    assert!(error < 0.02, "seed {seed}, from {factor}: off by {error}");
                }
            });
        }
    }
}
