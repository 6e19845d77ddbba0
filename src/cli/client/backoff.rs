//! Pauses between tries.

use std::time::Duration;

/// The pauses, in milliseconds: a hiccup is over at once, a restart of a server takes some seconds, and after a quarter
/// of a minute without a sign of life a person should know.
const PAUSES_MS: [u64; 8] = [100, 200, 400, 800, 1_500, 3_000, 4_000, 5_000];

/// Counts tries that came to nothing.
#[derive(Debug, Default)]
pub struct Backoff {
    tries: usize,
}

impl Backoff {
    /// Something arrived: the next trouble is a new one.
    pub fn reset(&mut self) {
        self.tries = 0;
    }

    /// Waits for the next try; `false` when there is none.
    pub async fn pause(&mut self) -> bool {
        let Some(&pause_ms) = PAUSES_MS.get(self.tries) else { return false };
        self.tries += 1;
        tokio::time::sleep(Duration::from_millis(pause_ms)).await;
        true
    }
}
