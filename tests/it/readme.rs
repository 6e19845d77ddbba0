//! What the documentation shows, run as it stands there.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::support::program::{Serving, run};
use crate::support::python::{python, succeeds};

const API: &str = include_str!("../../docs/api.md");
const CLIENT: &str = include_str!("../../src/client/mod.rs");

/// The first block of this language.
fn block(language: &str) -> &'static str {
    let fence = format!("```{language}\n");
    let (_, rest) = API.split_once(&fence).expect("the page has such a block");
    rest.split_once("```").expect("the block ends").0
}

#[test]
fn the_rust_client_is_the_one_that_is_compiled() {
    let (_, rest) = CLIENT.split_once("//! ```no_run\n").expect("an example in the documentation");
    let (example, _) = rest.split_once("//! ```").expect("the example ends");
    let example: Vec<&str> =
        example.lines().map(|line| line.trim_start_matches("//!").trim_start_matches(' ')).collect();
    let shown: Vec<&str> = block("rust").lines().map(str::trim_start).collect();
    assert_eq!(shown, example);
}

fn generate_stubs(python: &str, into: &Path) {
    let folders = ["proto/scpsfm/v1", "proto/google/api"];
    let files = folders.into_iter().flat_map(|folder| fs::read_dir(folder).expect("the API's files"));
    let protos = files.map(|entry| entry.expect("a file").path());
    let out = |flag: &str| format!("--{flag}={}", into.display());
    let mut command = Command::new(python);
    command.args(["-m", "grpc_tools.protoc", "-I", "proto"]).args([out("python_out"), out("grpc_python_out")]);
    succeeds(command.args(protos));
}

#[test]
fn the_python_client_submits_watches_and_reads_the_result() {
    let Some(python) = python("the Python client", "grpc, grpc_tools") else { return };
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

#[test]
fn the_files_of_a_solve_reproject_by_the_equations_of_their_page() {
    let Some(python) = python("the equations of docs/results.md", "numpy") else { return };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let (scene, out) = (directory.path().join("scene"), directory.path().join("out"));
    let text = |path: &Path| path.to_str().expect("a text").to_owned();
    let made = run(["synth", "--photographed", "--seed", "16", "--out", &text(&scene)]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let input = scene.join("observations.csv");
    let size = ["--width", "1600", "--height", "1200"];
    let solved = run(["solve", &text(&input), "--out", &text(&out)].into_iter().chain(size));
    assert_eq!(solved.code, Some(0), "{solved:?}");
    succeeds(Command::new(&python).arg("docs/examples/reproject.py").arg(&out).arg(&input));
}
