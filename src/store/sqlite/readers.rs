//! The connections that read. What is found by its keys is read where it is asked for: it takes less time than to wake
//! another thread does. What may be large is read on a thread for what blocks.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use super::closed;
use super::connection::SqliteConnection;
use crate::store::Error;
use crate::store::sql::{Connection, Row, Size, Statement};

/// Connections at most: listings and results seldom keep more than a few busy at once.
const CONNECTIONS: usize = 4;

/// How long a reader waits for one of them, none of which waits for a write: reads that take this long are of a disk
/// that has failed.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(60);

/// Connections to one database, opened when they are needed.
#[derive(Debug)]
pub(super) struct Readers {
    database: PathBuf,
    permits: Arc<Semaphore>,
    idle: Mutex<Vec<SqliteConnection>>,
}

impl Readers {
    pub(super) fn new(database: PathBuf) -> Arc<Self> {
        Arc::new(Self { database, permits: Arc::new(Semaphore::new(CONNECTIONS)), idle: Mutex::default() })
    }

    /// A connection, once one is free.
    ///
    /// # Errors
    /// [`Error::Unavailable`].
    pub(super) async fn acquire(self: &Arc<Self>, size: Size) -> Result<Reader, Error> {
        let late = |_| Error::Unavailable(format!("no read ended within {} s", ACQUIRE_TIMEOUT.as_secs_f64()));
        let permit = timeout(ACQUIRE_TIMEOUT, self.permits.clone().acquire_owned()).await.map_err(late)?;
        let permit = permit.map_err(|_| closed())?;
        let idle = self.idle().pop();
        let connection = idle.map_or_else(|| SqliteConnection::open_to_read(&self.database), Ok)?;
        let lent = Lent { connection: Some(connection), readers: self.clone(), _permit: permit };
        Ok(Reader { lent: Some(lent), is_small: size == Size::Small })
    }

    /// Closes all of them, once they have come back.
    pub(super) async fn close(&self) {
        let _all = self.permits.acquire_many(CONNECTIONS as u32).await;
        self.permits.close();
        self.idle().clear();
    }

    fn idle(&self) -> MutexGuard<'_, Vec<SqliteConnection>> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connection until it goes back to the others.
struct Lent {
    /// Always here until the drop.
    connection: Option<SqliteConnection>,
    readers: Arc<Readers>,
    /// Dropped after the connection is back.
    _permit: OwnedSemaphorePermit,
}

impl Lent {
    fn rows(&mut self, statement: &Statement) -> Result<Vec<Row>, Error> {
        self.connection.as_mut().ok_or_else(closed)?.run(statement)
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        self.readers.idle().extend(self.connection.take());
    }
}

/// A connection that reads.
pub(super) struct Reader {
    /// `None`: a read was given up, and has it until it ends.
    lent: Option<Lent>,
    is_small: bool,
}

#[async_trait::async_trait]
impl Connection for Reader {
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        let mut lent = self.lent.take().ok_or_else(closed)?;
        let rows = if self.is_small {
            lent.rows(&statement)
        } else {
            let reading = tokio::task::spawn_blocking(move || (lent.rows(&statement), lent));
            let rows;
            (rows, lent) = reading.await.map_err(|error| Error::Unavailable(format!("a read broke off: {error}")))?;
            rows
        };
        self.lent = Some(lent);
        rows
    }
}
