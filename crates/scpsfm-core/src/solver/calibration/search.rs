//! The search for the metric reconstruction: many starts, few that converge.

use super::fit::Fit;
use super::options::{CalibrationOptions, SearchOptions};
use super::{Stretch, Uncalibrated};
use crate::geometry::bundle::Options;
use crate::geometry::bundle::critical::Translating;
use crate::geometry::bundle::metric::{
    Information, Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction,
};
use crate::geometry::bundle::sequence;
use crate::geometry::daq::{self, CanonicalFrame, Daq, Free};
use crate::geometry::metric::{cheirality, retriangulate, upgrade, upgrade_translation};
use crate::geometry::observation::Observation;
use crate::geometry::statistics::{median, root_mean_square};
use crate::solver::error::Error;

/// A converged metric reconstruction.
#[derive(Debug, Clone)]
pub(super) struct Minimum {
    pub reconstruction: MetricReconstruction,
    pub cost: f64,
    pub cheirality: f64,
    /// Whether its adjustment ended early, as its cost would not come near the one that it was compared with.
    pub is_hopeless: bool,
}

impl Uncalibrated<'_> {
    /// The same by the observations of these points; all of them where there are none.
    fn on_subset<'s>(&'s self, thinned: Option<&'s Thinned>) -> Uncalibrated<'s> {
        Uncalibrated { observations: thinned.map_or(self.observations, |thinned| &thinned.observations), ..*self }
    }
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

    /// Whether it is the other minimum again: at the same focal lengths, and hardly dearer, or cheaper.
    ///
    /// * `counts`: one a view
    pub fn repeats(&self, other: &Self, counts: &[bool], options: &SearchOptions) -> bool {
        self.apart(other, |view| counts[view]) < options.same_minimum
            && self.cost < (1.0 + options.same_cost) * other.cost
    }

    /// Of which views the observations determine the focal length; all where they do of none.
    pub fn determined(&self, problem: &Uncalibrated) -> Vec<bool> {
        let views = self.reconstruction.focals.len();
        if views == 0 {
            return Vec::new();
        }
        let model = IntrinsicsModel::FOCAL_PER_VIEW;
        let information = Information::new(&self.reconstruction, problem.observations);
        let Some(information) = information else { return vec![true; views] };
        let noise = Fit::metric(self.cost, &self.reconstruction, model, problem).noise;
        let sigmas = information
            .own_focals(&information.optimum(model, &vec![IntrinsicsPrior::NONE; problem.groups()]))
            .into_iter();
        let determined: Vec<bool> = sigmas
            .map(|(variance, _)| {
                variance.is_some_and(|variance| variance.sqrt() * noise <= problem.options.grades.weak_up_to)
            })
            .collect();
        if determined.contains(&true) { determined } else { vec![true; views] }
    }

    /// The same with other lenses, still to be adjusted.
    ///
    /// * `other`: what stands in the place of the lens of a group
    pub fn with_lenses(&self, other: impl Fn(usize, &Intrinsics) -> Intrinsics) -> Self {
        let mut found = self.clone();
        let reconstruction = &mut found.reconstruction;
        for (group, lens) in reconstruction.intrinsics.iter_mut().enumerate() {
            let before = lens.focal;
            *lens = other(group, lens);
            // Views have focal lengths of their own only where they are of one group.
            reconstruction.focals.iter_mut().for_each(|focal| *focal *= lens.focal / before);
        }
        found
    }
}

/// What minima are searched by.
#[derive(Clone, Copy)]
pub(super) struct Search<'a> {
    pub problem: &'a Uncalibrated<'a>,
    /// What is known of the intrinsics of each group beforehand.
    pub priors: &'a [IntrinsicsPrior],
}

impl Search<'_> {
    /// The minimum that a reconstruction converges to with this model.
    pub fn converged(&self, start: MetricReconstruction, model: IntrinsicsModel) -> Minimum {
        self.converge(&self.problem.options.search.to_convergence(), start, model)
    }

    /// The same; `None` where its cost will not come near this one, so that it is none to compare with.
    pub fn converged_near(&self, start: MetricReconstruction, model: IntrinsicsModel, cost: f64) -> Option<Minimum> {
        let CalibrationOptions { search: options, grades, .. } = self.problem.options;
        // Of costs below the noise no difference tells anything.
        let told_apart = cost + grades.indistinguishable * self.problem.noise.powi(2);
        let hopeless_above = (options.hopeless_cost * cost).max(told_apart);
        let minimum = self.converge(&Options { hopeless_above, ..options.to_convergence() }, start, model);
        (!minimum.is_hopeless).then_some(minimum)
    }

    /// What these converge to, cheapest first, without those whose cost will not come near the cheapest, or this one.
    fn converged_below(
        &self,
        mut cheapest: f64,
        starts: impl IntoIterator<Item = MetricReconstruction>,
        model: IntrinsicsModel,
    ) -> Result<Vec<Minimum>, Error> {
        let mut found = Vec::new();
        for start in starts {
            Error::check(self.problem.stop)?;
            if let Some(minimum) = self.converged_near(start, model, cheapest) {
                cheapest = cheapest.min(minimum.cost);
                found.push(minimum);
            }
        }
        Error::check(self.problem.stop)?;
        Ok(distinct(found, self.problem))
    }

    /// Adjusts, and once more where points that diverged were triangulated anew.
    fn converge(&self, options: &Options, start: MetricReconstruction, model: IntrinsicsModel) -> Minimum {
        let mut minimum = self.adjusted(options, start, model);
        let again = !minimum.is_hopeless && self.retriangulate_diverged(&mut minimum.reconstruction);
        if again { self.adjusted(options, minimum.reconstruction, model) } else { minimum }
    }

    /// Triangulates the points anew that diverged on the way to a minimum; whether any moved.
    ///
    /// A step may take a point past infinity, or so far out that no gradient leads it back. It then costs many times
    /// what others do, and lens and poses give way to it.
    fn retriangulate_diverged(&self, reconstruction: &mut MetricReconstruction) -> bool {
        if reconstruction.has_common_centre {
            return false;
        }
        let (views, points) = (reconstruction.poses.len(), reconstruction.points.len());
        let mut sums = vec![(0.0, 0.0); points];
        for seen in self.problem.observations.iter().filter(|seen| seen.is_usable(views, points)) {
            let (cost, count) = &mut sums[seen.point];
            *cost += reconstruction.weighted_squared(seen);
            *count += 1.0;
        }
        let mut observed: Vec<f64> = sums.iter().filter(|(_, count)| *count > 0.0).map(|(cost, n)| cost / n).collect();
        let limit = self.problem.options.search.diverged_above * median(&mut observed);
        // Written so that NaN counts as diverged.
        let has_diverged = |(cost, count): (f64, f64)| count > 0.0 && !matches!(cost / count, mean if mean <= limit);
        let diverged: Vec<bool> = sums.into_iter().map(has_diverged).collect();
        retriangulate(reconstruction, self.problem.observations, &diverged) > 0
    }

    /// What a start comes to with these options, a minimum or not yet.
    fn adjusted(&self, options: &Options, start: MetricReconstruction, model: IntrinsicsModel) -> Minimum {
        let Uncalibrated { observations, stop, .. } = *self.problem;
        let mut reconstruction = start;
        let report = sequence::adjust_all(&mut reconstruction, observations, model, self.priors, options, stop);
        (self.problem.heartbeat)();
        let cheirality = cheirality(&reconstruction, observations);
        Minimum { reconstruction, cost: report.cost, cheirality, is_hopeless: report.is_hopeless }
    }

    /// Minima that are reached from other focal lengths than that of a metric reconstruction, cheapest first. Those far
    /// above a cost are left out.
    ///
    /// * `cost`: of the minimum near `metric`
    /// * `stretch`: some of the views, where they are many: all are adjusted from the focal lengths found there
    pub fn minima_from_other_focals(
        &self,
        metric: &MetricReconstruction,
        model: IntrinsicsModel,
        cost: f64,
        stretch: Option<&Stretch>,
    ) -> Result<Vec<Minimum>, Error> {
        let options = &self.problem.options.search;
        let following = Options { max_iterations: options.following_iterations, ..Options::DEFAULT };
        // Poses and points follow: freed at once, they would only go back to where they were.
        let start = |search: &Search, metric: &MetricReconstruction, factor: f64| {
            let start = metric.clone().with_scaled_focals(factor);
            search.adjusted(&following, start, IntrinsicsModel::FIXED).reconstruction
        };
        let mut factors = options.other_focals.to_vec();
        if let Some(stretch) = stretch {
            let search = Search { problem: &stretch.problem, ..*self };
            let here = MetricReconstruction { intrinsics: metric.intrinsics.clone(), ..stretch.metric.clone() };
            let near = search.converged(here.clone(), model);
            let starts = factors.iter().map(|&factor| start(&search, &here, factor));
            let found = search.converged_below(near.cost, starts, model)?;
            factors = found.iter().map(|other| (other.log_focal() - near.log_focal()).exp()).collect();
            factors.retain(|factor| factor.ln().abs() > options.same_minimum);
        }
        let starts = factors.iter().map(|&factor| start(self, metric, factor));
        self.converged_below(cost, starts, model)
    }

    /// Metric reconstructions with the focal length free, or one of each view, that different starts converge to,
    /// cheapest first.
    pub fn minima(&self, frame: &CanonicalFrame) -> Result<Vec<Minimum>, Error> {
        match self.problem.focal_per_view {
            true => self.minima_per_view(frame),
            false if self.problem.groups() > 1 => self.minima_of_groups(frame),
            false => self.minima_of_one(frame),
        }
    }

    /// With a focal length a camera group: from what one of each view leads to.
    fn minima_of_groups(&self, frame: &CanonicalFrame) -> Result<Vec<Minimum>, Error> {
        let problem = self.problem;
        let alone = Uncalibrated { group_of: &vec![0; frame.cameras.len()], focal_priors: &[None], ..*problem };
        let found = Search { problem: &alone, ..*self }.minima_per_view(frame)?;
        let in_groups = |minimum: Minimum| minimum.reconstruction.in_groups(problem.group_of, problem.groups());
        self.converged_below(f64::INFINITY, found.into_iter().map(in_groups), IntrinsicsModel::FOCAL)
    }

    /// With a focal length a view, of which nothing is known: from the quadrics that allow for that, and from the
    /// starts with one for all.
    fn minima_per_view(&self, frame: &CanonicalFrame) -> Result<Vec<Minimum>, Error> {
        let (model, search) = (IntrinsicsModel::FOCAL_PER_VIEW, Search { priors: &[IntrinsicsPrior::NONE], ..*self });
        let (problem, options) = (self.problem, &self.problem.options.search);
        let quadrics = daq::view_focal_starts(&frame.cameras).into_iter().take(options.starts);
        let mut starts: Vec<MetricReconstruction> =
            quadrics.filter_map(|(daq, _)| upgrade(frame, &daq, true, problem.observations)).collect();
        let thinned = Thinned::new(frame, problem);
        let on_subset = Search { problem: &problem.on_subset(thinned.as_ref()), ..search };
        for start in on_subset.starts_of_one(frame)? {
            let start = start.reconstruction.with_own_focals();
            starts.push(match &thinned {
                Some(thinned) => thinned.completed(start, problem.observations),
                None => start,
            });
        }
        let mut found = Vec::with_capacity(starts.len());
        for reconstruction in starts {
            Error::check(self.problem.stop)?;
            found.push(search.adjusted(&options.first(), reconstruction, model));
        }
        let mut found = distinct(found, problem);
        found.truncate(options.converged);
        search.converged_below(f64::INFINITY, found.into_iter().map(|minimum| minimum.reconstruction), model)
    }

    /// With one focal length for all views.
    fn minima_of_one(&self, frame: &CanonicalFrame) -> Result<Vec<Minimum>, Error> {
        let (model, problem) = (IntrinsicsModel::FOCAL, self.problem);
        let thinned = Thinned::new(frame, problem);
        let on_subset = Search { problem: &problem.on_subset(thinned.as_ref()), ..*self };
        let mut converged: Vec<Minimum> = Vec::new();
        let mut cheapest = f64::INFINITY;
        for start in on_subset.starts_of_one(frame)? {
            Error::check(self.problem.stop)?;
            let Some(mut minimum) = on_subset.converged_near(start.reconstruction, model, cheapest) else { continue };
            cheapest = cheapest.min(minimum.cost);
            if let Some(thinned) = &thinned {
                let start = thinned.completed(minimum.reconstruction, problem.observations);
                minimum = self.converged(start, model);
            }
            converged.push(minimum);
        }
        Error::check(self.problem.stop)?;
        Ok(distinct(converged, problem))
    }

    /// The best starts with one focal length for all views after their first steps, which are no minima yet, cheapest
    /// first.
    fn starts_of_one(&self, frame: &CanonicalFrame) -> Result<Vec<Minimum>, Error> {
        let options = &self.problem.options.search;
        let mut found: Vec<Minimum> = Vec::new();
        for start in starts(frame, options) {
            Error::check(self.problem.stop)?;
            let Some(start) = upgrade(frame, &start, false, self.problem.observations) else { continue };
            found.push(self.adjusted(&options.first(), start, IntrinsicsModel::FOCAL));
        }
        let mut found = distinct(found, self.problem);
        found.truncate(options.converged);
        Ok(found)
    }

    /// What starts that were found otherwise than by the quadric converge to, cheapest first.
    pub fn minima_from(&self, starts: Vec<MetricReconstruction>) -> Result<Vec<Minimum>, Error> {
        let problem = self.problem;
        let model = IntrinsicsModel::focal(problem.focal_per_view);
        let start = |mut start: MetricReconstruction| {
            start.intrinsics.iter_mut().for_each(|intrinsics| *intrinsics = Intrinsics::from_focal(intrinsics.focal));
            match problem.focal_per_view {
                true => start.with_own_focals(),
                false => start.in_groups(problem.group_of, problem.groups()),
            }
        };
        self.converged_below(f64::INFINITY, starts.into_iter().map(start), model)
    }

    /// The metric reconstruction of a camera that moved without turning, from a focal length that is known otherwise;
    /// empty where there is none.
    pub fn known_focal(&self, translation: &Translating, focal: f64) -> Vec<Minimum> {
        let start = upgrade_translation(translation, focal, self.problem.observations);
        let minimum = start.map(|start| self.converged(start, IntrinsicsModel::FOCAL));
        distinct(minimum.into_iter().collect(), self.problem)
    }
}

/// Cheapest first, without those that repeat a cheaper one.
pub(super) fn distinct(mut found: Vec<Minimum>, problem: &Uncalibrated) -> Vec<Minimum> {
    let options = &problem.options.search;
    found.retain(|minimum| minimum.cost.is_finite() && minimum.log_focal().is_finite());
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let counts = found.first().map(|cheapest| cheapest.determined(problem)).unwrap_or_default();
    let mut kept: Vec<Minimum> = Vec::with_capacity(found.len());
    for candidate in found {
        if !kept.iter().any(|minimum| candidate.repeats(minimum, &counts, options)) {
            kept.push(candidate);
        }
    }
    kept
}

/// Different starts: the best of the scan, refined, then the best of each window of the scan.
fn starts(frame: &CanonicalFrame, options: &SearchOptions) -> Vec<Daq> {
    let cameras = &frame.cameras;
    let scanned = daq::scan(cameras, options.scan_focals, options.scan_views);
    let best_near = |focal: f64, half_width: f64| {
        scanned.iter().find(|(daq, _)| (daq.intrinsics.focal / focal).ln().abs() < half_width).map(|(daq, _)| *daq)
    };
    let mut to_refine: Vec<Daq> = scanned.iter().take(options.refined_from_scan).map(|(daq, _)| *daq).collect();
    to_refine.extend(options.scan_centres.into_iter().filter_map(|focal| best_near(focal, options.scan_half_width)));
    let mut refined: Vec<(Daq, f64)> = to_refine
        .into_iter()
        .map(|start| daq::refine(cameras, start, Free::FocalAndPlane, options.refine_iterations))
        .filter(|(daq, cost)| cost.is_finite() && options.refined_focals.contains(&daq.intrinsics.focal))
        .collect();
    refined.sort_by(|a, b| a.1.total_cmp(&b.1));

    let mut kept: Vec<Daq> = Vec::with_capacity(options.starts);
    for (daq, _) in refined {
        let repeats = kept.iter().any(|other| {
            (daq.intrinsics.focal / other.intrinsics.focal).ln().abs() < options.same_start
                && (daq.plane_at_infinity - other.plane_at_infinity).norm()
                    < options.same_plane * (1.0 + daq.plane_at_infinity.norm())
        });
        if !repeats && kept.len() < options.refined_starts {
            kept.push(daq);
        }
    }
    let windows = options.starts.saturating_sub(1).max(1);
    let ratio = (options.window_range.1 / options.window_range.0).ln() / windows as f64;
    let mut windowed: Vec<(Daq, f64)> = (0..=windows)
        .filter_map(|k| best_near(options.window_range.0 * (ratio * k as f64).exp(), options.window_half_width))
        .map(|daq| (daq, daq::residual(cameras, &daq)))
        .collect();
    windowed.sort_by(|a, b| a.1.total_cmp(&b.1));
    kept.extend(windowed.into_iter().map(|(daq, _)| daq).take(options.starts.saturating_sub(kept.len())));
    kept
}

/// Every so many-th point, where there are more than the search needs.
struct Thinned {
    /// Those of the points that were chosen.
    observations: Vec<Observation>,
    was_left_out: Vec<bool>,
}

impl Thinned {
    /// `None` where all points take part.
    fn new(frame: &CanonicalFrame, problem: &Uncalibrated) -> Option<Self> {
        let (points, options) = (frame.points.len(), &problem.options.search);
        if points <= options.points {
            return None;
        }
        let mut chosen = vec![false; points];
        (0..options.points).for_each(|k| chosen[k * points / options.points] = true);
        // A view that would be left with too few points keeps all of its own.
        let mut left = vec![0usize; frame.cameras.len()];
        let in_range = |seen: &&Observation| seen.view < frame.cameras.len() && seen.point < points;
        for seen in problem.observations.iter().filter(in_range) {
            left[seen.view] += usize::from(chosen[seen.point]);
        }
        for seen in problem.observations.iter().filter(in_range) {
            if left[seen.view] < options.least_points_of_view {
                chosen[seen.point] = true;
            }
        }
        let of_chosen = |seen: &&Observation| in_range(seen) && chosen[seen.point];
        Some(Self {
            observations: problem.observations.iter().filter(of_chosen).copied().collect(),
            was_left_out: chosen.iter().map(|chosen| !chosen).collect(),
        })
    }

    /// A reconstruction that was found from these points with the others triangulated.
    fn completed(&self, mut found: MetricReconstruction, observations: &[Observation]) -> MetricReconstruction {
        retriangulate(&mut found, observations, &self.was_left_out);
        found
    }
}
