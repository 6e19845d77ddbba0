//! The program from the shell: exit codes, sentences, files. What it says to a server is in `cli_server`.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;

use rustix::process::Signal;
use serde_json::Value;
use tempfile::TempDir;

use crate::support::program::{Running, Serving, program, run};

/// An address where nothing listens: port 1 is reserved and privileged.
const NOBODY: &str = "http://127.0.0.1:1";

pub fn directory() -> TempDir {
    tempfile::tempdir().expect("a temporary directory")
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

pub fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// A scene that is quickly solved.
pub fn scene(directory: &Path) -> PathBuf {
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
fn wrong_usage_is_told_by_its_flag() {
    let directory = directory();
    let input = scene(directory.path());
    let (input, out) = (text(&input), directory.path().join("out"));
    let solve: [(&[&str], &str); 14] = [
        (&["--noise-px", "-1"], "--noise-px: -1 is not a positive finite number"),
        (&["--alpha", "nan"], "--alpha: NaN is not"),
        (&["--network-width", "100"], "--network-width: 100 is above"),
        (&["--epipolar-depths"], "--epipolar-depths is of use with --method paper, scpsfm, psfm only"),
        (&["--kappa", "2"], "--kappa is of use with --method paper only"),
        (&["--method", "geometry", "--alpha", "1"], "--alpha is of use with --method auto, paper, scpsfm only"),
        (&["--method", "geometry", "--network-width", "0.5"], "--network-width is of use with"),
        (&["--method", "psfm", "--iterations", "9"], "--iterations is of use with"),
        (&["--method", "psfm", "--no-daq"], "--no-daq is of use with"),
        (&["--focal-px", "900", "--focal-per-view"], "'--focal-px <PX>' cannot be used with '--focal-per-view'"),
        (&["--width", "99999999", "--height", "99999999"], "'--width <PX>': no image has more than 1000000 px"),
        (&["--seed", "-1"], "is not a whole number >= 0"),
        (&["--window", "3", "--export", "colmap"], "--export"),
        (&["--threads", "0"], "--threads"),
    ];
    for (flags, words) in solve {
        let refused = run(["solve", input, "--out", text(&out)].iter().chain(flags));
        assert_eq!(refused.code, Some(2), "{flags:?}: {refused:?}");
        assert!(refused.stderr.contains(words), "{words:?} is not in {refused:?}");
    }
    let others: [(&[&str], &str); 7] = [
        (&["synth", "--out", text(&out), "--focal-px", "5"], "--focal-px: 5.0 px is not within 100..=100000 px"),
        (&["synth", "--out", text(&out), "--wrong-views", "11"], "--wrong-views: "),
        (&["synth", "--out", text(&out), "--views", "-1"], "is not a whole number >= 0"),
        (&["synth", "--out", text(&out), "--sequence", "--ramp"], "--zoom"),
        (&["watch", "a", "--after", "-1"], "is not a whole number >= 0"),
        (&["evaluate", "--photographed", "--out", text(&out), "--first-seed", "-1"], "is not a whole number >= 0"),
        (&["evaluate", "--out", text(&out), "--seeds", "0"], "is not in 1..=10000"),
    ];
    for (arguments, words) in others {
        let refused = run(arguments);
        assert_eq!(refused.code, Some(2), "{arguments:?}: {refused:?}");
        assert!(refused.stderr.contains(words), "{words:?} is not in {refused:?}");
    }
    assert!(!out.exists());
}

#[test]
fn wrong_focal_lengths_and_coordinates_are_what_is_advised_first() {
    let directory = directory();
    let out = directory.path().join("out");
    let size = ["--width", "1000", "--height", "1000"];
    let solved = |input: &Path, more: &[&str]| {
        let solved = run(["solve", text(input), "--out", text(&out)].iter().chain(&size).chain(more));
        assert_eq!(solved.code, Some(0), "{solved:?}");
        solved
    };
    let walk = directory.path().join("walk");
    let made = ["synth", "--sequence", "--views", "8", "--tracks", "120", "--outliers", "0.2", "--out", text(&walk)];
    assert_eq!(run(made).code, Some(0));
    let input = walk.join("observations.csv");
    let good = solved(&input, &[]);
    assert!(!good.stderr.contains("millimetres") && !good.stdout.contains("POINTS_OUTSIDE_IMAGE"), "{good:?}");
    let millimetres = solved(&input, &["--focal-px", "28", "--focal-sigma", "10"]);
    assert!(millimetres.stderr.contains("is it in millimetres?"), "{millimetres:?}");
    assert!(millimetres.stderr.contains("of sigma 10 says next to nothing"), "{millimetres:?}");
    let contradicted = solved(&input, &["--focal-px", "28"]);
    assert!(
        contradicted.stdout.contains(" because of FOCAL_PRIOR_CONTRADICTED: check the focal length that was"),
        "{contradicted:?}"
    );

    let table = fs::read_to_string(&input).expect("the scene");
    let centred = table.lines().map(|line| {
        let numbers: Vec<f64> = line.split(',').filter_map(|number| number.parse().ok()).collect();
        let &[view, track, x, y] = numbers.as_slice() else { return line.to_owned() };
        format!("{view},{track},{},{}", x - 499.5, 499.5 - y)
    });
    let moved = walk.join("centred.csv");
    fs::write(&moved, centred.collect::<Vec<_>>().join("\n")).expect("written");
    let told = solved(&moved, &[]).stdout;
    assert!(told.contains("POINTS_OUTSIDE_IMAGE: ") && told.contains("measured from the image centre?"), "{told}");
}

#[test]
fn a_camera_that_only_turned_is_no_scene_for_other_programs() {
    let directory = directory();
    let (turn, out) = (directory.path().join("turn"), directory.path().join("out"));
    let made = ["synth", "--motion", "pure-rotation", "--outliers", "0.2", "--tracks", "100", "--out", text(&turn)];
    assert_eq!(run(made).code, Some(0));
    let input = turn.join("observations.csv");
    let size = ["--width", "1000", "--height", "1000", "--export", "colmap,bal", "--out", text(&out)];
    let solved = run(["solve", text(&input)].iter().chain(&size));
    assert!(solved.stdout.contains("METRIC") && solved.stdout.contains("PURE_ROTATION"), "{solved:?}");
    assert!(solved.stderr.contains("warning: colmap, bal: the camera only turned"), "{solved:?}");
    assert!(solved.stdout.contains("no depth") && !solved.stdout.contains("image_undistorter"), "{solved:?}");
}

#[test]
fn fewer_than_three_views_are_told_one_minimum() {
    let directory = directory();
    let (two, out) = (directory.path().join("two"), directory.path().join("out"));
    let made = ["synth", "--views", "2", "--tracks", "40", "--outliers", "0", "--out", text(&two)];
    assert_eq!(run(made).code, Some(0));
    let input = two.join("observations.csv");
    let solve = |input: &Path| run(["solve", text(input), "--out", text(&out)]);
    let of_two = solve(&input);
    assert_eq!(of_two.code, Some(3), "{of_two:?}");
    assert!(of_two.stdout.contains("NO_RECONSTRUCTION: add views; a reconstruction needs at least 3"), "{of_two:?}");
    let table = fs::read_to_string(&input).expect("the scene");
    let of_one = |line: &&str| !line.starts_with("1,");
    let one = two.join("one.csv");
    fs::write(&one, table.lines().filter(of_one).collect::<Vec<_>>().join("\n")).expect("written");
    let of_one = solve(&one);
    assert_eq!(of_one.code, Some(65), "{of_one:?}");
    assert!(of_one.stderr.contains("1 view given; a reconstruction needs at least 3"), "{of_one:?}");

    // What a solve wrote is no input.
    let answer = solve(&out.join("observations.csv"));
    assert!(answer.code == Some(65) && answer.stderr.contains("an answer and no input"), "{answer:?}");
    let answer = solve(&out);
    assert!(answer.code == Some(65) && answer.stderr.contains("is the directory of an answer"), "{answer:?}");
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
        assert!(told.contains("\n      NO_RECONSTRUCTION because of "), "{told}");
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
    let counts = ["inlier_tracks", "two_view_tracks", "unclassified_tracks", "rejected_tracks"];
    let counts = counts.map(|name| figures["result"][name].as_u64().expect(name));
    assert_eq!(counts.iter().sum::<u64>(), 100, "{figures}");
    // Stages are told of jobs that take longer than this one does on a fast machine.
    for state in ["QUEUED", "RUNNING", "SUCCEEDED", "METRIC"] {
        assert!(run.stderr.contains(state), "{state} is not among {}", run.stderr);
    }
    for file in ["result.json", "report.html", "scene/observations.csv", "scene/truth.json"] {
        assert!(out.join(file).exists(), "no {file}");
    }
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
