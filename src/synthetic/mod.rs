//! The paper's synthetic scenes (its section 5.1) and the metrics to judge answers on them.
//!
//! May depend on `domain` only, plus linear algebra.

pub mod metrics;
pub mod scene;

pub use scene::{Scene, SceneOptions, Truth};
