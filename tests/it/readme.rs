//! The README's own client, run as it stands there.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::Command;

use crate::support::program::{Serving, run};

const README: &str = include_str!("../../README.md");

/// The README's block of this language.
fn block(language: &str) -> &'static str {
    let fence = format!("```{language}\n");
    let (_, rest) = README.split_once(&fence).expect("the README has such a block");
    rest.split_once("```").expect("the block ends").0
}

/// An interpreter that has grpcio and grpcio-tools. Without one the test is skipped, loudly, unless
/// `SCPSFM_REQUIRE_PYTHON` forbids it.
fn python() -> Option<String> {
    let python = std::env::var("SCPSFM_PYTHON").unwrap_or_else(|_| "python3".into());
    let found = Command::new(&python).args(["-c", "import grpc, grpc_tools"]).output();
    if found.is_ok_and(|output| output.status.success()) {
        return Some(python);
    }
    let missing = format!("{python} with grpcio and grpcio-tools is missing (SCPSFM_PYTHON names an interpreter)");
    assert!(std::env::var_os("SCPSFM_REQUIRE_PYTHON").is_none(), "{missing}");
    // Past the capture of a passing test's output.
    writeln!(std::io::stderr(), "SKIPPED the Python client: {missing}").expect("stderr");
    None
}

/// Runs the interpreter to its end; returns what it printed.
fn succeeds(command: &mut Command) -> String {
    let output = command.output().expect("the interpreter runs");
    let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
    let (stdout, stderr) = (text(output.stdout), text(output.stderr));
    assert!(output.status.success(), "{command:?}\n{stdout}\n{stderr}");
    stdout
}

fn generate_stubs(python: &str, into: &Path) {
    let protos = fs::read_dir("proto/scpsfm/v1").expect("the API's files").map(|entry| entry.expect("a file").path());
    let out = |flag: &str| format!("--{flag}={}", into.display());
    let mut command = Command::new(python);
    command.args(["-m", "grpc_tools.protoc", "-I", "proto"]).args([out("python_out"), out("grpc_python_out")]);
    succeeds(command.args(protos));
}

#[test]
fn the_python_client_submits_watches_and_reads_the_result() {
    let Some(python) = python() else { return };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let scene = path("scene");
    let seed = ["synth", "--views", "8", "--tracks", "100", "--outliers", "0.5", "--seed", "2", "--out"];
    let made = run(seed.into_iter().map(Path::new).chain([scene.as_path()]));
    assert_eq!(made.code, Some(0), "{made:?}");
    let truth = fs::read_to_string(scene.join("truth.json")).expect("truth.json");
    let truth: serde_json::Value = serde_json::from_str(&truth).expect("JSON");
    let true_focal_px = truth["focal_px"].as_f64().expect("a focal length");

    fs::create_dir(path("stubs")).expect("a folder");
    generate_stubs(&python, &path("stubs"));
    fs::write(path("client.py"), block("python")).expect("written");
    let server = Serving::start(&path("data"));
    let printed = succeeds(
        Command::new(&python)
            .arg(path("client.py"))
            .arg(server.grpc.trim_start_matches("http://"))
            .arg(scene.join("observations.csv"))
            .env("PYTHONPATH", path("stubs"))
            .env("NO_PROXY", "127.0.0.1")
            .env("no_proxy", "127.0.0.1"),
    );
    let answer = |name: &str| {
        let line = printed.lines().find_map(|line| line.strip_prefix(name));
        line.unwrap_or_else(|| panic!("no {name:?} in {printed}")).trim()
    };
    assert_eq!(answer("status"), "RESULT_STATUS_SOLVED");
    let inliers: usize = answer("inlier tracks").parse().expect("a count");
    assert!((45..=55).contains(&inliers), "{inliers} of 50 inliers");
    let focal_px: f64 = answer("focal").parse().expect("a focal length");
    assert!((focal_px / true_focal_px - 1.0).abs() < 0.05, "{focal_px} instead of {true_focal_px}");
}
