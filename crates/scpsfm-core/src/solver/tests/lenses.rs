//! Whole solves through lenses that are not one known pinhole: distortion, a zoom, a focal length known beforehand.

use super::*;
use crate::domain::{Calibration, FocalPrior, LeftOut, LensProjection};
use crate::evaluation::bound::of_photographed;
use crate::synthetic::photographed::{
    FocalKind, LensKind, PhotographedMotion, PhotographedOptions, VisibilityKind, WrongKind,
};
use crate::synthetic::{Motion, Photographed};

#[test]
fn a_focal_length_known_beforehand_makes_a_translation_metric_after_all() {
    let options =
        SceneOptions { views: 6, tracks: 40, outliers: 0.0, max_rotation_rad: 0.0, ..SceneOptions::default() };
    let (input, scene) = scene(options);
    let mut raw = input.to_raw();
    let focal_px = 1.02 * scene.truth.focal_px;
    raw.views.iter_mut().for_each(|view| view.focal_prior = Some(FocalPrior { focal_px, sigma_log: 0.03 }));
    let solution = solved(&Input::new(raw, &Limits::default(), "scene").expect("valid"), &SolveSettings::default());
    assert_eq!((solution.status, solution.grade), (Status::Solved, Some(Grade::Weak)));
    let calibration = solution.calibrations[0];
    assert!((calibration.focal_px / focal_px - 1.0).abs() < 1e-3, "{calibration:?}");
    assert!((calibration.sigma_log_focal.expect("known") - 0.03).abs() < 0.005, "{calibration:?}");
    assert!(solution.warnings.iter().any(|warning| warning.code == WarningCode::PureTranslation));
    assert!(solution.views.iter().all(|view| view.rotation.is_some()));
}

/// Distorts every observation as a lens with this `k1` would.
fn distort(raw: &mut RawInput, scene: &Scene, radial_k1: f64) {
    let ([px, py], f) = (scene.truth.principal_point_px, scene.truth.focal_px);
    for k in 0..raw.x.len() {
        let (u, v) = ((raw.x[k] - px) / f, (raw.y[k] - py) / f);
        let scale = 1.0 + radial_k1 * (u * u + v * v);
        (raw.x[k], raw.y[k]) = (f * u * scale + px, f * v * scale + py);
    }
}

#[test]
fn a_distorting_lens_is_estimated_and_everything_reprojects_through_it() {
    for (seed, radial_k1) in [(1, -0.05), (2, -0.05), (3, 0.03)] {
        let options =
            SceneOptions { views: 6, tracks: 80, noise: 0.001, outliers: 0.5, seed, ..SceneOptions::default() };
        let (input, scene) = scene(options);
        let mut raw = input.to_raw();
        distort(&mut raw, &scene, radial_k1);
        let input = Input::new(raw.clone(), &Limits::default(), "scene").expect("valid input");
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        let calibration = solution.calibrations[0];
        let sigma = calibration.sigma_log_focal.expect("observable");
        println!(
            "seed {seed}: {calibration:?}, true {} px, {} inliers, {:?}, {:?}",
            scene.truth.focal_px,
            solution.inlier_track_count(),
            solution.grade,
            solution.warnings
        );
        assert!(focal_error(&solution, &scene) < 3.0 * sigma, "seed {seed}: {calibration:?}");
        assert!((calibration.radial_k1 - radial_k1).abs() < 0.02, "seed {seed}: {calibration:?}");
        let ([px, py], f) = (calibration.principal_point_px, calibration.focal_px);
        let mut residuals = Vec::new();
        for k in 0..raw.x.len() {
            let (pose, track) = (&solution.views[raw.view[k] as usize], raw.track[k] as usize);
            let Some(point) = solution.tracks.point[track].filter(|_| solution.observations.inlier[k]) else {
                continue;
            };
            let rows = pose.rotation.expect("a metric pose");
            let rotation = nalgebra::Matrix3::from_fn(|row, column| rows[row][column]);
            let seen = rotation * nalgebra::Vector3::from(point)
                + nalgebra::Vector3::from(pose.translation.expect("a metric pose"));
            let [x, y] = calibration.distort(seen.x / seen.z, seen.y / seen.z);
            residuals.push((f * x + px - raw.x[k]).hypot(calibration.aspect * f * y + py - raw.y[k]));
        }
        residuals.sort_by(f64::total_cmp);
        let median = residuals[residuals.len() / 2];
        println!("seed {seed}: median reprojection error {median:.2} px of {}", residuals.len());
        // Noise of 1 px a coordinate: 1.2 px in the median.
        assert!(median < 2.0, "seed {seed}: {median}");
    }
}

#[test]
fn a_zoom_gets_a_focal_length_a_view() {
    let options = SceneOptions { noise: 0.001, outliers: 0.5, tracks: 100, seed: 4, ..SceneOptions::default() };
    let (input, scene) = scene(options);
    let ([px, py], mut raw) = (scene.truth.principal_point_px, input.to_raw());
    let zoom = |view: u32| 1.0 + 0.08 * f64::from(view);
    for k in 0..raw.x.len() {
        raw.x[k] = px + zoom(raw.view[k]) * (raw.x[k] - px);
        raw.y[k] = py + zoom(raw.view[k]) * (raw.y[k] - py);
    }
    let input = Input::new(raw, &Limits::default(), "scene").expect("valid input");
    let solution = solved(&input, &SolveSettings { focal_per_view: true, ..SolveSettings::default() });
    assert_eq!(solution.grade, Some(Grade::Weak), "{:?}", solution.warnings);
    for (view, result) in solution.views.iter().enumerate() {
        let error = result.focal_px.expect("metric") / (zoom(view as u32) * scene.truth.focal_px) - 1.0;
        println!("view {view}: focal length off by {error:.4}");
        assert!(error.abs() < 0.02, "view {view}: {error}");
    }
    let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
    assert!(f1 > 0.98, "F1 {f1}");
}

/// Four cameras of one view each, behind strong lenses: what none carries alone, all carry together.
#[test]
fn cameras_of_one_view_each_are_calibrated_together() {
    let (mut beyond, mut calibrated) = (0, 0);
    for seed in 0..5 {
        let options = SceneOptions { seed, ..SceneOptions::four_cameras() };
        let (input, scene) = scene(options);
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        println!("seed {seed}: {:?} {:?}", solution.grade, solution.warnings);
        assert_eq!(solution.calibrations.len(), 4, "seed {seed}");
        calibrated += usize::from(solution.grade != Some(Grade::ProjectiveOnly));
        for (found, focal_px) in solution.calibrations.iter().zip(&scene.truth.focals_px) {
            let error = (found.focal_px / focal_px).ln().abs();
            println!(
                "  {:.1} px for {focal_px:.1}, k1 {:.3}, {error:.4} at {:?}",
                found.focal_px, found.radial_k1, found.sigma_log_focal
            );
            beyond += usize::from(error > 3.0 * found.sigma_log_focal.unwrap_or(f64::INFINITY));
        }
    }
    println!("{calibrated} of 5 calibrated, {beyond} of 20 focal lengths beyond 3 sigma");
    assert!(calibrated >= 4 && beyond <= 1, "{calibrated} {beyond}");
}

/// The same cameras declared as one: what no calibration of one camera fits is not told as certain.
#[test]
fn several_cameras_that_are_declared_as_one_are_not_metric_without_a_warning() {
    for seed in 0..8 {
        let mut raw = scene(SceneOptions { seed, ..SceneOptions::four_cameras() }).0.to_raw();
        raw.views.iter_mut().for_each(|view| view.camera_group = 0);
        let input = Input::new(raw, &Limits::default(), "scene").expect("valid");
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        let warned = solution.warnings.iter().any(|warning| warning.code == WarningCode::ModelMismatch);
        println!("seed {seed}: {:?}, {:?}", solution.grade, solution.warnings);
        assert!(solution.grade != Some(Grade::Metric) || warned, "seed {seed}");
    }
}

/// Two cameras that took pictures in turn, declared as one: METRIC, 34 % off, and WEAK, 41 % off at a sigma of 5 %,
/// while only the ratio to projective cameras asked whether a focal length a view fits better. Of the third the views
/// of the other camera had poses that a tenth of what they see agreed with.
#[test]
fn no_view_of_two_cameras_that_are_declared_as_one_refutes_the_focal_length() {
    for seed in [910_018, 910_034, 910_089] {
        let scene = Photographed::generate(&PhotographedOptions::drawn(seed)).expect("valid");
        let mut raw = scene.input.clone();
        raw.views.iter_mut().for_each(|view| view.camera_group = 0);
        let input = Input::new(raw, &Limits::default(), "scene").expect("valid");
        let solution = solved(&input, &SolveSettings::default());
        println!("seed {seed}: {:?}, {:?}", solution.grade, solution.warnings);
        if seed == 910_089 {
            let few = |reason| matches!(reason, LeftOut::NotRegistered { points, agreeing } if 3 * agreeing < points);
            let contradicted = solution.views.iter().filter(|view| view.left_out.is_some_and(few)).count();
            assert_eq!((solution.grade, contradicted), (Some(Grade::Metric), 17));
        }
        let Some(calibration) = solution.calibrations.first() else { continue };
        let sigma = calibration.sigma_log_focal.unwrap_or(f64::INFINITY);
        for view in solution.registered_views() {
            let error = (calibration.focal_px / scene.truth.focals_px[view]).ln().abs();
            assert!(error <= 3.0 * sigma, "seed {seed}, view {view}: {error} at a sigma of {sigma}");
        }
    }
}

fn solved_photographed(options: &PhotographedOptions) -> (Photographed, Solution) {
    let scene = Photographed::generate(options).expect("valid options");
    let input = Input::new(scene.input.clone(), &Limits::default(), "scene").expect("valid input");
    let solution = solved(&input, &SolveSettings::default());
    (scene, solution)
}

/// By how much the log focal length of each camera is off, and its sigma; all must be calibrated.
fn errors_of_cameras(solution: &Solution, scene: &Photographed) -> Vec<(f64, f64)> {
    let error = |(group, calibration): (u32, Option<&Calibration>)| {
        let calibration = calibration.expect("calibrated");
        let view = solution.views.iter().position(|view| view.camera_group == group).expect("a view of it");
        let error = (calibration.focal_px / scene.truth.focals_px[view]).ln().abs();
        (error, calibration.sigma_log_focal.expect("observable"))
    };
    solution.cameras().into_iter().map(error).collect()
}

/// More views than a calibration is compared with projective cameras on, from two cameras in turn: each knows poses and
/// points from the other, too.
#[test]
fn cameras_of_many_views_are_calibrated_together() {
    for seed in 0..3 {
        let options = PhotographedOptions {
            views: 46,
            tracks: 230,
            lens: LensKind::Pinhole,
            focal_px: 1100.0,
            focal: FocalKind::TwoGroups,
            ..fisheye(PhotographedMotion::Orbit, seed)
        };
        let scene = Photographed::generate(&options).expect("valid options");
        let bound = of_photographed(&scene).expect("bounded").into_iter().fold(0.0, f64::max);
        let input = Input::new(scene.input.clone(), &Limits::default(), "scene").expect("valid input");
        let solution = solved(&input, &SolveSettings::default());
        assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}: {:?}", solution.warnings);
        let mut least = f64::INFINITY;
        for (error, sigma) in errors_of_cameras(&solution, &scene) {
            println!("seed {seed}: off by {error:.5}, sigma {sigma:.5}, bound {bound:.5}");
            assert!(error < 3.0 * sigma, "seed {seed}: {error} for {sigma}");
            least = least.min(sigma);
        }
        // Windows of one in twenty differ by chance. Each camera by itself has 1.6 bounds and more.
        assert!(least < 1.3 * bound, "seed {seed}: {least} for {bound}");
    }
}

/// What fits behind the seed's pinhole is not what fits behind the lens: of two cameras on a drive.
#[test]
fn a_strong_lens_is_calibrated_from_what_fits_behind_it() {
    for seed in 0..3 {
        let options = PhotographedOptions {
            views: 16,
            motion: PhotographedMotion::Drive,
            turn_rad: PhotographedOptions::drawn(seed).turn_rad,
            lens: LensKind::ActionCamera,
            focal_px: 1100.0,
            focal: FocalKind::TwoGroups,
            radial: [-0.25, 0.05],
            wrong_share: 0.2,
            ..fisheye(PhotographedMotion::Drive, seed)
        };
        let (scene, solution) = solved_photographed(&options);
        println!("seed {seed}: {:?} {:?}", solution.grade, solution.warnings);
        assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}");
        for (error, sigma) in errors_of_cameras(&solution, &scene) {
            println!("  off by {error:.5}, sigma {sigma:.5}");
            assert!(error < 0.02 && error < 3.0 * sigma, "seed {seed}: {error} for {sigma}");
            // .0022 of one camera by what fits behind the seed's pinhole.
            assert!(seed > 0 || sigma < 0.002, "{sigma}");
        }
    }
}

/// Ten views behind an equidistant fisheye of 150 degrees, three of ten tracks wrong.
fn fisheye(motion: PhotographedMotion, seed: u64) -> PhotographedOptions {
    PhotographedOptions {
        views: 10,
        tracks: 200,
        motion,
        turn_rad: 0.6,
        lens: LensKind::Fisheye,
        focal_px: 764.0,
        focal: FocalKind::ConstantFocal,
        principal_point: [0.0; 2],
        aspect: 1.0,
        radial: [0.0; 2],
        noise_px: 0.5,
        visibility: VisibilityKind::Banded,
        lifetime: (5, 10),
        wrong: WrongKind::Permuted,
        wrong_share: 0.3,
        ..PhotographedOptions::drawn(seed)
    }
}

/// A scene with depth, a turning camera and a plane; the turning camera is refused without a search behind lenses.
#[test]
fn a_fisheye_is_found_and_calibrated() {
    for motion in [PhotographedMotion::Orbit, PhotographedMotion::PureRotation, PhotographedMotion::PlanarScene] {
        for seed in 0..3 {
            let scene = Photographed::generate(&fisheye(motion, seed)).expect("valid options");
            let input = Input::new(scene.input.clone(), &Limits::default(), "scene").expect("valid input");
            let solution = solved(&input, &SolveSettings::default());
            let calibration = solution.calibrations.first().copied();
            println!("{motion:?}, seed {seed}: {:?} {calibration:?} {:?}", solution.grade, solution.warnings);
            assert_eq!(solution.grade, Some(Grade::Metric), "{motion:?}, seed {seed}");
            let calibration = calibration.expect("metric");
            let sigma = calibration.sigma_log_focal.expect("observable");
            assert_eq!(calibration.lens_projection, LensProjection::Fisheye, "{motion:?}, seed {seed}");
            assert!((calibration.focal_px / 764.0).ln().abs() < 4.0 * sigma, "{motion:?}, seed {seed}");
        }
    }
}

/// A camera that only turned, three of ten tracks wrong.
fn turning(seed: u64, radial_k1: f64) -> SceneOptions {
    let motion = Motion::PureRotation;
    SceneOptions { motion, radial_k1, noise: 0.0005, outliers: 0.3, seed, ..SceneOptions::default() }
}

/// A camera that turns behind a strong barrel lens: one that moves about a bowl behind a pincushion lens fits nearly as
/// well. It was METRIC, off by a factor of 2.3.
#[test]
fn a_turning_barrel_lens_is_not_taken_for_a_pincushion_lens() {
    for (seed, radial_k1) in (4..=6).flat_map(|seed| [-0.45, -0.5].map(|k1| (seed, k1))) {
        let (input, scene) = scene(SceneOptions { focal_range_px: (900.0, 900.0), ..turning(seed, radial_k1) });
        let solution = solved(&input, &SolveSettings::default());
        let calibration = solution.calibrations.first();
        println!("seed {seed}, k1 {radial_k1}: {:?} {calibration:?} {:?}", solution.grade, solution.warnings);
        assert!(calibration.is_some(), "seed {seed}, k1 {radial_k1}: {:?}", solution.warnings);
        assert!(focal_error(&solution, &scene) < 0.02, "seed {seed}, k1 {radial_k1}");
    }
}

/// A pincushion lens that moves observations far outwards is right where the camera only turned. Homographies miss by
/// 13 standard deviations in the last scene, which was METRIC and off by 40 %: with depth, as a camera that moved.
#[test]
fn a_turning_pincushion_lens_is_calibrated() {
    for (seed, radial_k1) in (1..=3).flat_map(|seed| [0.1, 0.3].map(|k1| (seed, k1))).chain([(61, 0.3)]) {
        let (input, scene) = scene(turning(seed, radial_k1));
        let solution = solved(&input, &SolveSettings::default());
        println!("seed {seed}, k1 {radial_k1}: {:?} {:?}", solution.grade, solution.warnings);
        assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}, k1 {radial_k1}");
        assert!(focal_error(&solution, &scene) < 0.01, "seed {seed}, k1 {radial_k1}");
    }
}

/// The distortion of a fisheye tells its focal length where the camera does not turn. These were PROJECTIVE_ONLY.
#[test]
fn a_camera_that_does_not_turn_is_calibrated_behind_a_fisheye() {
    for seed in [820_140, 820_253, 820_776] {
        let options = PhotographedOptions::drawn(seed);
        assert_eq!((options.motion, options.lens), (PhotographedMotion::Translation, LensKind::Fisheye), "seed {seed}");
        let (scene, solution) = solved_photographed(&options);
        println!("seed {seed}: {:?} {:?}", solution.grade, solution.warnings);
        assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}");
        for (error, sigma) in errors_of_cameras(&solution, &scene) {
            println!("  off by {error:.5}, sigma {sigma:.5}");
            assert!(error < 4.0 * sigma, "seed {seed}: {error} for {sigma}");
        }
    }
}

/// A perspective lens leaves the focal length free where the camera does not turn, however much it distorts: it is not
/// to be taken for a fisheye, whose distortion would tell it.
#[test]
fn a_translation_behind_a_lens_that_distorts_is_not_metric() {
    for (lens, focal_px, radial) in
        [(LensKind::Barrel, 1400.0, [-0.12, 0.0]), (LensKind::ActionCamera, 1100.0, [-0.25, 0.05])]
    {
        for seed in 0..3 {
            let options =
                PhotographedOptions { lens, focal_px, radial, ..fisheye(PhotographedMotion::Translation, seed) };
            let (_, solution) = solved_photographed(&options);
            println!("{lens:?}, seed {seed}: {:?} {:?}", solution.grade, solution.calibrations.first());
            assert_ne!(solution.grade, Some(Grade::Metric), "{lens:?}, seed {seed}: {:?}", solution.calibrations);
        }
    }
    // An equidistant fisheye of 1.5 times the focal length bends as the barrel lens does: WEAK, off by half at 6 sigma.
    // Wrong observations fit a principal point outside the image behind the mild one: METRIC, off by 13 % at 6.6 sigma.
    // Two cameras' equal distortion is that of fisheyes of 22 and 31 degrees: WEAK, off by a factor of 2.1 at 19 sigma.
    for (seed, lens) in [(820_818, LensKind::Barrel), (910_082, LensKind::Mild), (940_002, LensKind::Mild)] {
        let options = PhotographedOptions::drawn(seed);
        assert_eq!((options.motion, options.lens), (PhotographedMotion::Translation, lens));
        let (_, solution) = solved_photographed(&options);
        assert_eq!(solution.grade, Some(Grade::ProjectiveOnly), "{seed}: {:?}", solution.calibrations);
    }
}
