//! Complete inputs whose right tracks hold wrong observations, and reconstructions that cannot be metric.

use super::*;
use crate::synthetic::Motion;

#[test]
fn right_tracks_that_each_hold_wrong_observations_calibrate() {
    for (outliers, wrong_observations) in [(0.0, 1), (0.0, 3), (0.5, 2), (0.7, 1)] {
        for seed in 0..2 {
            let (input, scene) = scene(SceneOptions { outliers, wrong_observations, seed, ..SceneOptions::default() });
            let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
            let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
            let of_observations = agreement(&solution.observations.inlier, &scene.truth.observation_right);
            println!("{outliers} wrong, {wrong_observations} of ten, seed {seed}: F1 {f1}, {of_observations:?}");
            assert_eq!(solution.grade, Some(Grade::Metric), "{outliers} {wrong_observations} seed {seed}");
            assert!(f1 > 0.98, "{outliers} {wrong_observations} seed {seed}: F1 {f1}");
            assert!(of_observations.precision > 0.99 && of_observations.recall > 0.97, "{of_observations:?}");
            assert!(focal_error(&solution, &scene) < 0.02, "{outliers} {wrong_observations} seed {seed}");
        }
    }
}

/// Depths or none, an input goes one way: where an observation of every track is missing, blocks of complete tracks
/// hold few of the views, and the others join them; what is wrong within right tracks is told apart.
#[test]
fn tracks_with_depths_reach_every_view() {
    for (deleted_observations, wrong_observations) in [(1, 0), (1, 1), (0, 1), (0, 2), (0, 3)] {
        for seed in 0..2 {
            let options = SceneOptions { outliers: 0.3, with_depths: true, seed, ..SceneOptions::default() };
            let (input, scene) = scene(SceneOptions { deleted_observations, wrong_observations, ..options });
            let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
            let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
            let of_observations = agreement(&solution.observations.inlier, &scene.truth.observation_right);
            let case = format!("{deleted_observations} deleted, {wrong_observations} wrong, seed {seed}");
            println!("{case}: F1 {f1}, {of_observations:?}");
            assert_eq!(solution.grade, Some(Grade::Metric), "{case}");
            assert!(f1 > 0.98, "{case}: F1 {f1}");
            assert!(solution.views.iter().all(|view| view.projection.is_some()), "seed {seed}: views are left out");
            assert!(of_observations.precision > 0.99 && of_observations.recall > 0.97, "seed {seed}");
        }
    }
}

/// Tracks that neighbouring views alone see: no block of complete tracks holds all views. In the scene of 40 views the
/// focal length that fits best is many times too long, and under it a metric extension breaks into parts.
#[test]
fn a_translation_with_missing_data_is_one_projective_reconstruction_of_all_views() {
    for (views, seed) in [(16, 0), (16, 1), (40, 700_000)] {
        let (input, scene) = scene(SceneOptions {
            views,
            tracks: 30 * views,
            noise: 5e-4,
            outliers: 0.3,
            motion: Motion::PureTranslation,
            seen_views: 5,
            seed,
            ..SceneOptions::default()
        });
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        assert_eq!(solution.grade, Some(Grade::ProjectiveOnly), "{views} views, seed {seed}");
        let in_first = solution.views.iter().filter(|view| view.projection.is_some() && view.part == 0).count();
        let of_observations = agreement(&solution.observations.inlier, &scene.truth.observation_right);
        println!("{views} views, seed {seed}: {in_first} views, {of_observations:?}");
        assert!(in_first + 1 >= views, "seed {seed}: {in_first} of {views} views");
        assert!(of_observations.f1 > 0.95, "{views} views, seed {seed}: {of_observations:?}");
    }
}

/// What is said of the noise of single observations weighs them: with six times the noise on every other one, the focal
/// length is surer and nearer to the truth than where nothing is said.
#[test]
fn observations_count_by_the_sigma_that_is_given() {
    use rand::{Rng, SeedableRng};
    const NOISE_PX: f64 = 0.5;
    const MORE_PX: f64 = 3.0;
    // Squared error and sigma, summed over the scenes.
    let (mut with, mut without) = ((0.0, 0.0), (0.0, 0.0));
    for seed in 0..10 {
        let noise = NOISE_PX / 1000.0;
        let options = SceneOptions {
            views: 8,
            tracks: 120,
            outliers: 0.1,
            deleted_observations: 1,
            noise,
            seed,
            ..SceneOptions::default()
        };
        let (input, scene) = scene(options);
        let mut raw = input.to_raw();
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        for k in (0..raw.x.len()).step_by(2) {
            let mut more = || MORE_PX * 12f64.sqrt() * (rng.random::<f64>() - 0.5);
            (raw.x[k], raw.y[k]) = (raw.x[k] + more(), raw.y[k] + more());
        }
        let solved = |raw: &RawInput| {
            let input = Input::new(raw.clone(), &Limits::default(), "scene").expect("valid");
            let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
            let sigma = solution.calibrations[0].sigma_log_focal.expect("observable");
            let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
            println!(
                "seed {seed}: focal length off by {:.5}, sigma {sigma:.5}, F1 {f1}",
                focal_error(&solution, &scene)
            );
            assert!(f1 > 0.97, "seed {seed}: F1 {f1}");
            (focal_error(&solution, &scene).powi(2), sigma)
        };
        let nothing_said = solved(&raw);
        without = (without.0 + nothing_said.0, without.1 + nothing_said.1);
        raw.sigma = (0..raw.x.len()).map(|k| if k % 2 == 0 { NOISE_PX.hypot(MORE_PX) } else { NOISE_PX }).collect();
        let said = solved(&raw);
        with = (with.0 + said.0, with.1 + said.1);
    }
    println!("{with:?} with, {without:?} without");
    assert!(with.0 < 0.8 * without.0 && with.1 < 0.75 * without.1, "{with:?} {without:?}");
}
