//! The thresholds of growing a consensus, with their reasons.

options! {
    /// How a seed grows to a consensus.
    pub struct GrowingOptions {
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
        /// Supports up to this size are fitted without a robust loss. There is nothing to spare yet.
        plain_support: usize = 8,
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
