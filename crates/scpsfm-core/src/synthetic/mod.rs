//! The paper's synthetic scenes (its section 5.1), scenes that depart from them, scenes as people photograph them, and
//! the metrics to judge answers on all of these; and the training scenes of a learned prior ([`training_scenes`]).
//!
//! May depend on `domain` only, plus linear algebra.

pub mod metrics;
pub mod photographed;
pub mod scene;
pub mod sequence;
pub mod training_scenes;

pub use photographed::{Photographed, PhotographedOptions, PhotographedTruth};
pub use scene::{Motion, NoiseKind, OutlierKind, Scene, SceneOptions, Shape, Truth};
pub use sequence::{Sequence, SequenceOptions, SequenceTruth};
