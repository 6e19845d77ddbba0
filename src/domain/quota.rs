//! What of the queue and of a tenant's uploads is bounded, under the names that metrics, error details and the
//! configuration have for it; and what is more than a bound allows all by itself.

use std::fmt;

scpsfm_core::named! {
    /// Something that a server has only so much room for.
    pub enum Quota {
        /// Jobs that wait.
        Jobs = "jobs",
        /// Bytes of inputs, as they are stored, of jobs that wait.
        Bytes = "bytes",
        /// Observations of jobs that wait.
        Observations = "observations",
        /// Jobs of one tenant that wait.
        TenantJobs = "tenant_jobs",
        /// Bytes of inputs of one tenant's jobs that wait.
        TenantBytes = "tenant_bytes",
        /// Bytes of one upload.
        UploadBytes = "upload_bytes",
        /// One tenant's uploads that are begun and not finished.
        TenantUploads = "tenant_uploads",
        /// Bytes of those and of the tenant's uploaded inputs.
        TenantUploadBytes = "tenant_upload_bytes",
        /// Bytes of memory of the jobs that one server solves at once.
        SolverBytes = "solver_bytes",
    }
}

impl Quota {
    /// Those of the queue.
    pub const OF_QUEUE: [Quota; 5] =
        [Quota::Jobs, Quota::Bytes, Quota::Observations, Quota::TenantJobs, Quota::TenantBytes];

    /// Those of uploads.
    pub const OF_UPLOADS: [Quota; 3] = [Quota::UploadBytes, Quota::TenantUploads, Quota::TenantUploadBytes];

    /// The key of the server's configuration that sets it.
    pub fn key(self) -> &'static str {
        match self {
            Quota::Jobs => "engine.queue_capacity",
            Quota::Bytes => "engine.queue_bytes",
            Quota::Observations => "engine.queue_observations",
            Quota::TenantJobs => "engine.tenant_queue_capacity",
            Quota::TenantBytes => "engine.tenant_queue_bytes",
            Quota::UploadBytes => "upload.max_bytes",
            Quota::TenantUploads => "upload.tenant_uploads",
            Quota::TenantUploadBytes => "upload.tenant_bytes",
            Quota::SolverBytes => "engine.max_solver_bytes",
        }
    }

    /// What it counts, for sentences.
    pub fn unit(self) -> &'static str {
        match self {
            Quota::Jobs | Quota::TenantJobs => "jobs",
            Quota::Bytes | Quota::TenantBytes => "bytes of input",
            Quota::Observations => "observations",
            Quota::UploadBytes | Quota::TenantUploadBytes => "bytes",
            Quota::TenantUploads => "uploads",
            Quota::SolverBytes => "bytes of memory",
        }
    }
}

/// What is more by itself than a bound allows, however empty the server is: to come back with it is of no use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Oversize {
    pub quota: Quota,
    pub asked: u64,
    pub max: u64,
}

impl fmt::Display for Oversize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { quota, asked, max } = self;
        let (unit, key) = (quota.unit(), quota.key());
        if Quota::OF_QUEUE.contains(quota) {
            let whose = if matches!(quota, Quota::TenantJobs | Quota::TenantBytes) { " of one tenant" } else { "" };
            write!(f, "{asked} {unit}{whose} in one batch never fit: {key} is {max} here; send fewer jobs at a time")
        } else if *quota == Quota::SolverBytes {
            write!(f, "a job of an estimated {asked} {unit} never fits: {key} is {max} here")
        } else {
            write!(f, "an upload of {asked} {unit} never fits: {key} is {max} here")
        }
    }
}
