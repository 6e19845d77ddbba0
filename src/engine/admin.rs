//! What operators ask for: retries, priorities, pauses of the queue, a drain.

use super::{Engine, Error, QueueReport, finished, observe};
use crate::domain::job::{Job, JobName};

impl Engine {
    /// Puts a job that ended without a result into the queue again, with its attempts counted anew; one that waits or
    /// runs is left as it is. With an etag, only where it is the job's. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::EtagMismatch`], [`StoreError::Succeeded`], [`StoreError::QueueFull`],
    /// [`Error::Draining`].
    pub async fn retry(&self, name: &JobName, etag: Option<String>) -> Result<Job, Error> {
        self.inner.check_open().inspect_err(|_| observe::refused(observe::Refusal::Draining))?;
        let (inner, name) = (self.inner.clone(), name.clone());
        let retry = async move {
            let retried = inner.store.retry_job(&name, etag.as_deref(), &inner.options.queue, inner.now()).await;
            let reply = retried.inspect_err(observe::refused_by_store)?;
            if reply.by_this_call {
                tracing::info!(job = %name, "retried");
                inner.notifier.wake(&name);
                inner.work_waits();
                inner.queue_changed();
            }
            Ok::<_, Error>(inner.dated(reply.job))
        };
        // On its own task: a caller that goes away must not leave a queued job untold.
        finished(tokio::spawn(retry)).await
    }

    /// Changes the priority of a queued job; with an etag, only where it is the job's.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::EtagMismatch`], [`StoreError::NotQueued`].
    pub async fn set_priority(&self, name: &JobName, etag: Option<&str>, priority: i32) -> Result<Job, Error> {
        Ok(self.inner.dated(self.inner.store.set_priority(name, etag, priority).await?))
    }

    /// Pauses the queue, or ends the pause. While it is paused no server of the store begins a job, also after a
    /// restart. What runs goes on.
    ///
    /// # Errors
    /// [`StoreError::Unavailable`].
    pub async fn set_paused(&self, paused: bool) -> Result<(), Error> {
        self.inner.store.set_paused(paused, self.inner.now()).await?;
        self.inner.work_waits();
        // The count of the queue tells of the change.
        self.inner.queue_changed();
        Ok(())
    }

    /// The queue over all servers of the store, with at most `tenants` tenants.
    ///
    /// # Errors
    /// [`StoreError::Unavailable`].
    pub async fn queue(&self, tenants: u32) -> Result<QueueReport, Error> {
        Ok(self.inner.store.queue(tenants).await?)
    }

    /// Asks whoever runs the engine to drain it and to end the process.
    pub fn ask_for_drain(&self) {
        self.inner.drain_asked.cancel();
    }

    /// Waits until a drain is asked for.
    pub fn drain_asked(&self) -> impl Future<Output = ()> + Send + use<> {
        self.inner.drain_asked.clone().cancelled_owned()
    }
}
