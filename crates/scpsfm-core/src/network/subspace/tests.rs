use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;

use super::*;

/// A cloud of random places, some of them unobserved.
fn random(views: usize, tracks: usize, seed: u64) -> (Vec<[f64; 2]>, Vec<bool>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let points = (0..views * tracks).map(|_| [rng.random(), rng.random()]).collect();
    (points, (0..views * tracks).map(|_| rng.random_bool(0.8)).collect())
}

#[test]
fn scores_follow_the_tracks_when_these_change_places() {
    let (views, tracks) = (6, 40);
    let (points, visible) = random(views, tracks, 1);
    let scores = shipped().network.forward(&Cloud::new(views, tracks, &points, &visible));
    let turned = |index: usize| (index / tracks) * tracks + (index % tracks + 17) % tracks;
    let moved_points: Vec<_> = (0..points.len()).map(|index| points[turned(index)]).collect();
    let moved_visible: Vec<_> = (0..points.len()).map(|index| visible[turned(index)]).collect();
    let moved = shipped().network.forward(&Cloud::new(views, tracks, &moved_points, &moved_visible));
    for track in 0..tracks {
        let (moved, kept) = (moved.tracks[track], scores.tracks[turned(track)]);
        assert!((moved - kept).abs() < 1e-2, "track {track}: {moved} and {kept}");
    }
    assert!(scores.observations.iter().chain(&scores.tracks).all(|score| score.is_finite()));
}

#[test]
fn what_is_unobserved_says_nothing() {
    let (views, tracks) = (5, 30);
    let (mut points, visible) = random(views, tracks, 2);
    let scores = shipped().network.forward(&Cloud::new(views, tracks, &points, &visible));
    for (point, _) in points.iter_mut().zip(&visible).filter(|(_, seen)| !**seen) {
        *point = [f64::NAN, 1e300];
    }
    assert_eq!(shipped().network.forward(&Cloud::new(views, tracks, &points, &visible)), scores);
}

#[test]
fn degenerate_clouds_get_finite_scores() {
    let cases = [(0, 0), (3, 0), (0, 3), (1, 1), (2, 5), (30, 1)];
    for (views, tracks) in cases {
        for seen in [true, false] {
            let cloud = Cloud::new(views, tracks, &vec![[1.0, 1.0]; views * tracks], &vec![seen; views * tracks]);
            let scores = shipped().network.forward(&cloud);
            assert_eq!((scores.tracks.len(), scores.observations.len()), (tracks, views * tracks));
            assert!(scores.tracks.iter().chain(&scores.observations).all(|score| score.is_finite()));
        }
    }
}

/// Another program's scores of the same network on the same scenes.
#[derive(Deserialize)]
struct Reference {
    views: usize,
    tracks: usize,
    points: Vec<[f64; 2]>,
    visible: Vec<bool>,
    track_scores: Vec<f32>,
    observation_scores: Vec<f32>,
}

/// `SCPSFM_PRIOR_REFERENCE` names a folder with `network.prior` and `scenes.json`, a list of [`Reference`]s.
#[test]
#[ignore = "asks for the scores of another program, in the folder that SCPSFM_PRIOR_REFERENCE names"]
fn scores_are_those_of_another_program() {
    let folder = std::env::var("SCPSFM_PRIOR_REFERENCE").expect("SCPSFM_PRIOR_REFERENCE names a folder");
    let read = |name: &str| std::fs::read(format!("{folder}/{name}")).expect(name);
    let file = PriorFile::read(&read("network.prior")).expect("a network");
    let scenes: Vec<Reference> = serde_json::from_slice(&read("scenes.json")).expect("scenes");
    assert!(!scenes.is_empty());
    for (number, scene) in scenes.iter().enumerate() {
        let cloud = Cloud::new(scene.views, scene.tracks, &scene.points, &scene.visible);
        let begun = std::time::Instant::now();
        let scores = file.network.forward(&cloud);
        let seconds = begun.elapsed().as_secs_f64();
        let apart = |found: f32, expected: f32| (found - expected).abs();
        let of_tracks = scores.tracks.iter().zip(&scene.track_scores).map(|(a, b)| apart(*a, *b)).fold(0.0, f32::max);
        let observations = scores.observations.iter().zip(&scene.observation_scores).zip(&scene.visible);
        let of_observations =
            observations.filter(|(_, seen)| **seen).map(|((a, b), _)| apart(*a, *b)).fold(0.0, f32::max);
        println!(
            "scene {number}: tracks apart by {of_tracks:.1e}, observations by {of_observations:.1e}, {seconds:.4} s"
        );
        assert!(of_tracks < 1e-3 && of_observations < 1e-3, "scene {number}");
    }
}
