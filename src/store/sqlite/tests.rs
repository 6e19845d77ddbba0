//! SQLite under the store's contract, and what is its own: the lock on the directory and its file.

use futures_util::FutureExt;
use tempfile::TempDir;
use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;

use super::sql::{Row, Statement};
use super::*;
use crate::domain::job::JobState;
use crate::store::{Claim, contract};

/// A store in a directory that lives as long as the test.
pub(super) struct Fixture {
    pub store: Sqlite,
    _directory: TempDir,
}

impl Fixture {
    pub async fn open() -> Option<Self> {
        let directory = tempfile::tempdir().expect("a temporary directory");
        Some(Self { store: Sqlite::open(directory.path()).expect("opens"), _directory: directory })
    }

    /// One whose groups take all that waits, however long that takes.
    pub async fn open_patient() -> Self {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let store = Sqlite::open_with(directory.path(), Duration::MAX).expect("opens");
        Self { store, _directory: directory }
    }
}

impl std::ops::Deref for Fixture {
    type Target = Sqlite;

    fn deref(&self) -> &Sqlite {
        &self.store
    }
}

impl Sqlite {
    /// Runs statements as they are on the writer's connection, for tests that need the database to misbehave.
    pub(crate) async fn execute(&self, statements: &'static str) {
        let run = sql::operation(move |connection: &mut SqliteConnection| {
            Box::pin(async move { Ok(connection.inner().execute_batch(statements)?) })
        });
        self.writer.write(WriteIntent::Little, run).await.expect("valid statements");
    }

    /// Lets the database grow no more, and has a write find that out. The writer's next connection knows nothing of the
    /// limit.
    pub(crate) async fn find_no_room(&self) {
        self.execute("PRAGMA max_page_count = 1").await;
        let large = crate::store::NewRecord { input: vec![7; 1 << 20].into(), ..contract::record("large") };
        let refused = self.create_job(large, &contract::ROOM, contract::time(0)).await;
        assert!(matches!(refused, Err(Error::NoSpace(_))), "{refused:?}");
    }

    /// Keeps the writer with an operation that has begun, until the sender is dropped.
    pub(crate) async fn hold(&self) -> (watch::Sender<()>, JoinHandle<Result<(), Error>>) {
        let (go, gone) = watch::channel(());
        let (tell, begun) = oneshot::channel();
        let tell = std::sync::Mutex::new(Some(tell));
        let wait = sql::operation(move |_: &mut SqliteConnection| {
            let mut gone = gone.clone();
            if let Some(tell) = tell.lock().expect("no panic").take() {
                tell.send(()).expect("somebody waits");
            }
            // An error says that the sender was dropped, which is what is waited for.
            async move {
                let _ = gone.changed().await;
                Ok(())
            }
            .boxed()
        });
        let writer = self.writer.clone();
        let held = tokio::spawn(async move { writer.write(WriteIntent::Little, wait).await });
        begun.await.expect("it begins");
        (go, held)
    }

    /// What a pragma says on the connection that writes.
    async fn on_writer<T: Send + 'static>(&self, pragma: &'static str, read: fn(&Row) -> Result<T, Error>) -> T {
        let (tell, told) = std::sync::mpsc::channel();
        let run = sql::operation(move |connection: &mut SqliteConnection| {
            let tell = tell.clone();
            async move {
                let rows = connection.rows(Statement::new(pragma)).await?;
                tell.send(read(&rows[0])?).expect("somebody waits");
                Ok(())
            }
            .boxed()
        });
        self.writer.write(WriteIntent::Little, run).await.expect("an answer");
        told.recv().expect("a value")
    }
}

contract::store_contract!(Fixture::open);

#[tokio::test]
async fn a_second_server_on_the_directory_is_refused_until_the_first_is_gone() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let first = Sqlite::open(directory.path()).expect("opens");
    let error = Sqlite::open(directory.path()).expect_err("is held");
    assert_eq!(error, Error::InUse(directory.path().to_path_buf()));
    assert!(error.to_string().contains("in use by another server"), "{error}");
    drop(first);
    Sqlite::open(directory.path()).expect("the first let go");
}

#[tokio::test]
async fn everything_is_there_after_a_reopen_and_every_lease_is_a_dead_one() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let now = contract::time(1);
    let store = Sqlite::open(directory.path()).expect("opens");
    store.create_job(contract::record("a"), &contract::ROOM, now).await.expect("created");
    let claimed =
        store.claim(&Claim::one("w", Duration::from_secs(3600)), now).await.expect("claims").begun.expect("a job");
    let events = store.events_after(&claimed.job.name, 0, 10).await.expect("events");
    drop(store);

    let store = Sqlite::open(directory.path()).expect("opens again");
    assert_eq!(store.job(&claimed.job.name).await.expect("kept"), claimed.job);
    assert_eq!(store.events_after(&claimed.job.name, 0, 10).await.expect("kept"), events);
    let recovered = store.recover(now, 3).await.expect("recovers");
    assert_eq!(recovered.len(), 1, "though the lease has an hour to go");
    assert_eq!(recovered[0].state, JobState::Queued);
}

#[tokio::test]
async fn a_read_that_is_given_up_leaves_its_connection_to_others() {
    let fixture = Fixture::open().await.expect("opens");
    let created = fixture.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
    let name = created.job.name;
    for _ in 0..20 {
        // Off this thread: it has begun, or waits for its turn, of which there are fewer.
        let _ = fixture.result(&name, u32::MAX).now_or_never();
    }
    assert_eq!(fixture.result(&name, u32::MAX).await, Ok(None));
    fixture.job(&name).await.expect("is there");
}

#[tokio::test]
async fn a_closed_store_says_so() {
    let fixture = Fixture::open().await.expect("opens");
    fixture.queue_stats().await.expect("open");
    fixture.close().await;
    let closed = Error::Unavailable("the store is closed".into());
    assert_eq!(fixture.queue_stats().await, Err(closed.clone()));
    let created = fixture.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await;
    assert_eq!(created.map(|created| created.job.name), Err(closed));
}

#[tokio::test]
async fn a_database_of_another_version_is_refused() {
    let newer = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
                 VALUES (9999, 'from the future', 1, x'00', 0)";
    let older = "UPDATE _sqlx_migrations SET checksum = x'00'";
    let odd = "UPDATE _sqlx_migrations SET checksum = 'text'";
    let half = "UPDATE _sqlx_migrations SET success = FALSE";
    for (statement, step) in [(newer, "step 9999"), (older, "step 1"), (odd, "step 1"), (half, "step 1")] {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let store = Sqlite::open(directory.path()).expect("opens");
        store.execute(statement).await;
        store.close().await;
        drop(store);
        let error = Sqlite::open(directory.path()).expect_err("is of another version");
        assert!(matches!(&error, Error::Corrupt(told) if told.contains(step)), "{error}");
    }
}

#[tokio::test]
async fn a_database_of_another_program_is_refused_and_left_as_it_is() {
    // A program that keeps its own migrations in the same way is another one too.
    for schema in ["CREATE TABLE keypoints (image_id)", "CREATE TABLE _sqlx_migrations (version)"] {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let database = directory.path().join(DATABASE_FILE);
        rusqlite::Connection::open(&database).and_then(|made| made.execute_batch(schema)).expect("made");
        let before = std::fs::read(&database).expect("is there");
        let error = Sqlite::open(directory.path()).expect_err("is foreign");
        assert!(matches!(&error, Error::Corrupt(told) if told.contains("of another program")), "{error}");
        assert_eq!(std::fs::read(&database).expect("is there"), before);
        assert_eq!(files(directory.path()), [DATABASE_FILE, LOCK_FILE]);
    }
}

/// Names of the files in a directory, sorted.
fn files(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).expect("a directory");
    let name = |entry: std::io::Result<std::fs::DirEntry>| entry.expect("a file").file_name().into_string();
    let mut names: Vec<String> = entries.map(|entry| name(entry).expect("UTF-8")).collect();
    names.sort();
    names
}

#[tokio::test]
async fn a_file_that_is_no_database_is_refused_by_its_name_and_left_as_it_is() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let database = directory.path().join(DATABASE_FILE);
    let text = "No database, and longer than the header of one. ".repeat(100);
    std::fs::write(&database, &text).expect("written");
    let error = Sqlite::open(directory.path()).expect_err("no database");
    let path = database.display().to_string();
    let says = |told: &str| told.starts_with(&path) && told.contains("not a database") && told.contains("data_dir");
    assert!(matches!(&error, Error::Corrupt(told) if says(told)), "{error}");
    assert_eq!(std::fs::read_to_string(&database).expect("is there"), text);
    assert_eq!(files(directory.path()), [DATABASE_FILE, LOCK_FILE]);
}

#[tokio::test]
async fn people_see_times_and_labels() {
    let fixture = Fixture::open().await.expect("opens");
    fixture.create_job(contract::labelled("a"), &contract::ROOM, contract::time(0)).await.expect("created");
    let select = "SELECT create_time || ' ' || labels AS line FROM job_list";
    let line = fixture.on_writer(select, |row| row.text("line")).await;
    assert_eq!(line, format!("{} {{\"site\":\"north\"}}", "2023-11-14T22:13:20.000Z"));
}

#[tokio::test]
async fn an_empty_file_is_refused_and_half_a_start_is_none() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    // What a start leaves that is cut off.
    std::fs::write(directory.path().join(DRAFT_FILE), b"half").expect("written");
    let store = Sqlite::open(directory.path()).expect("opens");
    store.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
    store.close().await;
    drop(store);
    let database = directory.path().join(DATABASE_FILE);
    std::fs::write(&database, b"").expect("emptied");
    let error = Sqlite::open(directory.path()).expect_err("its jobs are gone");
    assert!(matches!(&error, Error::Corrupt(text) if text.contains("has no bytes")), "{error}");
    assert_eq!(std::fs::metadata(&database).expect("is there").len(), 0, "left as it was found");
    let log = directory.path().join(format!("{DATABASE_FILE}-wal"));
    std::fs::remove_file(&database).expect("removed");
    std::fs::write(&log, b"commits").expect("written");
    let error = Sqlite::open(directory.path()).expect_err("the log is all that is left");
    assert!(matches!(&error, Error::Corrupt(text) if text.contains("is missing beside its log")), "{error}");
    assert_eq!(std::fs::read(&log).expect("is there"), b"commits", "left as it was found");
}

#[tokio::test]
async fn commits_are_synced_and_the_log_is_written_ahead() {
    let fixture = Fixture::open().await.expect("opens");
    let journal = fixture.on_writer("PRAGMA journal_mode", |row| row.text("journal_mode")).await;
    let synchronous = fixture.on_writer("PRAGMA synchronous", |row| row.integer("synchronous")).await;
    assert_eq!((journal.as_str(), synchronous), ("wal", 2));
}

#[tokio::test]
async fn deleted_jobs_leave_no_space_taken() {
    let fixture = Fixture::open().await.expect("opens");
    let pages = async || fixture.on_writer("PRAGMA page_count", |row| row.integer("page_count")).await;
    let mut largest = 0;
    let empty = pages().await;
    for round in 0..6 {
        let new = crate::store::NewRecord { input: vec![round; 4 << 20].into(), ..contract::record("a") };
        let name = fixture.create_job(new, &contract::ROOM, contract::time(0)).await.expect("created").job.name;
        largest = largest.max(pages().await);
        fixture.request_cancel(&name, None, contract::time(1)).await.expect("cancels");
        fixture.delete_job(&name, None).await.expect("deletes");
        fixture.reclaim().await.expect("gives back");
        assert!(pages().await < empty + 50, "round {round}: {} pages of {empty} at first", pages().await);
    }
    let chunk_pages = (4 << 20) / 4096;
    assert!(largest > chunk_pages, "{largest}");
    assert!(largest < empty + 2 * chunk_pages, "the file never held two inputs: {largest}");
    // Though the log, which says so, is short.
    let bytes = || std::fs::metadata(fixture._directory.path().join(DATABASE_FILE)).expect("the file").len();
    assert!(bytes() < VACUUM_BYTES, "{} bytes", bytes());
    fixture.close().await;
    assert!(bytes() < 1 << 20, "{} bytes", bytes());
}

#[tokio::test]
async fn of_a_deleted_input_nothing_is_left_once_its_jobs_are_gone() {
    let fixture = Fixture::open().await.expect("opens");
    contract::uploads::a_deleted_input_is_kept_by_its_jobs_alone(&*fixture).await;
    for _ in 0..3 {
        fixture.purge_uploads(None, None).await.expect("clears away");
    }
    let rows = async |count: &'static str| fixture.on_writer(count, |row| row.integer("count")).await;
    // Of the new one alone.
    assert_eq!(rows("SELECT COUNT(*) AS count FROM inputs").await, 1);
    assert_eq!(rows("SELECT COUNT(*) AS count FROM uploads").await, 1);
    assert_eq!(rows("SELECT COUNT(*) AS count FROM upload_parts").await, 0);
}

#[tokio::test]
async fn a_write_that_finds_no_room_is_run_again_once_the_log_is_cut() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let store = Sqlite::open(directory.path()).expect("a store");
    // A log that is too short to be written back by itself.
    let new = crate::store::NewRecord { input: vec![7; 3 << 20].into(), ..contract::record("a") };
    let name = store.create_job(new, &contract::ROOM, contract::time(0)).await.expect("created").job.name;
    let log = directory.path().join(format!("{DATABASE_FILE}-wal"));
    let length = std::fs::metadata(&log).expect("a log").len();
    assert!(length > 3 << 20, "{length} bytes");
    // As full as it is; the next connection knows nothing of the limit, as if the log had made room.
    store.execute("PRAGMA max_page_count = 1").await;
    let new = crate::store::NewRecord { input: vec![7; 1 << 20].into(), ..contract::record("b") };
    store.create_job(new, &contract::ROOM, contract::time(1)).await.expect("room is made");
    let length = std::fs::metadata(&log).expect("a log").len();
    assert!(length < 2 << 20, "the second write alone: {length} bytes");
    assert!(directory.path().join("scpsfm.reserve").exists());
    store.job(&name).await.expect("the first one");
}

#[tokio::test]
async fn a_log_that_has_become_long_is_written_back() {
    let fixture = Fixture::open().await.expect("opens");
    let beside = rusqlite::Connection::open(fixture._directory.path().join(DATABASE_FILE)).expect("another reader");
    let log = async || {
        // The writer's next turn comes once it is done with the log.
        fixture.on_writer("PRAGMA page_count", |row| row.integer("page_count")).await;
        let pages = |row: &rusqlite::Row<'_>| Ok((row.get::<_, i64>(1)?, row.get::<_, i64>(2)?));
        beside.query_row("PRAGMA wal_checkpoint(NOOP)", [], pages).expect("a log")
    };
    let create = async |job: &'static str, bytes: usize| {
        let new = crate::store::NewRecord { input: vec![1; bytes].into(), ..contract::record(job) };
        fixture.create_job(new, &contract::ROOM, contract::time(0)).await.expect("created");
    };
    create("a", 1 << 20).await;
    let (pages, written) = log().await;
    assert!(pages > 256 && written == 0, "a short one waits for more: {written} of {pages}");
    create("b", 4 << 20).await;
    let (pages, written) = log().await;
    assert!(pages > 1_000 && written == pages, "{written} of {pages}");
}
