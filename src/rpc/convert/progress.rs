//! Progress records.

use super::enums::{Twin, optional_to_wire};
use super::time::{duration_to_wire, seconds_from_wire};
use crate::domain::{HeadProgress, Losses, Phase, Progress, ReconstructionProgress, Stage, Step, Task, Violation};
use crate::rpc::proto;

pub fn to_wire(progress: &Progress) -> proto::Progress {
    proto::Progress {
        stage: progress.stage.to_wire(),
        fraction: progress.fraction,
        iteration_count: progress.iteration,
        losses: progress.losses.map(|Losses { num, proj, daq }| proto::Losses { num, proj, daq }),
        inlier_track_count: progress.inliers,
        focal_px: progress.focal_px,
        best_cost: progress.best_cost,
        elapsed_duration: Some(duration_to_wire(progress.elapsed_seconds)),
        reconstruction: Some(reconstruction_to_wire(&progress.reconstruction)),
        head: progress.head.as_ref().map(head_to_wire),
    }
}

/// `None`: of a stage that this version does not know.
///
/// # Errors
/// A violation that names the field which no server of this version would send.
pub fn from_wire(progress: &proto::Progress) -> Result<Option<Progress>, Violation> {
    let Some(stage) = Stage::known(progress.stage) else { return Ok(None) };
    Ok(Some(Progress {
        stage,
        fraction: progress.fraction,
        iteration: progress.iteration_count,
        losses: progress.losses.map(|proto::Losses { num, proj, daq }| Losses { num, proj, daq }),
        inliers: progress.inlier_track_count,
        focal_px: progress.focal_px,
        best_cost: progress.best_cost,
        elapsed_seconds: seconds_from_wire(progress.elapsed_duration, "progress.elapsed_duration")?,
        reconstruction: progress.reconstruction.as_ref().map(reconstruction_from_wire).unwrap_or_default(),
        head: progress.head.as_ref().map(head_from_wire),
    }))
}

fn head_to_wire(progress: &HeadProgress) -> proto::HeadProgress {
    let HeadProgress { head, iteration, phase, weight_sum, weight_histogram, tolerance, best_daq_residual } = *progress;
    proto::HeadProgress {
        head,
        iteration,
        phase: optional_to_wire(phase),
        weight_sum,
        weight_histogram: weight_histogram.to_vec(),
        tolerance,
        best_daq_residual,
    }
}

fn head_from_wire(progress: &proto::HeadProgress) -> HeadProgress {
    let proto::HeadProgress { head, iteration, phase, weight_sum, tolerance, best_daq_residual, .. } = *progress;
    let phase = Phase::known(phase);
    let bin = |k: usize| progress.weight_histogram.get(k).copied().unwrap_or(0);
    let weight_histogram = std::array::from_fn(bin);
    HeadProgress { head, iteration, phase, weight_sum, weight_histogram, tolerance, best_daq_residual }
}

fn reconstruction_to_wire(reconstruction: &ReconstructionProgress) -> proto::ReconstructionProgress {
    let ReconstructionProgress { block, blocks, part, registered_views, views, step } = *reconstruction;
    proto::ReconstructionProgress {
        block,
        block_count: blocks,
        part,
        registered_view_count: registered_views,
        view_count: views,
        task: optional_to_wire(step.map(|step| step.task)),
        step: step.map_or(0, |step| step.step),
        step_count: step.map_or(0, |step| step.steps),
    }
}

fn reconstruction_from_wire(wire: &proto::ReconstructionProgress) -> ReconstructionProgress {
    ReconstructionProgress {
        block: wire.block,
        blocks: wire.block_count,
        part: wire.part,
        registered_views: wire.registered_view_count,
        views: wire.view_count,
        step: Task::known(wire.task).map(|task| Step { task, step: wire.step, steps: wire.step_count }),
    }
}
