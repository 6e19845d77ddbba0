//! What training minimises.

use burn_tensor::Tensor;
use serde::{Deserialize, Serialize};

/// Weight of the first block's tracks; the last one's is 1, linear between (deep supervision: early blocks learn to
/// rank, later ones to refine).
const FIRST_BLOCK: f64 = 0.3;

/// Where a network learns from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum Objective {
    /// The generator's labels, by cross-entropy.
    #[default]
    Labels,
    /// No labels: the paper's L_num and L_proj, over many scenes instead of one.
    PaperLosses,
}

impl Objective {
    /// What the two parts of its loss are called.
    pub fn parts(self) -> [&'static str; 2] {
        match self {
            Self::Labels => ["tracks", "observations"],
            Self::PaperLosses => ["L_num", "L_proj"],
        }
    }
}

/// The loss of a batch, and the parts of it that are told apart.
pub struct Loss {
    pub total: Tensor<1>,
    pub parts: [Tensor<1>; 2],
}

/// Share of a block's tracks in the loss; those of all `blocks` sum to 1.
pub fn importance(block: usize, blocks: usize) -> f64 {
    let weight = |block: usize| FIRST_BLOCK + (1.0 - FIRST_BLOCK) * (block + 1) as f64 / blocks as f64;
    weight(block) / (0..blocks).map(weight).sum::<f64>()
}
