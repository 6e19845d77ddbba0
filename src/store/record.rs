//! What goes into the store and what workers get from it.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use sha2::{Digest, Sha256};

use crate::domain::job::{Failure, Job, JobName, JobState, Summary};
use crate::domain::progress::Progress;
use crate::domain::{Oversize, Quota, SolveSettings};

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
    /// Whether the job depends on the call that creates it; see [`crate::store::Store::create_jobs`].
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

impl From<Vec<u8>> for JobInput {
    fn from(payload: Vec<u8>) -> Self {
        JobInput::Inline(payload)
    }
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

/// What a creation came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Created {
    pub job: Job,
    /// `false`: an earlier call with the same request id had made it.
    pub new: bool,
}

/// How much may wait at once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QueueBounds {
    pub max_jobs: u64,
    /// Encoded inputs.
    pub max_bytes: u64,
    pub max_observations: u64,
    /// Of one tenant alone.
    pub max_tenant_jobs: u64,
    /// Encoded inputs of one tenant alone.
    pub max_tenant_bytes: u64,
}

impl QueueBounds {
    /// Whether tenants have bounds of their own.
    pub fn has_tenant_bounds(&self) -> bool {
        self.max_tenant_jobs < u64::MAX || self.max_tenant_bytes < u64::MAX
    }

    /// The bound that these jobs break by themselves, however little waits: together they never fit.
    pub fn never_takes(&self, batch: &[&NewRecord]) -> Option<Oversize> {
        let mut whole = QueueStats::default();
        let mut tenants: BTreeMap<&str, QueueStats> = BTreeMap::new();
        for new in batch {
            whole.add(new);
            tenants.entry(&new.name.tenant).or_default().add(new);
        }
        // One job that waits alone may be of any size.
        let of_several = |stats: &QueueStats, amount| if stats.queued > 1 { amount } else { 0 };
        let of_tenant = |stats: &QueueStats| {
            first_broken([
                (Quota::TenantJobs, stats.queued, self.max_tenant_jobs),
                (Quota::TenantBytes, of_several(stats, stats.queued_bytes), self.max_tenant_bytes),
            ])
        };
        tenants.values().find_map(of_tenant).or_else(|| {
            first_broken([
                (Quota::Jobs, whole.queued, self.max_jobs),
                (Quota::Bytes, of_several(&whole, whole.queued_bytes), self.max_bytes),
                (Quota::Observations, of_several(&whole, whole.queued_observations), self.max_observations),
            ])
        })
    }

    /// The first bound that one more job would break: of the tenant's own, then of the whole queue's.
    pub fn refuses(&self, whole: &QueueStats, tenant: &QueueStats, bytes: u64, observations: u64) -> Option<Bound> {
        self.refuses_tenant(tenant, bytes).or_else(|| self.refuses_all(whole, bytes, observations))
    }

    fn refuses_tenant(&self, stats: &QueueStats, bytes: u64) -> Option<Bound> {
        if stats.queued >= self.max_tenant_jobs {
            Some(Bound { quota: Quota::TenantJobs, waiting: stats.queued, asked: 1, max: self.max_tenant_jobs })
        } else if stats.queued > 0 && stats.queued_bytes.saturating_add(bytes) > self.max_tenant_bytes {
            // As below: a tenant's job that waits alone always fits.
            let (waiting, max) = (stats.queued_bytes, self.max_tenant_bytes);
            Some(Bound { quota: Quota::TenantBytes, waiting, asked: bytes, max })
        } else {
            None
        }
    }

    fn refuses_all(&self, stats: &QueueStats, bytes: u64, observations: u64) -> Option<Bound> {
        if stats.queued >= self.max_jobs {
            return Some(Bound { quota: Quota::Jobs, waiting: stats.queued, asked: 1, max: self.max_jobs });
        }
        // A job alone in the queue always fits: what is too large for an empty queue is refused by the limits on
        // inputs.
        if stats.queued == 0 {
            None
        } else if stats.queued_bytes.saturating_add(bytes) > self.max_bytes {
            Some(Bound { quota: Quota::Bytes, waiting: stats.queued_bytes, asked: bytes, max: self.max_bytes })
        } else if stats.queued_observations.saturating_add(observations) > self.max_observations {
            let (waiting, max) = (stats.queued_observations, self.max_observations);
            Some(Bound { quota: Quota::Observations, waiting, asked: observations, max })
        } else {
            None
        }
    }
}

/// The bound of the queue that refused a job, or a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bound {
    pub quota: Quota,
    /// How much of it waits, without what was refused.
    pub waiting: u64,
    /// How much the call asked for.
    pub asked: u64,
    pub max: u64,
}

impl Bound {
    /// The same of a batch: `stored` are those of its jobs that were stored and count as waiting, and `rest` begins with
    /// the job that was refused.
    pub fn of_batch(self, stored: &[&NewRecord], rest: &[NewRecord]) -> Self {
        let of_tenant = matches!(self.quota, Quota::TenantJobs | Quota::TenantBytes);
        let tenant = rest.first().filter(|_| of_tenant).map(|refused| refused.name.tenant.as_str());
        let amount = |news: &mut dyn Iterator<Item = &NewRecord>| {
            let mut stats = QueueStats::default();
            news.filter(|new| tenant.is_none_or(|tenant| new.name.tenant == tenant)).for_each(|new| stats.add(new));
            match self.quota {
                Quota::Bytes | Quota::TenantBytes => stats.queued_bytes,
                Quota::Observations => stats.queued_observations,
                _ => stats.queued,
            }
        };
        let before = amount(&mut stored.iter().copied());
        let asked = before.saturating_add(amount(&mut rest.iter()));
        Self { waiting: self.waiting.saturating_sub(before), asked, ..self }
    }
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { quota, waiting, asked, max } = self;
        let (full, what) = match quota {
            Quota::TenantJobs => ("the tenant's share of the queue", "jobs"),
            Quota::TenantBytes => ("the tenant's share of the queue", "bytes of input"),
            Quota::Bytes => ("the queue", "bytes of input"),
            Quota::Observations => ("the queue", "observations"),
            _ => ("the queue", "jobs"),
        };
        write!(f, "{full} is full: {what} waiting: {waiting}, asked for: {asked}, allowed: {max}")
    }
}

/// What waits and what runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct QueueStats {
    pub queued: u64,
    pub queued_bytes: u64,
    pub queued_observations: u64,
    pub running: u64,
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
}

/// The first of these amounts, each with what is asked and what is allowed, that is more than allowed.
fn first_broken<const N: usize>(amounts: [(Quota, u64, u64); N]) -> Option<Oversize> {
    let broken = amounts.into_iter().find(|(_, asked, max)| asked > max);
    broken.map(|(quota, asked, max)| Oversize { quota, asked, max })
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

impl Claim {
    /// Of the next job alone, where all tenants have equal shares, by a process in which nothing else runs.
    pub fn one(worker: &str, lease_for: Duration) -> Self {
        Self {
            worker: worker.into(),
            lease_for,
            begin: None,
            prefetch: None,
            shares: Arc::default(),
            solved: Vec::new(),
            suspect_after: None,
        }
    }
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

/// What asking for a cancel came to.
#[derive(Debug, Clone, PartialEq)]
pub struct CancelReply {
    /// The job as it stands now.
    pub job: Job,
    /// Whether this call ended it.
    pub ended_now: bool,
}

/// What asking for a retry came to.
#[derive(Debug, Clone, PartialEq)]
pub struct RetryReply {
    /// The job as it stands now.
    pub job: Job,
    /// Whether this call put it into the queue.
    pub queued_now: bool,
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
