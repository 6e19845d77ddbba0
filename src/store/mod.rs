//! The state that outlives the process: jobs, inputs, events, results, leases and request ids, behind one type.
//!
//! Only this module sees SQL, but for `formats`, which reads COLMAP's databases. Depends on `domain` and `telemetry`;
//! the state machine's rules are the domain's, what is written in one transaction is decided here.

mod bounds;
mod clock;
pub mod payload;
pub mod postgres;
pub mod query;
pub mod record;
mod sql;
pub mod sqlite;
pub mod upload;

#[cfg(test)]
mod contract;
#[cfg(test)]
pub(crate) mod tests;

use std::path::PathBuf;

use crate::domain::job::{JobName, JobState};
use crate::domain::{InputName, Oversize};

pub use bounds::{Bound, QueueBounds, UploadBounds};
pub use clock::Clock;
pub use query::{InputQuery, JobQuery, Order, Page};
pub use record::{
    ChangeReply, Claim, Claimed, Claims, EncodedResult, Ending, Heartbeat, JobInput, JobPayload, Lease, NewRecord,
    Outcome, PassedOver, Prefetch, QueueReport, QueueStats, Request, StoreStats, Swept, TenantQueue, TenantShares,
    WebhookOutcome, WebhookQueue,
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

/// A store of jobs, on whichever database; its operations are in the files of `sql`, by what they are on. Every
/// operation is one transaction: state, event and lease change together or not at all.
///
/// `now` is the caller's clock, so that tests need not wait; times are kept to the microsecond.
pub type Store = dyn sql::Database;

/// `Failure::reason` of a job whose workers vanished too often.
pub const ATTEMPTS_EXHAUSTED: &str = "ATTEMPTS_EXHAUSTED";
