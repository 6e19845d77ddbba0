//! The write-ahead log on its way back into the database: by the writer, between commits, and only where the disk has
//! room for it.
//!
//! SQLite would do so by itself, within whichever commit makes the log long. On a disk that fills up it would write as
//! much as fits and leave the log as long as it was: the room that is kept for what ends would be gone, and nothing
//! won.

use std::path::Path;
use std::time::Duration;

use super::BUSY_TIMEOUT;
use super::connection::SqliteConnection;
use crate::store::Error;

/// Pages at which the log is written back, as SQLite has it: 4 MB.
pub(super) const LONG_PAGES: i64 = 1_000;

/// How long a log that is to be cut waits for its readers; writers wait meanwhile.
const CUT_BUSY_TIMEOUT: Duration = Duration::from_millis(200);

/// Pages of the log, and how many of them are in the database, too; nothing is moved.
const LOOK: &str = "PRAGMA wal_checkpoint(NOOP)";
/// Writes back what no reader keeps in the log, and waits for none.
const WRITE_BACK: &str = "PRAGMA wal_checkpoint(PASSIVE)";
/// Writes all of it back and cuts the file to nothing.
const CUT: &str = "PRAGMA wal_checkpoint(TRUNCATE)";

/// What became of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Log {
    /// It is short, or as short as its readers let it be.
    Short,
    /// The disk lacks so many bytes for the pages that it would add to the database.
    Lacks(u64),
}

impl SqliteConnection {
    /// Writes a log of so many pages at least back into the database. Outside a transaction, as all of this.
    pub(super) fn write_log_back(&mut self, least_pages: i64) -> Result<Log, Error> {
        let (pages, written): (i64, i64) = self.first_row(LOOK, |row| Ok((row.get(1)?, row.get(2)?)))?;
        if pages < least_pages || written >= pages {
            return Ok(Log::Short);
        }
        self.where_it_fits(|connection| connection.first_row(WRITE_BACK, |_| Ok(())))
    }

    /// Writes the log back and cuts it to nothing: its room is for others, too. Readers may keep it from that.
    pub(super) fn cut_log(&mut self) -> Result<Log, Error> {
        self.where_it_fits(|connection| {
            connection.set_busy_timeout(CUT_BUSY_TIMEOUT)?;
            let cut = connection.first_row(CUT, |_| Ok(()));
            connection.set_busy_timeout(BUSY_TIMEOUT)?;
            cut
        })
    }

    fn where_it_fits(&mut self, write_back: impl FnOnce(&mut Self) -> Result<(), Error>) -> Result<Log, Error> {
        match self.log_lacks()? {
            0 => write_back(self).map(|()| Log::Short),
            bytes => Ok(Log::Lacks(bytes)),
        }
    }

    /// Bytes that the disk lacks for the database to grow by what the log adds to it.
    pub(super) fn log_lacks(&mut self) -> Result<u64, Error> {
        let growth = self.bytes()?.saturating_sub(self.file_bytes()?);
        Ok(growth.saturating_sub(self.room()?))
    }

    /// Bytes of the database, wherever its pages are.
    pub(super) fn bytes(&mut self) -> Result<u64, Error> {
        Ok(self.number("PRAGMA page_count")? * self.page_bytes()?)
    }

    /// Bytes of a page.
    pub(super) fn page_bytes(&mut self) -> Result<u64, Error> {
        self.number("PRAGMA page_size")
    }

    /// What a statement says that answers with one number of 32 bits.
    pub(super) fn number(&mut self, statement: &'static str) -> Result<u64, Error> {
        self.first_row(statement, |row| row.get::<_, u32>(0)).map(u64::from)
    }

    /// Bytes of the database's file.
    pub(super) fn file_bytes(&self) -> Result<u64, Error> {
        Ok(std::fs::metadata(self.database()).map_err(cannot_look)?.len())
    }

    /// Bytes that are free on the disk, as far as the system tells.
    pub(super) fn room(&self) -> Result<u64, Error> {
        room_beside(self.database()).map_err(cannot_look)
    }
}

fn cannot_look(error: std::io::Error) -> Error {
    Error::Unavailable(format!("cannot look at the disk: {error}"))
}

/// Bytes that are free on the disk of a file, as far as the system tells.
fn room_beside(file: &Path) -> std::io::Result<u64> {
    #[cfg(unix)]
    {
        let disk = rustix::fs::statvfs(file)?;
        // Not every file system counts: what does not fit is found by trying.
        if disk.f_blocks == 0 {
            return Ok(u64::MAX);
        }
        Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
    }
    #[cfg(not(unix))]
    {
        let _ = file;
        Ok(u64::MAX)
    }
}
