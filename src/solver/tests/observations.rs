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

/// Tracks that neighbouring views alone see: no block of complete tracks holds all views.
#[test]
fn a_translation_with_missing_data_is_one_projective_reconstruction_of_all_views() {
    for seed in 0..2 {
        let (input, scene) = scene(SceneOptions {
            views: 16,
            tracks: 400,
            noise: 5e-4,
            outliers: 0.2,
            motion: Motion::PureTranslation,
            seen_views: 5,
            seed,
            ..SceneOptions::default()
        });
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        assert_eq!(solution.grade, Some(Grade::ProjectiveOnly), "seed {seed}");
        let registered = solution.views.iter().filter(|view| view.projection.is_some()).count();
        let of_observations = agreement(&solution.observations.inlier, &scene.truth.observation_right);
        println!("seed {seed}: {registered} views, {of_observations:?}");
        assert!(registered >= 15, "seed {seed}: {registered} of 16 views");
        assert!(of_observations.f1 > 0.95, "seed {seed}: {of_observations:?}");
    }
}
