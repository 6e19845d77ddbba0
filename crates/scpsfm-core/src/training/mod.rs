//! Training of the [soft-subspace network](crate::network::subspace) on scenes drawn on the fly: what `scpsfm
//! train-prior` runs. May depend on `network` and `synthetic` only.
//!
//! A step draws a few batches of scenes, differentiates each on burn's tape (on a thread of its own where there are
//! cores), averages the derivatives in a fixed order and takes one step of Adam. Everything is counted in
//! steps, nothing in seconds: one seed gives one network on one machine, however many cores it has and however often
//! the training was interrupted.

mod adam;
mod gradient;
mod initial;
mod labelled;
mod objective;
mod pairs;
mod tape;
#[cfg(test)]
mod tests;
mod trainer;
mod unlabelled;

pub use objective::Objective;
pub use trainer::{Milestone, Settings, Trainer};

/// Why training could not go on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// burn returned something other than what it was asked for.
    #[error("the tensor backend failed: {0}")]
    Backend(String),
    /// The state of an interrupted training cannot be taken up.
    #[error("{0}")]
    State(String),
    /// What the network made of its tracks is not finite.
    #[error("the tracks have no singular values: the network's columns are not finite")]
    NoDecomposition,
    /// Too many steps in a row had no finite gradient.
    #[error("the network diverged in step {step}: no finite gradient in {rejected} steps")]
    Diverged { step: u64, rejected: u64 },
}
