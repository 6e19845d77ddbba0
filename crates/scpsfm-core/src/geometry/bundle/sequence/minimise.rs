//! Levenberg-Marquardt over a sequence.

use super::super::metric::{IntrinsicsModel, IntrinsicsPrior, POSE};
use super::super::{Loss, Options, Report};
use super::layout::Layout;
use super::normal::Normal;
use super::pattern::Pattern;
use super::point::{cost_of_point, iterate_points};
use super::reduced::{Reduced, substitute};
use super::solver::SparseCholesky;
use super::worker_pool::WorkerPool;
use super::{Free, MetricReconstruction, Observation, Run};
use crate::domain::StopToken;
use crate::geometry::levenberg_marquardt::{self, LeastSquares, StepCost};
use crate::parallel::Threads;

/// Factor by which a step may raise the cost for its points to be iterated. A chain of 100 views bent by half a radian
/// takes 14 steps with 2, 9 with 10; but from a start with cameras a quarter of the depth away, points end in
/// false places with 10 and do not with 2.
const ITERATE_WITHIN: f64 = 2.0;

/// Minimises the reprojection error over what is free.
///
/// * `priors`: what is known of the intrinsics, one a group; nothing of a group beyond the slice
///
/// The cost contains what the priors of groups with free intrinsics add, and never rises. What is held stays as it is,
/// to the bit; what is found does not depend on the threads. One iteration costs time linear in the observations times
/// the length of their tracks, and what the factorisation takes: linear in the views where each is connected with a
/// bounded number of others. `run.stop` is asked every few milliseconds, but not while the observations are laid out (a
/// million take a fifth of a second) nor within a factorisation; a stopped, stuck or degenerate problem keeps its last
/// good state. The costs of one that was stopped before they were known are infinite.
///
/// # Pitfall
/// Points may pass behind a camera on the way: residuals know no cheirality, so check it on the result.
pub fn adjust(
    sequence: &mut MetricReconstruction,
    observations: &[Observation],
    free: &Free,
    priors: &[IntrinsicsPrior],
    options: &Options,
    run: Run,
) -> Report {
    let Run { threads, stop, heartbeat } = run;
    let layout = Layout::new(sequence, observations, free);
    let pool = WorkerPool::new(&layout, threads, stop);
    let loss = options.loss;
    let solvable = || {
        let pattern = Pattern::new(sequence, &layout, stop)?;
        let sparse = if pattern.is_square { None } else { Some(SparseCholesky::new(&pattern)?) };
        Some((sparse, pattern))
    };
    let Some((sparse, pattern)) = (!layout.all_seen.is_empty()).then(solvable).flatten() else {
        return Report::at(cost(sequence, priors, loss, &pool).unwrap_or(f64::INFINITY));
    };
    let normal = Normal::new(&layout, &pattern, sequence);
    let reduced = Reduced::new(&layout, pattern);
    let mut descent = Descent { priors, loss, normal, reduced, sparse, pool: &pool, heartbeat };
    let report = levenberg_marquardt::minimise(&mut descent, sequence, options, stop);
    sequence.average_focals();
    report
}

/// As [`adjust`], over all poses and points and one model for every camera group, on the caller's thread. Focal
/// lengths a view are free only where the reconstruction has them.
pub fn adjust_all(
    reconstruction: &mut MetricReconstruction,
    observations: &[Observation],
    model: IntrinsicsModel,
    priors: &[IntrinsicsPrior],
    options: &Options,
    stop: &StopToken,
) -> Report {
    let models = vec![model; reconstruction.intrinsics.len()];
    let run = Run { threads: Threads::ONE, stop, heartbeat: &mut || () };
    adjust(reconstruction, observations, &Free::all(&models), priors, options, run)
}

/// Sum of the loss over the observations and of what the priors add; `None` when it was stopped.
fn cost(sequence: &MetricReconstruction, priors: &[IntrinsicsPrior], loss: Loss, pool: &WorkerPool) -> Option<f64> {
    let layout = pool.layout;
    let groups = priors.iter().zip(&layout.unknowns.parameters).zip(&sequence.intrinsics);
    let of_priors: f64 = groups.map(|((prior, parameters), intrinsics)| prior.cost(parameters, intrinsics)).sum();
    let of_point = |point: usize| Some(cost_of_point(sequence, layout.seen(point), &sequence.points[point], loss));
    Some(pool.of_points(of_point)?.into_iter().fold(of_priors, |sum, cost| sum + cost))
}

/// What the steps need from one to the next.
struct Descent<'a> {
    priors: &'a [IntrinsicsPrior],
    loss: Loss,
    normal: Normal,
    reduced: Reduced,
    /// The factorisation of the reduced system; `None` where that is a square matrix.
    sparse: Option<SparseCholesky>,
    pool: &'a WorkerPool<'a>,
    heartbeat: &'a mut dyn FnMut(),
}

impl LeastSquares for Descent<'_> {
    type State = MetricReconstruction;

    /// Lower than for a dense system: the weakest directions of a long chain of views would hardly move at its damping.
    /// Where rounding takes the system's definiteness, the attempt fails and is repeated with more.
    const MIN_DAMPING: f64 = 1e-14;

    fn cost(&self, sequence: &MetricReconstruction) -> f64 {
        cost(sequence, self.priors, self.loss, self.pool).unwrap_or(f64::INFINITY)
    }

    /// What is left unfinished when it is stopped is not used: no attempt follows.
    fn linearise(&mut self, sequence: &MetricReconstruction) {
        self.normal.fill(sequence, self.priors, self.loss, self.pool);
    }

    fn step(&mut self, from: &MetricReconstruction, damping: f64, to: &mut MetricReconstruction) -> Option<f64> {
        let Self { normal, reduced, pool, .. } = self;
        if !reduced.build(normal, damping, pool) {
            return None;
        }
        reduced.damp(normal, damping);
        if !reduced.solve(self.sparse.as_mut()) {
            return None;
        }
        let step = &reduced.vector;
        let possible = retract(to, from, pool.layout, step) && substitute(to, from, normal, damping, step, pool);
        // The rows of the Jacobian are not kept: what they predict is not known.
        possible.then_some(f64::NAN)
    }

    fn attempt(
        &mut self,
        from: &MetricReconstruction,
        damping: f64,
        present: f64,
        to: &mut MetricReconstruction,
    ) -> Option<StepCost> {
        let moved = self.step(from, damping, to).map(|predicted| StepCost { cost: self.cost(to), predicted });
        (self.heartbeat)();
        let StepCost { cost, predicted } = moved?;
        if cost < present || cost > ITERATE_WITHIN * present {
            return Some(StepCost { cost, predicted });
        }
        // Cheaper than another system: most of what a long step spoils is the points' part of its curvature.
        let lowered = iterate_points(to, self.loss, self.pool)?;
        Some(StepCost { cost: cost - lowered, predicted })
    }
}

/// Moves poses and intrinsics from where they are in `from`; `false` where a scale vanishes or nothing finite is left.
pub(super) fn retract(
    moved: &mut MetricReconstruction,
    from: &MetricReconstruction,
    layout: &Layout,
    step: &[f64],
) -> bool {
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
    // A focal length that a group moves, it moves of all its views.
    let shared = |group: usize| Some(moved.intrinsics.get(group)?.focal / from.intrinsics.get(group)?.focal);
    for ((own, from), &group) in moved.focals.iter_mut().zip(&from.focals).zip(&from.group_of) {
        *own = from * shared(group).unwrap_or(1.0);
    }
    for (view, block) in unknowns.view_block.iter().enumerate() {
        let Some(block) = block else { continue };
        if let Some((step, own_focal)) = step[unknowns.range(*block)].split_first_chunk::<POSE>() {
            moved.poses[view] = from.poses[view].moved(*step);
            possible &= moved.poses[view].translation.iter().all(|value| value.is_finite());
            if let [by] = own_focal {
                moved.focals[view] *= by.exp();
                possible &= moved.focals[view].is_normal();
            }
        }
    }
    possible
}
