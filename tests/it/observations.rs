//! `evaluate --observations`: this program and a peer on generated inputs, as a user runs it.

use std::fs;

use serde_json::{Value, json};

use crate::support::program::run;

#[test]
fn both_sides_are_scored_on_inputs_with_wrong_observations() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = |name: &str| directory.path().join(name).to_str().expect("UTF-8").to_owned();
    // A peer that keeps every track and every observation, and has a wrong focal length.
    let answer = json!({"views": 10, "focal": 5000.0, "inlier": vec![1; 200], "observation_inlier": vec![1; 1800]});
    fs::write(path("answer.json"), answer.to_string()).expect("written");
    let script = format!("test \"$1\" = --help || cp {} \"$5\"", path("answer.json"));
    fs::write(path("peer.sh"), script).expect("written");
    let (out, words) = (path("out"), format!("sh {}", path("peer.sh")));
    let shared = ["evaluate", "--observations", "--out", &out, "--quiet", "--scenes"];
    let evaluate = |scenes: &'static str, more: &[&str]| run(shared.iter().chain([&scenes]).chain(more));
    let done = evaluate("deleted 0.3, K 1", &["--seeds", "1", "--peer", &words, "--json"]);
    assert_eq!(done.code, Some(0), "{done:?}");
    let said: Value = serde_json::from_str(&done.stdout).expect("JSON");
    let rows = said["rows"].as_array().expect("rows");
    assert_eq!((&rows[0]["side"], &rows[1]["side"]), (&json!("scpsfm"), &json!("peer")), "{said}");
    assert!(rows.iter().all(|row| row["condition"] == "deleted 0.3, K 1" && row["seeds"] == 1), "{said}");
    assert!(rows[0]["f1"].as_f64() > Some(0.9) && rows[0]["seconds"].as_f64() > Some(0.0), "{said}");
    // Of 200 tracks 140 are right, and of each of these eight or nine of nine observations.
    assert_eq!(rows[1]["f1"].as_f64(), Some(280.0 / 340.0), "{said}");
    assert!(rows[1]["precision"].as_f64().is_some_and(|share| share > 0.6 && share < 0.65), "{said}");
    assert_eq!((&rows[1]["recall"], &rows[1]["metric"], &rows[1]["wrong"]), (&json!(1.0), &json!(1), &json!(1)));
    assert_eq!(fs::read_to_string(path("out/observations.json")).expect("written").trim(), done.stdout.trim());
    let table = evaluate("deleted 0.3, K 1", &["--seeds", "1", "--peer", &words]);
    assert!(table.code == Some(0) && table.stdout.contains("peer"), "{table:?}");
    let lines = fs::read_to_string(path("out/observations.jsonl")).expect("records").lines().count();
    assert_eq!(lines, 3, "a header and two runs: what is recorded is not done again");
    let unknown = evaluate("no such inputs", &[]);
    assert!(unknown.code == Some(2) && unknown.stderr.contains("deleted 0.3, K 1"), "{unknown:?}");
    assert_eq!(evaluate("deleted", &["--priors"]).code, Some(2));
}
