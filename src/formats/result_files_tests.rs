use std::collections::BTreeMap;
use std::fs;

use serde_json::Value;

use super::*;
use crate::domain::result::{ObservationResults, Sigmas, TwoViewTrack};
use crate::domain::{Calibration, Grade, LeftOut, LensProjection, Status, Warning, WarningCode};
use crate::formats::fixture;

fn json(solution: &Solution) -> Value {
    serde_json::from_str(&result_json(solution, None).expect("serialisable")).expect("JSON")
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().expect("an object").keys().map(String::as_str).collect()
}

/// Every file of a directory.
pub(super) fn contents(directory: &Path) -> BTreeMap<String, String> {
    let entries = fs::read_dir(directory).expect("a directory");
    entries
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| !path.ends_with(manifest::NAME))
        .map(|path| {
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            (name, fs::read_to_string(&path).expect("text"))
        })
        .collect()
}

#[test]
fn the_fields_of_result_json_are_a_contract() {
    let (_, solution) = fixture::solved();
    let result = json(&solution);
    let mut found = keys(&result);
    found.sort_unstable();
    let mut wanted = [
        "status",
        "grade",
        "focal_px",
        "sigma_log_focal",
        "focal_unobservable",
        "principal_point_px",
        "aspect",
        "lens_projection",
        "radial_k1",
        "radial_k2",
        "radial_k3",
        "tangential_p1",
        "tangential_p2",
        "sigma_principal_point_px",
        "sigma_aspect",
        "sigma_radial_k1",
        "sigma_radial_k2",
        "sigma_radial_k3",
        "sigma_tangential_p1",
        "sigma_tangential_p2",
        "cameras",
        "plane_at_infinity",
        "inlier_tracks",
        "inlier_observations",
        "split_points",
        "two_view_tracks",
        "unclassified_tracks",
        "rejected_tracks",
        "second_structures",
        "registered_views",
        "reprojection_rms_px",
        "reprojection_mean_px",
        "warnings",
        "method",
        "iterations",
        "winning_proposal",
        "trained_network_sha256",
        "noise_px",
        "seconds",
        "stages",
        "proposal_times",
        "seed",
        "version",
    ];
    wanted.sort_unstable();
    assert_eq!(found, wanted);
    assert_eq!(result["status"], "SOLVED");
    assert_eq!(result["grade"], "METRIC");
    assert_eq!(result["method"], "AUTO");
    assert_eq!(result["winning_proposal"], "network");
    assert_eq!(result["inlier_tracks"], 20);
    assert_eq!(result["inlier_observations"], 100);
    assert_eq!(result["registered_views"], 5);
    assert_eq!(result["focal_unobservable"], false);
    assert_eq!(result["aspect"], 1.0);
    assert_eq!(result["radial_k1"], -0.02);
    assert_eq!(keys(&result["warnings"][0]), ["code", "detail"]);
    assert_eq!(result["warnings"][0]["code"], "FEW_INLIERS");
    assert_eq!(keys(&result["stages"][0]), ["name", "seconds"]);
    assert_eq!(result["stages"][0]["name"], "prepare");
    assert_eq!(result["proposal_times"][0]["proposal"], "uniform");
    assert_eq!(result["proposal_times"][0]["seconds"], Value::Null);
}

#[test]
fn infinity_is_null_and_said() {
    let (_, mut solution) = fixture::solved();
    solution.calibrations[0].sigma_log_focal = None;
    let result = json(&solution);
    assert_eq!(result["sigma_log_focal"], Value::Null);
    assert_eq!(result["focal_unobservable"], true);
    solution.calibrations.clear();
    solution.status = Status::NoReconstruction;
    solution.grade = None;
    let result = json(&solution);
    assert_eq!(result["status"], "NO_RECONSTRUCTION");
    for field in ["grade", "focal_px", "sigma_log_focal", "focal_unobservable", "principal_point_px", "aspect"] {
        assert_eq!(result[field], Value::Null, "{field}");
    }
}

#[test]
fn a_projective_result_gives_no_calibration_and_says_why() {
    let (input, solution) = fixture::projective_only();
    let result = json(&solution);
    assert_eq!((&result["status"], &result["grade"]), (&"SOLVED".into(), &"PROJECTIVE_ONLY".into()));
    assert_eq!(result["focal_unobservable"], true);
    for field in [
        "focal_px",
        "sigma_log_focal",
        "principal_point_px",
        "aspect",
        "lens_projection",
        "radial_k1",
        "radial_k2",
        "radial_k3",
        "tangential_p1",
        "tangential_p2",
        "plane_at_infinity",
    ] {
        assert_eq!(result[field], Value::Null, "{field}");
    }
    assert_eq!((&result["registered_views"], &result["inlier_tracks"]), (&5.into(), &20.into()));
    for camera in CamerasJson::new(&solution, Some(&input)).views {
        assert!(camera.registered && camera.P.is_some(), "view {}", camera.view);
        assert!(camera.K.is_none() && camera.R.is_none() && camera.t.is_none(), "view {}", camera.view);
        assert!(camera.lens.radial_k1.is_none(), "view {}", camera.view);
    }
}

#[test]
fn a_camera_group_without_a_calibration_has_no_others() {
    let (input, mut solution) = fixture::solved();
    solution.views[3].camera_group = 9;
    let cameras = &json(&solution)["cameras"];
    assert!(cameras[0]["focal_px"].is_number(), "{cameras}");
    assert_eq!((&cameras[1]["camera_group"], &cameras[1]["focal_px"]), (&9.into(), &Value::Null));
    let matrices = CamerasJson::new(&solution, Some(&input)).views.into_iter().map(|view| view.K.is_some());
    assert_eq!(matrices.collect::<Vec<bool>>(), [true, true, true, false, true]);
}

#[test]
fn several_camera_groups_are_listed_and_each_view_gets_its_own() {
    let (input, mut solution) = fixture::solved();
    let second = Calibration {
        camera_group: 9,
        focal_px: 77.0,
        sigma_log_focal: None,
        principal_point_px: [1.0, 2.0],
        aspect: 1.25,
        lens_projection: LensProjection::Fisheye,
        radial_k1: 0.01,
        radial_k2: 0.002,
        radial_k3: -0.0005,
        tangential_p1: 0.0625,
        tangential_p2: -0.125,
        grade: Some(Grade::ProjectiveOnly),
        sigmas: Sigmas {
            principal_point_px: Some([3.0, 4.0]),
            radial_k1: Some(0.002),
            radial_k3: Some(0.0004),
            tangential_p1: Some(0.03),
            tangential_p2: Some(0.04),
            ..Sigmas::default()
        },
    };
    solution.calibrations.push(second);
    solution.views[3].camera_group = 9;
    for _ in 0..2 {
        solution.warnings.push(Warning::new(WarningCode::UnobservableFocal, "camera group 9: no turning").of_group(9));
    }
    let result = json(&solution);
    let found = result["cameras"].as_array().expect("a list");
    assert_eq!(found.len(), 2);
    let mut names = keys(&found[1]);
    names.sort_unstable();
    let mut wanted = [
        "camera_group",
        "views",
        "registered_views",
        "focal_px",
        "sigma_log_focal",
        "focal_unobservable",
        "principal_point_px",
        "aspect",
        "lens_projection",
        "radial_k1",
        "radial_k2",
        "radial_k3",
        "tangential_p1",
        "tangential_p2",
        "sigma_principal_point_px",
        "sigma_aspect",
        "sigma_radial_k1",
        "sigma_radial_k2",
        "sigma_radial_k3",
        "sigma_tangential_p1",
        "sigma_tangential_p2",
        "grade",
        "warnings",
    ];
    wanted.sort_unstable();
    assert_eq!(names, wanted);
    assert_eq!((&found[0]["camera_group"], &found[0]["registered_views"]), (&0.into(), &4.into()));
    assert_eq!((&found[0]["grade"], &found[0]["sigma_log_focal"]), (&"METRIC".into(), &0.004.into()));
    assert_eq!(found[0]["warnings"], Value::Array(Vec::new()));
    assert_eq!((&found[1]["camera_group"], &found[1]["views"]), (&9.into(), &1.into()));
    assert_eq!((&found[1]["aspect"], &found[1]["grade"]), (&1.25.into(), &"PROJECTIVE_ONLY".into()));
    assert_eq!((&found[1]["sigma_log_focal"], &found[1]["focal_unobservable"]), (&Value::Null, &true.into()));
    assert_eq!(found[1]["warnings"], serde_json::json!(["UNOBSERVABLE_FOCAL"]));
    assert_eq!(result["warnings"][1]["camera_group"], 9);
    let cameras = CamerasJson::new(&solution, Some(&input));
    let focal: Vec<f64> = cameras.views.iter().map(|view| view.K.expect("metric")[0][0]).collect();
    let first = solution.calibrations[0].focal_px;
    assert_eq!(focal, [first, first, first, 77.0, first]);
    assert_eq!(cameras.views[3].K.expect("metric")[1][1], 77.0 * 1.25);
    let sigmas: Vec<Option<f64>> = cameras.views.iter().map(|view| view.sigma_log_focal).collect();
    assert_eq!(sigmas, [Some(0.004), Some(0.004), Some(0.004), None, Some(0.004)]);
    solution.views[3].focal_px = Some(80.0);
    assert_eq!(CamerasJson::new(&solution, Some(&input)).views[3].K.expect("metric")[0][0], 80.0);
    assert_eq!((&found[1]["sigma_principal_point_px"][1], &found[1]["sigma_radial_k1"]), (&4.0.into(), &0.002.into()));
    assert_eq!((&found[1]["sigma_aspect"], &found[0]["sigma_radial_k1"]), (&Value::Null, &Value::Null));
    assert_eq!((cameras.views[3].sigmas.sigma_radial_k1, cameras.views[0].sigmas.sigma_radial_k1), (Some(0.002), None));
    assert_eq!((cameras.views[0].lens.radial_k1, cameras.views[3].lens.radial_k1), (Some(-0.02), Some(0.01)));
    let views = serde_json::to_value(&cameras).expect("serialisable");
    for (field, value, sigma) in
        [("radial_k3", -0.0005, 0.0004), ("tangential_p1", 0.0625, 0.03), ("tangential_p2", -0.125, 0.04)]
    {
        let error = format!("sigma_{field}");
        assert_eq!((&found[0][field], &found[0][&error]), (&0.0.into(), &Value::Null), "{field}");
        for of in [&found[1], &views["views"][3]] {
            assert_eq!((&of[field], &of[&error]), (&value.into(), &sigma.into()), "{field}");
        }
    }
    // The first group with registered views is the summary's own.
    solution.views.iter_mut().filter(|view| view.camera_group == 0).for_each(|view| view.projection = None);
    solution.calibrations.remove(0);
    let summary = json(&solution);
    for field in keys(&found[1]).into_iter().filter(|field| field.contains("radial") || field.contains("tangential")) {
        assert_eq!(summary[field], found[1][field], "{field}");
    }
}

#[test]
fn a_view_without_a_pose_has_no_matrices() {
    let (input, mut solution) = fixture::solved();
    solution.views[1] = fixture::left_out(LeftOut::NotRegistered { points: 12, agreeing: 4 });
    solution.views[2].rotation = None;
    let cameras = serde_json::to_value(CamerasJson::new(&solution, Some(&input))).expect("serialisable");
    let view = |k: usize| &cameras["views"][k];
    assert_eq!(view(0)["view"], 3);
    assert_eq!(view(0)["K"][0][0], solution.calibrations[0].focal_px);
    assert!(view(0)["R"].is_array() && view(0)["t"].is_array() && view(0)["P"].is_array());
    assert_eq!(view(1)["registered"], false);
    assert_eq!(view(1)["P"], Value::Null);
    assert_eq!(view(1)["left_out"]["code"], "NOT_REGISTERED");
    assert_eq!(view(1)["left_out"]["detail"], "4 of the 12 points it sees agree on a pose");
    assert_eq!(view(0)["left_out"], Value::Null);
    assert_eq!(view(2)["registered"], true);
    for matrix in ["K", "R", "t"] {
        assert_eq!(view(2)[matrix], Value::Null, "{matrix}");
    }
}

#[test]
fn answers_carry_the_callers_ids_in_the_callers_order() {
    let (mut input, mut solution) = fixture::solved();
    (solution.observations.weight[3], solution.observations.split[3]) = (0.25, 2);
    input.raw.view.swap(0, 1);
    input.raw.track.swap(0, 1);
    let directory = tempfile::tempdir().expect("a temporary directory");
    let out = directory.path().join("a/b");
    write(&out, &solution, Some(&input), &[]).expect("written");
    let files = contents(&out);
    assert_eq!(files.keys().collect::<Vec<_>>(), [CAMERAS, OBSERVATIONS, POINTS, REPORT, RESULT, TRACKS]);
    let tracks: Vec<&str> = files[TRACKS].lines().collect();
    assert_eq!(tracks[0], "track,weight,inlier,network_weight,part");
    assert_eq!(tracks.len(), 41);
    let expected = if solution.tracks.inlier[1] { "102,0.98,1,0.8,0" } else { "102,0.03,0,0.2," };
    assert_eq!(tracks[2], expected);
    let observations: Vec<&str> = files[OBSERVATIONS].lines().collect();
    assert_eq!(observations[0], "view,track,inlier,residual_px,weight,split,x_px,y_px,keypoint");
    assert_eq!(observations.len(), 201);
    assert!(observations[1].starts_with("3,102,"), "{}", observations[1]);
    let pixels = |k: usize| format!("{},{}", input.raw.x[k], input.raw.y[k]);
    assert!(observations[4].ends_with(&format!(",0.25,2,{},", pixels(3))), "{}", observations[4]);
    let outlier = solution.observations.inlier.iter().position(|&inlier| !inlier).expect("an outlier");
    let wanted = format!(",0,,0,,{},", pixels(outlier));
    assert!(observations[outlier + 1].ends_with(&wanted), "{}", observations[outlier + 1]);
    input.keypoints = (0..200).map(|k| 1000 + k).collect();
    assert!(observations_csv(&solution, &input).lines().nth(4).is_some_and(|line| line.ends_with(",1003")));
}

#[test]
fn without_a_network_there_is_no_fourth_column_and_without_the_input_no_observations() {
    let (_, mut solution) = fixture::solved();
    solution.tracks.network_weight.clear();
    let directory = tempfile::tempdir().expect("a temporary directory");
    write(directory.path(), &solution, None, &[]).expect("written");
    let files = contents(directory.path());
    assert!(!files.contains_key(OBSERVATIONS));
    assert_eq!(files[TRACKS].lines().next(), Some("track,weight,inlier,part"));
    assert!(files[TRACKS].lines().nth(1).expect("a track").starts_with("0,"));
}

#[test]
fn tracks_that_two_views_see_are_marked() {
    let (input, mut solution) = fixture::solved();
    let column = |solution: &Solution| -> Option<Vec<String>> {
        let text = tracks_csv(solution, Some(&input));
        let place = text.lines().next()?.split(',').position(|name| name == "two_view")?;
        Some(text.lines().skip(1).filter_map(|line| Some(line.split(',').nth(place)?.to_owned())).collect())
    };
    assert_eq!(column(&solution), None);
    solution.two_view_tracks = vec![TwoViewTrack { track: 2, weight: 0.75, part: 0, point: None }];
    let marked = column(&solution).expect("a column");
    assert!(
        marked.len() == solution.tracks.inlier.len()
            && marked.iter().enumerate().all(|(track, mark)| { mark == if track == 2 { "1" } else { "0" } }),
        "{marked:?}"
    );
}

#[test]
fn tracks_of_a_second_structure_are_marked() {
    let (_, mut solution) = fixture::solved();
    let rejected = solution.tracks.inlier.iter().position(|&inlier| !inlier).expect("an outlier");
    solution.tracks.second_structure =
        (0..solution.tracks.inlier.len()).map(|track| u32::from(track == rejected)).collect();
    let text = tracks_csv(&solution, None);
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0], "track,weight,inlier,network_weight,part,second_structure");
    let marked: Vec<usize> = (1..lines.len()).filter(|&line| lines[line].ends_with(",1")).collect();
    assert_eq!(marked, [rejected + 1]);
    assert!(lines[1..].iter().all(|line| line.split(',').count() == 6), "{text}");
}

#[test]
fn the_same_solution_gives_the_same_bytes_but_for_times() {
    let (input, solution) = fixture::solved();
    let directory = tempfile::tempdir().expect("a temporary directory");
    let written = |name: &str, solution: &Solution| {
        let out = directory.path().join(name);
        write(&out, solution, Some(&input), &[]).expect("written");
        contents(&out)
    };
    let first = written("first", &solution);
    assert_eq!(first, written("again", &solution));
    let mut later = solution.clone();
    later.seconds = 99.0;
    later.stages[0].seconds = 98.0;
    later.history.iter_mut().for_each(|progress| progress.elapsed_seconds += 7.0);
    let second = written("later", &later);
    for name in [TRACKS, OBSERVATIONS, CAMERAS, POINTS] {
        assert_eq!(first[name], second[name], "{name}");
    }
    let differing =
        |name: &str| first[name].lines().zip(second[name].lines()).filter(|(before, after)| before != after).count();
    assert_eq!(differing(RESULT), 2);
    assert!(differing(REPORT) <= 2, "{} lines of the report depend on times", differing(REPORT));
}

#[test]
fn frames_are_never_mixed() {
    let (input, solution) = fixture::solved_in_two_parts();
    let directory = tempfile::tempdir().expect("a temporary directory");
    write(directory.path(), &solution, Some(&input), &[]).expect("written");
    let files = contents(directory.path());
    let tracks: Vec<Vec<&str>> = files[TRACKS].lines().skip(1).map(|line| line.split(',').collect()).collect();
    for (name, part) in [(POINTS, "0"), ("points-part-1.ply", "1")] {
        let (header, body) = files[name].split_once("end_header\n").expect("a header");
        let points: Vec<&str> = body.lines().map(|line| line.split(' ').nth(7).expect("a track")).collect();
        let wanted: Vec<&str> = tracks.iter().filter(|row| row[4] == part).map(|row| row[0]).collect();
        assert!(!points.is_empty() && points == wanted, "{name}: {points:?} {wanted:?}");
        assert!(header.contains(&format!("of part {part} of 2")), "{header}");
    }
    assert!(tracks.iter().all(|row| row[4].is_empty() == (row[2] == "0")), "an outlier is of no part");
    let words = said(directory.path(), &solution);
    assert!(words.contains("points-part-1.ply those of the others"), "{words}");
    // A result in one part takes away what the other parts left.
    for name in ["points-part-01.ply", "points-part-2.ply"] {
        fs::write(directory.path().join(name), "mine").expect("written");
    }
    write(directory.path(), &fixture::solved().1, Some(&input), &[]).expect("written");
    let names: Vec<String> = contents(directory.path()).into_keys().filter(|name| name.ends_with(".ply")).collect();
    assert_eq!(names, ["points-part-01.ply", "points-part-2.ply", POINTS]);
}

/// Ranked and not verified: the ranking is in every table, and cameras.json says why there are no cameras.
#[test]
fn without_a_reconstruction_the_files_say_the_weights_and_the_reason() {
    let (input, mut solution) = fixture::solved();
    (solution.status, solution.grade) = (Status::NoReconstruction, None);
    solution.calibrations.clear();
    solution.views.fill(Default::default());
    solution.tracks.inlier.fill(false);
    solution.tracks.point.fill(None);
    solution.observations = ObservationResults::unjudged(input.raw.x.len());
    solution.warnings = vec![
        Warning::new(WarningCode::UnverifiedRanking, "20 tracks look right"),
        Warning::new(WarningCode::NoConsensus, "no 8 tracks agree"),
    ];
    let directory = tempfile::tempdir().expect("a temporary directory");
    write(directory.path(), &solution, Some(&input), &[]).expect("written");
    let files = contents(directory.path());
    let mut weights = Vec::new();
    for (row, &track) in files[OBSERVATIONS].lines().skip(1).zip(&input.raw.track) {
        let fields: Vec<&str> = row.split(',').collect();
        assert_eq!(fields[4], solution.tracks.weight[track as usize].to_string(), "{row}");
        weights.push(fields[4]);
    }
    assert!(weights.contains(&"0.98") && weights.contains(&"0.03"));
    let cameras: Value = serde_json::from_str(&files[CAMERAS]).expect("JSON");
    let reason = serde_json::json!({ "code": "NO_CONSENSUS", "detail": "no 8 tracks agree" });
    assert_eq!((&cameras["status"], &cameras["reason"]), (&"NO_RECONSTRUCTION".into(), &reason));
    assert_eq!((&cameras["views"][2]["registered"], &cameras["views"][2]["left_out"]), (&false.into(), &reason));
    let solved = serde_json::to_value(CamerasJson::new(&fixture::solved().1, None)).expect("JSON");
    assert_eq!((&solved["status"], &solved["reason"]), (&"SOLVED".into(), &Value::Null));
    let projective = CamerasJson::new(&fixture::projective_only().1, None);
    assert_eq!(projective.reason.expect("a reason").code, "UNOBSERVABLE_FOCAL");
    assert!(projective.views.iter().all(|view| view.left_out.is_none()));
}
