//! What the writer's thread does: groups, their commits, and what a full disk asks for.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use tokio::sync::mpsc;

use super::Message;
use super::pending::Pending;
use crate::store::Error;
use crate::store::sql::WriteIntent;
use crate::store::sqlite::ballast::{BALLAST_BYTES, Ballast, RETRY};
use crate::store::sqlite::connection::SqliteConnection;
use crate::store::sqlite::log::{LONG_PAGES, Log};
use crate::store::sqlite::vacuum::VACUUM_BYTES;
use crate::telemetry::metrics;

/// Begun as a writer at once: a transaction that began by reading could not be upgraded after another process wrote.
const BEGIN: &str = "BEGIN IMMEDIATE";

/// What the thread has.
pub(super) struct CommitBatcher {
    /// `None`: the last one was of no more use.
    connection: Option<SqliteConnection>,
    database: PathBuf,
    ballast: Ballast,
    /// When the ballast was last given up so that the log could be cut. For a while that is not tried again: it may
    /// have won nothing.
    gave_for_log: Option<Instant>,
    messages: mpsc::UnboundedReceiver<Message>,
    group_time: Duration,
}

/// An operation of a group and what it came to: answered with that once the group is committed, also where it was
/// refused, as it may have seen what the others had written.
type Executed = (Pending, Result<(), Error>);

impl CommitBatcher {
    pub(super) fn new(
        connection: SqliteConnection,
        database: PathBuf,
        ballast: Ballast,
        messages: mpsc::UnboundedReceiver<Message>,
        group_time: Duration,
    ) -> Self {
        Self { connection: Some(connection), database, ballast, gave_for_log: None, messages, group_time }
    }

    /// Works until every handle is gone, or it is told to close.
    pub(super) async fn serve(mut self) {
        let mut next = self.messages.recv().await;
        while let Some(message) = next {
            let left_over = match message {
                Message::Write(first) => {
                    let left_over = self.group(first).await;
                    self.write_log_back(LONG_PAGES);
                    left_over
                }
                Message::VacuumPays(reply) => {
                    let _ = reply.send(self.vacuum_pays());
                    None
                }
                Message::Shorten(done) => {
                    self.shorten();
                    let _ = done.send(());
                    None
                }
                Message::Close(done) => {
                    if let Some(Err(error)) = self.connection.take().map(SqliteConnection::close) {
                        tracing::debug!(%error, "the log is left to the next start");
                    }
                    let _ = done.send(());
                    return;
                }
            };
            next = match left_over {
                Some(message) => Some(message),
                None => self.messages.recv().await,
            };
        }
    }

    /// Runs operations until none waits, commits them together and answers them; a large one alone. Returns what it was
    /// handed and is no part of the group: a large operation, or what is none.
    async fn group(&mut self, first: Pending) -> Option<Message> {
        // Here, and not where one is run again, for which the ballast was given up.
        if self.ballast.is_due() {
            self.cut_log();
            self.ballast.restore();
        }
        let begun = Instant::now();
        let alone = first.is_large();
        let mut left_over = None;
        let mut group: Vec<Executed> = Vec::new();
        let mut next = Some(first);
        while let Some(operation) = next.take() {
            if operation.begins() {
                let result = match group.is_empty() {
                    true => self.open(&operation).await.map(Ok),
                    false => self.join(&operation).await,
                };
                match result {
                    Ok(outcome) => group.push((operation, outcome)),
                    // Nothing of anyone else's is in the transaction, or has been seen in it.
                    Err(error) if group.is_empty() => {
                        let helped = self.with_ballast(&operation, error).await;
                        operation.answer(helped);
                    }
                    Err(error) => {
                        self.roll_back();
                        group.push((operation, Ok(())));
                        self.each_alone(group, error).await;
                        return None;
                    }
                }
            }
            if alone || begun.elapsed() >= self.group_time {
                break;
            }
            match self.messages.try_recv() {
                Ok(Message::Write(operation)) if !operation.is_large() => next = Some(operation),
                Ok(other) => left_over = Some(other),
                Err(_) => {}
            }
        }
        self.commit(group).await;
        left_over
    }

    /// Begins a transaction with this operation; without one where it is refused.
    async fn open(&mut self, operation: &Pending) -> Result<(), Error> {
        let mut result = self.control(BEGIN);
        if result.is_ok() {
            result = self.run(operation).await;
        }
        if result.is_err() {
            self.roll_back();
        }
        result
    }

    /// Runs an operation in the transaction of others, which stand whatever becomes of it. An error says that the
    /// transaction is lost.
    async fn join(&mut self, operation: &Pending) -> Result<Result<(), Error>, Error> {
        self.control("SAVEPOINT one")?;
        let outcome = self.run(operation).await;
        if let Err(error) = &outcome {
            // Where the disk is full, SQLite may have rolled back everything by itself, and there is nothing to go back
            // to.
            self.control("ROLLBACK TO one")?;
            if self.can_help(error) {
                return Err(error.clone());
            }
        }
        self.control("RELEASE one")?;
        Ok(outcome)
    }

    /// Makes a group durable and answers it.
    async fn commit(&mut self, group: Vec<Executed>) {
        if group.is_empty() {
            return;
        }
        if let Err(error) = self.end(group.len()) {
            self.roll_back();
            return self.each_alone(group, error).await;
        }
        group.into_iter().for_each(|(operation, outcome)| operation.answer(outcome));
    }

    /// Runs the operations of a group that came to nothing for this reason again, each in a transaction of its own:
    /// what one of them broke is not held against the others.
    async fn each_alone(&mut self, group: Vec<Executed>, error: Error) {
        let one = group.len() == 1;
        for (operation, _) in group {
            let mut committed = if one { Err(error.clone()) } else { self.alone(&operation).await };
            if let Err(error) = committed {
                committed = self.with_ballast(&operation, error).await;
            }
            operation.answer(committed);
        }
    }

    /// Runs an operation in a transaction of its own.
    async fn alone(&mut self, operation: &Pending) -> Result<(), Error> {
        self.open(operation).await?;
        let committed = self.end(1);
        if committed.is_err() {
            self.roll_back();
        }
        committed
    }

    /// Gives the ballast up for an operation that found no room, and runs it again: one that begins something only once
    /// the log is cut and there is ballast beside it again.
    async fn with_ballast(&mut self, operation: &Pending, error: Error) -> Result<(), Error> {
        if !self.can_help(&error) || !self.ballast.give_up() {
            return Err(error);
        }
        self.cut_log();
        let begins = matches!(operation.intent, WriteIntent::Begins(_));
        if begins && !self.ballast.restore() { Err(error) } else { self.alone(operation).await }
    }

    /// Whether the ballast may be what an operation lacks.
    fn can_help(&self, error: &Error) -> bool {
        matches!(error, Error::NoSpace(_)) && self.ballast.is_whole()
    }

    /// Where it cannot be cut, nothing is lost: it is tried again.
    fn cut_log(&mut self) {
        if let Err(error) = self.connection().and_then(SqliteConnection::cut_log) {
            tracing::debug!(%error, "the log cannot be cut");
        }
    }

    /// Writes a log of so many pages at least back. Where the disk has no room for that, the ballast may have: a log
    /// that is cut gives more than it takes.
    fn write_log_back(&mut self, least_pages: i64) {
        let written = self.connection().and_then(|connection| connection.write_log_back(least_pages));
        let gave_lately = self.gave_for_log.is_some_and(|at| at.elapsed() < RETRY);
        match written {
            Ok(Log::Short) => self.gave_for_log = None,
            Ok(Log::Lacks(bytes)) if bytes <= BALLAST_BYTES && !gave_lately => {
                if self.ballast.give_up() {
                    self.gave_for_log = Some(Instant::now());
                    self.cut_log();
                    self.ballast.restore();
                }
            }
            Ok(Log::Lacks(_)) => {}
            Err(error) => tracing::debug!(%error, "the log cannot be written back"),
        }
    }

    fn vacuum_pays(&mut self) -> Result<bool, Error> {
        let kept = if self.ballast.is_whole() { BALLAST_BYTES } else { 0 };
        self.connection().and_then(|connection| connection.vacuum_pays(kept))
    }

    /// Writes the log back, however short it is, where the file is longer than its pages by what one
    /// [`VACUUM`](crate::store::sqlite::vacuum::VACUUM) gives back at least.
    fn shorten(&mut self) {
        match self.connection().and_then(SqliteConnection::surplus) {
            Ok(bytes) if bytes > VACUUM_BYTES => self.write_log_back(1),
            Ok(_) => {}
            Err(error) => tracing::debug!(%error, "the database cannot be shortened"),
        }
    }

    /// Runs an operation in the transaction that is open. Without ballast, what is left is for what ends what was
    /// begun: an operation that begins something is refused, unless it finds that it has nothing to write.
    async fn run(&mut self, operation: &Pending) -> Result<(), Error> {
        let is_bound = matches!(operation.intent, WriteIntent::Begins(_)) && !self.ballast.restore();
        let connection = self.connection()?;
        let before = connection.changes();
        operation.run(connection).await?;
        match is_bound && connection.changes() != before {
            true => Err(self.ballast.refusal()),
            false => Ok(()),
        }
    }

    /// Commits what so many operations wrote: it is on the disk then.
    fn end(&mut self, operations: usize) -> Result<(), Error> {
        self.control("COMMIT")?;
        metrics::store_commit(operations);
        Ok(())
    }

    /// Breaks the transaction off, if there is one. A connection that cannot even do that is given up.
    fn roll_back(&mut self) {
        if self.control("ROLLBACK").is_err() {
            self.connection = None;
        }
    }

    fn control(&mut self, statement: &'static str) -> Result<(), Error> {
        self.connection()?.control(statement)
    }

    fn connection(&mut self) -> Result<&mut SqliteConnection, Error> {
        let connection = match self.connection.take() {
            Some(connection) => connection,
            None => SqliteConnection::open(&self.database)?,
        };
        Ok(self.connection.insert(connection))
    }
}
