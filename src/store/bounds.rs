//! How much may wait in the queue, how much a tenant may upload, and the bound that refuses more.

use std::collections::BTreeMap;
use std::fmt;

use super::record::{NewRecord, QueueStats};
use crate::domain::{Oversize, Quota};

/// The queue's bounds on one tenant.
const OF_TENANT: [Quota; 2] = [Quota::TenantJobs, Quota::TenantBytes];

/// The queue's bounds on all tenants together.
const OF_ALL: [Quota; 3] = [Quota::Jobs, Quota::Bytes, Quota::Observations];

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
        let mut tenants: BTreeMap<&str, QueueStats> = BTreeMap::new();
        batch.iter().for_each(|new| tenants.entry(&new.name.tenant).or_default().add(new));
        let nothing = QueueStats::default();
        let broken = tenants.values().find_map(|asked| self.first_broken(&OF_TENANT, &nothing, asked));
        let whole = QueueStats::of(batch.iter().copied());
        let Bound { quota, asked, max, .. } = broken.or_else(|| self.first_broken(&OF_ALL, &nothing, &whole))?;
        Some(Oversize { quota, asked, max })
    }

    /// The first bound that what is asked for would break: of the tenant's own, then of the whole queue's.
    pub fn refuses(&self, whole: &QueueStats, tenant: &QueueStats, asked: &QueueStats) -> Option<Bound> {
        let of_tenant = self.first_broken(&OF_TENANT, tenant, asked);
        of_tenant.or_else(|| self.first_broken(&OF_ALL, whole, asked))
    }

    /// A job that waits alone may be of any size: what is too large for an empty queue is refused by the limits on
    /// inputs.
    fn first_broken(&self, quotas: &[Quota], waiting: &QueueStats, asked: &QueueStats) -> Option<Bound> {
        let is_alone = waiting.queued + asked.queued <= 1;
        let bound =
            |&quota| Bound { quota, taken: amount(waiting, quota), asked: amount(asked, quota), max: self.max(quota) };
        let counts = |bound: &Bound| !is_alone || matches!(bound.quota, Quota::Jobs | Quota::TenantJobs);
        quotas.iter().map(bound).find(|bound| bound.is_broken() && counts(bound))
    }

    fn max(&self, quota: Quota) -> u64 {
        match quota {
            Quota::Bytes => self.max_bytes,
            Quota::Observations => self.max_observations,
            Quota::TenantJobs => self.max_tenant_jobs,
            Quota::TenantBytes => self.max_tenant_bytes,
            _ => self.max_jobs,
        }
    }
}

/// How much of what this bound is on.
fn amount(stats: &QueueStats, quota: Quota) -> u64 {
    match quota {
        Quota::Bytes | Quota::TenantBytes => stats.queued_bytes,
        Quota::Observations => stats.queued_observations,
        _ => stats.queued,
    }
}

/// How much one tenant may upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UploadBounds {
    /// Of one upload.
    pub max_bytes: u64,
    /// Uploads that are begun and not finished.
    pub max_tenant_uploads: u64,
    /// Lengths of those as they were declared, and of the uploaded inputs that are kept as they were uploaded, also of
    /// those that were deleted and that jobs still have. What is stored of an input takes about 1.3 times as much.
    pub max_tenant_bytes: u64,
}

impl UploadBounds {
    /// The bound that an upload of so many bytes breaks by itself, however little the tenant has: it never fits.
    pub fn never_takes(&self, bytes: u64) -> Option<Oversize> {
        [(Quota::UploadBytes, self.max_bytes), (Quota::TenantUploadBytes, self.max_tenant_bytes)]
            .into_iter()
            .find(|(_, max)| bytes > *max)
            .map(|(quota, max)| Oversize { quota, asked: bytes, max })
    }

    /// The bound that one more upload would break, where so many are open and so many bytes are taken.
    pub fn refuses(&self, open: u64, taken_bytes: u64, bytes: u64) -> Option<Bound> {
        let uploads = Bound { quota: Quota::TenantUploads, taken: open, asked: 1, max: self.max_tenant_uploads };
        let quota = Quota::TenantUploadBytes;
        let bytes = Bound { quota, taken: taken_bytes, asked: bytes, max: self.max_tenant_bytes };
        [uploads, bytes].into_iter().find(Bound::is_broken)
    }
}

/// The bound that refused a job, a batch or an upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bound {
    pub quota: Quota,
    /// How much of it there is, without what was refused.
    pub taken: u64,
    /// How much the call asked for.
    pub asked: u64,
    pub max: u64,
}

impl Bound {
    fn is_broken(&self) -> bool {
        self.taken.saturating_add(self.asked) > self.max
    }

    /// The same of a batch: `stored` are those of its jobs that were stored and count as waiting, and `rest` begins with
    /// the job that was refused.
    pub fn of_batch(self, stored: &[&NewRecord], rest: &[NewRecord]) -> Self {
        let of_tenant = OF_TENANT.contains(&self.quota);
        let tenant = rest.first().filter(|_| of_tenant).map(|refused| &refused.name.tenant);
        let counts = |new: &&NewRecord| tenant.is_none_or(|tenant| new.name.tenant == *tenant);
        let before = amount(&QueueStats::of(stored.iter().copied().filter(counts)), self.quota);
        let asked = before.saturating_add(amount(&QueueStats::of(rest.iter().filter(counts)), self.quota));
        Self { taken: self.taken.saturating_sub(before), asked, ..self }
    }
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { quota, taken, asked, max } = self;
        let full = match quota {
            Quota::TenantUploads => {
                let rule = "uploads of the tenant are open: finish one, or let it expire";
                return write!(f, "{taken} of at most {max} {rule}");
            }
            Quota::TenantUploadBytes => {
                return write!(
                    f,
                    "{asked} bytes more are too many: the tenant's uploads and uploaded inputs take {taken} of at most \
                     {max} bytes; delete inputs that no job needs any more (`scpsfm inputs`, `scpsfm delete --input`), \
                     or have `upload.tenant_bytes` raised"
                );
            }
            Quota::TenantJobs | Quota::TenantBytes => "the tenant's share of the queue",
            _ => "the queue",
        };
        write!(f, "{full} is full: {} waiting: {taken}, asked for: {asked}, allowed: {max}", quota.unit())
    }
}
