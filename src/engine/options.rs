//! How an engine works.

use std::sync::Arc;
use std::time::Duration;

use super::limits;
use super::upload::UploadOptions;
use super::webhooks::Options as WebhookOptions;
use crate::domain::Backend;
use crate::parallel::Threads;
use crate::store::{Clock, QueueBounds, TenantShares};

/// How an engine works.
#[derive(Debug, Clone)]
pub struct Options {
    /// Worker threads, one job each; at least one is started.
    pub workers: usize,
    /// What may wait at once.
    pub queue: QueueBounds,
    /// How tenants share the workers.
    pub shares: Arc<TenantShares>,
    /// How long a worker may be silent before its job is taken from it; held to
    /// [`Options::MIN_LEASE`]..=[`Options::MAX_LEASE`].
    pub lease: Duration,
    /// Attempts that may be lost before a job fails.
    pub max_attempts: u32,
    /// Bytes of memory that the jobs which run at once are estimated to take together.
    pub max_solver_bytes: u64,
    pub uploads: UploadOptions,
    /// How long ended jobs are kept, and uploaded inputs that no job has; `None`: for good.
    pub retention: Option<Duration>,
    /// Jobs that are solved in less than this are short: behind one the next, which is prefetched, is begun at once.
    /// Zero: none is prefetched.
    pub short_job: Duration,
    /// Tells this process apart in the store.
    pub worker_name: String,
    /// Backend of jobs that name none; stored with the job, so that a restart under another one changes nothing.
    pub backend: Backend,
    /// What tells the time of all that is stored.
    pub clock: Clock,
    /// `None`: a job that names a webhook is refused, and none is sent.
    pub webhooks: Option<WebhookOptions>,
}

impl Options {
    /// Jobs that may wait: at about 3 s a job, what a 4-core server works off in some three minutes; beyond, a caller
    /// does better to come back than to wait.
    pub const DEFAULT_MAX_JOBS: u64 = 256;
    /// Encoded inputs that may wait: ten of the largest, on a disk that should not fill up unseen.
    pub const DEFAULT_MAX_BYTES: u64 = 1 << 30;
    /// Observations that may wait: four of the largest inputs, what a server can work off before its callers give up.
    pub const DEFAULT_MAX_OBSERVATIONS: u64 = 16_000_000;
    /// Several missed heartbeats, so that a busy disk loses no lease, and still a short wait after a crash.
    pub const DEFAULT_LEASE: Duration = Duration::from_secs(15);
    /// One crash may be the machine's fault, two a coincidence; three are the job's.
    pub const DEFAULT_MAX_ATTEMPTS: u32 = 3;
    /// Shorter leases would be lost to a slow disk's commit, and keep it busy with heartbeats.
    pub const MIN_LEASE: Duration = Duration::from_millis(100);
    /// Longer ones would leave the job of a dead worker lying for good.
    pub const MAX_LEASE: Duration = Duration::from_secs(24 * 60 * 60);
    /// A month: whoever wants a result has fetched it by then.
    pub const DEFAULT_RETENTION: Duration = Duration::from_secs(30 * 24 * 60 * 60);
    /// What passes between two jobs, a commit of the store and a dozen wake-ups, takes some 3 ms: a large part of jobs
    /// of 10 ms, and less than a thirtieth of those beyond.
    pub const DEFAULT_SHORT_JOB: Duration = Duration::from_millis(100);

    /// Three quarters of the memory of the machine or container, where the system tells: the rest is for calls, the
    /// store and the program.
    pub fn default_solver_bytes() -> u64 {
        limits::memory_bytes().map_or(u64::MAX, |bytes| bytes / 4 * 3)
    }
}

impl Default for Options {
    /// One worker a core.
    fn default() -> Self {
        Self {
            workers: Threads::one_a_core().count(),
            queue: QueueBounds {
                max_jobs: Self::DEFAULT_MAX_JOBS,
                max_bytes: Self::DEFAULT_MAX_BYTES,
                max_observations: Self::DEFAULT_MAX_OBSERVATIONS,
                // Without API keys there is one tenant, and nobody to keep room for.
                max_tenant_jobs: u64::MAX,
                max_tenant_bytes: u64::MAX,
            },
            shares: Arc::default(),
            uploads: UploadOptions::default(),
            lease: Self::DEFAULT_LEASE,
            max_attempts: Self::DEFAULT_MAX_ATTEMPTS,
            max_solver_bytes: Self::default_solver_bytes(),
            retention: Some(Self::DEFAULT_RETENTION),
            short_job: Self::DEFAULT_SHORT_JOB,
            worker_name: worker_name(),
            backend: Backend::default(),
            clock: Clock::default(),
            webhooks: None,
        }
    }
}

/// This process among those of every server on a store: the machine's name, which a container has of its own, and the
/// process id.
fn worker_name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").or_else(|_| std::env::var("HOSTNAME"));
    let host = host.map_or_else(|_| "process".into(), |host| host.trim().to_owned());
    format!("{host}-{}", std::process::id())
}
