//! Progress records.

use super::enums::Twin;
use crate::domain::{Course, HeadProgress, Losses, Phase, Progress, Stage, Step, Task, Violation};
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
        course: Some(course_to_wire(&progress.course)),
        head: progress.head.as_ref().map(head_to_wire),
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
        course: progress.course.as_ref().map(course_from_wire).unwrap_or_default(),
        head: progress.head.as_ref().map(head_from_wire),
    })
}

fn head_to_wire(progress: &HeadProgress) -> proto::HeadProgress {
    let HeadProgress { head, iteration, phase, weight_sum, weight_histogram, tolerance, best_daq_residual } = *progress;
    proto::HeadProgress {
        head,
        iteration,
        phase: super::enums::optional_to_wire(phase),
        weight_sum,
        weight_histogram: weight_histogram.to_vec(),
        tolerance,
        best_daq_residual,
    }
}

/// As [`course_from_wire`], of phases.
fn head_from_wire(progress: &proto::HeadProgress) -> HeadProgress {
    let proto::HeadProgress { head, iteration, phase, weight_sum, tolerance, best_daq_residual, .. } = *progress;
    let phase = Phase::from_wire(phase, "progress.head.phase").ok().flatten();
    let bin = |k: usize| progress.weight_histogram.get(k).copied().unwrap_or(0);
    let weight_histogram = std::array::from_fn(bin);
    HeadProgress { head, iteration, phase, weight_sum, weight_histogram, tolerance, best_daq_residual }
}

fn course_to_wire(course: &Course) -> proto::Course {
    let Course { block, blocks, part, registered_views, views, step } = *course;
    proto::Course {
        block,
        blocks,
        part,
        registered_views,
        views,
        task: super::enums::optional_to_wire(step.map(|step| step.task)),
        step: step.map_or(0, |step| step.step),
        steps: step.map_or(0, |step| step.steps),
    }
}

/// A task that only a later version knows is none: a stage that does something new is no reason not to watch it.
fn course_from_wire(course: &proto::Course) -> Course {
    let proto::Course { block, blocks, part, registered_views, views, task, step, steps } = *course;
    let task = Task::from_wire(task, "progress.course.task").ok().flatten();
    Course { block, blocks, part, registered_views, views, step: task.map(|task| Step { task, step, steps }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn servers_of_other_versions_are_understood() {
        let stage = Stage::Extend.to_wire();
        let older = from_wire(&proto::Progress { stage, fraction: 0.5, ..Default::default() }).expect("known");
        assert_eq!(older.course, Course::default());
        let course = proto::Course { registered_views: 3, task: 99, step: 1, steps: 2, ..Default::default() };
        let newer = from_wire(&proto::Progress { stage, course: Some(course), ..Default::default() }).expect("known");
        assert_eq!(newer.course, Course { registered_views: 3, ..Course::default() });
    }
}
