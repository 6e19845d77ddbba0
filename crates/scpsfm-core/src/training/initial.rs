//! The network before its first step.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::network::subspace::{Block, Layer, PairLayers, Shape, SubspaceNet};
use crate::network::{Parameter, standard_normal};

/// Standard deviation of the selections' weights: enough for the selections to differ, too little for one track to be
/// all of a selection.
const SELECTION_DEVIATION: f64 = 0.3;
/// Logarithms of the ridges of the first and the last block, the prototype's: blocks go from coarse to fine.
const LOG_RIDGE: (f32, f32) = (-1.5, -4.5);
/// Half the range over which the ridges of one block are spread, in logarithms.
const LOG_RIDGE_SPREAD: f32 = 0.3;
/// Logit of the rate at which depths move at first: a quarter of the way.
const DEPTH_RATE: f32 = -1.0;
/// Logarithms of the squared distances at which a match has half its weight, of the first and the last block: from a
/// seventh of a view's spread, which parts what is right from what lies anywhere, to a fiftieth, some standard
/// deviations of common noise.
const LOG_SCALE: (f32, f32) = (-4.0, -8.0);

/// A network with freshly drawn weights: each uniform within one over the square root of its layer's inputs.
pub fn initial(shape: Shape, seed: u64) -> SubspaceNet<Parameter> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let shapes = shape.arrays();
    let mut layer = |layer: &Layer<[usize; 2]>| {
        let most = (layer.weight[1] as f64).sqrt().recip();
        let mut draw = |[rows, columns]: [usize; 2]| {
            let values = (0..rows * columns).map(|_| (most * (2.0 * rng.random::<f64>() - 1.0)) as f32).collect();
            Parameter::new([rows, columns], values)
        };
        Layer { weight: draw(layer.weight), bias: draw(layer.bias) }
    };
    let mut network = SubspaceNet {
        first_encoder: layer(&shapes.first_encoder),
        first_state: layer(&shapes.first_state),
        blocks: Vec::with_capacity(shape.blocks),
        observation_hidden: layer(&shapes.observation_hidden),
        observation_logit: layer(&shapes.observation_logit),
    };
    for (number, block) in shapes.blocks.iter().enumerate() {
        network.blocks.push(Block {
            selection: layer(&block.selection),
            encoder: layer(&block.encoder),
            hidden: layer(&block.hidden),
            change: layer(&block.change),
            logit: layer(&block.logit),
            log_ridge: log_ridges(number, shape),
            depth_rate: Parameter::constant([1, 1], DEPTH_RATE),
            pairs: block.pairs.as_ref().map(|pairs| PairLayers {
                trust: layer(&pairs.trust),
                log_scale: Parameter::constant(pairs.log_scale, between(number, shape.blocks, LOG_SCALE)),
            }),
        });
    }
    for (block, shapes) in network.blocks.iter_mut().zip(&shapes.blocks) {
        let [rows, columns] = shapes.selection.weight;
        let draws = (0..rows * columns).map(|_| (SELECTION_DEVIATION * standard_normal(&mut rng)) as f32).collect();
        block.selection.weight = Parameter::new([rows, columns], draws);
    }
    network
}

/// The ridges of one block.
fn log_ridges(block: usize, shape: Shape) -> Parameter {
    let middle = between(block, shape.blocks, LOG_RIDGE);
    let spread = (-LOG_RIDGE_SPREAD, LOG_RIDGE_SPREAD);
    let ridges = (0..shape.selections).map(|selection| middle + between(selection, shape.selections, spread));
    Parameter::new([shape.selections, 1], ridges.collect())
}

/// The value at one of several evenly spaced places.
fn between(place: usize, count: usize, (from, to): (f32, f32)) -> f32 {
    from + (to - from) * if count < 2 { 0.5 } else { place as f32 / (count - 1) as f32 }
}
