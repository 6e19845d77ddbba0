//! Metric bundle adjustment of whole sequences, cameras in groups of one calibration, but for focal lengths of their
//! own where they have these: cost and memory linear in the observations, by a sparse Cholesky factorisation of the
//! Schur complement of the points (Triggs et al. 2000, "Bundle adjustment - a modern synthesis", section 6).
//!
//! Serves every metric reconstruction: a small system, and one that most views share, is a square matrix whose points
//! are eliminated many at a time. May depend on nothing of `geometry` but `bundle` and `levenberg_marquardt`, and on
//! linear algebra.

mod layout;
mod minimise;
mod normal;
mod pattern;
mod point;
mod reduced;
mod solver;
mod system;
#[cfg(test)]
mod tests;
mod worker_pool;

pub use self::minimise::{adjust, adjust_all};
pub(super) use self::reduced::GAUGE_DAMPING;
pub use self::system::System;
use super::Observation;
use super::metric::{IntrinsicsModel, MetricReconstruction};
use crate::domain::StopToken;
use crate::parallel::Threads;

/// What may move beside the points.
#[derive(Debug, Clone, Copy)]
pub struct Free<'a> {
    /// Free intrinsics, one a group; none are free of a group that is beyond the slice.
    pub models: &'a [IntrinsicsModel],
    /// Views whose poses are free; none are beyond the slice. `None`: all.
    pub views: Option<&'a [bool]>,
}

impl<'a> Free<'a> {
    /// All poses, and these intrinsics.
    pub fn all(models: &'a [IntrinsicsModel]) -> Self {
        Self { models, views: None }
    }
}

/// Who does an adjustment, who may end it, and who hears that it goes on.
pub struct Run<'a> {
    /// However many, they find the same, to the last bit.
    pub threads: Threads,
    pub stop: &'a StopToken,
    /// Called after every attempt at a step.
    pub heartbeat: &'a mut dyn FnMut(),
}
