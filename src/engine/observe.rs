//! What the engine tells metrics and traces: the one place where they meet.

pub(super) use crate::telemetry::metrics::{
    AttemptLost, Deletion, GivenUp, Refusal, UploadRefusal, attempt_lost, engine_size, input_created, job_created,
    job_finished as job_ended, jobs_deleted, queue_depth, refused, store_reachable, upload_refused, uploaded,
    uploads_given_up,
};
pub(super) use crate::telemetry::{Attempt, waited};
