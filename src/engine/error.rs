//! Why the engine refused or could not answer.

use crate::domain::job::JobState;
use crate::domain::{InvalidInput, Oversize};
use crate::store;

/// Why the engine refused or could not answer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// What the store refused, or could not do.
    #[error(transparent)]
    Store(#[from] store::Error),
    /// The job alone is estimated to take more memory than jobs that run at once may take together; `index` is its
    /// place in the batch.
    #[error("{oversize}")]
    JobTooLarge { index: usize, oversize: Oversize },
    #[error(transparent)]
    InvalidArgument(#[from] InvalidInput),
    /// There is no result in this state, or not yet.
    #[error("the job is {}; {}", .0.name(), match .0.is_terminal() {
        true => "it has no result",
        false => "its result is not ready",
    })]
    NotReady(JobState),
    /// This server is going down and takes on nothing new; what it was given goes on after its restart.
    #[error("the server is draining")]
    Draining,
    /// Not the caller's fault: the engine itself failed.
    #[error("{0}")]
    Internal(String),
}
