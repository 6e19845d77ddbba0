//! Pauses between tries, and how long all of them may take.

use std::future::Future;
use std::time::Duration;

use tokio::time::{Instant, timeout_at};
use tonic::Status;

use super::error;

/// The pauses, in milliseconds: a hiccup is over at once, a server that is restarted drains for up to 20 s unless it is
/// told otherwise, and after half a minute without a sign of life a person should know.
const PAUSES_MS: [u64; 11] = [100, 200, 400, 800, 1_500, 3_000, 4_000, 5_000, 5_000, 5_000, 5_000];

/// What is left of the time for the last try, so that it is not over before it begins.
const LAST_TRY: Duration = Duration::from_secs(1);

/// A stream that lived this long ended the trouble before it, even where nothing came: a job that waits has no events.
/// As long as the longest pause, so that a server whose streams break sooner is given up like one that is away.
const LIVED: Duration = Duration::from_millis(PAUSES_MS[PAUSES_MS.len() - 1]);

/// Counts tries that came to nothing, and the time since the first of them.
#[derive(Debug, Default)]
pub struct Backoff {
    tries: usize,
    trouble: Option<Trouble>,
    /// When the server took the latest stream, of which nothing has come yet.
    accepted: Option<Instant>,
}

/// A time of trouble.
#[derive(Debug)]
struct Trouble {
    /// When it counts as lasting.
    end: Instant,
    /// What its first try came to.
    first: Status,
    /// Whether a try of it may have done what it was for, its answer lost.
    may_be_done: bool,
    /// What the latest try came to.
    last: Status,
}

impl Backoff {
    /// How long a trouble is waited for, tries and pauses together.
    pub const TOTAL: Duration = Duration::from_millis(total_ms());

    /// Something arrived: the next trouble is a new one.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    /// The server answered with a stream; what it was worth is told by how long it lives.
    pub fn accepted(&mut self) {
        self.accepted = Some(Instant::now());
    }

    /// Makes a call, which in times of trouble may take no longer than the trouble is waited for.
    ///
    /// # Errors
    /// The call's; that of the one before, where this one took too long, and may yet be carried out.
    pub async fn within<T>(&mut self, call: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
        let Some(trouble) = &mut self.trouble else { return call.await };
        timeout_at(trouble.end, call).await.unwrap_or_else(|_| {
            trouble.may_be_done = true;
            Err(trouble.last.clone())
        })
    }

    /// Notes what a try came to; returns whether it is the first of its trouble.
    pub fn failed(&mut self, status: &Status) -> bool {
        let lived = self.accepted.take().map(|accepted| accepted.elapsed()).unwrap_or_default();
        if lived >= LIVED {
            self.reset();
        } else if let Some(trouble) = &mut self.trouble {
            // No time of trouble. How often it may go on so is bounded by the pauses.
            trouble.end += lived;
        }
        let first = self.trouble.is_none();
        let trouble = self.trouble.get_or_insert_with(|| Trouble {
            end: Instant::now() + Self::TOTAL,
            first: status.clone(),
            may_be_done: false,
            last: status.clone(),
        });
        trouble.last = status.clone();
        trouble.may_be_done |= error::may_be_done(status);
        first
    }

    /// What the trouble began with.
    pub fn first(&self) -> Option<&Status> {
        self.trouble.as_ref().map(|trouble| &trouble.first)
    }

    /// Whether a call may have done what it was for, though every answer was lost.
    pub fn may_be_done(&self) -> bool {
        self.trouble.as_ref().is_some_and(|trouble| trouble.may_be_done)
    }

    /// Waits for the next try, for no less than `at_least`; `false` when there is none.
    pub async fn pause(&mut self, at_least: Duration) -> bool {
        let Some(&pause_ms) = PAUSES_MS.get(self.tries) else { return false };
        let now = Instant::now();
        // The last pause is cut short, not left out: what was said to be the wait is the wait.
        let last = self.trouble.as_ref().map(|trouble| trouble.end - LAST_TRY);
        let wanted = now + Duration::from_millis(pause_ms).max(at_least);
        let next = last.map_or(wanted, |last| wanted.min(last));
        if next <= now || next < now + at_least {
            return false;
        }
        self.tries += 1;
        tokio::time::sleep_until(next).await;
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Seconds until a call is given up each of whose tries takes so long, from the end of the first, and how many
    /// tries that were.
    fn given_up_after(try_for: Duration) -> (f64, usize) {
        // Its clock does not wait.
        let clock = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
        clock.expect("a runtime").block_on(async {
            let (begun, mut tries, mut backoff) = (Instant::now(), 0, Backoff::default());
            loop {
                tries += 1;
                let call = async {
                    tokio::time::sleep(try_for).await;
                    Err::<(), _>(Status::unavailable("away"))
                };
                let status = backoff.within(call).await.expect_err("away");
                assert_eq!(status.message(), "away");
                backoff.failed(&status);
                if !backoff.pause(Duration::ZERO).await {
                    return (begun.elapsed().as_secs_f64() - try_for.as_secs_f64(), tries);
                }
            }
        })
    }

    /// A call that is cut off may have been sent: nobody knows what became of it.
    #[test]
    fn what_is_refused_is_not_done_and_what_is_cut_off_may_be() {
        let clock = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
        clock.expect("a runtime").block_on(async {
            let mut backoff = Backoff::default();
            assert!(!backoff.may_be_done());
            backoff.failed(&Status::resource_exhausted("full"));
            assert!(!backoff.may_be_done(), "the server refused it");
            let silent = std::future::pending::<Result<(), Status>>();
            let status = backoff.within(silent).await.expect_err("no answer");
            assert_eq!(status.code(), tonic::Code::ResourceExhausted, "what is known");
            backoff.failed(&status);
            assert!(backoff.may_be_done(), "also once more has failed");
        });
    }

    fn some_time_ago(time: Duration) -> Instant {
        Instant::now().checked_sub(time).expect("the machine has run for some seconds")
    }

    /// What a watch of a waiting job goes through when servers restart one after another.
    #[test]
    fn an_outage_after_a_stream_that_lived_is_a_new_one() {
        let away = Status::unavailable("away");
        let mut backoff = Backoff { tries: 7, ..Backoff::default() };
        assert!(backoff.failed(&away) && !backoff.failed(&away), "the second try is of the same trouble");
        let end = |backoff: &Backoff| backoff.trouble.as_ref().expect("trouble").end;
        let first = end(&backoff);
        backoff.accepted = Some(some_time_ago(LIVED));
        assert!(backoff.failed(&away), "another trouble, which is told");
        assert_eq!(backoff.tries, 0, "with all of its pauses");
        assert!(end(&backoff) >= first && backoff.accepted.is_none());
    }

    #[test]
    fn a_server_that_takes_every_stream_and_breaks_it_is_given_up() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        let away = Status::unavailable("away");
        let mut backoff = Backoff::default();
        assert!(backoff.failed(&away));
        let end = backoff.trouble.as_ref().expect("trouble").end;
        for tries in 0..PAUSES_MS.len() {
            backoff.accepted();
            assert!(!backoff.failed(&away) && backoff.tries == tries, "the pauses go on growing");
            // In the place of the pause.
            backoff.tries += 1;
        }
        assert!(!runtime.block_on(backoff.pause(Duration::ZERO)), "no pause is left");
        // The time for which a stream lived is no time of trouble.
        backoff.accepted = Some(some_time_ago(LIVED / 2));
        assert!(!backoff.failed(&away));
        assert!(backoff.trouble.as_ref().expect("trouble").end >= end + LIVED / 2);
    }

    /// As after a refusal that says when the call would pass.
    #[test]
    fn a_pause_is_as_long_as_it_must_be_or_there_is_none() {
        let clock = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
        clock.expect("a runtime").block_on(async {
            let mut backoff = Backoff::default();
            backoff.failed(&Status::resource_exhausted("too many"));
            let begun = Instant::now();
            assert!(backoff.pause(Duration::from_secs(7)).await);
            let waited = begun.elapsed();
            assert!(waited >= Duration::from_secs(7) && waited < Duration::from_secs(8), "{waited:?}");
            assert!(!backoff.pause(Backoff::TOTAL).await, "it would end after the time of trouble");
            assert_eq!(begun.elapsed(), waited, "which is known before it begins");
            assert!(backoff.pause(Duration::ZERO).await, "the pauses that are left go on");
        });
    }

    #[test]
    fn tries_that_take_long_do_not_make_the_wait_longer_than_it_says() {
        let total = Backoff::TOTAL.as_secs_f64();
        let (seconds, tries) = given_up_after(Duration::ZERO);
        assert!((0.9 * total..=total).contains(&seconds) && tries == PAUSES_MS.len() + 1, "{seconds} s, {tries} tries");
        let (seconds, tries) = given_up_after(Duration::from_secs(3));
        assert!((0.9 * total..=total).contains(&seconds) && tries >= 3, "{seconds} s, {tries} tries");
    }
}
