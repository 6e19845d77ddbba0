//! The thresholds of an attempt, with their reasons.

options! {
    /// How much of a block is searched and calibrated, and what its residuals say.
    pub struct AttemptOptions {
        /// Tracks that a search looks at, at most and where there are many views. Bundle adjustment costs their number
        /// times the square of the views, and more tracks make a consensus neither easier to find nor much more exact.
        searched_tracks: (usize, usize) = (600, 200),
        /// Tracks times squared views that a search may hold between those two.
        searched_work: usize = 60_000,
        /// Inlier tracks, and observations of them, that a calibration is made from. Beyond, it takes minutes, and
        /// other errors than noise bound what it gives.
        most_calibrated: usize = 600,
        calibrated_observations: usize = 20_000,
        /// Standard deviation of the log focal length that an undone lens stands for where the camera did not turn. The
        /// last step between sampled lenses is 1.5 %.
        undone_sigma: f64 = 0.02,
        /// Tracks that PAPER and SCPSFM optimise weights for, in up to 16 optimisations a block. The most that the
        /// recipe was measured with (20 views).
        network_tracks: usize = 1_000,
        /// Median of the squared residuals over their mean, below which they are of several kinds. One normal noise
        /// gives .69. Measured on scenes of ten views and 200 tracks with depths: .60 to .80 in 150 of noise 3 to 11 %;
        /// .15 to .49 in the 46 that were first fitted at too high a noise of 120 with one to three wrong observations
        /// in every right track.
        least_median_share: f64 = 0.5,
    }
}
