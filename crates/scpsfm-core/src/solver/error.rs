//! Why a solve ended without a solution.

use crate::domain::{StopReason, StopToken};

/// Why a solve ended without a solution. A scene that cannot be solved is a solution, not an error.
///
/// What takes a problem or a stop token and can end early ends with [`Error::Stopped`]; what searches blocks may end
/// with [`Error::Internal`], too.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// The stop token asked for it.
    #[error("stopped before a result stood: {0:?}")]
    Stopped(StopReason),
    /// A defect of ours, not of the input.
    #[error("internal solver error: {0}")]
    Internal(String),
}

impl Error {
    /// `Err` once the token asks for a stop.
    pub(super) fn check(stop: &StopToken) -> Result<(), Self> {
        stop.reason().map_or(Ok(()), |reason| Err(Self::Stopped(reason)))
    }
}
