//! The paper's synthetic scenes (its section 5.1), scenes that depart from them, and the metrics to judge answers on
//! both; and the training scenes of a learned prior ([`training_scenes`]).
//!
//! May depend on `domain` only, plus linear algebra.

pub mod metrics;
pub mod scene;
pub mod sequence;
pub mod training_scenes;

pub use scene::{Motion, NoiseKind, OutlierKind, Scene, SceneOptions, Shape, Truth};
pub use sequence::{Sequence, SequenceOptions, SequenceTruth};
