//! A focal length a view.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::geometry::bundle::metric::Intrinsics;
use crate::geometry::statistics::root_mean_square;

/// A scene whose focal length changes from view to view by factors of up to `exp(range)` either way, and these focal
/// lengths.
fn zooming(seed: u64, tracks: usize, noise: f64, range: f64) -> (TestScene, Vec<f64>) {
    zooming_behind(0.0, seed, tracks, noise, range)
}

/// The same behind a lens of this `k1`.
fn zooming_behind(radial: f64, seed: u64, tracks: usize, noise: f64, range: f64) -> (TestScene, Vec<f64>) {
    let mut scene = testing::scene(seed, 10, tracks, 0.0);
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x2003);
    let focals: Vec<f64> = (0..10)
        .map(|_| {
            let zoom = if range > 0.0 { rand::Rng::random_range(&mut rng, -range..range) } else { 0.0 };
            scene.intrinsics.focal * f64::exp(zoom)
        })
        .collect();
    for seen in &mut scene.observations {
        let intrinsics = Intrinsics { radial, ..Intrinsics::from_focal(focals[seen.camera]) };
        let image = intrinsics.project(&scene.poses[seen.camera].apply(&scene.points[seen.point]));
        let mut noisy = || noise * testing::normal(&mut rng);
        seen.xy = image + nalgebra::Vector2::new(noisy(), noisy());
    }
    (scene, focals)
}

fn calibrated(scene: &TestScene, seed: u64, noise: f64) -> Outcome {
    calibrated_as(true, scene, seed, noise)
}

fn calibrated_as(focal_per_view: bool, scene: &TestScene, seed: u64, noise: f64) -> Outcome {
    // Any projective frame of any cameras near the truth is adjusted to the observations.
    let (cameras, points) = projective_problem(scene, seed);
    let problem = Problem { focal_per_view, ..of_one_lens(&cameras, &points, &scene.observations, noise) };
    calibrate(&problem, SIDE_PX, &StopToken::default()).expect("nothing stops it")
}

#[test]
fn every_view_gets_its_focal_length() {
    for range in [0.0, 0.5] {
        let (mut calibrated_well, mut deviations) = (0, Vec::new());
        for seed in 0..10 {
            let (scene, focals) = zooming(seed, 60, 0.001, range);
            let begun = std::time::Instant::now();
            let outcome = calibrated(&scene, seed, 0.001);
            let found = outcome.focals.as_deref().unwrap_or_default();
            let errors: Vec<f64> = found.iter().zip(&focals).map(|(found, focal)| (found.focal / focal).ln()).collect();
            let rms = root_mean_square(&errors).expect("ten views");
            let sigma = outcome.sigma_log_focal.unwrap_or(f64::INFINITY);
            println!(
                "range {range}, seed {seed}: {:?}, errors {rms:.4} rms, sigma {sigma:.4}, rms ratio {:.2}, {:?} in {:?}",
                outcome.grade,
                outcome.rms_ratio,
                codes(&outcome),
                begun.elapsed()
            );
            // Never METRIC: a lens that is not estimated is part of sigma.
            assert_ne!(outcome.grade, Grade::Metric, "seed {seed}");
            calibrated_well += usize::from(outcome.grade == Grade::Weak && rms < 0.02);
            if outcome.grade == Grade::Weak {
                deviations.push(rms / sigma);
            }
        }
        let beyond = deviations.iter().filter(|deviation| **deviation > 3.0).count();
        println!("range {range}: {calibrated_well} of 10 well, {beyond} of {} beyond three sigma", deviations.len());
        assert!(calibrated_well >= 9 && beyond <= 1, "range {range}");
    }
}

/// A lens that is not estimated beside focal lengths moves them: by 15 % for a k1 of -.1.
#[test]
fn what_a_lens_moves_is_part_of_sigma() {
    let (mut told, mut beyond, mut warned) = (0, 0, 0);
    for (radial, range) in [(-0.1, 0.0), (-0.1, 0.2), (-0.2, 0.0), (-0.2, 0.2), (0.1, 0.2)] {
        for seed in 0..4 {
            let (scene, focals) = zooming_behind(radial, seed, 200, 0.001, range);
            let outcome = calibrated(&scene, seed, 0.001);
            let found = outcome.focals.as_deref().filter(|_| outcome.grade != Grade::ProjectiveOnly);
            let deviations: Vec<f64> = (found.unwrap_or_default().iter().zip(&focals))
                .filter_map(|(found, focal)| Some((found.focal / focal).ln().abs() / found.sigma_log?))
                .collect();
            println!("k1 {radial}, range {range}, seed {seed}: {:?}, {deviations:.1?} sigma", outcome.grade);
            told += deviations.len();
            beyond += deviations.iter().filter(|deviation| **deviation > 3.0).count();
            warned += usize::from(!outcome.warnings.is_empty());
        }
    }
    println!("{told} views told, {beyond} beyond three sigma, {warned} of 20 scenes with a warning");
    assert_eq!((beyond, warned), (0, 20));
}

/// One focal length for views that zoom is that of none of them.
#[test]
fn a_zoom_that_is_taken_for_one_focal_length_is_not_told_as_one() {
    let (mut refused, mut beyond) = (0, 0);
    for range in [0.05, 0.1, 0.2, 0.4] {
        for seed in 0..5 {
            let (scene, focals) = zooming(seed, 200, 0.0005, range);
            let outcome = calibrated_as(false, &scene, seed, 0.0005);
            let focal = outcome.metric.as_ref().map_or(f64::NAN, |metric| metric.intrinsics.focal);
            let errors: Vec<f64> = focals.iter().map(|own| (focal / own).ln()).collect();
            let error = root_mean_square(&errors).expect("ten views");
            let sigma = outcome.sigma_log_focal.unwrap_or(f64::INFINITY);
            println!("range {range}, seed {seed}: {:?}, off by {error:.3}, sigma {sigma:.3}", outcome.grade);
            refused += usize::from(outcome.grade == Grade::ProjectiveOnly);
            beyond += usize::from(outcome.grade != Grade::ProjectiveOnly && error > 3.0 * sigma);
        }
    }
    println!("{refused} of 20 refused, {beyond} told beyond three sigma");
    assert_eq!(beyond, 0);
}

#[test]
fn critical_motions_are_refused_with_a_focal_length_a_view_too() {
    for (motion, planar) in
        [(Motion::Translation, false), (Motion::Forward, false), (Motion::Rotation, false), (Motion::General, true)]
    {
        for seed in 0..3 {
            let scene = testing::scene_of(seed, 10, 40, NOISE, motion, planar);
            let outcome = calibrated(&scene, seed, NOISE);
            println!("{motion:?}, planar {planar}, seed {seed}: {:?}", codes(&outcome));
            assert_eq!(outcome.grade, Grade::ProjectiveOnly, "{motion:?}, planar {planar}, seed {seed}");
        }
    }
}

#[test]
fn the_plane_at_infinity_goes_with_the_zoom() {
    let (scene, _) = zooming(3, 60, 1e-5, 0.3);
    let (cameras, points) = projective_problem(&scene, 3);
    let problem = Problem { focal_per_view: true, ..of_one_lens(&cameras, &points, &scene.observations, 1e-5) };
    let outcome = calibrate(&problem, SIDE_PX, &StopToken::default()).expect("nothing stops it");
    let plane_at_infinity = outcome.plane_at_infinity.expect("a plane");
    let focals = outcome.focals.expect("a focal length a view");
    let frame = to_first_view_frame(&cameras, &[]).expect("rank 3");
    let daq = Daq::new(focals[0].focal, plane_at_infinity);
    for (camera, focal) in frame.cameras.iter().zip(&focals) {
        let (found, cost) = daq::zoomed(camera, &daq).expect("a focal length");
        assert!((found / focal.focal - 1.0).abs() < 1e-3 && cost < 1e-5, "{found} {focal:?} {cost}");
    }
}

#[test]
fn a_view_that_shows_too_little_has_no_focal_length_and_takes_none_from_the_others() {
    for seed in 0..3 {
        let (mut scene, focals) = zooming(seed, 60, 0.001, 0.3);
        // Three points determine less than the seven unknowns of a view.
        scene.observations.retain(|seen| seen.camera != 4 || seen.point < 3);
        let outcome = near_truth(&scene, &focals, 0.001);
        let found = outcome.focals.as_deref().expect("a focal length a view");
        println!("seed {seed}: {:?} {:?} {:?}", outcome.grade, outcome.sigma_log_focal, outcome.warnings);
        assert_eq!(outcome.grade, Grade::Weak, "seed {seed}");
        assert!(outcome.sigma_log_focal.is_some_and(|sigma| sigma < 0.1), "seed {seed}");
        assert!(codes(&outcome).contains(&"UNOBSERVABLE_FOCAL"), "seed {seed}");
        for (view, (found, focal)) in found.iter().zip(&focals).enumerate() {
            assert_eq!(found.sigma_log.is_none(), view == 4, "seed {seed}, view {view}: {found:?}");
            let error = (found.focal / focal).ln().abs();
            assert!(view == 4 || error < 0.05, "seed {seed}, view {view}: {error}");
        }
        // Of all but four there is nothing to say.
        scene.observations.retain(|seen| seen.camera < 4 || seen.point < 3);
        let outcome = near_truth(&scene, &focals, 0.001);
        assert_eq!(outcome.grade, Grade::ProjectiveOnly, "seed {seed}: {:?}", outcome.warnings);
    }
}

/// What a reconstruction near the true one is calibrated to.
fn near_truth(scene: &TestScene, focals: &[f64], noise: f64) -> Outcome {
    let zooming = Zooming { focals: focals.to_vec(), poses: scene.poses.clone(), points: scene.points.clone() };
    let points: Vec<Vector4<f64>> = zooming.points.iter().map(|point| point.push(1.0)).collect();
    let cameras = zooming.cameras();
    let problem = Problem { focal_per_view: true, ..of_one_lens(&cameras, &points, &scene.observations, noise) };
    from_zooming(&problem, &zooming, SIDE_PX, &StopToken::default(), &mut || {}).expect("nothing stops it")
}
