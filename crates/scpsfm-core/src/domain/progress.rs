//! What a running optimisation tells, and to whom.

use serde::{Deserialize, Serialize};

/// Part of the solver that is running.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Stage {
    /// Normalising, choosing the block of views, balancing the measurement matrix.
    #[default]
    Prepare,
    /// The network and the other priors propose, guided search verifies.
    Search,
    /// Growing, polishing and re-estimating the noise; projective bundle adjustment.
    Refine,
    /// Self-calibration, metric bundle adjustment, covariance and grade.
    Calibrate,
    /// Registering the other views of a sequence against the block that was solved.
    Extend,
    /// Classification of every track and observation under the final geometry.
    Classify,
}

impl Stage {
    /// Every stage in the order in which a solve passes them first; an extension is calibrated once more.
    pub const ALL: [Stage; 6] =
        [Stage::Prepare, Stage::Search, Stage::Refine, Stage::Calibrate, Stage::Extend, Stage::Classify];

    /// The stage's name in files, metrics and logs.
    pub fn name(self) -> &'static str {
        match self {
            Stage::Prepare => "prepare",
            Stage::Search => "search",
            Stage::Refine => "refine",
            Stage::Calibrate => "calibrate",
            Stage::Extend => "extend",
            Stage::Classify => "classify",
        }
    }
}

/// The three terms of the paper's loss (its eq. 11), unweighted, at the network's latest iteration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Losses {
    /// Too few inliers: `exp(t - N)` with `N = sum_j w_j`, and from `N = t` on its tangent `1 + t - N`, which may be
    /// negative; by PAPER `exp(t - sum_j s(kappa (w_j - 1/2)))`.
    pub num: f64,
    /// Distance from rank 4, `sum_{k>=5} sigma_k(M diag(w))`. It begins as the sum over all k, and is the sum of their
    /// squares over `k >= 5` in the last [`Phase`]; by PAPER it stays the same.
    pub proj: f64,
    /// `sum_i | S_i/|S_i| - omega/|omega| |`: distance from one constant calibration.
    pub daq: f64,
}

/// Which part of the continued objective a head of the network is in, see `network::head`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Phase {
    /// L_proj goes from the nuclear norm, convex in the weights, to the rank-4 tail.
    Relaxation,
    /// L_proj is the rank-4 tail, its weight set by the consensus.
    Rank,
    /// L_proj is the energy of the tail, its weight set by the noise of the consensus, which grows.
    Growth,
}

impl Phase {
    /// The phase's name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Phase::Relaxation => "relaxation",
            Phase::Rank => "rank",
            Phase::Growth => "growth",
        }
    }
}

/// The optimisation of the network from one set of new weights, at its latest iteration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeadProgress {
    /// From 1.
    pub head: u32,
    /// Of this head, from 1.
    pub iteration: u32,
    /// None by PAPER, whose objective stays the same.
    pub phase: Option<Phase>,
    /// `N = sum_j w_j`.
    pub weight_sum: f64,
    /// Tracks by weight, in equal intervals of [0, 1].
    pub weight_histogram: [u32; HeadProgress::BINS],
    /// Residual of a track (sine of the angle to the consensus' span) at which it leaves the consensus, tau; none
    /// before the growth.
    pub tolerance: Option<f64>,
    /// DAQ residual of the best head so far; none before one has ended, and without the DAQ term.
    pub best_daq_residual: Option<f64>,
}

impl HeadProgress {
    /// Intervals of the histogram.
    pub const BINS: usize = 10;

    /// Tracks by weight.
    ///
    /// * `weights`: one a track, in [0, 1]
    pub fn histogram(weights: &[f64]) -> [u32; Self::BINS] {
        let mut histogram = [0; Self::BINS];
        for weight in weights {
            histogram[((weight * Self::BINS as f64) as usize).min(Self::BINS - 1)] += 1;
        }
        histogram
    }
}

/// What a stage does many times over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Task {
    /// Adjusting everything and triangulating it anew; steps are rounds.
    Adjust,
    /// Calibrating camera groups, or runs of views that each have a focal length of their own; steps are these.
    Cameras,
    /// Asking windows of the sequence what focal length each sees; steps are windows.
    Windows,
    /// Classifying; steps are verdicts, up to two a track.
    Classify,
    /// Optimising the network from new weights; steps are heads.
    Heads,
}

/// How far a [`Task`] is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Step {
    pub task: Task,
    /// The round, group, run or window that is worked on, from 1, or the verdicts so far.
    pub step: u32,
    /// How many there will be at most.
    pub steps: u32,
}

/// Where a solve is on its way through the views of its input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReconstructionProgress {
    /// The block of views that is tried, from 1, and how many are tried at most; 0 before the first.
    pub block: u32,
    pub blocks: u32,
    /// The part that is built, from 0, in the order in which they are begun; the result numbers them by size. 0 again
    /// once all are built.
    pub part: u32,
    /// Views that have a camera now. Falls where a block is given up for another, or views lose their support.
    pub registered_views: u32,
    /// Views in which anything is observed: so many can be registered.
    pub views: u32,
    /// None where the stage says it all.
    pub step: Option<Step>,
}

/// The state of a running optimisation.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Progress {
    pub stage: Stage,
    /// Share of the work done, 0 to 1, never decreasing within an attempt.
    pub fraction: f64,
    /// Iterations of the paper's network done so far, over all heads and blocks; AUTO needs none where the search is
    /// decided without it.
    pub iteration: u32,
    /// Losses of that iteration; none before the first.
    pub losses: Option<Losses>,
    /// The head that iteration is of; none where there is no iteration.
    pub head: Option<HeadProgress>,
    /// Inlier tracks of the best hypothesis so far. The result's verdicts come later: they may be more or fewer.
    pub inliers: u32,
    /// Current estimate of the focal length in pixels: under PAPER and SCPSFM the network's while it is optimised; else
    /// none until the calibration.
    pub focal_px: Option<f64>,
    /// Truncated cost of the best hypothesis so far, as a share of the cost of calling every track an outlier:
    /// 0 is a perfect consensus of all tracks, 1 is none.
    pub best_cost: Option<f64>,
    /// Seconds since the attempt began.
    pub elapsed_seconds: f64,
    pub reconstruction: ReconstructionProgress,
}

/// Told of every iteration. Implementations must be quick: they run inside the optimisation.
///
/// An observer that wants the optimisation to end says so through the [`StopToken`](super::StopToken).
pub trait Observer {
    /// The optimisation entered a stage.
    fn stage(&mut self, _stage: Stage) {}
    /// The state changed.
    fn progress(&mut self, progress: &Progress);
    /// Interim inlier weights, one per track of the input in [0, 1] (0 for tracks the block leaves out).
    /// Called at the interval of [`SolveSettings::weights_every`](super::SolveSettings::weights_every).
    fn weights(&mut self, _iteration: u32, _weights: &[f32]) {}
}

/// Listens to nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Observer for Silent {
    fn progress(&mut self, _progress: &Progress) {}
}
