//! What the engine tells metrics and traces: the one place where they meet.

use std::time::SystemTime;

use tracing::Span;

use crate::domain::Stage;
use crate::domain::job::{Job, JobName, JobState};

/// Why a job was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refusal {
    QueueFull,
    Draining,
}

/// How an attempt ended that did not end its job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AttemptLost {
    /// Given back to the queue at a drain.
    GivenBack,
    /// Another worker took the lease over, or the store was out of reach for the length of a lease.
    Fenced,
    /// The lease ran out without a heartbeat, or its process died.
    LeaseExpired,
}

/// The engine started.
pub(super) fn engine_size(_queue_capacity: u64, _workers: usize) {}

/// Jobs that wait; told by one task only.
pub(super) fn queue_depth(_queued: u64) {}

/// A job was admitted and stored.
pub(super) fn job_created() {}

/// A job was refused.
pub(super) fn refused(_refusal: Refusal) {}

/// A job ended.
pub(super) fn job_ended(_job: &Job) {}

/// An attempt ended and its job did not.
pub(super) fn attempt_lost(_reason: AttemptLost) {}

/// An attempt as traces see it: a span, and one for the stage that runs.
#[derive(Debug)]
pub(super) struct Attempt {
    span: Span,
    stage: Option<Span>,
}

impl Attempt {
    /// At the claim.
    pub(super) fn begin(name: &JobName, number: u32, _trace_parent: Option<&str>, _queue_time: SystemTime) -> Self {
        Self { span: attempt_span(name, number), stage: None }
    }

    pub(super) fn span(&self) -> &Span {
        &self.span
    }

    /// A stage begins, and the one before ends.
    pub(super) fn stage(&mut self, stage: Stage) {
        self.stage = Some(stage_span(&self.span, stage));
    }

    /// The attempt led to this terminal state; `None`: to none.
    pub(super) fn end(self, _state: Option<JobState>) {}
}

fn attempt_span(name: &JobName, number: u32) -> Span {
    tracing::info_span!("attempt", job = %name, attempt = number)
}

fn stage_span(parent: &Span, stage: Stage) -> Span {
    tracing::info_span!(parent: parent, "stage", stage = stage.name())
}
