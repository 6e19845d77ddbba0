//! Metric bundle adjustment of whole sequences, cameras in groups of one calibration, but for focal lengths of their own
//! where they have these: cost and memory linear in the
//! observations, by a sparse Cholesky factorisation of the Schur complement of the points (Triggs et al. 2000, "Bundle
//! adjustment - a modern synthesis", section 6).
//!
//! Shares residuals, loss and damping with the dense adjustment of one block, `bundle::metric`. May depend on nothing
//! of `geometry` but `bundle` and linear algebra.

mod crew;
mod layout;
mod minimise;
mod normal;
mod pattern;
mod point;
mod reduced;
mod settle;
mod solver;
#[cfg(test)]
mod tests;

use nalgebra::{Vector2, Vector3};

pub use self::minimise::adjust;
use super::Observation;
use super::metric::{Intrinsics, IntrinsicsModel, Pose, Reconstruction};
use crate::domain::StopToken;
use crate::parallel::Threads;

/// A metric reconstruction, up to a similarity, whose views share intrinsics in groups.
#[derive(Debug, Clone, PartialEq)]
pub struct Sequence {
    /// One a group; where views have focal lengths of their own, all but these.
    pub intrinsics: Vec<Intrinsics>,
    /// The focal length of each view; empty where views have that of their group.
    pub focals: Vec<f64>,
    /// Group of each view.
    pub group_of: Vec<usize>,
    pub poses: Vec<Pose>,
    pub points: Vec<Vector3<f64>>,
}

/// What may move. What a mask is too short for is held.
#[derive(Debug, Clone, Copy)]
pub struct Free<'a> {
    /// Free intrinsics, one a group; none are free of a group that is beyond the slice.
    pub models: &'a [IntrinsicsModel],
    /// Views whose poses are free; `None`: all.
    pub views: Option<&'a [bool]>,
    /// Points that are free; `None`: all.
    pub points: Option<&'a [bool]>,
}

impl<'a> Free<'a> {
    /// All poses and points, and these intrinsics.
    pub fn all(models: &'a [IntrinsicsModel]) -> Self {
        Self { models, views: None, points: None }
    }
}

impl From<&Reconstruction> for Sequence {
    /// All views in one group.
    fn from(block: &Reconstruction) -> Self {
        Self {
            intrinsics: vec![block.intrinsics],
            focals: block.focals.clone(),
            group_of: vec![0; block.poses.len()],
            poses: block.poses.clone(),
            points: block.points.clone(),
        }
    }
}

impl Sequence {
    /// Intrinsics of a view.
    ///
    /// # Panics
    /// When the view or its group is out of range.
    #[inline]
    pub fn intrinsics_of(&self, view: usize) -> Intrinsics {
        let shared = self.intrinsics[self.group_of[view]];
        match self.focals.get(view) {
            Some(&focal) => Intrinsics { focal, ..shared },
            None => shared,
        }
    }

    /// Takes the geometric mean of the views' own focal lengths as that of their group.
    fn average_focals(&mut self) {
        for (group, intrinsics) in self.intrinsics.iter_mut().enumerate() {
            let of_group = self.focals.iter().zip(&self.group_of).filter(|(_, of)| **of == group);
            let logs: Vec<f64> = of_group.map(|(focal, _)| focal.ln()).collect();
            if !logs.is_empty() {
                intrinsics.focal = (logs.iter().sum::<f64>() / logs.len() as f64).exp();
            }
        }
    }

    /// Predicted minus observed image point, unweighted; infinite or not a number at depth zero.
    ///
    /// # Panics
    /// When an index is out of range.
    pub fn residual(&self, seen: &Observation) -> Vector2<f64> {
        self.intrinsics_of(seen.view).project(&self.poses[seen.view].apply(&self.points[seen.point])) - seen.xy
    }

    /// Whether an observation can be used.
    fn holds(&self, seen: &Observation) -> bool {
        let has_intrinsics = |group: &usize| *group < self.intrinsics.len();
        seen.is_usable(self.poses.len(), self.points.len()) && self.group_of.get(seen.view).is_some_and(has_intrinsics)
    }
}

/// Who does an adjustment, who may end it, and who hears that it goes on.
pub struct Run<'a> {
    /// However many, they find the same, to the last bit.
    pub threads: Threads,
    pub stop: &'a StopToken,
    /// Called after every attempt at a step.
    pub told: &'a mut dyn FnMut(),
}

/// Observations' worth of work after which the stop token is asked: some milliseconds, 20 in builds for tests.
const WORK_BETWEEN_QUESTIONS: usize = 1 << 14;

/// Asks the stop token now and then.
struct Pace<'a> {
    stop: &'a StopToken,
    left: usize,
}

impl<'a> Pace<'a> {
    fn new(stop: &'a StopToken) -> Self {
        Self { stop, left: WORK_BETWEEN_QUESTIONS }
    }

    /// Whether to go on after so much work.
    #[inline]
    fn go_on(&mut self, work: usize) -> bool {
        match self.left.checked_sub(work) {
            Some(left) => {
                self.left = left;
                true
            }
            None => {
                self.left = WORK_BETWEEN_QUESTIONS;
                !self.stop.is_stopped()
            }
        }
    }
}
