//! SCPSFM from an input to a solution.

use super::*;
use crate::domain::Task;

fn settings() -> SolveSettings {
    SolveSettings::of_method(Method::Scpsfm)
}

/// Counts what is told of heads and keeps the last interim weights.
#[derive(Default)]
struct Heads {
    told: Vec<(u32, u32)>,
    weights: Vec<f32>,
}

impl Observer for Heads {
    fn progress(&mut self, progress: &Progress) {
        let step =
            progress.reconstruction.step.filter(|step| step.task == Task::Heads && progress.stage == Stage::Search);
        self.told.extend(step.map(|step| (step.step, progress.iteration)));
    }

    fn weights(&mut self, _: u32, weights: &[f32]) {
        self.weights = weights.to_vec();
    }
}

#[test]
fn its_own_weights_decide_and_the_rest_is_calibrated() {
    let (input, scene) = scene(SceneOptions { with_depths: true, seed: 1, ..SceneOptions::default() });
    let mut heads = Heads::default();
    let settings = SolveSettings { weights_every: 100, ..settings() };
    let solution = solve(&input, &settings, &mut heads, &StopToken::default()).expect("a solution");
    assert_eq!((solution.status, solution.grade), (Status::Solved, Some(Grade::Metric)));
    assert!(agreement(&solution.tracks.inlier, &scene.truth.inlier).f1 > 0.99);
    assert!(focal_error(&solution, &scene) < 0.03);
    assert_eq!(solution.iterations, SolveSettings::DEFAULT_ITERATIONS);
    for (track, weight) in solution.tracks.weight.iter().enumerate() {
        assert_eq!((*weight > 0.5, *weight), (solution.tracks.inlier[track], solution.tracks.network_weight[track]));
    }
    assert_eq!(heads.told.last(), Some(&(1, 500)));
    assert_eq!(heads.weights.len(), 200);
}

/// Perspective is no noise: one right track in twenty is three times as far from rank 4 as the median one.
#[test]
fn without_depths_next_to_no_right_track_is_lost() {
    let mut recall = 0.0;
    for seed in 0..3 {
        let (input, scene) = scene(SceneOptions { outliers: 0.5, seed, ..SceneOptions::default() });
        let found = agreement(&solved(&input, &settings()).tracks.inlier, &scene.truth.inlier);
        assert!(found.precision > 0.99, "seed {seed}: {found:?}");
        recall += found.recall / 3.0;
    }
    assert!(recall > 0.98, "{recall}");
}

/// Views and tracks that nothing is observed of change nothing.
#[test]
fn empty_views_and_tracks_change_nothing() {
    let options = SceneOptions { views: 6, tracks: 60, outliers: 0.5, with_depths: true, ..SceneOptions::default() };
    let (plain, scene) = scene(options);
    let mut raw = scene.input.clone();
    raw.views.insert(3, raw.views[0].clone());
    raw.view.iter_mut().for_each(|view| *view += u32::from(*view >= 3));
    raw.track_count += 5;
    let padded = Input::new(raw, &Limits::default(), "scene").expect("a valid scene");
    let settings = SolveSettings { iterations: 100, ..settings() };
    let (plain, padded) = (solved(&plain, &settings), solved(&padded, &settings));
    assert_eq!(padded.tracks.weight[..60], plain.tracks.weight);
    assert!(padded.tracks.weight[60..].iter().all(|&weight| weight == 0.0));
    let focal = |solution: &Solution| solution.calibrations.first().map(|calibration| calibration.focal_px.to_bits());
    assert!(focal(&plain).is_some(), "{:?}", plain.warnings);
    assert_eq!(focal(&padded), focal(&plain));
}

#[test]
fn nothing_is_made_of_what_no_head_is_accepted_for() {
    let options = SceneOptions { tracks: 60, outliers: 1.0, with_depths: true, ..SceneOptions::default() };
    let (input, _) = scene(options);
    let solution = solved(&input, &SolveSettings { iterations: 60, ..settings() });
    assert_eq!((solution.status, solution.grade), (Status::NoReconstruction, None));
    assert!(solution.calibrations.is_empty());
    let codes: Vec<WarningCode> = solution.warnings.iter().map(|warning| warning.code).collect();
    assert!(codes.contains(&WarningCode::UnverifiedRanking), "{codes:?}");
    assert_eq!(solution.iterations, 16 * 60);
}
