//! The database's file and its schema: made where there is none, brought up to date, and told from another program's.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use rusqlite::{TransactionBehavior, params};

use super::connection::SqliteConnection;
use super::{DATABASE_FILE, DRAFT_FILE};
use crate::store::Error;
use crate::store::sql::{self, Step};

pub(super) const SCHEMA: &str = include_str!("../migrations/sqlite/0001_schema.sql");

const MIGRATIONS: [Step; 1] = [(1, "schema", SCHEMA)];

/// Which steps a database has, in the table that sqlx has for them on PostgreSQL, too.
const STEPS_TABLE: &str = "CREATE TABLE IF NOT EXISTS _sqlx_migrations (version BIGINT PRIMARY KEY, \
    description TEXT NOT NULL, installed_on TIMESTAMP NOT NULL DEFAULT CURRENT_TIMESTAMP, success BOOLEAN NOT NULL, \
    checksum BLOB NOT NULL, execution_time BIGINT NOT NULL)";

const NOTE_STEP: &str = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
                         VALUES (?, ?, TRUE, ?, 0)";

/// Counts two tables that every store has, those of earlier builds too.
const OWN_TABLES: &str = "SELECT COUNT(*) FROM sqlite_schema WHERE name IN ('_sqlx_migrations', 'jobs')";

/// Opens a store's database to write, and brings its schema up to date; refuses any other file before anything is
/// written to it.
pub(super) fn open(database: &Path) -> Result<SqliteConnection, Error> {
    let opened = SqliteConnection::open(database).and_then(|mut connection| {
        let own = connection.first_row(OWN_TABLES, |row| row.get::<_, i64>(0))?;
        Ok((connection, own == 2))
    });
    let file = database.display();
    let mut connection = match opened {
        Ok((connection, true)) => connection,
        Ok((_, false)) => {
            return Err(Error::Corrupt(format!(
                "{file} is the database of another program; give another data directory (store.data_dir)"
            )));
        }
        Err(Error::Corrupt(what)) => {
            return Err(Error::Corrupt(format!(
                "{file}: {what}; restore it from a backup, or give another data directory (store.data_dir)"
            )));
        }
        Err(error) => return Err(error),
    };
    connection.write_ahead()?;
    update(&mut connection)?;
    Ok(connection)
}

/// Takes the steps that the database does not have, all or none.
fn update(connection: &mut SqliteConnection) -> Result<(), Error> {
    let steps = sql::migrator(&MIGRATIONS);
    let transaction = connection.inner().transaction_with_behavior(TransactionBehavior::Immediate)?;
    transaction.execute_batch(STEPS_TABLE)?;
    // Without a checksum: a step that was begun and not done.
    let select = "SELECT version, CASE WHEN success THEN CAST(checksum AS BLOB) END FROM _sqlx_migrations";
    let taken: BTreeMap<i64, Option<Vec<u8>>> =
        transaction.prepare(select)?.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?.collect::<Result<_, _>>()?;
    if let Some(&unknown) = taken.keys().find(|&&version| !steps.version_exists(version)) {
        return Err(sql::other_version(unknown));
    }
    for step in steps.iter() {
        match taken.get(&step.version) {
            Some(Some(checksum)) if *checksum == *step.checksum => {}
            Some(_) => return Err(sql::other_version(step.version)),
            None => {
                transaction.execute_batch(step.sql.as_str())?;
                transaction.execute(NOTE_STEP, params![step.version, step.description, step.checksum])?;
            }
        }
    }
    Ok(transaction.commit()?)
}

/// The write-ahead log of a database.
pub(super) fn log_of(database: &Path) -> PathBuf {
    database.with_file_name(format!("{DATABASE_FILE}-wal"))
}

/// Whether the database's file is there. One of no bytes is refused: no server leaves one behind, so that it is what is
/// left of jobs, and a store that began anew on it would hide that they are gone. So is none at all beside a log with
/// commits that only it holds.
pub(super) fn is_there(database: &Path) -> Result<bool, Error> {
    let log = log_of(database);
    match std::fs::metadata(database) {
        Ok(file) if file.len() == 0 => Err(Error::Corrupt(format!(
            "{} has no bytes; restore it, or move it and the files beside it away to begin without jobs",
            database.display()
        ))),
        Ok(_) => Ok(true),
        Err(error) if error.kind() == ErrorKind::NotFound => match std::fs::metadata(&log) {
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
pub(super) fn create(directory: &Path, database: &Path) -> Result<(), Error> {
    let draft = directory.join(DRAFT_FILE);
    // Of a start that was cut off; and an empty log of a database that was taken away.
    for name in [DRAFT_FILE, DATABASE_FILE] {
        for suffix in ["", "-journal", "-wal", "-shm"] {
            // Where there is none, there is nothing to remove.
            let _ = std::fs::remove_file(directory.join(format!("{name}{suffix}")));
        }
    }
    let mut connection = SqliteConnection::create(&draft)?;
    update(&mut connection)?;
    drop(connection);
    std::fs::rename(&draft, database)
        .map_err(|error| Error::Unavailable(format!("cannot make {}: {error}", database.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stores of earlier builds know a step by its checksum.
    #[test]
    fn published_steps_are_as_they_were() {
        let begins =
            |step: &sqlx::migrate::Migration| step.checksum[..8].iter().map(|byte| format!("{byte:02x}")).collect();
        let checksums: Vec<String> = sql::migrator(&MIGRATIONS).iter().map(begins).collect();
        assert_eq!(checksums, ["a21000a69f783a9d"]);
    }
}
