//! What is seen of one attempt at a job, from its begin to its end.

use std::time::{Duration, Instant, SystemTime};

use tracing::{Span, field};

use super::metrics::{self, Held};
use super::tracing::{attempt_span, queue_span, stage_span};
use crate::domain::Stage;
use crate::domain::job::{JobName, JobState};

/// An attempt that runs: its span, its stages and the busy worker. Dropped without [`Attempt::end`] (an early return,
/// a panic), it counts as one that did not end its job.
#[must_use = "the attempt ends when this is dropped"]
#[derive(Debug)]
pub struct Attempt {
    span: Span,
    current: Option<CurrentStage>,
    spent: Vec<(Stage, Duration)>,
    busy: Option<Held>,
}

#[derive(Debug)]
struct CurrentStage {
    stage: Stage,
    begun: Instant,
    _span: Span,
}

/// A job was begun at `begun_at` that had entered the queue at `enqueued_at`. `traceparent` as for [`Attempt::begin`].
pub fn waited(job: &JobName, traceparent: Option<&str>, enqueued_at: SystemTime, begun_at: SystemTime) {
    // A clock set back between the two gives no wait, not a panic.
    metrics::queue_wait(begun_at.duration_since(enqueued_at).unwrap_or_default());
    queue_span(job, traceparent, enqueued_at.min(begun_at), begun_at);
}

impl Attempt {
    /// Work on the job begins. `traceparent` is the one that its record keeps.
    pub fn begin(job: &JobName, attempt: u32, traceparent: Option<&str>) -> Self {
        Self {
            span: attempt_span(job, attempt, traceparent),
            current: None,
            spent: Vec::with_capacity(Stage::ALL.len()),
            busy: None,
        }
    }

    /// The attempt's span. Log lines written inside it carry the job's name.
    pub fn span(&self) -> &Span {
        &self.span
    }

    /// A worker has the job in its hands.
    pub fn at_work(&mut self) {
        self.busy = Some(metrics::busy_worker());
    }

    /// The worker is free again; what is left is to commit what it found.
    pub fn at_rest(&mut self) {
        self.leave_stage();
        self.busy = None;
    }

    /// The solver entered a stage; the one before is over.
    pub fn stage(&mut self, stage: Stage) {
        self.leave_stage();
        self.current = Some(CurrentStage { stage, begun: Instant::now(), _span: stage_span(&self.span, stage) });
    }

    /// The attempt is over: with the terminal state it led to, or `None` where the job goes on without it (given
    /// back, lease lost).
    pub fn end(mut self, outcome: Option<JobState>) {
        self.report(outcome);
    }

    fn leave_stage(&mut self) {
        if let Some(left) = self.current.take() {
            self.spent.push((left.stage, left.begun.elapsed()));
        }
    }

    fn report(&mut self, outcome: Option<JobState>) {
        self.leave_stage();
        for (stage, spent) in std::mem::take(&mut self.spent) {
            metrics::stage_finished(stage, outcome, spent);
        }
        if let Some(outcome) = outcome {
            self.span.record("outcome", outcome.name());
            if outcome == JobState::Failed {
                self.span.record("otel.status_code", field::display("ERROR"));
            }
        }
    }
}

impl Drop for Attempt {
    fn drop(&mut self) {
        self.report(None);
    }
}
