//! Clocks: the wall clock of a server, and the one that leases run on.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use tokio::time::Instant;

use super::sql::{as_micros, micros, time};

/// Differences below this, in microseconds, are the network's, not the clocks': leases last seconds.
const IN_STEP: i64 = 100_000;

/// Tells the time; the machine's clock, unless a simulation sets another.
#[derive(Clone)]
pub struct Clock(Arc<dyn Fn() -> SystemTime + Send + Sync>);

impl Clock {
    /// A clock that shows what `now` says.
    pub fn new(now: impl Fn() -> SystemTime + Send + Sync + 'static) -> Self {
        Self(Arc::new(now))
    }

    /// The time that it shows.
    pub fn now(&self) -> SystemTime {
        (self.0)()
    }
}

impl Default for Clock {
    fn default() -> Self {
        Self::new(SystemTime::now)
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Clock")
    }
}

/// The clock that leases run on: the database's where servers share one, else the machine's as it was at the start.
///
/// It is steady: between two comparisons with the database it goes on as the monotonic clock does. Setting the
/// machine's clock neither ends a lease nor prolongs one.
#[derive(Debug)]
pub(super) struct LeaseClock {
    wall: Clock,
    reading: Mutex<Reading>,
}

/// What two clocks showed at the same time.
#[derive(Debug, Clone, Copy)]
struct Reading {
    wall: SystemTime,
    steady: Instant,
    /// How far the lease clock was ahead of the wall clock, in microseconds.
    ahead: i64,
}

impl LeaseClock {
    /// A lease clock that shows what the wall clock does, until that is set.
    pub(super) fn new(wall: Clock) -> Self {
        let reading = Reading { wall: wall.now(), steady: Instant::now(), ahead: 0 };
        Self { wall, reading: Mutex::new(reading) }
    }

    /// Follows a clock that showed `theirs`, in microseconds since 1970, at some time between `asked` and now.
    pub(super) fn follow(&self, theirs: i64, asked: Instant) {
        let (wall, steady) = (self.wall.now(), Instant::now());
        let uncertain = as_micros(steady - asked) / 2;
        let distance = theirs.saturating_sub(micros(wall).saturating_sub(uncertain));
        let is_in_step = distance.saturating_abs() <= uncertain.saturating_add(IN_STEP);
        let ahead = if is_in_step { 0 } else { distance };
        let before = std::mem::replace(&mut *self.locked(), Reading { wall, steady, ahead });
        if before.ahead == 0 && ahead != 0 {
            tracing::warn!(ahead_seconds = ahead as f64 / 1e6, "the database's clock is not this machine's");
        }
    }

    /// The time of leases when the wall clock shows `now`.
    pub(super) fn translate(&self, now: SystemTime) -> SystemTime {
        let Reading { wall, steady, ahead } = *self.locked();
        let shown = micros(self.wall.now()).saturating_sub(micros(wall));
        let set = shown.saturating_sub(as_micros(steady.elapsed()));
        let set = if set.saturating_abs() <= IN_STEP { 0 } else { set };
        time(micros(now).saturating_add(ahead).saturating_sub(set))
    }

    fn locked(&self) -> std::sync::MutexGuard<'_, Reading> {
        self.reading.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicI64, Ordering};
    use std::time::Duration;

    use super::*;

    const DAY: i64 = 86_400_000_000;

    impl LeaseClock {
        /// As if the clocks were so far apart.
        pub(in crate::store) fn pretend(&self, ahead: Duration) {
            self.locked().ahead = as_micros(ahead);
        }
    }

    /// A wall clock that is set by so many microseconds.
    fn settable() -> (Clock, Arc<AtomicI64>) {
        let set = Arc::new(AtomicI64::new(0));
        let clock = {
            let (set, origin) = (set.clone(), Instant::now());
            Clock::new(move || time(DAY + as_micros(origin.elapsed()) + set.load(Ordering::Relaxed)))
        };
        (clock, set)
    }

    #[tokio::test(start_paused = true)]
    async fn setting_the_clock_moves_no_lease() {
        let (wall, set) = settable();
        let leases = LeaseClock::new(wall.clone());
        for jump in [0, 3_600_000_000, -7_200_000_000, 50 * DAY] {
            tokio::time::advance(Duration::from_secs(5)).await;
            set.store(jump, Ordering::Relaxed);
            let passed = leases.translate(wall.now()).duration_since(time(DAY)).expect("later");
            assert_eq!(as_micros(passed), as_micros(leases.locked().steady.elapsed()), "{jump}");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn the_database_s_clock_is_followed_between_comparisons() {
        let (wall, set) = settable();
        let leases = LeaseClock::new(wall.clone());
        // Asked now, answered two seconds later: theirs is an hour ahead of ours in the middle.
        let asked = Instant::now();
        let theirs = micros(wall.now()) + 3_601_000_000;
        tokio::time::advance(Duration::from_secs(2)).await;
        leases.follow(theirs, asked);
        let ahead = |now: SystemTime| micros(leases.translate(now)) - micros(now);
        assert_eq!(ahead(wall.now()), 3_600_000_000);
        set.store(-60_000_000, Ordering::Relaxed);
        tokio::time::advance(Duration::from_secs(20)).await;
        assert_eq!(ahead(wall.now()), 3_660_000_000, "ours was set back by a minute");
        // Within what the way there and back leaves open they are one clock.
        let asked = Instant::now();
        let theirs = micros(wall.now()) + 1_500_000;
        tokio::time::advance(Duration::from_secs(2)).await;
        leases.follow(theirs, asked);
        assert_eq!(ahead(wall.now()), 0);
    }
}
