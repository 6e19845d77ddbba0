//! The system of poses and intrinsics that is left when the points are eliminated: built point by point, damped, and
//! solved.

use nalgebra::Vector3;

use super::super::metric::{POINT, POSE};
use super::layout::{Layout, Touch};
use super::normal::Normal;
use super::pattern::{Column, Pattern};
use super::solver::Solver;
use super::{Pace, Sequence};

/// Damping beside Marquardt's, as a share of the diagonal: holds the gauge (seven directions for every set of views
/// that no point connects with another). Rounding leaves some 1e-15 of the diagonal in these directions; the weakest
/// real ones, the bending of long chains of views, have about the inverse fourth power of their number.
const GAUGE_DAMPING: f64 = 1e-13;

/// The reduced system and the scratch to build and solve it, reused from step to step.
pub(super) struct Reduced {
    pub pattern: Pattern,
    /// In the order of the pattern.
    pub values: Vec<f64>,
    /// Right-hand side, then solution.
    pub vector: Vec<f64>,
    /// Couplings of one point times the inverse root of its block.
    whitened: Vec<f64>,
}

impl Reduced {
    pub fn new(layout: &Layout, pattern: Pattern) -> Self {
        let most = (0..layout.point_count()).map(|point| layout.couplings(point).len()).max().unwrap_or(0);
        Self {
            values: vec![0.0; pattern.value_count()],
            vector: vec![0.0; pattern.dimension()],
            whitened: vec![0.0; most],
            pattern,
        }
    }

    /// Eliminates the points; `false` when a point's block cannot be factored, or it was stopped.
    pub fn build(&mut self, layout: &Layout, normal: &Normal, damping: f64, pace: &mut Pace) -> bool {
        self.values.copy_from_slice(&normal.cameras.values);
        for (slot, gradient) in self.vector.iter_mut().zip(&normal.cameras.gradient) {
            *slot = -gradient;
        }
        for (point, block) in normal.points.iter().enumerate() {
            let touches = layout.touches(point);
            if touches.is_empty() {
                continue;
            }
            // Pairs cost what a sixth of an observation's linearisation does.
            if !pace.go_on(touches.len() * (6 + touches.len()) / 6) {
                return false;
            }
            let Some(factor) = block.factor(damping) else { return false };
            let pull = factor.whiten(&block.gradient);
            let couplings = &normal.couplings[layout.couplings(point)];
            for touch in touches {
                let size = self.pattern.size(touch.block as usize);
                let range = touch.coupling as usize..touch.coupling as usize + POINT * size;
                let whitened = &mut self.whitened[range.clone()];
                factor.whiten_coupling(&couplings[range], whitened);
                let first = self.pattern.offsets[touch.block as usize];
                for (k, slot) in self.vector[first..first + size].iter_mut().enumerate() {
                    *slot += whitened[k] * pull[0] + whitened[size + k] * pull[1] + whitened[2 * size + k] * pull[2];
                }
            }
            self.subtract_pairs(touches);
        }
        true
    }

    /// The blocks between all that touches one point, lower triangle.
    fn subtract_pairs(&mut self, touches: &[Touch]) {
        for (first, column) in touches.iter().enumerate() {
            let size = self.pattern.size(column.block as usize);
            let stride = self.pattern.stride(column.block as usize);
            let mut places: Column = self.pattern.column(column.block as usize);
            let right = &self.whitened[column.coupling as usize..][..POINT * size];
            for row in &touches[first..] {
                // Pattern and touches come from the same layout, so that there is a place.
                let Some(start) = places.start_of(row.block) else { continue };
                let height = self.pattern.size(row.block as usize);
                let left = &self.whitened[row.coupling as usize..][..POINT * height];
                let values = &mut self.values[start..];
                match left.first_chunk::<{ POINT * POSE }>() {
                    Some(left) if height == POSE => subtract_from_pose(values, stride, left, right),
                    _ => subtract_product(values, stride, left, right),
                }
            }
        }
    }

    /// Marquardt's damping, and what holds the gauge.
    pub fn damp(&mut self, normal: &Normal, damping: f64) {
        for &index in &normal.cameras.diagonal {
            let diagonal = normal.cameras.values[index];
            // Nothing is known of this unknown: it stays where it is.
            let undetermined = if diagonal > 0.0 { 0.0 } else { 1.0 };
            self.values[index] += (damping + GAUGE_DAMPING) * diagonal + undetermined;
        }
    }

    /// Solves for the step in place of the right-hand side; `false` when the system is not positive definite.
    pub fn solve(&mut self, solver: &mut Solver) -> bool {
        solver.solve(&self.pattern, &self.values, &mut self.vector) && self.vector.iter().all(|value| value.is_finite())
    }
}

/// Moves the points of `moved` to where they belong after the step of poses and intrinsics: from where they are in
/// `from` by `-V^-1 (Jp' r + Jp' Jc dc)`. `false` when that is no number, or it was stopped.
pub(super) fn substitute(
    moved: &mut Sequence,
    from: &Sequence,
    layout: &Layout,
    normal: &Normal,
    damping: f64,
    step: &[f64],
    pace: &mut Pace,
) -> bool {
    for (point, block) in normal.points.iter().enumerate() {
        let seen = layout.seen(point).len();
        if seen == 0 || !layout.free_points[point] {
            continue;
        }
        if !pace.go_on(seen) {
            return false;
        }
        let Some(factor) = block.factor(damping) else { return false };
        let mut gradient = block.gradient;
        let couplings = &normal.couplings[layout.couplings(point)];
        for touch in layout.touches(point) {
            let step = &step[layout.unknowns.range(touch.block as usize)];
            let coupling = &couplings[touch.coupling as usize..][..POINT * step.len()];
            for (k, column) in coupling.chunks_exact(step.len()).enumerate() {
                gradient[k] += dot(column, step);
            }
        }
        let shift: Vector3<f64> = factor.unwhiten(&factor.whiten(&gradient));
        if !shift.iter().all(|value| value.is_finite()) {
            return false;
        }
        moved.points[point] = from.points[point] - shift;
    }
    true
}

#[inline]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let b = &b[..a.len()];
    let (mut sum, mut k) = (0.0, 0);
    while k < a.len() {
        sum += a[k] * b[k];
        k += 1;
    }
    sum
}

/// Subtracts `left right'` from a block of six rows; both factors have three columns.
///
/// Loops by hand over arrays, here and below: this is the innermost loop, and iterators cost several times as much in
/// builds for tests, which barely optimise.
#[inline]
fn subtract_from_pose(values: &mut [f64], stride: usize, left: &[f64; POINT * POSE], right: &[f64]) {
    let columns = right.len() / POINT;
    let mut k = 0;
    while k < columns {
        let (a, b, c) = (right[k], right[columns + k], right[2 * columns + k]);
        if let Some(slots) = values[k * stride..].first_chunk_mut::<POSE>() {
            let mut r = 0;
            while r < POSE {
                slots[r] -= left[r] * a + left[POSE + r] * b + left[2 * POSE + r] * c;
                r += 1;
            }
        }
        k += 1;
    }
}

/// Subtracts `left right'` from a block.
#[inline]
fn subtract_product(values: &mut [f64], stride: usize, left: &[f64], right: &[f64]) {
    let (rows, columns) = (left.len() / POINT, right.len() / POINT);
    let mut k = 0;
    while k < columns {
        let (a, b, c) = (right[k], right[columns + k], right[2 * columns + k]);
        let slots = &mut values[k * stride..][..rows];
        let mut r = 0;
        while r < rows {
            slots[r] -= left[r] * a + left[rows + r] * b + left[2 * rows + r] * c;
            r += 1;
        }
        k += 1;
    }
}
