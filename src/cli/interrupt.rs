//! Ctrl-C and SIGTERM, in order.

use std::time::Duration;

use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::exit::{Exit, Failure};
use crate::domain::{StopReason, StopToken};

/// Signals within this time of the first are the same request: `timeout` and some supervisors signal a process and its
/// group, so that it arrives twice, with nothing in between. Nobody presses keys as fast.
const SAME_REQUEST: Duration = Duration::from_millis(100);

/// While this lives, the first SIGINT or SIGTERM cancels its token, and the second ends the process.
pub struct Interrupt {
    token: CancellationToken,
    listener: JoinHandle<()>,
}

impl Interrupt {
    /// Listens from now on. To be called within a runtime.
    ///
    /// # Errors
    /// The operating system refuses.
    pub fn listen() -> Result<Self, Failure> {
        let mut signals = Signals::listen()?;
        let token = CancellationToken::new();
        let cancels = token.clone();
        let listener = tokio::spawn(async move {
            signals.next().await;
            cancels.cancel();
            signals.again().await;
            // Stopping in order was asked for and takes too long for whoever asks twice.
            std::process::exit(Exit::Interrupted as i32);
        });
        Ok(Self { token, listener })
    }

    /// Cancelled by the first signal.
    pub fn token(&self) -> CancellationToken {
        self.token.clone()
    }

    /// From now on until the task is aborted, the first signal stops blocking work that asks this token.
    pub fn stops(&self, stop: &StopToken) -> JoinHandle<()> {
        let (stop, token) = (stop.clone(), self.token());
        tokio::spawn(async move {
            token.cancelled().await;
            stop.stop(StopReason::Cancelled);
        })
    }
}

impl Drop for Interrupt {
    fn drop(&mut self) {
        self.listener.abort();
    }
}

/// SIGTERM and SIGINT.
pub struct Signals {
    #[cfg(unix)]
    terminate: tokio::signal::unix::Signal,
    #[cfg(unix)]
    interrupt: tokio::signal::unix::Signal,
}

impl Signals {
    /// From now on, the signals are ours.
    #[cfg(unix)]
    pub fn listen() -> Result<Self, Failure> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self { terminate: signal(SignalKind::terminate())?, interrupt: signal(SignalKind::interrupt())? })
    }

    /// Waits for one that is another request, to be called right after the one before.
    pub async fn again(&mut self) {
        let first = Instant::now();
        loop {
            self.next().await;
            if first.elapsed() >= SAME_REQUEST {
                return;
            }
        }
    }

    /// Waits for the next one.
    #[cfg(unix)]
    pub async fn next(&mut self) {
        tokio::select! {
            _ = self.terminate.recv() => {}
            _ = self.interrupt.recv() => {}
        }
    }

    #[cfg(not(unix))]
    pub fn listen() -> Result<Self, Failure> {
        Ok(Self {})
    }

    #[cfg(not(unix))]
    pub async fn next(&mut self) {
        if tokio::signal::ctrl_c().await.is_err() {
            std::future::pending::<()>().await;
        }
    }
}
