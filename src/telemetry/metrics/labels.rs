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

/// What has a rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RateBound {
    /// Calls of a key.
    Calls,
    /// New jobs of a tenant.
    Jobs,
}

impl RateBound {
    const ALL: [RateBound; 2] = [RateBound::Calls, RateBound::Jobs];

    /// Its name to callers and in metrics.
    pub fn name(self) -> &'static str {
        match self {
            RateBound::Calls => "calls",
            RateBound::Jobs => "jobs",
        }
    }

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

/// Why a request over HTTP was refused before it became a call of the API. Requests that find no memory are counted
/// by [`Refusal::Memory`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HttpRefusal {
    /// A page of another site sends it.
    Origin,
    /// It is for a host that the server does not know.
    Host,
    /// There is nothing at its path.
    Path,
    /// What is at its path is not for this method.
    Method,
    /// It has no key, or an unknown one.
    Unauthenticated,
    /// Its body is of another kind than JSON.
    MediaType,
    /// An upload that does not tell its length.
    Length,
    /// Its body is longer than it may be.
    TooLarge,
    /// Its body did not come in time.
    Stalled,
    /// Its JSON, its query or its path breaks a rule.
    Invalid,
}

impl HttpRefusal {
    pub(super) const ALL: [HttpRefusal; 10] = [
        HttpRefusal::Origin,
        HttpRefusal::Host,
        HttpRefusal::Path,
        HttpRefusal::Method,
        HttpRefusal::Unauthenticated,
        HttpRefusal::MediaType,
        HttpRefusal::Length,
        HttpRefusal::TooLarge,
        HttpRefusal::Stalled,
        HttpRefusal::Invalid,
    ];

    /// The label, and the reason that its caller is told but for keys, which have two.
    pub fn reason(self) -> &'static str {
        match self {
            HttpRefusal::Origin => "ORIGIN_REFUSED",
            HttpRefusal::Host => "HOST_REFUSED",
            HttpRefusal::Path => "PATH_NOT_FOUND",
            HttpRefusal::Method => "METHOD_NOT_ALLOWED",
            HttpRefusal::Unauthenticated => "UNAUTHENTICATED",
            HttpRefusal::MediaType => "UNSUPPORTED_MEDIA_TYPE",
            HttpRefusal::Length => "LENGTH_REQUIRED",
            HttpRefusal::TooLarge => "MESSAGE_TOO_LARGE",
            HttpRefusal::Stalled => "INPUT_STALLED",
            HttpRefusal::Invalid => "INVALID_ARGUMENT",
        }
    }
}

/// Why a job was deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Deletion {
    /// Its owner asked for it.
    Requested,
    /// It was kept long enough.
    Retention,
}

impl Deletion {
    pub(super) const ALL: [Deletion; 2] = [Deletion::Requested, Deletion::Retention];

    pub(super) fn name(self) -> &'static str {
        match self {
            Deletion::Requested => "REQUESTED",
            Deletion::Retention => "RETENTION",
        }
    }
}

/// Files that are read again when they change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reloaded {
    /// The server's certificate, its key and the authorities of its clients.
    Certificates,
    /// The API keys.
    Keys,
}

impl Reloaded {
    pub(super) const ALL: [Reloaded; 2] = [Reloaded::Certificates, Reloaded::Keys];

    pub(super) fn name(self) -> &'static str {
        match self {
            Reloaded::Certificates => "CERTIFICATES",
            Reloaded::Keys => "KEYS",
        }
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

/// Why an upload was given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GivenUp {
    /// Nothing came for too long.
    Abandoned,
    /// Its bytes do not have the SHA-256 that its caller named.
    WrongHash,
    /// Its bytes are no valid input.
    Invalid,
}

impl GivenUp {
    pub(super) const ALL: [GivenUp; 3] = [GivenUp::Abandoned, GivenUp::WrongHash, GivenUp::Invalid];

    pub(super) fn name(self) -> &'static str {
        match self {
            GivenUp::Abandoned => "ABANDONED",
            GivenUp::WrongHash => "WRONG_HASH",
            GivenUp::Invalid => "INVALID",
        }
    }
}

/// What an attempt at a webhook came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WebhookAttempt {
    /// The receiver accepted it.
    Delivered,
    /// It is made again.
    Failed,
    /// It failed, and was the last one.
    GivenUp,
}

impl WebhookAttempt {
    pub(super) const ALL: [WebhookAttempt; 3] =
        [WebhookAttempt::Delivered, WebhookAttempt::Failed, WebhookAttempt::GivenUp];

    pub(super) fn name(self) -> &'static str {
        match self {
            WebhookAttempt::Delivered => "DELIVERED",
            WebhookAttempt::Failed => "FAILED",
            WebhookAttempt::GivenUp => "GIVEN_UP",
        }
    }
}

/// How an attempt ended that did not end its job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttemptLost {
    /// Given back to the queue at a drain.
    GivenBack,
    /// Another worker took the lease over; the outcome was dropped.
    Fenced,
    /// The lease ran out without a heartbeat: the process that held it died.
    LeaseExpired,
}

impl AttemptLost {
    pub(super) const ALL: [AttemptLost; 3] = [AttemptLost::GivenBack, AttemptLost::Fenced, AttemptLost::LeaseExpired];

    pub(super) fn name(self) -> &'static str {
        match self {
            AttemptLost::GivenBack => "GIVEN_BACK",
            AttemptLost::Fenced => "FENCED",
            AttemptLost::LeaseExpired => "LEASE_EXPIRED",
        }
    }
}

/// Label of the grade of a result.
pub(super) fn grade_name(grade: Option<Grade>) -> &'static str {
    match grade {
        Some(Grade::Metric) => "METRIC",
        Some(Grade::Weak) => "WEAK",
        Some(Grade::ProjectiveOnly) => "PROJECTIVE_ONLY",
        None => NONE,
    }
}
