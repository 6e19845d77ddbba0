//! The system of poses and intrinsics that is left when the points are eliminated: built point by point, or of many
//! points at a time where most views see most of them, damped, and solved.

use std::ops::Range;

use nalgebra::Vector3;

use super::super::dense::{self, PANEL_SHARE};
use super::super::metric::{POINT, POSE};
use super::MetricReconstruction;
use super::layout::Layout;
use super::normal::Normal;
use super::pattern::Pattern;
use super::solver::SparseCholesky;
use super::worker_pool::{POINTS_BETWEEN_QUESTIONS, WorkerPool, split_off};
use crate::parallel::even_cuts;
use crate::simd::{LANES, vectorised};

/// Damping beside Marquardt's, as a share of the diagonal: holds the gauge (seven directions for every set of views
/// that no point connects with another). Rounding leaves some 1e-15 of the diagonal in these directions; the weakest
/// real ones, the bending of long chains of views, have about the inverse fourth power of their number.
pub(in super::super) const GAUGE_DAMPING: f64 = 1e-13;

/// The reduced system and the scratch to build and solve it, reused from step to step.
pub(super) struct Reduced {
    pub pattern: Pattern,
    /// In the order of the pattern.
    pub values: Vec<f64>,
    /// Right-hand side, then solution.
    pub vector: Vec<f64>,
    /// Couplings of a batch of points, each times the inverse root of its point's block: one point's after the other,
    /// or the columns of a panel.
    whitened: Vec<f64>,
    /// Gradients of these points, whitened the same way.
    whitened_gradients: Vec<Vector3<f64>>,
    /// Whether points are eliminated by panels, as columns over all unknowns.
    pub by_panels: bool,
}

impl Reduced {
    pub fn new(layout: &Layout, pattern: Pattern) -> Self {
        Self {
            by_panels: pattern.is_square && layout.coupled_share() >= PANEL_SHARE,
            values: vec![0.0; pattern.value_count()],
            vector: vec![0.0; pattern.unknowns.count()],
            whitened: Vec::new(),
            whitened_gradients: Vec::new(),
            pattern,
        }
    }

    /// Eliminates the points; `false` when a point's block cannot be factored, or it was stopped.
    ///
    /// Batch by batch: first the points are whitened, each by itself, then taken from the block columns that they are
    /// coupled with, in their order; by panels, one product does.
    pub fn build(&mut self, normal: &Normal, damping: f64, pool: &WorkerPool) -> bool {
        self.values.copy_from_slice(&normal.values);
        for (slot, gradient) in self.vector.iter_mut().zip(&normal.gradient) {
            *slot = -gradient;
        }
        for points in pool.batches() {
            if pool.stop.is_stopped() || !self.whiten(normal, damping, pool, points.clone()) {
                return false;
            }
            if self.by_panels {
                self.subtract_panel(pool, points);
            } else if !self.subtract(pool, points) {
                return false;
            }
        }
        true
    }

    /// Whitens the couplings and gradients of a batch of points; `false` when a block cannot be factored.
    fn whiten(&mut self, normal: &Normal, damping: f64, pool: &WorkerPool, points: Range<usize>) -> bool {
        let (layout, by_panels, rows) = (pool.layout, self.by_panels, self.vector.len());
        let length = |points: Range<usize>| match by_panels {
            true => POINT * rows * points.filter(|point| layout.is_coupled(*point)).count(),
            false => layout.couplings_of(points).len(),
        };
        // What is left from another batch is written over before it is read.
        self.whitened.resize(self.whitened.len().max(length(points.clone())), 0.0);
        self.whitened_gradients.resize(self.whitened_gradients.len().max(points.len()), Vector3::zeros());
        let (mut whitened, mut whitened_gradients) =
            (self.whitened.as_mut_slice(), self.whitened_gradients.as_mut_slice());
        let cut = |ends: &[usize]| {
            let range = ends[0]..ends[1];
            let whitened = split_off(&mut whitened, length(range.clone()));
            let whitened_gradients = split_off(&mut whitened_gradients, range.len());
            (range, whitened, whitened_gradients)
        };
        let pieces = pool.cut(points).windows(2).map(cut).collect();
        pool.threads.each(pieces, |(points, mut whitened, whitened_gradients)| {
            vectorised(
                #[inline(always)]
                || {
                    for (point, whitened_gradient) in points.zip(whitened_gradients) {
                        let incident_blocks = layout.incident_blocks(point);
                        if incident_blocks.is_empty() {
                            continue;
                        }
                        let couplings = &normal.couplings[layout.couplings_of(point..point + 1)];
                        let whitened = split_off(&mut whitened, length(point..point + 1));
                        if by_panels {
                            whitened.fill(0.0);
                        }
                        let block = &normal.points[point];
                        let Some(factor) = block.factor(damping) else { return false };
                        *whitened_gradient = factor.whiten(&block.gradient);
                        for incident in incident_blocks {
                            let (block, start) = (incident.block as usize, incident.coupling as usize);
                            let unknowns = layout.unknowns.range(block);
                            let size = unknowns.len();
                            let coupling = &couplings[start..start + POINT * size];
                            let (place, stride) = if by_panels { (unknowns.start, rows) } else { (start, size) };
                            factor.whiten_coupling(coupling, &mut whitened[place..], stride);
                        }
                    }
                    true
                },
            )
        })
    }

    /// Takes from the system what the points of a batch subtract, as columns of a panel.
    fn subtract_panel(&mut self, pool: &WorkerPool, points: Range<usize>) {
        let rows = self.vector.len();
        let first = points.start;
        let coupled = points.filter(|point| pool.layout.is_coupled(*point)).map(|point| point - first);
        let whitened = &self.whitened[..POINT * rows * coupled.clone().count()];
        dense::subtract_panel(whitened, rows, &mut self.values);
        let gradients = coupled.flat_map(|point| self.whitened_gradients[point].iter());
        for (column, gradient) in whitened.chunks_exact(rows.max(1)).zip(gradients) {
            self.vector.iter_mut().zip(column).for_each(|(slot, value)| *slot += value * gradient);
        }
    }

    /// The same point by point, from the block columns that they are coupled with; `false` when it was stopped.
    fn subtract(&mut self, pool: &WorkerPool, points: Range<usize>) -> bool {
        let Self { pattern, values, vector, whitened, whitened_gradients, .. } = self;
        let unknowns = &pattern.unknowns;
        let mut weights = vec![0; unknowns.block_count()];
        for incident in points.clone().flat_map(|point| pool.layout.incident_blocks(point)) {
            weights[incident.block as usize] += 1;
        }
        let (mut values, mut vector) = (values.as_mut_slice(), vector.as_mut_slice());
        let cut = |ends: &[usize]| {
            let range = ends[0]..ends[1];
            let values = split_off(&mut values, pattern.panels(range.clone()).len());
            let vector = split_off(&mut vector, unknowns.offsets[range.end] - unknowns.offsets[range.start]);
            (range, values, vector)
        };
        let pieces = even_cuts(pool.threads.pieces(), weights.into_iter()).windows(2).map(cut).collect();
        let batch = Batch { pattern, pool, points, whitened, whitened_gradients };
        pool.threads.each(pieces, |(columns, values, vector)| {
            vectorised(
                #[inline(always)]
                || batch.subtract_from(columns, values, vector),
            )
        })
    }

    /// Marquardt's damping, and what holds the gauge.
    pub fn damp(&mut self, normal: &Normal, damping: f64) {
        for &index in &normal.diagonal {
            let diagonal = normal.values[index];
            // Nothing is known of this unknown: it stays where it is.
            let undetermined = if diagonal > 0.0 { 0.0 } else { 1.0 };
            self.values[index] += (damping + GAUGE_DAMPING) * diagonal + undetermined;
        }
    }

    /// Solves for the step in place of the right-hand side; `false` when the system is not positive definite.
    ///
    /// * `sparse`: the factorisation of this pattern; `None` where that is a square matrix, which the factor overwrites
    pub fn solve(&mut self, sparse: Option<&mut SparseCholesky>) -> bool {
        let is_solved = match sparse {
            Some(sparse) => sparse.solve(&self.values, &mut self.vector),
            None => dense::solve(&mut self.values, &mut self.vector),
        };
        is_solved && self.vector.iter().all(|value| value.is_finite())
    }
}

/// What the points of a batch subtract is made of.
struct Batch<'a> {
    pattern: &'a Pattern,
    pool: &'a WorkerPool<'a>,
    points: Range<usize>,
    whitened: &'a [f64],
    whitened_gradients: &'a [Vector3<f64>],
}

impl Batch<'_> {
    /// Takes from these block columns what the points that are coupled with them subtract; `false` when it was stopped.
    #[inline(always)]
    fn subtract_from(&self, columns: Range<usize>, values: &mut [f64], vector: &mut [f64]) -> bool {
        let (layout, pattern, unknowns) = (self.pool.layout, self.pattern, &self.pattern.unknowns);
        let first_coupling = layout.couplings_of(self.points.clone()).start;
        let (first_value, first_unknown) = (pattern.panels(columns.clone()).start, unknowns.offsets[columns.start]);
        for (point, whitened_gradient) in self.points.clone().zip(self.whitened_gradients) {
            if point.is_multiple_of(POINTS_BETWEEN_QUESTIONS) && self.pool.stop.is_stopped() {
                return false;
            }
            let incident_blocks = layout.incident_blocks(point);
            let whitened = &self.whitened[layout.couplings_of(point..point + 1).start - first_coupling..];
            let first = incident_blocks.partition_point(|incident| (incident.block as usize) < columns.start);
            for (k, column) in incident_blocks.iter().enumerate().skip(first) {
                let block = column.block as usize;
                if block >= columns.end {
                    break;
                }
                let (size, stride) = (unknowns.size(block), pattern.strides[block]);
                let right = factor_columns(&whitened[column.coupling as usize..][..POINT * size]);
                let [x, y, z]: &[f64; POINT] = whitened_gradient.as_ref();
                let vector = &mut vector[unknowns.offsets[block] - first_unknown..][..size];
                for (((slot, a), b), c) in vector.iter_mut().zip(right[0]).zip(right[1]).zip(right[2]) {
                    *slot += a * x + b * y + c * z;
                }
                let places = pattern.column(block);
                for row in &incident_blocks[k..] {
                    // Pattern and incident blocks come from the same layout, so that there is a place.
                    let Some(start) = places.start_of(row.block) else { continue };
                    let height = unknowns.size(row.block as usize);
                    let left = &whitened[row.coupling as usize..][..POINT * height];
                    let values = &mut values[start - first_value..];
                    match left.first_chunk::<{ POINT * POSE }>() {
                        Some(left) if height == POSE => subtract_from_pose(values, stride, left, right),
                        _ => subtract_product(values, stride, factor_columns(left), right),
                    }
                }
            }
        }
        true
    }
}

/// The three columns of a factor.
#[inline(always)]
fn factor_columns(factor: &[f64]) -> [&[f64]; POINT] {
    let (first, rest) = factor.split_at(factor.len() / POINT);
    let (second, third) = rest.split_at(first.len());
    [first, second, third]
}

/// Moves the points of `moved` to where they belong after the step of poses and intrinsics: from where they are in
/// `from` by `-V^-1 (Jp' r + Jp' Jc dc)`. `false` when that is no number, or it was stopped.
pub(super) fn substitute(
    moved: &mut MetricReconstruction,
    from: &MetricReconstruction,
    normal: &Normal,
    damping: f64,
    step: &[f64],
    pool: &WorkerPool,
) -> bool {
    let layout = pool.layout;
    let place = |point: usize| {
        if layout.seen(point).is_empty() {
            return Some(from.points[point]);
        }
        let block = &normal.points[point];
        let factor = block.factor(damping)?;
        let mut gradient = block.gradient;
        let couplings = &normal.couplings[layout.couplings_of(point..point + 1)];
        for incident in layout.incident_blocks(point) {
            let step = &step[layout.unknowns.range(incident.block as usize)];
            let coupling = &couplings[incident.coupling as usize..][..POINT * step.len()];
            for (k, column) in coupling.chunks_exact(step.len()).enumerate() {
                gradient[k] += column.iter().zip(step).map(|(a, b)| a * b).sum::<f64>();
            }
        }
        let shift = factor.solve(&gradient);
        shift.iter().all(|value| value.is_finite()).then(|| from.points[point] - shift)
    };
    pool.of_points(place).map(|points| moved.points = points).is_some()
}

/// Subtracts `left right'` from a block of six rows; both factors have three columns.
#[inline(always)]
fn subtract_from_pose(values: &mut [f64], stride: usize, left: &[f64; POINT * POSE], right: [&[f64]; POINT]) {
    for (k, ((a, b), c)) in right[0].iter().zip(right[1]).zip(right[2]).enumerate() {
        if let Some(slots) = values[k * stride..].first_chunk_mut::<POSE>() {
            for (r, slot) in slots.iter_mut().enumerate() {
                *slot -= left[r] * a + left[POSE + r] * b + left[2 * POSE + r] * c;
            }
        }
    }
}

/// Subtracts `left right'` from a block.
#[inline(always)]
fn subtract_product(values: &mut [f64], stride: usize, left: [&[f64]; POINT], right: [&[f64]; POINT]) {
    let (first, firsts) = left[0].as_chunks::<LANES>();
    let (second, seconds) = left[1].as_chunks::<LANES>();
    let (third, thirds) = left[2].as_chunks::<LANES>();
    for (k, ((a, b), c)) in right[0].iter().zip(right[1]).zip(right[2]).enumerate() {
        let (slots, others) = values[k * stride..][..left[0].len()].as_chunks_mut::<LANES>();
        for (((slots, first), second), third) in slots.iter_mut().zip(first).zip(second).zip(third) {
            // In a local copy, which the compiler knows to be none of the factors.
            let mut sums = *slots;
            for (r, sum) in sums.iter_mut().enumerate() {
                *sum -= first[r] * a + second[r] * b + third[r] * c;
            }
            *slots = sums;
        }
        for (((slot, first), second), third) in others.iter_mut().zip(firsts).zip(seconds).zip(thirds) {
            *slot -= first * a + second * b + third * c;
        }
    }
}
