//! Learning from labels: binary cross-entropy of tracks after every block and of observations after the last.

use burn_tensor::Tensor;
use burn_tensor::activation::log_sigmoid;

use super::objective::{Loss, importance};
use super::tape::Output;

/// Weight of the observations beside that of the last block's tracks.
const OBSERVATIONS: f64 = 0.5;
/// Bounds of how much more a right one counts than a wrong one.
const POSITIVE_WEIGHT: (f64, f64) = (0.3, 10.0);

/// The labels of a batch and what each of them counts.
pub struct Labels {
    /// 1 for right tracks, B x 1 x m.
    pub tracks: Tensor<3>,
    /// Sums to 1 over the batch.
    pub track_weights: Tensor<3>,
    /// 1 for right observations, B x n x 1 x m.
    pub observations: Tensor<4>,
    /// Sums to 1 over the batch; 0 where unobserved.
    pub observation_weights: Tensor<4>,
}

/// What each label of a set counts: right ones the square root of the odds against them, so that the few are heard
/// without being believed everywhere.
///
/// * `counted`: whether each label counts at all
pub fn weights(right: &[bool], counted: &[bool]) -> Vec<f64> {
    let count =
        |wanted: bool| right.iter().zip(counted).filter(|&(&right, &counted)| counted && right == wanted).count();
    let (positive, negative) = (count(true).max(1) as f64, count(false).max(1) as f64);
    let of_right = (negative / positive).sqrt().clamp(POSITIVE_WEIGHT.0, POSITIVE_WEIGHT.1);
    let all = right.iter().zip(counted);
    all.map(|(&right, &counted)| {
        if !counted {
            0.0
        } else if right {
            of_right
        } else {
            1.0
        }
    })
    .collect()
}

/// The loss of what the network said; its parts are the tracks' by the last block and the observations'.
pub fn loss(output: Output, labels: &Labels) -> Loss {
    let blocks = output.tracks.len();
    let of_blocks: Vec<Tensor<1>> = output
        .tracks
        .into_iter()
        .map(|logits| cross_entropy(logits, labels.tracks.clone(), labels.track_weights.clone()))
        .collect();
    let observations =
        cross_entropy(output.observations, labels.observations.clone(), labels.observation_weights.clone());
    let last_block = of_blocks[blocks - 1].clone();
    let mut total = last_block.clone() + observations.clone().mul_scalar(OBSERVATIONS);
    for (block, loss) in of_blocks.into_iter().enumerate() {
        total = total + loss.mul_scalar(importance(block, blocks));
    }
    Loss { total, parts: [last_block, observations] }
}

/// `-w (y log s(x) + (1 - y) log s(-x))`, summed.
fn cross_entropy<const D: usize>(logits: Tensor<D>, labels: Tensor<D>, weights: Tensor<D>) -> Tensor<1> {
    // log s(-x) = log s(x) - x
    let loss = logits.clone() * (labels.neg().add_scalar(1.0)) - log_sigmoid(logits);
    (loss * weights).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_few_right_ones_weigh_more() {
        let right = [true, false, false, false, false, false];
        assert_eq!(weights(&right, &[true, true, true, true, true, false]), [2.0, 1.0, 1.0, 1.0, 1.0, 0.0]);
        assert_eq!(weights(&[false; 3], &[true; 3]), [1.0; 3]);
        assert_eq!(weights(&[true; 1000], &[true; 1000])[0], POSITIVE_WEIGHT.0);
    }
}
