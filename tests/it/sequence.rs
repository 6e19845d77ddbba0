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

#[test]
fn a_sequence_of_impossible_measures_is_wrong_usage() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let out = directory.path().join("walk");
    for (wrong, named) in [
        (["--sequence", "--views", "4"].as_slice(), "lifetime"),
        (&["--sequence", "--motion", "orbit"], "--motion"),
        (&["--sequence", "--lifetime", "3"], "--lifetime"),
    ] {
        let refused = run(["synth", "--out", text(&out)].iter().chain(wrong));
        assert_eq!(refused.code, Some(2), "{wrong:?}: {refused:?}");
        assert!(refused.stderr.contains(named), "{wrong:?}: {refused:?}");
    }
}
