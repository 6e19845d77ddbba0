//! The search for the metric reconstruction: many starts, few that converge.

use nalgebra::Vector3;

use super::fit::Fit;
use super::verdict::WEAK_UP_TO;
use super::{Problem, Stopped};
use crate::domain::StopToken;
use crate::geometry::bundle::Options;
use crate::geometry::bundle::critical::Translating;
use crate::geometry::bundle::metric::{
    self, Information, Intrinsics, IntrinsicsModel, IntrinsicsPrior, Reconstruction,
};
use crate::geometry::daq::{self, CanonicalFrame, Daq, Free};
use crate::geometry::metric::{cheirality, upgrade, upgrade_translation};
use crate::geometry::observation::Observation;
use crate::geometry::statistics::root_mean_square;
use crate::geometry::triangulation;

/// The scan of focal lengths: 40 in the range, from the 4 widest views.
const SCAN_FOCALS: usize = 40;
const SCAN_VIEWS: usize = 4;
/// Refined starts kept, and the iterations of their refinement; it converges in 10 to 20.
const REFINED_STARTS: usize = 4;
const REFINE_ITERATIONS: usize = 40;
/// Best entries of the scan that are refined.
const REFINED_FROM_SCAN: usize = 3;
/// Starts that are adjusted. With the refined ones alone a third of the scenes at .3 % noise was within 1 % of the
/// focal length, with these .92.
const STARTS: usize = 8;
/// Windows of the scan, in image sides, whose best entry is a start as it stands: they keep starts apart that the
/// refinement would draw into one minimum.
const WINDOW_RANGE: (f64, f64) = (0.45, 3.2);
/// Half width of a window in log focal; neighbours touch.
const WINDOW_HALF_WIDTH: f64 = 0.15;
/// Difference in log focal below which refined starts are the same.
const SAME_START: f64 = 0.02;
/// Iterations and tolerance of the first adjustment, which only has to rank the starts.
const FIRST_ITERATIONS: usize = 12;
const FIRST_TOLERANCE: f64 = 1e-4;
/// Starts that are adjusted to convergence, and the iterations allowed.
const CONVERGED: usize = 3;
const FINAL_ITERATIONS: usize = 60;
const FINAL_TOLERANCE: f64 = 1e-9;
/// Share of the cheapest minimum's cost that a start must get down to at its pace to be adjusted to convergence: a
/// rival is within a few per cent, and one stuck at thirty times the cost took half the time of a calibration.
const HOPELESS: f64 = 4.0;
/// Adjusted starts this near in log focal, and within this share in cost, are the same minimum.
const SAME_MINIMUM: f64 = 0.01;
const SAME_COST: f64 = 0.1;
/// Focal lengths that the refinement may end at, in image sides; beyond, it ran away along a null direction.
const PLAUSIBLE_FOCAL: std::ops::Range<f64> = 0.05..50.0;
/// Points that take part in the search; more tell no minimum from another that these do not.
const SEARCH_POINTS: usize = 150;

/// A converged metric reconstruction.
#[derive(Debug, Clone)]
pub(super) struct Minimum {
    pub reconstruction: Reconstruction,
    pub cost: f64,
    pub cheirality: f64,
}

impl Minimum {
    /// Of the geometric mean where views or groups have their own.
    pub fn log_focal(&self) -> f64 {
        self.reconstruction.log_focal()
    }

    /// Difference in log focal length, the root mean square over the groups; where views have their own, over those
    /// that count.
    pub fn apart(&self, other: &Self, counts: impl Fn(usize) -> bool) -> f64 {
        let (own, others) = (&self.reconstruction, &other.reconstruction);
        let differences: Vec<f64> = if own.focals.is_empty() {
            let pairs = own.intrinsics.iter().zip(&others.intrinsics);
            pairs.map(|(own, other)| (own.focal / other.focal).ln()).collect()
        } else {
            let pairs = own.focals.iter().zip(&others.focals).enumerate().filter(|(view, _)| counts(*view));
            pairs.map(|(_, (own, other))| (own / other).ln()).collect()
        };
        root_mean_square(&differences).unwrap_or(0.0)
    }

    /// Of which views the observations determine the focal length; all where they do of none.
    fn determined(&self, problem: &Problem) -> Vec<bool> {
        let views = self.reconstruction.focals.len();
        if views == 0 {
            return Vec::new();
        }
        let model = IntrinsicsModel::FOCAL_PER_VIEW;
        let information = Information::new(&self.reconstruction, problem.observations);
        let Some(information) = information else { return vec![true; views] };
        let noise = Fit::metric(self.cost, model, problem).noise;
        let sigmas = information
            .own_focals(&information.optimum(model, &vec![IntrinsicsPrior::NONE; problem.groups()]))
            .into_iter();
        let determined: Vec<bool> = sigmas
            .map(|(variance, _)| variance.is_some_and(|variance| variance.sqrt() * noise <= WEAK_UP_TO))
            .collect();
        if determined.contains(&true) { determined } else { vec![true; views] }
    }

    /// Adjusts to convergence from here with this model.
    pub fn adjusted(
        &self,
        observations: &[Observation],
        model: IntrinsicsModel,
        priors: &[IntrinsicsPrior],
        stop: &StopToken,
    ) -> Self {
        self.adjusted_by(&converge(), observations, model, priors, stop)
    }

    fn adjusted_by(
        &self,
        options: &Options,
        observations: &[Observation],
        model: IntrinsicsModel,
        priors: &[IntrinsicsPrior],
        stop: &StopToken,
    ) -> Self {
        let mut reconstruction = self.reconstruction.clone();
        let report = metric::adjust(&mut reconstruction, observations, model, priors, options, stop);
        let cheirality = cheirality(&reconstruction, observations);
        Self { reconstruction, cost: report.cost, cheirality }
    }
}

fn first() -> Options {
    Options { max_iterations: FIRST_ITERATIONS, relative_tolerance: FIRST_TOLERANCE, ..Options::default() }
}

pub(super) fn converge() -> Options {
    Options { max_iterations: FINAL_ITERATIONS, relative_tolerance: FINAL_TOLERANCE, ..Options::default() }
}

/// Factors on the focal length of a reconstruction from which other minima are looked for: a forward motion has them
/// half or twice as far.
pub(super) const OTHER_FOCALS: [f64; 4] = [0.5, 0.75, 1.33, 2.0];
/// Iterations in which poses and points follow a focal length that is held.
const FOLLOWING: usize = 12;

/// Minima from a reconstruction that is metric already: its own, and those that other focal lengths lead to, which its
/// poses and points have followed, for freed at once these would only go back to where they were; cheapest first.
///
/// * `heartbeat`: called after each
pub(super) fn minima_near(
    metric: &Reconstruction,
    problem: &Problem,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
    heartbeat: &mut dyn FnMut(),
) -> Result<Vec<Minimum>, Stopped> {
    let model = IntrinsicsModel::focal(metric.has_own_focals());
    let mut found = Vec::new();
    for factor in std::iter::once(1.0).chain(OTHER_FOCALS) {
        Stopped::check(stop)?;
        let mut reconstruction = metric.clone();
        reconstruction
            .intrinsics
            .iter_mut()
            .for_each(|intrinsics| *intrinsics = Intrinsics::from_focal(intrinsics.focal));
        reconstruction.scale_focals(factor);
        if factor != 1.0 {
            let options = Options { max_iterations: FOLLOWING, ..Options::default() };
            metric::adjust(&mut reconstruction, problem.observations, IntrinsicsModel::FIXED, priors, &options, stop);
        }
        let start = Minimum { reconstruction, cost: f64::INFINITY, cheirality: 0.0 };
        found.push(start.adjusted(problem.observations, model, priors, stop));
        heartbeat();
    }
    Stopped::check(stop)?;
    Ok(distinct(found, problem))
}

/// Metric reconstructions with the focal length free, or one of each view, that different starts converge to, cheapest
/// first.
pub(super) fn minima(
    frame: &CanonicalFrame,
    problem: &Problem,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
) -> Result<Vec<Minimum>, Stopped> {
    match problem.focal_per_view {
        true => minima_per_view(frame, problem, stop),
        false if problem.groups() > 1 => minima_of_groups(frame, problem, priors, stop),
        false => minima_of_one(frame, problem, priors, stop),
    }
}

/// With a focal length a camera group: from what one of each view leads to.
fn minima_of_groups(
    frame: &CanonicalFrame,
    problem: &Problem,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
) -> Result<Vec<Minimum>, Stopped> {
    let alone = Problem { group_of: &vec![0; frame.cameras.len()], focal_priors: &[None], ..*problem };
    let mut found = minima_per_view(frame, &alone, stop)?;
    for minimum in &mut found {
        Stopped::check(stop)?;
        minimum.reconstruction = minimum.reconstruction.clone().in_groups(problem.group_of, problem.groups());
        *minimum = minimum.adjusted(problem.observations, IntrinsicsModel::FOCAL, priors, stop);
    }
    Ok(distinct(found, problem))
}

/// With a focal length a view: from the quadrics that allow for that, and from what one for all leads to.
fn minima_per_view(frame: &CanonicalFrame, problem: &Problem, stop: &StopToken) -> Result<Vec<Minimum>, Stopped> {
    let (model, priors) = (IntrinsicsModel::FOCAL_PER_VIEW, [IntrinsicsPrior::NONE]);
    let quadrics = daq::view_focal_starts(&frame.cameras).into_iter().take(STARTS);
    let mut starts: Vec<Reconstruction> =
        quadrics.filter_map(|(daq, _)| upgrade(frame, &daq, true, problem.observations)).collect();
    let of_one = minima_of_one(frame, problem, &priors, stop)?;
    starts.extend(of_one.into_iter().map(|minimum| minimum.reconstruction.with_own_focals()));
    let mut found = Vec::with_capacity(starts.len());
    for reconstruction in starts {
        Stopped::check(stop)?;
        let start = Minimum { reconstruction, cost: f64::INFINITY, cheirality: 0.0 };
        found.push(start.adjusted_by(&first(), problem.observations, model, &priors, stop));
    }
    let mut found = distinct(found, problem);
    found.truncate(CONVERGED);
    for minimum in &mut found {
        Stopped::check(stop)?;
        *minimum = minimum.adjusted(problem.observations, model, &priors, stop);
    }
    Ok(distinct(found, problem))
}

/// With one focal length for all views.
fn minima_of_one(
    frame: &CanonicalFrame,
    problem: &Problem,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
) -> Result<Vec<Minimum>, Stopped> {
    let model = IntrinsicsModel::FOCAL;
    let (subset, chosen) = subsample(frame, problem.observations);
    let observations = subset.as_deref().unwrap_or(problem.observations);
    let mut found: Vec<Minimum> = Vec::new();
    for start in starts(frame) {
        Stopped::check(stop)?;
        let Some(mut reconstruction) = upgrade(frame, &start, false, observations) else { continue };
        let report = metric::adjust(&mut reconstruction, observations, model, priors, &first(), stop);
        found.push(Minimum { cheirality: 0.0, cost: report.cost, reconstruction });
    }
    let mut found = distinct(found, problem);
    found.truncate(CONVERGED);
    let mut converged: Vec<Minimum> = Vec::with_capacity(found.len());
    let mut cheapest = f64::INFINITY;
    for mut start in found {
        Stopped::check(stop)?;
        if start.cost > HOPELESS * cheapest {
            let tried = start.adjusted_by(&first(), observations, model, priors, stop);
            let pace = (tried.cost / start.cost).powf(FINAL_ITERATIONS as f64 / FIRST_ITERATIONS as f64);
            if pace * tried.cost > HOPELESS * cheapest {
                continue;
            }
            start = tried;
        }
        let mut minimum = start.adjusted(observations, model, priors, stop);
        cheapest = cheapest.min(minimum.cost);
        if let Some(chosen) = &chosen {
            fill_points(&mut minimum, chosen, problem.observations);
            minimum = minimum.adjusted(problem.observations, model, priors, stop);
        }
        converged.push(minimum);
    }
    Stopped::check(stop)?;
    Ok(distinct(converged, problem))
}

/// The metric reconstruction of a camera that moved without turning, from a focal length that is known otherwise; empty
/// where there is none.
pub(super) fn known_focal(
    translation: &Translating,
    focal: f64,
    problem: &Problem,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
) -> Vec<Minimum> {
    let observations = problem.observations;
    let start = upgrade_translation(translation, focal, observations);
    let minimum = start.map(|reconstruction| Minimum { reconstruction, cost: f64::INFINITY, cheirality: 0.0 });
    let adjusted = minimum.map(|start| start.adjusted(observations, IntrinsicsModel::FOCAL, priors, stop));
    distinct(adjusted.into_iter().collect(), problem)
}

/// Cheapest first, without those that repeat a cheaper one.
fn distinct(mut found: Vec<Minimum>, problem: &Problem) -> Vec<Minimum> {
    found.retain(|minimum| minimum.cost.is_finite() && minimum.log_focal().is_finite());
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let counts = found.first().map(|cheapest| cheapest.determined(problem)).unwrap_or_default();
    let mut kept: Vec<Minimum> = Vec::with_capacity(found.len());
    for candidate in found {
        let repeats = kept.iter().any(|minimum| {
            candidate.apart(minimum, |view| counts[view]) < SAME_MINIMUM
                && candidate.cost < (1.0 + SAME_COST) * minimum.cost
        });
        if !repeats {
            kept.push(candidate);
        }
    }
    kept
}

/// Different starts: the linear DAQ and the best of the scan, refined, then the best of each window of the scan.
fn starts(frame: &CanonicalFrame) -> Vec<Daq> {
    let cameras = &frame.cameras;
    let scanned = daq::scan(cameras, SCAN_FOCALS, SCAN_VIEWS);
    let best_near = |focal: f64, half_width: f64| {
        scanned.iter().find(|(daq, _)| (daq.intrinsics.focal / focal).ln().abs() < half_width).map(|(daq, _)| *daq)
    };
    let mut to_refine: Vec<Daq> = daq::linear(cameras).into_iter().collect();
    to_refine.extend(scanned.iter().take(REFINED_FROM_SCAN).map(|(daq, _)| *daq));
    to_refine.extend([0.5, 1.0, 2.0, 4.0].into_iter().filter_map(|focal| best_near(focal, 0.5 * 2f64.ln())));
    let mut refined: Vec<(Daq, f64)> = to_refine
        .into_iter()
        .map(|start| daq::refine(cameras, start, Free::FocalAndPlane, REFINE_ITERATIONS))
        .filter(|(daq, cost)| cost.is_finite() && PLAUSIBLE_FOCAL.contains(&daq.intrinsics.focal))
        .collect();
    refined.sort_by(|a, b| a.1.total_cmp(&b.1));

    let mut kept: Vec<Daq> = Vec::with_capacity(STARTS);
    for (daq, _) in refined {
        let repeats = kept.iter().any(|other| {
            (daq.intrinsics.focal / other.intrinsics.focal).ln().abs() < SAME_START
                && (daq.plane_at_infinity - other.plane_at_infinity).norm()
                    < 0.05 * (1.0 + daq.plane_at_infinity.norm())
        });
        if !repeats && kept.len() < REFINED_STARTS {
            kept.push(daq);
        }
    }
    let windows = STARTS - 1;
    let ratio = (WINDOW_RANGE.1 / WINDOW_RANGE.0).ln() / windows as f64;
    let mut windowed: Vec<(Daq, f64)> = (0..=windows)
        .filter_map(|k| best_near(WINDOW_RANGE.0 * (ratio * k as f64).exp(), WINDOW_HALF_WIDTH))
        .map(|daq| (daq, daq::residual(cameras, &daq)))
        .collect();
    windowed.sort_by(|a, b| a.1.total_cmp(&b.1));
    kept.extend(windowed.into_iter().map(|(daq, _)| daq).take(STARTS - kept.len()));
    kept
}

/// Every so many-th point, when there are more than the search needs: their observations, and which were chosen.
fn subsample(frame: &CanonicalFrame, observations: &[Observation]) -> (Option<Vec<Observation>>, Option<Vec<bool>>) {
    let points = frame.points.len();
    if points <= SEARCH_POINTS {
        return (None, None);
    }
    let mut chosen = vec![false; points];
    (0..SEARCH_POINTS).for_each(|k| chosen[k * points / SEARCH_POINTS] = true);
    // A view that would be left with too few points keeps all of its own.
    let mut left = vec![0usize; frame.cameras.len()];
    let in_range = |seen: &&Observation| seen.view < frame.cameras.len() && seen.point < points;
    for seen in observations.iter().filter(in_range) {
        left[seen.view] += usize::from(chosen[seen.point]);
    }
    for seen in observations.iter().filter(in_range) {
        if left[seen.view] < LEAST_POINTS_OF_A_VIEW {
            chosen[seen.point] = true;
        }
    }
    let subset = observations.iter().filter(in_range).filter(|seen| chosen[seen.point]).copied().collect();
    (Some(subset), Some(chosen))
}

/// Points below which the search does not thin out a view.
const LEAST_POINTS_OF_A_VIEW: usize = 20;

/// Triangulates the points that took no part in the search with the cameras it found.
fn fill_points(minimum: &mut Minimum, chosen: &[bool], observations: &[Observation]) {
    let cameras = minimum.reconstruction.cameras();
    let points = &mut minimum.reconstruction.points;
    let mut of_point = vec![Vec::new(); points.len()];
    for seen in observations.iter().filter(|seen| seen.view < cameras.len()) {
        if let Some(of_point) = of_point.get_mut(seen.point) {
            of_point.push(*seen);
        }
    }
    for ((point, of_point), chosen) in points.iter_mut().zip(&of_point).zip(chosen) {
        if *chosen || of_point.is_empty() {
            continue;
        }
        let homogeneous = triangulation::linear(&cameras, of_point);
        let position: Vector3<f64> = homogeneous.xyz() / homogeneous.w;
        if position.iter().all(|value| value.is_finite()) {
            *point = position;
        }
    }
}
