//! The embedded store: SQLite in a data directory that one server at a time may hold.
//!
//! All writes go through one connection, so that they queue up in the process and no caller ever sees `SQLITE_BUSY`;
//! those that wait together are committed together. Reads have their own connections and, thanks to the write-ahead
//! log, never wait for the writer.

mod ballast;
mod connection;
#[cfg(test)]
mod groups_tests;
mod log;
#[cfg(test)]
mod tests;
mod vacuum;
mod writer;

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use sqlx::sqlite::{
    SqliteAutoVacuum, SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool, SqlitePoolOptions,
};

use super::clock::LeaseClock;
use super::sql::{self, Connection, Database, Operation, Row, Size, Statement, Step, WriteIntent};
use super::{Clock, Error, Notification};
use ballast::{Ballast, SpaceFlag};
pub(super) use connection::WriteConnection;
use vacuum::{VACUUM, VACUUM_BYTES, VACUUMS};
use writer::Writer;

/// The database within the data directory.
const DATABASE_FILE: &str = "scpsfm.db";
/// The same while it is made.
const DRAFT_FILE: &str = "scpsfm.db.new";
/// Held locked while a server uses the directory. A file of its own: SQLite's locks are on the database, and are let
/// go between transactions.
const LOCK_FILE: &str = "scpsfm.lock";
/// Connections for reading: listings and watchers seldom keep more than a few busy at once.
const READERS: u32 = 4;
/// How long a statement waits for another process on the file, such as a backup.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a reader waits for one of the connections, none of which waits for a write: reads that take this long are
/// of a disk that has failed.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(60);

/// What every connection is told.
const SETTINGS: [(&str, &str); 4] = [
    // What was acknowledged survives a power cut, not only a crash of the process.
    ("synchronous", "FULL"),
    ("foreign_keys", "ON"),
    // What the write-ahead log keeps of its length once it is written back, in bytes: a large result would leave it as
    // long as itself.
    ("journal_size_limit", "67108864"),
    // The writer writes the log back: see `log`.
    ("wal_autocheckpoint", "0"),
];

const SCHEMA: &str = include_str!("../migrations/sqlite/0001_schema.sql");

const MIGRATIONS: [Step; 1] = [(1, "schema", SCHEMA)];

/// Counts two tables that every store has, those of earlier builds too.
const OWN_TABLES: &str = "SELECT COUNT(*) FROM sqlite_schema WHERE name IN ('_sqlx_migrations', 'jobs')";

/// Store in a data directory.
#[derive(Debug)]
pub struct Sqlite {
    writer: Writer,
    has_room: SpaceFlag,
    clock: LeaseClock,
    readers: SqlitePool,
    /// The database and its write-ahead log.
    files: [PathBuf; 2],
    /// Unlocked when it is closed, also by the death of the process.
    _lock: File,
}

impl Sqlite {
    /// Opens the store in `directory`, which is made where it is missing, and brings its schema up to date.
    ///
    /// # Errors
    /// [`Error::InUse`] while another server holds the directory, [`Error::Unavailable`] where it cannot be written,
    /// [`Error::Corrupt`] where its schema is of a newer version, or its file is there and empty, or another program's.
    pub async fn open(directory: &Path) -> Result<Self, Error> {
        Self::open_with(directory, writer::GROUP_TIME).await
    }

    async fn open_with(directory: &Path, group_time: Duration) -> Result<Self, Error> {
        let lock = lock(directory)?;
        let database = directory.join(DATABASE_FILE);
        if !is_there(&database)? {
            create(directory, &database).await?;
        }
        let options = options(&database);
        let mut ballast = Ballast::of(directory);
        let connection = match bring_up_to_date(&options, &database).await {
            // To open it is to write, too: a log and its index. Where these cannot be made, not every system says why.
            Err(Error::NoSpace(_) | Error::Unavailable(_)) if ballast.give_up() => {
                bring_up_to_date(&options, &database).await?
            }
            opened => opened?,
        };
        // Only now: in the directory of another program nothing is made but the lock's file, which keeps two servers
        // from looking at once.
        if ballast.is_due() {
            ballast.restore();
        }
        let has_room = ballast.space_flag();
        let files = [database.clone(), log_of(&database)];
        let writer = Writer::start(connection, database, ballast, group_time)?;
        let readers = readers().connect_with(options.pragma("query_only", "1")).await?;
        let clock = LeaseClock::new(Clock::default());
        Ok(Self { writer, has_room, clock, readers, files, _lock: lock })
    }
}

/// How the database is opened to bring its schema up to date, and to read; see [`WriteConnection::open`].
fn options(database: &Path) -> SqliteConnectOptions {
    let options = SqliteConnectOptions::new().filename(database).journal_mode(SqliteJournalMode::Wal);
    SETTINGS.iter().fold(options.busy_timeout(BUSY_TIMEOUT), |options, &(name, value)| options.pragma(name, value))
}

/// Brings the schema of a database up to date, over a connection of its own.
async fn migrate(options: &SqliteConnectOptions) -> Result<(), Error> {
    let mut connection = <SqliteConnection as sqlx::Connection>::connect_with(options).await?;
    let migrated = sql::migrator(&MIGRATIONS).run(&mut connection).await.map_err(sql::migration_failed);
    // Also after an error: one that is only dropped goes at a time of its own.
    let closed = sqlx::Connection::close(connection).await;
    migrated.and(closed.map_err(Error::from))
}

/// Brings its schema up to date and opens it to write.
async fn bring_up_to_date(options: &SqliteConnectOptions, database: &Path) -> Result<WriteConnection, Error> {
    // First, and there until the other one is closed, also by an error: the last one to go writes the log back, which a
    // full disk has no room for.
    let connection = open_own(database)?;
    migrate(options).await?;
    Ok(connection)
}

/// Opens a store's database; refuses any other file before anything is written to it.
fn open_own(database: &Path) -> Result<WriteConnection, Error> {
    let opened = WriteConnection::open(database).and_then(|mut connection| {
        let own = connection.first_row(OWN_TABLES, |row| row.get::<_, i64>(0))?;
        Ok((connection, own == 2))
    });
    let file = database.display();
    match opened {
        Ok((connection, true)) => Ok(connection),
        Ok((_, false)) => Err(Error::Corrupt(format!(
            "{file} is the database of another program; give another data directory (store.data_dir)"
        ))),
        Err(Error::Corrupt(what)) => Err(Error::Corrupt(format!(
            "{file}: {what}; restore it from a backup, or give another data directory (store.data_dir)"
        ))),
        Err(error) => Err(error),
    }
}

/// The write-ahead log of a database.
fn log_of(database: &Path) -> PathBuf {
    database.with_file_name(format!("{DATABASE_FILE}-wal"))
}

/// Whether the database's file is there. One of no bytes is refused: no server leaves one behind, so that it is what is
/// left of jobs, and a store that began anew on it would hide that they are gone. So is none at all beside a log with
/// commits that only it holds.
fn is_there(database: &Path) -> Result<bool, Error> {
    let log = log_of(database);
    match std::fs::metadata(database) {
        Ok(file) if file.len() == 0 => Err(Error::Corrupt(format!(
            "{} has no bytes; restore it, or move it and the files beside it away to begin without jobs",
            database.display()
        ))),
        Ok(_) => Ok(true),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => match std::fs::metadata(&log) {
            Ok(log_file) if log_file.len() > 0 => Err(Error::Corrupt(format!(
                "{} is missing beside its log {}, which holds jobs; restore it, or move the log away, too, to begin \
                 without jobs",
                database.display(),
                log.display()
            ))),
            _ => Ok(false),
        },
        Err(error) => Err(Error::Unavailable(format!("cannot look at {}: {error}", database.display()))),
    }
}

/// Makes the database under another name, and gives it its own once it is whole: a process that dies in between leaves
/// nothing that looks like a store.
async fn create(directory: &Path, database: &Path) -> Result<(), Error> {
    let draft = directory.join(DRAFT_FILE);
    // Of a start that was cut off; and an empty log of a database that was taken away.
    for name in [DRAFT_FILE, DATABASE_FILE] {
        for suffix in ["", "-wal", "-shm"] {
            // Where there is none, there is nothing to remove.
            let _ = std::fs::remove_file(directory.join(format!("{name}{suffix}")));
        }
    }
    // Only takes effect in a new file, and is a write in any other; lets retention hand space back.
    let new = options(&draft).create_if_missing(true).auto_vacuum(SqliteAutoVacuum::Incremental);
    // As the only connection it writes the log back into the file and removes it.
    migrate(&new).await?;
    std::fs::rename(&draft, database)
        .map_err(|error| Error::Unavailable(format!("cannot make {}: {error}", database.display())))
}

fn readers() -> SqlitePoolOptions {
    // Connections to a file do not age, and need not be tried before every use.
    SqlitePoolOptions::new()
        .max_connections(READERS)
        .acquire_timeout(ACQUIRE_TIMEOUT)
        .test_before_acquire(false)
        .idle_timeout(None)
        .max_lifetime(None)
}

fn lock(directory: &Path) -> Result<File, Error> {
    let failed = |what: &str, error: std::io::Error| Error::Unavailable(format!("{what}: {error}"));
    std::fs::create_dir_all(directory)
        .map_err(|error| failed(&format!("cannot create the data directory {}", directory.display()), error))?;
    let path = directory.join(LOCK_FILE);
    let file = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(&path)
        .map_err(|error| failed(&format!("cannot open {}", path.display()), error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(Error::InUse(directory.to_path_buf())),
        Err(TryLockError::Error(error)) => Err(failed(&format!("cannot lock {}", path.display()), error)),
    }
}

#[async_trait::async_trait]
impl Connection for SqliteConnection {
    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        sql::run::<sqlx::Sqlite>(self, statement).await
    }
}

#[async_trait::async_trait]
impl Database for Sqlite {
    /// The lock on the directory says that no other process lives here.
    fn is_shared(&self) -> bool {
        false
    }

    async fn reader(&self, _size: Size) -> Result<Box<dyn Connection>, Error> {
        Ok(Box::new(self.readers.acquire().await?))
    }

    async fn write(
        &self,
        _size: Size,
        intent: WriteIntent,
        operation: Operation<dyn Connection, ()>,
    ) -> Result<(), Error> {
        self.writer.write(intent, sql::operation(move |connection: &mut WriteConnection| operation(connection))).await
    }

    fn bound(&self, _size: Size) -> Option<Duration> {
        None
    }

    fn lease_clock(&self, now: SystemTime) -> SystemTime {
        self.clock.translate(now)
    }

    /// The file and its log.
    async fn bytes(&self) -> Result<u64, Error> {
        let length = |path: &PathBuf| match std::fs::metadata(path) {
            Ok(file) => Ok(file.len()),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(0),
            Err(error) => Err(Error::Unavailable(format!("cannot look at {}: {error}", path.display()))),
        };
        self.files.iter().map(length).sum()
    }

    /// Gives the file's free pages back, some at a time. It becomes shorter as the log is written back, which tells it
    /// to: such a log need not be long.
    async fn vacuum(&self) -> Result<(), Error> {
        for _ in 0..VACUUMS {
            if !self.writer.vacuum_pays().await? {
                break;
            }
            self.writer.run(WriteIntent::Ends(VACUUM_BYTES), VACUUM).await?;
        }
        self.writer.shorten().await
    }

    fn has_room(&self) -> bool {
        self.has_room.is_set()
    }

    async fn notification(&self) -> Notification {
        std::future::pending().await
    }

    async fn disconnect(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }
}
