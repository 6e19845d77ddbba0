//! What goes into the store and what workers get from it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use sha2::{Digest, Sha256};

use crate::domain::SolveSettings;
use crate::domain::job::{Failure, Job, JobName, JobState, Summary};
use crate::domain::progress::Progress;

/// A job to be stored.
#[derive(Debug, Clone)]
pub struct NewRecord {
    pub name: JobName,
    pub request: Option<Request>,
    pub input: JobInput,
    pub view_count: u32,
    pub track_count: u32,
    pub observation_count: u32,
    pub settings: SolveSettings,
    pub deadline: Option<SystemTime>,
    pub priority: i32,
    pub labels: BTreeMap<String, String>,
    /// W3C `traceparent` of the call that created the job, so that its trace goes on after a restart.
    pub trace_parent: Option<String>,
    /// Whether the job depends on the call that creates it; see `Store::create_jobs`.
    pub cancel_on_disconnect: bool,
    /// Where the job's end is to be sent.
    pub webhook_url: Option<String>,
}

/// What a job works on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum JobInput {
    /// Encoded [`crate::domain::Input`], see [`super::payload`].
    Inline(Vec<u8>),
    /// An uploaded input of the job's tenant, by its id, with the length of its payload.
    Uploaded { input: String, bytes: u64 },
}

impl JobInput {
    /// The id of the uploaded input, where it is one.
    pub fn uploaded(&self) -> Option<&str> {
        match self {
            JobInput::Inline(_) => None,
            JobInput::Uploaded { input, .. } => Some(input),
        }
    }

    /// Length of the encoded input.
    pub fn bytes(&self) -> u64 {
        match self {
            JobInput::Inline(bytes) => bytes.len() as u64,
            JobInput::Uploaded { bytes, .. } => *bytes,
        }
    }
}

/// A request id of the job's tenant, with the digest of the body that it stands for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    pub id: String,
    /// SHA-256.
    pub digest: [u8; 32],
}

/// Answer to a call that creates, cancels or retries a job; an earlier call may have done so.
#[derive(Debug, Clone, PartialEq)]
pub struct ChangeReply {
    /// The job as it stands now.
    pub job: Job,
    /// Whether this call made the change: it created the job, ended it, or put it into the queue.
    pub by_this_call: bool,
}

/// What waits in the queue.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct QueueStats {
    pub queued: u64,
    pub queued_bytes: u64,
    pub queued_observations: u64,
    /// Whether claims find nothing of it.
    pub paused: bool,
}

/// What operators watch; it takes longer to count than [`QueueStats`].
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct StoreStats {
    /// Bytes that the store takes.
    pub bytes: u64,
    /// When the job that waits longest entered the queue; `None`: none waits.
    pub oldest_queue_time: Option<SystemTime>,
    /// The tenants that have jobs which wait or run.
    pub tenants: Vec<TenantQueue>,
}

impl QueueStats {
    /// One more job waits.
    pub fn add(&mut self, new: &NewRecord) {
        self.queued += 1;
        self.queued_bytes = self.queued_bytes.saturating_add(new.input.bytes());
        self.queued_observations = self.queued_observations.saturating_add(u64::from(new.observation_count));
    }

    /// Of these jobs.
    pub fn of<'a>(news: impl IntoIterator<Item = &'a NewRecord>) -> Self {
        let mut stats = Self::default();
        news.into_iter().for_each(|new| stats.add(new));
        stats
    }
}

/// How tenants share the workers.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TenantShares {
    /// Jobs that a tenant begins for each that one of weight 1 begins, while both have some waiting; 1 for those that
    /// are not named.
    pub weights: BTreeMap<String, u32>,
    /// Jobs of one tenant that run at once at most.
    pub max_running: Option<u32>,
}

impl TenantShares {
    /// Of a tenant, at least 1.
    pub fn weight(&self, tenant: &str) -> u32 {
        self.weights.get(tenant).copied().unwrap_or(1).max(1)
    }
}

/// What a worker asks the queue for.
#[derive(Debug, Clone)]
pub struct Claim {
    /// The process that asks.
    pub worker: String,
    /// How long the job that is begun is leased for.
    pub lease_for: Duration,
    /// The job to begin: one that an earlier claim prefetched, with its time of creation, which tells it from a later
    /// job of the same name. `None`: the next one in the queue.
    pub begin: Option<(Lease, SystemTime)>,
    /// Where one is begun, the one after it is leased too; `None`: no other one.
    pub prefetch: Option<Prefetch>,
    pub shares: Arc<TenantShares>,
    /// Leases of jobs that are solved and whose end is not stored yet: they do not count for the bound on running jobs,
    /// for whose place this claim is made.
    pub solved: Vec<Lease>,
    /// Lost attempts from which on a job is a suspect, which is leased, not begun. `None`: nothing else runs in the
    /// process, so that a suspect may be begun.
    pub suspect_after: Option<u32>,
}

/// A job that is leased ahead of its begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Prefetch {
    /// How long other claims pass over it.
    pub lease_for: Duration,
    /// None larger is leased ahead.
    pub max_observations: u32,
}

/// What a claim came to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Claims {
    /// It is running.
    pub begun: Option<Claimed>,
    /// It is queued. Its lease is that of the attempt which a later claim is to begin.
    pub prefetched: Option<Claimed>,
    /// It is queued and leased as a prefetched one, for a later claim by a process in which nothing else runs. None is
    /// begun or prefetched beside it.
    pub suspect: Option<Claimed>,
}

/// The right to write to a running job. `attempt` is the fencing token: a later lease has a larger one.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Lease {
    pub name: JobName,
    pub attempt: u32,
}

/// A job in a worker's hands.
#[derive(Debug, Clone, PartialEq)]
pub struct Claimed {
    pub job: Job,
    pub lease: Lease,
    pub trace_parent: Option<String>,
    /// When the job last entered the queue.
    pub queue_time: SystemTime,
}

/// What a worker reads of a claimed job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobPayload {
    /// Encoded [`crate::domain::Input`], see [`super::payload`].
    pub input: Vec<u8>,
    pub cancel_requested: bool,
}

/// What a heartbeat brings back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Heartbeat {
    pub cancel_requested: bool,
    pub deadline: Option<SystemTime>,
}

/// The end of an attempt and of its job.
#[derive(Debug, Clone)]
pub struct Ending {
    pub outcome: Outcome,
    /// The last progress, where it is newer than what was recorded; it goes into the job, not among the events.
    pub progress: Option<Progress>,
}

/// A result as it is read: encoded once, by the server that solved the job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedResult {
    pub bytes: Vec<u8>,
    pub sha256: [u8; 32],
}

impl EncodedResult {
    /// Of these bytes, which are hashed here.
    pub fn new(bytes: Vec<u8>) -> Self {
        Self { sha256: Sha256::digest(&bytes).into(), bytes }
    }

    /// Whether the bytes are those of the digest.
    pub fn is_intact(&self) -> bool {
        <[u8; 32]>::from(Sha256::digest(&self.bytes)) == self.sha256
    }
}

/// How a job ended.
#[derive(Debug, Clone)]
pub enum Outcome {
    Succeeded { summary: Summary, result: EncodedResult },
    Failed(Failure),
    Cancelled,
    DeadlineExceeded,
}

impl Outcome {
    /// The state that the job ends in.
    pub fn state(&self) -> JobState {
        match self {
            Self::Succeeded { .. } => JobState::Succeeded,
            Self::Failed(_) => JobState::Failed,
            Self::Cancelled => JobState::Cancelled,
            Self::DeadlineExceeded => JobState::DeadlineExceeded,
        }
    }
}

/// The queue as its administrator sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QueueReport {
    /// Since when it is paused; `None`: it is not.
    pub pause_time: Option<SystemTime>,
    /// How many jobs are in each state.
    pub jobs: [(JobState, u64); JobState::ALL.len()],
    /// The job that has waited longest, and since when.
    pub oldest: Option<(JobName, SystemTime)>,
    /// Tenants with jobs that wait or run: those with the most waiting jobs first.
    pub tenants: Vec<TenantQueue>,
}

/// What one tenant has in the queue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TenantQueue {
    pub tenant: String,
    pub queued: u64,
    pub running: u64,
}

/// What a sweep changed; the jobs as they stand now.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Swept {
    /// Their leases had run out: queued again, or ended.
    pub lost: Vec<Job>,
    /// They had waited past their deadline.
    pub expired: Vec<Job>,
}

/// What is to be sent to webhooks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WebhookQueue {
    /// Ends of jobs that were neither accepted nor given up.
    pub pending: u64,
    /// Whether an attempt at one of them is due.
    pub is_due: bool,
}

/// Whose webhooks are passed over: as many attempts at them are under way as may be.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PassedOver {
    pub hosts: Vec<String>,
    pub tenants: Vec<String>,
}

/// What an attempt at a webhook came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum WebhookOutcome {
    Delivered,
    /// It failed, and the next attempt is due after that time.
    Retry {
        error: String,
        after: Duration,
    },
    /// It failed, and was the last one.
    GivenUp {
        error: String,
    },
}
