//! An attempt at a job as a slot handles it: what a worker is given, and what is left to commit.

use std::sync::Arc;

use tokio::task::JoinHandle;
use tracing::{Instrument, Span};

use super::Inner;
use super::ahead::Ahead;
use super::execution::{End, JobExecution, Leasing, Wait};
use super::observe::Attempt;
use super::worker::{Began, Verdict, Worker};
use crate::store::Claimed;

/// A job that has all that a worker needs.
pub(super) enum Ready {
    /// It is leased.
    Claimed(Box<Begun>),
    /// It is to be, once the worker that has it begins.
    Foreseen(Box<Ahead>),
}

/// An attempt whose input is read.
pub(super) struct Begun {
    execution: JobExecution,
    attempt: Attempt,
    /// Or why there is nothing to solve.
    input: Result<Vec<u8>, Verdict>,
}

/// Begins an attempt at a claimed job: reads its input.
pub(super) async fn begin(inner: &Arc<Inner>, claimed: Claimed) -> Ready {
    let Claimed { job, lease, trace_parent, queue_time } = claimed;
    let attempt = Attempt::begin(&job.name, job.attempt, trace_parent.as_deref());
    let wait = Wait { trace_parent, queue_time };
    // All of it inside the span, so that every line carries the job's name.
    let span = attempt.span().clone();
    async {
        let mut execution = JobExecution::begin(inner.clone(), job, lease, wait);
        let input = execution.prepare().await;
        Ready::Claimed(Box::new(Begun { execution, attempt, input }))
    }
    .instrument(span)
    .await
}

/// What became of a job that a worker was to solve, once the worker is free again.
pub(super) enum Ran {
    Done(Box<Done>),
    /// It was foreseen and is another's by now, or nobody's.
    Gone,
    /// It was foreseen, and the store took no claim.
    NotLeased,
}

impl Ready {
    /// Has the worker solve it.
    pub(super) async fn run(self, worker: &Worker) -> Ran {
        match self {
            Self::Claimed(begun) => {
                let Begun { mut execution, attempt, input } = *begun;
                let span = attempt.span().clone();
                let end = match input {
                    Ok(input) => execution.run(worker, attempt, input).instrument(span.clone()).await,
                    Err(verdict) => End { verdict, latest: None, attempt: Some(attempt) },
                };
                Ran::Done(Box::new(Done { execution, end, span }))
            }
            Self::Foreseen(ahead) => {
                let Ahead { job, lease, wait, reserved, stop, begun, heard } = *ahead;
                let Ok(Began { span, at, time }) = begun.await else { return Ran::Gone };
                // Where another slot has it by now, what the worker has begun is stopped.
                let Some(mut execution) = JobExecution::foreseen(job, lease, wait, stop.token().clone(), reserved)
                else {
                    return Ran::Gone;
                };
                stop.keep();
                let (leasing, end) = execution.run_foreseen(at, time, heard).instrument(span.clone()).await;
                match leasing {
                    Leasing::Leased => Ran::Done(Box::new(Done { execution, end, span })),
                    Leasing::Gone => Ran::Gone,
                    Leasing::Failed => Ran::NotLeased,
                }
            }
        }
    }
}

/// An attempt that is over, and that the store does not know of yet.
pub(super) struct Done {
    execution: JobExecution,
    end: End,
    span: Span,
}

impl Done {
    /// Commits what it came to, on a task of its own.
    pub(super) fn commit(self) -> JoinHandle<()> {
        tokio::spawn(self.execution.conclude(self.end).instrument(self.span))
    }
}
