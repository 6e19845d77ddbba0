//! The clock that leases run on: the database's, which every server shares.

use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Duration, SystemTime};

use sqlx::postgres::PgConnection;

use crate::store::Error;
use crate::store::sql::{Connection, Row, Statement};

/// Differences below this are the network's, not the clocks': leases last seconds.
const IN_STEP: Duration = Duration::from_millis(100);

/// How far the database's clock is ahead of this machine's, in microseconds.
#[derive(Debug, Default)]
pub(super) struct Clock(AtomicI64);

impl Clock {
    /// Compares the clocks.
    pub(super) async fn set(&self, connection: &mut PgConnection) -> Result<(), Error> {
        let select = Statement::new("SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000000 AS BIGINT) AS micros");
        let asked = SystemTime::now();
        let theirs = connection.row(select).await?.integer("micros")?;
        let answered = SystemTime::now();
        let since_epoch = |time: SystemTime| time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        // They read their clock some time in between.
        let ours = (since_epoch(asked) + since_epoch(answered)) / 2;
        let ahead = theirs.saturating_sub(i64::try_from(ours.as_micros()).unwrap_or(i64::MAX));
        let uncertain = since_epoch(answered).saturating_sub(since_epoch(asked)) / 2 + IN_STEP;
        let in_step = u128::from(ahead.unsigned_abs()) <= uncertain.as_micros();
        let ahead = if in_step { 0 } else { ahead };
        if self.0.swap(ahead, Ordering::Relaxed) == 0 && ahead != 0 {
            tracing::warn!(ahead_seconds = ahead as f64 / 1e6, "the database's clock is not this machine's");
        }
        Ok(())
    }

    /// The database's time when this machine's clock shows `now`.
    pub(super) fn translate(&self, now: SystemTime) -> SystemTime {
        let ahead = self.0.load(Ordering::Relaxed);
        let distance = Duration::from_micros(ahead.unsigned_abs());
        let there = if ahead < 0 { now.checked_sub(distance) } else { now.checked_add(distance) };
        there.unwrap_or(now)
    }

    /// As if the clocks were so far apart.
    #[cfg(test)]
    pub(super) fn pretend(&self, ahead: Duration) {
        self.0.store(ahead.as_micros() as i64, Ordering::Relaxed);
    }
}
