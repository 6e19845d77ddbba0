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
        best_score: progress.best_score,
        elapsed_duration: Some(duration_to_wire(progress.elapsed_seconds)),
        reconstruction: Some(reconstruction_to_wire(&progress.reconstruction)),
        head: progress.head.as_ref().map(head_to_wire),
    }
}

/// # Errors
/// A violation where the stage is unknown.
pub fn from_wire(progress: &proto::Progress) -> Result<Progress, Violation> {
    Ok(Progress {
        stage: Stage::required(progress.stage, "progress.stage")?,
        fraction: progress.fraction,
        iteration: progress.iteration_count,
        losses: progress.losses.map(|proto::Losses { num, proj, daq }| Losses { num, proj, daq }),
        inliers: progress.inlier_track_count,
        focal_px: progress.focal_px,
        best_score: progress.best_score,
        elapsed_seconds: seconds_from_wire(progress.elapsed_duration, "progress.elapsed_duration")?,
        reconstruction: progress.reconstruction.as_ref().map(reconstruction_from_wire).unwrap_or_default(),
        head: progress.head.as_ref().map(head_from_wire),
    })
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

/// As [`reconstruction_from_wire`], of phases.
fn head_from_wire(progress: &proto::HeadProgress) -> HeadProgress {
    let proto::HeadProgress { head, iteration, phase, weight_sum, tolerance, best_daq_residual, .. } = *progress;
    let phase = Phase::from_wire(phase, "progress.head.phase").ok().flatten();
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

/// A task that only a later version knows is none: a stage that does something new is no reason not to watch it.
fn reconstruction_from_wire(wire: &proto::ReconstructionProgress) -> ReconstructionProgress {
    let task = Task::from_wire(wire.task, "progress.reconstruction.task").ok().flatten();
    ReconstructionProgress {
        block: wire.block,
        blocks: wire.block_count,
        part: wire.part,
        registered_views: wire.registered_view_count,
        views: wire.view_count,
        step: task.map(|task| Step { task, step: wire.step, steps: wire.step_count }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tasks_of_later_versions_are_none() {
        let reconstruction = proto::ReconstructionProgress {
            registered_view_count: 3,
            task: 99,
            step: 1,
            step_count: 2,
            ..Default::default()
        };
        let newer = from_wire(&proto::Progress {
            stage: Stage::Extend.to_wire(),
            elapsed_duration: Some(duration_to_wire(0.5)),
            reconstruction: Some(reconstruction),
            ..Default::default()
        });
        let expected = ReconstructionProgress { registered_views: 3, ..ReconstructionProgress::default() };
        assert_eq!(newer.expect("known").reconstruction, expected);
    }
}
