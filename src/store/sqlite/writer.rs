//! The one writer: a thread that holds the only connection that writes, and commits together what waits together.
//!
//! A commit costs a sync of the disk, whatever is in it. Operations that arrive while one is under way are the next
//! group: each is a transaction of its own to its caller, who hears of it once the group's commit is on the disk. What
//! is large is a group of its own.

use std::panic::AssertUnwindSafe;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use super::connection::{WriteConnection, WrittenRow};
use super::log::{LONG_PAGES, Log};
use super::reserve::{RESERVE_BYTES, RETRY, Reserve};
use super::vacuum::VACUUM_BYTES;
use crate::store::Error;
use crate::store::sql::{self, Moves, Operation, Statement};
use crate::telemetry::metrics;

/// How long an operation waits for its turn; behind a queue of writes this long, the disk has failed.
const PATIENCE: Duration = Duration::from_secs(60);

/// How long a group goes on taking operations, each of [`LARGE_BYTES`] at most: about what a commit takes on a slow
/// disk, so that the first of a group waits for the others about as long as for the disk.
pub(super) const GROUP_TIME: Duration = Duration::from_millis(10);

/// An operation that writes or removes more than this has a commit of its own: what a disk of 100 MB/s takes in
/// [`GROUP_TIME`]. The others neither wait for it longer than for their own group, nor are they run again where it
/// fails.
pub(super) const LARGE_BYTES: u64 = 1 << 20;

/// Begun as a writer at once: a transaction that began by reading could not be upgraded after another process wrote.
const BEGIN: &str = "BEGIN IMMEDIATE";

/// A handle on the thread, which ends once every handle is gone or after [`Writer::close`].
#[derive(Debug, Clone)]
pub(super) struct Writer {
    inbox: mpsc::UnboundedSender<Message>,
    /// [`PATIENCE`], but in tests.
    pub(super) patience: Duration,
}

enum Message {
    Write(Box<dyn Waiting>),
    VacuumPays(oneshot::Sender<bool>),
    Shorten(oneshot::Sender<()>),
    Close(oneshot::Sender<()>),
}

/// An operation that waits for its turn, whatever it answers.
trait Waiting: Send {
    /// Marks it as begun; `false` where its caller is gone, and nobody wants it any more.
    fn begins(&self) -> bool;

    fn moves(&self) -> Moves;

    /// Whether it is to have a commit of its own.
    fn is_large(&self) -> bool {
        self.moves().bytes() > LARGE_BYTES
    }

    /// Runs it within the transaction and keeps its answer. It may be run again where the transaction came to nothing.
    fn run<'c>(&'c mut self, connection: &'c mut WriteConnection) -> BoxFuture<'c, Result<(), Error>>;

    /// Answers its caller: with what it kept, or why nothing was written.
    fn answer(self: Box<Self>, committed: Result<(), Error>);
}

/// Whether an operation has begun, or its caller has given it up: whichever comes first.
#[derive(Debug, Default)]
struct Turn(AtomicU8);

impl Turn {
    const WAITING: u8 = 0;
    const BEGUN: u8 = 1;
    const GIVEN_UP: u8 = 2;

    /// `false` where its caller has given it up.
    fn begin(&self) -> bool {
        self.leave_waiting(Self::BEGUN)
    }

    /// `false` where it has begun.
    fn give_up(&self) -> bool {
        self.leave_waiting(Self::GIVEN_UP)
    }

    fn leave_waiting(&self, to: u8) -> bool {
        self.0.compare_exchange(Self::WAITING, to, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }
}

struct Pending<T> {
    operation: Operation<WriteConnection, T>,
    moves: Moves,
    value: Option<T>,
    turn: Arc<Turn>,
    reply: oneshot::Sender<Result<T, Error>>,
}

impl<T: Send + 'static> Waiting for Pending<T> {
    fn begins(&self) -> bool {
        self.turn.begin() && !self.reply.is_closed()
    }

    fn moves(&self) -> Moves {
        self.moves
    }

    fn run<'c>(&'c mut self, connection: &'c mut WriteConnection) -> BoxFuture<'c, Result<(), Error>> {
        Box::pin(async {
            // A defect in one operation must not cost the others their writer, be it in its call or in what it awaits.
            let run = async { (self.operation)(connection).await };
            let outcome = AssertUnwindSafe(run).catch_unwind().await;
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
    /// Starts the thread on a connection to `database`, which it opens anew when that is of no more use. On a full disk
    /// `reserve` is for what makes room. A group goes on taking operations for `group_time`.
    ///
    /// # Errors
    /// [`Error::Unavailable`] where the system has no thread to give.
    pub(super) fn start(
        connection: WriteConnection,
        database: PathBuf,
        reserve: Reserve,
        group_time: Duration,
    ) -> Result<Self, Error> {
        let (inbox, messages) = mpsc::unbounded_channel();
        let failed = |error: std::io::Error| Error::Unavailable(format!("cannot start the writer's thread: {error}"));
        // A runtime of its own: what is awaited here is the next message and, within an operation, nothing but in
        // tests.
        let runtime = tokio::runtime::Builder::new_current_thread().build().map_err(failed)?;
        let connection = Some(connection);
        let desk = Desk { connection, database, reserve, gave_for_log: None, messages, group_time };
        let work = move || runtime.block_on(desk.serve());
        thread::Builder::new().name("store-writer".into()).spawn(work).map_err(failed)?;
        Ok(Self { inbox, patience: PATIENCE })
    }

    /// Runs an operation and answers once what it wrote is on the disk.
    pub(super) async fn write<T: Send + 'static>(
        &self,
        moves: Moves,
        operation: Operation<WriteConnection, T>,
    ) -> Result<T, Error> {
        let turn = Arc::new(Turn::default());
        let (reply, mut answer) = oneshot::channel();
        let pending = Pending { operation, moves, value: None, turn: turn.clone(), reply };
        let closed = || Error::Unavailable("the store is closed".into());
        self.inbox.send(Message::Write(Box::new(pending))).map_err(|_| closed())?;
        loop {
            match timeout(self.patience, &mut answer).await {
                Ok(answered) => return answered.unwrap_or_else(|_| Err(closed())),
                Err(_) if turn.give_up() => {
                    return Err(no_turn(self.patience));
                }
                // What has begun ends, sooner or later, and whether it came to anything is known only then.
                Err(_) => {}
            }
        }
    }

    /// Runs one statement without parameters and returns its rows.
    pub(super) async fn run(&self, moves: Moves, statement: &'static str) -> Result<Vec<WrittenRow>, Error> {
        let run = sql::operation(move |connection: &mut WriteConnection| {
            async move { sql::Connection::rows(connection, Statement::new(statement)).await }.boxed()
        });
        self.write(moves, run).await
    }

    /// Whether to give free pages back is worth the room that it takes.
    pub(super) async fn vacuum_pays(&self) -> Result<bool, Error> {
        self.ask(Message::VacuumPays).await
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
        match timeout(self.patience, self.send(message)).await {
            Ok(answer) => answer,
            Err(_) => Err(no_turn(self.patience)),
        }
    }

    /// Has something done that answers when it is.
    async fn send<T>(&self, message: fn(oneshot::Sender<T>) -> Message) -> Result<T, Error> {
        let closed = || Error::Unavailable("the store is closed".into());
        let (done, answer) = oneshot::channel();
        self.inbox.send(message(done)).map_err(|_| closed())?;
        answer.await.map_err(|_| closed())
    }
}

fn no_turn(patience: Duration) -> Error {
    Error::Unavailable(format!("no turn to write came within {} s", patience.as_secs_f64()))
}

/// What the thread has.
struct Desk {
    /// `None`: the last one was of no more use.
    connection: Option<WriteConnection>,
    database: PathBuf,
    reserve: Reserve,
    /// When the reserve was last given up so that the log could be cut. For a while that is not tried again: it may
    /// have won nothing.
    gave_for_log: Option<Instant>,
    messages: mpsc::UnboundedReceiver<Message>,
    group_time: Duration,
}

/// An operation of a group and what it came to: answered with that once the group is committed, also where it was
/// refused, as it may have seen what the others had written.
type Ran = (Box<dyn Waiting>, Result<(), Error>);

impl Desk {
    async fn serve(mut self) {
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
                    if let Some(Err(error)) = self.connection.take().map(WriteConnection::close) {
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
    async fn group(&mut self, first: Box<dyn Waiting>) -> Option<Message> {
        // Here, and not where one is run again, for which the reserve was given up.
        if self.reserve.is_due() {
            self.cut_log();
            self.reserve.restore();
        }
        let begun = Instant::now();
        let alone = first.is_large();
        let mut left_over = None;
        let mut group: Vec<Ran> = Vec::new();
        let mut next = Some(first);
        while let Some(mut operation) = next.take() {
            if operation.begins() {
                let ran = match group.is_empty() {
                    true => self.open(operation.as_mut()).await.map(Ok),
                    false => self.join(operation.as_mut()).await,
                };
                match ran {
                    Ok(outcome) => group.push((operation, outcome)),
                    // Nothing of anyone else's is in the transaction, or has been seen in it.
                    Err(error) if group.is_empty() => {
                        let helped = self.with_reserve(operation.as_mut(), error).await;
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
    async fn open(&mut self, operation: &mut dyn Waiting) -> Result<(), Error> {
        let mut ran = self.control(BEGIN);
        if ran.is_ok() {
            ran = self.run(operation).await;
        }
        if ran.is_err() {
            self.roll_back();
        }
        ran
    }

    /// Runs an operation in the transaction of others, which stand whatever becomes of it. An error says that the
    /// transaction is lost.
    async fn join(&mut self, operation: &mut dyn Waiting) -> Result<Result<(), Error>, Error> {
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
    async fn commit(&mut self, group: Vec<Ran>) {
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
    async fn each_alone(&mut self, group: Vec<Ran>, error: Error) {
        let one = group.len() == 1;
        for (mut operation, _) in group {
            let mut committed = if one { Err(error.clone()) } else { self.alone(operation.as_mut()).await };
            if let Err(error) = committed {
                committed = self.with_reserve(operation.as_mut(), error).await;
            }
            operation.answer(committed);
        }
    }

    /// Runs an operation in a transaction of its own.
    async fn alone(&mut self, operation: &mut dyn Waiting) -> Result<(), Error> {
        self.open(operation).await?;
        let committed = self.end(1);
        if committed.is_err() {
            self.roll_back();
        }
        committed
    }

    /// Gives the reserve up for an operation that found no room, and runs it again: one that begins something only once
    /// the log is cut and there is a reserve beside it again.
    async fn with_reserve(&mut self, operation: &mut dyn Waiting, error: Error) -> Result<(), Error> {
        if !self.can_help(&error) || !self.reserve.give_up() {
            return Err(error);
        }
        self.cut_log();
        let begins = matches!(operation.moves(), Moves::Begins(_));
        if begins && !self.reserve.restore() { Err(error) } else { self.alone(operation).await }
    }

    /// Whether the reserve may be what an operation lacks.
    fn can_help(&self, error: &Error) -> bool {
        matches!(error, Error::NoSpace(_)) && self.reserve.is_whole()
    }

    /// Where it cannot be cut, nothing is lost: it is tried again.
    fn cut_log(&mut self) {
        if let Err(error) = self.connection().and_then(WriteConnection::cut_log) {
            tracing::debug!(%error, "the log cannot be cut");
        }
    }

    /// Writes a log of so many pages at least back. Where the disk has no room for that, the reserve may have: a log that
    /// is cut gives more than it takes.
    fn write_log_back(&mut self, least_pages: i64) {
        let written = self.connection().and_then(|connection| connection.write_log_back(least_pages));
        let gave_lately = self.gave_for_log.is_some_and(|at| at.elapsed() < RETRY);
        match written {
            Ok(Log::Short) => self.gave_for_log = None,
            Ok(Log::Lacks(bytes)) if bytes <= RESERVE_BYTES && !gave_lately => {
                if self.reserve.give_up() {
                    self.gave_for_log = Some(Instant::now());
                    self.cut_log();
                    self.reserve.restore();
                }
            }
            Ok(Log::Lacks(_)) => {}
            Err(error) => tracing::debug!(%error, "the log cannot be written back"),
        }
    }

    fn vacuum_pays(&mut self) -> bool {
        let kept = if self.reserve.is_whole() { RESERVE_BYTES } else { 0 };
        self.connection().and_then(|connection| connection.vacuum_pays(kept)).unwrap_or_else(|error| {
            tracing::debug!(%error, "whether a vacuum pays cannot be told");
            false
        })
    }

    /// Writes the log back, however short it is, where the file is longer than its pages by what one
    /// [`VACUUM`](super::vacuum::VACUUM) gives back at least.
    fn shorten(&mut self) {
        match self.connection().and_then(WriteConnection::surplus) {
            Ok(bytes) if bytes > VACUUM_BYTES => self.write_log_back(1),
            Ok(_) => {}
            Err(error) => tracing::debug!(%error, "the database cannot be shortened"),
        }
    }

    /// Runs an operation in the transaction that is open. Without a reserve, what is left is for what ends what was
    /// begun: an operation that begins something is refused, unless it finds that it has nothing to write.
    async fn run(&mut self, operation: &mut dyn Waiting) -> Result<(), Error> {
        let is_bound = matches!(operation.moves(), Moves::Begins(_)) && !self.reserve.restore();
        let connection = self.connection()?;
        let before = connection.changes();
        operation.run(connection).await?;
        match is_bound && connection.changes() != before {
            true => Err(self.reserve.refusal()),
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

    fn connection(&mut self) -> Result<&mut WriteConnection, Error> {
        let connection = match self.connection.take() {
            Some(connection) => connection,
            None => WriteConnection::open(&self.database)?,
        };
        Ok(self.connection.insert(connection))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_a_writer_and_a_caller_one_has_the_turn() {
        let turn = || Arc::new(Turn::default());
        let (begun, given_up) = (turn(), turn());
        assert!(begun.begin() && !begun.give_up());
        assert!(given_up.give_up() && !given_up.begin());
        for round in 0..1_000 {
            let (turn, both) = (turn(), Arc::new(std::sync::Barrier::new(2)));
            let begins = thread::spawn({
                let (turn, both) = (turn.clone(), both.clone());
                move || {
                    both.wait();
                    turn.begin()
                }
            });
            both.wait();
            let given_up = turn.give_up();
            assert_ne!(begins.join().expect("no panic"), given_up, "round {round}");
        }
    }
}
