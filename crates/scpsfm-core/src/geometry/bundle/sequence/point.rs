//! A point by itself: what it costs, its block of the normal equations and its elimination, and its own minimum with
//! the cameras as they are.

use nalgebra::Vector3;

use super::super::Loss;
use super::super::engine::POINT_DAMPING;
use super::super::metric::POINT;
use super::super::problem::{UNDEFINED_SQUARED, usable_squared_norm};
use super::MetricReconstruction;
use super::layout::Seen;
use super::normal::Weighted;
use super::worker_pool::WorkerPool;

/// Gauss-Newton steps of a point at most: they converge quadratically from nearby.
const STEPS: usize = 3;
/// Share of its cost by which a point's last step has to lower it for another to follow.
const WORTHWHILE: f64 = 1e-2;

/// Information on a point and half the gradient of the cost by it.
#[derive(Debug, Clone, Copy)]
pub(super) struct PointBlock {
    /// Lower triangle, column after column.
    matrix: [f64; 6],
    pub gradient: Vector3<f64>,
}

/// `L` of a point's damped block `L L'`, lower triangle by columns, with the diagonal inverted.
#[derive(Debug, Clone, Copy)]
pub(super) struct PointFactor([f64; 6]);

impl PointBlock {
    pub const ZERO: Self = Self { matrix: [0.0; 6], gradient: Vector3::new(0.0, 0.0, 0.0) };

    #[inline(always)]
    pub fn add(&mut self, rows: &[Vector3<f64>; 2], residual: [f64; 2]) {
        let [a, b] = rows;
        let entry = |i: usize, j: usize| a[i] * a[j] + b[i] * b[j];
        let added = [entry(0, 0), entry(1, 0), entry(2, 0), entry(1, 1), entry(2, 1), entry(2, 2)];
        self.matrix.iter_mut().zip(added).for_each(|(sum, value)| *sum += value);
        self.gradient += a * residual[0] + b * residual[1];
    }

    /// Holds the length of a direction, which no observation tells: rounding would step along it by any amount.
    #[inline(always)]
    pub fn hold_length(&mut self, direction: &Vector3<f64>) {
        let [m00, _, _, m11, _, m22] = self.matrix;
        let scale = ((m00 + m11 + m22) / direction.norm_squared().max(f64::MIN_POSITIVE)).sqrt();
        self.add(&[direction * scale, Vector3::zeros()], [0.0; 2]);
    }

    /// Factors the block with Marquardt's damping; `None` when it is not positive definite.
    #[inline(always)]
    pub fn factor(&self, damping: f64) -> Option<PointFactor> {
        let [m00, m10, m20, m11, m21, m22] = self.matrix;
        let least = POINT_DAMPING * (m00 + m11 + m22) + f64::MIN_POSITIVE;
        let inverse_root = |value: f64| (value > 0.0 && value.is_finite()).then(|| value.sqrt().recip());
        let l00 = inverse_root(m00 + damping * m00 + least)?;
        let (l10, l20) = (m10 * l00, m20 * l00);
        let l11 = inverse_root(m11 + damping * m11 + least - l10 * l10)?;
        let l21 = (m21 - l20 * l10) * l11;
        let l22 = inverse_root(m22 + damping * m22 + least - l20 * l20 - l21 * l21)?;
        Some(PointFactor([l00, l10, l20, l11, l21, l22]))
    }
}

impl PointFactor {
    /// `L^-1 x`
    #[inline(always)]
    pub fn whiten(&self, x: &Vector3<f64>) -> Vector3<f64> {
        let [l00, l10, l20, l11, l21, l22] = self.0;
        let first = x[0] * l00;
        let second = (x[1] - l10 * first) * l11;
        Vector3::new(first, second, (x[2] - l20 * first - l21 * second) * l22)
    }

    /// `L'^-1 L^-1 x`
    #[inline(always)]
    pub fn solve(&self, x: &Vector3<f64>) -> Vector3<f64> {
        let [l00, l10, l20, l11, l21, l22] = self.0;
        let x = self.whiten(x);
        let third = x[2] * l22;
        let second = (x[1] - l21 * third) * l11;
        Vector3::new((x[0] - l10 * second - l20 * third) * l00, second, third)
    }

    /// `W L'^-1` for a coupling `W`, `rows x 3`, column-major.
    ///
    /// * `stride`: distance between the columns of `whitened`
    #[inline(always)]
    pub fn whiten_coupling(&self, coupling: &[f64], whitened: &mut [f64], stride: usize) {
        let [l00, l10, l20, l11, l21, l22] = self.0;
        let rows = coupling.len() / POINT;
        let coupling = &coupling[..POINT * rows];
        let (a, rest) = whitened.split_at_mut(stride);
        let (b, c) = rest.split_at_mut(stride);
        let (a, b, c) = (&mut a[..rows], &mut b[..rows], &mut c[..rows]);
        let (first, rest) = coupling.split_at(rows);
        let (second, third) = rest.split_at(rows);
        let written = a.iter_mut().zip(b).zip(c);
        for (((a, b), c), ((first, second), third)) in written.zip(first.iter().zip(second).zip(third)) {
            *a = first * l00;
            *b = (second - l10 * *a) * l11;
            *c = (third - l20 * *a - l21 * *b) * l22;
        }
    }
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

/// Moves every point towards its minimum with the cameras as they are (embedded point iterations; Jeong, Nister,
/// Steedly, Szeliski, Kweon 2012, "Pushing the envelope of modern methods for bundle adjustment"); by how much that
/// lowers the cost. `None` when it was stopped.
///
/// Long chains of views bend at next to no cost. Cameras and points that follow a bend along its tangent are stretched
/// across its axis and not along it, which costs by the square of the angle; points that are put where the moved
/// cameras see them leave the third power.
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
        let moved = position - factor.solve(&block.gradient);
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

#[cfg(test)]
mod tests {
    use super::*;

    /// What rounding leaves of the gradient along a direction moves it by its size, and without the hold by any amount.
    #[test]
    fn a_direction_is_not_stepped_along() {
        let direction = Vector3::new(0.3, -0.4, 1.2);
        let across = [Vector3::new(4.0, 3.0, 0.0), Vector3::new(0.0, 3.0, 1.0)];
        let step = |is_held: bool| {
            let mut block = PointBlock::ZERO;
            block.add(&across, [1e-3, -2e-3]);
            block.gradient += direction * 1e-6;
            if is_held {
                block.hold_length(&direction);
            }
            let factor = block.factor(0.0).expect("positive definite");
            factor.solve(&block.gradient)
        };
        assert!(across.iter().all(|row| row.dot(&direction).abs() < 1e-12));
        assert!(step(false).dot(&direction).abs() > 1.0, "{}", step(false));
        assert!(step(true).dot(&direction).abs() < 1e-6, "{}", step(true));
        let shift = step(true) - step(false);
        assert!(shift.cross(&direction).norm() < 1e-3 * shift.norm(), "{shift}");
    }
}
