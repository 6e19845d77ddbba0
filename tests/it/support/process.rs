//! The real program as a process of its own: for what only a process has, such as its death, its signals and its
//! metrics.

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use tonic::transport::Channel;

use super::scrape::Page;

/// A running `scpsfm serve`; killed when dropped.
pub struct Process {
    child: Child,
    grpc: String,
    metrics: SocketAddr,
}

impl Process {
    /// Starts the server on free loopback ports, with one worker and these variables of the environment, and waits
    /// until it serves. It logs to the file `log` in `data_dir`'s parent.
    pub fn serve(data_dir: &Path, variables: &[(&str, &str)]) -> Self {
        let log = std::fs::File::options().create(true).append(true).open(Self::log(data_dir)).expect("a log file");
        let mut child = Command::new(env!("CARGO_BIN_EXE_scpsfm"))
            .args(["serve", "--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--workers", "1"])
            .args(["--log-format", "json", "--data-dir"])
            .arg(data_dir)
            .envs(variables.iter().copied())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .expect("the program starts");
        let mut lines = BufReader::new(child.stdout.take().expect("piped"));
        let grpc = address(&mut lines, "grpc ", data_dir);
        let metrics = address(&mut lines, "metrics ", data_dir);
        let metrics = metrics.trim_start_matches("http://").trim_end_matches("/metrics").parse().expect("an address");
        Self { child, grpc, metrics }
    }

    /// Where the server of this data directory logs.
    pub fn log(data_dir: &Path) -> std::path::PathBuf {
        data_dir.with_extension("log")
    }

    pub async fn jobs(&self) -> JobServiceClient<Channel> {
        JobServiceClient::connect(self.grpc.clone()).await.expect("a connection")
    }

    /// What `/metrics` shows now.
    pub async fn scrape(&self) -> Page {
        Page::get(self.metrics).await
    }

    /// Asks the server to drain, as a supervisor does, and waits for its end. Needs a runtime of several threads.
    pub fn terminate(mut self) -> ExitStatus {
        let pid = Pid::from_child(&self.child);
        kill_process(pid, Signal::TERM).expect("the process lives");
        tokio::task::block_in_place(|| self.child.wait()).expect("it ends")
    }

    /// Ends the server without a warning, as a power cut does.
    pub fn kill(mut self) {
        self.child.kill().expect("the process lives");
        self.child.wait().expect("it ends");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Fails only where the process has ended, which is what is wanted.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What follows `name` on the next line.
fn address(lines: &mut BufReader<ChildStdout>, name: &str, data_dir: &Path) -> String {
    let mut line = String::new();
    lines.read_line(&mut line).expect("stdout");
    match line.trim_end().strip_prefix(name) {
        Some(address) => address.to_owned(),
        None => {
            let log = std::fs::read_to_string(Process::log(data_dir)).unwrap_or_default();
            panic!("the server printed {line:?} instead of its {name}address; its log:\n{log}")
        }
    }
}
