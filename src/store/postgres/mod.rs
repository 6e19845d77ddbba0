//! The shared store: PostgreSQL, which several servers use as one.
//!
//! Every write of a worker is conditioned on its lease under the job's row lock, so that of two servers that think they
//! hold a job one is refused. Notifications carry the names of jobs: what they say is read from the tables.

mod connection;
mod listener;
#[cfg(test)]
mod locks_tests;
mod schema;
#[cfg(test)]
pub(crate) mod tests;
mod url;

use std::time::{Duration, SystemTime};

use sqlx::postgres::{PgConnectOptions, PgConnection, PgPool, PgPoolOptions};
use tokio::sync::Mutex;
use tokio::time::{Instant, timeout};

use super::clock::LeaseClock;
use super::sql::{Connection, Database, Operation, Size, Statement, WriteIntent};
use super::{Clock, Error, Notification};
use listener::Listener;
pub use url::{DatabaseUrl, UrlError};

/// Connections of one server, beside the one that listens: a worker writes a few times a second, an idle one looks once
/// a second. PostgreSQL's own default of a hundred connections leaves room for some ten servers.
const CONNECTIONS: u32 = 6;
/// Connections for inputs and results of callers. Apart, since each may take half a minute, and no lease may be lost
/// because its heartbeat waits behind uploads.
const PAYLOAD_CONNECTIONS: u32 = 3;
/// How long a caller waits for a connection. Callers are told soon that the database is away, before their timeout or
/// a worker's lease is over.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(3);
/// How long an operation on a few rows may take: what takes longer waits for a database that does not answer.
const SMALL_BOUND: Duration = Duration::from_secs(5);
/// How long an input or a result may be on its way: 100 MB at some 3.5 MB/s.
const PAYLOAD_BOUND: Duration = Duration::from_secs(30);
/// How long a connection that comes back may take to answer before it is thrown away.
const RELEASE_TIMEOUT: Duration = Duration::from_secs(1);

/// What the database ends by itself, in milliseconds, so that a server that was stopped in the middle of a transaction
/// holds no locks that others wait for. An idle connection is none of these.
const SESSION: [(&str, &str); 6] = [
    ("application_name", "scpsfm"),
    ("statement_timeout", "30000"),
    ("idle_in_transaction_session_timeout", "5000"),
    // A connection whose peer vanished without a word, after a minute: three questions ten seconds apart after half a
    // minute of silence. PostgreSQL's default is two hours.
    ("tcp_keepalives_idle", "30"),
    ("tcp_keepalives_interval", "10"),
    ("tcp_keepalives_count", "3"),
];

/// Store in a PostgreSQL database.
#[derive(Debug)]
pub struct Postgres {
    pool: PgPool,
    payloads: PgPool,
    clock: LeaseClock,
    listener: Mutex<Listener>,
    /// Gets no notifications, for tests of what polls alone achieve.
    #[cfg(test)]
    pub(crate) deaf: bool,
}

impl Postgres {
    /// Opens the store in a database that exists and brings its schema up to date.
    ///
    /// # Errors
    /// [`Error::Unavailable`] where the database does not answer or refuses, or another server is at the schema for too
    /// long, [`Error::Corrupt`] where its schema is of a newer version.
    pub async fn open(url: &DatabaseUrl) -> Result<Self, Error> {
        let options = url.options().clone().options(SESSION);
        let pool = match pool_of(CONNECTIONS).connect_with(options.clone()).await {
            // A pool says how long it waited, not for what.
            Err(sqlx::Error::PoolTimedOut) => return Err(cause_of_no_connection(&options).await),
            pool => pool?,
        };
        let payloads = pool_of(PAYLOAD_CONNECTIONS).connect_lazy_with(options.clone());
        schema::update(&options).await?;
        let store = Self {
            pool,
            payloads,
            clock: LeaseClock::new(Clock::default()),
            listener: Mutex::new(Listener::new(options)),
            #[cfg(test)]
            deaf: false,
        };
        store.set_lease_clock().await?;
        Ok(store)
    }

    fn pool(&self, size: Size) -> &PgPool {
        match size {
            Size::Small | Size::Page | Size::Outcome => &self.pool,
            Size::Payload => &self.payloads,
        }
    }
}

async fn cause_of_no_connection(options: &PgConnectOptions) -> Error {
    let connecting = <PgConnection as sqlx::Connection>::connect_with(options);
    match timeout(ACQUIRE_TIMEOUT, connecting).await {
        Ok(Err(cause)) => cause.into(),
        Ok(Ok(_)) | Err(_) => sqlx::Error::PoolTimedOut.into(),
    }
}

fn pool_of(connections: u32) -> PgPoolOptions {
    PgPoolOptions::new()
        .max_connections(connections)
        .acquire_timeout(ACQUIRE_TIMEOUT)
        // A connection that does not answer would keep its place until the network gives it up, a quarter of an hour.
        .after_release(|connection, _| {
            Box::pin(async move {
                match timeout(RELEASE_TIMEOUT, sqlx::Connection::ping(connection)).await {
                    Ok(answer) => answer.map(|()| true),
                    Err(_) => Err(sqlx::Error::PoolTimedOut),
                }
            })
        })
}

#[async_trait::async_trait]
impl Database for Postgres {
    fn is_shared(&self) -> bool {
        true
    }

    async fn reader(&self, size: Size) -> Result<Box<dyn Connection>, Error> {
        Ok(Box::new(self.pool(size).acquire().await?))
    }

    async fn write(
        &self,
        size: Size,
        _intent: WriteIntent,
        operation: Operation<dyn Connection, ()>,
    ) -> Result<(), Error> {
        let mut transaction = self.pool(size).begin().await?;
        let outcome = operation(&mut *transaction).await;
        match outcome {
            Ok(()) => transaction.commit().await?,
            // Dropped, it would be rolled back some time later: until then its locks hide rows from those who pass over
            // what is locked. Where it fails, the connection is gone, and they with it.
            Err(_) => drop(transaction.rollback().await),
        }
        outcome
    }

    fn bound(&self, size: Size) -> Option<Duration> {
        Some(match size {
            Size::Small | Size::Page => SMALL_BOUND,
            Size::Payload | Size::Outcome => PAYLOAD_BOUND,
        })
    }

    fn lease_clock(&self, now: SystemTime) -> SystemTime {
        self.clock.translate(now)
    }

    async fn set_lease_clock(&self) -> Result<(), Error> {
        let select = Statement::new("SELECT CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000000 AS BIGINT) AS micros");
        let mut connection = self.reader(Size::Small).await?;
        let asked = Instant::now();
        let theirs = connection.row(select).await?.integer("micros")?;
        self.clock.follow(theirs, asked);
        Ok(())
    }

    async fn bytes(&self) -> Result<u64, Error> {
        let select = Statement::new("SELECT pg_database_size(current_database()) AS bytes");
        let row = self.reader(Size::Small).await?.row(select).await?;
        Ok(u64::try_from(row.integer("bytes")?).unwrap_or(0))
    }

    async fn notification(&self) -> Notification {
        #[cfg(test)]
        if self.deaf {
            return std::future::pending().await;
        }
        self.listener.lock().await.next().await
    }

    async fn close(&self) {
        self.listener.lock().await.close().await;
        self.payloads.close().await;
        self.pool.close().await;
    }
}
