//! The embedded store: SQLite in a data directory that one server at a time may hold.
//!
//! All writes go through one connection, so that they queue up in the process and no caller ever sees `SQLITE_BUSY`;
//! reads have their own connections and, thanks to the write-ahead log, never wait for the writer.

mod attempts;
mod jobs;
mod rows;
#[cfg(test)]
mod tests;

use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::{Duration, SystemTime};

use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::sqlite::{
    SqliteAutoVacuum, SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{SqlSafeStr, Sqlite as Database, Transaction};

use super::record::{CancelReply, Claimed, Created, Ending, Heartbeat, Lease, Load, NewRecord, QueueBounds, Swept};
use super::{Error, JobPage, JobQuery, Store};
use crate::domain::job::{Job, JobEvent, JobName};
use crate::domain::progress::Progress;

/// The database within the data directory.
const DATABASE_FILE: &str = "scpsfm.db";
/// Held locked while a server uses the directory. A file of its own: SQLite's locks are on the database, and are let
/// go between transactions.
const LOCK_FILE: &str = "scpsfm.lock";
/// Connections for reading: listings and watchers seldom keep more than a few busy at once.
const READERS: u32 = 4;
/// How long a statement waits for another process on the file, such as a backup.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a caller waits for a connection; behind a queue of writes this long, the disk has failed.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(60);

/// Migrations in order; published ones are never edited.
const MIGRATIONS: [(i64, &str, &str); 1] = [(1, "jobs", include_str!("../migrations/sqlite/0001_jobs.sql"))];

/// Store in a data directory.
#[derive(Debug)]
pub struct Sqlite {
    writer: SqlitePool,
    readers: SqlitePool,
    /// Unlocked when it is closed, also by the death of the process.
    _lock: File,
}

impl Sqlite {
    /// Opens the store in `directory`, which is made where it is missing, and brings its schema up to date.
    ///
    /// # Errors
    /// [`Error::InUse`] while another server holds the directory, [`Error::Unavailable`] where it cannot be written,
    /// [`Error::Corrupt`] where its schema is of a newer version.
    pub async fn open(directory: &Path) -> Result<Self, Error> {
        let lock = lock(directory)?;
        let options = SqliteConnectOptions::new()
            .filename(directory.join(DATABASE_FILE))
            .create_if_missing(true)
            // Only takes effect in a new file; lets retention hand space back.
            .auto_vacuum(SqliteAutoVacuum::Incremental)
            .journal_mode(SqliteJournalMode::Wal)
            // What was acknowledged survives a power cut, not only a crash of the process.
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT);
        let writer = pool(1).connect_with(options.clone()).await?;
        migrate(&writer).await?;
        let readers = pool(READERS).connect_with(options.pragma("query_only", "1")).await?;
        Ok(Self { writer, readers, _lock: lock })
    }

    /// Runs a statement as it is, for tests that need the database to misbehave.
    #[cfg(test)]
    pub(crate) async fn execute(&self, statement: &'static str) {
        sqlx::query(statement).execute(&self.writer).await.expect("a valid statement");
    }

    /// Begins a transaction that may write. It takes the write lock at once: one that began by reading could not be
    /// upgraded after another process wrote.
    async fn begin(&self) -> Result<Transaction<'static, Database>, Error> {
        Ok(self.writer.begin_with("BEGIN IMMEDIATE").await?)
    }
}

fn pool(connections: u32) -> SqlitePoolOptions {
    // Connections to a file do not age, and need not be tried before every use.
    SqlitePoolOptions::new()
        .max_connections(connections)
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

async fn migrate(pool: &SqlitePool) -> Result<(), Error> {
    let migrations = MIGRATIONS
        .into_iter()
        .map(|(version, name, sql)| {
            Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
        })
        .collect();
    Migrator::with_migrations(migrations)
        .run(pool)
        .await
        .map_err(|error| Error::Corrupt(format!("cannot bring the schema up to date: {error}")))
}

impl From<sqlx::Error> for Error {
    fn from(error: sqlx::Error) -> Self {
        match error {
            sqlx::Error::ColumnDecode { .. } | sqlx::Error::ColumnNotFound(_) | sqlx::Error::Decode(_) => {
                Error::Corrupt(error.to_string())
            }
            _ => Error::Unavailable(error.to_string()),
        }
    }
}

#[async_trait::async_trait]
impl Store for Sqlite {
    async fn create_job(&self, new: NewRecord, bounds: &QueueBounds, now: SystemTime) -> Result<Created, Error> {
        let mut transaction = self.begin().await?;
        let created = jobs::create(&mut transaction, &new, bounds, now).await?;
        transaction.commit().await?;
        Ok(created)
    }

    async fn job(&self, name: &JobName) -> Result<Job, Error> {
        jobs::get(&mut *self.readers.acquire().await?, name).await
    }

    async fn jobs(&self, query: &JobQuery) -> Result<JobPage, Error> {
        jobs::list(&mut *self.readers.acquire().await?, query).await
    }

    async fn events_after(&self, name: &JobName, after: u64, limit: u32) -> Result<Vec<JobEvent>, Error> {
        jobs::events_after(&mut *self.readers.acquire().await?, name, after, limit).await
    }

    async fn claim(&self, worker: &str, now: SystemTime, lease_for: Duration) -> Result<Option<Claimed>, Error> {
        // Idle workers look for jobs again and again: through a reader, which keeps them out of the writers' queue.
        if !attempts::may_claim(&mut *self.readers.acquire().await?).await? {
            return Ok(None);
        }
        let mut transaction = self.begin().await?;
        let claimed = attempts::claim(&mut transaction, worker, now, lease_for).await?;
        transaction.commit().await?;
        Ok(claimed)
    }

    async fn input(&self, name: &JobName) -> Result<Vec<u8>, Error> {
        jobs::input(&mut *self.readers.acquire().await?, name).await
    }

    async fn heartbeat(&self, lease: &Lease, now: SystemTime, lease_for: Duration) -> Result<Heartbeat, Error> {
        let mut transaction = self.begin().await?;
        let heartbeat = attempts::heartbeat(&mut transaction, lease, now, lease_for).await?;
        transaction.commit().await?;
        Ok(heartbeat)
    }

    async fn record(&self, lease: &Lease, progress: &Progress, now: SystemTime) -> Result<u64, Error> {
        let mut transaction = self.begin().await?;
        let sequence = attempts::record(&mut transaction, lease, progress, now).await?;
        transaction.commit().await?;
        Ok(sequence)
    }

    async fn finish(&self, lease: &Lease, ending: &Ending, now: SystemTime) -> Result<Job, Error> {
        let mut transaction = self.begin().await?;
        let job = attempts::finish(&mut transaction, lease, ending, now).await?;
        transaction.commit().await?;
        Ok(job)
    }

    async fn release(&self, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
        let mut transaction = self.begin().await?;
        let job = attempts::release(&mut transaction, lease, now).await?;
        transaction.commit().await?;
        Ok(job)
    }

    async fn request_cancel(&self, name: &JobName, now: SystemTime) -> Result<CancelReply, Error> {
        let mut transaction = self.begin().await?;
        let reply = attempts::request_cancel(&mut transaction, name, now).await?;
        transaction.commit().await?;
        Ok(reply)
    }

    /// The lock on the directory says that no other process lives here, so that every lease is a dead one's.
    async fn recover(&self, now: SystemTime, max_attempts: u32) -> Result<Vec<Job>, Error> {
        let mut transaction = self.begin().await?;
        let changed = attempts::take_back(&mut transaction, None, now, max_attempts).await?;
        transaction.commit().await?;
        Ok(changed)
    }

    async fn sweep(&self, now: SystemTime, max_attempts: u32) -> Result<Swept, Error> {
        // Most sweeps find nothing: a look through a reader spares the writer, and the disk, a transaction.
        if !attempts::needs_sweep(&mut *self.readers.acquire().await?, now).await? {
            return Ok(Swept::default());
        }
        let mut transaction = self.begin().await?;
        let lost = attempts::take_back(&mut transaction, Some(now), now, max_attempts).await?;
        let expired = attempts::expire_queued(&mut transaction, now).await?;
        transaction.commit().await?;
        Ok(Swept { lost, expired })
    }

    async fn result(&self, name: &JobName) -> Result<Option<Vec<u8>>, Error> {
        jobs::result(&mut *self.readers.acquire().await?, name).await
    }

    async fn load(&self) -> Result<Load, Error> {
        jobs::load(&mut *self.readers.acquire().await?).await
    }

    async fn close(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }
}
