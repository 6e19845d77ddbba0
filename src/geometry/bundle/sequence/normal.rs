//! The normal equations at one state: what poses and intrinsics have among themselves, their couplings with the
//! points, and the blocks of the points.

use nalgebra::Vector3;

use super::super::Loss;
use super::super::engine::usable_squared_norm;
use super::super::metric::{IntrinsicsPrior, POSE, Parameter};
use super::layout::{Layout, Seen};
use super::pattern::{Pattern, Place};
use super::point::PointBlock;
use super::{Pace, Sequence};

/// Where a view's residuals go in the camera part of the normal equations.
#[derive(Debug, Clone, Copy)]
struct ViewPlaces {
    /// First unknown of the pose and its diagonal block.
    pose: Option<(usize, Place)>,
    /// The same of the intrinsics.
    group: Option<(usize, Place)>,
    /// Block of intrinsics and pose.
    cross: Option<Place>,
}

/// One observation's weighted residual and Jacobian, by rows.
pub(super) struct Weighted {
    pub residual: [f64; 2],
    pose: [[f64; POSE]; 2],
    pub point: [Vector3<f64>; 2],
    by_parameter: [[f64; Parameter::COUNT]; 2],
}

impl Weighted {
    /// `None` where the observation is undefined.
    #[inline]
    pub fn new(sequence: &Sequence, point: &Vector3<f64>, seen: &Seen, loss: Loss) -> Option<Self> {
        let pose = &sequence.poses[seen.view];
        let intrinsics = &sequence.intrinsics[sequence.group_of[seen.view]];
        let at = pose.apply(point);
        let residual = intrinsics.project(&at) - seen.xy;
        let squared = usable_squared_norm(&residual)? * seen.weight;
        let root = seen.weight.sqrt() * loss.root_weight(squared);
        let gradients = intrinsics.gradients(&at);
        let by_seen = gradients.by_seen.map(|gradient| gradient * root);
        let pose_row = |by_seen: &Vector3<f64>| {
            let turn = at.cross(by_seen);
            [turn.x, turn.y, turn.z, by_seen.x, by_seen.y, by_seen.z]
        };
        Some(Self {
            residual: [residual.x * root, residual.y * root],
            pose: [pose_row(&by_seen[0]), pose_row(&by_seen[1])],
            point: [pose.rotation.tr_mul(&by_seen[0]), pose.rotation.tr_mul(&by_seen[1])],
            by_parameter: gradients.by_parameter.map(|row| row.map(|value| value * root)),
        })
    }
}

/// Poses and intrinsics among themselves.
#[derive(Debug)]
pub(super) struct Cameras {
    /// One a view.
    places: Vec<ViewPlaces>,
    /// Where the diagonal is among the values.
    pub diagonal: Vec<usize>,
    /// `Jc' Jc`, in the order of the pattern.
    pub values: Vec<f64>,
    /// Half the gradient of the cost.
    pub gradient: Vec<f64>,
}

/// The normal equations `J' J dx = -J' r`.
#[derive(Debug)]
pub(super) struct Normal {
    pub cameras: Cameras,
    /// Couplings of poses and intrinsics with the points, `Jc' Jp`.
    pub couplings: Vec<f64>,
    pub points: Vec<PointBlock>,
}

impl Normal {
    pub fn new(layout: &Layout, pattern: &Pattern, sequence: &Sequence) -> Self {
        Self {
            cameras: Cameras::new(layout, pattern, sequence),
            couplings: vec![0.0; layout.coupling_count()],
            points: vec![PointBlock::ZERO; layout.point_count()],
        }
    }

    /// Linearises at this state; `false` when it was stopped.
    pub fn fill(
        &mut self,
        sequence: &Sequence,
        layout: &Layout,
        priors: &[IntrinsicsPrior],
        loss: Loss,
        pace: &mut Pace,
    ) -> bool {
        self.cameras.values.fill(0.0);
        self.cameras.gradient.fill(0.0);
        self.cameras.believe(sequence, layout, priors);
        for (point, position) in sequence.points.iter().enumerate() {
            let seen = layout.seen(point);
            if !pace.go_on(seen.len()) {
                return false;
            }
            let mut block = PointBlock::ZERO;
            let couplings = &mut self.couplings[layout.couplings(point)];
            couplings.fill(0.0);
            for seen in seen {
                if let Some(row) = Weighted::new(sequence, position, seen, loss) {
                    block.add(&row.point, row.residual);
                    let parameters = &layout.unknowns.parameters[sequence.group_of[seen.view]];
                    self.cameras.add(seen, &row, parameters, couplings);
                }
            }
            self.points[point] = block;
        }
        true
    }
}

impl Cameras {
    fn new(layout: &Layout, pattern: &Pattern, sequence: &Sequence) -> Self {
        let unknowns = &layout.unknowns;
        let diagonal = |block: usize| Some((unknowns.range(block).start, pattern.place(block, block)?));
        let places = |view: usize| {
            let (pose, group) = (unknowns.pose_block[view], unknowns.group_block_of_view(sequence, view));
            ViewPlaces {
                pose: pose.and_then(diagonal),
                group: group.and_then(diagonal),
                cross: pose.zip(group).and_then(|(pose, group)| pattern.place(group, pose)),
            }
        };
        Self {
            places: (0..sequence.poses.len()).map(places).collect(),
            diagonal: pattern.diagonal(),
            values: vec![0.0; pattern.value_count()],
            gradient: vec![0.0; pattern.dimension()],
        }
    }

    /// What is known of the intrinsics beforehand.
    fn believe(&mut self, sequence: &Sequence, layout: &Layout, priors: &[IntrinsicsPrior]) {
        for (group, prior) in priors.iter().enumerate().take(sequence.intrinsics.len()) {
            let Some(block) = layout.unknowns.group_block[group] else { continue };
            for (index, parameter) in layout.unknowns.range(block).zip(&layout.unknowns.parameters[group]) {
                let information = prior.information[*parameter as usize];
                self.gradient[index] += information * prior.deviation(*parameter, &sequence.intrinsics[group]);
                self.values[self.diagonal[index]] += information;
            }
        }
    }

    /// Adds one observation, also to the couplings of its point.
    #[inline]
    fn add(&mut self, seen: &Seen, row: &Weighted, parameters: &[Parameter], couplings: &mut [f64]) {
        let places = self.places[seen.view];
        let point = [row.point[0].as_slice(), row.point[1].as_slice()];
        let pose = [row.pose[0].as_slice(), row.pose[1].as_slice()];
        if let Some((first, place)) = places.pose {
            add_to_pose(&mut self.values, place, &row.pose, &row.pose);
            add_gradient(&mut self.gradient[first..], pose, row.residual);
            if let Some(start) = seen.pose_coupling {
                add_to_pose(couplings, Place { start: start as usize, stride: POSE }, &row.pose, &point);
            }
        }
        if let Some((first, place)) = places.group {
            let free = row.by_parameter.map(|by_parameter| {
                let mut free = [0.0; Parameter::COUNT];
                free.iter_mut()
                    .zip(parameters)
                    .for_each(|(value, parameter)| *value = by_parameter[*parameter as usize]);
                free
            });
            let free = [&free[0][..parameters.len()], &free[1][..parameters.len()]];
            add_product(&mut self.values, place, free, free);
            add_gradient(&mut self.gradient[first..], free, row.residual);
            if let Some(cross) = places.cross {
                add_product(&mut self.values, cross, free, pose);
            }
            if let Some(start) = seen.group_coupling {
                add_product(couplings, Place { start: start as usize, stride: parameters.len() }, free, point);
            }
        }
    }
}

/// Adds `rows' columns` to a block of six rows.
///
/// Loops by hand over arrays, here and below: iterators cost several times as much in builds for tests, which barely
/// optimise.
#[inline]
fn add_to_pose(values: &mut [f64], place: Place, rows: &[[f64; POSE]; 2], columns: &[impl AsRef<[f64]>; 2]) {
    let [first, second] = rows;
    let [a, b] = [columns[0].as_ref(), columns[1].as_ref()];
    let b = &b[..a.len()];
    let mut k = 0;
    while k < a.len() {
        if let Some(slots) = values[place.start + k * place.stride..].first_chunk_mut::<POSE>() {
            let mut r = 0;
            while r < POSE {
                slots[r] += first[r] * a[k] + second[r] * b[k];
                r += 1;
            }
        }
        k += 1;
    }
}

/// Adds `rows' columns` to a block.
#[inline]
fn add_product(values: &mut [f64], place: Place, rows: [&[f64]; 2], columns: [&[f64]; 2]) {
    let [first, second] = rows;
    for (k, (a, b)) in columns[0].iter().zip(columns[1]).enumerate() {
        let start = place.start + k * place.stride;
        for (r, slot) in values[start..start + first.len()].iter_mut().enumerate() {
            *slot += first[r] * a + second[r] * b;
        }
    }
}

/// Adds `rows' residual`.
#[inline]
fn add_gradient(gradient: &mut [f64], rows: [&[f64]; 2], residual: [f64; 2]) {
    for ((slot, a), b) in gradient.iter_mut().zip(rows[0]).zip(rows[1]) {
        *slot += a * residual[0] + b * residual[1];
    }
}
