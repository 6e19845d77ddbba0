//! What the engine tells metrics and traces: the one place where they meet.

use crate::store::Bound;
pub(super) use crate::telemetry::Attempt;
pub(super) use crate::telemetry::metrics::{
    AttemptLost, Deletion, GivenUp, Refusal, attempt_lost, engine_size, input_created, job_created,
    job_finished as job_ended, jobs_deleted, queue_depth, refused, store_reachable, upload_refused, uploaded,
    uploads_given_up,
};

/// The refusal by a bound of the queue.
pub(super) fn by(bound: Bound) -> Refusal {
    match bound {
        Bound::Jobs { .. } => Refusal::QueueJobs,
        Bound::Bytes { .. } => Refusal::QueueBytes,
        Bound::Observations { .. } => Refusal::QueueObservations,
        Bound::TenantJobs { .. } => Refusal::TenantJobs,
        Bound::TenantBytes { .. } => Refusal::TenantBytes,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metrics_and_error_details_name_a_bound_alike() {
        let (waiting, max) = (1, 1);
        for bound in [
            Bound::Jobs { waiting, max },
            Bound::Bytes { waiting, max },
            Bound::Observations { waiting, max },
            Bound::TenantJobs { waiting, max },
            Bound::TenantBytes { waiting, max },
        ] {
            assert_eq!(by(bound).bound(), bound.name());
        }
    }
}
