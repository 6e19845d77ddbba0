//! What the SQL databases say in the same words: the statements, what their rows mean, and in which transaction what
//! changes. A database adds how it is opened, its schema and the few words that are its own, through [`Connection`] and
//! [`Database`].

mod admin;
mod admission;
mod attempts;
mod claims;
mod fairness;
mod inputs;
mod jobs;
mod operation;
mod removal;
mod rows;
mod statement;
mod uploads;
mod webhooks;

use std::time::{Duration, SystemTime};

use futures_util::future::BoxFuture;
use sqlx::SqlSafeStr;
use sqlx::migrate::{Migration, MigrationType, Migrator};

use super::{Error, Notification};
use crate::domain::FEW_OBSERVATIONS;
pub(super) use rows::{as_micros, micros, time};
pub(super) use statement::{Row, Statement, Value};

/// A connection to a database, within a transaction or not: unless it says otherwise, one that has the database to
/// itself when it writes.
#[async_trait::async_trait]
pub trait Connection: Send {
    /// Whether a transaction that writes is alone in the database: what it has seen stays as it is.
    fn writes_alone(&self) -> bool {
        true
    }

    /// Runs a statement to its end and returns its rows.
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error>;

    /// Waits until no other transaction has the lock, and keeps it until this one ends.
    async fn take_lock(&mut self, _lock: Lock) -> Result<(), Error> {
        Ok(())
    }

    /// Notifies other processes of a change, once it is committed.
    async fn notify(&mut self, _notification: Notification) -> Result<(), Error> {
        Ok(())
    }
}

impl dyn Connection + '_ {
    /// Ends a `SELECT` whose rows the transaction is about to change.
    fn for_update(&self) -> &'static str {
        if self.writes_alone() { "" } else { " FOR UPDATE" }
    }

    /// The same, passing over the rows that another transaction is changing.
    fn skip_locked(&self) -> &'static str {
        if self.writes_alone() { "" } else { " FOR UPDATE SKIP LOCKED" }
    }

    /// The one row of a statement that always has one.
    pub(super) async fn row(&mut self, statement: Statement) -> Result<Row, Error> {
        let row = self.optional_row(statement).await?;
        row.ok_or_else(|| Error::Corrupt("a row that was just written is not there".into()))
    }

    /// The first row, if there is any.
    pub(super) async fn optional_row(&mut self, statement: Statement) -> Result<Option<Row>, Error> {
        Ok(self.rows(statement).await?.into_iter().next())
    }

    /// Runs statements in their order, of which none needs another's answer. Returns the rows of all of them.
    async fn batch(&mut self, statements: Vec<Statement>) -> Result<Vec<Row>, Error> {
        let mut rows = Vec::new();
        for statement in statements {
            rows.append(&mut self.rows(statement).await?);
        }
        Ok(rows)
    }

    /// Runs a statement that has no rows.
    pub(super) async fn execute(&mut self, statement: Statement) -> Result<(), Error> {
        self.rows(statement).await.map(drop)
    }
}

/// What one transaction at a time may do, where writing is not that by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lock {
    /// Admit jobs: the bounds of the queue hold over all servers.
    Admission,
    /// Claim jobs, where there is a bound on those of a tenant that run.
    Claims,
}

/// What is one transaction. It may be run again where its transaction came to nothing.
pub type Operation<C, T> = Box<dyn for<'c> Fn(&'c mut C) -> BoxFuture<'c, Result<T, Error>> + Send + Sync + 'static>;

/// An operation from a closure.
pub(super) fn operation<C: ?Sized, T>(
    run: impl for<'c> Fn(&'c mut C) -> BoxFuture<'c, Result<T, Error>> + Send + Sync + 'static,
) -> Operation<C, T> {
    Box::new(run)
}

/// What a store needs of its database; the store's operations are in the other files of this folder.
#[async_trait::async_trait]
pub trait Database: Send + Sync + 'static {
    /// Whether other processes may hold leases and change jobs.
    fn is_shared(&self) -> bool;

    /// A connection that only reads.
    async fn reader(&self, size: Size) -> Result<Box<dyn Connection>, Error>;

    /// Runs an operation in a transaction, and answers once it is committed and durable. Where it is refused, nothing
    /// of it is.
    async fn write(
        &self,
        size: Size,
        intent: WriteIntent,
        operation: Operation<dyn Connection, ()>,
    ) -> Result<(), Error>;

    /// How long an operation of this size may take; `None`: as long as it does.
    fn bound(&self, _size: Size) -> Option<Duration> {
        None
    }

    /// The time on the clock that leases run on, where the caller's shows `now`: one clock for every process that holds
    /// or takes back leases, and a steady one.
    fn lease_clock(&self, now: SystemTime) -> SystemTime;

    /// Compares the caller's clock with that of the leases; called again and again, as clocks drift.
    async fn set_lease_clock(&self) -> Result<(), Error> {
        Ok(())
    }

    /// Gives back the space of what was removed, some of it at a time; a database that does so by itself does nothing
    /// here.
    async fn vacuum(&self) -> Result<(), Error> {
        Ok(())
    }

    /// Bytes that the database takes.
    async fn bytes(&self) -> Result<u64, Error>;

    /// Whether there was room to begin something at the last look, where the store looks: a shared one is for its own
    /// operators to watch.
    fn has_room(&self) -> bool {
        true
    }

    /// Waits for a change by another process. Notifications may be lost, repeated or stale: whoever handles them looks
    /// into the store, and looks from time to time without one. Never answers where the store is not shared. For one
    /// caller at a time.
    async fn notification(&self) -> Notification {
        std::future::pending().await
    }

    /// Closes every connection; what was acknowledged is durable without it.
    async fn close(&self);
}

/// What an operation moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// A few rows, found by their keys.
    Small,
    /// A page of a listing, or what is counted over all jobs.
    Page,
    /// An input or a result, for a caller who can wait.
    Payload,
    /// A result, under a lease that may run out.
    Outcome,
}

impl Size {
    /// That of the input, or of the result, of a job of so many observations.
    fn of_payload(observations: u32) -> Self {
        if observations <= FEW_OBSERVATIONS { Self::Small } else { Self::Payload }
    }
}

/// What an operation does to the room on the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WriteIntent {
    /// It begins something that writes about so many bytes, now or later: on a full disk nothing new is begun.
    Begins(u64),
    /// It changes a few rows.
    Little,
    /// It removes about so many bytes, or writes them to bring to an end what was begun: on a full disk it goes first.
    Ends(u64),
}

impl WriteIntent {
    pub(super) fn bytes(self) -> u64 {
        match self {
            Self::Begins(bytes) | Self::Ends(bytes) => bytes,
            Self::Little => 0,
        }
    }
}

/// A migration: its version, its name and its SQL. Published ones are never edited.
pub(super) type Step = (i64, &'static str, &'static str);

/// The migrations in order.
pub(super) fn migrator(steps: &[Step]) -> Migrator {
    let migrations = steps
        .iter()
        .map(|&(version, name, sql)| {
            Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
        })
        .collect();
    Migrator::with_migrations(migrations)
}

/// A database that took a step which these migrations do not have, or have otherwise.
pub(super) fn other_version(step: i64) -> Error {
    Error::Corrupt(format!(
        "step {step} of its schema is not of this version: it is the store of a newer server, or of an earlier build. \
         Let that build end its jobs, and begin with a new data directory or database"
    ))
}
