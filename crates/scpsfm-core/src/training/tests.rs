use burn_tensor::{DType, Device, Tensor};

use super::gradient::{differentiate, tensors};
use super::labelled::loss;
use super::tape::constant;
use super::*;
use crate::network::Parameter;
use crate::network::subspace::{Cloud, Shape, SubspaceNet};
use crate::synthetic::training_scenes::{self, TrainingScene};

const SMALL: Shape = Shape { state: 6, selections: 3, blocks: 3, encoding: 5, strides: 0 };
const PAIRED: Shape = Shape { strides: 2, ..SMALL };

/// Some scenes with holes.
fn scenes(seed: u64) -> Vec<TrainingScene> {
    let mut numbers = 0..;
    let holed = |scenes: &Vec<TrainingScene>| scenes.iter().all(|scene| scene.visible.iter().any(|seen| !seen));
    let mut scenes =
        numbers.find_map(|number| Some(training_scenes::batch(seed, number)).filter(holed)).expect("holes");
    scenes.truncate(2);
    scenes
}

#[test]
fn the_tape_says_what_the_network_says() {
    assert_same_scores(SMALL);
}

#[test]
fn the_tape_says_of_pairs_what_the_network_says() {
    assert_same_scores(PAIRED);
}

fn assert_same_scores(shape: Shape) {
    let seed = 3;
    let network = initial::initial(shape, seed);
    let device = Device::flex().autodiff();
    for scene in scenes(seed) {
        let (batch, _) = tensors(std::slice::from_ref(&scene), DType::F32, &device);
        let output = network.map(|parameter| parameter.tensor(&device)).on_tape(&batch, DType::F32).expect("a pass");
        let cloud = Cloud::new(scene.views, scene.tracks, &scene.points, &scene.visible);
        let scores = network.map(|parameter| parameter.values().to_vec()).forward(&cloud);
        let last = output.tracks.last().expect("blocks").clone();
        assert_near(&scores.tracks, &values(last.inner()));
        assert_near(&scores.observations, &values(output.observations.inner()));
    }
}

fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec().expect("f32")
}

fn assert_near(found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len());
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-3, "apart by {worst}");
}

/// The loss in f64 at a network moved along a direction.
fn loss_at(
    network: &SubspaceNet<Parameter>,
    direction: &SubspaceNet<Vec<f64>>,
    length: f64,
    scenes: &[TrainingScene],
) -> f64 {
    let device = Device::flex();
    let mut directions = direction.arrays().into_iter();
    let moved = network.map(|parameter| {
        let moves = directions.next().expect("as many arrays");
        let moved = parameter.values().iter().zip(moves).map(|(value, slope)| f64::from(*value) + length * slope);
        constant::<2>(moved.collect(), parameter.shape(), DType::F64, &device)
    });
    let (batch, labels) = tensors(scenes, DType::F64, &device);
    let total = loss(moved.on_tape(&batch, DType::F64).expect("a pass"), &labels).total;
    total.into_data().try_into_vec::<f64>().expect("f64")[0]
}

#[test]
fn derivatives_agree_with_finite_differences() {
    let seed = 5;
    assert_differences(&initial::initial(SMALL, seed), &scenes(seed), 0, seed);
}

/// Without reweighting, and with one direction that is freer than all others, derivatives through pairs are exact.
#[test]
fn derivatives_through_pairs_agree_with_finite_differences() {
    const ALWAYS_WHOLE: f32 = 30.0;
    let seed = 5;
    let mut network = initial::initial(PAIRED, seed);
    for pairs in network.blocks.iter_mut().filter_map(|block| block.pairs.as_mut()) {
        pairs.log_scale = Parameter::constant(pairs.log_scale.shape(), ALWAYS_WHOLE);
    }
    assert_differences(&network, &[rectified(seed), rectified(seed + 1)], 0, seed);
}

/// With reweighting they are for the last block, which takes the distances of the others as given.
#[test]
fn derivatives_of_reweighting_agree_with_finite_differences() {
    let seed = 5;
    let network = initial::initial(PAIRED, seed);
    let mut before = network.clone();
    before.blocks.pop();
    // What follows the blocks is in both.
    let [first, after] = [2, 2].map(|layers| 2 * layers);
    let of_blocks = before.arrays().len() - first - after;
    assert_differences(&network, &[rectified(seed), rectified(seed + 1)], first + of_blocks, seed);
}

/// A scene whose tracks have nearly the same x in every view and any y: the equations `x_to = x_from` of its pairs are
/// met, and no others nearly as well.
fn rectified(seed: u64) -> TrainingScene {
    use rand::{Rng, SeedableRng};
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let (views, tracks) = (4, 60);
    let all = views * tracks;
    let columns: Vec<f64> = (0..tracks).map(|_| rng.random()).collect();
    let points = (0..all).map(|k| [columns[k % tracks] + 0.02 * rng.random::<f64>(), rng.random()]).collect();
    let [visible, right] = [0.9, 0.5].map(|share| (0..all).map(|_| rng.random_bool(share)).collect::<Vec<bool>>());
    TrainingScene { views, tracks, points, inlier: right[..tracks].to_vec(), right, visible }
}

/// Central differences of the loss in f64, one direction for every array from the `first` on, against the derivatives
/// in f32.
fn assert_differences(network: &SubspaceNet<Parameter>, scenes: &[TrainingScene], first: usize, seed: u64) {
    use rand::{Rng, SeedableRng};
    const LENGTH: f64 = 1e-5;
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let gradient = differentiate(network, scenes, Objective::Labels).expect("a gradient").gradient;
    let count = network.arrays().len();
    let largest = gradient.arrays().into_iter().flatten().map(|slope| slope.abs()).fold(0.0, f32::max);
    for chosen in first..count {
        let mut place = 0;
        let direction = network.map(|parameter| {
            let of_chosen = f64::from(u8::from(place == chosen));
            place += 1;
            parameter.values().iter().map(|_| of_chosen * (2.0 * rng.random::<f64>() - 1.0)).collect::<Vec<f64>>()
        });
        let expected = (loss_at(network, &direction, LENGTH, scenes) - loss_at(network, &direction, -LENGTH, scenes))
            / (2.0 * LENGTH);
        let (slopes, moves) = (gradient.arrays()[chosen], direction.arrays()[chosen]);
        let found: f64 = slopes.iter().zip(moves).map(|(slope, length)| f64::from(*slope) * length).sum();
        let tolerance = 0.01 * expected.abs() + 1e-5 * f64::from(largest);
        assert!((found - expected).abs() < tolerance, "array {chosen} of {count}: {found} for {expected}, seed {seed}");
    }
}

#[test]
fn a_training_put_aside_goes_on_as_if_it_had_not_been() {
    assert_goes_on(SMALL, "");
    assert_goes_on(PAIRED, " --pairs");
}

fn assert_goes_on(shape: Shape, flag: &str) {
    let settings = Settings { seed: 11, steps: 4, shape, objective: Objective::Labels };
    let mut whole = Trainer::new(settings);
    let mut parted = Trainer::new(settings);
    while !whole.is_finished() {
        whole.advance().expect("a step");
        parted.advance().expect("a step");
        parted = Trainer::resume(&parted.state().expect("a state"), settings).expect("its own state");
    }
    assert_eq!(whole, parted);
    assert_eq!(whole.milestones().len(), 1);
    let other = Settings { seed: 12, ..settings };
    let error = Trainer::resume(&whole.state().expect("a state"), other).expect_err("another training");
    assert_eq!(error.to_string(), format!("it belongs to a training with --seed 11 --steps 4{flag}"));
    assert!(Trainer::resume(b"no state", settings).is_err() && Trainer::resume(b"", settings).is_err());
    let mut damaged = whole.state().expect("a state");
    let middle = damaged.len() / 2;
    damaged[middle] ^= 1;
    let error = Trainer::resume(&damaged, settings).expect_err("a damaged state");
    assert!(error.to_string().contains("checksum"), "{error}");
}

/// The plane that stands for the loss without labels: its derivative along the logits is that of the losses themselves.
#[test]
fn without_labels_the_weights_follow_the_papers_losses() {
    use super::tape::Output;
    use crate::network::NetworkSettings;
    use rand::{Rng, SeedableRng};
    const LENGTH: f64 = 1e-5;
    let (seed, views, tracks, scenes, blocks) = (7, 4, 30, 2, 2);
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut draw = |count: usize| (0..count).map(|_| 2.0 * rng.random::<f64>() - 1.0).collect::<Vec<f64>>();
    let columns = draw(scenes * views * 3 * tracks);
    let (logits, directions) =
        ([draw(scenes * tracks), draw(scenes * tracks)], [(); 2].map(|()| draw(scenes * tracks)));
    let device = Device::flex().autodiff();
    let at = |length: f64| {
        let leaves: Vec<Tensor<3>> = (0..blocks)
            .map(|block| {
                let moved = logits[block].iter().zip(&directions[block]).map(|(logit, step)| logit + length * step);
                constant(moved.collect(), [scenes, 1, tracks], DType::F64, &device).require_grad()
            })
            .collect();
        let output = Output {
            tracks: leaves.clone(),
            observations: constant(vec![0.0], [1, 1, 1, 1], DType::F64, &device),
            columns: constant(columns.clone(), [scenes, views, 3, tracks], DType::F64, &device),
        };
        (unlabelled::loss(output, DType::F64).expect("finite columns"), leaves)
    };
    let number = |tensor: Tensor<1>| tensor.inner().into_data().try_into_vec::<f64>().expect("f64")[0];
    let total = |length: f64| number(at(length).0.total);
    let expected = (total(LENGTH) - total(-LENGTH)) / (2.0 * LENGTH);
    let (loss, leaves) = at(0.0);
    let mut reached = loss.total.clone().backward();
    let mut found = 0.0;
    for (leaf, direction) in leaves.into_iter().zip(&directions) {
        let slopes: Vec<f64> =
            leaf.grad_remove(&mut reached).expect("a gradient").into_data().try_into_vec().expect("f64");
        found += slopes.iter().zip(direction).map(|(slope, step)| slope * step).sum::<f64>();
    }
    assert!((found - expected).abs() < 1e-5 * expected.abs().max(1.0), "{found} for {expected}, seed {seed}");
    let [num, proj] = loss.parts.map(number);
    assert!(num > 0.0 && proj > NetworkSettings::default().alpha / 100.0, "L_num {num}, L_proj {proj}");
}
