//! The trained network from the shell: training, its files, asking another one.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::Stdio;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Run, Running, program, run};

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

fn train(out: &Path, seed: &str) -> Run {
    run(["train-prior", "--out", text(out), "--seed", seed, "--steps", "2"])
}

#[test]
fn a_seed_gives_one_network_that_a_solve_asks() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = |name: &str| directory.path().join(name);
    for (name, seed) in [("new/a.prior", "3"), ("b.prior", "3"), ("c.prior", "4")] {
        let run = train(&at(name), seed);
        assert_eq!(run.code, Some(0), "{run:?}");
        assert!(run.stderr.contains("step 2, ") && run.stderr.contains("sha256"), "{run:?}");
    }
    let bytes = |name: &str| fs::read(at(name)).expect(name);
    assert_eq!(bytes("new/a.prior"), bytes("b.prior"), "one seed, one file");
    assert_ne!(bytes("b.prior"), bytes("c.prior"));
    assert!(fs::read_to_string(at("b.prior.svg")).expect("curves").starts_with("<svg xmlns="));
    assert!(!at("b.prior.state").exists(), "a training that ended has nothing to go on from");

    let scene = at("scene");
    let made =
        run(["synth", "--views", "6", "--tracks", "60", "--outliers", "0.5", "--seed", "5", "--out", text(&scene)]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let input = scene.join("observations.csv");
    let solve = |prior: &Path, out: &str| {
        let out = at(out);
        let files = ["--out", text(&out), "--prior", text(prior), "--json", "--quiet"];
        run(["solve", text(&input), "--width", "1000", "--height", "1000"].into_iter().chain(files))
    };
    let solved = solve(&at("b.prior"), "answer");
    assert_eq!(solved.code, Some(0), "{solved:?}");
    let result: Value = serde_json::from_str(&solved.stdout).expect("JSON");
    assert_eq!(result["status"], "SOLVED", "two steps teach nothing, and a search does not need it");

    let mut damaged = bytes("b.prior");
    *damaged.last_mut().expect("numbers") ^= 1;
    fs::write(at("damaged.prior"), damaged).expect("a file");
    let refused = solve(&at("damaged.prior"), "refused");
    assert_eq!(refused.code, Some(65), "{refused:?}");
    assert!(refused.stderr.contains("damaged.prior") && refused.stderr.contains("checksum"), "{refused:?}");
    let missing = solve(&at("none.prior"), "missing");
    assert!(missing.code == Some(65) && missing.stderr.contains("none.prior"), "{missing:?}");
}

#[test]
fn a_network_that_asks_pairs_is_trained_and_asked() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = |name: &str| directory.path().join(name);
    let (file, scene, answer) = (at("pairs.prior"), at("scene"), at("answer"));
    let trained = run(["train-prior", "--pairs", "--out", text(&file), "--seed", "3", "--steps", "2", "--quiet"]);
    assert_eq!(trained.code, Some(0), "{trained:?}");
    let bytes = fs::read(&file).expect("a network");
    let header = String::from_utf8_lossy(&bytes[..bytes.len().min(400)]).into_owned();
    assert!(header.contains("--seed 3 --steps 2 --pairs --out FILE") && header.contains("\"strides\":2"), "{header}");

    let made =
        run(["synth", "--views", "6", "--tracks", "60", "--outliers", "0.5", "--seed", "5", "--out", text(&scene)]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let input = scene.join("observations.csv");
    let asked = ["--prior", text(&file), "--out", text(&answer), "--json", "--quiet"];
    let solved = run(["solve", text(&input), "--width", "1000", "--height", "1000"].into_iter().chain(asked));
    assert_eq!(solved.code, Some(0), "{solved:?}");
    let result: Value = serde_json::from_str(&solved.stdout).expect("JSON");
    assert_eq!(result["status"], "SOLVED", "{result}");
    let checksum = result["trained_network_sha256"].as_str().expect("the network that was asked");
    assert!(trained.stderr.contains(checksum) || header.contains(checksum), "{checksum}: {header}");
}

#[test]
fn the_state_of_another_training_is_refused() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let out = directory.path().join("a.prior");
    fs::write(directory.path().join("a.prior.state"), b"not a state").expect("a file");
    let refused = train(&out, "1");
    assert_eq!(refused.code, Some(65), "{refused:?}");
    assert!(refused.stderr.contains("a.prior.state") && refused.stderr.contains("remove it"), "{refused:?}");
    let nowhere = train(directory.path(), "1");
    assert!(nowhere.code == Some(2) && nowhere.stderr.contains("--out"), "{nowhere:?}");
}

#[test]
fn priors_are_compared_in_a_table_and_a_file() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let out = text(directory.path());
    let run_of = |scenes: &'static str| {
        run(["evaluate", "--priors", "--scenes", scenes, "--seeds", "1", "--auto-only", "--quiet", "--out", out])
    };
    let compared = run_of("outliers .9");
    assert_eq!(compared.code, Some(0), "{compared:?}");
    assert!(compared.stdout.contains("with learned") && compared.stdout.contains("outliers .9 "), "{compared:?}");
    let written = fs::read_to_string(directory.path().join("priors.json")).expect("priors.json");
    let written: Value = serde_json::from_str(&written).expect("JSON");
    let rows = written["rows"]["auto"].as_array().expect("rows");
    let counts = (&written["complete"], &written["runs_done"], &written["runs_planned"]);
    assert_eq!(counts, (&true.into(), &1.into(), &1.into()), "{written}");
    assert!(!compared.stdout.contains("Incomplete"), "{compared:?}");
    assert!(rows.len() == 2 && rows.iter().all(|row| row["seeds"] == 1), "{written}");
    let lines = || fs::read_to_string(directory.path().join("priors.jsonl")).expect("records").lines().count();
    assert_eq!(lines(), 2, "a header and a scene");
    assert_eq!(run_of("outliers .9").stdout, compared.stdout, "what is recorded is not done again, times included");
    assert_eq!(lines(), 2);
    let unknown = run_of("no such scenes");
    assert!(unknown.code == Some(2) && unknown.stderr.contains("outliers .9"), "{unknown:?}");
}

/// Several scenes make a list, each run has a line where stderr is no terminal, what was asked for as JSON is JSON, and
/// either says that runs are missing.
#[test]
fn an_interrupted_comparison_says_what_it_has() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let scenes = ["--scenes", "outliers .9,any roll, .97", "--seeds", "1000"];
    let how = ["--threads", "1", "--out", text(directory.path())];
    let interrupted = |more: &[&str]| {
        let mut command =
            program(["evaluate", "--priors", "--auto-only"].iter().chain(&scenes).chain(&how).chain(more));
        let mut running = Running(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started"));
        let mut lines = BufReader::new(running.0.stderr.take().expect("stderr")).lines();
        let first = lines.next().expect("a line").expect("text");
        running.signal(Signal::INT);
        let mut stdout = String::new();
        running.0.stdout.take().expect("stdout").read_to_string(&mut stdout).expect("text");
        assert_eq!(running.wait().code(), Some(130), "{stdout}");
        (first, stdout)
    };
    let (first, stdout) = interrupted(&["--json"]);
    assert!(first.starts_with("1/2000 runs, "), "{first}");
    let printed: Value = serde_json::from_str(&stdout).expect("JSON");
    let rows = printed["rows"]["auto"].as_array().expect("rows");
    assert!(rows.iter().any(|row| row["condition"] == "outliers .9"), "{printed}");
    assert_eq!(printed["complete"], false, "{printed}");
    let done = printed["runs_done"].as_u64().expect("a count");
    assert!((1..2000).contains(&done) && printed["runs_planned"] == 2000, "{printed}");
    let written = fs::read_to_string(directory.path().join("priors.json")).expect("priors.json");
    assert_eq!(written.trim_end(), stdout.trim_end());
    let (_, table) = interrupted(&[]);
    assert!(table.contains("Incomplete: ") && table.contains(" of 2000 runs are done."), "{table}");
}
