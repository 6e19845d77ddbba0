//! The one writer: a thread that holds the only connection that writes, and commits together what waits together.
//!
//! A commit costs a sync of the disk, whatever is in it. Operations that arrive while one is under way are the next
//! group: each is a transaction of its own to its caller, who hears of it once the group's commit is on the disk. What
//! is large is a group of its own. Here is the handle that callers have; `pending` is an operation on its way,
//! `commit_batcher` what the thread does with it.

mod commit_batcher;
mod pending;

use std::path::PathBuf;
use std::thread;
use std::time::Duration;

use futures_util::FutureExt;
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use self::commit_batcher::CommitBatcher;
use self::pending::Pending;
use super::ballast::Ballast;
use super::closed;
use super::connection::SqliteConnection;
use crate::store::Error;
use crate::store::sql::{self, Connection, Operation, Statement, WriteIntent};

/// How long an operation waits for its turn; behind a queue of writes this long, the disk has failed.
const TURN_TIMEOUT: Duration = Duration::from_secs(60);

/// How long a group goes on taking operations, each of [`LARGE_BYTES`] at most: about what a commit takes on a slow
/// disk, so that the first of a group waits for the others about as long as for the disk.
pub(super) const GROUP_TIME: Duration = Duration::from_millis(10);

/// An operation that writes or removes more than this has a commit of its own: what a disk of 100 MB/s takes in
/// [`GROUP_TIME`]. The others neither wait for it longer than for their own group, nor are they run again where it
/// fails.
pub(super) const LARGE_BYTES: u64 = 1 << 20;

/// A handle on the thread, which ends once every handle is gone or after [`Writer::close`].
#[derive(Debug, Clone)]
pub(super) struct Writer {
    inbox: mpsc::UnboundedSender<Message>,
    /// [`TURN_TIMEOUT`], but in tests.
    pub(super) turn_timeout: Duration,
}

enum Message {
    Write(Pending),
    VacuumPays(oneshot::Sender<Result<bool, Error>>),
    Shorten(oneshot::Sender<()>),
    Close(oneshot::Sender<()>),
}

impl Writer {
    /// Starts the thread on a connection to `database`, which it opens anew when that is of no more use. On a full disk
    /// `ballast` is for what makes room. A group goes on taking operations for `group_time`.
    ///
    /// # Errors
    /// [`Error::Unavailable`] where the system has no thread to give.
    pub(super) fn start(
        connection: SqliteConnection,
        database: PathBuf,
        ballast: Ballast,
        group_time: Duration,
    ) -> Result<Self, Error> {
        let (inbox, messages) = mpsc::unbounded_channel();
        let failed = |error: std::io::Error| Error::Unavailable(format!("cannot start the writer's thread: {error}"));
        // A runtime of its own: what is awaited here is the next message and, within an operation, nothing but in
        // tests.
        let runtime = tokio::runtime::Builder::new_current_thread().build().map_err(failed)?;
        let commit_batcher = CommitBatcher::new(connection, database, ballast, messages, group_time);
        let work = move || runtime.block_on(commit_batcher.serve());
        thread::Builder::new().name("store-writer".into()).spawn(work).map_err(failed)?;
        Ok(Self { inbox, turn_timeout: TURN_TIMEOUT })
    }

    /// Runs an operation and answers once what it wrote is on the disk.
    pub(super) async fn write(
        &self,
        intent: WriteIntent,
        operation: Operation<SqliteConnection, ()>,
    ) -> Result<(), Error> {
        let (pending, turn, mut answer) = Pending::new(intent, operation);
        self.inbox.send(Message::Write(pending)).map_err(|_| closed())?;
        loop {
            match timeout(self.turn_timeout, &mut answer).await {
                Ok(answered) => return answered.unwrap_or_else(|_| Err(closed())),
                Err(_) if turn.take() => {
                    return Err(no_turn(self.turn_timeout));
                }
                // What has begun ends, sooner or later, and whether it came to anything is known only then.
                Err(_) => {}
            }
        }
    }

    /// Runs one statement without parameters.
    pub(super) async fn run(&self, intent: WriteIntent, statement: &'static str) -> Result<(), Error> {
        let run = sql::operation(move |connection: &mut SqliteConnection| {
            async move { connection.rows(Statement::new(statement)).await.map(drop) }.boxed()
        });
        self.write(intent, run).await
    }

    /// Whether to give free pages back is worth the room that it takes.
    pub(super) async fn vacuum_pays(&self) -> Result<bool, Error> {
        self.ask(Message::VacuumPays).await?
    }

    /// After what is already waiting, has the database's file give back what it has beyond its pages, where that is
    /// worth it and its readers let it.
    pub(super) async fn shorten(&self) -> Result<(), Error> {
        self.ask(Message::Shorten).await
    }

    /// Ends the thread after what is already waiting, and closes the connection.
    pub(super) async fn close(&self) {
        // An error says that the thread is gone, which is what was wanted.
        let _ = self.send(Message::Close).await;
    }

    /// Has something done that can as well be done another time.
    async fn ask<T>(&self, message: fn(oneshot::Sender<T>) -> Message) -> Result<T, Error> {
        match timeout(self.turn_timeout, self.send(message)).await {
            Ok(answer) => answer,
            Err(_) => Err(no_turn(self.turn_timeout)),
        }
    }

    /// Has something done that answers when it is.
    async fn send<T>(&self, message: fn(oneshot::Sender<T>) -> Message) -> Result<T, Error> {
        let (done, answer) = oneshot::channel();
        self.inbox.send(message(done)).map_err(|_| closed())?;
        answer.await.map_err(|_| closed())
    }
}

fn no_turn(turn_timeout: Duration) -> Error {
    Error::Unavailable(format!("no turn to write came within {} s", turn_timeout.as_secs_f64()))
}
