//! Reading. What is found by its keys is read on the thread that asks for it, over one connection: that takes less time
//! than to wake another thread. Where that connection is taken, as while the disk stalls, and what may be large, is read
//! on a thread for what blocks, so that no more than one of the threads that serve calls waits for the disk.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Mutex, OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use super::connection::SqliteConnection;
use super::{BUSY_TIMEOUT, closed};
use crate::store::Error;
use crate::store::sql::{Connection, Row, Size, Statement};

/// Operations that read on threads for what blocks, at most: listings and results seldom keep more than a few busy.
const OFF_THREAD: usize = 4;

/// How long one more waits for its turn; no read waits for a write: reads that take this long are of a disk that has
/// failed.
const TURN_TIMEOUT: Duration = Duration::from_secs(60);

/// How long a thread that serves calls waits for another process on the file; then another thread does.
const SHORT_BUSY_TIMEOUT: Duration = Duration::from_millis(100);

/// Reads one database.
#[derive(Debug, Clone)]
pub(super) struct Readers {
    database: PathBuf,
    /// `None`: the store is closed.
    shared: Arc<Mutex<Option<SqliteConnection>>>,
    turns: Arc<Semaphore>,
}

impl Readers {
    pub(super) fn open(database: PathBuf) -> Result<Self, Error> {
        let shared = Arc::new(Mutex::new(Some(SqliteConnection::open_to_read(&database, SHORT_BUSY_TIMEOUT)?)));
        Ok(Self { database, shared, turns: Arc::new(Semaphore::new(OFF_THREAD)) })
    }

    pub(super) fn reader(&self, size: Size) -> Reader {
        Reader { readers: self.clone(), is_small: size == Size::Small, own: None }
    }

    /// Ends once nothing is read any more; closes the connections.
    pub(super) async fn close(&self) {
        let _all = self.turns.acquire_many(OFF_THREAD as u32).await;
        self.turns.close();
        *self.shared.lock().await = None;
    }

    /// A turn to read on another thread.
    async fn turn(&self) -> Result<OwnedSemaphorePermit, Error> {
        let late = |_| Error::Unavailable(format!("no read ended within {} s", TURN_TIMEOUT.as_secs_f64()));
        let turn = timeout(TURN_TIMEOUT, self.turns.clone().acquire_owned()).await.map_err(late)?;
        turn.map_err(|_| closed())
    }

    /// The rows, read on this thread; `None` where that would wait.
    fn read_here(&self, statement: &Statement) -> Option<Result<Vec<Row>, Error>> {
        let mut shared = self.shared.try_lock().ok()?;
        match shared.as_mut().ok_or_else(closed).and_then(|connection| connection.run(statement)) {
            Err(Error::Unavailable(_)) => None,
            rows => Some(rows),
        }
    }
}

/// What one operation reads by.
pub(super) struct Reader {
    readers: Readers,
    is_small: bool,
    /// Once it has read on another thread.
    own: Option<Own>,
}

/// A turn to read on another thread, and a connection for it.
struct Own {
    connection: Option<SqliteConnection>,
    _turn: OwnedSemaphorePermit,
}

impl Own {
    fn rows(&mut self, database: &Path, statement: &Statement) -> Result<Vec<Row>, Error> {
        let connection = match self.connection.take() {
            Some(connection) => connection,
            None => SqliteConnection::open_to_read(database, BUSY_TIMEOUT)?,
        };
        self.connection.insert(connection).run(statement)
    }
}

#[async_trait::async_trait]
impl Connection for Reader {
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        if self.is_small {
            // Who reads again and again, never waiting, leaves the thread to others now and then.
            tokio::task::consume_budget().await;
            if let Some(rows) = self.readers.read_here(&statement) {
                return rows;
            }
        }
        let mut own = match self.own.take() {
            Some(own) => own,
            None => Own { connection: None, _turn: self.readers.turn().await? },
        };
        let database = self.readers.database.clone();
        // It goes on where its caller is gone, and has its turn until it ends.
        let reading = tokio::task::spawn_blocking(move || (own.rows(&database, &statement), own));
        let (rows, own) = reading.await.map_err(|error| Error::Unavailable(format!("a read broke off: {error}")))?;
        self.own = Some(own);
        rows
    }
}
