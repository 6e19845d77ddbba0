//! Ctrl-C as a token.

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::exit::Exit;

/// While this lives, the first Ctrl-C cancels its token, and the second ends the process.
pub struct Interrupt {
    token: CancellationToken,
    listener: JoinHandle<()>,
}

impl Interrupt {
    /// Listens from now on. To be called within a runtime.
    pub fn listen() -> Self {
        let token = CancellationToken::new();
        let cancels = token.clone();
        let listener = tokio::spawn(async move {
            if tokio::signal::ctrl_c().await.is_err() {
                return;
            }
            cancels.cancel();
            if tokio::signal::ctrl_c().await.is_ok() {
                // Stopping in order was asked for and takes too long for whoever asks twice.
                std::process::exit(Exit::Interrupted as i32);
            }
        });
        Self { token, listener }
    }

    /// Cancelled by Ctrl-C.
    pub fn token(&self) -> CancellationToken {
        self.token.clone()
    }
}

impl Drop for Interrupt {
    fn drop(&mut self) {
        self.listener.abort();
    }
}
