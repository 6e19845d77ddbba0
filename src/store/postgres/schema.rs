//! Brings the schema up to date, over a connection of its own: what callers wait for is bounded by the session, and a
//! step on a large table takes as long as it takes.

use std::time::Duration;

use sqlx::migrate::{Migrate, MigrateError};
use sqlx::postgres::{PgConnectOptions, PgConnection};
use tokio::time::{Instant, timeout};

use super::ACQUIRE_TIMEOUT;
use crate::store::Error;
use crate::store::sql::{self, Connection, Statement, Step};

const MIGRATIONS: [Step; 1] = [(1, "schema", include_str!("../migrations/postgres/0001_schema.sql"))];

/// How long a server waits for another one that is at the schema: a step that goes through some ten million jobs takes
/// minutes. Then it ends, and whoever started it may start it again.
const SCHEMA_LOCK_TIMEOUT: Duration = Duration::from_secs(15 * 60);

/// Between two lines that say that it waits.
const LOG_PERIOD: Duration = Duration::from_secs(5);

/// How long a step waits for a table, all of whose users wait behind it: as long as the longest statement of a server.
/// Only others, such as a backup, hold one for longer.
const TABLE_LOCK_TIMEOUT: Duration = Duration::from_secs(30);

/// What a wait for a lock ends with that took too long (PostgreSQL, appendix A: `lock_not_available`).
const LOCK_NOT_AVAILABLE: &str = "55P03";

/// Brings the schema up to date, or waits until another server has.
///
/// # Errors
/// [`Error::Unavailable`] where the database refuses, or another server takes too long; [`Error::Corrupt`] where its
/// schema is of a newer version.
pub(super) async fn update(options: &PgConnectOptions) -> Result<(), Error> {
    migrate(options, &MIGRATIONS, SCHEMA_LOCK_TIMEOUT).await
}

async fn migrate(options: &PgConnectOptions, steps: &[Step], lock_timeout: Duration) -> Result<(), Error> {
    // Of two values of a setting, the later one holds.
    let options = options.clone().options([("statement_timeout", "0")]);
    let connecting = <PgConnection as sqlx::Connection>::connect_with(&options);
    let mut connection = timeout(ACQUIRE_TIMEOUT, connecting).await.map_err(|_| sqlx::Error::PoolTimedOut)??;
    lock(&mut connection, lock_timeout).await?;
    bound_locks(&mut connection, TABLE_LOCK_TIMEOUT).await?;
    // The lock ends with the connection, however this does.
    let mut migrator = sql::migrator(steps);
    migrator.set_locking(false);
    let migrated = migrator.run(&mut connection).await.map_err(failed);
    // What was done is committed: there is nothing to lose with the connection.
    let _ = timeout(ACQUIRE_TIMEOUT, sqlx::Connection::close(connection)).await;
    migrated
}

/// Waits until no other server is at the schema, and keeps others from it. Says so while it waits.
async fn lock(connection: &mut PgConnection, lock_timeout: Duration) -> Result<(), Error> {
    bound_locks(connection, lock_timeout).await?;
    let too_long = || {
        let seconds = lock_timeout.as_secs_f64();
        Error::Unavailable(format!("waited {seconds} s for other servers that bring the schema up to date"))
    };
    let begun = Instant::now();
    let mut lock = connection.lock();
    loop {
        match timeout(LOG_PERIOD, &mut lock).await {
            Ok(Err(error)) if is_late(&error) => return Err(too_long()),
            Ok(locked) => return locked.map_err(failed),
            // The database ends the wait by itself, unless it has gone away meanwhile.
            Err(_) if begun.elapsed() > lock_timeout + ACQUIRE_TIMEOUT => return Err(too_long()),
            Err(_) => tracing::info!(
                waited_seconds = begun.elapsed().as_secs(),
                "waiting for another server that brings the schema up to date"
            ),
        }
    }
}

/// How long each wait for a lock may take from here on.
async fn bound_locks(connection: &mut PgConnection, bound: Duration) -> Result<(), Error> {
    // 0 would be no bound.
    let milliseconds = bound.as_millis().max(1).to_string();
    let set = Statement::new("SELECT set_config('lock_timeout', $1, FALSE)").bind(&milliseconds);
    connection.rows(set).await.map(drop)
}

fn is_late(error: &MigrateError) -> bool {
    let MigrateError::Execute(error) = error else { return false };
    error.as_database_error().and_then(|cause| cause.code()).as_deref() == Some(LOCK_NOT_AVAILABLE)
}

/// Why the schema cannot be brought up to date.
fn failed(error: MigrateError) -> Error {
    match error {
        MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _) => error.into(),
        MigrateError::VersionMissing(step) | MigrateError::VersionMismatch(step) => sql::other_version(step),
        error => Error::Corrupt(format!("cannot bring the schema up to date: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::cluster;
    use super::super::url::DatabaseUrl;
    use super::*;

    /// How a server that holds its statements to a bound reaches a database without a schema.
    async fn hasty(cluster: &cluster::Cluster) -> PgConnectOptions {
        let url: DatabaseUrl = cluster.database().await.parse().expect("an address");
        url.options().clone().options([("statement_timeout", "100")])
    }

    async fn connected(options: &PgConnectOptions) -> PgConnection {
        <PgConnection as sqlx::Connection>::connect_with(options).await.expect("a connection")
    }

    #[tokio::test]
    async fn a_step_may_take_longer_than_what_a_caller_waits_for() {
        let Some(cluster) = cluster::shared("a step of the schema that takes long") else { return };
        let options = hasty(&cluster).await;
        let sleep = "SELECT pg_sleep(0.5)";
        let statement = connected(&options).await.rows(Statement::new(sleep)).await;
        assert!(statement.is_err(), "a caller's is ended");
        migrate(&options, &[(1, "slow", sleep)], SCHEMA_LOCK_TIMEOUT).await.expect("takes its time");
        let mut connection = connected(&options).await;
        let done = connection.rows(Statement::new("SELECT version FROM _sqlx_migrations")).await.expect("a table");
        assert_eq!(done.iter().map(|row| row.integer("version")).collect::<Vec<_>>(), [Ok(1)]);
    }

    #[tokio::test]
    async fn the_wait_for_another_server_is_bounded_and_says_what_it_was_for() {
        let Some(cluster) = cluster::shared("two servers that bring one schema up to date") else { return };
        let options = hasty(&cluster).await;
        let mut other = connected(&options).await;
        other.lock().await.expect("the lock");
        let error = migrate(&options, &MIGRATIONS, Duration::from_millis(300)).await.expect_err("is held");
        let expected = "waited 0.3 s for other servers that bring the schema up to date";
        assert_eq!(error, Error::Unavailable(expected.into()));
        // One that waits goes on once the other is through.
        let waiting = migrate(&options, &MIGRATIONS, SCHEMA_LOCK_TIMEOUT);
        let unlocking = async {
            let waiters = "SELECT COUNT(*) AS count FROM pg_locks WHERE locktype = 'advisory' AND NOT granted \
                           AND database = (SELECT oid FROM pg_database WHERE datname = current_database())";
            let look = async {
                while other.rows(Statement::new(waiters)).await.expect("counts")[0].integer("count") != Ok(1) {
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
            };
            timeout(Duration::from_secs(60), look).await.expect("nobody waits");
            other.unlock().await.expect("unlocks");
        };
        let (migrated, ()) = tokio::join!(waiting, unlocking);
        migrated.expect("up to date");
        migrate(&options, &MIGRATIONS, SCHEMA_LOCK_TIMEOUT)
            .await
            .expect("nothing is left to do, and nobody holds the lock");
    }
}
