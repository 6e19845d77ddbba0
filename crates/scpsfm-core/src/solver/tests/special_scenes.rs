//! Whole solves of planes, of cameras that only turn, and of tracks that stay where they are in the image.

use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::domain::ImageSize;
use crate::geometry::bundle::testing::normal;
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
fn a_camera_that_stands_still_among_wrong_tracks_is_told_so() {
    for seed in 0..3 {
        let (_, scene) = scene(SceneOptions { noise: 0.001, outliers: 0.3, seed, ..default() });
        let mut raw = scene.input.clone();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut first = vec![None; raw.track_count];
        for k in 0..raw.view.len() {
            let track = raw.track[k] as usize;
            let (x, y) = *first[track].get_or_insert((raw.x[k], raw.y[k]));
            if scene.truth.inlier[track] {
                (raw.x[k], raw.y[k]) = (x + normal(&mut rng), y + normal(&mut rng));
            }
        }
        let input = Input::new(raw, &Limits::default(), "still").expect("valid input");
        let solution = solved(&input, &SolveSettings::default());
        assert_eq!(solution.grade, Some(Grade::ProjectiveOnly), "seed {seed}: {:?}", solution.warnings);
        assert!(solution.calibrations.is_empty(), "seed {seed}");
        assert!(warns(&solution, WarningCode::LittleMotion), "seed {seed}: {:?}", solution.warnings);
        let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
        assert!(f1 > 0.98, "seed {seed}: F1 {f1}");
    }
}

/// All around, most views share nothing: each joins by the directions that its neighbours know.
#[test]
fn a_full_turn_registers_every_view() {
    const VIEWS: usize = 24;
    const FOCAL_PX: f64 = 1000.0;
    for seed in 0..3 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut noise = || (0..4).map(|_| rng.random::<f64>() - 0.5).sum::<f64>();
        let rotation = |view: usize| {
            let turn = std::f64::consts::TAU * view as f64 / VIEWS as f64;
            Rotation3::from_euler_angles(0.1 * (2.0 * turn).sin(), 0.0, 0.05 * (3.0 * turn).cos())
                * Rotation3::from_axis_angle(&Vector3::y_axis(), turn)
        };
        let sized = View { size: Some(ImageSize { width_px: 1600, height_px: 1200 }), ..View::default() };
        let mut raw = RawInput { views: vec![sized; VIEWS], track_count: 900, ..RawInput::default() };
        for track in 0..raw.track_count {
            let around = std::f64::consts::TAU * (track as f64 * 0.618).fract();
            let direction = Vector3::new(around.sin(), 0.8 * noise(), around.cos());
            for view in 0..VIEWS {
                let seen = rotation(view) * direction;
                let image = seen.xy() / seen.z * FOCAL_PX;
                if seen.z > 0.0 && image.x.abs() < 790.0 && image.y.abs() < 590.0 {
                    // Three in ten have nothing to do with a direction.
                    let wrong = if track % 10 < 3 { 200.0 } else { 0.0 };
                    raw.view.push(view as u32);
                    raw.track.push(track as u32);
                    raw.x.push(799.5 + image.x + (0.5 + wrong) * noise());
                    raw.y.push(599.5 + image.y + (0.5 + wrong) * noise());
                }
            }
        }
        let input = Input::new(raw, &Limits::default(), "turn").expect("valid input");
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        let found = &solution.calibrations[0];
        println!("seed {seed}: {:?}, {found:?}, {:?}", solution.grade, solution.warnings);
        assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}: {:?}", solution.warnings);
        let (error, sigma) = ((found.focal_px / FOCAL_PX).ln().abs(), found.sigma_log_focal.expect("observable"));
        assert!(error < 3.5 * sigma, "seed {seed}: {error}, {sigma}");
        assert!(warns(&solution, WarningCode::PureRotation), "seed {seed}: {:?}", solution.warnings);
        let registered = solution.views.iter().filter(|view| view.rotation.is_some()).count();
        assert_eq!(registered, VIEWS, "seed {seed}: {:?}", solution.warnings);
        assert!(solution.views.iter().all(|view| view.translation == Some([0.0; 3])), "seed {seed}");
        // Two observations of a direction verify each other as little as two of a point.
        let ranges = input.track_ranges();
        let verifiable: Vec<usize> =
            (0..input.track_count()).filter(|&track| ranges[track + 1] - ranges[track] >= 3).collect();
        let of = |holds: &dyn Fn(usize) -> bool| verifiable.iter().map(|&track| holds(track)).collect::<Vec<bool>>();
        let f1 = agreement(&of(&|track| solution.tracks.inlier[track]), &of(&|track| track % 10 >= 3)).f1;
        assert!(f1 > 0.98, "seed {seed}: F1 {f1}");
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

/// A camera that does not turn sees points infinitely far away at one place of the image, as it does a watermark.
#[test]
fn what_is_static_before_a_camera_that_does_not_turn_is_not_the_scene_either() {
    for seed in 0..3 {
        let options = SceneOptions { motion: Motion::PureTranslation, noise: 0.001, outliers: 0.4, seed, ..default() };
        let (input, scene) = scene(options);
        let mut raw = input.to_raw();
        for k in 0..raw.x.len() {
            let track = raw.track[k];
            if !scene.truth.inlier[track as usize] {
                (raw.x[k], raw.y[k]) = (f64::from(track * 131 % 997), f64::from(track * 311 % 991));
            }
        }
        let input = Input::new(raw, &Limits::default(), "scene").expect("valid input");
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        let found = agreement(&solution.tracks.inlier, &scene.truth.inlier);
        assert!(found.precision > 0.99 && found.recall > 0.95, "seed {seed}: {found:?}");
        assert!(warns(&solution, WarningCode::StaticTracks), "seed {seed}");
    }
}

/// Of a square of 1000 px 5 px are assumed; `noise_px` replaces them.
#[test]
fn noise_far_above_the_assumed_one_gives_a_warning() {
    for seed in 0..2 {
        let told = |noise: f64, noise_px: Option<f64>| {
            let (input, _) = scene(SceneOptions { noise, outliers: 0.3, seed, ..default() });
            let solution = solved(&input, &SolveSettings { seed, noise_px, ..SolveSettings::default() });
            assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}: {:?}", solution.warnings);
            warns(&solution, WarningCode::HighNoise)
        };
        let found = [(0.003, None), (0.02, None), (0.02, Some(15.0)), (0.003, Some(1.0))];
        assert_eq!(found.map(|(noise, noise_px)| told(noise, noise_px)), [false, true, false, true], "seed {seed}");
    }
}

fn default() -> SceneOptions {
    SceneOptions::default()
}
