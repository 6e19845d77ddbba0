//! The normal equations at one state: what views and intrinsics have among themselves, their couplings with the points,
//! and the blocks of the points.

use std::ops::Range;

use nalgebra::Vector3;

use super::super::Loss;
use super::super::metric::{IntrinsicsPrior, POSE, Parameter, Projection, ProjectionGradients, VIEW};
use super::super::problem::usable_squared_norm;
use super::MetricReconstruction;
use super::layout::{Layout, Seen};
use super::pattern::{Pattern, Place};
use super::point::PointBlock;
use super::worker_pool::{WorkerPool, split_off};
use crate::parallel::even_cuts;
use crate::simd::{LANES, vectorised};

/// Where a view's residuals go in the camera part of the normal equations.
#[derive(Debug, Clone, Copy)]
struct ViewPlaces {
    /// First unknown of the view, its unknowns and its diagonal block.
    view: Option<(usize, usize, Place)>,
    /// First unknown of the intrinsics, how many are free, and their diagonal block.
    group: Option<(usize, usize, Place)>,
    /// Block of intrinsics and view.
    cross: Option<Place>,
}

/// One observation's weighted residual and Jacobian, by rows.
#[derive(Debug)]
pub(super) struct Weighted {
    pub residual: [f64; 2],
    /// By pose and own focal length.
    view: [[f64; VIEW]; 2],
    pub point: [Vector3<f64>; 2],
    /// By the free intrinsics, in their order, and zeros behind them.
    free: [[f64; Parameter::COUNT]; 2],
}

impl Weighted {
    /// `None` where the observation is undefined.
    ///
    /// * `parameters`: those of the intrinsics that are free
    #[inline(always)]
    pub fn new(
        sequence: &MetricReconstruction,
        point: &Vector3<f64>,
        seen: &Seen,
        parameters: &[Parameter],
        loss: Loss,
    ) -> Option<Self> {
        let intrinsics = sequence.intrinsics_of(seen.view);
        let projection = Projection::new(&intrinsics, &sequence.poses[seen.view], point);
        let residual = projection.image - seen.xy;
        let squared = usable_squared_norm(&residual)? * seen.weight;
        let root = seen.weight.sqrt() * loss.root_weight(squared);
        let ProjectionGradients { by_parameter, by_pose, by_point } = projection.gradients();
        let of_shift = if sequence.has_common_centre { 0.0 } else { root };
        Some(Self {
            residual: [residual.x * root, residual.y * root],
            view: std::array::from_fn(|component| {
                let [a, b, c, x, y, z] = by_pose[component];
                let focal = by_parameter[component][Parameter::LogFocal as usize] * root;
                [a * root, b * root, c * root, x * of_shift, y * of_shift, z * of_shift, focal]
            }),
            point: by_point.map(|row| row * root),
            free: std::array::from_fn(|component| {
                let mut free = [0.0; Parameter::COUNT];
                let chosen = parameters.iter().map(|parameter| by_parameter[component][*parameter as usize] * root);
                free.iter_mut().zip(chosen).for_each(|(slot, value)| *slot = value);
                free
            }),
        })
    }
}

/// Where the residuals of all views go.
#[derive(Debug)]
struct Places {
    of_view: Vec<ViewPlaces>,
    /// Values and unknowns that belong to the views before each, and to all of them: the groups' come after these.
    before: Vec<(usize, usize)>,
}

/// The normal equations `J' J dx = -J' r`.
#[derive(Debug)]
pub(super) struct Normal {
    places: Places,
    /// Views and intrinsics among themselves, `Jc' Jc`, in the order of the pattern.
    pub values: Vec<f64>,
    /// Where the diagonal is among them.
    pub diagonal: Vec<usize>,
    /// Half the gradient of the cost by views and intrinsics.
    pub gradient: Vec<f64>,
    /// Couplings of views and intrinsics with the points, `Jc' Jp`.
    pub couplings: Vec<f64>,
    pub points: Vec<PointBlock>,
    /// Rows of the Jacobian of a batch of points.
    rows: Vec<Option<Weighted>>,
}

impl Normal {
    pub fn new(layout: &Layout, pattern: &Pattern, sequence: &MetricReconstruction) -> Self {
        let points = layout.point_count();
        Self {
            places: Places::new(pattern, sequence),
            values: vec![0.0; pattern.value_count()],
            diagonal: pattern.diagonal(),
            gradient: vec![0.0; pattern.unknowns.count()],
            couplings: vec![0.0; layout.couplings_of(0..points).len()],
            points: vec![PointBlock::ZERO; points],
            rows: Vec::new(),
        }
    }

    /// Linearises at this state; `false` when it was stopped.
    ///
    /// Batch by batch: first the rows of the Jacobian and what each point has to itself, then the rows are added up by
    /// views and intrinsics, in the order of the observations.
    pub fn fill(
        &mut self,
        sequence: &MetricReconstruction,
        priors: &[IntrinsicsPrior],
        loss: Loss,
        pool: &WorkerPool,
    ) -> bool {
        self.values.fill(0.0);
        self.gradient.fill(0.0);
        let unknowns = &pool.layout.unknowns;
        for (group, prior) in priors.iter().enumerate().take(sequence.intrinsics.len()) {
            let Some(block) = unknowns.group_block[group] else { continue };
            for (index, parameter) in unknowns.range(block).zip(&unknowns.parameters[group]) {
                let information = prior.information[*parameter as usize];
                self.gradient[index] += information * prior.deviation(*parameter, &sequence.intrinsics[group]);
                self.values[self.diagonal[index]] += information;
            }
        }
        for points in pool.batches() {
            if pool.stop.is_stopped() {
                return false;
            }
            self.linearise(sequence, loss, pool, points.clone());
            self.add_batch(pool, points);
        }
        true
    }

    /// Rows of the Jacobian of a batch of points, and the points' own blocks and couplings.
    fn linearise(&mut self, sequence: &MetricReconstruction, loss: Loss, pool: &WorkerPool, points: Range<usize>) {
        let (layout, unknowns) = (pool.layout, &pool.layout.unknowns);
        let seen = layout.seen_range(points.clone()).len();
        // What is left from another batch is written over before it is read.
        self.rows.resize_with(self.rows.len().max(seen), || None);
        let mut rows = self.rows.as_mut_slice();
        let mut couplings = &mut self.couplings[layout.couplings_of(points.clone())];
        let mut blocks = &mut self.points[points.clone()];
        let cut = |ends: &[usize]| {
            let range = ends[0]..ends[1];
            let rows = split_off(&mut rows, layout.seen_range(range.clone()).len());
            let couplings = split_off(&mut couplings, layout.couplings_of(range.clone()).len());
            let blocks = split_off(&mut blocks, range.len());
            (range, rows, couplings, blocks)
        };
        let pieces = pool.cut(points).windows(2).map(cut).collect();
        pool.threads.each(pieces, |(points, mut rows, mut couplings, blocks)| {
            vectorised(
                #[inline(always)]
                || {
                    for (point, slot) in points.zip(blocks) {
                        let seen = layout.seen(point);
                        let mut block = PointBlock::ZERO;
                        let couplings = split_off(&mut couplings, layout.couplings_of(point..point + 1).len());
                        couplings.fill(0.0);
                        for (seen, slot) in seen.iter().zip(split_off(&mut rows, seen.len())) {
                            let parameters = &unknowns.parameters[sequence.group_of[seen.view]];
                            *slot = Weighted::new(sequence, &sequence.points[point], seen, parameters, loss);
                            if let Some(row) = slot {
                                block.add(&row.point, row.residual);
                                let size = unknowns.view_block[seen.view].map_or(0, |block| unknowns.size(block));
                                row.link_blocks(seen, size, parameters.len(), couplings);
                            }
                        }
                        if sequence.has_common_centre {
                            block.hold_length(&sequence.points[point]);
                        }
                        *slot = block;
                    }
                },
            );
            true
        });
    }

    fn add_batch(&mut self, pool: &WorkerPool, points: Range<usize>) {
        let (places, rows) = (&self.places, self.rows.as_slice());
        let seen = &pool.layout.all_seen[pool.layout.seen_range(points)];
        let mut weights = vec![0; places.of_view.len()];
        seen.iter().for_each(|seen| weights[seen.view] += 1);
        let (mut values, mut gradient) = (self.values.as_mut_slice(), self.gradient.as_mut_slice());
        let cut = |ends: &[usize]| {
            let (first, last) = (places.before[ends[0]], places.before[ends[1]]);
            let values = split_off(&mut values, last.0 - first.0);
            (Some(ends[0]..ends[1]), values, split_off(&mut gradient, last.1 - first.1))
        };
        let mut pieces: Vec<_> = even_cuts(pool.threads.pieces(), weights.into_iter()).windows(2).map(cut).collect();
        // What is left is that of the groups: first, for nobody can share it.
        pieces.insert(0, (None, values, gradient));
        pool.threads.each(pieces, |(views, values, gradient)| {
            vectorised(
                #[inline(always)]
                || match views {
                    Some(views) => places.add_to_views(seen, rows, views, values, gradient),
                    None => places.add_to_groups(seen, rows, values, gradient),
                },
            );
            true
        });
    }
}

impl Places {
    fn new(pattern: &Pattern, sequence: &MetricReconstruction) -> Self {
        let unknowns = &pattern.unknowns;
        let of_view = |view: usize| {
            let (own, group) = (unknowns.view_block[view], unknowns.group_block_of_view(sequence, view));
            let diagonal = |block: usize| {
                let range = unknowns.range(block);
                Some((range.start, range.len(), pattern.place(block, block)?))
            };
            ViewPlaces {
                view: own.and_then(diagonal),
                group: group.and_then(diagonal),
                cross: own.zip(group).and_then(|(own, group)| pattern.place(group, own)),
            }
        };
        let mut before = vec![(0, 0)];
        for block in &unknowns.view_block {
            let last = before[before.len() - 1];
            before.push(block.map_or(last, |block| (pattern.panels(0..block + 1).end, unknowns.range(block).end)));
        }
        Self { of_view: (0..sequence.poses.len()).map(of_view).collect(), before }
    }

    /// Adds to the blocks of a run of views.
    ///
    /// * `values`, `gradient`: those of these views
    #[inline(always)]
    fn add_to_views(
        &self,
        seen: &[Seen],
        rows: &[Option<Weighted>],
        views: Range<usize>,
        values: &mut [f64],
        gradient: &mut [f64],
    ) {
        let (first_value, first_unknown) = self.before[views.start];
        let of_views = |place: Place| Place { start: place.start - first_value, ..place };
        for (seen, row) in seen.iter().zip(rows).filter(|(seen, _)| views.contains(&seen.view)) {
            let ViewPlaces { view: Some((first, unknowns, place)), group, cross } = self.of_view[seen.view] else {
                continue;
            };
            let Some(row) = row else { continue };
            let own = [&row.view[0][..unknowns], &row.view[1][..unknowns]];
            add_to_view(values, of_views(place), unknowns, &row.view, own);
            add_gradient(&mut gradient[first - first_unknown..], own, row.residual);
            if let Some(((_, free, _), cross)) = group.zip(cross) {
                add_product(values, of_views(cross), row.by_intrinsics(free), own);
            }
        }
    }

    /// Adds to the blocks of all groups.
    ///
    /// * `values`, `gradient`: those of the groups
    #[inline(always)]
    fn add_to_groups(&self, seen: &[Seen], rows: &[Option<Weighted>], values: &mut [f64], gradient: &mut [f64]) {
        let Some(&(first_value, first_unknown)) = self.before.last() else { return };
        for (seen, row) in seen.iter().zip(rows) {
            let (Some((first, free, place)), Some(row)) = (self.of_view[seen.view].group, row) else { continue };
            let free = row.by_intrinsics(free);
            add_product(values, Place { start: place.start - first_value, ..place }, free, free);
            add_gradient(&mut gradient[first - first_unknown..], free, row.residual);
        }
    }
}

impl Weighted {
    /// Derivatives by the intrinsics, of which so many are free.
    #[inline(always)]
    fn by_intrinsics(&self, free: usize) -> [&[f64]; 2] {
        [&self.free[0][..free], &self.free[1][..free]]
    }

    /// Adds this observation to the couplings of its point.
    ///
    /// * `unknowns`: of the view
    /// * `free`: how many intrinsics are
    #[inline(always)]
    fn link_blocks(&self, seen: &Seen, unknowns: usize, free: usize, couplings: &mut [f64]) {
        let point = [self.point[0].as_slice(), self.point[1].as_slice()];
        if let Some(start) = seen.view_coupling {
            add_to_view(couplings, Place { start: start as usize, stride: unknowns }, unknowns, &self.view, point);
        }
        if let Some(start) = seen.group_coupling {
            let place = Place { start: start as usize, stride: free };
            add_product(couplings, place, self.by_intrinsics(free), point);
        }
    }
}

/// Adds `rows' columns` to a block of as many rows as a view has unknowns.
#[inline(always)]
fn add_to_view(values: &mut [f64], place: Place, unknowns: usize, rows: &[[f64; VIEW]; 2], columns: [&[f64]; 2]) {
    match unknowns {
        POSE => add_rows::<POSE>(values, place, rows, columns),
        _ => add_rows::<VIEW>(values, place, rows, columns),
    }
}

#[inline(always)]
fn add_rows<const R: usize>(values: &mut [f64], place: Place, rows: &[[f64; VIEW]; 2], [a, b]: [&[f64]; 2]) {
    let [first, second] = rows;
    for (k, (a, b)) in a.iter().zip(b).enumerate() {
        if let Some(slots) = values[place.start + k * place.stride..].first_chunk_mut::<R>() {
            // In a local copy, which the compiler knows to be none of the rows.
            let mut sums = *slots;
            for ((sum, first), second) in sums.iter_mut().zip(first).zip(second) {
                *sum += first * a + second * b;
            }
            *slots = sums;
        }
    }
}

/// Adds `rows' columns` to a block.
#[inline(always)]
fn add_product(values: &mut [f64], place: Place, rows: [&[f64]; 2], columns: [&[f64]; 2]) {
    let (first, firsts) = rows[0].as_chunks::<LANES>();
    let (second, seconds) = rows[1].as_chunks::<LANES>();
    for (k, (a, b)) in columns[0].iter().zip(columns[1]).enumerate() {
        let slots = &mut values[place.start + k * place.stride..][..rows[0].len()];
        let (slots, others) = slots.as_chunks_mut::<LANES>();
        for ((slots, first), second) in slots.iter_mut().zip(first).zip(second) {
            let mut sums = *slots;
            for (r, sum) in sums.iter_mut().enumerate() {
                *sum += first[r] * a + second[r] * b;
            }
            *slots = sums;
        }
        for ((slot, first), second) in others.iter_mut().zip(firsts).zip(seconds) {
            *slot += first * a + second * b;
        }
    }
}

/// Adds `rows' residual`.
#[inline(always)]
fn add_gradient(gradient: &mut [f64], rows: [&[f64]; 2], residual: [f64; 2]) {
    for ((slot, a), b) in gradient.iter_mut().zip(rows[0]).zip(rows[1]) {
        *slot += a * residual[0] + b * residual[1];
    }
}
