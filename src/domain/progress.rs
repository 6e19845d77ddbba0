//! What a running optimisation tells, and to whom.

use serde::{Deserialize, Serialize};

/// Part of the solver that is running.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Stage {
    /// Normalising, choosing the block of views, balancing the measurement matrix.
    Prepare,
    /// The network and the other priors propose, guided search verifies.
    Search,
    /// Growing, polishing and re-estimating the noise; projective bundle adjustment.
    Refine,
    /// Self-calibration, metric bundle adjustment, covariance and grade.
    Calibrate,
    /// Registering the other views of a sequence against the block that was solved.
    Extend,
    /// Judging every track and observation under the final geometry.
    Judge,
}

impl Stage {
    /// Every stage in the order in which a solve passes them first; an extension is calibrated once more.
    pub const ALL: [Stage; 6] =
        [Stage::Prepare, Stage::Search, Stage::Refine, Stage::Calibrate, Stage::Extend, Stage::Judge];

    /// The stage's name in files, metrics and logs.
    pub fn name(self) -> &'static str {
        match self {
            Stage::Prepare => "prepare",
            Stage::Search => "search",
            Stage::Refine => "refine",
            Stage::Calibrate => "calibrate",
            Stage::Extend => "extend",
            Stage::Judge => "judge",
        }
    }
}

/// The three terms of the paper's loss (its eq. 9), unweighted, at the network's latest iteration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Losses {
    /// `exp(t - sum_j s(kappa (w_j - 1/2)))`: too few inliers.
    pub num: f64,
    /// `sum_{k>=5} sigma_k(M diag(w))`: distance from rank 4.
    pub proj: f64,
    /// `sum_i | S_i/|S_i| - omega/|omega| |`: distance from one constant calibration.
    pub daq: f64,
}

/// The state of a running optimisation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    pub stage: Stage,
    /// Share of the work done, 0 to 1, never decreasing within an attempt.
    pub fraction: f64,
    /// Iterations of the paper's network done so far; AUTO needs none where the search is decided without it.
    pub iteration: u32,
    /// Losses of that iteration; none before the first.
    pub losses: Option<Losses>,
    /// Inlier tracks of the best hypothesis so far.
    pub inliers: u32,
    /// Current estimate of the focal length in pixels: under PAPER the network's while it is optimised; else none until
    /// the calibration.
    pub focal_px: Option<f64>,
    /// Truncated cost of the best hypothesis so far, as a share of the cost of calling every track an outlier:
    /// 0 is a perfect consensus of all tracks, 1 is none.
    pub best_score: Option<f64>,
    /// Seconds since the attempt began.
    pub elapsed_seconds: f64,
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
