//! What the engine tells metrics and traces: the one place where they meet.

pub(super) use crate::telemetry::Attempt;
pub(super) use crate::telemetry::metrics::{
    AttemptLost, Refusal, attempt_lost, engine_size, job_created, job_finished as job_ended, queue_depth, refused,
};
