//! The one writer: a thread that holds the only connection that writes, and commits together what waits together.
//!
//! A commit costs a sync of the disk, whatever is in it. Operations that arrive while one is under way are the next
//! group: each is a transaction of its own to its caller, who hears of it once the group's commit is on the disk.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection, SqliteRow};
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use crate::store::Error;
use crate::store::sql::{self, Operation, Statement};

/// How long an operation waits for its turn; behind a queue of writes this long, the disk has failed.
const PATIENCE: Duration = Duration::from_secs(60);

/// How long a group goes on taking operations: about what a commit takes on a slow disk, so that the first of a group
/// waits for the others no longer than for the disk.
const GROUP_TIME: Duration = Duration::from_millis(10);

/// Begun as a writer at once: a transaction that began by reading could not be upgraded after another process wrote.
const BEGIN: &str = "BEGIN IMMEDIATE";

/// A handle on the thread, which ends once every handle is gone or after [`Writer::close`].
#[derive(Debug, Clone)]
pub(super) struct Writer {
    inbox: mpsc::UnboundedSender<Message>,
    /// Commits so far.
    #[cfg(test)]
    pub commits: Arc<std::sync::atomic::AtomicUsize>,
}

enum Message {
    Write(Box<dyn Waiting>),
    Close(oneshot::Sender<()>),
}

/// An operation that waits for its turn, whatever it answers.
trait Waiting: Send {
    /// Marks it as begun; `false` where its caller is gone, and nobody wants it any more.
    fn begins(&self) -> bool;

    /// Runs it within the transaction and keeps its answer. It may be run again where the transaction came to nothing.
    fn run<'c>(&'c mut self, connection: &'c mut SqliteConnection) -> BoxFuture<'c, Result<(), Error>>;

    /// Answers its caller: with what it kept, or why nothing was written.
    fn answer(self: Box<Self>, committed: Result<(), Error>);
}

struct Pending<T> {
    operation: Operation<SqliteConnection, T>,
    value: Option<T>,
    begun: Arc<AtomicBool>,
    reply: oneshot::Sender<Result<T, Error>>,
}

impl<T: Send + 'static> Waiting for Pending<T> {
    fn begins(&self) -> bool {
        self.begun.store(true, Ordering::Release);
        !self.reply.is_closed()
    }

    fn run<'c>(&'c mut self, connection: &'c mut SqliteConnection) -> BoxFuture<'c, Result<(), Error>> {
        Box::pin(async {
            // A defect in one operation must not cost the others their writer.
            let outcome = AssertUnwindSafe((self.operation)(connection)).catch_unwind().await;
            let value = outcome.unwrap_or_else(|_| Err(Error::Corrupt("an operation of the store panicked".into())))?;
            self.value = Some(value);
            Ok(())
        })
    }

    fn answer(self: Box<Self>, committed: Result<(), Error>) {
        let Self { value, reply, .. } = *self;
        let missing = || Error::Corrupt("an operation was committed without an answer".into());
        // A caller that went away does not need to know.
        let _ = reply.send(committed.and_then(|()| value.ok_or_else(missing)));
    }
}

impl Writer {
    /// Starts the thread on a connection; `options` open another one when that is of no more use.
    ///
    /// # Errors
    /// [`Error::Unavailable`] where the system has no thread to give.
    pub(super) fn start(connection: SqliteConnection, options: SqliteConnectOptions) -> Result<Self, Error> {
        let (inbox, messages) = mpsc::unbounded_channel();
        let failed = |error: std::io::Error| Error::Unavailable(format!("cannot start the writer's thread: {error}"));
        // A runtime of its own: each statement is a round trip to SQLite's thread, and waking this one thread is cheaper
        // than finding one among those of the server.
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().map_err(failed)?;
        #[cfg(test)]
        let commits = Arc::default();
        let desk = Desk {
            connection: Some(connection),
            options,
            messages,
            #[cfg(test)]
            commits: Arc::clone(&commits),
        };
        let work = move || runtime.block_on(desk.serve());
        thread::Builder::new().name("store-writer".into()).spawn(work).map_err(failed)?;
        Ok(Self {
            inbox,
            #[cfg(test)]
            commits,
        })
    }

    /// Runs an operation and answers once what it wrote is on the disk.
    pub(super) async fn write<T: Send + 'static>(&self, operation: Operation<SqliteConnection, T>) -> Result<T, Error> {
        let begun = Arc::new(AtomicBool::new(false));
        let (reply, mut answer) = oneshot::channel();
        let pending = Pending { operation, value: None, begun: begun.clone(), reply };
        let closed = || Error::Unavailable("the store is closed".into());
        self.inbox.send(Message::Write(Box::new(pending))).map_err(|_| closed())?;
        loop {
            match timeout(PATIENCE, &mut answer).await {
                Ok(answered) => return answered.unwrap_or_else(|_| Err(closed())),
                // What has begun ends, sooner or later, and whether it came to anything is known only then.
                Err(_) if begun.load(Ordering::Acquire) => {}
                Err(_) => {
                    let waited = PATIENCE.as_secs();
                    return Err(Error::Unavailable(format!("no turn to write came within {waited} s")));
                }
            }
        }
    }

    /// Runs one statement without parameters, and returns its rows.
    pub(super) async fn run(&self, statement: &'static str) -> Result<Vec<SqliteRow>, Error> {
        let run = sql::operation(move |connection: &mut SqliteConnection| {
            async move { sql::Connection::rows(connection, Statement::new(statement)).await }.boxed()
        });
        self.write(run).await
    }

    /// Ends the thread after what is already waiting, and closes the connection.
    pub(super) async fn close(&self) {
        let (done, closed) = oneshot::channel();
        if self.inbox.send(Message::Close(done)).is_ok() {
            // An error says that the thread is gone, which is what was wanted.
            let _ = closed.await;
        }
    }
}

/// What the thread has.
struct Desk {
    /// `None`: the last one was of no more use.
    connection: Option<SqliteConnection>,
    options: SqliteConnectOptions,
    messages: mpsc::UnboundedReceiver<Message>,
    #[cfg(test)]
    commits: Arc<std::sync::atomic::AtomicUsize>,
}

/// An operation of a group and what it came to: answered with that once the group is committed, also where it was
/// refused, as it may have seen what the others had written.
type Ran = (Box<dyn Waiting>, Result<(), Error>);

impl Desk {
    async fn serve(mut self) {
        while let Some(message) = self.messages.recv().await {
            let close = match message {
                Message::Write(first) => self.group(first).await,
                Message::Close(done) => Some(done),
            };
            let Some(done) = close else { continue };
            if let Some(connection) = self.connection.take() {
                // What was acknowledged is durable without it.
                let _ = connection.close().await;
            }
            let _ = done.send(());
            return;
        }
    }

    /// Runs operations until none waits, commits them together and answers them. Returns the close that was asked for
    /// meanwhile.
    async fn group(&mut self, first: Box<dyn Waiting>) -> Option<oneshot::Sender<()>> {
        let begun = Instant::now();
        let mut group: Vec<Ran> = Vec::new();
        let mut next = Some(first);
        while let Some(mut operation) = next.take() {
            if operation.begins() {
                let ran = match group.is_empty() {
                    true => self.open(operation.as_mut()).await,
                    false => self.join(operation.as_mut()).await,
                };
                match ran {
                    Ok(outcome) => group.push((operation, outcome)),
                    // Nothing of anyone else's is in the transaction, or has been seen in it.
                    Err(error) if group.is_empty() => operation.answer(Err(error)),
                    Err(_) => {
                        group.push((operation, Ok(())));
                        self.each_alone(group).await;
                        return None;
                    }
                }
            }
            if begun.elapsed() >= GROUP_TIME {
                break;
            }
            match self.messages.try_recv() {
                Ok(Message::Write(operation)) => next = Some(operation),
                Ok(Message::Close(done)) => {
                    self.commit(group).await;
                    return Some(done);
                }
                Err(_) => {}
            }
        }
        self.commit(group).await;
        None
    }

    /// Begins a transaction with this operation; without one where it is refused.
    async fn open(&mut self, operation: &mut dyn Waiting) -> Result<Result<(), Error>, Error> {
        let begun = self.control(BEGIN).await;
        let ran = match begun {
            Ok(()) => operation.run(self.connection().await?).await,
            Err(error) => Err(error),
        };
        if ran.is_err() {
            self.roll_back().await;
        }
        ran.map(Ok)
    }

    /// Runs an operation in the transaction of others, which stand whatever becomes of it. An error says that the
    /// transaction is lost.
    async fn join(&mut self, operation: &mut dyn Waiting) -> Result<Result<(), Error>, Error> {
        self.control("SAVEPOINT one").await?;
        let outcome = operation.run(self.connection().await?).await;
        if outcome.is_err() {
            // Where the disk is full, SQLite has rolled back everything by itself, and there is nothing to go back to.
            self.control("ROLLBACK TO one").await?;
        }
        self.control("RELEASE one").await?;
        Ok(outcome)
    }

    /// Makes a group durable and answers it.
    async fn commit(&mut self, group: Vec<Ran>) {
        if group.is_empty() {
            return;
        }
        if let Err(error) = self.end().await {
            if group.len() > 1 {
                return self.each_alone(group).await;
            }
            self.roll_back().await;
            group.into_iter().for_each(|(operation, _)| operation.answer(Err(error.clone())));
            return;
        }
        group.into_iter().for_each(|(operation, outcome)| operation.answer(outcome));
    }

    /// Runs the operations of a group that came to nothing again, each in a transaction of its own: what one of them
    /// broke is not held against the others.
    async fn each_alone(&mut self, group: Vec<Ran>) {
        self.roll_back().await;
        for (mut operation, _) in group {
            let mut committed = self.open(operation.as_mut()).await.and_then(|outcome| outcome);
            if committed.is_ok() {
                committed = self.end().await;
                if committed.is_err() {
                    self.roll_back().await;
                }
            }
            operation.answer(committed);
        }
    }

    /// Commits: what was written is on the disk then.
    async fn end(&mut self) -> Result<(), Error> {
        #[cfg(test)]
        self.commits.fetch_add(1, Ordering::SeqCst);
        self.control("COMMIT").await
    }

    /// Breaks the transaction off, if there is one. A connection that cannot even do that is given up.
    async fn roll_back(&mut self) {
        if self.control("ROLLBACK").await.is_err() {
            self.connection = None;
        }
    }

    async fn control(&mut self, statement: &'static str) -> Result<(), Error> {
        sqlx::query(statement).execute(self.connection().await?).await?;
        Ok(())
    }

    async fn connection(&mut self) -> Result<&mut SqliteConnection, Error> {
        if self.connection.is_none() {
            self.connection = Some(SqliteConnection::connect_with(&self.options).await?);
        }
        self.connection.as_mut().ok_or_else(|| Error::Unavailable("no connection to the database".into()))
    }
}
