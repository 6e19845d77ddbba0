//! The embedded store: SQLite in a data directory that one server at a time may hold.
//!
//! All writes go through one connection, so that they queue up in the process and no caller ever sees `SQLITE_BUSY`;
//! those that wait together are committed together. Reads have other connections and, thanks to the write-ahead log,
//! never wait for the writer. Either way SQLite is called on a thread of ours: to hand every statement to a thread of its
//! connection, as asynchronous drivers do, takes longer beside busy solvers than most statements.

mod ballast;
mod connection;
#[cfg(test)]
mod groups_tests;
mod log;
mod readers;
mod schema;
#[cfg(test)]
mod tests;
mod vacuum;
mod writer;

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime};

use super::clock::LeaseClock;
use super::sql::{self, Connection, Database, Operation, Size, WriteIntent};
use super::{Clock, Error};
use ballast::Ballast;
pub(super) use connection::SqliteConnection;
use readers::Readers;
use vacuum::{VACUUM, VACUUM_BYTES, VACUUMS};
use writer::Writer;

/// The database within the data directory.
const DATABASE_FILE: &str = "scpsfm.db";
/// The same while it is made.
const DRAFT_FILE: &str = "scpsfm.db.new";
/// Held locked while a server uses the directory. A file of its own: SQLite's locks are on the database, and are let
/// go between transactions.
const LOCK_FILE: &str = "scpsfm.lock";
/// How long a statement waits for another process on the file, such as a backup.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);

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

/// Store in a data directory.
#[derive(Debug)]
pub struct Sqlite {
    writer: Writer,
    has_room: Arc<AtomicBool>,
    clock: LeaseClock,
    readers: Readers,
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
    pub fn open(directory: &Path) -> Result<Self, Error> {
        Self::open_with(directory, writer::GROUP_TIME)
    }

    fn open_with(directory: &Path, group_time: Duration) -> Result<Self, Error> {
        let lock = lock(directory)?;
        let database = directory.join(DATABASE_FILE);
        if !schema::is_there(&database)? {
            schema::create(directory, &database)?;
        }
        let mut ballast = Ballast::of(directory);
        let connection = match schema::open(&database) {
            // To open it is to write, too: a log and its index. Where these cannot be made, not every system says why.
            Err(Error::NoSpace(_) | Error::Unavailable(_)) if ballast.give_up() => schema::open(&database)?,
            opened => opened?,
        };
        // Only now: in the directory of another program nothing is made but the lock's file, which keeps two servers
        // from looking at once.
        if ballast.is_due() {
            ballast.restore();
        }
        let has_room = ballast.space_flag();
        let files = [database.clone(), schema::log_of(&database)];
        let readers = Readers::open(database.clone())?;
        let writer = Writer::start(connection, database, ballast, group_time)?;
        let clock = LeaseClock::new(Clock::default());
        Ok(Self { writer, has_room, clock, readers, files, _lock: lock })
    }
}

/// Of a store that is closed.
fn closed() -> Error {
    Error::Unavailable("the store is closed".into())
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
impl Database for Sqlite {
    /// The lock on the directory says that no other process lives here.
    fn is_shared(&self) -> bool {
        false
    }

    async fn reader(&self, size: Size) -> Result<Box<dyn Connection>, Error> {
        Ok(Box::new(self.readers.reader(size)))
    }

    async fn write(
        &self,
        _size: Size,
        intent: WriteIntent,
        operation: Operation<dyn Connection, ()>,
    ) -> Result<(), Error> {
        self.writer.write(intent, sql::operation(move |connection: &mut SqliteConnection| operation(connection))).await
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
        self.has_room.load(Ordering::Relaxed)
    }

    async fn close(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }
}
