//! The thresholds of growing a consensus and of settling its noise, with their reasons.

use crate::geometry::bundle::Loss;

options! {
    /// How a seed grows to a consensus.
    pub struct ConsensusOptions {
        /// Rounds of growing at most, and those without a better consensus after which it ends. A true seed needs five
        /// to ten.
        rounds: usize = 30,
        idle_rounds: usize = 3,
        /// Bundle adjustment iterations of the first rounds, how many rounds these are, and iterations of the later
        /// ones.
        first_iterations: usize = 12,
        first_rounds: usize = 3,
        /// They start close to the optimum.
        later_iterations: usize = 8,
        /// Refinement steps of a triangulated point.
        point_steps: usize = 6,
        /// Scale of the Cauchy loss in units of the noise. Residuals beyond it are on their way to being outliers.
        cauchy_scale: f64 = 3.0,
        /// Supports up to this size are fitted without a robust loss. There is nothing to spare yet.
        plain_support: usize = 8,
        /// Tracks whose linear residual is this many gates away are not refined. No refinement brings them back.
        hopeless_gates: f64 = 100.0,
        /// Growth of the support while the gate admits more tracks than it holds, and while it does not.
        fast_growth: f64 = 1.5,
        careful_growth: f64 = 1.15,
        /// Share of the support that the gate must admit for the support to become what it admits.
        caught_up: f64 = 0.8,
        /// Gates within which the next track must lie for a support to grow that the gate does not confirm.
        near_gates: f64 = 30.0,
        /// Inflations of the gate while polishing, and how often they are gone through.
        polish_inflations: [f64; 6] = [8.0, 4.0, 2.0, 1.0, 1.0, 1.0],
        polish_rounds: usize = 2,
    }
}

impl ConsensusOptions {
    /// Robust loss at a noise level.
    pub fn loss(&self, noise: f64) -> Loss {
        Loss::Cauchy { scale: self.cauchy_scale * noise }
    }
}

options! {
    /// How the noise of a consensus is settled.
    pub struct NoiseOptions {
        /// Rounds of re-estimating it. From ten times too high two or three suffice.
        rounds: usize = 6,
        /// Relative change below which it has settled.
        settled: f64 = 0.05,
        /// Bounds of the estimate, normalised units. A hundredth of a pixel in a 10,000 px image, and a tenth of the
        /// image.
        bounds: (f64, f64) = (1e-6, 0.1),
        /// Higher levels, in units of the consensus's own, from which it settles too.
        higher: [f64; 2] = [2.0, 4.0],
        /// Settled noise, in units of that the consensus was found at, below which its gate was wide enough to lose
        /// nothing.
        surely_high: f64 = 0.75,
    }
}

impl NoiseOptions {
    /// The noise within the bounds of an estimate.
    pub fn clamp(&self, noise: f64) -> f64 {
        noise.clamp(self.bounds.0, self.bounds.1)
    }
}
