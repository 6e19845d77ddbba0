//! What the network is told.

use crate::domain::{Backend, SolveSettings};

/// Settings of one optimisation; the defaults and their reasons are those of [`SolveSettings`].
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkSettings {
    /// Width of the PointNet as a share of the original.
    pub width: f64,
    /// Weight of L_proj; of the continued objective, at the first iteration.
    pub alpha: f64,
    /// Weight of L_DAQ.
    pub beta: f64,
    /// The paper's `t`; of the continued objective, at the first iteration.
    pub min_inliers: f64,
    /// Slope of the sigmoid in L_num; the continued objective has none.
    pub kappa: f64,
    /// Adam's learning rate.
    pub learning_rate: f64,
    /// Iterations of a head.
    pub iterations: u32,
    /// Whether L_DAQ is optimised. Its value is reported either way.
    pub use_daq: bool,
    /// Of the initial weights, and of how heads differ.
    pub seed: u64,
    pub backend: Backend,
}

impl From<&SolveSettings> for NetworkSettings {
    fn from(settings: &SolveSettings) -> Self {
        Self {
            width: settings.network_width,
            alpha: settings.alpha,
            beta: settings.beta,
            min_inliers: settings.min_inliers,
            kappa: settings.kappa,
            learning_rate: settings.learning_rate,
            iterations: settings.iterations,
            use_daq: settings.use_daq,
            seed: settings.seed,
            backend: settings.backend.unwrap_or_default(),
        }
    }
}

impl Default for NetworkSettings {
    fn default() -> Self {
        Self::from(&SolveSettings::default())
    }
}
