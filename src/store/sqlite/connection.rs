//! A connection to the database, called on whatever thread has it.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rusqlite::config::DbConfig;
use rusqlite::types::Value as Cell;
use rusqlite::{OpenFlags, Statement as Prepared, ffi};

use super::{BUSY_TIMEOUT, SETTINGS};
use crate::store::Error;
use crate::store::sql::{Connection, Row, Statement, Value};

/// Pages of a transaction that are held in memory, 64 MiB: what one message may hold by default. Of more, the end of a
/// long upload, some go to the log early.
const SPILL_PAGES: i64 = 16_384;

/// Statements that stay prepared: more than there are.
const PREPARED: usize = 128;

/// A connection of rusqlite.
#[derive(Debug)]
pub(in crate::store) struct SqliteConnection {
    inner: rusqlite::Connection,
    database: PathBuf,
}

impl SqliteConnection {
    /// Opens a database that is there, to write.
    ///
    /// # Errors
    /// [`Error::Unavailable`], [`Error::NoSpace`] and [`Error::Corrupt`].
    pub(super) fn open(database: &Path) -> Result<Self, Error> {
        let connection = Self::connect(database, OpenFlags::empty())?;
        // Up to so many pages, each is in the log once, not each time that the cache is full; and not at all where the
        // transaction gives it back, as on a full disk it must.
        connection.inner.pragma_update(None, "cache_spill", SPILL_PAGES)?;
        // Only with the first look does it open the log, and keep others that close from being the last to go.
        connection.inner.query_row("PRAGMA schema_version", [], |_| Ok(()))?;
        Ok(connection)
    }

    /// Opens one that is there, to read.
    ///
    /// # Errors
    /// As [`SqliteConnection::open`].
    pub(super) fn open_to_read(database: &Path, busy_timeout: Duration) -> Result<Self, Error> {
        let connection = Self::connect(database, OpenFlags::empty())?;
        connection.inner.busy_timeout(busy_timeout)?;
        connection.inner.pragma_update(None, "query_only", "ON")?;
        Ok(connection)
    }

    /// Makes one that gives back the space of what is removed.
    ///
    /// # Errors
    /// As [`SqliteConnection::open`].
    pub(super) fn create(database: &Path) -> Result<Self, Error> {
        let connection = Self::connect(database, OpenFlags::SQLITE_OPEN_CREATE)?;
        // Only takes effect in a new file, and is a write in any other.
        connection.inner.pragma_update(None, "auto_vacuum", "INCREMENTAL")?;
        Ok(connection)
    }

    fn connect(database: &Path, more: OpenFlags) -> Result<Self, Error> {
        // One thread at a time has it: SQLite need not lock.
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX | more;
        let connection = rusqlite::Connection::open_with_flags(database, flags)?;
        connection.busy_timeout(BUSY_TIMEOUT)?;
        connection.set_prepared_statement_cache_capacity(PREPARED);
        // Plans that do not depend on the values of parameters: with every other value of a `LIMIT` SQLite would
        // prepare the statement anew.
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_QPSG, true)?;
        // Dropping this does not write the log back: see `close`.
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, true)?;
        for (name, value) in SETTINGS {
            connection.pragma_update(None, name, value)?;
        }
        Ok(Self { inner: connection, database: database.to_owned() })
    }

    /// Has commits go to a log beside the file first, from here on: readers then wait for no writer.
    ///
    /// # Errors
    /// [`Error::Unavailable`] where the file system has no shared memory for the log's index.
    pub(super) fn write_ahead(&mut self) -> Result<(), Error> {
        let mode: String = self.inner.pragma_update_and_check(None, "journal_mode", "WAL", |row| row.get(0))?;
        match mode.as_str() {
            "wal" => Ok(()),
            _ => Err(Error::Unavailable(format!("{} cannot have a write-ahead log", self.database.display()))),
        }
    }

    /// Runs one without parameters or rows.
    pub(in crate::store) fn control(&mut self, statement: &'static str) -> Result<(), Error> {
        Ok(self.inner.prepare_cached(statement)?.raw_execute().map(drop)?)
    }

    /// What one without parameters says in its first row.
    pub(super) fn first_row<T>(
        &mut self,
        statement: &'static str,
        read: impl FnOnce(&rusqlite::Row<'_>) -> rusqlite::Result<T>,
    ) -> Result<T, Error> {
        Ok(self.inner.prepare_cached(statement)?.query_row([], read)?)
    }

    /// How long a statement waits for others on the file.
    pub(super) fn set_busy_timeout(&mut self, busy_timeout: Duration) -> Result<(), Error> {
        Ok(self.inner.busy_timeout(busy_timeout)?)
    }

    /// The file.
    pub(super) fn database(&self) -> &Path {
        &self.database
    }

    /// Closes it: as the last one to go it writes the log back, where there is room for it, and removes it.
    pub(super) fn close(mut self) -> Result<(), Error> {
        if self.log_lacks()? == 0 {
            self.inner.set_db_config(DbConfig::SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, false)?;
        }
        self.inner.close().map_err(|(_, error)| error.into())
    }

    /// Rows that were changed over it.
    pub(in crate::store) fn changes(&self) -> u64 {
        self.inner.total_changes()
    }

    pub(super) fn inner(&mut self) -> &mut rusqlite::Connection {
        &mut self.inner
    }

    /// Runs a statement to its end and returns its rows.
    pub(super) fn run(&mut self, statement: &Statement) -> Result<Vec<Row>, Error> {
        let mut prepared = self.inner.prepare_cached(statement.sql())?;
        bind(&mut prepared, statement.values())?;
        let columns: Arc<[String]> = prepared.column_names().into_iter().map(str::to_owned).collect();
        let mut found = Vec::new();
        let mut rows = prepared.raw_query();
        while let Some(row) = rows.next()? {
            let cells = (0..columns.len()).map(|place| row.get(place).map_err(Error::from).and_then(value));
            found.push(Row::new(columns.clone(), cells.collect::<Result<_, _>>()?));
        }
        Ok(found)
    }
}

/// What a cell holds; no column is of reals.
fn value(cell: Cell) -> Result<Value, Error> {
    match cell {
        Cell::Null => Ok(Value::Integer(None)),
        Cell::Integer(value) => Ok(Value::Integer(Some(value))),
        Cell::Text(value) => Ok(Value::Text(Some(value))),
        Cell::Blob(value) => Ok(Value::Bytes(Some(value))),
        Cell::Real(_) => Err(Error::Corrupt("a column is a real number".into())),
    }
}

/// Gives the parameters `$1`, `$2`, ... their values. To SQLite these are names, numbered as they come.
fn bind(prepared: &mut Prepared<'_>, values: &[Value]) -> Result<(), Error> {
    for place in 1..=prepared.parameter_count() {
        let number = prepared.parameter_name(place).and_then(|name| name.strip_prefix('$')?.parse::<usize>().ok());
        let value = number.and_then(|number| values.get(number.checked_sub(1)?));
        match value.ok_or_else(|| Error::Corrupt(format!("a statement's parameter {place} has no value")))? {
            Value::Integer(value) => prepared.raw_bind_parameter(place, value)?,
            Value::Text(value) => prepared.raw_bind_parameter(place, value)?,
            Value::Bytes(value) => prepared.raw_bind_parameter(place, value)?,
        }
    }
    Ok(())
}

#[async_trait::async_trait]
impl Connection for SqliteConnection {
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        self.run(&statement)
    }
}

/// What SQLite's code says (sqlite.org/rescode.html), of which the primary one is the low byte. The index of its log
/// could not be made longer: `SQLITE_IOERR_SHMSIZE`.
fn of_code(code: i32) -> fn(String) -> Error {
    match (code, code & 0xff) {
        (ffi::SQLITE_IOERR_SHMSIZE, _) | (_, ffi::SQLITE_FULL) => Error::NoSpace,
        (_, ffi::SQLITE_CORRUPT | ffi::SQLITE_NOTADB) => Error::Corrupt,
        _ => Error::Unavailable,
    }
}

impl From<rusqlite::Error> for Error {
    fn from(error: rusqlite::Error) -> Self {
        use rusqlite::Error::{FromSqlConversionFailure, InvalidColumnType, SqliteFailure, Utf8Error};
        let text = error.to_string();
        match &error {
            SqliteFailure(cause, _) => of_code(cause.extended_code)(text),
            // What is stored is not what was written.
            FromSqlConversionFailure(..) | InvalidColumnType(..) | Utf8Error(..) => Self::Corrupt(text),
            _ => Self::Unavailable(text),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::schema::SCHEMA;
    use super::*;

    impl SqliteConnection {
        /// An empty database in memory.
        pub(in crate::store) fn in_memory() -> Result<Self, Error> {
            let connection = rusqlite::Connection::open_in_memory()?;
            connection.set_prepared_statement_cache_capacity(PREPARED);
            connection.pragma_update(None, "foreign_keys", "ON")?;
            connection.execute_batch(SCHEMA)?;
            Ok(Self { inner: connection, database: PathBuf::new() })
        }
    }

    #[test]
    fn codes_tell_a_full_disk_and_a_damaged_file() {
        let of = |code| of_code(code)(String::new());
        // SQLITE_FULL, SQLITE_IOERR_SHMSIZE = 10 | 19 << 8; SQLITE_CORRUPT, SQLITE_CORRUPT_INDEX = 11 | 3 << 8 and
        // SQLITE_NOTADB.
        assert!([13, 4874].map(of).iter().all(|error| matches!(error, Error::NoSpace(_))));
        assert!([11, 779, 26].map(of).iter().all(|error| matches!(error, Error::Corrupt(_))));
        // SQLITE_BUSY, SQLITE_IOERR_WRITE = 10 | 3 << 8.
        assert!([5, 778].map(of).iter().all(|error| matches!(error, Error::Unavailable(_))));
    }
}
