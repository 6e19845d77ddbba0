use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::arrays::{Layer, Shape};
use super::*;

/// Views of random points by cameras that turn and move, image points with noise of 1e-4; the first `wrong` tracks are
/// moved by `by` in every view, each in a direction of its own.
fn scene(views: usize, tracks: usize, wrong: usize, by: f64, seed: u64) -> Cloud {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let world: Vec<[f64; 3]> = (0..tracks).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect();
    let mut points = Vec::new();
    for view in 0..views {
        let (sine, cosine) = (0.15 * view as f64).sin_cos();
        for (track, [x, y, z]) in world.iter().enumerate() {
            let (x, z) = (cosine * x + sine * z + 0.3 * view as f64, cosine * z - sine * x + 4.0);
            let turn = rng.random_range(0.0..std::f64::consts::TAU);
            let off = if track < wrong { by } else { 1e-4 };
            points.push([x / z + off * turn.cos(), y / z + off * turn.sin()]);
        }
    }
    Cloud::new(views, tracks, &points, &vec![true; views * tracks])
}

/// Layers that trust every track alike.
fn impartial(strides: usize, log_scale: f32) -> PairLayers<Vec<f32>> {
    let trust = Layer { weight: vec![0.0; strides], bias: vec![0.0; strides] };
    PairLayers { trust, log_scale: vec![log_scale; strides] }
}

#[test]
fn pairs_are_neighbours_and_linear_in_the_views() {
    let found: Vec<[usize; 3]> = pairs(4, 2).map(|Pair { stride, from, to }| [stride, from, to]).collect();
    assert_eq!(found, [[0, 0, 1], [0, 1, 2], [0, 2, 3], [1, 0, 2], [1, 1, 3]]);
    assert_eq!(pairs(100, 2).count(), 197);
    assert_eq!((pairs(1, 2).count(), pairs(0, 2).count(), pairs(5, 0).count()), (0, 0, 0));
}

#[test]
fn reweighting_tells_near_misses_from_hits() {
    let (views, tracks, wrong) = (5, 100, 40);
    let cloud = scene(views, tracks, wrong, 0.02, 3);
    let mut asked = Pairs::new(&cloud, 2);
    let layers = impartial(2, -8.0);
    let state = vec![0.0; tracks];
    let mut features = asked.ask(&layers, &state);
    let shares = |features: &PairFeatures| {
        // Of the wrong observations, how many have a mean above that of every right one.
        let mean = |view: usize| row(features.of_view(view), tracks, 1).to_vec();
        let told = |view: usize| {
            let most = mean(view)[wrong..].iter().copied().fold(f32::NEG_INFINITY, f32::max);
            mean(view)[..wrong].iter().filter(|mean| **mean > most).count()
        };
        (0..views).map(told).sum::<usize>() as f64 / (views * wrong) as f64
    };
    let before = shares(&features);
    for _ in 0..5 {
        features = asked.ask(&layers, &state);
    }
    let after = shares(&features);
    assert!(after > 0.9 && before < 0.7 * after, "{before} of the near misses told at first, {after} in the end");
    let share = |view: usize| row(features.of_view(view), tracks, 2)[0];
    assert_eq!((0..views).map(share).collect::<Vec<_>>(), [0.5, 0.75, 1.0, 0.75, 0.5]);
    let least = (0..views).all(|view| {
        let of_view = features.of_view(view);
        row(of_view, tracks, 0).iter().zip(row(of_view, tracks, 1)).all(|(least, mean)| least <= mean)
    });
    assert!(least, "the least of some numbers is no more than their mean");
}

#[test]
fn what_no_pair_sees_is_neutral() {
    let (views, tracks) = (3, 40);
    let points = vec![[0.0; 2]; views * tracks];
    // Views 0 and 1 share too few matches, 0 and 2 all but one, 1 and 2 as few.
    let visible: Vec<bool> = (0..views * tracks)
        .map(|place| match (place / tracks, place % tracks) {
            (1, track) => track < LEAST_MATCHES - 1,
            (_, track) => track > 0,
        })
        .collect();
    let cloud = Cloud::new(views, tracks, &points, &visible);
    let features = Pairs::new(&cloud, 2).ask(&impartial(2, 0.0), &vec![0.0; tracks]);
    let heard = |view: usize, track: usize| [0, 1, 2].map(|k| row(features.of_view(view), tracks, k)[track]);
    assert_eq!(heard(1, 3), [NEUTRAL, NEUTRAL, 0.0]);
    assert_eq!(heard(0, 0), [NEUTRAL, NEUTRAL, 0.0], "its one pair does not see it");
    let [least, mean, share] = heard(2, 5);
    assert!(least.is_finite() && least == mean && share == 0.25, "{:?}", heard(2, 5));
    assert!(PairFeatures::default().of_view(2).is_empty());
}

/// Random numbers in place of trained ones.
fn random_network(seed: u64) -> crate::network::subspace::SubspaceNet<Vec<f32>> {
    let shape = Shape { state: 6, selections: 2, blocks: 3, encoding: 5, strides: 2 };
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    shape.arrays().map(|[rows, columns]| (0..rows * columns).map(|_| rng.random_range(-0.5..0.5)).collect())
}

#[test]
fn a_network_with_pairs_hears_them_and_scores_whatever_it_is_shown() {
    let mut network = random_network(4);
    let cloud = scene(5, 60, 20, 0.3, 5);
    let scores = network.forward(&cloud);
    // The last inputs of the encoders are what pairs say.
    for block in &mut network.blocks {
        let inputs = block.encoder.weight.len() / block.encoder.bias.len();
        let of_pairs = |weights: &mut [f32]| weights[inputs - PAIR_FEATURES..].fill(0.0);
        block.encoder.weight.chunks_exact_mut(inputs).for_each(of_pairs);
    }
    assert_ne!(network.forward(&cloud).tracks, scores.tracks, "pairs say something");

    let network = random_network(4);
    for (views, tracks) in [(0, 0), (3, 0), (0, 3), (1, 30), (2, 5), (30, 1), (3, 20)] {
        for seen in [true, false] {
            let cloud = Cloud::new(views, tracks, &vec![[1.0, 1.0]; views * tracks], &vec![seen; views * tracks]);
            let scores = network.forward(&cloud);
            assert_eq!((scores.tracks.len(), scores.observations.len()), (tracks, views * tracks));
            assert!(scores.tracks.iter().chain(&scores.observations).all(|score| score.is_finite()));
        }
    }
}
