//! Intrinsics beyond the focal length, and what is known of it beforehand.

use std::cell::Cell;

use nalgebra::Vector2;

use super::*;
use crate::geometry::bundle::metric::Extension;
use crate::solver::calibration::models::{Candidate, Selection};

#[test]
fn a_displaced_principal_point_is_found_and_a_central_one_is_left_alone() {
    for seed in 0..4 {
        let mut scene = testing::scene(seed, 10, 60, 0.0);
        scene.intrinsics.principal_point = Vector2::new(0.05, -0.03);
        let mut rng = rand::SeedableRng::seed_from_u64(seed);
        scene.observe(0.001, &mut rng);
        let outcome = calibrated(&scene, seed, 0.001);
        let found = outcome.intrinsics().expect("a metric reconstruction");
        println!("seed {seed}: {found:?}, true {:?}, {:?}", scene.intrinsics, codes(&outcome));
        assert!(outcome.model.contains(Extension::PrincipalPoint), "seed {seed}");
        assert!((found.principal_point - scene.intrinsics.principal_point).norm() < 0.01, "seed {seed}");
        assert!(focal_error(&outcome, &scene) < 0.01, "seed {seed}");

        let central = calibrated(&testing::scene(seed, 10, 60, 0.001), seed, 0.001);
        assert_eq!(central.model, IntrinsicsModel::FOCAL, "seed {seed}");
    }
}

/// Sigma grows by what a camera is unlike others, so that only one that is well determined is METRIC.
#[test]
fn an_implausible_camera_is_less_certain() {
    for seed in 0..4 {
        // Of as many standard deviations in y and none in x.
        for (deviations, noise, is_metric) in [(2.0, 1e-4, true), (10.0, 1e-4, true), (10.0, 1e-2, false)] {
            let mut scene = testing::scene(seed, 10, 60, 0.0);
            let options = CalibrationOptions::DEFAULT;
            scene.intrinsics.principal_point.y = deviations * options.lenses.principal_point_sigma;
            scene.observe(noise, &mut rand::SeedableRng::seed_from_u64(seed));
            let before = calibrated(&scene, seed, noise);
            let mut after = before.clone();
            // Asked twice, it doubts once.
            let found = before.intrinsics().expect("metric");
            (0..2).for_each(|_| after.doubt_implausible(&found, None, &options, SIDE_PX));
            let ratio = after.sigma_log_focal.expect("determined") / before.sigma_log_focal.expect("determined");
            println!("seed {seed}, {deviations} at {noise}: {ratio}, {:?}, {:?}", after.grade, codes(&after));
            assert_eq!((before.grade, after.grade == Grade::Metric), (Grade::Metric, is_metric), "seed {seed}");
            let expected = if deviations > 3.0 { deviations * 0.5f64.sqrt() } else { 1.0 };
            assert!((ratio / expected - 1.0).abs() < 0.1, "seed {seed}: {ratio} for {expected}");
            assert_eq!(codes(&after).contains(&"MODEL_MISMATCH"), expected > 1.0, "seed {seed}");
            // A focal length that is known beforehand is no less known.
            let focal_prior = FocalPrior { focal_px: found.focal * SIDE_PX, sigma_log: 1e-3 };
            let mut known = Outcome { sigma_log_focal: Some(0.9e-3), ..before };
            known.doubt_implausible(&found, Some(focal_prior), &options, SIDE_PX);
            assert!(known.sigma_log_focal < Some(1e-3), "seed {seed}: {:?}", known.sigma_log_focal);
        }
    }
}

/// Scenes seen through a distorting lens, only what falls into the image.
fn through_a_lens(seed: u64, radial: f64, principal_point: Vector2<f64>, noise: f64) -> TestScene {
    let mut scene = testing::scene(seed, 10, 80, 0.0);
    scene.intrinsics.radial[0] = radial;
    scene.intrinsics.principal_point = principal_point;
    scene.observe(noise, &mut rand::SeedableRng::seed_from_u64(seed));
    scene.crop();
    scene
}

#[test]
fn radial_distortion_is_found_with_a_displaced_principal_point_too() {
    for radial in [-0.05, -0.3] {
        let mut beyond = 0;
        for seed in 0..20 {
            let displaced = testing::direction::<2>(seed).map(|value| (0.03 * value).clamp(-0.05, 0.05));
            let scene = through_a_lens(seed, radial, displaced, 0.001);
            let begun = std::time::Instant::now();
            let outcome = calibrated(&scene, seed, 0.001);
            let error = focal_error(&outcome, &scene);
            let sigma = outcome.sigma_log_focal.unwrap_or(f64::INFINITY);
            let found = outcome.intrinsics().expect("metric");
            println!(
                "k1 {radial}, seed {seed}: error {error:.5}, {:.1} sigma of {sigma:.5}, {:?}, k1 {:.4}, pp off by {:.4}, {} {:?} {:.2} in {:?}",
                error / sigma,
                outcome.grade,
                found.radial[0],
                (found.principal_point - displaced).norm(),
                outcome.model.name(),
                codes(&outcome),
                outcome.rms_ratio,
                begun.elapsed()
            );
            let warned = codes(&outcome).contains(&"MODEL_MISMATCH");
            beyond += usize::from(error > 3.0 * sigma && !warned);
        }
        println!("k1 {radial}: {beyond} of 20 beyond three sigma and without a warning");
        assert!(beyond <= 1, "k1 {radial}: {beyond} of 20");
    }
}

#[test]
fn a_second_radial_term_is_taken_where_the_lens_has_one_and_only_there() {
    let (mut taken, mut taken_in_vain, mut beyond) = (0, 0, 0);
    for seed in 0..20 {
        for second_radial in [0.2, 0.0] {
            let mut scene = testing::scene(seed, 10, 200, 0.0);
            scene.intrinsics.radial = [-0.25, second_radial, 0.0];
            scene.observe(0.0005, &mut rand::SeedableRng::seed_from_u64(seed));
            scene.crop();
            let outcome = calibrated(&scene, seed, 0.0005);
            let (error, sigma) = (focal_error(&outcome, &scene), outcome.sigma_log_focal.unwrap_or(f64::INFINITY));
            let found = outcome.intrinsics().expect("metric");
            println!(
                "seed {seed}, k2 {second_radial}: {} k1 {:.4} k2 {:.4}, error {error:.5}, {:.1} sigma, {:?}",
                outcome.model.name(),
                found.radial[0],
                found.radial[1],
                error / sigma,
                codes(&outcome)
            );
            let is_taken = outcome.model.contains(Extension::RadialK2);
            assert!(!is_taken || outcome.model.contains(Extension::RadialK1), "seed {seed}");
            match second_radial == 0.0 {
                true => taken_in_vain += usize::from(is_taken),
                false => taken += usize::from(is_taken),
            }
            beyond += usize::from(error > 3.0 * sigma);
        }
    }
    println!(
        "taken in {taken} of 20 lenses that have it and {taken_in_vain} of 20 that have not, {beyond} beyond 3 sigma"
    );
    assert!(taken >= 15 && taken_in_vain <= 1 && beyond <= 1, "{taken} {taken_in_vain} {beyond}");
}

/// Terms that few lenses have are found in those, at a principal point that they would displace, and in no others.
#[test]
fn tangential_distortion_and_a_third_radial_term_are_taken_only_where_the_lens_has_them() {
    let lenses = [
        ([-0.2, 0.1, 0.0], [0.0, 0.0], None),
        ([-0.2, 0.1, 0.0], [0.004, -0.003], Some(Extension::Tangential)),
        ([-0.3, 0.1, 0.4], [0.0, 0.0], Some(Extension::RadialK3)),
    ];
    for (radial, tangential, extension) in lenses {
        let (mut taken, mut in_vain, mut beyond) = (0, 0, 0);
        for seed in 0..10 {
            let mut scene = testing::scene(seed, 12, 300, 0.0);
            (scene.intrinsics.radial, scene.intrinsics.tangential) = (radial, tangential);
            scene.intrinsics.principal_point = Vector2::new(0.01, -0.02);
            scene.observe(0.0003, &mut rand::SeedableRng::seed_from_u64(seed));
            scene.crop();
            let outcome = calibrated(&scene, seed, 0.0003);
            let found = outcome.intrinsics().expect("metric");
            let deviations = Parameter::ALL.map(|parameter| {
                let error = found.value(parameter) - scene.intrinsics.value(parameter);
                outcome.sigma(parameter).map_or(0.0, |sigma| error.abs() / sigma)
            });
            println!("{extension:?}, seed {seed}: {}, {deviations:.1?} sigma", outcome.model.name());
            let rare = [Extension::Tangential, Extension::RadialK3].map(|rare| (rare, outcome.model.contains(rare)));
            taken += rare.iter().filter(|(rare, is_taken)| *is_taken && extension == Some(*rare)).count();
            in_vain += rare.iter().filter(|(rare, is_taken)| *is_taken && extension != Some(*rare)).count();
            beyond += deviations.iter().filter(|deviation| **deviation > 3.5).count();
        }
        println!("{extension:?}: taken in {taken} of 10, others in {in_vain}, {beyond} values beyond 3.5 sigma");
        assert!(taken >= if extension.is_some() { 8 } else { 0 } && in_vain <= 1 && beyond <= 2, "{extension:?}");
    }
}

/// The lens estimated so far: what the observations ask for is kept or found, and nothing else is left of it.
#[test]
fn the_lens_that_a_reconstruction_comes_with_does_not_matter() {
    for seed in 0..10 {
        for radial in [0.0, -0.2] {
            let scene = through_a_lens(seed, radial, Vector2::zeros(), 0.001);
            let outcomes =
                [(0.0, 0.0, 1.0), (-0.2, 0.0, 1.0), (-0.1, 0.02, 1.03)].map(|(radial, off_centre, aspect)| {
                    let mut metric = scene.reconstruction();
                    let lens = &mut metric.intrinsics[0];
                    (lens.radial[0], lens.aspect) = (radial, aspect);
                    lens.principal_point = Vector2::new(off_centre, -off_centre);
                    calibrated_from(&scene, &metric, 0.001)
                });
            let sigma = outcomes[0].sigma_log_focal.expect("determined");
            for outcome in &outcomes {
                println!("k1 {radial}, seed {seed}: {:?} {}", outcome.sigma_log_focal, outcome.model.name());
                assert_eq!(outcome.model.contains(Extension::RadialK1), radial != 0.0, "k1 {radial}, seed {seed}");
                assert_eq!(outcome.model, outcomes[0].model, "k1 {radial}, seed {seed}");
                let metric = outcome.metric.as_ref().expect("a metric reconstruction");
                assert_eq!(metric.model(), outcome.model, "k1 {radial}, seed {seed}");
                let [own, other] = [outcome, &outcomes[0]].map(|of| of.intrinsics().expect("metric").focal);
                assert!((own / other).ln().abs() < 0.05 * sigma, "k1 {radial}, seed {seed}: {own} and {other}");
            }
        }
    }
}

/// A lens with a needless radial term keeps it where cameras turn by a twentieth of a degree, and loses it where they
/// turn by one. Steps are two of what is compared with, and the adjustments: one or some of the minimum, two for each
/// of four other focal lengths, and those of other models.
#[test]
fn nothing_else_is_tried_where_the_lens_leaves_the_focal_length_open() {
    let (mut open, mut determined) = (0, 0);
    for (max_rotation_rad, seed) in (0..20).map(|seed| (0.001, seed)).chain((0..5).map(|seed| (0.02, seed))) {
        let scene = testing::scene_turning(seed, 60, 0.001, max_rotation_rad);
        let mut metric = scene.reconstruction();
        metric.intrinsics[0].radial[0] = -0.01;
        let points: Vec<Vector4<f64>> = scene.points.iter().map(|point| point.push(1.0)).collect();
        let cameras = scene.cameras();
        let steps = Cell::new(0);
        let heartbeat = &|| steps.set(steps.get() + 1);
        let problem = Uncalibrated { heartbeat, ..of_one_lens(&cameras, &points, &scene.observations, 0.001) };
        let Outcome { grade, sigma_log_focal, model, .. } = only(from_metric(&problem, &metric, None));
        let steps = steps.get();
        let of = format!("turning by {max_rotation_rad}, seed {seed}");
        println!("{of}: {grade:?} {sigma_log_focal:?} after {steps} steps, {}", model.name());
        if (3..10).contains(&steps) {
            open += 1;
            assert_eq!((grade, model), (Grade::ProjectiveOnly, metric.model()), "{of}");
        }
        if grade != Grade::ProjectiveOnly {
            determined += 1;
            assert!(steps > 10 && model == IntrinsicsModel::FOCAL, "{of}");
        }
    }
    assert!(open > 0 && determined > 0, "{open} open, {determined} determined");
}

/// Poses and points were adjusted to a focal length that is not the best, as where a descent ended on its way.
#[test]
fn what_a_descent_still_had_to_go_is_part_of_its_error() {
    for seed in 0..10 {
        let scene = testing::scene(seed, 10, 60, 0.001);
        let points: Vec<Vector4<f64>> = scene.points.iter().map(|point| point.push(1.0)).collect();
        let cameras = scene.cameras();
        let problem = of_one_lens(&cameras, &points, &scene.observations, 0.001);
        let search = |priors, model, start| problem.search(priors).converged(start, model);
        let priors = problem.priors(0.001);
        let converged = search(&priors, IntrinsicsModel::FOCAL, scene.reconstruction()).reconstruction;
        let fit = Fit::projective(0.0, &problem, scene.points.len(), 0);
        let at = |factor: f64| {
            let start = converged.clone().with_scaled_focals(factor);
            let minimum = search(&priors, IntrinsicsModel::FIXED, start);
            let best = Candidate::new(minimum, IntrinsicsModel::FOCAL, priors.clone(), &problem);
            let may_be_observable = problem.may_be_observable(&best, &fit);
            let sigmas = problem.sigmas(&Selection::of(best), &priors, 1.0);
            (may_be_observable, sigmas.of_group[0][Parameter::LogFocal as usize].expect("determined"))
        };
        let ((_, there), (is_near, near), (is_far, far)) = (at(1.0), at(1.03), at(1.5));
        println!("seed {seed}: {there:.5}, {near:.5} {is_near}, {far:.5} {is_far}");
        assert!(there < 0.005 && is_near && !is_far, "seed {seed}");
        assert!((0.02..0.06).contains(&near), "seed {seed}: {near}");
    }
}

#[test]
fn a_lens_without_distortion_is_left_without() {
    for seed in 0..10 {
        let scene = through_a_lens(seed, 0.0, Vector2::zeros(), 0.001);
        let outcome = calibrated(&scene, seed, 0.001);
        let found = outcome.intrinsics().expect("metric");
        println!("seed {seed}: {} {:?}", outcome.model.name(), codes(&outcome));
        assert_eq!(found.radial[0], 0.0, "seed {seed}");
    }
}

#[test]
fn a_prior_makes_a_translation_weak_and_never_metric() {
    for motion in [Motion::Translation, Motion::Forward] {
        for seed in 0..10 {
            let scene = testing::scene_of(seed, 10, 30, 0.001, motion, false);
            let focal_px = scene.intrinsics.focal * SIDE_PX * 1.01;
            for sigma_log in [0.02, 0.001] {
                let outcome = calibrated_knowing(&scene, seed, 0.001, Some(FocalPrior { focal_px, sigma_log }));
                println!(
                    "{motion:?}, seed {seed}: {:?} {:?} {:?}",
                    outcome.grade, outcome.sigma_log_focal, outcome.warnings
                );
                assert_eq!(outcome.grade, Grade::Weak, "{motion:?}, seed {seed}");
                let sigma = outcome.sigma_log_focal.expect("known beforehand");
                assert!((0.02..0.03).contains(&sigma), "{motion:?}, seed {seed}: {sigma}");
                assert!(codes(&outcome).contains(&"PURE_TRANSLATION"), "{motion:?}, seed {seed}");
                assert!(focal_error(&outcome, &scene) < 0.02, "{motion:?}, seed {seed}");
            }
        }
    }
}

#[test]
fn a_prior_helps_where_the_motion_says_little_and_is_contradicted_where_it_says_much() {
    for seed in 0..5 {
        let weak = testing::scene_turning(seed, 40, 0.001, 0.05);
        let focal_px = weak.intrinsics.focal * SIDE_PX;
        let alone = calibrated(&weak, seed, 0.001).sigma_log_focal.unwrap_or(f64::INFINITY);
        let helped = calibrated_knowing(&weak, seed, 0.001, Some(FocalPrior { focal_px, sigma_log: 0.05 }));
        println!("seed {seed}: sigma {alone} alone, {:?} with a prior", helped.sigma_log_focal);
        assert!(helped.sigma_log_focal.expect("known") < 0.051_f64.max(1.1 * alone), "seed {seed}");

        let strong = testing::scene(seed, 10, 60, 0.001);
        let off = strong.intrinsics.focal * SIDE_PX * 1.3;
        let outcome = calibrated_knowing(&strong, seed, 0.001, Some(FocalPrior { focal_px: off, sigma_log: 0.02 }));
        println!("seed {seed}: {:?} {:?} {:?}", outcome.grade, outcome.sigma_log_focal, outcome.warnings);
        assert!(codes(&outcome).contains(&"FOCAL_PRIOR_CONTRADICTED"), "seed {seed}: {:?}", outcome.warnings);
        assert!(focal_error(&outcome, &strong) < 3.0 * outcome.sigma_log_focal.expect("observable"), "seed {seed}");
    }
}

/// A prior at the true focal length, however sure, takes nothing from what the observations say, and lifts the grade by
/// one step at most.
#[test]
fn a_right_prior_lifts_the_grade_by_one_step_or_not_at_all() {
    let rank = |grade: Grade| [Grade::ProjectiveOnly, Grade::Weak, Grade::Metric].iter().position(|of| *of == grade);
    let mut lifted = 0;
    for (turning, seed) in
        [0.02, 0.05, 0.1, 0.2].into_iter().flat_map(|turning| (0..3).map(move |seed| (turning, seed)))
    {
        let scene = testing::scene_turning(seed, 40, 0.001, turning);
        let alone = calibrated(&scene, seed, 0.001);
        for sigma_log in [0.005, 0.01, 0.02] {
            let prior = FocalPrior { focal_px: scene.intrinsics.focal * SIDE_PX, sigma_log };
            let helped = calibrated_knowing(&scene, seed, 0.001, Some(prior));
            println!("turning {turning}, seed {seed}, {sigma_log}: {:?} to {:?}", alone.grade, helped.grade);
            let [from, to] = [alone.grade, helped.grade].map(rank);
            assert!(from <= to && to <= from.map(|from| from + 1), "{:?} to {:?}", alone.grade, helped.grade);
            lifted += usize::from(from < to);
        }
    }
    assert!(lifted > 0, "no scene leaves anything to a prior");
}

/// However far away what the tracks say is.
#[test]
fn what_the_tracks_say_against_a_prior_is_what_they_say_without_it() {
    for seed in 0..5 {
        let scene = testing::scene(seed, 10, 60, 0.001);
        let alone = calibrated(&scene, seed, 0.001).intrinsics().expect("a calibration").focal * SIDE_PX;
        let off = FocalPrior { focal_px: scene.intrinsics.focal * SIDE_PX * 0.6, sigma_log: 0.001 };
        let outcome = calibrated_knowing(&scene, seed, 0.001, Some(off));
        let told = outcome.warnings.iter().find_map(|warning| {
            let figure = warning.detail.strip_prefix("the tracks alone give a focal length of ")?;
            figure.split(' ').next()?.parse::<f64>().ok()
        });
        let told = told.unwrap_or_else(|| panic!("seed {seed}: {:?}", outcome.warnings));
        assert!((told / alone).ln().abs() < 0.02, "seed {seed}: {told} for {alone}, {:?}", outcome.warnings);
    }
}

#[test]
fn an_orbit_about_one_axis_leaves_the_principal_point_open() {
    for seed in 0..5 {
        let mut scene = testing::scene(seed, 10, 40, 0.0);
        testing::orbit(&mut scene, 0.8);
        scene.observe(0.001, &mut rand::SeedableRng::seed_from_u64(seed));
        let outcome = calibrated(&scene, seed, 0.001);
        println!("seed {seed}: {:?} {:?} {:?}", outcome.grade, outcome.sigma_log_focal, outcome.warnings);
        assert!(codes(&outcome).contains(&"PRINCIPAL_POINT_UNOBSERVABLE"), "seed {seed}: {:?}", outcome.warnings);
    }
}

/// The terms of the other projection's series are no doubt about those of this one.
#[test]
fn the_sigmas_of_a_fisheyes_terms_are_of_its_own_series() {
    for seed in 0..5 {
        let mut scene = testing::scene(seed, 10, 200, 0.0);
        scene.intrinsics = Intrinsics { radial: [0.1, 0.0, 0.0], ..Intrinsics::equidistant(1.0) };
        scene.observe(0.0005, &mut rand::SeedableRng::seed_from_u64(seed));
        scene.crop();
        let outcome = calibrated_from_truth(&scene, 0.0005);
        let (error, sigma) = (focal_error(&outcome, &scene), outcome.sigma_log_focal.expect("observable"));
        let found = outcome.intrinsics().expect("metric");
        let of_k1 = outcome.sigma(Parameter::RadialK1).expect("free");
        println!(
            "seed {seed}: {:?}, off by {error:.4} at {sigma:.4}, k1 {:.4} at {of_k1:.4}",
            outcome.grade, found.radial[0]
        );
        assert!(outcome.grade == Grade::Metric && error < 4.0 * sigma, "seed {seed}");
        assert!((found.radial[0] - 0.1).abs() < 4.0 * of_k1 && of_k1 < 0.05, "seed {seed}");
    }
}

/// The distortion of a fisheye tells its focal length where the camera does not turn. Where noise hides it, the motion is
/// the reason for the refusal.
#[test]
fn a_fisheye_that_does_not_turn_is_told_the_reason_where_it_is_refused() {
    for (noise, is_refused) in [(0.0003, false), (0.005, true)] {
        for seed in 0..3 {
            let mut scene = testing::scene_of(seed, 10, 200, 0.0, Motion::Translation, false);
            scene.intrinsics = Intrinsics::equidistant(1.0);
            scene.observe(noise, &mut rand::SeedableRng::seed_from_u64(seed));
            scene.crop();
            let outcome = calibrated_from_truth(&scene, noise);
            println!(
                "noise {noise}, seed {seed}: {:?} {:?} {:?}",
                outcome.grade,
                outcome.sigma_log_focal,
                codes(&outcome)
            );
            assert_eq!(outcome.grade == Grade::ProjectiveOnly, is_refused, "noise {noise}, seed {seed}");
            assert_eq!(codes(&outcome).contains(&"PURE_TRANSLATION"), is_refused, "noise {noise}, seed {seed}");
        }
    }
}
