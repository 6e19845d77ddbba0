//! The real program, run as a user runs it.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use super::server::PATIENCE;

/// How often a child is asked whether it has ended.
const POLL: Duration = Duration::from_millis(10);

/// What a finished run left behind.
#[derive(Debug)]
pub struct Run {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

/// The program with these arguments, free of this shell's settings. `SCPSFM_PROGRAM` names another build of it, such as
/// an optimised one where figures are wanted.
pub fn program<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Command {
    let path = std::env::var_os("SCPSFM_PROGRAM").unwrap_or_else(|| env!("CARGO_BIN_EXE_scpsfm").into());
    let mut command = Command::new(path);
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SCPSFM_")) {
        command.env_remove(name);
    }
    // Of a fixed port, only one server on the machine could have it.
    command.args(arguments).env("SCPSFM_HTTP__LISTEN", "127.0.0.1:0");
    command
}

/// Runs to the end.
pub fn run<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Run {
    let output = program(arguments).stdin(Stdio::null()).output().expect("the program runs");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    Run { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

/// A running program; killed when dropped.
pub struct Running(pub Child);

impl Running {
    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.0.id() as i32).expect("a process id");
        kill_process(pid, signal).expect("the signal is sent");
    }

    /// Waits for the end, not for ever.
    pub fn wait(&mut self) -> ExitStatus {
        let begin = Instant::now();
        loop {
            if let Some(status) = self.0.try_wait().expect("the child can be asked") {
                return status;
            }
            assert!(begin.elapsed() < PATIENCE, "the program did not end");
            std::thread::sleep(POLL);
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn serve() -> Command {
    program(["serve", "--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--log-format", "json"])
}

/// `scpsfm serve` on free ports.
pub struct Serving {
    pub running: Running,
    /// `http://127.0.0.1:...`
    pub grpc: String,
    /// `127.0.0.1:...`
    pub metrics: String,
    /// `http://127.0.0.1:...`
    pub http: String,
    _stdout: BufReader<ChildStdout>,
}

impl Serving {
    /// Starts it on a data directory and waits until it says where it listens.
    pub fn start(data_dir: &Path) -> Self {
        Self::start_with(data_dir, &[], Stdio::null())
    }

    /// The same with these variables of the environment, logging to `stderr`.
    pub fn start_with(data_dir: &Path, variables: &[(&str, &str)], stderr: impl Into<Stdio>) -> Self {
        Self::start_more(data_dir, &["--workers", "1"], variables, stderr)
    }

    /// The same with more arguments.
    pub fn start_more(
        data_dir: &Path,
        arguments: &[&str],
        variables: &[(&str, &str)],
        stderr: impl Into<Stdio>,
    ) -> Self {
        let mut command = serve();
        command.arg("--data-dir").arg(data_dir).args(arguments).envs(variables.iter().copied());
        Self::spawned(command.stderr(stderr))
    }

    /// Starts it with one worker on a PostgreSQL database and waits until it says where it listens.
    pub fn on_database(url: &str, variables: &[(&str, &str)], stderr: impl Into<Stdio>) -> Self {
        let mut command = serve();
        // In the environment, as the README tells to: other users of the machine see flags.
        command.args(["--workers", "1"]).env("SCPSFM_STORE__URL", url).envs(variables.iter().copied());
        Self::spawned(command.stderr(stderr))
    }

    fn spawned(command: &mut Command) -> Self {
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().expect("the server starts");
        let mut stdout = BufReader::new(child.stdout.take().expect("piped"));
        let running = Running(child);
        let mut told = |prefix: &str| {
            let mut line = String::new();
            stdout.read_line(&mut line).expect("a line of the server");
            let address = line.trim_end().strip_prefix(prefix).map(str::to_owned);
            address.unwrap_or_else(|| panic!("{line:?} does not begin with {prefix:?}"))
        };
        let grpc = told("grpc ");
        let metrics = told("metrics http://").trim_end_matches("/metrics").to_owned();
        let http = told("http ");
        Self { running, grpc, metrics, http, _stdout: stdout }
    }

    /// Body of a page of the metrics port.
    pub fn page(&self, path: &str) -> String {
        let (head, body) = self.answer(path);
        assert!(head.starts_with("HTTP/1.1 200"), "{head}");
        body
    }

    /// Head and body of an answer of the metrics port, whatever its code.
    pub fn answer(&self, path: &str) -> (String, String) {
        use std::io::Write;
        let mut stream = std::net::TcpStream::connect(&self.metrics).expect("the metrics port answers");
        stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
        write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").expect("a request");
        let mut text = String::new();
        stream.read_to_string(&mut text).expect("an answer");
        let (head, body) = text.split_once("\r\n\r\n").expect("a head and a body");
        (head.to_owned(), body.to_owned())
    }
}
