//! The values of labels that say why something happened.

use crate::domain::{Grade, Quota};

/// Label of a succeeded job without a reconstruction, of an attempt that ended no job, and of a refusal by no bound.
pub(super) const NONE: &str = "NONE";

/// Why a job was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// As much of this waits as may.
    QueueFull(Quota),
    /// The batch alone has more of this than may ever wait.
    BatchTooLarge(Quota),
    /// Input or settings broke a rule.
    Invalid,
    /// The input is above the advertised limits.
    TooLarge,
    /// The job alone takes more memory than those that run may take together.
    JobTooLarge,
    /// The server is draining.
    Draining,
    /// The calls under way hold as many bytes as they may.
    Memory,
    /// A key calls, or a tenant creates jobs, more often than it may.
    RateLimited(RateBound),
}

scpsfm_core::named! {
    /// What has a rate.
    pub enum RateBound {
        /// Calls of a key.
        Calls = "calls",
        /// New jobs of a tenant.
        Jobs = "jobs",
    }
}

impl RateBound {
    /// The key of the configuration that sets it.
    pub fn key(self) -> &'static str {
        match self {
            RateBound::Calls => "rates.calls_per_second",
            RateBound::Jobs => "rates.jobs_per_second",
        }
    }
}

impl Refusal {
    pub(super) fn all() -> impl Iterator<Item = Refusal> {
        let by_bound =
            Quota::OF_QUEUE.into_iter().flat_map(|quota| [Refusal::QueueFull(quota), Refusal::BatchTooLarge(quota)]);
        let by_rate = RateBound::ALL.into_iter().map(Refusal::RateLimited);
        by_bound.chain(by_rate).chain([
            Refusal::Invalid,
            Refusal::TooLarge,
            Refusal::JobTooLarge,
            Refusal::Draining,
            Refusal::Memory,
        ])
    }

    pub(super) fn reason(self) -> &'static str {
        match self {
            Refusal::QueueFull(_) => "QUEUE_FULL",
            Refusal::BatchTooLarge(_) => "BATCH_TOO_LARGE",
            Refusal::Invalid => "INVALID",
            Refusal::TooLarge => "TOO_LARGE",
            Refusal::JobTooLarge => "JOB_TOO_LARGE",
            Refusal::Draining => "DRAINING",
            Refusal::Memory => "MEMORY",
            Refusal::RateLimited(_) => "RATE_LIMITED",
        }
    }

    /// The bound that was hit; `NONE` where it was none.
    pub(super) fn bound(self) -> &'static str {
        match self {
            Refusal::QueueFull(quota) | Refusal::BatchTooLarge(quota) => quota.name(),
            Refusal::RateLimited(bound) => bound.name(),
            Refusal::JobTooLarge => Quota::SolverBytes.name(),
            Refusal::Invalid | Refusal::TooLarge | Refusal::Draining | Refusal::Memory => NONE,
        }
    }
}

/// Why an upload was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UploadRefusal {
    /// The tenant has as much of this as it may.
    Full(Quota),
    /// The upload alone has more of this than may ever be.
    TooLarge(Quota),
}

impl UploadRefusal {
    pub(super) const ALL: [UploadRefusal; 4] = [
        UploadRefusal::Full(Quota::TenantUploads),
        UploadRefusal::Full(Quota::TenantUploadBytes),
        UploadRefusal::TooLarge(Quota::UploadBytes),
        UploadRefusal::TooLarge(Quota::TenantUploadBytes),
    ];

    pub(super) fn reason(self) -> &'static str {
        match self {
            UploadRefusal::Full(_) => "UPLOADS_FULL",
            UploadRefusal::TooLarge(_) => "UPLOAD_TOO_LARGE",
        }
    }

    pub(super) fn bound(self) -> &'static str {
        match self {
            UploadRefusal::Full(quota) | UploadRefusal::TooLarge(quota) => quota.name(),
        }
    }
}

scpsfm_core::named! {
    /// Why a request over HTTP was refused before it became a call of the API. Requests that find no memory are counted
    /// by [`Refusal::Memory`]. The names are the reasons that callers are told, but for keys, which have two.
    pub enum HttpRefusal {
        /// A page of another site sends it.
        Origin = "ORIGIN_REFUSED",
        /// It is for a host that the server does not know.
        Host = "HOST_REFUSED",
        /// There is nothing at its path.
        Path = "PATH_NOT_FOUND",
        /// What is at its path is not for this method.
        Method = "METHOD_NOT_ALLOWED",
        /// It has no key, or an unknown one.
        Unauthenticated = "UNAUTHENTICATED",
        /// Its body is of another kind than JSON.
        MediaType = "UNSUPPORTED_MEDIA_TYPE",
        /// An upload that does not tell its length.
        Length = "LENGTH_REQUIRED",
        /// Its body is longer than it may be.
        TooLarge = "MESSAGE_TOO_LARGE",
        /// Its body did not come in time.
        Stalled = "INPUT_STALLED",
        /// Its JSON, its query or its path breaks a rule.
        Invalid = "INVALID_ARGUMENT",
    }
}

scpsfm_core::named! {
    /// Why a job was deleted.
    pub enum Deletion {
        /// Its owner asked for it.
        Requested = "REQUESTED",
        /// It was kept long enough.
        Retention = "RETENTION",
    }
}

scpsfm_core::named! {
    /// Files that are read again when they change.
    pub enum Reloaded {
        /// The server's certificate, its key and the authorities of its clients.
        Certificates = "CERTIFICATES",
        /// The API keys.
        Keys = "KEYS",
    }
}

impl std::fmt::Display for Reloaded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Reloaded::Certificates => "certificates",
            Reloaded::Keys => "API keys",
        })
    }
}

scpsfm_core::named! {
    /// Why an upload was given up.
    pub enum GivenUp {
        /// Nothing came for too long.
        Abandoned = "ABANDONED",
        /// Its bytes do not have the SHA-256 that its caller named.
        WrongHash = "WRONG_HASH",
        /// Its bytes are no valid input.
        Invalid = "INVALID",
    }
}

scpsfm_core::named! {
    /// What an attempt at a webhook came to.
    pub enum WebhookAttempt {
        /// The receiver accepted it.
        Delivered = "DELIVERED",
        /// It is made again.
        Failed = "FAILED",
        /// It failed, and was the last one.
        GivenUp = "GIVEN_UP",
    }
}

scpsfm_core::named! {
    /// How an attempt ended that did not end its job.
    pub enum AttemptLost {
        /// Given back to the queue at a drain.
        GivenBack = "GIVEN_BACK",
        /// Another worker took the lease over; the outcome was dropped.
        Fenced = "FENCED",
        /// The lease ran out without a heartbeat: the process that held it died.
        LeaseExpired = "LEASE_EXPIRED",
    }
}

/// Label of the grade of a result.
pub(super) fn grade_name(grade: Option<Grade>) -> &'static str {
    grade.map_or(NONE, Grade::name)
}
