//! What a calibration is worth, and what to warn of.

use super::fit::Fit;
use super::misfit::Comparison;
use super::models::{Candidate, Selection};
use super::options::CalibrationOptions;
use super::search::{self, Minimum};
use super::verdict::Verdict;
use super::view_focals::{self, Differing};
use super::{Outcome, Stretch, Uncalibrated};
use crate::domain::{Grade, Warning, WarningCode};
use crate::geometry::bundle::metric::{Extension, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Parameter};
use crate::solver::error::Error;

/// What a selection is worth for each camera group.
///
/// * `fit`: of the projective cameras, to the views of `stretch`
/// * `stretch`: the views on which both are compared; `None`: all
pub(super) fn grade(
    problem: &Uncalibrated,
    fit: &Fit,
    stretch: Option<Stretch>,
    selection: Selection,
    warnings: Vec<Warning>,
) -> Result<Vec<Outcome>, Error> {
    let CalibrationOptions { fit: fit_options, lenses, grades, .. } = problem.options;
    let best = &selection.best;
    Error::check(problem.stop)?;
    let comparison = match &stretch {
        None => Comparison::new(best, fit, problem),
        Some(Stretch { problem, metric }) => {
            Comparison::new(&problem.on_stretch(best, metric), fit, problem).beside(&best.fit)
        }
    };
    let profile = problem.profile(best);
    // Both are of the same residuals, seen from two sides.
    let correlation = (profile.correlation / comparison.violation).max(1.0);
    let inflation = comparison.violation * profile.widening;
    let sigmas = problem.sigmas(&selection, &best.priors, inflation);
    let sigmas = sigmas.widened(correlation, problem.focal_priors);
    let has_own_focals = best.minimum.reconstruction.has_own_focals();
    let mut focals = view_focals::of(best, &sigmas, lenses);
    let determined: Vec<bool> = focals.iter().map(|view| view_focals::is_determined(view, grades)).collect();
    let rival = rival(problem, best, &selection.others, |view| determined[view]);
    // Of cameras that were taken for one, the tracks that fit are those that projective cameras fit as badly: their
    // ratio is no misfit, and what they violate the calibration by is. Where it is that alone, views of one camera
    // differ by some tenths of a per cent too, behind a lens that the model does not quite have: only what the grade
    // depends on is said.
    let is_misfit = comparison.is_misfit(fit_options);
    let differing = ((is_misfit || comparison.is_violated(fit_options)) && !has_own_focals)
        .then(|| view_focals::differing(&best.minimum.reconstruction, &best.fit, problem))
        .flatten()
        .filter(|differing| is_misfit || differing.shift > grades.metric_below);
    let grade_group = |group: usize| -> Outcome {
        let mut verdict = Verdict::new(problem.options, warnings.clone());
        // What the ratios of the others' deviations are taken of, and the one that is reported.
        let (of_focal, mut sigma) = match has_own_focals {
            true => {
                let sigma = view_focals::judge(&mut verdict, &focals);
                (sigma, sigma)
            }
            false => {
                let of_focal = sigmas.of_group[group][Parameter::LogFocal as usize];
                let mut sigma = of_focal.filter(|sigma| *sigma < grades.unobservable_above);
                if problem.focal_priors[group].is_some() {
                    // It lifts the grade by one step at most.
                    let alone = problem.sigmas(&selection, &without_focal(best, group), inflation * correlation);
                    if grades.grade(alone.of_group[group][Parameter::LogFocal as usize]) == Grade::ProjectiveOnly {
                        verdict.grade = verdict.grade.worse(Grade::Weak);
                    }
                }
                weigh_prior(&mut verdict, &mut sigma, problem, best, group, &comparison, correlation);
                verdict.judge_sigma(sigma, correlation);
                (of_focal, sigma)
            }
        };
        if let Some((rival, shift)) = rival {
            let worst = if shift > grades.weak_up_to { Grade::ProjectiveOnly } else { Grade::Weak };
            verdict.cap(worst, WarningCode::SecondMinimum, second_minimum(rival, best, problem.scale_px));
        }
        verdict.judge_fit(&comparison, &best.model.name(), problem.scale_px);
        if verdict.is_misfit && has_own_focals {
            // What a focal length a view behind one lens does not explain, nobody knows the reason of.
            verdict.grade = Grade::ProjectiveOnly;
        } else if let Some(differing) = &differing {
            // What the views' own differ from it by, one focal length for all is wrong by.
            sigma = sigma.map(|sigma| sigma.max(differing.shift));
            verdict.doubt(sigma, differing_words(differing, problem));
        }
        let focal = best.minimum.reconstruction.intrinsics[group].focal;
        if !has_own_focals {
            let is_known = problem.focal_priors[group].is_some();
            verdict.judge_plausibility(focal, is_known, problem.scale_px);
        }
        verdict.judge_cheirality(best.minimum.cheirality);
        if verdict.grade != Grade::ProjectiveOnly && !has_own_focals {
            verdict.warnings.extend(principal_point(best, group, comparison.violation * correlation, problem));
        }
        let ratio = |sigma: Option<f64>| Some(sigma? / of_focal?).filter(|ratio| ratio.is_finite());
        Outcome {
            group,
            sigma_log_focal: verdict.reported(sigma),
            sigma_ratios: sigmas.of_group[group].map(ratio),
            grade: verdict.grade,
            warnings: verdict.warnings,
            model: best.model,
            rms_ratio: comparison.ratio,
            metric: None,
            focals: None,
        }
    };
    let mut outcomes: Vec<Outcome> = (0..problem.groups()).map(grade_group).collect();
    focals.iter_mut().for_each(|view| view_focals::forget_undetermined(view, grades));
    let mut metric = selection.best.minimum.reconstruction;
    if let ([lens], Some(mean)) = (metric.intrinsics.as_mut_slice(), view_focals::mean(&focals)) {
        lens.focal = mean;
    }
    for outcome in &mut outcomes {
        outcome.metric = Some(metric.clone());
        outcome.focals = has_own_focals.then(|| focals.clone());
    }
    Ok(outcomes)
}

/// The best minimum that is found from the one near a metric reconstruction under the model of its lenses, and others
/// from other focal lengths, as [`select`]; `None` where the one near it does not converge.
///
/// Where no focal length may be determined under that model, nothing else is tried: in 20 such calibrations of 309 no
/// other model determined one either, and all were refused.
///
/// * `stretch`: as of [`grade`]
pub(super) fn select_near(
    problem: &Uncalibrated,
    fit: &Fit,
    metric: &MetricReconstruction,
    stretch: Option<&Stretch>,
    warnings: &mut Vec<Warning>,
) -> Result<Option<Selection>, Error> {
    let model = metric.model();
    let near = problem.adjusted(metric.clone(), model, fit.noise);
    Error::check(problem.stop)?;
    let cost = near.minimum.cost;
    if !cost.is_finite() {
        return Ok(None);
    }
    if !problem.may_be_observable(&near, fit) {
        return Ok(Some(Selection::of(near)));
    }
    let Candidate { minimum, priors, .. } = near;
    let others = problem.search(&priors).minima_from_other_focals(metric, model, cost, stretch)?;
    let minima = search::distinct(std::iter::once(minimum).chain(others).collect(), problem);
    select(problem, fit, minima, model, priors, warnings).map(Some)
}

/// The best of some minima under the model that the data carry, and the others under the same.
///
/// * `minima`: not empty, cheapest first, of this model with these priors
pub(super) fn select(
    problem: &Uncalibrated,
    fit: &Fit,
    mut minima: Vec<Minimum>,
    model: IntrinsicsModel,
    priors: Vec<IntrinsicsPrior>,
    warnings: &mut Vec<Warning>,
) -> Result<Selection, Error> {
    let first = minima.remove(best_in_front(&minima, problem, fit));
    let first = Candidate::new(first, model, priors, problem);
    let (projections, priors) = (first.projections(), first.priors.clone());
    let selection = problem.select_of_any_projection(first, &mut minima, warnings)?;
    let best = &selection.best;
    if best.model == model && best.priors == priors && best.projections() == projections {
        return Ok(Selection { others: minima, ..selection });
    }
    with_others(problem, selection, minima)
}

/// A selection with what other minima converge to under its model: a better one is taken in its place, and those that
/// fall back into the best are left out.
fn with_others(problem: &Uncalibrated, mut selection: Selection, minima: Vec<Minimum>) -> Result<Selection, Error> {
    let CalibrationOptions { search, grades, .. } = problem.options;
    for start in minima {
        Error::check(problem.stop)?;
        let best = &selection.best;
        let start = start.reconstruction.of_model(best.model);
        let found = problem.search(&best.priors).converged_near(start, best.model, best.minimum.cost);
        let Some(mut minimum) = found else { continue };
        let lowered = best.minimum.cost - minimum.cost;
        let is_told_apart = lowered > grades.indistinguishable * best.fit.noise.powi(2);
        if !is_told_apart && minimum.repeats(&best.minimum, &best.minimum.determined(problem), search) {
            continue;
        }
        // A model that is wrong may rank the minima wrongly.
        if lowered > 0.0 && minimum.cheirality >= grades.least_in_front.min(best.minimum.cheirality) {
            let better = Candidate::new(minimum.clone(), best.model, best.priors.clone(), problem);
            minimum = selection.replace(better).minimum;
        }
        selection.others.push(minimum);
    }
    Ok(selection)
}

/// The cheapest minimum whose points are in front of the cameras, if the data do not tell it from the cheapest.
fn best_in_front(minima: &[Minimum], problem: &Uncalibrated, fit: &Fit) -> usize {
    let unit = fit.noise.max(problem.noise).powi(2);
    let options = &problem.options.grades;
    let near = |minimum: &Minimum| minimum.cost - minima[0].cost < options.indistinguishable * unit;
    minima.iter().position(|minimum| minimum.cheirality >= options.least_in_front && near(minimum)).unwrap_or(0)
}

/// Another calibration that explains the data about as well, and how far its log focal length is from the best one's.
///
/// * `counts`: which views do where they have focal lengths of their own
fn rival<'a>(
    problem: &Uncalibrated,
    best: &Candidate,
    others: &'a [Minimum],
    counts: impl Fn(usize) -> bool,
) -> Option<(&'a Minimum, f64)> {
    let grades = &problem.options.grades;
    let mut apart = others.iter().map(|other| (other, other.apart(&best.minimum, &counts)));
    apart.find(|(other, apart)| {
        *apart > grades.other_calibration
            && other.cheirality >= grades.least_in_front.min(best.minimum.cheirality)
            && other.cost - best.minimum.cost < grades.indistinguishable * best.fit.noise.powi(2)
    })
}

/// The priors without what is known of the focal length of one group.
fn without_focal(best: &Candidate, group: usize) -> Vec<IntrinsicsPrior> {
    let mut alone = best.priors.clone();
    alone[group] = alone[group].forgetting(Parameter::LogFocal);
    alone
}

/// Standard deviation of the log focal length of a group by the observations alone; `None`: unobservable.
fn of_data(best: &Candidate, group: usize, inflation: f64) -> Option<f64> {
    let sigma = best.sigma(group, Parameter::LogFocal, best.model, &without_focal(best, group))?;
    Some(sigma * inflation)
}

/// What a prior on the focal length may not do: contradict the observations unsaid.
///
/// Where it contradicts them, sigma grows by as many standard deviations (Birge's ratio of two values): one of the two
/// is wrong, and which is not known.
///
/// * `comparison`: of the best with projective cameras
/// * `correlation`: factor on the standard deviation of the observations alone beside that
fn weigh_prior(
    verdict: &mut Verdict,
    sigma: &mut Option<f64>,
    problem: &Uncalibrated,
    best: &Candidate,
    group: usize,
    comparison: &Comparison,
    correlation: f64,
) {
    let Some(focal_prior) = problem.focal_priors[group] else { return };
    let of_data = of_data(best, group, comparison.violation * correlation);
    let alone = without_focal(best, group);
    let contradicts = |difference: f64, of_data: f64| {
        let deviations = difference.abs() / of_data.hypot(focal_prior.sigma_log);
        Some(deviations).filter(|deviations| *deviations > problem.options.grades.prior_contradicted)
    };
    let optimum = best.optimum(best.model, &alone).filter(|_| !comparison.is_misfit(&problem.options.fit));
    if let (Some(of_data), Some(optimum)) = (of_data, optimum) {
        let known = best.priors[group].deviation(Parameter::LogFocal, &best.minimum.reconstruction.intrinsics[group]);
        if contradicts(known + optimum.shift_of(group, Parameter::LogFocal), of_data).is_none() {
            return;
        }
    }
    // Far from what the observations say, nothing fits, and they do not tell to second order where that is.
    let freed = problem.search(&alone).converged(best.minimum.reconstruction.clone(), best.model);
    let freed = Candidate::new(freed, best.model, alone, problem);
    let focal_px = freed.minimum.reconstruction.intrinsics[group].focal * problem.scale_px;
    let Some(of_data) = freed.sigma(group, Parameter::LogFocal, freed.model, &freed.priors) else { return };
    // What is left of the misfit without the prior is not its doing.
    let inflation = (comparison.violation * freed.fit.noise / best.fit.noise).max(1.0) * correlation;
    if let Some(deviations) = contradicts((focal_px / focal_prior.focal_px).ln(), inflation * of_data) {
        let detail = format!(
            "the tracks alone give a focal length of {focal_px:.1} px, {deviations:.1} standard deviations from the \
             {:.1} px known beforehand",
            focal_prior.focal_px
        );
        verdict.warnings.push(Warning::new(WarningCode::FocalPriorContradicted, detail));
        *sigma = sigma.map(|sigma| sigma * deviations);
    }
}

/// Says so where the observations do not determine the principal point.
fn principal_point(best: &Candidate, group: usize, inflation: f64, problem: &Uncalibrated) -> Option<Warning> {
    let mut alone = best.priors.clone();
    alone[group] = alone[group].forgetting(Parameter::PrincipalX).forgetting(Parameter::PrincipalY);
    let model = best.model.with(Extension::PrincipalPoint);
    let names = [("x", Parameter::PrincipalX), ("y", Parameter::PrincipalY)];
    let unknown: Vec<String> = names
        .into_iter()
        .filter_map(|(name, parameter)| {
            match best.sigma(group, parameter, model, &alone).map(|sigma| sigma * inflation) {
                Some(sigma) if sigma <= problem.options.grades.principal_point_unobservable_above => None,
                Some(sigma) => Some(format!("{name} only to {:.0} px", sigma * problem.scale_px)),
                None => Some(format!("{name} not at all")),
            }
        })
        .collect();
    let detail = format!("the tracks determine the principal point in {}", unknown.join(" and "));
    (!unknown.is_empty()).then(|| Warning::new(WarningCode::PrincipalPointUnobservable, detail))
}

fn differing_words(differing: &Differing, problem: &Uncalibrated) -> String {
    let (least, most) = differing.range;
    let lenses = &problem.options.lenses;
    let range = match lenses.is_plausible(least) && lenses.is_plausible(most) {
        true => format!(", at {:.1} to {:.1} px", least * problem.scale_px, most * problem.scale_px),
        // Some views do not determine theirs.
        false => String::new(),
    };
    format!("with a focal length a view (focal_per_view) the images fit better{range}")
}

fn second_minimum(rival: &Minimum, best: &Candidate, scale_px: f64) -> String {
    format!(
        "a focal length of {:.1} px instead of {:.1} px explains the data about as well: chi-square larger by {:.1} \
         of {} degrees of freedom",
        rival.log_focal().exp() * scale_px,
        best.minimum.log_focal().exp() * scale_px,
        ((rival.cost - best.minimum.cost) / best.fit.noise.powi(2)).max(0.0),
        best.fit.freedom
    )
}
