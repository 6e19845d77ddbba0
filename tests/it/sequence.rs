//! A sequence, here and through a server: from the generator to the files that a caller reads.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::support::program::{Serving, run};

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).expect("a file")).expect("JSON")
}

#[test]
fn a_walk_is_registered_whole_and_a_server_gives_the_same_answer() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let walk = path("walk");
    let scene = ["--sequence", "--views", "14", "--tracks", "500", "--noise", "0.0005", "--outliers", "0.3"];
    let made = run(["synth", "--out", text(&walk)].iter().chain(&scene));
    assert_eq!(made.code, Some(0), "{made:?}");
    let input = walk.join("observations.csv");
    let size = ["--width", "1000", "--height", "1000", "--method", "geometry"];
    let here = run(["solve", text(&input), "--out", text(&path("here"))].iter().chain(&size));
    assert_eq!(here.code, Some(0), "{here:?}");

    let (result, truth) = (json(&path("here").join("result.json")), json(&walk.join("truth.json")));
    assert_eq!((&result["grade"], &result["registered_views"]), (&"METRIC".into(), &14.into()), "{result}");
    let focal = |value: &Value| value["focal_px"].as_f64().expect("a number");
    let error = focal(&result) / focal(&truth) - 1.0;
    assert!(error.abs() < 0.01, "focal length off by {error}");
    let cameras = json(&path("here").join("cameras.json"));
    let views = cameras["views"].as_array().expect("views");
    assert!(views.iter().all(|view| view["registered"] == true && view["part"] == 0), "{cameras}");

    let server = Serving::start(&path("data"));
    let there =
        run(["solve", text(&input), "--out", text(&path("there")), "--server", &server.grpc].iter().chain(&size));
    assert_eq!(there.code, Some(0), "{there:?}");
    for file in ["tracks.csv", "observations.csv", "cameras.json", "points.ply"] {
        let read = |from: &str| fs::read(path(from).join(file)).expect("a result file");
        assert!(read("here") == read("there"), "{file} differs");
    }
}

/// A client that watches sees how many views there are and how many stand, up to what the result says.
#[test]
fn whoever_watches_sees_the_views_rise() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let walk = directory.path().join("walk");
    let scene = ["--sequence", "--views", "60", "--tracks", "1500", "--noise", "0.0005", "--outliers", "0.3"];
    let made = run(["synth", "--out", text(&walk)].iter().chain(&scene));
    assert_eq!(made.code, Some(0), "{made:?}");
    let server = Serving::start(&directory.path().join("data"));
    let input = walk.join("observations.csv");
    let size = ["--width", "1000", "--height", "1000", "--method", "geometry"];
    let submit = ["submit", text(&input), "--server", &server.grpc, "--job-id", "walk"];
    let submitted = run(submit.iter().chain(&size));
    assert_eq!(submitted.code, Some(0), "{submitted:?}");
    let watched = run(["watch", "walk", "--server", &server.grpc, "--json"]);
    assert_eq!(watched.code, Some(0), "{watched:?}");

    let events: Vec<Value> = watched.stdout.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    let progress: Vec<&Value> = events.iter().map(|event| &event["progress"]).filter(|told| told.is_object()).collect();
    let course =
        |told: &Value, key: &str| told["reconstruction"][key].as_u64().unwrap_or_else(|| panic!("{key} in {told}"));
    // What a block had that was given up for the next counts no more.
    for pair in progress.windows(2).filter(|pair| course(pair[0], "block") == course(pair[1], "block")) {
        let registered = [0, 1].map(|k| course(pair[k], "registered_views"));
        assert!(registered[0] <= registered[1], "{} {}", pair[0], pair[1]);
    }
    let last = progress.last().expect("progress at the end at least");
    assert!(progress.iter().all(|told| course(told, "views") == 60), "{progress:?}");
    let summary = events.iter().map(|event| &event["summary"]).find(|told| told.is_object()).expect("a summary");
    assert_eq!(Some(course(last, "registered_views")), summary["registered_views"].as_u64(), "{last} {summary}");
    assert!(course(last, "registered_views") > 50, "{last}");
}

#[test]
fn threads_change_nothing_in_any_file_but_times() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let walk = path("walk");
    let scene = ["--sequence", "--views", "20", "--tracks", "1000", "--noise", "0.0005", "--outliers", "0.3"];
    let made = run(["synth", "--out", text(&walk)].iter().chain(&scene));
    assert_eq!(made.code, Some(0), "{made:?}");
    let input = walk.join("observations.csv");
    let on = |threads: &str| {
        let out = path(threads);
        let size = ["--width", "1000", "--height", "1000", "--method", "geometry", "-q"];
        let done = run(["solve", text(&input), "--out", text(&out), "--threads", threads].iter().chain(&size));
        assert_eq!(done.code, Some(0), "{done:?}");
        let mut result = json(&out.join("result.json"));
        for timed in ["seconds", "stages", "proposal_times"] {
            assert!(result[timed].take() != Value::Null, "{timed}");
        }
        let files = ["tracks.csv", "observations.csv", "cameras.json", "points.ply"];
        (result, files.map(|file| fs::read(out.join(file)).expect("a result file")))
    };
    let alone = on("1");
    assert!(alone.0["registered_views"].as_u64() > Some(15), "{}", alone.0);
    for threads in ["2", "3"] {
        assert!(on(threads) == alone, "{threads} threads");
    }
}

#[test]
fn windows_are_solved_alone_and_alike_on_any_number_of_threads() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let walk = path("walk");
    let scene = ["--sequence", "--views", "8", "--tracks", "400", "--noise", "0.0005", "--outliers", "0.3"];
    let made = run(["synth", "--out", text(&walk)].iter().chain(&scene));
    // Fewer views than a track may live by default.
    assert_eq!(made.code, Some(0), "{made:?}");
    assert!(made.stderr.contains("400 tracks of 3 to 8 views"), "{made:?}");
    let input = walk.join("observations.csv");
    let windows = |threads: &str| {
        let out = path(threads);
        let flags = ["--width", "1000", "--height", "1000", "--method", "geometry", "--window", "5", "--step", "2"];
        let solve = ["solve", text(&input), "--out", text(&out), "--threads", threads];
        let done = run(solve.iter().chain(&flags));
        assert_eq!(done.code, Some(0), "{done:?}");
        (done, json(&out.join("windows.json")), fs::read_to_string(out.join("windows.csv")).expect("windows.csv"))
    };
    let (one, mut of_one, csv) = windows("1");
    let (_, mut of_three, _) = windows("3");
    for table in [&mut of_one, &mut of_three] {
        table["seconds"] = Value::Null;
        table["windows"].as_array_mut().expect("rows").iter_mut().for_each(|row| row["seconds"] = Value::Null);
    }
    assert_eq!(of_one, of_three);
    let rows = of_one["windows"].as_array().expect("rows");
    let views: Vec<_> = rows.iter().map(|row| (row["first_view"].as_u64(), row["last_view"].as_u64())).collect();
    assert_eq!(views, [(Some(0), Some(4)), (Some(2), Some(6))]);
    assert_eq!((&of_one["views_left"], of_one["solved"].as_u64()), (&1.into(), Some(2)), "{of_one}");
    assert!(csv.lines().next().is_some_and(|header| header.ends_with(",reason,warnings")), "{csv}");
    for row in rows {
        assert!(row["warnings"].is_array(), "{row}");
        assert!(row["reprojection_mean_px"].as_f64().is_some_and(|px| (0.1..1.0).contains(&px)), "{row}");
        assert!(
            row["inlier_tracks"].as_u64() > Some(50) && row["tracks"].as_u64() > row["inlier_tracks"].as_u64(),
            "{row}"
        );
    }
    assert_eq!(csv.lines().count(), 3);
    assert!(one.stderr.contains("window 2 of 2: views 2 to 6\n"), "{one:?}");
    assert!(one.stdout.contains("median") && one.stdout.contains("in no window: 1"), "{one:?}");
    let none = path("none");
    let too_long = ["solve", text(&input), "--out", text(&none), "--window", "9"];
    assert_eq!(run(too_long).code, Some(2));
    assert_eq!(run(too_long.iter().chain(&["--server", "http://127.0.0.1:1"])).code, Some(2));
}

#[test]
fn a_sequence_of_impossible_measures_is_wrong_usage() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let out = directory.path().join("walk");
    for (wrong, named) in [
        (["--sequence", "--views", "4", "--lifetime", "3,5"].as_slice(), "lifetime"),
        (&["--sequence", "--motion", "orbit"], "--motion"),
        (&["--sequence", "--lifetime", "3"], "--lifetime"),
    ] {
        let refused = run(["synth", "--out", text(&out)].iter().chain(wrong));
        assert_eq!(refused.code, Some(2), "{wrong:?}: {refused:?}");
        assert!(refused.stderr.contains(named), "{wrong:?}: {refused:?}");
    }
}
