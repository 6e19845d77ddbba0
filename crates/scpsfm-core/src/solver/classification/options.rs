//! The thresholds of the classification, with their reasons.

options! {
    /// How the residuals of right observations are distributed, and how tracks are judged by them.
    pub struct ClassificationOptions {
        /// Share of right observations in the tail, before it is known, and the tail's width in units of the core.
        /// Feature detectors have a core of .1 to .3 px and tails that a Gaussian of that width would call impossible;
        /// together with the uniform outliers this puts the gate at 12 to 17 core deviations, where real sequences want
        /// it (15 to 20).
        tail_share: f64 = 0.05,
        tail_width: f64 = 3.0,
        /// Bounds of the share that is estimated. Noise without a tail still has a rare blunder that is no wrong match.
        tail_bounds: (f64, f64) = (0.001, 0.2),
        /// Observations from which the share is estimated, and those that it is estimated from at most, evenly taken.
        least_tail_observations: usize = 100,
        /// They tell a share of .05 to .0015.
        most_tail_observations: usize = 20_000,
        /// Rounds of the estimation. It converges in five.
        tail_rounds: usize = 10,
        /// Prior probability that a single observation of a right track is wrong.
        wrong_observation: f64 = 0.05,
        /// Least spread of the points of an image, image sides. Half of them within a thousandth are no picture of
        /// anything.
        least_spread: f64 = 1e-3,
        /// Points from which a view counts for the density of wrong observations. The spread of eight is known to a
        /// third.
        least_points: usize = 8,
        /// Share of the observations of right tracks that a view must keep under a METRIC calibration. Views of a second
        /// camera that was not declared kept .09 to .17 in one scene and .19 to .58 in another; the views of the first
        /// 120 scenes of `evaluate --photographed`, up to 70 % of whose tracks are wrong, .46 and more.
        least_kept_share: f64 = 0.33,
        /// Refinement steps of a point.
        point_steps: usize = 10,
        /// The same before an observation far beyond the gate is dropped. Which is the worst shows early, and of a
        /// wrong track four in ten observations are dropped one after the other.
        dropping_steps: usize = 4,
        /// Gates from which on the further steps bring no observation back. Twice the distance.
        far_gates: f64 = 4.0,
    }
}
