//! What the engine tells metrics and traces: the one place where they meet.

pub(super) use crate::telemetry::metrics::{
    AttemptLost, Deletion, GivenUp, Held, Refusal, WebhookAttempt, attempt_lost, engine_size, input_created,
    job_created, job_finished as job_ended, jobs_deleted, queue_depth, queue_paused, refused, solver_bytes, uploaded,
    uploads_given_up, webhook_attempt, webhooks_pending,
};
pub(super) use crate::telemetry::{Attempt, waited};

use std::time::SystemTime;

use super::StoreState;
use crate::store::{self, StoreStats};
use crate::telemetry::metrics::{
    UploadRefusal, queue_oldest, store_bytes, store_full, store_reachable, tenant_jobs, upload_refused,
};

/// What operators watch, as of `now`.
pub(super) fn store_stats(stats: StoreStats, now: SystemTime) {
    store_bytes(stats.bytes);
    // A clock that was set back gives no age.
    queue_oldest(stats.oldest_queue_time.and_then(|time| now.duration_since(time).ok()).unwrap_or_default());
    tenant_jobs(stats.tenants.into_iter().map(|of| (of.tenant, [of.queued, of.running])).collect());
}

pub(super) fn store_state(state: StoreState) {
    store_reachable(state != StoreState::Unavailable);
    store_full(state == StoreState::Full);
}

/// Counts what the store refused because a bound was reached.
pub(super) fn refused_by_store(error: &store::Error) {
    match error {
        store::Error::QueueFull(bound) => refused(Refusal::QueueFull(bound.quota)),
        store::Error::BatchTooLarge(oversize) => refused(Refusal::BatchTooLarge(oversize.quota)),
        store::Error::UploadsFull(bound) => upload_refused(UploadRefusal::Full(bound.quota)),
        store::Error::UploadTooLarge(oversize) => upload_refused(UploadRefusal::TooLarge(oversize.quota)),
        _ => {}
    }
}
