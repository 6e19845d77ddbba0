//! The thresholds of the classification, with their reasons.

options! {
    /// How tracks are judged by their residuals.
    pub struct ClassificationOptions {
        /// Share of the observations of right tracks that a view must keep under a calibration. Views of a second
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
