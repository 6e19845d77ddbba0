//! A server that vanishes under a command that waits for a job, and one that was never there.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::Stdio;

use rustix::process::Signal;

use crate::support::program::{Running, Serving, program, run};

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

/// The server is lost for good: what is left is the job's name, and the commands that take it up again.
#[test]
fn a_lost_server_leaves_the_commands_that_find_the_job_again() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let scene = directory.path().join("scene");
    let made = run(["synth", "--views", "6", "--tracks", "60", "--out", text(&scene)]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let input = scene.join("observations.csv");
    let out = directory.path().join("out");
    let serving = Serving::start(&directory.path().join("data"));
    let server = ["--server", serving.grpc.as_str(), "--method", "paper", "--iterations", "10000"];
    let solve = ["solve", text(&input), "--out", text(&out), "--width", "1000", "--height", "1000"];
    let submit = ["submit", text(&input), "--watch"];
    let begun = [&solve[..], &submit[..]].map(|command| {
        let mut command = program(command.iter().chain(&server));
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the program starts");
        let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
        let running = Running(child);
        let mut line = String::new();
        stderr.read_line(&mut line).expect("the job's first event");
        let name = line.split(' ').next().expect("a name").to_owned();
        assert!(name.starts_with("tenants/default/jobs/"), "{line}");
        (running, stderr, name)
    });
    let grpc = serving.grpc.clone();
    serving.running.signal(Signal::KILL);
    for ((mut running, mut stderr, name), of_solve) in begun.into_iter().zip([true, false]) {
        let mut said = String::new();
        stderr.read_to_string(&mut said).expect("text");
        assert_eq!(running.wait().code(), Some(69), "{said}");
        assert!(said.contains(&format!("the job is {name};")), "{said}");
        let watch = format!("\n  scpsfm watch {name} --server {grpc}");
        assert!(said.contains(&watch), "{said}");
        let result = if of_solve {
            let files = format!("--out {} --input {} --width 1000 --height 1000", text(&out), text(&input));
            format!("\n  scpsfm result {name} --server {grpc} {files}\n")
        } else {
            format!("\n  scpsfm result {name} --server {grpc} --out DIR\n")
        };
        assert!(said.ends_with(&result), "{said}");
    }
}

/// What answers there is a server, and no trouble that passes: it is the wrong port.
#[test]
fn who_asks_the_port_of_the_metrics_is_told_so() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let serving = Serving::start(&directory.path().join("data"));
    let asked = run(["list", "--server", &format!("http://{}", serving.metrics)]);
    assert_eq!(asked.code, Some(69), "{asked:?}");
    assert!(asked.stderr.contains("speaks no gRPC: is this another port"), "{asked:?}");
}
