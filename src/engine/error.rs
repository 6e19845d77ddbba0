//! Why the engine refused or could not answer.

use std::time::Duration;

use crate::domain::job::{JobName, JobState};
use crate::domain::{InputName, InvalidInput, Oversize, Violation};
use crate::store::{self, TakenId};

/// Why the engine refused or could not answer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error("{0} does not exist")]
    NotFound(JobName),
    #[error("{0} does not exist")]
    InputNotFound(InputName),
    #[error("there is no upload {}", .0.input)]
    UploadNotFound(InputName),
    /// Another stream goes on with the upload.
    #[error("{0}")]
    TakenOver(String),
    /// The tenant has uploaded as much as it may; `bound` names for programs what there is too much of.
    #[error("{message}")]
    UploadsFull { bound: &'static str, message: String },
    /// The upload alone is more than the server or the tenant may ever have.
    #[error("{0}")]
    UploadTooLarge(Oversize),
    /// The job id is taken, or the request id or upload id stands for another body.
    #[error("{0}")]
    AlreadyExists(TakenId),
    /// Too much waits already; `bound` names for programs what there is too much of.
    #[error("{message}; try again in {} s", .retry_after.as_secs_f64())]
    QueueFull { retry_after: Duration, bound: &'static str, message: String },
    /// The batch alone is more than may ever wait.
    #[error("{0}")]
    BatchTooLarge(Oversize),
    /// The job alone is estimated to take more memory than jobs that run at once may take together; `index` is its
    /// place in the batch.
    #[error("{oversize}")]
    JobTooLarge { index: usize, oversize: Oversize },
    #[error(transparent)]
    InvalidArgument(#[from] InvalidInput),
    /// Only ended jobs can be deleted.
    #[error("{0}")]
    NotEnded(String),
    /// A job that has succeeded is not retried.
    #[error("{0}")]
    Succeeded(String),
    /// Only waiting jobs get another priority.
    #[error("{0}")]
    NotQueued(String),
    /// The job has changed since the caller read it.
    #[error("{0}")]
    EtagMismatch(String),
    /// There is no result in this state.
    #[error("the job is {}, it has no result", .0.name())]
    NotReady(JobState),
    /// This server is going down and takes on nothing new; what it was given goes on after its restart.
    #[error("the server is draining")]
    Draining,
    /// The store is out of reach; nothing is known to have changed. Trying again later may help.
    #[error("the store is out of reach: {0}")]
    Unavailable(String),
    /// The store has no room for what was to be stored; it is not. Trying again helps once somebody has made room.
    #[error("no space is left for the store: {0}")]
    NoSpace(String),
    /// Not the caller's fault: the store or the engine itself failed.
    #[error("{0}")]
    Internal(String),
}

impl From<store::Error> for Error {
    fn from(error: store::Error) -> Self {
        match error {
            store::Error::NotFound(name) => Error::NotFound(name),
            store::Error::InputNotFound(name) => Error::InputNotFound(name),
            store::Error::UploadNotFound(name) => Error::UploadNotFound(name),
            store::Error::UploadTakenOver(_) => Error::TakenOver(error.to_string()),
            store::Error::UploadsFull(bound) => {
                Error::UploadsFull { bound: bound.quota.name(), message: bound.to_string() }
            }
            store::Error::UploadTooLarge(oversize) => Error::UploadTooLarge(oversize),
            store::Error::BatchTooLarge(oversize) => Error::BatchTooLarge(oversize),
            store::Error::AlreadyExists(taken) => Error::AlreadyExists(taken),
            store::Error::NotEnded(..) => Error::NotEnded(error.to_string()),
            store::Error::Succeeded(_) => Error::Succeeded(error.to_string()),
            store::Error::NotQueued(..) => Error::NotQueued(error.to_string()),
            store::Error::EtagMismatch(_) => Error::EtagMismatch(error.to_string()),
            store::Error::PageToken => Error::InvalidArgument(Violation::of("page_token", error.to_string()).into()),
            store::Error::QueueFull(bound) => Error::QueueFull {
                retry_after: super::Options::DEFAULT_RETRY_AFTER,
                bound: bound.quota.name(),
                message: bound.to_string(),
            },
            store::Error::Unavailable(cause) => Error::Unavailable(cause),
            store::Error::NoSpace(cause) => Error::NoSpace(cause),
            store::Error::Fenced(_) | store::Error::InUse(_) | store::Error::Corrupt(_) => {
                Error::Internal(error.to_string())
            }
        }
    }
}
