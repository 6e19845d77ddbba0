//! Whole solves of planes, of cameras that only turn, and of tracks that stay where they are in the image.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::*;
use crate::synthetic::{Motion, Shape};

fn warns(solution: &Solution, code: WarningCode) -> bool {
    solution.warnings.iter().any(|warning| warning.code == code)
}

fn assert_calibrated(solution: &Solution, scene: &Scene, case: &str) {
    println!("{case}: {:?}, {:?}, {:?}", solution.grade, solution.calibrations, solution.warnings);
    assert_eq!(solution.grade, Some(Grade::Metric), "{case}");
    let sigma = solution.calibrations[0].sigma_log_focal.expect("observable");
    assert!(focal_error(solution, scene) < 3.5 * sigma, "{case}");
    let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
    assert!(f1 > 0.99, "{case}: F1 {f1}");
    assert!(solution.views.iter().all(|view| view.rotation.is_some()), "{case}");
}

/// The frame of a camera that only turned is told by its rotations alone: what one view sees, another sees where these
/// say.
#[test]
fn a_camera_that_only_turns_is_calibrated_by_its_directions() {
    for seed in 0..3 {
        let options = SceneOptions { motion: Motion::PureRotation, noise: 0.001, outliers: 0.5, seed, ..default() };
        let (input, scene) = scene(options);
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        assert_calibrated(&solution, &scene, &format!("seed {seed}"));
        assert!(warns(&solution, WarningCode::PureRotation), "seed {seed}");
        assert!(solution.tracks.point.iter().all(Option::is_none), "seed {seed}: a direction has no coordinates");
        assert!(solution.views.iter().all(|view| view.translation == Some([0.0; 3])), "seed {seed}");
        let (focal_px, centre_px) = (solution.calibrations[0].focal_px, solution.calibrations[0].principal_point_px);
        let calibration = Matrix3::new(focal_px, 0.0, centre_px[0], 0.0, focal_px, centre_px[1], 0.0, 0.0, 1.0);
        let back = calibration.try_inverse().expect("a focal length");
        let rotation = |view: usize| {
            let rows = solution.views[view].rotation.expect("a pose");
            Matrix3::from_fn(|row, column| rows[row][column])
        };
        let mut first: Vec<Option<Vector3<f64>>> = vec![None; input.track_count()];
        let mut squared = Vec::new();
        for k in (0..input.observation_count()).filter(|&k| solution.observations.inlier[input.caller_index(k)]) {
            let (view, track, seen) = (input.view_of(k), input.track_of(k), Vector2::from(input.point_px(k)));
            match first[track] {
                None => first[track] = Some(rotation(view).tr_mul(&(back * seen.push(1.0)))),
                Some(direction) => {
                    let image = calibration * rotation(view) * direction;
                    squared.push((image.xy() / image.z - seen).norm_squared());
                }
            }
        }
        // P is K R, in the frame in which that of the first view is [I|0].
        let first_view = back.try_inverse().expect("a focal length") * rotation(0);
        let first_back = first_view.try_inverse().expect("a camera");
        for view in 0..input.view_count() {
            let rows = solution.views[view].projection.expect("a camera");
            assert!((0..3).all(|row| rows[row][3] == 0.0), "seed {seed}: {rows:?}");
            let found = Matrix3::from_fn(|row, column| rows[row][column]).normalize();
            let expected = (calibration * rotation(view) * first_back).normalize();
            let apart = (found - expected).norm().min((found + expected).norm());
            assert!(apart < 1e-9, "seed {seed}, view {view}: {found} {expected}");
        }
        let rms = (squared.iter().sum::<f64>() / squared.len() as f64).sqrt();
        println!("seed {seed}: {} transfers, {rms:.2} px", squared.len());
        // Two observations of one pixel of noise a coordinate are 2 apart, and a turn magnifies towards the edges.
        assert!(squared.len() > 500 && rms < 2.6, "seed {seed}: {rms} px");
    }
}

#[test]
fn tilted_views_of_a_plane_are_calibrated() {
    for seed in 0..3 {
        let options = SceneOptions { shape: Shape::Plane, noise: 0.001, outliers: 0.5, seed, ..default() };
        let (input, scene) = scene(options);
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        assert_calibrated(&solution, &scene, &format!("seed {seed}"));
        assert!(warns(&solution, WarningCode::PlanarScene), "seed {seed}");
        let with_point = solution.tracks.inlier.iter().zip(&solution.tracks.point).filter(|(inlier, _)| **inlier);
        assert!(with_point.clone().all(|(_, point)| point.is_some()), "seed {seed}");
    }
}

#[test]
fn what_is_static_in_the_image_is_not_the_scene() {
    for seed in 0..3 {
        let options = SceneOptions { noise: 0.001, outliers: 0.6, seed, ..default() };
        let (input, scene) = scene(options);
        let mut raw = input.to_raw();
        let place = |track: u32| Vector2::new(f64::from(track * 131 % 997), f64::from(track * 311 % 991));
        for k in 0..raw.x.len() {
            let (track, wobble) = (raw.track[k], 0.5 * (k as f64).sin());
            if !scene.truth.inlier[track as usize] {
                (raw.x[k], raw.y[k]) = (place(track).x + wobble, place(track).y - wobble);
            }
        }
        let input = Input::new(raw, &Limits::default(), "scene").expect("valid input");
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        assert_calibrated(&solution, &scene, &format!("seed {seed}"));
        let told = solution.warnings.iter().find(|warning| warning.code == WarningCode::StaticTracks);
        assert!(told.is_some_and(|told| told.detail.starts_with("120 tracks")), "seed {seed}: {told:?}");
        let all = SceneOptions { noise: 0.001, outliers: 0.0, seed, ..default() };
        let clean = solved(&super::scene(all).0, &SolveSettings::default());
        assert!(!warns(&clean, WarningCode::StaticTracks), "seed {seed}");
    }
}

fn default() -> SceneOptions {
    SceneOptions::default()
}
