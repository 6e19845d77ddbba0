//! What a reconstruction costs.

use nalgebra::Vector3;

use super::super::Loss;
use super::super::metric::IntrinsicsPrior;
use super::super::problem::{UNDEFINED_SQUARED, usable_squared_norm};
use super::MetricReconstruction;
use super::layout::Seen;
use super::worker_pool::WorkerPool;

/// Sum of the loss over the observations and of what the priors add; `None` when it was stopped.
pub(super) fn cost(
    sequence: &MetricReconstruction,
    priors: &[IntrinsicsPrior],
    loss: Loss,
    pool: &WorkerPool,
) -> Option<f64> {
    let layout = pool.layout;
    let groups = priors.iter().zip(&layout.unknowns.parameters).zip(&sequence.intrinsics);
    let of_priors: f64 = groups.map(|((prior, parameters), intrinsics)| prior.cost(parameters, intrinsics)).sum();
    let of_point = |point: usize| Some(cost_of_point(sequence, layout.seen(point), &sequence.points[point], loss));
    Some(pool.of_points(of_point)?.into_iter().fold(of_priors, |sum, cost| sum + cost))
}

/// Sum of the loss over the observations of one point, were it at this position.
pub(super) fn cost_of_point(
    sequence: &MetricReconstruction,
    seen: &[Seen],
    position: &Vector3<f64>,
    loss: Loss,
) -> f64 {
    let mut sum = 0.0;
    for seen in seen {
        let at = sequence.poses[seen.view].apply(position);
        let residual = sequence.intrinsics_of(seen.view).project(&at) - seen.xy;
        sum += loss.cost(seen.weight * usable_squared_norm(&residual).unwrap_or(UNDEFINED_SQUARED));
    }
    sum
}
