//! The thresholds of the classification, with their reasons.

/// How the residuals of right observations are distributed, and how tracks are judged by them.
#[derive(Debug, Clone, PartialEq)]
pub struct ClassificationOptions {
    /// Share of right observations in the tail, before it is known, and the tail's width in units of the core.
    pub tail_share: f64,
    pub tail_width: f64,
    /// Bounds of the share that is estimated.
    pub tail_bounds: (f64, f64),
    /// Observations from which the share is estimated, and those that it is estimated from at most, evenly taken.
    pub least_tail_observations: usize,
    pub most_tail_observations: usize,
    /// Rounds of the estimation.
    pub tail_rounds: usize,
    /// Prior probability that a single observation of a right track is wrong.
    pub wrong_observation: f64,
    /// Least spread of the points of an image, image sides.
    pub least_spread: f64,
    /// Points from which a view counts for the density of wrong observations.
    pub least_points: usize,
    /// Refinement steps of a point.
    pub point_steps: usize,
    /// The same before an observation far beyond the gate is dropped.
    pub dropping_steps: usize,
    /// Gates from which on the further steps bring no observation back.
    pub far_gates: f64,
}

impl ClassificationOptions {
    pub const DEFAULT: Self = Self {
        // Feature detectors have a core of .1 to .3 px and tails that a Gaussian of that width would call impossible;
        // together with the uniform outliers this puts the gate at 12 to 17 core deviations, where real sequences want
        // it (15 to 20).
        tail_share: 0.05,
        tail_width: 3.0,
        // Noise without a tail still has a rare blunder that is no wrong match.
        tail_bounds: (0.001, 0.2),
        least_tail_observations: 100,
        // They tell a share of .05 to .0015.
        most_tail_observations: 20_000,
        // It converges in five.
        tail_rounds: 10,
        wrong_observation: 0.05,
        // Half of them within a thousandth are no picture of anything.
        least_spread: 1e-3,
        // The spread of eight is known to a third.
        least_points: 8,
        point_steps: 10,
        // Which is the worst shows early, and of a wrong track four in ten observations are dropped one after the
        // other.
        dropping_steps: 4,
        // Twice the distance.
        far_gates: 4.0,
    };
}
