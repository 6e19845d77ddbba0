//! Inputs whose views share tracks in pairs, but no three of them enough.

use std::collections::BTreeMap;

use nalgebra::{Rotation3, Vector3};
use rand::seq::index;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::domain::ImageSize;
use crate::solver::view_selection;

const VIEWS: usize = 20;
const TRACKS: usize = 1_000;

/// A scene of which each track keeps four views, anywhere among them: pairs of views share some thirty tracks, no three
/// more than seven.
///
/// * `outliers`: share of wrong tracks
fn scattered(seed: u64, outliers: f64) -> (Input, Scene) {
    let options =
        SceneOptions { views: VIEWS, tracks: TRACKS, outliers, noise: 0.0005, seed, ..SceneOptions::default() };
    let scene = Scene::generate(&options).expect("valid options");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut shared = BTreeMap::new();
    let triples = |views: &[usize]| -> Vec<Vec<usize>> {
        (0..views.len()).map(|left_out| [&views[..left_out], &views[left_out + 1..]].concat()).collect()
    };
    let mut kept_views = || loop {
        let mut views = index::sample(&mut rng, VIEWS, 4).into_vec();
        views.sort_unstable();
        if triples(&views).iter().all(|triple| shared.get(triple).is_none_or(|count| *count < 7)) {
            triples(&views).into_iter().for_each(|triple| *shared.entry(triple).or_insert(0) += 1);
            return views;
        }
    };
    let kept: Vec<Vec<usize>> = (0..TRACKS).map(|_| kept_views()).collect();
    let from = &scene.input;
    let mut raw = RawInput { views: from.views.clone(), track_count: TRACKS, ..RawInput::default() };
    for k in 0..from.x.len() {
        let (view, track) = (from.view[k], from.track[k]);
        if kept[track as usize].contains(&(view as usize)) {
            raw.view.push(view);
            raw.track.push(track);
            raw.x.push(from.x[k]);
            raw.y.push(from.y[k]);
        }
    }
    let input = Input::new(raw, &Limits::default(), "scattered").expect("valid input");
    let (settings, stop) = (SolveSettings::default(), StopToken::default());
    let problem = Problem::new(&input, &settings, Threads::ONE, &stop);
    assert!(view_selection::candidate_views(&problem).is_empty(), "seed {seed}: three views share enough tracks");
    drop(problem);
    (input, scene)
}

/// Two tracks in ten are wrong.
#[test]
fn views_that_share_tracks_in_pairs_alone_are_reconstructed() {
    for seed in 0..3 {
        let (input, scene) = scattered(seed, 0.2);
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
        println!("seed {seed}: {:?}, F1 {f1}, {:?}", solution.grade, solution.warnings);
        assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}: {:?}", solution.warnings);
        assert_eq!(solution.registered_views().len(), VIEWS, "seed {seed}");
        assert!(f1 > 0.95, "seed {seed}: F1 {f1}");
        assert!(focal_error(&solution, &scene) < 0.02, "seed {seed}: {}", focal_error(&solution, &scene));
    }
}

/// Pairs of views agree with some fundamental matrix by chance, and no three of these with three cameras.
#[test]
fn pairs_of_views_without_structure_are_no_reconstruction() {
    for seed in 0..5 {
        let (input, _) = scattered(seed, 1.0);
        let solution = solved(&input, &SolveSettings { seed, ..SolveSettings::default() });
        assert_eq!(solution.status, Status::NoReconstruction, "seed {seed}: {:?}", solution.warnings);
        let reason = solution.warnings.iter().find(|warning| warning.code == WarningCode::FewInliers);
        assert!(reason.is_some_and(|reason| reason.detail.contains("more than by chance")), "{:?}", solution.warnings);
    }
}

/// Where the points of three views lie on a line in each, every track agrees with some point; in more views, many do.
/// A few points off the line are no help.
#[test]
fn points_on_a_line_in_each_view_are_no_reconstruction() {
    for (seed, (views, tracks)) in (0..).zip([(3, 40), (4, 60), (6, 40), (12, 80), (20, 50)]) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let of_each: [f64; 20] = std::array::from_fn(|view| 0.1 * view as f64);
        for (slopes, off) in [([1.0; 20], 0), (of_each, 0), (of_each, tracks / 10)] {
            let mut raw = RawInput { track_count: tracks, ..RawInput::default() };
            let size = Some(ImageSize { width_px: 1000, height_px: 1000 });
            raw.views = vec![View { size, ..View::default() }; views];
            for (track, view) in (0..tracks).flat_map(|track| (0..views).map(move |view| (track, view))) {
                let x: f64 = rng.random_range(0.0..1000.0);
                raw.view.push(view as u32);
                raw.track.push(track as u32);
                raw.x.push(x);
                raw.y.push(if track < off { rng.random_range(0.0..1000.0) } else { slopes[view] * x });
            }
            let input = Input::new(raw, &Limits::default(), "line").expect("valid input");
            let solution = solved(&input, &SolveSettings::default());
            assert_eq!(solution.grade, None, "{views} views of {tracks} tracks, {off} off: {:?}", solution.warnings);
        }
    }
}

/// The images of one line in space tell of one coordinate: the cameras are free to fit tracks that are anywhere.
#[test]
fn a_line_in_space_and_a_few_wrong_tracks_are_no_reconstruction() {
    let tracks = 100;
    for (seed, views, wrong) in [(1, 5, 1), (2, 5, 2), (3, 5, 5), (4, 10, 1), (5, 10, 2), (6, 10, 5), (7, 6, 20)] {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let along: Vec<f64> = (0..tracks).map(|_| rng.random_range(-1.0..1.0)).collect();
        let size = Some(ImageSize { width_px: 1000, height_px: 1000 });
        let views = vec![View { size, ..View::default() }; views];
        let mut raw = RawInput { track_count: tracks, ..RawInput::default() };
        for view in 0..views.len() {
            let axis = Vector3::from_fn(|_, _| rng.random_range(-0.4..0.4));
            let rotation = Rotation3::from_scaled_axis(axis);
            let shift = Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), 6.0);
            for (track, along) in along.iter().enumerate() {
                let seen: Vector3<f64> = rotation * Vector3::new(2.0, 1.0, 0.5) * *along + shift;
                let right = |k: usize| 1000.0 * seen[k] / seen.z + 500.0;
                let mut noise = || rng.random_range(-0.5..0.5);
                let [x, y] = [0, 1].map(right);
                let [dx, dy] = [noise(), noise()];
                let anywhere = [rng.random_range(0.0..1000.0), rng.random_range(0.0..1000.0)];
                let [x, y] = if track < wrong { anywhere } else { [x + dx, y + dy] };
                raw.view.push(view as u32);
                raw.track.push(track as u32);
                raw.x.push(x);
                raw.y.push(y);
            }
        }
        raw.views = views;
        let input = Input::new(raw, &Limits::default(), "line").expect("valid input");
        let solution = solved(&input, &SolveSettings::default());
        assert_eq!(solution.grade, None, "seed {seed}, {wrong} wrong: {:?}", solution.warnings);
    }
}
