//! The network's arrays, or something for each of them: its values, their tensors, their gradients.

use serde::{Deserialize, Serialize};

/// A linear layer: `weight` is outputs x inputs, `bias` outputs x 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Layer<T> {
    pub weight: T,
    pub bias: T,
}

/// What a block asks pairs of views with, see [`pairs`](super::pairs); `S` strides.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairLayers<T> {
    /// State to the logits of a track's weights in the pairs of every stride, S x C.
    pub trust: Layer<T>,
    /// Logarithms of the squared distances at which a match has half its weight, S x 1.
    pub log_scale: T,
}

/// One block; see [the architecture](super).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Block<T> {
    /// State to the logits of the selections, H x C.
    pub selection: Layer<T>,
    /// Observation to its encoding, E x (H + 3), or E x (H + 6) with pairs.
    pub encoder: Layer<T>,
    /// State, pooled encodings, residuals and leverages to what moves the state, C x (C + 2E + 2H).
    pub hidden: Layer<T>,
    /// That and the state to the state's change, C x 2C.
    pub change: Layer<T>,
    /// State to the track's logit, 1 x C.
    pub logit: Layer<T>,
    /// Logarithms of λ, H x 1.
    pub log_ridge: T,
    /// Logit of the rate at which depths move, 1 x 1.
    pub depth_rate: T,
    /// Of a network that asks pairs of views. Left out where there are none, so that files and states of networks
    /// without pairs are what they were before there were any.
    #[serde(default = "Option::default", skip_serializing_if = "Option::is_none")]
    pub pairs: Option<PairLayers<T>>,
}

/// The whole network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SubspaceNet<T> {
    /// Observation (place, offset from the track's mean place, its squares, visible) to its encoding, E x 7.
    pub first_encoder: Layer<T>,
    /// Pooled encodings to the first state, C x 2E.
    pub first_state: Layer<T>,
    pub blocks: Vec<Block<T>>,
    /// Residuals (H), image residuals (H), place, visible, the track's mean residual, its state, pairs to E.
    pub observation_hidden: Layer<T>,
    /// That to the observation's logit, 1 x E.
    pub observation_logit: Layer<T>,
}

/// Numbers that an observation's first encoding is made from.
pub const FIRST_FEATURES: usize = 7;
/// Numbers beside the residuals that an observation's later encodings are made from: place and visible.
pub const PLACE_FEATURES: usize = 3;
/// Numbers that pairs of views say of an observation: the least and the mean logarithm of its distances, and how many
/// pairs it is in, as a share of those of a view in the middle.
pub const PAIR_FEATURES: usize = 3;

/// The sizes of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shape {
    /// Numbers in a track's state, `C`.
    pub state: usize,
    /// Soft selections a block, `H`.
    pub selections: usize,
    /// Blocks, `L`.
    pub blocks: usize,
    /// Numbers in an observation's encoding, `E`.
    pub encoding: usize,
    /// Views that the partners of a pair are apart at most, `S`; with 0 no pairs are asked.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub strides: usize,
}

/// Whether a header leaves a size out.
fn is_zero(size: &usize) -> bool {
    *size == 0
}

impl Default for Shape {
    /// The sizes that the training scenes were chosen with: 30,205 numbers, about 1 ms for 10 x 200.
    fn default() -> Self {
        Self { state: 32, selections: 4, blocks: 6, encoding: 16, strides: 0 }
    }
}

/// Strides of a network that asks pairs: neighbours have most in common, the next but one closes triangles, so that a
/// wrong observation disagrees with more than one. On real windows pairs are no better with 3.
const PAIR_STRIDES: usize = 2;

impl Shape {
    /// Above these a file is not a network that this program would run for a request.
    const MOST: Shape = Shape { state: 256, selections: 16, blocks: 32, encoding: 128, strides: 4 };

    /// The default sizes with pairs of views.
    pub fn with_pairs() -> Self {
        Self { strides: PAIR_STRIDES, ..Self::default() }
    }

    /// Why no network can have this shape; `None` where one can.
    pub fn defect(&self) -> Option<String> {
        let most = Self::MOST;
        let sizes = [
            ("state", self.state, 1..=most.state),
            ("selections", self.selections, 1..=most.selections),
            ("blocks", self.blocks, 1..=most.blocks),
            ("encoding", self.encoding, 1..=most.encoding),
            ("strides", self.strides, 0..=most.strides),
        ];
        let (name, size, range) = sizes.into_iter().find(|(_, size, range)| !range.contains(size))?;
        Some(format!("shape.{name} is {size}, not in {range:?}"))
    }

    /// Every array's rows and columns, as a network.
    pub fn arrays(&self) -> SubspaceNet<[usize; 2]> {
        let Self { state, selections, blocks, encoding, strides } = *self;
        let layer = |outputs, inputs| Layer { weight: [outputs, inputs], bias: [outputs, 1] };
        let asks = strides > 0;
        let of_pairs = if asks { PAIR_FEATURES } else { 0 };
        let block = Block {
            selection: layer(selections, state),
            encoder: layer(encoding, selections + PLACE_FEATURES + of_pairs),
            hidden: layer(state, state + 2 * encoding + 2 * selections),
            change: layer(state, 2 * state),
            logit: layer(1, state),
            log_ridge: [selections, 1],
            depth_rate: [1, 1],
            pairs: asks.then(|| PairLayers { trust: layer(strides, state), log_scale: [strides, 1] }),
        };
        SubspaceNet {
            first_encoder: layer(encoding, FIRST_FEATURES),
            first_state: layer(state, 2 * encoding),
            blocks: vec![block; blocks],
            observation_hidden: layer(encoding, 2 * selections + PLACE_FEATURES + 1 + state + of_pairs),
            observation_logit: layer(1, encoding),
        }
    }
}

impl<T> Layer<T> {
    fn map<'a, U>(&'a self, f: &mut impl FnMut(&'a T) -> U) -> Layer<U> {
        Layer { weight: f(&self.weight), bias: f(&self.bias) }
    }
}

impl<T> Block<T> {
    fn map<'a, U>(&'a self, f: &mut impl FnMut(&'a T) -> U) -> Block<U> {
        Block {
            selection: self.selection.map(f),
            encoder: self.encoder.map(f),
            hidden: self.hidden.map(f),
            change: self.change.map(f),
            logit: self.logit.map(f),
            log_ridge: f(&self.log_ridge),
            depth_rate: f(&self.depth_rate),
            pairs: self
                .pairs
                .as_ref()
                .map(|pairs| PairLayers { trust: pairs.trust.map(f), log_scale: f(&pairs.log_scale) }),
        }
    }
}

impl<T> SubspaceNet<T> {
    /// Something for each array, in a fixed order: that of [`Self::arrays`] and of the file.
    pub fn map<'a, U>(&'a self, mut f: impl FnMut(&'a T) -> U) -> SubspaceNet<U> {
        let f = &mut f;
        SubspaceNet {
            first_encoder: self.first_encoder.map(f),
            first_state: self.first_state.map(f),
            blocks: self.blocks.iter().map(|block| block.map(f)).collect(),
            observation_hidden: self.observation_hidden.map(f),
            observation_logit: self.observation_logit.map(f),
        }
    }

    /// Every array, in the order of [`Self::map`].
    pub fn arrays(&self) -> Vec<&T> {
        let mut arrays = Vec::new();
        self.map(|array| arrays.push(array));
        arrays
    }

    /// Every array, in the same order, to be changed.
    pub fn arrays_mut(&mut self) -> Vec<&mut T> {
        let Self { first_encoder, first_state, blocks, observation_hidden, observation_logit } = self;
        let mut arrays = Vec::new();
        for layer in [first_encoder, first_state] {
            arrays.extend([&mut layer.weight, &mut layer.bias]);
        }
        for Block { selection, encoder, hidden, change, logit, log_ridge, depth_rate, pairs } in blocks {
            for layer in [selection, encoder, hidden, change, logit] {
                arrays.extend([&mut layer.weight, &mut layer.bias]);
            }
            arrays.extend([log_ridge, depth_rate]);
            if let Some(PairLayers { trust, log_scale }) = pairs {
                arrays.extend([&mut trust.weight, &mut trust.bias, log_scale]);
            }
        }
        for layer in [observation_hidden, observation_logit] {
            arrays.extend([&mut layer.weight, &mut layer.bias]);
        }
        arrays
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_shape_has_the_size_it_is_said_to_have() {
        let numbers: usize = Shape::default().arrays().arrays().iter().map(|[rows, columns]| rows * columns).sum();
        assert_eq!(numbers, 30_205);
    }

    #[test]
    fn arrays_have_one_order() {
        for shape in [Shape::default(), Shape::with_pairs()] {
            let mut network = shape.arrays();
            let expected: Vec<[usize; 2]> = network.arrays().into_iter().copied().collect();
            let found: Vec<[usize; 2]> = network.arrays_mut().into_iter().map(|shape| *shape).collect();
            assert_eq!(found, expected);
        }
    }

    #[test]
    fn pairs_add_arrays_and_inputs_only() {
        let numbers =
            |shape: Shape| shape.arrays().arrays().iter().map(|[rows, columns]| rows * columns).sum::<usize>();
        let Shape { state, blocks, encoding, strides, .. } = Shape::with_pairs();
        let of_layers = blocks * strides * (state + 2);
        let of_inputs = (blocks + 1) * encoding * PAIR_FEATURES;
        assert_eq!(numbers(Shape::with_pairs()), numbers(Shape::default()) + of_layers + of_inputs);
    }

    #[test]
    fn a_shape_without_pairs_does_not_speak_of_them() {
        let text = |shape: Shape| serde_json::to_string(&shape).expect("plain numbers");
        assert_eq!(text(Shape::default()), r#"{"state":32,"selections":4,"blocks":6,"encoding":16}"#);
        for shape in [Shape::default(), Shape::with_pairs()] {
            assert_eq!(serde_json::from_str::<Shape>(&text(shape)).expect("a shape"), shape);
        }
    }

    #[test]
    fn shapes_that_no_network_has_are_named() {
        assert_eq!(Shape::default().defect(), None);
        let none = Shape { selections: 0, ..Shape::default() };
        assert_eq!(none.defect().as_deref(), Some("shape.selections is 0, not in 1..=16"));
        let giant = Shape { blocks: usize::MAX, ..Shape::default() };
        assert!(giant.defect().is_some_and(|defect| defect.starts_with("shape.blocks is ")));
        let far = Shape { strides: 5, ..Shape::default() };
        assert_eq!(far.defect().as_deref(), Some("shape.strides is 5, not in 0..=4"));
        assert_eq!(Shape::with_pairs().defect(), None);
    }
}
