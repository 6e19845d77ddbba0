//! Asking a running optimisation to stop.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Instant;

/// Why an optimisation was asked to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopReason {
    /// The caller cancelled the job.
    Cancelled,
    /// The job's deadline passed.
    DeadlineExceeded,
    /// The server is draining or the worker lost its lease: the attempt is given back, not ended.
    Interrupted,
}

/// A flag shared between whoever may stop an optimisation and the optimisation itself.
///
/// Numerical code asks [`StopToken::reason`] at least every 50 ms; asking costs an atomic load and, where a deadline
/// is set, a look at the clock. The first reason given wins.
#[derive(Debug, Clone, Default)]
pub struct StopToken {
    flag: Arc<AtomicU8>,
    deadline: Option<Instant>,
}

impl StopToken {
    /// A token that stops by itself at `deadline`.
    pub fn with_deadline(deadline: Option<Instant>) -> Self {
        Self { flag: Arc::default(), deadline }
    }

    /// Whether both are one token.
    pub fn is(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.flag, &other.flag)
    }

    /// Asks for a stop; later reasons are ignored.
    pub fn stop(&self, reason: StopReason) {
        let code = match reason {
            StopReason::Cancelled => 1,
            StopReason::DeadlineExceeded => 2,
            StopReason::Interrupted => 3,
        };
        // A lost race means that another reason came first, which is the one to keep.
        let _ = self.flag.compare_exchange(0, code, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// The reason to stop, if there is one.
    pub fn reason(&self) -> Option<StopReason> {
        match self.flag.load(Ordering::Relaxed) {
            1 => Some(StopReason::Cancelled),
            2 => Some(StopReason::DeadlineExceeded),
            3 => Some(StopReason::Interrupted),
            _ if self.deadline.is_some_and(|deadline| Instant::now() >= deadline) => {
                self.stop(StopReason::DeadlineExceeded);
                self.reason()
            }
            _ => None,
        }
    }

    /// Whether to stop.
    pub fn is_stopped(&self) -> bool {
        self.reason().is_some()
    }
}
