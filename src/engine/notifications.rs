//! Handles the notifications of other servers on the same store: one says where to look, never what is there.

use std::sync::Arc;

use super::{Inner, Phase, locked};
use crate::domain::StopReason;
use crate::domain::job::JobName;
use crate::store::Notification;

/// Passes notifications on to whoever waits for such a change, until the engine is closed.
pub(super) async fn run(inner: Arc<Inner>) {
    let mut phase = inner.phase.subscribe();
    while *phase.borrow_and_update() != Phase::Closed {
        tokio::select! {
            biased;
            _ = phase.changed() => {}
            notification = inner.store.notification() => inner.handle(notification).await,
        }
    }
}

impl Inner {
    async fn handle(&self, notification: Notification) {
        match notification {
            Notification::Events(job) => self.notifier.wake(&job),
            Notification::Queued => {
                self.work_waits();
                self.queue_changed();
            }
            Notification::Cancel(job) => self.look_for_cancel(&job).await,
            // Watchers and slots look by themselves within their polls; this only makes it sooner.
            Notification::Missed => {
                self.notifier.wake_all();
                self.work_waits();
            }
        }
    }

    /// Stops the attempts at a job that run here, if its cancel was asked for. One that a failing store hides comes
    /// with the next heartbeat.
    async fn look_for_cancel(&self, name: &JobName) {
        if !locked(&self.running).keys().any(|lease| lease.name == *name) {
            return;
        }
        match self.store.job(name).await {
            Ok(job) if job.cancel_requested => self.stop_attempts(name),
            Ok(_) => {}
            Err(error) => tracing::debug!(job = %name, %error, "cannot look for a cancel"),
        }
    }

    /// Stops whatever runs here for a job. There may be two attempts for a while: one that lost its lease and does not
    /// know yet.
    pub(super) fn stop_attempts(&self, name: &JobName) {
        for (_, listed) in locked(&self.running).iter().filter(|(lease, _)| lease.name == *name) {
            listed.stop.stop(StopReason::Cancelled);
        }
    }
}
