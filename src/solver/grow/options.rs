//! The thresholds of growing a consensus and of settling its noise, with their reasons.

use crate::geometry::bundle::Loss;

/// How a seed grows to a consensus.
#[derive(Debug, Clone, PartialEq)]
pub struct ConsensusOptions {
    /// Rounds of growing at most, and those without a better consensus after which it ends.
    pub rounds: usize,
    pub idle_rounds: usize,
    /// Bundle adjustment iterations of the first rounds, how many rounds these are, and iterations of the later ones.
    pub first_iterations: usize,
    pub first_rounds: usize,
    pub later_iterations: usize,
    /// Refinement steps of a triangulated point.
    pub point_steps: usize,
    /// Scale of the Cauchy loss in units of the noise.
    pub cauchy_scale: f64,
    /// Supports up to this size are fitted without a robust loss.
    pub plain_support: usize,
    /// Tracks whose linear residual is this many gates away are not refined.
    pub hopeless_gates: f64,
    /// Growth of the support while the gate admits more tracks than it holds, and while it does not.
    pub fast_growth: f64,
    pub careful_growth: f64,
    /// Share of the support that the gate must admit for the support to become what it admits.
    pub caught_up: f64,
    /// Gates within which the next track must lie for a support to grow that the gate does not confirm.
    pub near_gates: f64,
    /// Inflations of the gate while polishing, and how often they are gone through.
    pub polish_inflations: [f64; 6],
    pub polish_rounds: usize,
}

impl ConsensusOptions {
    pub const DEFAULT: Self = Self {
        // A true seed needs five to ten.
        rounds: 30,
        idle_rounds: 3,
        first_iterations: 12,
        first_rounds: 3,
        // They start close to the optimum.
        later_iterations: 8,
        point_steps: 6,
        // Residuals beyond it are on their way to being outliers.
        cauchy_scale: 3.0,
        // There is nothing to spare yet.
        plain_support: 8,
        // No refinement brings them back.
        hopeless_gates: 100.0,
        fast_growth: 1.5,
        careful_growth: 1.15,
        caught_up: 0.8,
        near_gates: 30.0,
        polish_inflations: [8.0, 4.0, 2.0, 1.0, 1.0, 1.0],
        polish_rounds: 2,
    };

    /// Robust loss at a noise level.
    pub fn loss(&self, noise: f64) -> Loss {
        Loss::Cauchy { scale: self.cauchy_scale * noise }
    }
}

/// How the noise of a consensus is settled.
#[derive(Debug, Clone, PartialEq)]
pub struct NoiseOptions {
    /// Rounds of re-estimating it.
    pub rounds: usize,
    /// Relative change below which it has settled.
    pub settled: f64,
    /// Bounds of the estimate, normalised units.
    pub bounds: (f64, f64),
    /// Higher levels, in units of the consensus's own, from which it settles too.
    pub higher: [f64; 2],
    /// Settled noise, in units of that the consensus was found at, below which its gate was wide enough to lose
    /// nothing.
    pub surely_high: f64,
}

impl NoiseOptions {
    pub const DEFAULT: Self = Self {
        // From ten times too high two or three suffice.
        rounds: 6,
        settled: 0.05,
        // A hundredth of a pixel in a 10,000 px image, and a tenth of the image.
        bounds: (1e-6, 0.1),
        higher: [2.0, 4.0],
        surely_high: 0.75,
    };

    /// The noise within the bounds of an estimate.
    pub fn clamp(&self, noise: f64) -> f64 {
        noise.clamp(self.bounds.0, self.bounds.1)
    }
}
