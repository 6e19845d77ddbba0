//! Calibrations of synthetic scenes, in a projective frame as the search would hand them over.

mod coverage;
mod critical;
mod models;
mod view_focals;

use std::sync::LazyLock;

use super::*;
use crate::domain::StopReason;
use crate::geometry::bundle::testing::{self, Motion, NOISE, TestScene};
use crate::geometry::observation::Observation;

const SIDE_PX: f64 = 1000.0;
static NEVER_STOPPED: LazyLock<StopToken> = LazyLock::new(StopToken::default);

/// A scene as the solver would hand it over: in a projective frame of its own, adjusted to the noisy observations.
fn projective_problem(scene: &TestScene, seed: u64) -> (Vec<Matrix3x4<f64>>, Vec<Vector4<f64>>) {
    let (mut cameras, mut points) = testing::projectively_transformed(scene, seed);
    projective::adjust(&mut cameras, &mut points, &scene.observations, &Options::squared(40), &StopToken::default());
    (cameras, points)
}

/// Nothing known beforehand, one focal length.
pub fn of_one_lens<'a>(
    cameras: &'a [Matrix3x4<f64>],
    points: &'a [Vector4<f64>],
    observations: &'a [Observation],
    noise: f64,
) -> Uncalibrated<'a> {
    let group_of = &[0; 64][..cameras.len()];
    let options = &CalibrationOptions::DEFAULT;
    Uncalibrated {
        cameras,
        points,
        observations,
        noise,
        outlier_density: 1.0,
        group_of,
        focal_priors: &[None],
        focal_per_view: false,
        scale_px: SIDE_PX,
        options,
        stop: &NEVER_STOPPED,
        heartbeat: &|| (),
    }
}

/// The thresholds are those of the problem's options.
#[test]
fn the_options_bound_the_grades() {
    let scene = testing::scene(1, 10, 60, 1e-3);
    let (cameras, points) = projective_problem(&scene, 1);
    let grade = |metric_below: f64, weak_up_to: f64| {
        let mut options = CalibrationOptions::DEFAULT;
        (options.grades.metric_below, options.grades.weak_up_to) = (metric_below, weak_up_to);
        let problem = Uncalibrated { options: &options, ..of_one_lens(&cameras, &points, &scene.observations, 1e-3) };
        only(calibrate(&problem)).grade
    };
    assert_eq!(grade(0.02, 0.1), Grade::Metric);
    assert_eq!(grade(1e-9, 0.1), Grade::Weak);
    assert_eq!(grade(1e-9, 1e-9), Grade::ProjectiveOnly);
}

/// A point so far out that no gradient leads it back is triangulated anew, and would else cost many times the noise.
#[test]
fn a_diverged_point_does_not_bend_the_minimum() {
    for seed in 0..5 {
        let scene = testing::scene(seed, 6, 40, 1e-3);
        let (cameras, points) = projective_problem(&scene, seed);
        let converged = |start: &MetricReconstruction, diverged_above: f64| {
            let mut options = CalibrationOptions::DEFAULT;
            options.search.diverged_above = diverged_above;
            let problem =
                Uncalibrated { options: &options, ..of_one_lens(&cameras, &points, &scene.observations, 1e-3) };
            let priors = [IntrinsicsPrior::NONE];
            problem.search(&priors).converged(start.clone(), IntrinsicsModel::FOCAL)
        };
        let start = scene.reconstruction();
        let bound = CalibrationOptions::DEFAULT.search.diverged_above;
        let expected = converged(&start, bound);
        let mut diverged = start.clone();
        let centre = start.poses[0].rotation.tr_mul(&-start.poses[0].translation);
        let distance = |point: &usize| (start.points[*point] - centre).norm();
        let farthest = (0..40).max_by(|a, b| distance(a).total_cmp(&distance(b))).expect("points");
        diverged.points[farthest] = centre + (start.points[farthest] - centre) * 1e7;
        let (found, left) = (converged(&diverged, bound), converged(&diverged, f64::INFINITY));
        let difference = found.log_focal() - expected.log_focal();
        println!("seed {seed}: {:e}, {:e}, left {:e}; {difference:e}", expected.cost, found.cost, left.cost);
        assert!(left.cost > 3.0 * expected.cost, "seed {seed}");
        assert!((found.cost / expected.cost - 1.0).abs() < 1e-4 && difference.abs() < 1e-4, "seed {seed}");
    }
}

fn calibrated(scene: &TestScene, seed: u64, noise: f64) -> Outcome {
    calibrated_knowing(scene, seed, noise, None)
}

fn calibrated_knowing(scene: &TestScene, seed: u64, noise: f64, focal_prior: Option<FocalPrior>) -> Outcome {
    let (cameras, points) = projective_problem(scene, seed);
    let focal_priors = &[focal_prior];
    let problem = Uncalibrated { focal_priors, ..of_one_lens(&cameras, &points, &scene.observations, noise) };
    only(calibrate(&problem))
}

/// The calibration of a sequence that grew to where the truth is: what a search costs is left out.
fn calibrated_from_truth(scene: &TestScene, noise: f64) -> Outcome {
    calibrated_from(scene, &scene.reconstruction(), noise)
}

/// The same of one that grew to this.
fn calibrated_from(scene: &TestScene, metric: &MetricReconstruction, noise: f64) -> Outcome {
    let points: Vec<Vector4<f64>> = scene.points.iter().map(|point| point.push(1.0)).collect();
    let cameras = scene.cameras();
    let problem = of_one_lens(&cameras, &points, &scene.observations, noise);
    only(from_metric(&problem, metric, None))
}

/// The outcome of the only camera group.
fn only(outcomes: Result<Vec<Outcome>, Error>) -> Outcome {
    let mut outcomes = outcomes.expect("nothing stops it");
    assert_eq!(outcomes.len(), 1);
    outcomes.remove(0)
}

fn focal_error(outcome: &Outcome, scene: &TestScene) -> f64 {
    let found = outcome.intrinsics().expect("a metric reconstruction");
    (found.focal / scene.intrinsics.focal - 1.0).abs()
}

fn codes(outcome: &Outcome) -> Vec<&'static str> {
    outcome.warnings.iter().map(|warning| warning.code.name()).collect()
}

#[test]
fn general_motion_is_calibrated() {
    let mut errors = Vec::new();
    for seed in 0..12 {
        let scene = testing::scene(seed, 10, 20, NOISE);
        let begun = std::time::Instant::now();
        let outcome = calibrated(&scene, seed, NOISE);
        let error = focal_error(&outcome, &scene);
        println!(
            "seed {seed}: error {error:.5}, sigma {:?}, {:?}, rms ratio {:.3}, {:?} {:?} in {:?}",
            outcome.sigma_log_focal,
            outcome.grade,
            outcome.rms_ratio,
            outcome.model,
            codes(&outcome),
            begun.elapsed()
        );
        assert_ne!(outcome.grade, Grade::ProjectiveOnly, "seed {seed}");
        assert!(error < 5.0 * outcome.sigma_log_focal.expect("observable"), "seed {seed}");
        errors.push(error);
    }
    errors.sort_by(f64::total_cmp);
    let median = 0.5 * (errors[5] + errors[6]);
    println!("median {median:.5}, worst {:.5}", errors[11]);
    assert!(median <= 0.005 && errors[11] <= 0.05, "{errors:?}");
}

#[test]
fn little_turning_costs_certainty_not_honesty() {
    for amplitude in [0.1, 0.02] {
        for seed in 0..5 {
            let scene = testing::scene_turning(seed, 40, 0.001, amplitude);
            let outcome = calibrated(&scene, seed, 0.001);
            let error = focal_error(&outcome, &scene);
            println!(
                "amplitude {amplitude}, seed {seed}: error {error:.4}, {:?} {:?} {:?}",
                outcome.sigma_log_focal,
                outcome.grade,
                codes(&outcome)
            );
            let sigma = outcome.sigma_log_focal.expect("some turning");
            assert!(error < 4.0 * sigma, "seed {seed}: {error} {sigma}");
        }
    }
}

#[test]
fn exact_input_is_judged_like_any_other() {
    for seed in 0..3 {
        let general = testing::scene(seed, 10, 20, 0.0);
        let outcome = calibrated(&general, seed, 0.0);
        println!("seed {seed}: {:?} {:?} {}", outcome.grade, outcome.warnings, outcome.rms_ratio);
        assert_eq!((outcome.grade, codes(&outcome)), (Grade::Metric, vec![]), "seed {seed}");
        assert!(focal_error(&outcome, &general) < 1e-5, "seed {seed}");
        for (motion, planar) in [(Motion::Rotation, false), (Motion::General, true)] {
            let special = testing::scene_of(seed, 10, 20, 0.0, motion, planar);
            let outcome = calibrated(&special, seed, 0.0);
            println!("{motion:?}, planar {planar}, seed {seed}: {:?} {:?}", outcome.sigma_log_focal, outcome.warnings);
            assert_eq!(outcome.grade, Grade::Metric, "{motion:?}, planar {planar}, seed {seed}");
            assert!(focal_error(&outcome, &special) < 1e-4, "{motion:?}, planar {planar}, seed {seed}");
        }
        for motion in [Motion::Translation, Motion::Forward] {
            let outcome = calibrated(&testing::scene_of(seed, 10, 20, 0.0, motion, false), seed, 0.0);
            println!("{motion:?}, seed {seed}: {:?} {:?}", outcome.sigma_log_focal, outcome.warnings);
            assert_eq!(outcome.grade, Grade::ProjectiveOnly, "{motion:?}, seed {seed}");
        }
    }
}

#[test]
fn a_wrong_assumption_about_the_noise_changes_neither_focal_length_nor_refusal() {
    for assumed in [NOISE / 5.0, NOISE * 5.0] {
        let scene = testing::scene(4, 10, 20, NOISE);
        let outcome = calibrated(&scene, 4, assumed);
        println!("assumed {assumed}: {:?} {:?} {:?}", outcome.grade, outcome.sigma_log_focal, codes(&outcome));
        assert!(focal_error(&outcome, &scene) < 0.02);
        assert_ne!(outcome.grade, Grade::ProjectiveOnly);
        for (motion, planar) in [(Motion::Rotation, false), (Motion::General, true)] {
            let special = testing::scene_of(4, 10, 20, NOISE, motion, planar);
            let outcome = calibrated(&special, 4, assumed);
            let (error, sigma) = (focal_error(&outcome, &special), outcome.sigma_log_focal.expect("observable"));
            assert!(error < 4.0 * sigma, "{motion:?}, planar {planar}, assumed {assumed}: {error}, {sigma}");
        }
        let outcome = calibrated(&testing::scene_of(4, 10, 20, NOISE, Motion::Translation, false), 4, assumed);
        assert_eq!(outcome.grade, Grade::ProjectiveOnly, "assumed {assumed}");
    }
}

#[test]
fn three_views_are_graded_honestly() {
    for seed in 0..6 {
        let scene = testing::scene(seed, 3, 40, NOISE);
        let outcome = calibrated(&scene, seed, NOISE);
        let error = focal_error(&outcome, &scene);
        println!(
            "seed {seed}: error {error:.4}, sigma {:?}, {:?} {:?}",
            outcome.sigma_log_focal,
            outcome.grade,
            codes(&outcome)
        );
        if outcome.grade != Grade::ProjectiveOnly {
            assert!(error < 5.0 * outcome.sigma_log_focal.expect("graded"), "seed {seed}");
        }
    }
}

#[test]
fn many_points_are_all_adjusted() {
    let scene = testing::scene(2, 8, 400, NOISE);
    let outcome = calibrated(&scene, 2, NOISE);
    assert!(focal_error(&outcome, &scene) < 0.01);
    let metric = outcome.metric.expect("a metric reconstruction");
    assert_eq!(metric.points.len(), 400);
    let squared: f64 = scene.observations.iter().map(|seen| metric.residual(seen).norm_squared()).sum();
    let rms = (squared / (2 * scene.observations.len()) as f64).sqrt();
    assert!(rms < 1.05 * NOISE, "{rms}");
}

#[test]
fn hostile_input_is_refused_without_panic() {
    let scene = testing::scene(1, 4, 12, NOISE);
    let (cameras, points) = projective_problem(&scene, 1);
    let run = |cameras: &[Matrix3x4<f64>], points: &[Vector4<f64>], observations: &[Observation], noise| {
        let problem = of_one_lens(cameras, points, observations, noise);
        only(calibrate(&problem))
    };
    let nothing = run(&[], &[], &[], NOISE);
    assert_eq!(nothing.grade, Grade::ProjectiveOnly);
    assert!(codes(&nothing).contains(&"FEW_INLIERS"));
    assert_eq!(run(&cameras, &points, &[], NOISE).grade, Grade::ProjectiveOnly);
    assert_eq!(run(&cameras[..1], &points, &scene.observations, NOISE).grade, Grade::ProjectiveOnly);
    let nan = vec![Matrix3x4::from_element(f64::NAN); 4];
    assert_eq!(run(&nan, &points, &scene.observations, NOISE).grade, Grade::ProjectiveOnly);
    let zero = vec![Vector4::zeros(); 12];
    assert_eq!(run(&cameras, &zero, &scene.observations, NOISE).grade, Grade::ProjectiveOnly);
    let huge: Vec<_> = cameras.iter().map(|camera| camera * 1e200).collect();
    run(&huge, &points, &scene.observations, NOISE);
    run(&cameras, &points, &scene.observations, 0.0);
    let mut undefined = testing::scene_of(1, 4, 12, NOISE, Motion::Rotation, false).observations;
    undefined.iter_mut().filter(|seen| seen.point < 3).for_each(|seen| seen.xy.x = f64::NAN);
    run(&cameras, &points, &undefined, NOISE);
}

#[test]
fn a_stopped_token_ends_it() {
    let scene = testing::scene(1, 4, 12, NOISE);
    let (cameras, points) = projective_problem(&scene, 1);
    let stop = StopToken::default();
    let problem = Uncalibrated { stop: &stop, ..of_one_lens(&cameras, &points, &scene.observations, NOISE) };
    stop.stop(StopReason::Cancelled);
    assert_eq!(calibrate(&problem).map(|_| ()), Err(Error::Stopped(StopReason::Cancelled)));
}
