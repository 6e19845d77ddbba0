//! The Levenberg-Marquardt loop over a sequence.

use nalgebra::{Rotation3, Vector3};

use super::super::engine::{DAMPING_DOWN, DAMPING_UP, MAX_ATTEMPTS, UNDEFINED_SQUARED, usable_squared_norm};
use super::super::metric::IntrinsicsPrior;
use super::super::{Loss, Options, Report};
use super::crew::Crew;
use super::layout::{Layout, Seen};
use super::normal::Normal;
use super::pattern::Pattern;
use super::reduced::{Reduced, substitute};
use super::settle::settle_points;
use super::solver::Solver;
use super::{Free, Pace, Run, Sequence, Sighting};

/// Least damping, as a share of the diagonal. Lower than for a block: the weakest directions of a long chain of views
/// would hardly move at a block's. Where rounding takes the system's definiteness, the attempt fails and is repeated
/// with more.
const MIN_DAMPING: f64 = 1e-14;

/// Factor on the damping's factor with each rejected step: the attempts span 5e15, from the least damping to one that
/// allows but a small step downhill.
const GROWTH_UP: f64 = 2.0;

/// Factor by which a step may raise the cost for its points to be settled. A chain of 100 views bent by half a radian
/// takes 14 steps with 2, 9 with 10; but from a start with cameras a quarter of the depth away, points settle into
/// false places with 10 and do not with 2.
const SETTLE_WITHIN: f64 = 2.0;

/// Minimises the reprojection error over what is free.
///
/// * `priors`: what is known of the intrinsics, one a group; nothing of a group beyond the slice
///
/// The cost contains what the priors of groups with free intrinsics add, and never rises. What is held stays as it is,
/// to the bit; what is found does not depend on the threads. One iteration costs time linear in the observations times
/// the length of their tracks, and what the factorisation takes: linear in the views where each is connected with a
/// bounded number of others. `run.stop` is asked every few milliseconds but not within a factorisation; a stopped,
/// stuck or degenerate problem keeps its last good state. The costs of one that was stopped before they were known are
/// infinite.
///
/// # Pitfall
/// Points may pass behind a camera on the way: residuals know no cheirality, so check it on the result.
pub fn adjust(
    sequence: &mut Sequence,
    sightings: &[Sighting],
    free: &Free,
    priors: &[IntrinsicsPrior],
    options: &Options,
    run: Run,
) -> Report {
    let Run { threads, stop, told } = run;
    let mut pace = Pace::new(stop);
    let unknown = Report { initial_cost: f64::INFINITY, cost: f64::INFINITY, iterations: 0 };
    let Some(layout) = Layout::new(sequence, sightings, free, &mut pace) else { return unknown };
    let crew = Crew::new(&layout, threads, stop);
    let Some(initial_cost) = cost(sequence, &layout, priors, options.loss, &crew) else { return unknown };
    let mut report = Report { initial_cost, cost: initial_cost, iterations: 0 };
    if layout.is_empty() || stop.is_stopped() {
        return report;
    }
    let Some(mut descent) = Descent::new(sequence, &layout, priors, options, crew, &mut pace) else { return report };
    let mut trial = sequence.clone();
    while report.iterations < options.max_iterations && report.cost > 0.0 {
        let Some(cost) = descent.step(sequence, &mut trial, report.cost, told) else { break };
        std::mem::swap(sequence, &mut trial);
        let gain = report.cost - cost;
        report.cost = cost;
        report.iterations += 1;
        if gain < options.relative_tolerance * cost {
            break;
        }
    }
    report
}

/// Pattern of the reduced system of a layout; `None` when it was stopped.
pub(super) fn pattern(sequence: &Sequence, layout: &Layout, pace: &mut Pace) -> Option<Pattern> {
    let unknowns = &layout.unknowns;
    let pair = |view: usize| unknowns.pose_block[view].zip(unknowns.group_block_of_view(sequence, view));
    Pattern::new(layout, (0..sequence.poses.len()).filter_map(pair), pace)
}

/// Sum of the loss over the observations and of what the priors add; `None` when it was stopped.
fn cost(sequence: &Sequence, layout: &Layout, priors: &[IntrinsicsPrior], loss: Loss, crew: &Crew) -> Option<f64> {
    let mut sum = 0.0;
    for (group, (prior, intrinsics)) in priors.iter().zip(&sequence.intrinsics).enumerate() {
        for parameter in &layout.unknowns.parameters[group] {
            sum += prior.information[*parameter as usize] * prior.deviation(*parameter, intrinsics).powi(2);
        }
    }
    let of_point = |point: usize| Some(cost_of_point(sequence, layout.seen(point), &sequence.points[point], loss));
    crew.of_points(layout, of_point)?.into_iter().for_each(|cost| sum += cost);
    Some(sum)
}

/// Sum of the loss over the observations of one point, were it at this position.
pub(super) fn cost_of_point(sequence: &Sequence, seen: &[Seen], position: &Vector3<f64>, loss: Loss) -> f64 {
    let mut sum = 0.0;
    for seen in seen {
        let at = sequence.poses[seen.view].apply(position);
        let residual = sequence.intrinsics_of(seen.view).project(&at) - seen.xy;
        sum += loss.cost(seen.weight * usable_squared_norm(&residual).unwrap_or(UNDEFINED_SQUARED));
    }
    sum
}

/// What the steps need from one to the next.
struct Descent<'a> {
    layout: &'a Layout,
    priors: &'a [IntrinsicsPrior],
    loss: Loss,
    normal: Normal,
    reduced: Reduced,
    solver: Solver,
    damping: f64,
    crew: Crew<'a>,
}

impl<'a> Descent<'a> {
    fn new(
        sequence: &Sequence,
        layout: &'a Layout,
        priors: &'a [IntrinsicsPrior],
        options: &Options,
        crew: Crew<'a>,
        pace: &mut Pace,
    ) -> Option<Self> {
        let pattern = pattern(sequence, layout, pace)?;
        Some(Self {
            layout,
            priors,
            loss: options.loss,
            solver: Solver::new(&pattern)?,
            normal: Normal::new(layout, &pattern, sequence),
            reduced: Reduced::new(layout, pattern),
            damping: options.initial_damping.max(MIN_DAMPING),
            crew,
        })
    }

    /// Linearises and raises the damping until `trial` costs less than `present`; its cost.
    fn step(&mut self, sequence: &Sequence, trial: &mut Sequence, present: f64, told: &mut dyn FnMut()) -> Option<f64> {
        if !self.normal.fill(sequence, self.layout, self.priors, self.loss, &self.crew) {
            return None;
        }
        let mut growth = DAMPING_UP;
        for _ in 0..MAX_ATTEMPTS {
            if self.crew.is_stopped() {
                return None;
            }
            let lowered = self.attempt(sequence, trial, present);
            told();
            if lowered.is_some() {
                self.damping = (self.damping / DAMPING_DOWN).max(MIN_DAMPING);
                return lowered;
            }
            self.damping *= growth;
            growth *= GROWTH_UP;
        }
        None
    }

    /// Moves `trial` to where the damped step leads from `sequence`; its cost where that is less than `present`.
    fn attempt(&mut self, sequence: &Sequence, trial: &mut Sequence, present: f64) -> Option<f64> {
        let Self { layout, normal, reduced, crew, .. } = self;
        if !reduced.build(layout, normal, self.damping, crew) {
            return None;
        }
        reduced.damp(normal, self.damping);
        if !reduced.solve(&mut self.solver) {
            return None;
        }
        let step = &reduced.vector;
        let possible = retract(trial, sequence, layout, step);
        if !possible || !substitute(trial, sequence, layout, normal, self.damping, step, crew) {
            return None;
        }
        let cost = cost(trial, layout, self.priors, self.loss, crew)?;
        if cost < present {
            return Some(cost);
        }
        if cost > SETTLE_WITHIN * present {
            return None;
        }
        // Cheaper than another system: most of what a long step spoils is the points' part of its curvature.
        let cost = cost - settle_points(trial, layout, self.loss, crew)?;
        (cost < present).then_some(cost)
    }
}

/// Moves poses and intrinsics from where they are in `from`.
///
/// Cameras turn about their own centres, `x -> dR x + dt` in camera coordinates: about the origin of the world, a
/// camera far from it could turn only against the damping of its lever. `false` where a scale vanishes or nothing
/// finite is left.
pub(super) fn retract(moved: &mut Sequence, from: &Sequence, layout: &Layout, step: &[f64]) -> bool {
    let mut possible = true;
    let unknowns = &layout.unknowns;
    for (group, block) in unknowns.group_block.iter().enumerate() {
        let Some(block) = block else { continue };
        moved.intrinsics[group] = from.intrinsics[group];
        for (parameter, by) in unknowns.parameters[group].iter().zip(&step[unknowns.range(*block)]) {
            moved.intrinsics[group].shift(*parameter, *by);
        }
        possible &=
            [moved.intrinsics[group].focal, moved.intrinsics[group].aspect].iter().all(|scale| scale.is_normal());
    }
    for (view, block) in unknowns.pose_block.iter().enumerate() {
        let Some(block) = block else { continue };
        if let &[a, b, c, x, y, z] = &step[unknowns.range(*block)] {
            let turn = Rotation3::from_scaled_axis([a, b, c].into());
            moved.poses[view].rotation = turn * from.poses[view].rotation;
            moved.poses[view].translation = turn * from.poses[view].translation + Vector3::new(x, y, z);
            possible &= moved.poses[view].translation.iter().all(|value| value.is_finite());
        }
    }
    possible
}
