//! The state that outlives the process: jobs, inputs, events, results, leases and request ids, behind one trait.
//!
//! Only this module sees SQL, but for `formats`, which reads COLMAP's databases. Depends on `domain` and `telemetry`;
//! the state machine's rules are the domain's, what is written in one transaction is decided here.

mod bounds;
mod clock;
mod input_query;
pub mod payload;
pub mod postgres;
pub mod query;
pub mod record;
#[cfg(test)]
pub(crate) mod simulated;
mod sql;
pub mod sqlite;
pub mod upload;

#[cfg(test)]
mod contract;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use crate::domain::job::{Job, JobEvent, JobName, JobState};
use crate::domain::progress::Progress;
use crate::domain::{InputName, Oversize};

pub use bounds::{Bound, QueueBounds, UploadBounds};
pub use clock::Clock;
pub use input_query::{InputPage, InputQuery};
pub use query::{JobPage, JobQuery, Order};
pub use record::{
    CancelReply, Claim, Claimed, Claims, Created, EncodedResult, Ending, Heartbeat, JobInput, JobPayload, Lease,
    NewRecord, Outcome, PassedOver, Prefetch, QueueReport, QueueStats, Request, RetryReply, StoreStats, Swept,
    TenantQueue, TenantShares, WebhookOutcome, WebhookQueue,
};
pub use upload::{BegunUpload, NewInput, NewUpload, PurgedUploads, StoredInput, UploadLease, UploadStatus};

/// Why the store did not do what it was asked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error("{0} does not exist")]
    NotFound(JobName),
    #[error("{0} does not exist")]
    InputNotFound(InputName),
    #[error("there is no upload {} of tenants/{}", .0.input, .0.tenant)]
    UploadNotFound(InputName),
    /// Another stream goes on with the upload. The write was dropped.
    #[error("another stream has taken over the upload {}", .0.input)]
    UploadTakenOver(InputName),
    /// The tenant has as many uploads as it may.
    #[error("{0}")]
    UploadsFull(Bound),
    /// The upload alone is more than the tenant may ever have.
    #[error("{0}")]
    UploadTooLarge(Oversize),
    /// An id stands for something else already.
    #[error("{0}")]
    AlreadyExists(TakenId),
    /// Only ended jobs can be removed.
    #[error("{0} is {name}; only a job that has ended can be deleted: cancel it first", name = .1.name())]
    NotEnded(JobName, JobState),
    /// There is nothing to retry of a job that has its result.
    #[error("{0} has succeeded; only a job that ended without a result is retried")]
    Succeeded(JobName),
    /// Only waiting jobs are put in another order.
    #[error("{0} is {name}; only the priority of a job that waits can be changed", name = .1.name())]
    NotQueued(JobName, JobState),
    /// The job has changed since the caller read it.
    #[error("{0} has changed since its etag was read")]
    EtagMismatch(JobName),
    /// The lease is no longer held: the job was taken over, given back or ended. The write was dropped.
    #[error("the lease on {} (attempt {}) is no longer held", .0.name, .0.attempt)]
    Fenced(Lease),
    /// Admission refused the job.
    #[error("{0}")]
    QueueFull(Bound),
    /// The batch alone is more than may ever wait.
    #[error("{0}")]
    BatchTooLarge(Oversize),
    /// A page token that this query did not give out.
    #[error("page token is not one that this query returned")]
    PageToken,
    /// Another process holds this data directory.
    #[error("{} is in use by another server", .0.display())]
    InUse(PathBuf),
    /// The database or the file system failed; trying again later may help.
    #[error("store unavailable: {0}")]
    Unavailable(String),
    /// There is no room for what was to be written; it is not. What is there can be read.
    #[error("no space is left for the store: {0}")]
    NoSpace(String),
    /// What was read is not what was written.
    #[error("store corrupt: {0}")]
    Corrupt(String),
}

/// An id that cannot be used again.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TakenId {
    #[error("{0} already exists")]
    Job(JobName),
    #[error("request id {0:?} was used before with another body; a new request needs a new id")]
    Request(String),
    /// With what the bytes differ in.
    #[error("upload {id} was begun with another {what}; other bytes need a new upload id", id = .0.input, what = .1)]
    Upload(InputName, &'static str),
}

/// What another process has changed, as it says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Notification {
    /// The job has new events.
    Events(JobName),
    /// Something entered the queue.
    Queued,
    /// The cancel of a running job was asked for.
    Cancel(JobName),
    /// Notifications may have been lost: anything may have changed.
    Missed,
}

/// A store of jobs. Every method is one transaction: state, event and lease change together or not at all.
///
/// `now` is the caller's clock, so that tests need not wait; times are kept to the microsecond.
#[async_trait::async_trait]
pub trait Store: Send + Sync + 'static {
    /// Stores a queued job with its input and its first event, unless the request id is known or admission refuses.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`], [`Error::QueueFull`], [`Error::BatchTooLarge`].
    async fn create_job(&self, new: NewRecord, bounds: &QueueBounds, now: SystemTime) -> Result<Created, Error> {
        let created = self.create_jobs(vec![new], bounds, now).await?.pop();
        created.ok_or_else(|| Error::Corrupt("one job was to be created, none was".into()))
    }

    /// The same for several jobs, all or none; the answers are in their order. A request id that comes twice with the
    /// same body is one job: with [`NewRecord::cancel_on_disconnect`] the call attaches to it, as far as it depends on
    /// its calls ([`Job::attached_calls`]), and without it does not depend on any from then on.
    ///
    /// # Errors
    /// As [`Store::create_job`], of the first job that is refused.
    async fn create_jobs(
        &self,
        new: Vec<NewRecord>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<Vec<Created>, Error>;

    /// The job that a tenant's request made before; `None` where it made none, or the job is gone.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`] for a request id with another body.
    async fn requested_job(&self, tenant: &str, request: &Request) -> Result<Option<Job>, Error>;

    /// # Errors
    /// [`Error::NotFound`].
    async fn job(&self, name: &JobName) -> Result<Job, Error>;

    /// One page of a tenant's jobs.
    ///
    /// # Errors
    /// [`Error::PageToken`].
    async fn jobs(&self, query: &JobQuery) -> Result<JobPage, Error>;

    /// At most `limit` events with a sequence number above `after`, in order.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    async fn events_after(&self, name: &JobName, after: u64, limit: u32) -> Result<Vec<JobEvent>, Error>;

    /// Leases the next job in the queue and begins it; nothing where none waits, or the queue is paused. Tenants
    /// take turns, by their weights; within a tenant jobs go by priority, then age. Jobs past their deadline are left to [`Store::sweep`].
    ///
    /// The claim may also prefetch: it leases the job after it, which stays queued until a later claim begins it. Other
    /// claims pass over a prefetched job until that lease expires, but for those that find no other job. Nothing need
    /// be given back: a prefetched job that is not begun in time is any worker's, and no attempt was made.
    ///
    /// A suspect ([`Claim::suspect_after`]) is leased as long as a job that is begun, and not begun; a claim that is to
    /// begin it extends that lease, or ends it with a `lease_for` of zero. Where nothing else runs in the process, the
    /// claim begins it; the same claim once more, for want of an answer, gives the attempt that was begun.
    async fn claim(&self, claim: &Claim, now: SystemTime) -> Result<Claims, Error>;

    /// The encoded input of a job, and whether its cancel has been asked for.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    async fn job_payload(&self, name: &JobName) -> Result<JobPayload, Error>;

    /// Extends a lease and brings back what its holder must know.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    async fn heartbeat(&self, lease: &Lease, now: SystemTime, lease_for: Duration) -> Result<Heartbeat, Error>;

    /// Appends a progress event; returns its sequence number.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    async fn record(&self, lease: &Lease, progress: &Progress, now: SystemTime) -> Result<u64, Error>;

    /// Ends an attempt and its job, with the result where there is one. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    async fn finish(&self, lease: &Lease, ending: &Arc<Ending>, now: SystemTime) -> Result<Job, Error>;

    /// Gives a lease back. The job returns to the queue, or ends if its cancel was asked for; the attempt does not
    /// count against the cap. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    async fn release(&self, lease: &Lease, now: SystemTime) -> Result<Job, Error>;

    /// Asks for the end of a job: a queued one ends at once, a running one is flagged for its worker, an ended one is
    /// left as it is. With an `etag`, only where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`].
    async fn request_cancel(&self, name: &JobName, etag: Option<&str>, now: SystemTime) -> Result<CancelReply, Error>;

    /// Puts a job that ended without a result into the queue again, as far as the bounds allow it: with its attempts
    /// counted anew, without a deadline that has passed, and without a caller that it depends on. One that waits or
    /// runs is left as it is. With an `etag`, only where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::Succeeded`], [`Error::QueueFull`].
    async fn retry_job(
        &self,
        name: &JobName,
        etag: Option<&str>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<RetryReply, Error>;

    /// Changes the priority of a queued job. With an `etag`, only where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::NotQueued`].
    async fn set_priority(&self, name: &JobName, etag: Option<&str>, priority: i32) -> Result<Job, Error>;

    /// Pauses the queue, in which no claim finds a job from then on, or resumes it; for every process and over
    /// restarts. What is so already stays as it is.
    async fn set_paused(&self, paused: bool, now: SystemTime) -> Result<(), Error>;

    /// The queue as its administrator sees it, with at most `tenants` tenants.
    async fn queue(&self, tenants: u32) -> Result<QueueReport, Error>;

    /// Counts that a call was disconnected that had attached to the job, unless it no longer depends on its calls or is
    /// another one of the same name, which was not `created` then. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    async fn detach(&self, name: &JobName, created: SystemTime) -> Result<Job, Error>;

    /// Removes an ended job with its events, attempts, input, result, request ids and webhook. With an `etag`, only
    /// where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::NotEnded`].
    async fn delete_job(&self, name: &JobName, etag: Option<&str>) -> Result<(), Error>;

    /// Removes at most `limit` of the jobs that ended at that time or before, the oldest first. Returns how many.
    async fn purge(&self, ended_by: SystemTime, limit: u32) -> Result<u32, Error>;

    /// Gives some of the space that removed jobs took back to the file system, where the database does not do so by
    /// itself.
    async fn reclaim(&self) -> Result<(), Error>;

    /// Takes back every lease that no living process can hold: all of them where one process has the store to itself,
    /// those that ran out where it is shared. Called once, before the first claim. A job that lost `max_attempts`
    /// attempts this way fails with `ATTEMPTS_EXHAUSTED`. Returns the jobs that changed.
    async fn recover(&self, now: SystemTime, max_attempts: u32) -> Result<Vec<Job>, Error>;

    /// Takes back leases that ran out, as [`Store::recover`] does, and ends queued jobs that are past their deadline.
    async fn sweep(&self, now: SystemTime, max_attempts: u32) -> Result<Swept, Error>;

    /// The encoded result of a job; `None` where there is none. Whether it is intact is for the caller to ask: it takes
    /// long.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    async fn result(&self, name: &JobName) -> Result<Option<EncodedResult>, Error>;

    /// Begins an upload, or goes on with one: from here on its earlier streams cannot write.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`] where it was begun with another length or hash, [`Error::UploadsFull`],
    /// [`Error::UploadTooLarge`].
    async fn begin_upload(&self, new: &NewUpload, bounds: &UploadBounds, now: SystemTime)
    -> Result<BegunUpload, Error>;

    /// Adds bytes to an upload, at its end.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`], [`Error::UploadNotFound`] where it was given up.
    async fn append_upload(&self, lease: &UploadLease, at_byte: u64, data: &[u8], now: SystemTime)
    -> Result<(), Error>;

    /// Some of an upload's bytes from there on, which must be where a read before it ended; none at the end.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`].
    async fn read_upload(&self, lease: &UploadLease, at_byte: u64) -> Result<Vec<u8>, Error>;

    /// Makes an input of an upload whose bytes are all there.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`], [`Error::UploadNotFound`] where it was given up.
    async fn finish_upload(
        &self,
        lease: &UploadLease,
        new: &Arc<NewInput>,
        now: SystemTime,
    ) -> Result<StoredInput, Error>;

    /// Gives an upload up: its id is free again.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`], [`Error::UploadNotFound`].
    async fn give_up_upload(&self, lease: &UploadLease) -> Result<(), Error>;

    /// How far an upload has come.
    ///
    /// # Errors
    /// [`Error::UploadNotFound`].
    async fn upload(&self, name: &InputName) -> Result<UploadStatus, Error>;

    /// An uploaded input.
    ///
    /// # Errors
    /// [`Error::InputNotFound`].
    async fn uploaded_input(&self, name: &InputName) -> Result<StoredInput, Error>;

    /// One page of a tenant's uploaded inputs.
    ///
    /// # Errors
    /// [`Error::PageToken`].
    async fn inputs(&self, query: &InputQuery) -> Result<InputPage, Error>;

    /// Takes an uploaded input's name away, which is free again at once. Jobs that were created with it keep it; it is
    /// removed with the last of them, or at once where there is none.
    ///
    /// # Errors
    /// [`Error::InputNotFound`].
    async fn delete_input(&self, name: &InputName) -> Result<(), Error>;

    /// Gives up the uploads to which nothing came since `abandoned_by`, and removes some of the bytes of those that
    /// were given up or finished, and some of the uploaded inputs that no job has and none was created with since
    /// `unused_since`. `None`: none.
    async fn purge_uploads(
        &self,
        abandoned_by: Option<SystemTime>,
        unused_since: Option<SystemTime>,
    ) -> Result<PurgedUploads, Error>;

    /// What waits and what runs.
    async fn queue_stats(&self) -> Result<QueueStats, Error>;

    /// What is to be sent to the webhooks of jobs that have ended.
    async fn webhook_queue(&self, now: SystemTime) -> Result<WebhookQueue, Error>;

    /// Leases the delivery of a job's end that is due, passing over some hosts and tenants, and counts an attempt at
    /// it: first attempts in the order of the jobs, then what is due the longest. Returns the job as it stands then;
    /// `None` where nothing is due. A delivery whose lease runs out is due again.
    async fn claim_webhook(
        &self,
        passed: &PassedOver,
        now: SystemTime,
        lease_for: Duration,
    ) -> Result<Option<Job>, Error>;

    /// Notes what the attempt at the delivery of a `claimed` job came to. `false` where the job is gone, or another
    /// attempt has begun since: nothing is noted then.
    async fn settle_webhook(&self, claimed: &Job, outcome: &WebhookOutcome, now: SystemTime) -> Result<bool, Error>;

    /// What operators watch.
    async fn stats(&self) -> Result<StoreStats, Error>;

    /// Whether other processes may be at work on the same jobs.
    fn is_shared(&self) -> bool;

    /// Whether there was room to begin something at the last look, where the store looks: a shared one is for its own
    /// operators to watch.
    fn has_room(&self) -> bool;

    /// Waits for a change by another process. Notifications may be lost, repeated or stale: whoever handles them looks
    /// into the store, and looks from time to time without one. Never answers where the store is not shared. For one
    /// caller at a time.
    async fn notification(&self) -> Notification;

    /// Closes every connection; what was acknowledged is durable without it.
    async fn close(&self);
}

/// `Failure::reason` of a job whose workers vanished too often.
pub const ATTEMPTS_EXHAUSTED: &str = "ATTEMPTS_EXHAUSTED";
