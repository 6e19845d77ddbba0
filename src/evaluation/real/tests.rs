//! Both sides on a small sequence that the tests write.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitStatus;
use std::time::Duration;

use nalgebra::{Matrix3, Matrix3x4, Vector3};
use serde_json::{Value, json};

use super::measures::Verdicts;
use super::{Options, Row, Sequence, Side, folder, ours, page, run, table};
use crate::domain::{Limits, Method, Silent, SolveSettings, StopToken};
use crate::formats::result_files;
use crate::synthetic::{self, SequenceOptions};

fn generated() -> synthetic::Sequence {
    let options = SequenceOptions {
        views: 8,
        tracks: 250,
        lifetime: (4, 8),
        noise: 0.0003,
        outliers: 0.2,
        seed: 5,
        ..SequenceOptions::default()
    };
    synthetic::Sequence::generate(&options).expect("valid options")
}

/// A sequence's folder in `directory`.
fn written(directory: &Path, name: &str, sequence: &synthetic::Sequence) -> PathBuf {
    let folder = directory.join(name);
    fs::create_dir_all(&folder).expect("a folder");
    let (input, truth) = (&sequence.input, &sequence.truth);
    let mut observations = String::from("view,track,x,y\n");
    let mut labels = String::from("view,track,residual_px,inlier\n");
    for k in 0..input.x.len() {
        let (view, track) = (input.view[k], input.track[k]);
        writeln!(observations, "{view},{track},{},{}", input.x[k], input.y[k]).expect("text");
        writeln!(labels, "{view},{track},0.5,{}", u8::from(truth.observation_right[k])).expect("text");
    }
    let [x, y] = truth.principal_point_px;
    let k = [[truth.focal_px, 0.0, x], [0.0, truth.focal_px, y], [0.0, 0.0, 1.0]];
    let cameras: Vec<Vec<Vec<f64>>> = truth
        .rotations
        .iter()
        .zip(&truth.translations)
        .map(|(rotation, translation)| {
            let mut pose = Matrix3x4::zeros();
            pose.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::from_fn(|row, column| rotation[row][column]));
            pose.set_column(3, &Vector3::from(*translation));
            let camera = Matrix3::from_fn(|row, column| k[row][column]) * pose;
            camera.row_iter().map(|row| row.iter().copied().collect()).collect()
        })
        .collect();
    fs::write(folder.join(folder::OBSERVATIONS), observations).expect("written");
    fs::write(folder.join(folder::LABELS), labels).expect("written");
    fs::write(folder.join(folder::META), json!({"width": 1000, "height": 1000, "K": k}).to_string()).expect("written");
    fs::write(folder.join(folder::CAMERAS), json!({"P": cameras}).to_string()).expect("written");
    folder
}

#[test]
fn a_solve_is_scored_against_all_that_is_known() {
    let directory = tempfile::tempdir().expect("a directory");
    let sequence = Sequence::read(&written(directory.path(), "walk", &generated())).expect("a good folder");
    assert_eq!((sequence.name.as_str(), sequence.views(), sequence.centres.len()), ("walk", 8, 8));
    let input = sequence.input.check(&Limits::default()).expect("valid");
    let settings = SolveSettings { method: Method::Geometry, ..SolveSettings::default() };
    let solution = crate::solver::solve(&input, &settings, &mut Silent, &StopToken::default()).expect("a solution");
    result_files::write(&ours::files(directory.path()), &solution, Some(&sequence.input), &[]).expect("written");

    let answer = ours::answer(&sequence, directory.path(), ExitStatus::default(), "").expect("an answer");
    let scores = super::Scores::of(&sequence, &answer);
    assert_eq!((scores.registered, scores.parts, scores.centres), (8, 1, 8), "{scores:?}");
    assert_eq!(scores.verdicts, Verdicts::Observations);
    assert!(scores.f1 > 0.97 && scores.precision > 0.97 && scores.recall > 0.97, "{scores:?}");
    assert!(scores.focal_error_percent.expect("calibrated").abs() < 2.0, "{scores:?}");
    assert!(scores.focal_error_sigmas.expect("with a sigma").abs() < 6.0, "{scores:?}");
    assert!(scores.centre_error_percent.expect("metric") < 1.0, "{scores:?}");
    assert!(scores.rms_px.expect("reconstructed") < 1.0, "{scores:?}");

    // Without an answer there is a reason.
    let empty = tempfile::tempdir().expect("a directory");
    let reason = ours::answer(&sequence, empty.path(), ExitStatus::default(), "no memory").expect_err("no files");
    assert!(reason.contains("no memory"), "{reason}");
}

/// The rows of one sequence where this program cannot be started and the peer is this shell script.
#[cfg(unix)]
fn with_peer(directory: &Path, script: &str, timeout: Duration) -> Vec<Row> {
    let sequence = Sequence::read(&directory.join("walk")).expect("a good folder");
    let file = directory.join("peer.sh");
    fs::write(&file, script).expect("written");
    let options = Options {
        program: directory.join("no-such-program"),
        peer: vec!["sh".into(), file.display().to_string()],
        peer_timeout: timeout,
    };
    let mut seen = Vec::new();
    let rows = run(&[sequence], &options, &StopToken::default(), &mut |_, side| seen.push(side), &mut |_| {});
    assert_eq!(seen, [Side::Scpsfm, Side::Peer]);
    rows.expect("a directory for the programs' files")
}

#[cfg(unix)]
#[test]
fn a_peers_verdicts_on_tracks_are_spread_over_their_observations() {
    let directory = tempfile::tempdir().expect("a directory");
    let made = generated();
    written(directory.path(), "walk", &made);
    let answer = json!({
        "views": 7, "focal": 1.1 * made.truth.focal_px, "reproj": 0.7, "sigma_log_focal": 0.05,
        "inlier": made.truth.inlier.iter().map(|&inlier| u8::from(inlier)).collect::<Vec<_>>(),
        "error": "two models", "seconds": {"total": 1.0},
    });
    let prepared = directory.path().join("prepared.json");
    fs::write(&prepared, answer.to_string()).expect("written");
    // A peer that is called otherwise fails.
    let script = format!(
        "set -e; head -n 1 \"$1\" | grep -q view,track,x,y; test \"$2 $3 $4\" = '1000 1000 -o'; cp {} \"$5\"",
        prepared.display()
    );
    let rows = with_peer(directory.path(), &script, Duration::from_secs(600));
    let [ours, peer] = &rows[..] else { panic!("{rows:?}") };
    assert!(ours.failure.as_ref().is_some_and(|reason| reason.contains("no-such-program")), "{ours:?}");
    let scores = peer.scores.as_ref().unwrap_or_else(|| panic!("{peer:?}"));
    assert_eq!((scores.registered, scores.verdicts, scores.mean_px), (7, Verdicts::Tracks, Some(0.7)));
    assert!((scores.focal_error_percent.expect("a focal length") - 10.0).abs() < 1e-9);
    assert!((scores.focal_error_sigmas.expect("a sigma") - 1.1f64.ln() / 0.05).abs() < 1e-9);
    // The right tracks are all there, and with them the wrong observations in them.
    assert_eq!(scores.recall, 1.0);
    assert!(scores.precision > 0.9 && scores.precision < 1.0, "{scores:?}");
    assert_eq!(scores.warnings, ["two models"]);
    assert_eq!(scores.centre_error_percent, None);
    assert!(peer.usage.wall_seconds > 0.0);

    // Verdicts on observations go before those on tracks.
    let mut finer = answer;
    finer["observation_inlier"] = json!(made.truth.observation_right);
    let centres = made.truth.rotations.iter().zip(&made.truth.translations).map(|(rotation, translation)| {
        let rotation = Matrix3::from_fn(|row, column| rotation[row][column]);
        let centre = -3.0 * rotation.transpose() * Vector3::from(*translation);
        [centre.x, centre.y, centre.z]
    });
    finer["centres"] = centres.collect();
    fs::write(&prepared, finer.to_string()).expect("written");
    let rows = with_peer(directory.path(), &script, Duration::from_secs(600));
    let scores = rows[1].scores.as_ref().expect("an answer");
    assert_eq!((scores.f1, scores.verdicts), (1.0, Verdicts::Observations));
    assert!(scores.centre_error_percent.expect("centres") < 1e-6, "{scores:?}");
}

#[cfg(unix)]
#[test]
fn a_peer_that_fails_is_a_row_with_its_reason() {
    let directory = tempfile::tempdir().expect("a directory");
    written(directory.path(), "walk", &generated());
    let patient = Duration::from_secs(600);
    let cases = [
        ("echo 'no images, no model' >&2; exit 3", patient, "no images, no model"),
        ("kill -SEGV $$", patient, "signal"),
        ("true", patient, "wrote no answer"),
        ("echo '{' > \"$5\"", patient, "cannot be read"),
        ("echo '{\"views\": 3, \"focal\": -700}' > \"$5\"", patient, "`focal`: -700 is not a number above 0"),
        ("echo '{\"views\": 3, \"rms\": -1}' > \"$5\"", patient, "`rms`: -1 is not a number from 0 on"),
        ("echo '{\"views\": 99, \"inlier\": []}' > \"$5\"", patient, "`views` is 99, of a sequence of 8 views"),
        ("echo '{\"views\": 3}' > \"$5\"", patient, "neither `inlier` nor `observation_inlier`"),
        ("echo '{\"views\": 3, \"inlier\": [1, 0]}' > \"$5\"", patient, "2 entries"),
        ("echo '{\"views\": 3, \"observation_inlier\": [1]}' > \"$5\"", patient, "1 entry"),
        ("sleep 600", Duration::from_millis(50), "its limit"),
    ];
    for (script, timeout, expected) in cases {
        let rows = with_peer(directory.path(), script, timeout);
        let reason = rows[1].failure.as_deref().unwrap_or_else(|| panic!("{script}: {rows:?}"));
        assert!(reason.contains(expected) && rows[1].scores.is_none(), "{script}: {reason}");
        assert!(table::text(&rows).contains("failed: "), "{script}");
    }
}

#[test]
fn what_is_wrong_with_a_folder_names_file_and_place() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = written(directory.path(), "walk", &generated());
    let good = |name: &str| fs::read_to_string(path.join(name)).expect("written");
    let meta: Value = serde_json::from_str(&good(folder::META)).expect("JSON");
    let changed = |field: &str, value: Value| {
        let mut meta = meta.clone();
        meta[field] = value;
        meta.to_string()
    };
    let labels = good(folder::LABELS);
    let line = |number: usize, text: &str| {
        let mut lines: Vec<&str> = labels.lines().collect();
        lines[number - 1] = text;
        lines.join("\n")
    };
    let second = labels.lines().nth(1).expect("a label").to_owned();
    let cases = [
        (folder::META, "{".to_owned(), "is not JSON"),
        (folder::META, "{\"K\": 3}".into(), "`width`: is missing"),
        (folder::META, changed("width", json!(-4)), "`width`: must be a whole number"),
        (folder::META, changed("height", json!("tall")), "`height`: must be a whole number"),
        (folder::META, changed("height", json!(2_000_000)), "`height`: must be a whole number of pixels, 1 to 1000000"),
        (folder::META, changed("K", Value::Null), "`K`: must be a 3x3"),
        (folder::META, changed("K", json!([[1.0, 0.0], [0.0, 1.0]])), "`K`: must be a 3x3"),
        (folder::META, changed("K", json!([meta["K"], [[1.0]]])), "`K[1]`: must be a 3x3"),
        (folder::LABELS, String::new(), "is empty"),
        (folder::LABELS, line(1, "view,track,verdict"), "line 1: the header has no column `inlier`"),
        (folder::LABELS, line(4, "0,3,0.5,perhaps"), "line 4, `inlier`: \"perhaps\" is neither 0 nor 1"),
        (folder::LABELS, line(5, "0"), "line 5, `inlier`"),
        (folder::LABELS, line(6, "a,3,0.5,1"), "line 6, `view`: \"a\" is not a whole number"),
        (folder::LABELS, line(7, &second), "line 7: view"),
        (folder::LABELS, line(2, ""), "says nothing of view"),
        (folder::CAMERAS, "{}".into(), "`P`: must be a list"),
        (folder::CAMERAS, json!({"P": [null]}).to_string(), "`P`: has 1 entry"),
        (folder::CAMERAS, json!({"P": [null, [[0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 0, 1]]]}).to_string(), "`P[1]`"),
        (folder::OBSERVATIONS, "view,track,x\n".into(), "no column `y`"),
    ];
    for (file, content, expected) in cases {
        let before = good(file);
        fs::write(path.join(file), &content).expect("written");
        let error = Sequence::read(&path).err().unwrap_or_else(|| panic!("{file}: {expected}: accepted")).to_string();
        assert!(error.contains(expected) && error.contains(file) && error.contains("walk"), "{expected}: {error}");
        fs::write(path.join(file), before).expect("written");
    }
    fs::remove_file(path.join(folder::CAMERAS)).expect("removed");
    assert!(Sequence::read(&path).expect("cameras may be absent").centres.is_empty());
    fs::remove_file(path.join(folder::META)).expect("removed");
    assert!(Sequence::read(&path).expect_err("no calibration").to_string().contains("meta.json: cannot be read"));
}

#[test]
fn image_sizes_and_calibrations_are_read_as_they_are_written() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = written(directory.path(), "walk", &generated());
    let k = |focal: f64| json!([[focal, 0, 300], [0, focal, 200], [0, 0, 1]]);
    let read = |meta: Value| {
        fs::write(path.join(folder::META), meta.to_string()).expect("written");
        let sequence = Sequence::read(&path).unwrap_or_else(|error| panic!("{error}"));
        (sequence.size.width_px, sequence.size.height_px, sequence.focal_px)
    };
    assert_eq!(read(json!({"image_width": 600, "image_height": 400, "K": k(500.0)})), (600, 400, Some(500.0)));
    assert_eq!(read(json!({"image_size": [600, 400], "K": [k(500.0), k(500.2)]})), (600, 400, Some(500.1)));
    // A zoom has no one focal length to be right about.
    assert_eq!(read(json!({"image_size": [600, 400], "K": [k(500.0), k(510.0)]})), (600, 400, None));
}

#[test]
fn a_folder_of_folders_gives_each_sequence_once() {
    let directory = tempfile::tempdir().expect("a directory");
    let (b, a) = (written(directory.path(), "b", &generated()), written(directory.path(), "a", &generated()));
    fs::create_dir(directory.path().join("notes")).expect("a folder");
    let found = folder::find(&[b.clone(), directory.path().into()]).expect("two sequences");
    assert_eq!(found, [b, a]);
    let error = folder::find(&[directory.path().join("notes")]).expect_err("nothing in it").to_string();
    assert!(error.contains("notes") && error.contains(folder::OBSERVATIONS), "{error}");
    assert!(folder::find(&[directory.path().join("nowhere")]).is_err());
}

#[test]
fn names_stay_text_in_every_form() {
    let row = Row {
        sequence: "a,<b>\"c".into(),
        side: Side::Peer,
        views: 9,
        observations: 40,
        cameras_estimated: true,
        failure: Some("<script>, no".into()),
        scores: None,
        usage: super::Usage { wall_seconds: 1.5, cpu_seconds: Some(2.25), peak_memory_mb: None },
    };
    let csv = table::csv(std::slice::from_ref(&row));
    let (header, line) = csv.trim_end().split_once('\n').expect("two lines");
    assert!(line.starts_with("\"a,<b>\"\"c\",peer,9,40,") && line.ends_with(",\"<script>, no\""), "{line}");
    // Two commas of the line are within quotes.
    assert_eq!(line.matches(',').count() - 2, header.matches(',').count());
    let html = page::page(std::slice::from_ref(&row), &["x<y".into()], Some("Incomplete"));
    assert!(html.contains("a,&lt;b&gt;&quot;c") && html.contains("x&lt;y") && !html.contains("<script>"), "{html}");
    let text = table::text(&[row.clone(), Row { sequence: "longer than the other".into(), ..row }]);
    let place = |line: &str| line.find("peer").expect("the side");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(place(lines[1]), place(lines[2]));
}
