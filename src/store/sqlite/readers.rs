//! Reading. What is found by its keys is read where it is asked for, over one connection: it takes less time than to
//! wake another thread does. What may be large has a connection of its own, on a thread for what blocks.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::closed;
use super::connection::SqliteConnection;
use crate::store::Error;
use crate::store::sql::{Connection, Row, Size, Statement};

/// Reads one database.
#[derive(Debug, Clone)]
pub(super) struct Readers {
    database: PathBuf,
    /// For small reads, one at a time; `None`: the store is closed.
    shared: Arc<Mutex<Option<SqliteConnection>>>,
}

impl Readers {
    pub(super) fn open(database: PathBuf) -> Result<Self, Error> {
        let shared = Arc::new(Mutex::new(Some(SqliteConnection::open_to_read(&database)?)));
        Ok(Self { database, shared })
    }

    pub(super) fn reader(&self, size: Size) -> Reader {
        Reader { readers: self.clone(), is_small: size == Size::Small }
    }

    /// Reads nothing more.
    pub(super) fn close(&self) {
        *self.shared() = None;
    }

    fn shared(&self) -> MutexGuard<'_, Option<SqliteConnection>> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What one operation reads by.
pub(super) struct Reader {
    readers: Readers,
    is_small: bool,
}

#[async_trait::async_trait]
impl Connection for Reader {
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        {
            let mut shared = self.readers.shared();
            let shared = shared.as_mut().ok_or_else(closed)?;
            if self.is_small {
                return shared.run(&statement);
            }
        }
        let database = self.readers.database.clone();
        let read = move || SqliteConnection::open_to_read(&database)?.run(&statement);
        let broke_off = |error| Error::Unavailable(format!("a read broke off: {error}"));
        tokio::task::spawn_blocking(read).await.map_err(broke_off)?
    }
}
