//! A PostgreSQL of the tests' own: a cluster in a temporary folder, on a free port of the loopback interface.
//!
//! The store's unit tests include this file too, so that there is one way to start it.

// Neither of the two uses all of it.
#![allow(dead_code)]

use std::io::Write;
use std::net::TcpListener;
use std::os::unix::fs::chown;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// Nothing here takes nearly so long on any machine; what does hangs.
const PATIENCE: Duration = Duration::from_secs(60);

/// Who owns the database and what the password is: no secret, but one that must not be seen in any log.
const USER: &str = "tester";
pub const PASSWORD: &str = "hunter2";

/// A running cluster; it is stopped and removed when dropped.
pub struct Cluster {
    programs: PathBuf,
    owner: Option<(u32, u32)>,
    port: u16,
    server: Mutex<Child>,
    databases: AtomicU32,
    folder: TempDir,
}

/// The cluster that tests of one process share, as long as one of them is running. Without a PostgreSQL the test is
/// skipped, loudly, unless `SCPSFM_REQUIRE_POSTGRES` forbids it.
pub fn shared(what: &str) -> Option<Arc<Cluster>> {
    static SHARED: Mutex<Weak<Cluster>> = Mutex::new(Weak::new());
    // A test that failed to start it leaves nothing behind that the next one could not use.
    let mut shared = SHARED.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    if let Some(running) = shared.upgrade() {
        return Some(running);
    }
    let cluster = Arc::new(Cluster::start(what)?);
    *shared = Arc::downgrade(&cluster);
    Some(cluster)
}

/// The folder of PostgreSQL's programs: on the path, or where Debian puts them.
fn programs() -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let debian = std::fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten();
    let mut folders: Vec<PathBuf> = debian.map(|version| version.path().join("bin")).collect();
    folders.sort();
    folders.extend(std::env::split_paths(&path));
    folders.into_iter().rev().find(|folder| folder.join("initdb").is_file() && folder.join("postgres").is_file())
}

/// The user to run it as: PostgreSQL refuses root.
fn unprivileged() -> Option<(u32, u32)> {
    if !rustix::process::geteuid().is_root() {
        return None;
    }
    let users = std::fs::read_to_string("/etc/passwd").expect("the list of users");
    let nobody = users.lines().find_map(|line| line.strip_prefix("nobody:")).expect("a user nobody");
    let ids: Vec<u32> = nobody.split(':').skip(1).take(2).map(|id| id.parse().expect("a number")).collect();
    Some((ids[0], ids[1]))
}

fn free_port() -> u16 {
    let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a free port");
    listener.local_addr().expect("an address").port()
}

impl Cluster {
    /// A cluster of one's own, for tests that stop it.
    pub fn start(what: &str) -> Option<Self> {
        let Some(programs) = programs() else {
            let missing = "PostgreSQL (initdb, postgres) is missing";
            assert!(std::env::var_os("SCPSFM_REQUIRE_POSTGRES").is_none(), "{missing}");
            // Past the capture of a passing test's output.
            writeln!(std::io::stderr(), "SKIPPED {what}: {missing}").expect("stderr");
            return None;
        };
        let folder = tempfile::tempdir().expect("a temporary folder");
        let owner = unprivileged();
        std::fs::write(folder.path().join("password"), PASSWORD).expect("written");
        if let Some((user, group)) = owner {
            for path in [folder.path(), &folder.path().join("password")] {
                chown(path, Some(user), Some(group)).expect("given away");
            }
        }
        let data = folder.path().join("data");
        let mut initdb = as_user(&programs.join("initdb"), owner, folder.path());
        initdb.arg("-D").arg(&data).args(["-U", USER, "-A", "scram-sha-256", "-E", "UTF8", "--no-locale", "-N"]);
        let made = initdb.arg("--pwfile").arg(folder.path().join("password")).output().expect("initdb runs");
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        // Between the look for a free port and its use another process may take it.
        let (port, server) = (0..10)
            .find_map(|_| {
                let port = free_port();
                Some((port, spawn(&programs, owner, folder.path(), port)?))
            })
            .expect("PostgreSQL starts");
        Some(Self { programs, owner, port, server: Mutex::new(server), databases: AtomicU32::new(0), folder })
    }

    /// The address of a database, password included.
    fn url(&self, database: &str) -> String {
        format!("postgres://{USER}:{PASSWORD}@127.0.0.1:{}/{database}", self.port)
    }

    /// A new, empty database; returns its address.
    pub async fn database(&self) -> String {
        use sqlx::Connection;
        let name = format!("t{}", self.databases.fetch_add(1, Ordering::SeqCst));
        let mut connection = sqlx::PgConnection::connect(&self.url("postgres")).await.expect("a connection");
        let create = sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}"));
        sqlx::query(create).execute(&mut connection).await.expect("a database");
        connection.close().await.expect("closed");
        self.url(&name)
    }

    /// Whether a transaction of that database has been waiting for its client for a while.
    pub async fn waits_for_a_client(&self, url: &str) -> bool {
        use sqlx::Connection;
        let mut connection = sqlx::PgConnection::connect(url).await.expect("a connection");
        sqlx::query_scalar(
            "SELECT EXISTS (SELECT 1 FROM pg_stat_activity WHERE datname = current_database() \
             AND state = 'idle in transaction' AND clock_timestamp() - state_change > interval '100 ms')",
        )
        .fetch_one(&mut connection)
        .await
        .expect("an answer")
    }

    /// Stops the database in the midst of whatever it does, as by a crash; everything that was committed stays.
    pub fn stop(&self) {
        let mut server = self.server.lock().expect("no test panicked here");
        end(&mut server, Signal::QUIT);
    }

    /// Starts it again on the same port.
    pub fn restart(&self) {
        let mut server = self.server.lock().expect("no test panicked here");
        let begun = Instant::now();
        *server = loop {
            if let Some(started) = spawn(&self.programs, self.owner, self.folder.path(), self.port) {
                break started;
            }
            assert!(begun.elapsed() < PATIENCE, "PostgreSQL does not come back");
        };
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        let server = self.server.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner);
        end(server, Signal::QUIT);
    }
}

/// Ends the server with its children, which is what this signal is for.
fn end(server: &mut Child, signal: Signal) {
    let pid = Pid::from_raw(server.id() as i32).expect("a process id");
    if matches!(server.try_wait(), Ok(None)) {
        kill_process(pid, signal).expect("the signal is sent");
    }
    server.wait().expect("it ends");
}

fn as_user(program: &Path, owner: Option<(u32, u32)>, folder: &Path) -> Command {
    let mut command = Command::new(program);
    command.current_dir(folder).env_clear().env("PATH", std::env::var_os("PATH").unwrap_or_default());
    command.stdin(Stdio::null()).stdout(Stdio::null());
    if let Some((user, group)) = owner {
        command.uid(user).gid(group);
    }
    command
}

/// Starts the server and waits until it takes connections; `None` when it ended instead.
fn spawn(programs: &Path, owner: Option<(u32, u32)>, folder: &Path, port: u16) -> Option<Child> {
    let log = std::fs::File::options().append(true).create(true).open(folder.join("log")).expect("a log");
    let data = folder.join("data");
    let mut server = as_user(&programs.join("postgres"), owner, folder)
        .arg("-D")
        .arg(&data)
        // No socket files; nothing that a power cut could spoil is worth keeping.
        .args(["-k", "", "-h", "127.0.0.1", "-p", &port.to_string(), "-c", "fsync=off"])
        .stderr(log)
        .spawn()
        .expect("postgres runs");
    let begun = Instant::now();
    loop {
        if server.try_wait().expect("the child can be asked").is_some() {
            return None;
        }
        // The last line of its lock file says how far it is; the file of a server that crashed names another process.
        let state = std::fs::read_to_string(data.join("postmaster.pid")).unwrap_or_default();
        let mut lines = state.lines();
        if lines.next() == Some(server.id().to_string().as_str()) && lines.any(|line| line.trim() == "ready") {
            return Some(server);
        }
        assert!(begun.elapsed() < PATIENCE, "PostgreSQL does not become ready");
        std::thread::sleep(Duration::from_millis(20));
    }
}
