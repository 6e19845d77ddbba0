//! How often may be called: calls of a key, and jobs that a tenant creates, each a rate with a burst (GCRA).
//!
//! What is counted lies in this process: of several servers on one database each allows as much. Only keys and tenants
//! that were let in have an entry, so that nobody can fill the memory with them.

use std::fmt;
use std::hash::Hash;
use std::num::NonZeroU32;

use governor::clock::{Clock, DefaultClock};
use governor::middleware::NoOpMiddleware;
use governor::state::keyed::HashMapStateStore;
use governor::{Quota, RateLimiter};
use tonic::Status;

use super::keys;
use super::status;
use crate::telemetry::metrics::{RateBound, Refusal, refused};

/// How much a second, and how much at once after a pause.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rate {
    pub per_second: NonZeroU32,
    pub burst: NonZeroU32,
}

/// The rates of a server; `None`: any.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Options {
    /// Calls of a key. Without keys all callers share one.
    pub calls: Option<Rate>,
    /// Jobs that a tenant creates.
    pub jobs: Option<Rate>,
}

/// A rate for each of some keys.
type Limiter<K, C> = RateLimiter<K, HashMapStateStore<K>, C, NoOpMiddleware<<C as Clock>::Instant>>;

/// Calls and jobs so far.
pub struct Rates<C: Clock = DefaultClock> {
    clock: C,
    calls: Option<Limiter<Option<keys::Hash>, C>>,
    jobs: Option<Limiter<String, C>>,
}

impl<C: Clock + Clone> Rates<C> {
    pub fn new(options: Options, clock: C) -> Self {
        let calls = options.calls.map(|rate| limiter(rate, &clock));
        let jobs = options.jobs.map(|rate| limiter(rate, &clock));
        Self { clock, calls, jobs }
    }

    /// Counts a call with this key; `None` where none is asked for.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED`, reason `RATE_LIMITED`, with the time after which it would pass.
    pub fn call(&self, key: Option<&keys::Hash>) -> Result<(), Status> {
        self.check(self.calls.as_ref(), &key.cloned(), NonZeroU32::MIN, RateBound::Calls)
    }

    /// Counts jobs that a tenant is about to create, all or none.
    ///
    /// # Errors
    /// As [`Rates::call`].
    pub fn jobs(&self, tenant: &str, count: usize) -> Result<(), Status> {
        let Some(count) = u32::try_from(count).ok().and_then(NonZeroU32::new) else { return Ok(()) };
        self.check(self.jobs.as_ref(), &tenant.to_owned(), count, RateBound::Jobs)
    }

    fn check<K: Hash + Eq + Clone>(
        &self,
        limiter: Option<&Limiter<K, C>>,
        key: &K,
        count: NonZeroU32,
        bound: RateBound,
    ) -> Result<(), Status> {
        let Some(limiter) = limiter else { return Ok(()) };
        match limiter.check_key_n(key, count) {
            Ok(Ok(())) => Ok(()),
            Ok(Err(too_early)) => {
                refused(Refusal::RateLimited(bound));
                Err(status::rate_limited(bound, too_early.wait_time_from(self.clock.now())))
            }
            // The configuration allows no burst below the largest batch.
            Err(error) => Err(status::internal(&error)),
        }
    }
}

fn limiter<K: Hash + Eq + Clone, C: Clock + Clone>(rate: Rate, clock: &C) -> Limiter<K, C> {
    RateLimiter::hashmap_with_clock(Quota::per_second(rate.per_second).allow_burst(rate.burst), clock.clone())
}

impl<C: Clock> fmt::Debug for Rates<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Rates").field("calls", &self.calls.is_some()).field("jobs", &self.jobs.is_some()).finish()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use governor::clock::FakeRelativeClock;
    use tonic::Code;
    use tonic_types::StatusExt;

    use super::*;

    fn rate(per_second: u32, burst: u32) -> Option<Rate> {
        let number = |number| NonZeroU32::new(number).expect("from 1 on");
        Some(Rate { per_second: number(per_second), burst: number(burst) })
    }

    fn key(text: &str) -> Option<keys::Hash> {
        Some(keys::Hash::of(text))
    }

    #[test]
    fn each_key_has_its_burst_and_then_its_rate() {
        const PER_SECOND: u32 = 50;
        const BURST: u32 = 20;
        const SECONDS: u32 = 10;
        let clock = FakeRelativeClock::default();
        let rates = Rates::new(Options { calls: rate(PER_SECOND, BURST), jobs: None }, clock.clone());
        let (north, south) = (key("north"), key("south"));
        let passed = |key: &Option<keys::Hash>| (0..1_000).filter(|_| rates.call(key.as_ref()).is_ok()).count();
        assert_eq!(passed(&north), BURST as usize);
        assert_eq!(passed(&south), BURST as usize, "of its own");
        assert_eq!(passed(&None), BURST as usize, "all callers without a key share one");
        // Ten times as many calls as may come, evenly.
        let step = Duration::from_secs(1) / (10 * PER_SECOND);
        let mut count = 0;
        for _ in 0..10 * PER_SECOND * SECONDS {
            clock.advance(step);
            count += u32::from(rates.call(north.as_ref()).is_ok());
        }
        assert!(count.abs_diff(PER_SECOND * SECONDS) <= 1, "{count} calls in {SECONDS} s");
        // A pause gives the burst back, and no more.
        clock.advance(Duration::from_secs(3_600));
        assert_eq!(passed(&north), BURST as usize);
    }

    #[test]
    fn a_refusal_says_when_the_call_would_pass() {
        let clock = FakeRelativeClock::default();
        let rates = Rates::new(Options { calls: rate(4, 1), jobs: rate(10, 1_000) }, clock.clone());
        rates.call(None).expect("the first");
        let status = rates.call(None).expect_err("the second");
        assert_eq!(status.code(), Code::ResourceExhausted);
        let info = status.get_details_error_info().expect("an ErrorInfo");
        assert_eq!((info.reason.as_str(), info.metadata["bound"].as_str()), ("RATE_LIMITED", "calls"));
        let wait = status.get_details_retry_info().and_then(|retry| retry.retry_delay).expect("a RetryInfo");
        assert_eq!(wait, Duration::from_millis(250));
        clock.advance(wait - Duration::from_millis(1));
        assert!(rates.call(None).is_err(), "too early");
        clock.advance(Duration::from_millis(1));
        rates.call(None).expect("in time");
    }

    #[test]
    fn a_batch_counts_its_jobs_and_is_taken_whole_or_not_at_all() {
        let clock = FakeRelativeClock::default();
        let rates = Rates::new(Options { calls: None, jobs: rate(10, 1_000) }, clock.clone());
        for _ in 0..1_000 {
            rates.call(None).expect("no rate");
        }
        rates.jobs("north", 990).expect("a burst");
        let status = rates.jobs("north", 20).expect_err("ten are left");
        assert_eq!(status.get_details_error_info().expect("an ErrorInfo").metadata["bound"], "jobs");
        let wait = status.get_details_retry_info().and_then(|retry| retry.retry_delay);
        assert_eq!(wait, Some(Duration::from_secs(1)));
        rates.jobs("north", 10).expect("nothing was taken by what was refused");
        rates.jobs("south", 1_000).expect("another tenant's");
        clock.advance(Duration::from_secs(1));
        rates.jobs("north", 10).expect("a second's");
        assert!(rates.jobs("north", 1).is_err());
    }
}
