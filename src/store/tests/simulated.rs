//! A database for simulations: the SQL that ships, on one SQLite in memory that all simulated servers share, each of
//! them behind a network of its own whose faults are drawn by seed.
//!
//! Nothing here waits for a thread: all time that passes is that of tokio's paused clock.

use std::ops::Deref;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use futures_util::FutureExt;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::sync::{OwnedMutexGuard, broadcast};
use tokio::time::{Instant, sleep};

use crate::store::clock::LeaseClock;
use crate::store::sql::{Connection, Database, Operation, Row, Size, Statement, WriteIntent, micros};
use crate::store::sqlite::SqliteConnection;
use crate::store::{Clock, Error, Notification, Store};

/// Notifications that a server may be behind before it is told that some are lost.
const NOTIFICATIONS: usize = 16;

/// How long an operation may take, as for PostgreSQL.
const BOUND: Duration = Duration::from_secs(10);

/// A defect that is built in on purpose, for the simulation to find.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Bug {
    /// A claim takes a job that another worker has.
    DoubleClaim,
    /// A write whose lease is lost is made all the same.
    LateWrite,
    /// A reader of events passes one over now and then.
    MissedEvent,
    /// Jobs that lost attempts run among others.
    SuspectsTogether,
    /// A tenant runs more jobs at once than it may.
    UnboundedTenant,
}

/// What happens to the operations of one server from now on.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Faults {
    /// The longest that a request or an answer is on its way.
    pub delay: Duration,
    /// Share of the requests that do not reach the database, and of the answers that do not come back.
    pub lost: f64,
    /// Share of the requests and answers that hang until the caller gives up.
    pub hanging: f64,
    /// Share of the notifications that are lost.
    pub lost_notifications: f64,
    /// The database is out of reach.
    pub partitioned: bool,
    /// Nothing that begins something can be stored.
    pub full: bool,
    /// How far the server's clock is ahead of the database's, in seconds.
    pub clock_ahead: i32,
}

/// The way of one server to the database.
#[derive(Debug)]
pub(crate) struct Link {
    faults: Faults,
    rng: ChaCha8Rng,
}

impl Link {
    /// Sets the faults from now on.
    pub(crate) fn set(&mut self, faults: Faults) {
        self.faults = faults;
    }

    pub(crate) fn faults(&self) -> Faults {
        self.faults
    }
}

/// Where everything is stored.
#[derive(Clone)]
pub(crate) struct Cluster {
    connection: Arc<tokio::sync::Mutex<SimulatedConnection>>,
    notifications: broadcast::Sender<Notification>,
}

impl Cluster {
    /// An empty database.
    pub(crate) fn new(bug: Option<Bug>) -> Self {
        let inner = SqliteConnection::in_memory().expect("a database in memory");
        let connection = SimulatedConnection { inner, committing: Vec::new(), bug, reads: 0 };
        Self {
            connection: Arc::new(tokio::sync::Mutex::new(connection)),
            notifications: broadcast::Sender::new(NOTIFICATIONS),
        }
    }

    /// A server's connection, at the time `now` of the database's clock. `SHARED`: whether there may be others.
    pub(crate) fn connect<const SHARED: bool>(&self, seed: u64, now: SystemTime) -> Simulated<SHARED> {
        let link = Link { faults: Faults::default(), rng: ChaCha8Rng::seed_from_u64(seed) };
        let link = Arc::new(Mutex::new(link));
        let origin = Instant::now();
        let database_clock = Clock::new(move || now + origin.elapsed());
        let wall_clock = {
            let (database_clock, link) = (database_clock.clone(), link.clone());
            Clock::new(move || {
                let ahead = link.lock().unwrap_or_else(PoisonError::into_inner).faults.clock_ahead;
                let distance = Duration::from_secs(ahead.unsigned_abs().into());
                let time = database_clock.now();
                if ahead < 0 { time - distance } else { time + distance }
            })
        };
        Simulated {
            cluster: self.clone(),
            link,
            lease_clock: LeaseClock::new(wall_clock.clone()),
            database_clock,
            wall_clock,
            notifications: tokio::sync::Mutex::new(self.notifications.subscribe()),
        }
    }

    /// The column `number` of what a query finds, past every fault.
    pub(crate) fn numbers(&self, query: &'static str) -> Vec<i64> {
        let mut connection = self.connection.try_lock().expect("between two steps no transaction is open");
        let rows = connection.inner.rows(Statement::new(query)).now_or_never().expect("it waits for nothing");
        let rows = rows.expect("a valid query");
        rows.iter().map(|row| row.integer("number").expect("a number")).collect()
    }
}

/// The store of one simulated server.
pub(crate) struct Simulated<const SHARED: bool> {
    cluster: Cluster,
    link: Arc<Mutex<Link>>,
    database_clock: Clock,
    /// The server's.
    wall_clock: Clock,
    lease_clock: LeaseClock,
    notifications: tokio::sync::Mutex<broadcast::Receiver<Notification>>,
}

impl<const SHARED: bool> Deref for Simulated<SHARED> {
    type Target = Store;

    fn deref(&self) -> &Store {
        self
    }
}

/// Which way something is on the link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    There,
    Back,
}

impl<const SHARED: bool> Simulated<SHARED> {
    /// The way to the database, for its faults to be set.
    pub(crate) fn link(&self) -> Arc<Mutex<Link>> {
        self.link.clone()
    }

    /// The wall clock of the server.
    pub(crate) fn wall_clock(&self) -> Clock {
        self.wall_clock.clone()
    }

    fn locked(&self) -> MutexGuard<'_, Link> {
        self.link.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Passes a request or an answer, or not.
    async fn pass(&self, way: Way) -> Result<(), Error> {
        let (delay, hangs, is_lost) = {
            let Link { faults, rng, .. } = &mut *self.locked();
            let delay = faults.delay.mul_f64(rng.random::<f64>());
            let hangs = rng.random_bool(faults.hanging);
            // What is committed while the network breaks is committed, and its answer is lost.
            (delay, hangs, rng.random_bool(faults.lost) || faults.partitioned)
        };
        sleep(delay).await;
        if hangs {
            std::future::pending::<()>().await;
        }
        match is_lost {
            true => Err(Error::Unavailable(format!("the connection broke ({way:?})"))),
            false => Ok(()),
        }
    }
}

#[async_trait::async_trait]
impl<const SHARED: bool> Database for Simulated<SHARED> {
    fn is_shared(&self) -> bool {
        SHARED
    }

    async fn reader(&self, _size: Size) -> Result<Box<dyn Connection>, Error> {
        self.pass(Way::There).await?;
        Ok(Box::new(ReadConnection(self.cluster.connection.clone().lock_owned().await)))
    }

    async fn write(
        &self,
        _size: Size,
        intent: WriteIntent,
        operation: Operation<dyn Connection, ()>,
    ) -> Result<(), Error> {
        self.pass(Way::There).await?;
        let is_full = self.locked().faults.full;
        let outcome = {
            let mut connection = self.cluster.connection.lock().await;
            let outcome = connection.transaction(&operation, is_full && matches!(intent, WriteIntent::Begins(_))).await;
            for change in std::mem::take(&mut connection.committing) {
                // Without a server that listens there is nobody to notify.
                let _ = self.cluster.notifications.send(change);
            }
            outcome
        };
        self.pass(Way::Back).await?;
        outcome
    }

    fn bound(&self, _size: Size) -> Option<Duration> {
        Some(BOUND)
    }

    fn lease_clock(&self, now: SystemTime) -> SystemTime {
        self.lease_clock.translate(now)
    }

    async fn set_lease_clock(&self) -> Result<(), Error> {
        if !SHARED {
            return Ok(());
        }
        let asked = Instant::now();
        self.pass(Way::There).await?;
        let theirs = micros(self.database_clock.now());
        self.pass(Way::Back).await?;
        self.lease_clock.follow(theirs, asked);
        Ok(())
    }

    async fn bytes(&self) -> Result<u64, Error> {
        let select = "SELECT page_count * page_size AS bytes FROM pragma_page_count(), pragma_page_size()";
        let row = self.reader(Size::Small).await?.row(Statement::new(select)).await?;
        Ok(u64::try_from(row.integer("bytes")?).unwrap_or(0))
    }

    fn has_room(&self) -> bool {
        !self.locked().faults.full
    }

    async fn notification(&self) -> Notification {
        if !SHARED {
            return std::future::pending().await;
        }
        loop {
            let received = self.notifications.lock().await.recv().await;
            let Link { faults, rng, .. } = &mut *self.locked();
            if rng.random_bool(faults.lost_notifications) || faults.partitioned {
                continue;
            }
            return received.unwrap_or(Notification::Missed);
        }
    }

    async fn close(&self) {}
}

/// The one connection, lent to a reader.
pub(crate) struct ReadConnection(OwnedMutexGuard<SimulatedConnection>);

#[async_trait::async_trait]
impl Connection for ReadConnection {
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        self.0.rows(statement).await
    }
}

/// The connection that all servers share.
pub(crate) struct SimulatedConnection {
    inner: SqliteConnection,
    /// Sent to the others once the transaction is committed.
    committing: Vec<Notification>,
    bug: Option<Bug>,
    /// Reads of events so far.
    reads: u32,
}

impl SimulatedConnection {
    /// Runs an operation in a transaction. On a full disk one that is to begin something may write nothing.
    async fn transaction(&mut self, operation: &Operation<dyn Connection, ()>, is_full: bool) -> Result<(), Error> {
        self.inner.control("BEGIN IMMEDIATE")?;
        let before = self.inner.changes();
        let mut outcome = operation(self).await;
        if let (Err(Error::Fenced(lease)), Some(Bug::LateWrite)) = (&outcome, self.bug) {
            let late = Statement::new(
                "UPDATE jobs SET last_sequence = last_sequence + 1 WHERE tenant = $1 AND job = $2 \
                 RETURNING id, last_sequence",
            );
            let late = late.bind(&lease.name.tenant).bind(&lease.name.job);
            if let [job] = self.inner.rows(late).await?.as_slice() {
                let (id, sequence) = (job.integer("id")?, job.integer("last_sequence")?);
                let insert = "INSERT INTO events SELECT job_id, $1, $2, time, body FROM events \
                              WHERE job_id = $3 AND sequence = 1";
                let insert = Statement::new(insert).bind(sequence).bind(lease.attempt).bind(id);
                self.inner.rows(insert).await?;
            }
            self.inner.control("COMMIT")?;
            return outcome;
        }
        if outcome.is_ok() && is_full && self.inner.changes() != before {
            outcome = Err(Error::NoSpace("the simulated disk is full".into()));
        }
        if outcome.is_ok() {
            self.inner.control("COMMIT")?;
        } else {
            self.committing.clear();
            self.inner.control("ROLLBACK")?;
        }
        outcome
    }
}

#[async_trait::async_trait]
impl Connection for SimulatedConnection {
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        let bug = self.bug;
        let statement = match bug {
            Some(Bug::DoubleClaim) if statement.sql().contains("ORDER BY priority") => {
                statement.replaced("state = 'QUEUED'", "state IN ('QUEUED', 'RUNNING')")
            }
            Some(Bug::UnboundedTenant) if statement.sql().contains("AS leased GROUP BY tenant") => {
                statement.replaced("COUNT(*) >=", "COUNT(*) < 0 AND 0 <")
            }
            Some(Bug::SuspectsTogether) if statement.sql().contains("state = 'QUEUED'") => {
                statement.replaced("attempt, lost_attempts,", "attempt, 0 AS lost_attempts,")
            }
            _ => statement,
        };
        let reads_events = statement.sql().contains("FROM events");
        let mut rows = self.inner.rows(statement).await?;
        if bug == Some(Bug::MissedEvent) && reads_events && rows.len() > 1 {
            self.reads += 1;
            if self.reads.is_multiple_of(7) {
                rows.remove(0);
            }
        }
        Ok(rows)
    }

    async fn notify(&mut self, notification: Notification) -> Result<(), Error> {
        self.committing.push(notification);
        Ok(())
    }
}

mod tests {
    use super::*;
    use crate::store::contract::store_contract;

    async fn open() -> Option<Arc<Simulated<true>>> {
        Some(Arc::new(Cluster::new(None).connect(0, SystemTime::UNIX_EPOCH)))
    }

    store_contract!(open);
}
