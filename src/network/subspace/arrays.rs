//! The network's arrays, or something for each of them: its values, their tensors, their gradients.

use serde::{Deserialize, Serialize};

/// A linear layer: `weight` is outputs x inputs, `bias` outputs x 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Layer<T> {
    pub weight: T,
    pub bias: T,
}

/// One block; see [the architecture](super).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Block<T> {
    /// State to the logits of the selections, H x C.
    pub selection: Layer<T>,
    /// Observation to its encoding, E x (H + 3).
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
}

/// The whole network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SubspaceNet<T> {
    /// Observation (place, offset from the track's mean place, its squares, visible) to its encoding, E x 7.
    pub first_encoder: Layer<T>,
    /// Pooled encodings to the first state, C x 2E.
    pub first_state: Layer<T>,
    pub blocks: Vec<Block<T>>,
    /// Residuals (H), image residuals (H), place, visible, the track's mean residual, its state to E.
    pub observation_hidden: Layer<T>,
    /// That to the observation's logit, 1 x E.
    pub observation_logit: Layer<T>,
}

/// Numbers that an observation's first encoding is made from.
pub const FIRST_FEATURES: usize = 7;
/// Numbers beside the residuals that an observation's later encodings are made from: place and visible.
pub const PLACE_FEATURES: usize = 3;

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
}

impl Default for Shape {
    /// The sizes that the curriculum was found with: 30,205 numbers, about 1.5 ms for 10 x 200.
    fn default() -> Self {
        Self { state: 32, selections: 4, blocks: 6, encoding: 16 }
    }
}

impl Shape {
    /// Above these a file is not a network that this program would run for a request.
    const MOST: Shape = Shape { state: 256, selections: 16, blocks: 32, encoding: 128 };

    /// Why no network can have this shape; `None` where one can.
    pub fn defect(&self) -> Option<String> {
        let most = Self::MOST;
        let sizes = [
            ("state", self.state, most.state),
            ("selections", self.selections, most.selections),
            ("blocks", self.blocks, most.blocks),
            ("encoding", self.encoding, most.encoding),
        ];
        let (name, size, most) = sizes.into_iter().find(|&(_, size, most)| !(1..=most).contains(&size))?;
        Some(format!("shape.{name} is {size}, not in 1..={most}"))
    }

    /// Every array's rows and columns, as a network.
    pub fn arrays(&self) -> SubspaceNet<[usize; 2]> {
        let Self { state, selections, blocks, encoding } = *self;
        let layer = |outputs, inputs| Layer { weight: [outputs, inputs], bias: [outputs, 1] };
        let block = Block {
            selection: layer(selections, state),
            encoder: layer(encoding, selections + PLACE_FEATURES),
            hidden: layer(state, state + 2 * encoding + 2 * selections),
            change: layer(state, 2 * state),
            logit: layer(1, state),
            log_ridge: [selections, 1],
            depth_rate: [1, 1],
        };
        SubspaceNet {
            first_encoder: layer(encoding, FIRST_FEATURES),
            first_state: layer(state, 2 * encoding),
            blocks: vec![block; blocks],
            observation_hidden: layer(encoding, 2 * selections + PLACE_FEATURES + 1 + state),
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
        for Block { selection, encoder, hidden, change, logit, log_ridge, depth_rate } in blocks {
            for layer in [selection, encoder, hidden, change, logit] {
                arrays.extend([&mut layer.weight, &mut layer.bias]);
            }
            arrays.extend([log_ridge, depth_rate]);
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
        let mut network = Shape::default().arrays();
        let expected: Vec<[usize; 2]> = network.arrays().into_iter().copied().collect();
        let found: Vec<[usize; 2]> = network.arrays_mut().into_iter().map(|shape| *shape).collect();
        assert_eq!(found, expected);
    }

    #[test]
    fn shapes_that_no_network_has_are_named() {
        assert_eq!(Shape::default().defect(), None);
        let none = Shape { selections: 0, ..Shape::default() };
        assert_eq!(none.defect().as_deref(), Some("shape.selections is 0, not in 1..=16"));
        let giant = Shape { blocks: usize::MAX, ..Shape::default() };
        assert!(giant.defect().is_some_and(|defect| defect.starts_with("shape.blocks is ")));
    }
}
