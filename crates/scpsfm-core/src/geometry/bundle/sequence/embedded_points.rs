//! Points after a long step of the cameras: each to its own minimum (embedded point iterations; Jeong, Nister, Steedly,
//! Szeliski, Kweon 2012, "Pushing the envelope of modern methods for bundle adjustment").
//!
//! Long chains of views bend at next to no cost. Cameras and points that follow a bend along its tangent are stretched
//! across its axis and not along it, which costs by the square of the angle; points that are put where the moved
//! cameras see them leave the third power.

use nalgebra::Vector3;

use super::super::Loss;
use super::MetricReconstruction;
use super::cost::cost_of_point;
use super::layout::Seen;
use super::normal::Weighted;
use super::point::PointBlock;
use super::worker_pool::WorkerPool;

/// Gauss-Newton steps of a point at most: they converge quadratically from nearby.
const STEPS: usize = 3;
/// Share of its cost by which a point's last step has to lower it for another to follow.
const WORTHWHILE: f64 = 1e-2;

/// Moves every point towards its minimum with the cameras as they are; by how much that lowers the cost. `None`
/// when it was stopped.
pub(super) fn iterate_points(sequence: &mut MetricReconstruction, loss: Loss, pool: &WorkerPool) -> Option<f64> {
    let of_point = |point: usize| Some(iterate(sequence, pool.layout.seen(point), sequence.points[point], loss));
    let iterated = pool.of_points(of_point)?;
    let mut lowered = 0.0;
    for (slot, (position, by)) in sequence.points.iter_mut().zip(iterated) {
        *slot = position;
        lowered += by;
    }
    Some(lowered)
}

/// A point nearer its minimum, and by how much it costs less there.
fn iterate(
    sequence: &MetricReconstruction,
    seen: &[Seen],
    mut position: Vector3<f64>,
    loss: Loss,
) -> (Vector3<f64>, f64) {
    let initial_cost = cost_of_point(sequence, seen, &position, loss);
    let mut cost = initial_cost;
    for _ in 0..STEPS {
        let mut block = PointBlock::ZERO;
        for row in seen.iter().filter_map(|seen| Weighted::new(sequence, &position, seen, &[], loss)) {
            block.add(&row.point, row.residual);
        }
        if sequence.has_common_centre {
            block.hold_length(&position);
        }
        let Some(factor) = block.factor(0.0) else { break };
        let moved = position - factor.unwhiten(&factor.whiten(&block.gradient));
        let moved_cost = cost_of_point(sequence, seen, &moved, loss);
        let lower = moved_cost < cost && moved.iter().all(|value| value.is_finite());
        if !lower {
            break;
        }
        let gain = cost - moved_cost;
        (position, cost) = (moved, moved_cost);
        if gain < WORTHWHILE * cost {
            break;
        }
    }
    (position, initial_cost - cost)
}
