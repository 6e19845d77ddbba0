//! Jobs: their names, their state machine, their record and their events.

use std::collections::BTreeMap;
use std::fmt;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use super::input_name::InputName;
use super::progress::Progress;
use super::result::{Grade, Status};
use super::settings::{Proposal, SolveSettings};
use super::warning::Warning;
use super::webhook::Webhook;

/// Tenant of callers without an API key.
pub const DEFAULT_TENANT: &str = "default";

/// A job's resource name, `tenants/{tenant}/jobs/{job}`.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct JobName {
    pub tenant: String,
    pub job: String,
}

impl JobName {
    /// Longest tenant or job id, AIP-122's bound for a user-settable id.
    pub const MAX_ID_LENGTH: usize = 63;

    /// The name of that form; ids are 1 to 63 of `a-z`, `0-9` and `-`, and do not begin or end with `-`.
    pub fn parse(name: &str) -> Option<Self> {
        let mut parts = name.split('/');
        match (parts.next(), parts.next(), parts.next(), parts.next(), parts.next()) {
            (Some("tenants"), Some(tenant), Some("jobs"), Some(job), None)
                if Self::is_id(tenant) && Self::is_id(job) =>
            {
                Some(Self { tenant: tenant.into(), job: job.into() })
            }
            _ => None,
        }
    }

    /// Whether `id` may stand in a resource name.
    pub fn is_id(id: &str) -> bool {
        !id.is_empty()
            && id.len() <= Self::MAX_ID_LENGTH
            && !id.starts_with('-')
            && !id.ends_with('-')
            && id.bytes().all(|byte| matches!(byte, b'a'..=b'z' | b'0'..=b'9' | b'-'))
    }
}

impl fmt::Display for JobName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "tenants/{}/jobs/{}", self.tenant, self.job)
    }
}

scpsfm_core::named! {
    /// Where a job stands.
    pub enum JobState {
        /// Stored, waiting for a worker.
        Queued = "QUEUED",
        /// A worker holds the lease.
        Running = "RUNNING",
        Succeeded = "SUCCEEDED",
        Failed = "FAILED",
        Cancelled = "CANCELLED",
        /// The deadline passed before a result stood.
        DeadlineExceeded = "DEADLINE_EXCEEDED",
    }
}

impl JobState {
    /// Whether the job has ended: it changes no more, unless it is retried.
    pub fn is_terminal(self) -> bool {
        !matches!(self, JobState::Queued | JobState::Running)
    }

    /// Whether a job may go from this state to `next`. A running job returns to the queue when its worker gives the
    /// lease back or loses it, an ended one that has no result when it is retried.
    pub fn may_become(self, next: JobState) -> bool {
        match self {
            JobState::Queued => !matches!(next, JobState::Queued | JobState::Succeeded),
            JobState::Running => next != JobState::Running,
            JobState::Succeeded => false,
            JobState::Failed | JobState::Cancelled | JobState::DeadlineExceeded => next == JobState::Queued,
        }
    }
}

/// What a job answers in a line, without its arrays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    pub status: Status,
    pub grade: Option<Grade>,
    pub focal_px: Option<f64>,
    pub sigma_log_focal: Option<f64>,
    pub inlier_tracks: u32,
    pub registered_views: u32,
    pub reprojection_rms_px: Option<f64>,
    pub winning_proposal: Option<Proposal>,
    pub iterations: u32,
    pub seconds: f64,
    /// Size of the stored result in bytes; `ReadJobResult` streams about as much.
    pub result_size_bytes: u64,
    /// The result's first warnings, see [`Summary::warnings_of`]; of one without a reconstruction, why there is none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<Warning>,
}

impl Summary {
    /// Warnings in a summary at most; a result seldom has more, unless it has many camera groups.
    pub const MAX_WARNINGS: usize = 8;
    /// Longest detail of a warning in a summary, in characters: a page of a thousand jobs stays below a message's
    /// limit.
    pub const MAX_DETAIL_CHARS: usize = 400;

    /// So much of a result's warnings as a summary holds.
    pub fn warnings_of(warnings: &[Warning]) -> Vec<Warning> {
        let shortened = |warning: &Warning| {
            let mut detail: String = warning.detail.chars().take(Self::MAX_DETAIL_CHARS).collect();
            if detail.len() < warning.detail.len() {
                detail.push_str("...");
            }
            Warning { detail, ..warning.clone() }
        };
        warnings.iter().take(Self::MAX_WARNINGS).map(shortened).collect()
    }
}

/// Why a job failed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// Upper-case reason, stable for programs: `INTERNAL`, `ATTEMPTS_EXHAUSTED`.
    pub reason: String,
    pub message: String,
    /// Of a job that ran out of attempts: what became of each, oldest first; the latest ones where there were many.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub attempts: Vec<PastAttempt>,
}

impl Failure {
    /// A failure that needs no history.
    pub fn new(reason: &str, message: impl Into<String>) -> Self {
        Self { reason: reason.into(), message: message.into(), attempts: Vec::new() }
    }
}

/// An attempt that is over.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PastAttempt {
    /// Counted from 1.
    pub attempt: u32,
    /// The server process that made it.
    pub server: String,
    pub start_time: SystemTime,
    /// When it ended; of a lost one, when that was found.
    pub end_time: SystemTime,
    pub end: AttemptEnd,
}

scpsfm_core::named! {
    /// How an attempt ended.
    pub enum AttemptEnd {
        /// It ended its job.
        Ended = "ENDED",
        /// Its server gave the job back, as at a drain.
        GivenBack = "GIVEN_BACK",
        /// Its server was not heard of for the time of a lease, or its process died.
        Lost = "LOST",
    }
}

/// The `Solve` calls that a job depends on, counted over all servers of a store: it is cancelled once each of them was
/// disconnected. The calls of a server that died never detach, so that their job runs to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct AttachedCalls {
    /// Calls that have attached so far: the one that created the job, and later ones with its request id.
    pub attached: u64,
    /// Those of them that were disconnected since.
    pub detached: u64,
}

/// A job as its owner sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Job {
    pub name: JobName,
    pub state: JobState,
    /// Attempts begun so far; the fencing token of the one that runs.
    pub attempt: u32,
    pub settings: SolveSettings,
    /// The uploaded input that it was created with, be that still there or not; `None`: its input came with it.
    pub input: Option<InputName>,
    pub view_count: u32,
    pub track_count: u32,
    pub observation_count: u32,
    pub labels: BTreeMap<String, String>,
    /// Larger is sooner; 0 is the default.
    pub priority: i32,
    pub create_time: SystemTime,
    /// When the first attempt began, of those since the last retry.
    pub start_time: Option<SystemTime>,
    pub end_time: Option<SystemTime>,
    /// A job without a result at this time expires.
    pub deadline: Option<SystemTime>,
    /// The latest progress, at most half a second old while running.
    pub progress: Option<Progress>,
    /// Sequence number of the latest event.
    pub last_sequence: u64,
    pub summary: Option<Summary>,
    pub failure: Option<Failure>,
    /// A cancel was asked for and has not yet reached the worker.
    pub cancel_requested: bool,
    /// The calls that it is cancelled without; `None`: it does not depend on any caller.
    pub attached_calls: Option<AttachedCalls>,
    /// When an ended job is removed; `None` while it has not ended, or where it is kept for good.
    pub expire_time: Option<SystemTime>,
    /// Where its end is sent.
    pub webhook: Option<Webhook>,
}

impl Job {
    /// Changes whenever the job does, but for its latest progress and its webhook: another one after each event and
    /// each change of `attached_calls` or of the priority, and another job's of the same name, which was created at
    /// another time, is another.
    pub fn etag(&self) -> String {
        let created = self.create_time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_micros();
        let cancels = u8::from(self.cancel_requested);
        let mut etag = format!("{created:x}-{:x}-{cancels}-{}", self.last_sequence, self.priority);
        if let Some(AttachedCalls { attached, detached }) = self.attached_calls {
            etag.push_str(&format!("-{attached:x}-{detached:x}"));
        }
        etag
    }
}

/// Something that happened to a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JobEvent {
    pub job: JobName,
    /// 0 before the first attempt.
    pub attempt: u32,
    /// Strictly increasing within a job, from 1. `None` for interim weights, which are latest-only and not replayed.
    pub sequence: Option<u64>,
    pub time: SystemTime,
    pub body: EventBody,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum EventBody {
    /// The job entered a state; a failure carries its reason.
    State {
        state: JobState,
        failure: Option<Failure>,
    },
    Progress(Progress),
    /// Interim weights, one per track.
    Weights {
        iteration: u32,
        weights: Vec<f32>,
    },
    /// The result stands and can be read; always followed by the terminal state.
    Summary(Summary),
}

#[cfg(test)]
mod tests {
    use super::{JobName, JobState};

    #[test]
    fn names_round_trip_and_bad_names_are_refused() {
        let name = JobName::parse("tenants/default/jobs/a-1").expect("valid");
        assert_eq!(name.to_string(), "tenants/default/jobs/a-1");
        for bad in ["", "tenants/a/jobs/", "tenants/A/jobs/b", "tenants/a/jobs/b/c", "jobs/b", "tenants/a/jobs/-b"] {
            assert_eq!(JobName::parse(bad), None, "{bad}");
        }
    }

    #[test]
    fn an_ended_job_goes_on_by_a_retry_alone_and_names_round_trip() {
        for state in JobState::ALL {
            assert_eq!(JobState::from_name(state.name()), Some(state));
            let next: Vec<_> = JobState::ALL.into_iter().filter(|&next| state.may_become(next)).collect();
            match state {
                JobState::Succeeded => assert_eq!(next, []),
                _ if state.is_terminal() => assert_eq!(next, [JobState::Queued], "{}", state.name()),
                _ => assert!(next.len() > 1, "{}", state.name()),
            }
        }
    }
}
