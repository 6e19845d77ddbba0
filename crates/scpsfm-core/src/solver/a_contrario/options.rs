//! The thresholds of the verification against chance, with their reasons.

options! {
    /// When a consensus is not held to be chance, and how the tracks without structure are tried that say so.
    pub struct FalseAlarmOptions {
        /// Logarithm of the expected number of false alarms at which a consensus is decisive, for that is never by
        /// chance, and at which it may be accepted once the search has ended.
        ln_decisive: f64 = -40.0,
        ln_acceptable: f64 = -7.0,
        /// The same by the cameras, above which nothing is accepted. Refining makes them fit more than the seven tracks
        /// that determine them. Of 200 entirely wrong inputs of 3 to 10 views none is answered, and eight right tracks
        /// among 200 in ten views are.
        ln_by_cameras: f64 = -10.0,
        /// Noise levels that a consensus is grown and settled at, each a test of its own. Five of the search, one of
        /// the refinement.
        noise_levels: f64 = 6.0,
        /// Neighbours of a point that are no near-duplicates: as many as of points anywhere in the image, and so many
        /// standard deviations of their number (Poisson's).
        usual_sigmas: f64 = 2.0,
        /// Random tracks that cameras are tried on. Some milliseconds at 10 views, for the few consensuses that may be
        /// accepted.
        random_tracks: usize = 500,
        /// Share of random tracks whose residual is measured, and the standard normal quantile of that share; smaller
        /// residuals are extrapolated from there. Ten of 500 tracks: known to a third.
        measured_share: f64 = 0.02,
        measured_quantile: f64 = -2.053_749,
        /// What those residuals are at least, a constraint, as a share of the variance of the image points. Cameras
        /// that verify by that much need not be tried. Cameras that do not bend the images of a set of tracks leave a
        /// fiftieth of random tracks .06 (three views) to .4 (ten) of it, and what bends them is allowed to take most
        /// of that.
        least_measured: f64 = 0.01,
        /// Residuals that stand for those of the smallest share, and the least of them as a share of what the inliers
        /// leave. Ratios of 1.02 to 1.3 where cameras may be doubted.
        extrapolated: i32 = 64,
        /// What is smaller has next to no probability.
        least_extrapolated: f64 = 0.25,
        /// Bisections of the tilt of the distribution. Three digits.
        tilt_steps: usize = 12,
    }
}
