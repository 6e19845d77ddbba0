//! What the engine tells metrics and traces: the one place where they meet.

pub(super) use crate::telemetry::metrics::{
    AttemptLost, Deletion, GivenUp, Refusal, UploadRefusal, WebhookAttempt, attempt_lost, engine_size, input_created,
    job_created, job_finished as job_ended, jobs_deleted, queue_depth, queue_paused, refused, upload_refused, uploaded,
    uploads_given_up, webhook_attempt, webhooks_pending,
};
pub(super) use crate::telemetry::{Attempt, waited};

use super::StoreState;
use crate::telemetry::metrics::{store_full, store_reachable};

pub(super) fn store_state(state: StoreState) {
    store_reachable(state != StoreState::Away);
    store_full(state == StoreState::Full);
}
