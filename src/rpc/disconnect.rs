//! Jobs that depend on the calls of `Solve`: one whose calls were all disconnected is cancelled after a grace period,
//! unless another call has attached to it by then. The store counts these calls, so that it does not matter which
//! server they came to.

use std::time::Duration;

use tokio::runtime::Handle;

use crate::domain::job::{Job, JobName};
use crate::engine::{self, Engine, StoreError, Watch};

/// Cancels jobs that nobody waits for any more.
#[derive(Debug, Clone)]
pub struct DisconnectTracker {
    engine: Engine,
    grace: Duration,
}

impl DisconnectTracker {
    /// A job whose calls were all disconnected for `grace` is cancelled.
    pub fn new(engine: Engine, grace: Duration) -> Self {
        Self { engine, grace }
    }

    /// The call whose submission, with `cancel_on_disconnect`, gave this job. Must be called within a tokio runtime.
    pub fn attached(&self, job: Job) -> AttachedCall {
        AttachedCall { tracker: self.clone(), job, ending: Ending::Disconnected, runtime: Handle::current() }
    }

    /// A call was disconnected from this job.
    async fn detach(self, job: Job, may_cancel: bool) {
        let left = match self.engine.detach(&job.name, job.create_time).await {
            Ok(left) => left,
            Err(engine::Error::Store(StoreError::NotFound(_))) => return,
            Err(error) => {
                tracing::warn!(job = %job.name, %error, "cannot count a disconnected Solve; its job runs to its end");
                return;
            }
        };
        if may_cancel && left.attached_calls.is_some_and(|calls| calls.attached == calls.detached) {
            tokio::time::sleep(self.grace).await;
            self.cancel_if_abandoned(&left).await;
        }
    }

    /// Cancels a job unless a call attached to it since it was `left`, even one that was disconnected again: that has a
    /// grace period of its own.
    async fn cancel_if_abandoned(&self, left: &Job) {
        let name = &left.name;
        loop {
            let job = match self.engine.job(name).await {
                Ok(job) => job,
                Err(error) => return tracing::warn!(job = %name, %error, "cannot look at a job that nobody waits for"),
            };
            let is_same = job.create_time == left.create_time && job.attached_calls == left.attached_calls;
            if !is_same || job.state.is_terminal() {
                return;
            }
            match self.engine.cancel(name, Some(job.etag())).await {
                Ok(_) => return tracing::info!(job = %name, "cancelled: every Solve that waited was disconnected"),
                // It has changed between the two, and perhaps a call has attached.
                Err(engine::Error::Store(StoreError::EtagMismatch(_))) => {}
                Err(error) => return tracing::warn!(job = %name, %error, "cannot cancel a job that nobody waits for"),
            }
        }
    }
}

/// How a call ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ending {
    /// It is dropped, which is what a lost connection does.
    Disconnected,
    /// By an error of ours, for which the job is not cancelled: its caller may come again with the same request id.
    OurError,
    /// With its job.
    JobEnded,
}

/// A call that waits for a job. When it is dropped, the job is cancelled after the grace period if it depends on its
/// calls and none is left.
pub struct AttachedCall {
    tracker: DisconnectTracker,
    job: Job,
    ending: Ending,
    runtime: Handle,
}

impl AttachedCall {
    /// The job that it waits for.
    pub fn job(&self) -> &JobName {
        &self.job.name
    }

    /// The job's events from the first on. An error leaves the job alone, as [`AttachedCall::failed`] does.
    ///
    /// # Errors
    /// See [`Engine::watch`].
    pub async fn watch(&mut self) -> Result<Watch, engine::Error> {
        self.tracker.engine.watch(&self.job.name, 0).await.inspect_err(|_| self.ending = Ending::OurError)
    }

    /// The call ends with an error of ours: the job is not cancelled for it.
    pub fn failed(&mut self) {
        self.ending = Ending::OurError;
    }

    /// The job has ended: there is nothing to cancel.
    pub fn job_ended(&mut self) {
        self.ending = Ending::JobEnded;
    }
}

impl Drop for AttachedCall {
    fn drop(&mut self) {
        if self.job.attached_calls.is_none() || self.ending == Ending::JobEnded {
            return;
        }
        let may_cancel = self.ending == Ending::Disconnected;
        self.runtime.spawn(self.tracker.clone().detach(self.job.clone(), may_cancel));
    }
}
