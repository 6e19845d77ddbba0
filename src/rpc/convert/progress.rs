//! Progress records.

use super::enums::Twin;
use crate::domain::{Losses, Progress, Stage, Violation};
use crate::rpc::proto;

pub fn to_wire(progress: &Progress) -> proto::Progress {
    proto::Progress {
        stage: progress.stage.to_wire(),
        fraction: progress.fraction,
        iteration: progress.iteration,
        losses: progress.losses.map(|Losses { num, proj, daq }| proto::Losses { num, proj, daq }),
        inliers: progress.inliers,
        focal_px: progress.focal_px,
        best_score: progress.best_score,
        elapsed_seconds: progress.elapsed_seconds,
    }
}

/// # Errors
/// A violation where the stage is unknown.
pub fn from_wire(progress: &proto::Progress) -> Result<Progress, Violation> {
    Ok(Progress {
        stage: Stage::required(progress.stage, "progress.stage")?,
        fraction: progress.fraction,
        iteration: progress.iteration,
        losses: progress.losses.map(|proto::Losses { num, proj, daq }| Losses { num, proj, daq }),
        inliers: progress.inliers,
        focal_px: progress.focal_px,
        best_score: progress.best_score,
        elapsed_seconds: progress.elapsed_seconds,
    })
}
