//! Inputs on which something holds under one geometry that says nothing of it.

use super::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A group: as many tracks as this that follow a wrong one, each observation moved by so much.
struct WrongGroup {
    tracks: usize,
    jitter_px: f64,
}

/// A scene with groups about its first wrong tracks; and the truth of every track, those of the groups last.
fn with_groups(options: SceneOptions, groups: &[WrongGroup]) -> (Input, Vec<bool>) {
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let (input, scene) = scene(options);
    let mut raw = input.to_raw();
    let mut truth = scene.truth.inlier.clone();
    let wrong: Vec<usize> = (0..truth.len()).filter(|&track| !truth[track]).collect();
    let observations = raw.x.len();
    for (group, &followed) in groups.iter().zip(&wrong) {
        // The sum of three has a standard deviation of a half.
        let mut moved = || 2.0 * group.jitter_px * (0..3).map(|_| rng.random::<f64>() - 0.5).sum::<f64>();
        let of_followed: Vec<usize> = (0..observations).filter(|&k| raw.track[k] as usize == followed).collect();
        for _ in 0..group.tracks {
            for &k in &of_followed {
                raw.view.push(raw.view[k]);
                raw.track.push(raw.track_count as u32);
                raw.x.push(raw.x[k] + moved());
                raw.y.push(raw.y[k] + moved());
            }
            raw.track_count += 1;
            truth.push(false);
        }
    }
    (Input::new(raw, &Limits::default(), "scene").expect("valid"), truth)
}

fn by_geometry(input: &Input) -> Solution {
    solved(input, &SolveSettings { method: Method::Geometry, ..SolveSettings::default() })
}

#[test]
fn near_duplicates_of_a_wrong_track_outvote_no_right_ones() {
    for (seed, jitter_px) in [(0, 0.1), (1, 0.3), (2, 1.0), (3, 3.0)] {
        let options = SceneOptions { tracks: 105, outliers: 30.0 / 105.0, seed, ..SceneOptions::default() };
        let (input, truth) = with_groups(options, &[WrongGroup { tracks: 100, jitter_px }]);
        let solution = by_geometry(&input);
        let f1 = agreement(&solution.tracks.inlier, &truth).f1;
        assert!(f1 > 0.97, "seed {seed}, jitter {jitter_px} px: F1 {f1}");
    }
}

#[test]
fn groups_verify_no_more_than_a_track_each() {
    let many = vec![WrongGroup { tracks: 60, jitter_px: 0.3 }, WrongGroup { tracks: 40, jitter_px: 1.0 }];
    // Fewer than are represented by one, and so many that too few would remain beside the one.
    let small = (0..6).map(|_| WrongGroup { tracks: 6, jitter_px: 0.3 }).collect();
    let alone = vec![WrongGroup { tracks: 60, jitter_px: 0.3 }];
    for (name, tracks, groups) in [("many", 40, many), ("small", 40, small), ("alone", 10, alone)] {
        for seed in 0..3 {
            let options = SceneOptions { tracks, outliers: 1.0, seed, ..SceneOptions::default() };
            let (input, _) = with_groups(options, &groups);
            let solution = by_geometry(&input);
            let inliers = solution.inlier_track_count();
            assert_eq!(solution.status, Status::NoReconstruction, "{name}, seed {seed}: {inliers} inliers");
            let told = |code: WarningCode| solution.warnings.iter().any(|warning| warning.code == code);
            assert!(told(WarningCode::FewInliers) || told(WarningCode::NoConsensus), "{:?}", solution.warnings);
        }
    }
}

/// Three views are the fewest, and their cameras the most flexible.
#[test]
fn cameras_that_admit_any_track_verify_none() {
    for seed in [3350, 3353, 3355, 3358, 3359, 3364, 3365] {
        let options = SceneOptions { views: 3, tracks: 50, outliers: 1.0, seed, ..SceneOptions::default() };
        let solution = by_geometry(&scene(options).0);
        assert_eq!(solution.status, Status::NoReconstruction, "seed {seed}: {} inliers", solution.inlier_track_count());
    }
}
