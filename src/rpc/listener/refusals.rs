//! When refused connections are logged: at once, and then seldom enough that a flood of them does not fill the log.

use std::time::Duration;

use tokio::time::{Instant, sleep_until};

/// Between two lines about refused connections: a minute is soon enough for whoever reads logs, and sixty lines an hour
/// drown nothing.
const LOG_PERIOD: Duration = Duration::from_secs(60);

/// Counts connections that were refused and are not in the log yet.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    unlogged: u64,
    /// When the next line may come; `None`: at once.
    next_line: Option<Instant>,
}

impl Refusals {
    /// One more connection was refused; returns how many there are to log now.
    pub(super) fn add(&mut self, now: Instant) -> Option<u64> {
        self.unlogged += 1;
        if self.next_line.is_none() { self.due(now) } else { None }
    }

    /// Waits until those since the last line are to be logged, and returns how many there are; for ever where there are
    /// none.
    pub(super) async fn next_count(&mut self) -> u64 {
        loop {
            let Some(next) = self.next_line else { return std::future::pending().await };
            sleep_until(next).await;
            if let Some(count) = self.due(Instant::now()) {
                return count;
            }
        }
    }

    fn due(&mut self, now: Instant) -> Option<u64> {
        let count = std::mem::take(&mut self.unlogged);
        self.next_line = (count > 0).then(|| now + LOG_PERIOD);
        (count > 0).then_some(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_is_logged_at_once_and_the_others_together() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(async {
            let begin = Instant::now();
            let mut refusals = Refusals::default();
            assert_eq!(refusals.add(begin), Some(1));
            for _ in 0..1_000 {
                assert_eq!(refusals.add(begin + LOG_PERIOD / 2), None);
            }
            assert_eq!(refusals.due(begin + LOG_PERIOD), Some(1_000));
            assert_eq!(refusals.add(begin + LOG_PERIOD), None, "the next line is a minute off");
            assert_eq!(refusals.due(begin + 2 * LOG_PERIOD), Some(1));
            // After a quiet minute the next one is logged at once again.
            assert_eq!(refusals.due(begin + 3 * LOG_PERIOD), None);
            assert_eq!(refusals.add(begin + 4 * LOG_PERIOD), Some(1));
        });
    }

    #[test]
    fn nothing_is_waited_for_where_nothing_was_refused() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(async {
            let mut refusals = Refusals::default();
            assert!(futures_util::poll!(std::pin::pin!(refusals.next_count())).is_pending());
            let now = Instant::now();
            refusals.add(now);
            refusals.add(now);
            refusals.next_line = Some(now);
            assert_eq!(refusals.next_count().await, 1);
        });
    }
}
