//! The program from the shell: exit codes, sentences, files.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Instant;

use rustix::process::Signal;
use serde_json::Value;
use tempfile::TempDir;

use crate::support::program::{Running, Serving, program, run};
use crate::support::server::PATIENCE;

/// An address where nothing listens: port 1 is reserved and privileged.
const NOBODY: &str = "http://127.0.0.1:1";

fn directory() -> TempDir {
    tempfile::tempdir().expect("a temporary directory")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// A scene that is quickly solved.
fn scene(directory: &Path) -> PathBuf {
    let out = directory.join("scene");
    let run = run(["synth", "--views", "6", "--tracks", "60", "--outliers", "0.5", "--seed", "5", "--out", text(&out)]);
    assert_eq!(run.code, Some(0), "{run:?}");
    out.join("observations.csv")
}

#[test]
fn every_command_explains_itself() {
    let commands = [
        "demo",
        "serve",
        "solve",
        "upload",
        "inputs",
        "submit",
        "watch",
        "get",
        "list",
        "cancel",
        "retry",
        "priority",
        "delete",
        "result",
        "admin",
        "synth",
        "evaluate",
        "train-prior",
        "completions",
        "man",
    ]
    .map(Some);
    for command in commands.into_iter().chain([None]) {
        let run = run(command.into_iter().chain(["--help"]));
        assert_eq!(run.code, Some(0), "{run:?}");
        assert!(run.stdout.contains(if command.is_some() { "Examples:" } else { "Exit codes:" }), "{}", run.stdout);
    }
    assert_eq!(run(["--version"]).stdout.trim(), concat!("scpsfm ", env!("CARGO_PKG_VERSION")));
}

#[test]
fn an_evaluation_scores_methods_against_the_oracle_and_goes_on_where_it_was() {
    let directory = directory();
    let out = directory.path().join("evaluation");
    let evaluate = |seeds: &'static str| {
        let run = run([
            "evaluate",
            "--sweeps",
            "orbit",
            "--depths",
            "given",
            "--methods",
            "oracle,psfm",
            "--seeds",
            seeds,
            "--json",
            "--quiet",
            "--out",
            text(&out),
        ]);
        assert_eq!(run.code, Some(0), "{run:?}");
        json(&run.stdout)
    };
    let summary = evaluate("1");
    let cells = summary["cells"].as_array().expect("cells");
    assert_eq!(cells.len(), 10, "five shares of outliers, two methods");
    let oracle = cells.iter().filter(|cell| cell["contestant"] == "oracle");
    assert!(oracle.clone().count() == 5 && oracle.clone().all(|cell| cell["mean_f1"].as_f64() > Some(0.95)));
    for file in ["runs.jsonl", "summary.json", "summary.csv", "figure-depths-given.svg", "index.html"] {
        assert!(out.join(file).metadata().is_ok_and(|metadata| metadata.len() > 0), "{file}");
    }
    let records = || fs::read_to_string(out.join("runs.jsonl")).expect("records");
    let first = records();
    assert_eq!(first.lines().count(), 1 + 10);
    evaluate("2");
    assert!(records().starts_with(&first), "what was recorded stays");
    assert_eq!(records().lines().count(), 1 + 20);
}

#[test]
fn wrong_usage_ends_with_2_and_does_nothing() {
    let directory = directory();
    let input = scene(directory.path());
    let (input, out) = (text(&input), directory.path().join("out"));
    let cases: [&[&str]; 21] = [
        &["solve", input],
        &["solve", input, "--out", text(&out), "--seed", "-1"],
        &["submit", "--server", NOBODY],
        &["submit", "-", "-", "--server", NOBODY],
        &["solve", input, "--out", text(&out), "--export", "colmap-db"],
        &["solve", input, "--out", text(&out), "--width", "100"],
        &["solve", input, "--out", text(&out), "--width", "0", "--height", "9"],
        &["solve", input, "--out", text(&out), "--iterations", "0"],
        &["solve", input, "--out", text(&out), "--iterations", "10001"],
        &["submit", input, "--server", NOBODY, "--priority", "1001"],
        &["submit", input, "--server", NOBODY, "--request-id", ""],
        &["submit", input, "--server", NOBODY, "--job-id", ""],
        &["submit", input, "--server", NOBODY, "--label", "a=1", "--label", "a=2"],
        &["solve", input, "--out", text(&out), "--method", "magic"],
        &["solve", input, "--out", text(&out), "--epipolar-depths"],
        &["synth", "--views", "1", "--out", text(&out)],
        &["synth", "--focal-px", "0", "--out", text(&out)],
        &["evaluate", "--sweeps", "magic", "--out", text(&out)],
        &["evaluate", "--seeds", "0", "--out", text(&out)],
        &["evaluate", "--ablation", "--methods", "auto", "--out", text(&out)],
        &["frobnicate"],
    ];
    for arguments in cases {
        let run = run(arguments);
        assert_eq!(run.code, Some(2), "{arguments:?}: {run:?}");
        assert!(run.stdout.is_empty() && run.stderr.contains("error"), "{run:?}");
    }
    assert!(!out.exists());
}

#[test]
fn a_bad_input_ends_with_65_and_names_file_and_line() {
    let directory = directory();
    let good = fs::read_to_string(scene(directory.path())).expect("the scene");
    let bad = directory.path().join("bad.csv");
    let refused = |content: &[u8]| {
        fs::write(&bad, content).expect("written");
        let run = run(["solve", text(&bad), "--out", text(&directory.path().join("out"))]);
        assert_eq!(run.code, Some(65), "{run:?}");
        assert!(run.stdout.is_empty(), "{run:?}");
        run.stderr
    };
    let mut lines: Vec<&str> = good.lines().collect();
    lines[17] = "0,16,NaN,1";
    let nan = refused(lines.join("\n").as_bytes());
    assert_eq!(nan, format!("error: {}, line 18: x: NaN is not a finite number\n", text(&bad)));
    assert!(refused(&good.as_bytes()[..good.len() - 30]).contains("the file may be truncated"));
    assert!(refused(b"").contains("bad.csv: is empty"));
    assert!(refused(b"\x7fELF\x02\x01\x01\0\0\0\n").contains("bad.csv: is not a text file"));
    assert!(refused(b"SQLite format 3\0").contains("bad.csv: cannot be"));
    let missing = run(["solve", "no/such.csv", "--out", text(directory.path())]);
    assert_eq!(missing.code, Some(65), "{missing:?}");
    assert!(missing.stderr.contains("such.csv: cannot be read"), "{missing:?}");
    assert!(!directory.path().join("out").exists());
}

#[test]
fn a_table_may_come_on_standard_input() {
    let directory = directory();
    let input = scene(directory.path());
    let out = |name: &str| directory.path().join(name);
    let from = |file: &Path, more: &[&str]| {
        let size = ["--width", "1000", "--height", "1000", "--json", "--quiet"];
        let mut command = program(["solve", "-", "--out", text(&out("piped"))].iter().chain(&size).chain(more));
        let output = command.stdin(fs::File::open(file).expect("a file")).output().expect("the program runs");
        let words = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
        (output.status.code(), words(output.stdout), words(output.stderr))
    };
    let (code, piped, _) = from(&input, &[]);
    assert_eq!(code, Some(0));
    let size = ["--width", "1000", "--height", "1000", "--json", "--quiet"];
    let read = run(["solve", text(&input), "--out", text(&out("read"))].iter().chain(&size));
    assert_eq!(json(&piped)["focal_px"], json(&read.stdout)["focal_px"]);

    // The kind is told from the first bytes.
    let other = directory.path().join("other");
    fs::write(&other, "OPENSFM_TRACKS_VERSION_v1\na.jpg\t0\t0\n").expect("written");
    let (code, _, told) = from(&other, &[]);
    assert!(code == Some(65) && told.starts_with("error: standard input, line 2: "), "{told}");
    fs::write(&other, b"SQLite format 3\0").expect("written");
    let (code, _, told) = from(&other, &[]);
    assert!(code == Some(65) && told.contains("standard input: is a stream; COLMAP's files"), "{told}");
}

#[test]
fn a_bad_configuration_ends_with_64_and_a_printed_one_reads_back() {
    let directory = directory();
    let file = directory.path().join("scpsfm.toml");
    fs::write(&file, "[engine]\nwrokers = 3\n").expect("written");
    let misspelt = run(["serve", "--config", text(&file)]);
    assert_eq!(misspelt.code, Some(64), "{misspelt:?}");
    assert!(misspelt.stderr.contains("wrokers"), "{misspelt:?}");
    let nowhere = run(["serve", "--listen", "localhost"]);
    assert_eq!(nowhere.code, Some(64), "{nowhere:?}");

    let printed = run(["serve", "--print-config", "--workers", "3", "--backend", "ndarray"]);
    assert_eq!(printed.code, Some(0), "{printed:?}");
    fs::write(&file, &printed.stdout).expect("written");
    assert_eq!(run(["serve", "--print-config", "--config", text(&file)]).stdout, printed.stdout);
    assert!(printed.stdout.contains("workers = 3") && printed.stdout.contains("ndarray"), "{printed:?}");

    // With a password: not shown, which the file says, and refused until it is there again.
    let url = ["--store", "postgres://me:hunter2@db.example/scpsfm"];
    let printed = run(["serve", "--print-config"].iter().chain(&url));
    assert!(printed.code == Some(0) && !printed.stdout.contains("hunter2"), "{printed:?}");
    assert!(printed.stdout.starts_with("# The password in store.url is not shown"), "{printed:?}");
    fs::write(&file, &printed.stdout).expect("written");
    let refused = run(["serve", "--print-config", "--config", text(&file)]);
    assert_eq!(refused.code, Some(64), "{refused:?}");
    assert!(refused.stderr.contains("store.url") && refused.stderr.contains("SCPSFM_STORE__URL"), "{refused:?}");
    let complete = run(["serve", "--print-config", "--config", text(&file)].iter().chain(&url));
    assert_eq!(complete.stdout, printed.stdout);
}

#[test]
fn a_password_in_a_servers_address_is_refused_and_not_repeated() {
    for server in ["http://me:hunter2@127.0.0.1:1", "me:hunter2@127.0.0.1:1", "https://me:hunter2@localhost"] {
        let refused = run(["list", "--server", server]);
        assert_eq!(refused.code, Some(2), "{refused:?}");
        let told = refused.stdout + &refused.stderr;
        assert!(told.contains("--api-key-file") && !told.contains("hunter2"), "{told}");
    }
    let output = program(["list", "--help"]).env("SCPSFM_SERVER", "http://me:hunter2@h").output().expect("runs");
    let help = String::from_utf8(output.stdout).expect("UTF-8");
    assert!(help.contains("SCPSFM_SERVER") && !help.contains("hunter2"), "{help}");
}

#[test]
fn without_a_server_commands_end_with_69() {
    let directory = directory();
    let input = scene(directory.path());
    let out = directory.path().join("out");
    let cases: [&[&str]; 4] = [
        &["list", "--server", NOBODY],
        &["get", "tenants/default/jobs/a", "--server", NOBODY],
        &["submit", text(&input), "--server", NOBODY],
        &["solve", text(&input), "--out", text(&out), "--server", NOBODY],
    ];
    for arguments in cases {
        let run = run(arguments);
        assert_eq!(run.code, Some(69), "{arguments:?}: {run:?}");
        assert!(run.stderr.contains("127.0.0.1:1"), "{run:?}");
    }
}

/// The files of a directory, times blanked; without the list of them, whose sums know the times.
fn files_but_for_times(directory: &Path) -> BTreeMap<String, String> {
    let entries = fs::read_dir(directory).expect("a directory");
    let timeless = |line: &&str| {
        !line.contains("seconds\":") && !line.contains("<dt>time</dt>") && !line.contains("proposal-times")
    };
    entries
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| !path.ends_with("scpsfm-files.json"))
        .map(|path| {
            let content = fs::read_to_string(&path).expect("text");
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            (name, content.lines().filter(timeless).collect::<Vec<_>>().join("\n"))
        })
        .collect()
}

#[test]
fn a_server_gives_the_same_files_as_the_program_itself_and_drains_on_sigterm() {
    let directory = directory();
    let path = |name: &str| directory.path().join(name);
    let input = scene(directory.path());
    let solve = |out: &Path, more: &[&str]| {
        let size = ["--width", "1000", "--height", "1000", "--json"];
        let run = run(["solve", text(&input), "--out", text(out)].iter().chain(&size).chain(more));
        assert_eq!(run.code, Some(0), "{run:?}");
        json(&run.stdout)
    };
    let local = solve(&path("local"), &[]);
    assert_eq!(local["status"], "SOLVED");
    assert_eq!(local["inlier_tracks"], 30);
    assert_eq!(json(&fs::read_to_string(path("local").join("result.json")).expect("result.json")), local);

    let mut serving = Serving::start(&path("data"));
    assert!(serving.page("/readyz").starts_with("ready"));
    solve(&path("remote"), &["--server", &serving.grpc]);
    let (local, remote) = (files_but_for_times(&path("local")), files_but_for_times(&path("remote")));
    assert_eq!(local.keys().collect::<Vec<_>>(), remote.keys().collect::<Vec<_>>());
    for (name, content) in &local {
        assert!(content == &remote[name], "{name} differs");
    }

    let listed = run(["list", "--server", &serving.grpc]);
    assert_eq!(listed.code, Some(0), "{listed:?}");
    assert!(listed.stdout.contains("SUCCEEDED"), "{listed:?}");
    let name = listed.stdout.split_whitespace().find(|word| word.starts_with("tenants/")).expect("a job's name");
    let result = run(["result", name, "--json", "--server", &serving.grpc]);
    assert_eq!(json(&result.stdout)["inlier_tracks"], 30);
    let quiet = run(["result", name, "-q", "--out", text(&path("quiet")), "--server", &serving.grpc]);
    assert_eq!((quiet.code, quiet.stdout.as_str(), quiet.stderr.as_str()), (Some(0), "", ""), "{quiet:?}");
    assert!(path("quiet").join("report.html").exists());
    a_result_goes_with_its_own_input_alone(name, &serving.grpc, &input);
    let deleted = run(["delete", name, "--server", &serving.grpc]);
    assert_eq!((deleted.code, deleted.stdout.trim()), (Some(0), name), "{deleted:?}");
    assert_eq!(run(["get", name, "--server", &serving.grpc]).code, Some(65), "it is gone");
    let unknown = run(["get", "tenants/default/jobs/unknown", "--server", &serving.grpc]);
    assert_eq!(unknown.code, Some(65), "{unknown:?}");

    // As `timeout` does it: the process and its group are told, so that it hears twice.
    serving.running.signal(Signal::TERM);
    serving.running.signal(Signal::TERM);
    assert_eq!(serving.running.wait().code(), Some(0));
}

/// Verdicts are listed by place: rows in another order, or images of another size, would be judged wrongly.
fn a_result_goes_with_its_own_input_alone(name: &str, server: &str, input: &Path) {
    let out = input.with_file_name("verdicts");
    let with = |file: &Path, width: &str| {
        let size = ["--width", width, "--height", "1000", "--out", text(&out)];
        run(["result", name, "--json", "--server", server, "--input", text(file)].iter().chain(&size))
    };
    let own = with(input, "1000");
    assert_eq!(own.code, Some(0), "{own:?}");
    let table = fs::read_to_string(input).expect("the input");
    let (head, rows) = table.split_once('\n').expect("a header");
    let reversed: Vec<&str> = rows.lines().rev().collect();
    let shuffled = input.with_file_name("reversed.csv");
    fs::write(&shuffled, format!("{head}\n{}\n", reversed.join("\n"))).expect("written");
    for refused in [with(&shuffled, "1000"), with(input, "500")] {
        assert!(refused.code == Some(65) && refused.stderr.contains("not the job's input"), "{refused:?}");
    }
    let known = ["--width", "1000", "--height", "1000", "--focal-px", "900", "--out", text(&out)];
    let known = run(["result", name, "--server", server, "--input", text(input)].iter().chain(&known));
    assert!(known.code == Some(65) && known.stderr.contains("--focal-px"), "{known:?}");
    let no_input = run(["result", name, "--json", "--server", server, "--width", "1000", "--height", "1000"]);
    assert!(no_input.code == Some(2) && no_input.stderr.contains("--width 1000"), "{no_input:?}");
}

#[test]
fn what_cannot_be_solved_ends_with_3_and_says_why() {
    let directory = directory();
    let (scene, out) = (directory.path().join("scene"), directory.path().join("out"));
    run(["synth", "--views", "4", "--tracks", "20", "--outliers", "1", "--out", text(&scene)]);
    let input = scene.join("observations.csv");
    let solved = run(["solve", text(&input), "--out", text(&out), "--json", "--method", "geometry"]);
    assert_eq!(solved.code, Some(3), "{solved:?}");
    let result = json(&solved.stdout);
    assert_eq!(result["status"], "NO_RECONSTRUCTION");
    assert_ne!(result["warnings"], Value::Array(Vec::new()));
    assert!(out.join("report.html").exists());

    // The same words from a server, on watch and on get, as soon as the job has ended.
    let serving = Serving::start(&directory.path().join("data"));
    let server = ["--server", serving.grpc.as_str()];
    let submitted = run(["submit", text(&input), "--method", "geometry", "--watch"].iter().chain(&server));
    assert_eq!(submitted.code, Some(3), "{submitted:?}");
    let name = submitted.stdout.trim();
    let got = run(["get", name].iter().chain(&server));
    let watched = run(["watch", name].iter().chain(&server));
    for warning in result["warnings"].as_array().expect("a list") {
        let (code, detail) = (warning["code"].as_str().expect("a code"), warning["detail"].as_str().expect("words"));
        let line = format!("  warning: {code}: {detail}\n");
        for told in [&submitted.stderr, &watched.stderr, &got.stdout] {
            assert!(told.contains(&line), "{line:?} is not in {told}");
        }
        assert!(got.stdout.contains("no reconstruction: ") && got.stdout.contains(code), "{got:?}");
    }
    for told in [&submitted.stderr, &watched.stderr] {
        assert!(
            told.contains(&format!("\nnext: scpsfm result {name} --server {} --out DIR\n", serving.grpc)),
            "{told}"
        );
        assert!(told.contains("\n      NO_RECONSTRUCTION by "), "{told}");
    }
    let all = json(&run(["get", name, "--json"].iter().chain(&server)).stdout);
    assert_eq!(all["summary"]["warnings"], result["warnings"]);
}

#[test]
fn ctrl_c_ends_a_solve_with_130_and_leaves_no_result() {
    let directory = directory();
    let (input, out) = (scene(directory.path()), directory.path().join("out"));
    // The paper's method runs all its iterations: some minutes, had it its way.
    let mut child = program(["solve", text(&input), "--out", text(&out), "--method", "paper", "--iterations", "10000"])
        .stdin(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
    let mut running = Running(child);
    let mut line = String::new();
    stderr.read_line(&mut line).expect("progress");
    assert!(line.contains('%'), "{line:?}");
    running.signal(Signal::INT);
    assert_eq!(running.wait().code(), Some(130));
    assert!(!out.join("result.json").exists());
}

#[test]
fn ctrl_c_ends_a_watch_with_130_and_tells_that_the_job_goes_on() {
    let directory = directory();
    let input = scene(directory.path());
    let serving = Serving::start(&directory.path().join("data"));
    let submit = ["submit", text(&input), "--method", "paper", "--iterations", "10000", "--watch"];
    let mut child = program(submit.iter().chain(&["--server", &serving.grpc]))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
    let mut running = Running(child);
    let mut told = String::new();
    while !told.contains('%') {
        assert!(stderr.read_line(&mut told).expect("progress") > 0, "{told:?}");
    }
    running.signal(Signal::INT);
    assert_eq!(running.wait().code(), Some(130));
    stderr.read_to_string(&mut told).expect("the rest");
    assert!(told.contains("the job goes on\n  scpsfm watch tenants/default/jobs/"), "{told}");
    let going_on = run(["list", "--state", "running", "--server", &serving.grpc]);
    assert_eq!(going_on.stdout.lines().count(), 1, "{going_on:?}");
}

#[test]
fn a_quiet_demo_prints_nothing() {
    let directory = directory();
    let out = directory.path().join("demo");
    let run = run(["demo", "-q", "--out", text(&out), "--outliers", "0.8", "--tracks", "100"]);
    assert_eq!((run.code, run.stdout.as_str(), run.stderr.as_str()), (Some(0), "", ""));
    assert!(out.join("report.html").exists());
}

#[test]
fn standard_input_that_is_named_twice_is_refused_by_its_argument() {
    let run = run(["submit", "-", "-", "--server", NOBODY]);
    assert_eq!(run.code, Some(2), "{run:?}");
    assert!(run.stderr.contains("INPUT: `-` is given twice"), "{run:?}");
}

#[test]
fn the_demo_finds_what_is_true() {
    let directory = directory();
    let out = directory.path().join("demo");
    let run = run(["demo", "--out", text(&out), "--outliers", "0.8", "--tracks", "100", "--json"]);
    assert_eq!(run.code, Some(0), "{run:?}");
    let figures = json(&run.stdout);
    assert!(figures["f1"].as_f64().is_some_and(|f1| f1 >= 0.95), "{figures}");
    assert_eq!(figures["result"]["status"], "SOLVED");
    // Stages are told of jobs that take longer than this one does on a fast machine.
    for state in ["QUEUED", "RUNNING", "SUCCEEDED", "METRIC"] {
        assert!(run.stderr.contains(state), "{state} is not among {}", run.stderr);
    }
    for file in ["result.json", "report.html", "scene/observations.csv", "scene/truth.json"] {
        assert!(out.join(file).exists(), "no {file}");
    }
}

#[test]
fn flags_that_only_a_server_can_refuse_are_wrong_usage() {
    let directory = directory();
    let (input, bad) = (scene(directory.path()), directory.path().join("bad.csv"));
    let input = text(&input);
    let serving = Serving::start(&directory.path().join("data"));
    let long_key = format!("{}=x", "k".repeat(64));
    let cases: [(&[&str], &str); 7] = [
        (&["submit", input, "--label", &long_key], "job.labels"),
        (&["submit", input, "--job-id", "A"], "job_id"),
        (&["submit", input, "--request-id", "a b"], "request_id"),
        (&["submit", input, "--time-limit", "1e15"], "job.time_limit"),
        (&["list", "--filter", "colour = red"], "filter"),
        (&["list", "--page-token", "made-up"], "page_token"),
        (&["list", "--server", "localhost:1"], "http://HOST:PORT"),
    ];
    for (arguments, names) in cases {
        // A later --server is none: clap takes one.
        let server: &[&str] = if arguments.contains(&"--server") { &[] } else { &["--server", &serving.grpc] };
        let run = run(arguments.iter().chain(server));
        assert_eq!(run.code, Some(2), "{arguments:?}: {run:?}");
        assert!(run.stdout.is_empty() && run.stderr.contains(names), "{run:?}");
        assert!(!run.stderr.contains(".csv"), "the file is not to blame: {run:?}");
    }
    // What the file is to blame for stays bad input, told by its lines, though only the server looks for it.
    let twice = "view,track,x,y\n0,0,1,1\n1,0,1,1\n0,0,2,2\n1,1,3,3\n";
    fs::write(&bad, twice).expect("written");
    let run = run(["submit", text(&bad), "--server", &serving.grpc]);
    assert_eq!(run.code, Some(65), "{run:?}");
    assert!(run.stderr.contains("bad.csv"), "{run:?}");
}

#[test]
fn a_watch_after_the_last_event_says_so_and_ends_as_the_job_did() {
    let directory = directory();
    let (good, hopeless) = (scene(directory.path()), directory.path().join("hopeless"));
    run(["synth", "--views", "4", "--tracks", "20", "--outliers", "1", "--out", text(&hopeless)]);
    let serving = Serving::start(&directory.path().join("data"));
    let server = ["--server", serving.grpc.as_str()];
    for (input, code) in [(good, 0), (hopeless.join("observations.csv"), 3)] {
        let submitted = run(["submit", text(&input), "--method", "geometry"].iter().chain(&server));
        assert_eq!(submitted.code, Some(0), "{submitted:?}");
        let name = submitted.stdout.trim();
        assert_eq!(run(["watch", name].iter().chain(&server)).code, Some(code));
        let job = json(&run(["get", name, "--json"].iter().chain(&server)).stdout);
        let last = job["last_sequence"].as_u64().expect("a number");
        let after = |after: u64| run(["watch", name, "--after", &after.to_string(), "--json"].iter().chain(&server));
        let nothing = after(last);
        assert_eq!((nothing.code, nothing.stdout.as_str()), (Some(code), ""), "{nothing:?}");
        let words = format!("nothing comes after event {last}: {name} is SUCCEEDED\n");
        assert_eq!(nothing.stderr, words);
        // The final state alone, after the event that tells the result.
        let end = after(last - 1);
        assert_eq!((end.code, end.stdout.lines().count(), end.stderr.as_str()), (Some(code), 1, ""), "{end:?}");
        assert_eq!(after(last + 1).code, Some(2));
    }
}

#[test]
fn submit_says_that_it_waits_for_a_server_that_drains_and_why() {
    let directory = directory();
    let input = scene(directory.path());
    // Longer than the test takes: the long job ends with the server, killed at the end.
    let drain = [("SCPSFM_ENGINE__DRAIN_SECONDS", "600")];
    let serving = Serving::start_with(&directory.path().join("data"), &drain, Stdio::null());
    let submit = |more: &[&str]| {
        let submit = ["submit", text(&input), "--server", &serving.grpc];
        let mut command = program(submit.iter().chain(more));
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the program starts");
        let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
        let running = Running(child);
        let mut line = String::new();
        stderr.read_line(&mut line).expect("a line or the end");
        drop(running);
        line
    };
    assert_eq!(submit(&["--method", "paper", "--iterations", "10000"]), "");
    let running = || run(["list", "--state", "running", "--json", "--server", &serving.grpc]);
    let begin = Instant::now();
    while running().stdout.is_empty() {
        assert!(begin.elapsed() < PATIENCE, "the job does not run");
    }
    serving.running.signal(Signal::TERM);
    // The signal takes a moment to arrive; until then jobs are taken in silence.
    let told = loop {
        let line = submit(&[]);
        if !line.is_empty() {
            break line;
        }
        assert!(begin.elapsed() < PATIENCE, "the server does not drain");
    };
    assert_eq!(
        told,
        format!("waiting up to 30 s: {}: the server is draining; try another or come back\n", serving.grpc)
    );
}

#[test]
fn a_table_of_views_is_not_replaced_by_the_result() {
    let directory = directory();
    let path = |name: &str| directory.path().join(name).to_str().expect("a path of ours").to_owned();
    let made = run(["synth", "--views", "4", "--tracks", "30", "--out", &path("scene")]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let table = path("out/tracks.csv");
    fs::create_dir(path("out")).expect("created");
    fs::copy(path("scene/views.csv"), &table).expect("copied");
    let refused = run(["solve", &path("scene/observations.csv"), "--view-table", &table, "--out", &path("out")]);
    assert_eq!(refused.code, Some(2), "{refused:?}");
    assert!(refused.stderr.contains("would replace its own input") && refused.stderr.contains(&table), "{refused:?}");
    assert_eq!(fs::read(table).expect("kept"), fs::read(path("scene/views.csv")).expect("a table"));
}
