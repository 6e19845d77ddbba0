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
    /// All pauses together.
    pub const TOTAL: Duration = Duration::from_millis(total_ms());

    /// Whether no try has come to nothing yet.
    pub fn is_first_try(&self) -> bool {
        self.tries == 0
    }

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

const fn total_ms() -> u64 {
    let (mut total, mut k) = (0, 0);
    while k < PAUSES_MS.len() {
        total += PAUSES_MS[k];
        k += 1;
    }
    total
}
