//! The normal equations of views and intrinsics at one reconstruction, the points eliminated.

use std::ops::Range;

use super::layout::Layout;
use super::normal::Normal;
use super::pattern::Pattern;
use super::reduced::Reduced;
use super::worker_pool::WorkerPool;
use super::{Free, MetricReconstruction, Observation};
use crate::domain::StopToken;
use crate::geometry::bundle::Loss;
use crate::geometry::bundle::metric::{IntrinsicsModel, Parameter};
use crate::parallel::Threads;

/// What the observations say of the poses and of all intrinsics, those that views have of their own and those that they
/// share, nothing damped.
pub struct System {
    pattern: Pattern,
    values: Vec<f64>,
    /// Half the downward gradient of the cost.
    pub negative_gradient: Vec<f64>,
    /// The diagonal were the points and everything else known.
    pub known: Vec<f64>,
}

impl System {
    /// Linearises; `None` where a point's block is no number.
    pub fn new(reconstruction: &MetricReconstruction, observations: &[Observation]) -> Option<Self> {
        let model = IntrinsicsModel::focal(reconstruction.has_own_focals()).with_all_extensions();
        let models = vec![model; reconstruction.intrinsics.len()];
        let stop = StopToken::default();
        let layout = Layout::new(reconstruction, observations, &Free::all(&models));
        let pattern = Pattern::new(reconstruction, &layout, &stop)?;
        let pool = WorkerPool::new(&layout, Threads::ONE, &stop);
        let mut normal = Normal::new(&layout, &pattern, reconstruction);
        normal.fill(reconstruction, &[], Loss::Squared, &pool);
        let mut reduced = Reduced::new(&layout, pattern);
        let possible = reduced.build(&normal, 0.0, &pool);
        let known = normal.diagonal.iter().map(|&index| normal.values[index]).collect();
        let Reduced { pattern, values, vector: negative_gradient, .. } = reduced;
        possible.then_some(Self { pattern, values, negative_gradient, known })
    }

    /// Views that see something, and their unknowns: the pose, and the focal length where it is the view's own.
    pub fn of_views(&self) -> impl Iterator<Item = (usize, Range<usize>)> {
        let unknowns = &self.pattern.unknowns;
        let views = unknowns.view_block.iter().enumerate();
        views.filter_map(move |(view, block)| Some((view, unknowns.range((*block)?))))
    }

    /// Camera group, intrinsic and unknown of all that views share.
    pub fn of_groups(&self) -> impl Iterator<Item = (usize, Parameter, usize)> {
        let unknowns = &self.pattern.unknowns;
        let blocks = unknowns.group_block.iter().zip(&unknowns.parameters).enumerate();
        blocks.flat_map(move |(group, (block, parameters))| {
            let unknowns = block.map_or(0..0, |block| unknowns.range(block));
            parameters.iter().zip(unknowns).map(move |(parameter, unknown)| (group, *parameter, unknown))
        })
    }

    /// Calls `take` with row, column and value of the lower triangle.
    pub fn for_each(&self, mut take: impl FnMut(usize, usize, f64)) {
        self.pattern.for_each(|row, column, index| {
            if row >= column {
                take(row, column, self.values[index]);
            }
        });
    }
}
