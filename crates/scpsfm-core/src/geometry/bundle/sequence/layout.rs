//! Which unknowns there are, and the observations point by point.

use std::ops::Range;

use nalgebra::Vector2;

use super::super::intrinsics::Parameter;
use super::super::metric::{POINT, POSE, VIEW};
use super::super::problem;
use super::{Free, MetricReconstruction, Observation};

/// The unknowns of views and groups, in blocks: the free views that see something, then the groups with free
/// intrinsics.
#[derive(Debug, Clone)]
pub(super) struct Unknowns {
    /// Block of a view: its pose, and its own focal length where that is free; `None` where it is held or sees nothing.
    pub view_block: Vec<Option<usize>>,
    /// Block of a group's intrinsics; `None` where all are held.
    pub group_block: Vec<Option<usize>>,
    /// Free intrinsics of a group, in the order of its block.
    pub parameters: Vec<Vec<Parameter>>,
    /// First unknown of a block, and at the end the number of unknowns.
    pub offsets: Vec<usize>,
}

impl Unknowns {
    fn new(sequence: &MetricReconstruction, free: &Free, sees: &[bool]) -> Self {
        let mut offsets = vec![0];
        let mut append = |size: usize| {
            let block = offsets.len() - 1;
            offsets.push(offsets[block] + size);
            block
        };
        let own_focal = |view: usize| {
            let model = sequence.group_of.get(view).and_then(|group| free.models.get(*group));
            view < sequence.focals.len() && model.is_some_and(|model| model.is_per_view())
        };
        let view_block = (0..sequence.poses.len())
            .map(|view| {
                let unknowns = if own_focal(view) { VIEW } else { POSE };
                let is_free = free.views.is_none_or(|views| views.get(view) == Some(&true));
                (sees[view] && is_free).then(|| append(unknowns))
            })
            .collect();
        let groups = sequence.intrinsics.len();
        let parameters: Vec<Vec<Parameter>> = (0..groups)
            .map(|group| free.models.get(group).map(|model| model.parameters()).unwrap_or_default())
            .collect();
        let group_block = parameters.iter().map(|free| (!free.is_empty()).then(|| append(free.len()))).collect();
        Self { view_block, group_block, parameters, offsets }
    }

    pub fn group_block_of_view(&self, sequence: &MetricReconstruction, view: usize) -> Option<usize> {
        *self.group_block.get(*sequence.group_of.get(view)?)?
    }

    pub fn block_count(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Unknowns of all blocks.
    pub fn count(&self) -> usize {
        self.offsets[self.block_count()]
    }

    /// Unknowns of a block.
    #[inline]
    pub fn size(&self, block: usize) -> usize {
        self.offsets[block + 1] - self.offsets[block]
    }

    pub fn range(&self, block: usize) -> Range<usize> {
        self.offsets[block]..self.offsets[block + 1]
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Seen {
    pub view: usize,
    pub xy: Vector2<f64>,
    pub weight: f64,
    /// Where the couplings of the view and of its group's intrinsics with the point start; `None` where either is held.
    pub view_coupling: Option<u32>,
    pub group_coupling: Option<u32>,
}

/// A block of unknowns that a point is coupled with.
#[derive(Debug, Clone, Copy)]
pub(super) struct IncidentBlock {
    pub block: u32,
    /// Start of its rows x 3 matrix among the point's couplings, column after column.
    pub coupling: u32,
}

/// The observations sorted by point, then view, and the blocks that each point is linked with.
#[derive(Debug)]
pub(super) struct Layout {
    pub unknowns: Unknowns,
    pub all_seen: Vec<Seen>,
    seen_starts: Vec<usize>,
    incident_blocks: Vec<IncidentBlock>,
    incident_block_starts: Vec<usize>,
    coupling_starts: Vec<usize>,
}

impl Layout {
    /// Observations with an index out of range, a coordinate that is not finite or a weight that is not positive are
    /// left out.
    pub fn new(sequence: &MetricReconstruction, observations: &[Observation], free: &Free) -> Self {
        let points = sequence.points.len();
        let is_usable = |seen: &&Observation| {
            let group = sequence.group_of.get(seen.view);
            seen.is_usable(sequence.poses.len(), points)
                && group.is_some_and(|group| *group < sequence.intrinsics.len())
        };
        let sorted = problem::Layout::sorted(observations.iter().filter(is_usable).copied().collect(), points);
        let mut sees = vec![false; sequence.poses.len()];
        sorted.observations.iter().for_each(|seen| sees[seen.view] = true);
        let unlinked =
            |Observation { view, xy, weight, .. }| Seen { view, xy, weight, view_coupling: None, group_coupling: None };
        let mut layout = Self {
            unknowns: Unknowns::new(sequence, free, &sees),
            all_seen: sorted.observations.into_iter().map(unlinked).collect(),
            seen_starts: sorted.starts,
            incident_blocks: Vec::new(),
            incident_block_starts: vec![0],
            coupling_starts: vec![0],
        };
        layout.link_blocks(sequence);
        layout
    }

    /// Finds the blocks that each point is linked with and gives them their places among the couplings.
    fn link_blocks(&mut self, sequence: &MetricReconstruction) {
        let unknowns = &self.unknowns;
        let mut blocks: Vec<usize> = Vec::new();
        let mut couplings = 0;
        for point in 0..self.point_count() {
            let seen = &mut self.all_seen[self.seen_starts[point]..self.seen_starts[point + 1]];
            let first = self.incident_blocks.len();
            let view = |seen: &Seen| unknowns.view_block[seen.view];
            let group = |seen: &Seen| unknowns.group_block_of_view(sequence, seen.view);
            blocks.clear();
            blocks.extend(seen.iter().filter_map(view));
            blocks.extend(seen.iter().filter_map(group));
            blocks.sort_unstable();
            blocks.dedup();
            let mut size = 0;
            for &block in &blocks {
                self.incident_blocks.push(IncidentBlock { block: block as u32, coupling: size as u32 });
                size += POINT * unknowns.size(block);
            }
            let incident_blocks = &self.incident_blocks[first..];
            let place = |block: Option<usize>| {
                let at = incident_blocks.binary_search_by_key(&(block? as u32), |incident| incident.block).ok()?;
                Some(incident_blocks[at].coupling)
            };
            for seen in seen {
                seen.view_coupling = place(view(seen));
                seen.group_coupling = place(group(seen));
            }
            couplings += size;
            self.incident_block_starts.push(self.incident_blocks.len());
            self.coupling_starts.push(couplings);
        }
    }

    pub fn point_count(&self) -> usize {
        self.seen_starts.len() - 1
    }

    pub fn seen(&self, point: usize) -> &[Seen] {
        &self.all_seen[self.seen_range(point..point + 1)]
    }

    /// Blocks that a point is linked with, ascending.
    pub fn incident_blocks(&self, point: usize) -> &[IncidentBlock] {
        &self.incident_blocks[self.incident_block_starts[point]..self.incident_block_starts[point + 1]]
    }

    pub fn is_coupled(&self, point: usize) -> bool {
        !self.incident_blocks(point).is_empty()
    }

    /// Where the couplings of a run of points are.
    pub fn couplings_of(&self, points: Range<usize>) -> Range<usize> {
        self.coupling_starts[points.start]..self.coupling_starts[points.end]
    }

    /// Share of all pairs of an unknown and a point with any that are coupled; not a number where there are none.
    pub fn coupled_share(&self) -> f64 {
        let points = (0..self.point_count()).filter(|point| self.is_coupled(*point)).count();
        self.coupling_starts[self.point_count()] as f64 / (POINT * self.unknowns.count() * points) as f64
    }

    /// Where the observations of a run of points are among all.
    pub fn seen_range(&self, points: Range<usize>) -> Range<usize> {
        self.seen_starts[points.start]..self.seen_starts[points.end]
    }
}
