//! Which model the data carry, how well the focal length is determined, and what to warn of.

use super::search::Minimum;
use super::{LEAST_NOISE, Outcome, Problem, Stopped};
use crate::domain::{Grade, StopToken, Warning, WarningCode};
use crate::geometry::bundle::metric::{self, IntrinsicsModel, intrinsics_variance};
use crate::geometry::bundle::{Observation, Options};

/// Standard deviations of the log focal length that bound the grades.
const METRIC_BELOW: f64 = 0.02;
const WEAK_UP_TO: f64 = 0.1;
/// Standard deviation of the log focal length, a factor of 2.7, beyond which the focal length counts as unobservable.
const UNOBSERVABLE_ABOVE: f64 = 1.0;
/// Gain in chi-square at which a richer model is taken: the .999 quantile for two degrees of freedom.
const CHI_SQUARE_GAIN: f64 = 13.8;
/// How much a richer model may raise the standard deviation of the log focal length and still be taken: beyond, it
/// fits by giving up what was to be found.
const SIGMA_INFLATION: f64 = 3.0;
/// Shift of the log focal length between models, in standard deviations, that speaks of a wrong model.
const MODEL_SHIFT: f64 = 3.0;
/// Degrees of freedom from which the posterior noise is believed; it is then known to 13 %.
const ENOUGH_FREEDOM: usize = 30;
/// Ratio of the metric to the projective posterior noise that speaks of a wrong model; the paper's synthetic scenes
/// stay within 1.05.
const RMS_RATIO_LIMIT: f64 = 1.15;
/// The same ratio from which the metric reconstruction is not to be used at all.
const RMS_RATIO_REFUSAL: f64 = 3.0;
/// With few degrees of freedom the ratio exceeds its limit by chance; the loss of fit must also be this many standard
/// deviations of its F statistic.
const MISFIT_DEVIATIONS: f64 = 4.0;
/// Difference in log focal from which another minimum is another calibration.
const OTHER_CALIBRATION: f64 = 0.02;
/// Share of the observations that must lie in front of their cameras, and below which the reconstruction is refused.
const CHEIRALITY_LIMIT: f64 = 0.99;
const CHEIRALITY_REFUSAL: f64 = 0.9;
/// Where the profile of the cost is sampled, in standard deviations to either side, and the iterations there.
const PROFILE_DEVIATIONS: f64 = 3.0;
const PROFILE_ITERATIONS: usize = 15;
/// Largest step of the profile in log focal: a factor of 1.35.
const PROFILE_LONGEST: f64 = 0.3;

/// How well the projective reconstruction fits.
pub(super) struct ProjectiveFit {
    cost: f64,
    freedom: usize,
    /// Posterior standard deviation of a coordinate; not below the assumed one where there is little to judge from.
    pub noise: f64,
}

impl ProjectiveFit {
    pub fn new(cost: f64, problem: &Problem, inliers: usize) -> Self {
        let unknowns = (11 * problem.cameras.len() + 3 * inliers).saturating_sub(15);
        let freedom = (2 * problem.observations.len()).saturating_sub(unknowns);
        let posterior = posterior_noise(cost, freedom);
        let noise = if freedom < ENOUGH_FREEDOM { posterior.max(problem.noise) } else { posterior };
        Self { cost, freedom, noise }
    }
}

fn posterior_noise(cost: f64, freedom: usize) -> f64 {
    (cost / freedom.max(1) as f64).sqrt().max(LEAST_NOISE)
}

/// A metric reconstruction under one model, with what the model makes of the focal length.
struct Candidate {
    model: IntrinsicsModel,
    minimum: Minimum,
    freedom: usize,
    noise: f64,
    /// Standard deviation of the log focal length; `None`: unobservable.
    sigma: Option<f64>,
}

impl Candidate {
    fn new(minimum: Minimum, model: IntrinsicsModel, problem: &Problem) -> Self {
        let Problem { observations, .. } = problem;
        let inliers = super::observed_points(problem);
        let unknowns = (6 * problem.cameras.len() + 3 * inliers + model.freedom()).saturating_sub(7);
        let freedom = (2 * observations.len()).saturating_sub(unknowns);
        let noise = posterior_noise(minimum.cost, freedom).max(problem.noise);
        let variance = intrinsics_variance(&minimum.reconstruction, observations, model).log_focal;
        let sigma = variance.map(|variance| variance.sqrt() * noise).filter(|sigma| sigma.is_finite());
        Self { model, minimum, freedom, noise, sigma }
    }
}

/// Chooses among the minima and models, and says what the choice is worth.
///
/// * `minima`: not empty, cheapest first, with the focal length free
pub(super) fn grade(
    problem: &Problem,
    fit: &ProjectiveFit,
    mut minima: Vec<Minimum>,
    scale_px: f64,
    mut warnings: Vec<Warning>,
    stop: &StopToken,
) -> Result<Outcome, Stopped> {
    let chosen = minima.remove(best_in_front(&minima, problem, fit));
    let simple = Candidate::new(chosen, IntrinsicsModel::Focal, problem);
    let rival = rival(&simple, &minima);
    let mut best = richest(simple, problem, scale_px, &mut warnings, stop)?;
    Stopped::check(stop)?;
    best.sigma = best
        .sigma
        .map(|sigma| profiled(sigma, &best, problem.observations, stop))
        .filter(|sigma| *sigma < UNOBSERVABLE_ABOVE);

    let mut grade = grade_of_sigma(best.sigma);
    let mut cap = |worst: Grade| grade = grade.worse(worst);
    if best.sigma.is_none_or(|sigma| sigma > WEAK_UP_TO) {
        warnings.push(unobservable(&best));
    }
    if let Some(rival) = rival {
        let shift = (rival.log_focal() - best.minimum.log_focal()).abs();
        cap(if shift > WEAK_UP_TO { Grade::ProjectiveOnly } else { Grade::Weak });
        warnings.push(second_minimum(rival, &best, scale_px));
    }
    let rms_ratio = posterior_noise(best.minimum.cost, best.freedom) / fit.noise;
    if rms_ratio > RMS_RATIO_LIMIT && misfits(&best, fit) {
        cap(if rms_ratio > RMS_RATIO_REFUSAL { Grade::ProjectiveOnly } else { Grade::Weak });
        let detail = format!(
            "the metric reconstruction fits {rms_ratio:.2} times worse than the projective one ({:.2} px against \
             {:.2} px) with {} free: distortion, a zoom or wrong tracks",
            rms_ratio * fit.noise * scale_px,
            fit.noise * scale_px,
            best.model.name()
        );
        warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
    }
    let in_front = best.minimum.cheirality;
    if in_front < CHEIRALITY_LIMIT {
        cap(if in_front < CHEIRALITY_REFUSAL { Grade::ProjectiveOnly } else { Grade::Weak });
        let detail = format!("{:.1} % of the observations lie behind their cameras", 100.0 * (1.0 - in_front));
        warnings.push(Warning::new(WarningCode::Cheirality, detail));
    }
    if warnings.iter().any(|warning| warning.code == WarningCode::FewInliers) {
        cap(Grade::Weak);
    }
    // A sigma that the fit contradicts is not told: whatever lowered the grade is worth at least the grade's least.
    let sigma = best.sigma.map(|sigma| if grade == Grade::Weak { sigma.max(METRIC_BELOW) } else { sigma });
    Ok(Outcome {
        sigma_log_focal: sigma,
        grade,
        warnings,
        model: best.model,
        plane_at_infinity: None,
        cheirality: in_front,
        rms_ratio,
        metric: Some(best.minimum.reconstruction),
    })
}

/// The grade that a standard deviation of the log focal length alone would give; `None`: unobservable.
pub fn grade_of_sigma(sigma: Option<f64>) -> Grade {
    match sigma {
        Some(sigma) if sigma < METRIC_BELOW => Grade::Metric,
        Some(sigma) if sigma <= WEAK_UP_TO => Grade::Weak,
        _ => Grade::ProjectiveOnly,
    }
}

/// The cheapest minimum whose points are in front of the cameras, if the data do not tell it from the cheapest.
fn best_in_front(minima: &[Minimum], problem: &Problem, fit: &ProjectiveFit) -> usize {
    let unit = fit.noise.max(problem.noise).powi(2);
    let near = |minimum: &Minimum| minimum.cost - minima[0].cost < CHI_SQUARE_GAIN * unit;
    minima.iter().position(|minimum| minimum.cheirality >= CHEIRALITY_LIMIT && near(minimum)).unwrap_or(0)
}

/// Another calibration that explains the data about as well.
fn rival<'a>(best: &Candidate, others: &'a [Minimum]) -> Option<&'a Minimum> {
    others.iter().find(|other| {
        (other.log_focal() - best.minimum.log_focal()).abs() > OTHER_CALIBRATION
            && other.cheirality >= CHEIRALITY_LIMIT.min(best.minimum.cheirality)
            && other.cost - best.minimum.cost < CHI_SQUARE_GAIN * best.noise * best.noise
    })
}

/// Frees principal point, then aspect, as long as the data ask for it and still determine the focal length.
fn richest(
    simple: Candidate,
    problem: &Problem,
    scale_px: f64,
    warnings: &mut Vec<Warning>,
    stop: &StopToken,
) -> Result<Candidate, Stopped> {
    let mut best = simple;
    for model in [IntrinsicsModel::FocalPrincipalPoint, IntrinsicsModel::FocalPrincipalPointAspect] {
        Stopped::check(stop)?;
        let minimum = best.minimum.adjusted(problem.observations, model, stop);
        let richer = Candidate::new(minimum, model, problem);
        let gain = (best.minimum.cost - richer.minimum.cost) / (richer.noise * richer.noise);
        if gain <= CHI_SQUARE_GAIN {
            continue;
        }
        let shift = (richer.minimum.log_focal() - best.minimum.log_focal()).abs();
        if best.sigma.is_some_and(|sigma| shift > MODEL_SHIFT * sigma) {
            let detail = format!(
                "freeing {} moves the focal length from {:.1} to {:.1} px, {:.1} standard deviations",
                model.name(),
                best.minimum.reconstruction.intrinsics.focal * scale_px,
                richer.minimum.reconstruction.intrinsics.focal * scale_px,
                shift / best.sigma.unwrap_or(f64::INFINITY)
            );
            warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
        }
        let observable = match (best.sigma, richer.sigma) {
            (Some(simple), Some(rich)) => rich <= METRIC_BELOW.max(SIGMA_INFLATION * simple),
            (None, rich) => rich.is_some(),
            (Some(_), None) => false,
        };
        if observable {
            best = richer;
        }
    }
    Ok(best)
}

/// Whether the metric reconstruction loses more fit than chance would explain (F test against the projective one).
fn misfits(best: &Candidate, fit: &ProjectiveFit) -> bool {
    let added = best.freedom.saturating_sub(fit.freedom).max(1) as f64;
    let freedom = fit.freedom.max(1) as f64;
    let statistic = (best.minimum.cost - fit.cost) / added / (fit.noise * fit.noise);
    statistic > 1.0 + MISFIT_DEVIATIONS * (2.0 / added + 2.0 / freedom).sqrt()
}

/// The standard deviation as the profile of the cost shows it, where that is larger than the linearised one.
///
/// The focal length is held three standard deviations away while poses and points adjust; the chi-square should rise
/// by nine. Near critical motions the linearisation is optimistic: it is taken where the noise has moved the scene.
fn profiled(sigma: f64, best: &Candidate, observations: &[Observation], stop: &StopToken) -> f64 {
    let shift = (PROFILE_DEVIATIONS * sigma).min(PROFILE_LONGEST);
    if shift <= 0.0 {
        return sigma;
    }
    let side = |shift: f64| {
        let mut moved = best.minimum.reconstruction.clone();
        moved.intrinsics.focal *= shift.exp();
        let options = Options::squared(PROFILE_ITERATIONS);
        let report = metric::adjust(&mut moved, observations, IntrinsicsModel::Fixed, &options, stop);
        (report.cost - best.minimum.cost).max(0.0) / (best.noise * best.noise)
    };
    let rise = side(shift).min(side(-shift));
    sigma.max(shift / rise.sqrt().max(f64::MIN_POSITIVE))
}

fn unobservable(best: &Candidate) -> Warning {
    let detail = match best.sigma {
        Some(sigma) => format!(
            "the motion determines the logarithm of the focal length only to {sigma:.2} (one standard deviation), \
             more than {WEAK_UP_TO}"
        ),
        None => "the motion does not determine the focal length".to_owned(),
    };
    Warning::new(WarningCode::UnobservableFocal, detail)
}

fn second_minimum(rival: &Minimum, best: &Candidate, scale_px: f64) -> Warning {
    let detail = format!(
        "a focal length of {:.1} px instead of {:.1} px explains the data about as well: chi-square larger by {:.1} \
         of {} degrees of freedom",
        rival.reconstruction.intrinsics.focal * scale_px,
        best.minimum.reconstruction.intrinsics.focal * scale_px,
        ((rival.cost - best.minimum.cost) / (best.noise * best.noise)).max(0.0),
        best.freedom
    );
    Warning::new(WarningCode::SecondMinimum, detail)
}
