//! The program from the shell, against a server.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::Stdio;
use std::time::Instant;

use rustix::process::Signal;

use crate::cli::{directory, json, scene, text};
use crate::support::program::{Running, Serving, program, run};
use crate::support::server::PATIENCE;

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
    let told = run(["result", name, "--out", text(&path("told")), "--server", &serving.grpc]);
    assert!(told.stdout.contains("not counted  30 tracks, rejected or unclassified: "), "{told:?}");
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
fn flags_that_only_a_server_can_refuse_are_wrong_usage() {
    let directory = directory();
    let (input, bad) = (scene(directory.path()), directory.path().join("bad.csv"));
    let input = text(&input);
    let serving = Serving::start(&directory.path().join("data"));
    let long_key = format!("{}=x", "k".repeat(64));
    let cases: [(&[&str], &str); 8] = [
        (&["submit", input, "--label", &long_key], "error: --label: "),
        (&["submit", input, "--job-id", "A"], "error: --job-id: "),
        (&["submit", input, "--request-id", "a b"], "error: --request-id: "),
        (&["submit", input, "--time-limit", "1e15"], "error: --time-limit: "),
        (&["list", "--filter", "colour = red"], "error: --filter: "),
        (&["list", "--page-token", "made-up"], "error: --page-token: "),
        (&["list", "--server", "localhost:1"], "--server \"localhost:1\" has no scheme: put http:// in front"),
        (&["list", "--server", "ftp://localhost:1"], "http://HOST:PORT"),
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
