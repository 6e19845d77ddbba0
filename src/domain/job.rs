//! The job's state machine.

use serde::{Deserialize, Serialize};

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum JobState {
    /// Stored, waiting for a worker.
    Queued,
    /// A worker holds the lease.
    Running,
    Succeeded,
    Failed,
    Cancelled,
    /// The deadline passed before a result stood.
    Expired,
}

impl JobState {
    /// Every state.
    pub const ALL: [JobState; 6] = [
        JobState::Queued,
        JobState::Running,
        JobState::Succeeded,
        JobState::Failed,
        JobState::Cancelled,
        JobState::Expired,
    ];

    /// The state's name in files, metrics, filters and the store.
    pub fn name(self) -> &'static str {
        match self {
            JobState::Queued => "QUEUED",
            JobState::Running => "RUNNING",
            JobState::Succeeded => "SUCCEEDED",
            JobState::Failed => "FAILED",
            JobState::Cancelled => "CANCELLED",
            JobState::Expired => "EXPIRED",
        }
    }

    /// The state of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.name() == name)
    }

    /// Whether the job has ended for good.
    pub fn is_terminal(self) -> bool {
        !matches!(self, JobState::Queued | JobState::Running)
    }

    /// Whether a job may go from this state to `next`. A running job returns to the queue when its worker gives the
    /// lease back or loses it.
    pub fn may_become(self, next: JobState) -> bool {
        match self {
            JobState::Queued => !matches!(next, JobState::Queued | JobState::Succeeded),
            JobState::Running => next != JobState::Running,
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::JobState;

    #[test]
    fn terminal_states_are_final_and_names_round_trip() {
        for state in JobState::ALL {
            assert_eq!(JobState::from_name(state.name()), Some(state));
            let goes_on = JobState::ALL.iter().any(|&next| state.may_become(next));
            assert_eq!(goes_on, !state.is_terminal(), "{}", state.name());
        }
    }
}
