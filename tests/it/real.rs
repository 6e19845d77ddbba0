//! `evaluate --real`: this program beside another one, as a user runs it.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use crate::support::program::run;

/// A sequence folder of the generator's making.
fn folder(directory: &Path) -> PathBuf {
    let folder = directory.join("walk");
    let out = folder.to_str().expect("UTF-8");
    let made = run([
        "synth",
        "--sequence",
        "--views",
        "6",
        "--tracks",
        "150",
        "--lifetime",
        "4,6",
        "--outliers",
        "0.2",
        "--noise",
        "0.0003",
        "--out",
        out,
    ]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let text = fs::read_to_string(folder.join("truth.json")).expect("the truth");
    let truth: Value = serde_json::from_str(&text).expect("JSON");
    let (focal, point) = (&truth["focal_px"], &truth["principal_point_px"]);
    let meta = json!({"width": 1000, "height": 1000, "K": [[focal, 0, point[0]], [0, focal, point[1]], [0, 0, 1]]});
    fs::write(folder.join("meta.json"), meta.to_string()).expect("written");
    let observations = fs::read_to_string(folder.join("observations.csv")).expect("observations");
    let right = truth["observation_right"].as_array().expect("a list");
    let labels = observations.lines().skip(1).zip(right).map(|(line, right)| {
        let ids: Vec<&str> = line.split(',').take(2).collect();
        format!("{},{right}\n", ids.join(","))
    });
    let labels: String = std::iter::once("view,track,inlier\n".to_owned()).chain(labels).collect();
    fs::write(folder.join("labels.csv"), labels).expect("written");
    folder
}

#[test]
fn both_sides_are_run_measured_and_written() {
    let directory = tempfile::tempdir().expect("a directory");
    let folder = folder(directory.path());
    let peer = directory.path().join("peer.sh");
    fs::write(&peer, "echo 'out of luck' >&2; exit 4").expect("written");
    let out = directory.path().join("out");
    let text = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    // The folder above holds the sequence.
    let (above, out_text, words) = (text(directory.path()), text(&out), format!("sh {}", text(&peer)));
    let shared = ["evaluate", "--real", &above, "--peer", &words, "--out", &out_text, "--quiet"];
    let done = run(shared.into_iter().chain(["--json"]));
    assert_eq!(done.code, Some(0), "{done:?}");
    let said: Value = serde_json::from_str(&done.stdout).expect("JSON");
    assert_eq!((&said["complete"], &said["runs_done"], &said["runs_planned"]), (&json!(true), &json!(2), &json!(2)));
    let (ours, peer) = (&said["rows"][0], &said["rows"][1]);
    assert_eq!((&ours["side"], &ours["failure"]), (&json!("scpsfm"), &Value::Null), "{said}");
    assert_eq!(ours["scores"]["registered"], 6, "{said}");
    assert!(ours["scores"]["f1"].as_f64() > Some(0.95), "{said}");
    assert!(ours["scores"]["focal_error_percent"].as_f64().is_some_and(|error| error.abs() < 5.0), "{said}");
    assert!(ours["usage"]["wall_seconds"].as_f64() > Some(0.0), "{said}");
    if cfg!(target_os = "linux") {
        assert!(ours["usage"]["cpu_seconds"].as_f64() > Some(0.0), "{said}");
        assert!(ours["usage"]["peak_memory_mb"].as_f64() > Some(1.0), "{said}");
    }
    assert_eq!(peer["scores"], Value::Null, "{said}");
    assert!(peer["failure"].as_str().is_some_and(|reason| reason.contains("out of luck")), "{said}");
    assert_eq!(fs::read_to_string(out.join("real.json")).expect("written").trim(), done.stdout.trim());
    assert_eq!(fs::read_to_string(out.join("real.csv")).expect("written").lines().count(), 3);
    assert!(fs::read_to_string(out.join("real.html")).expect("written").contains("out of luck"));

    // A folder that is wrong ends all of it before anything is solved, and leaves nothing.
    fs::write(folder.join("labels.csv"), "view,track,inlier\n0,0,maybe\n").expect("written");
    let other = text(&directory.path().join("other"));
    let refused = run(["evaluate", "--real", &above, "--out", &other, "--quiet"]);
    assert_eq!(refused.code, Some(65), "{refused:?}");
    assert!(refused.stderr.contains("labels.csv, line 2, `inlier`"), "{refused:?}");
    assert!(!Path::new(&other).exists());
    for wrong in [
        &["evaluate", "--peer", "true"][..],
        &["evaluate", "--real", &above, "--quick"],
        &["evaluate", "--real", &above, "--priors"],
    ] {
        assert_eq!(run(wrong).code, Some(2), "{wrong:?}");
    }
}
