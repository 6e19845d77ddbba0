//! The thresholds of the verification against chance, with their reasons.

/// When a consensus is not held to be chance, and how the tracks without structure are tried that say so.
#[derive(Debug, Clone, PartialEq)]
pub struct FalseAlarmOptions {
    /// Logarithm of the expected number of false alarms at which a consensus is decisive, and at which it may be
    /// accepted once the search has ended.
    pub ln_decisive: f64,
    pub ln_acceptable: f64,
    /// The same by the cameras, above which nothing is accepted.
    pub ln_by_cameras: f64,
    /// Noise levels that a consensus is grown and settled at, each a test of its own.
    pub noise_levels: f64,
    /// Neighbours of a point that are no near-duplicates: as many as of points anywhere in the image, and so many
    /// standard deviations of their number (Poisson's).
    pub usual_sigmas: f64,
    /// Random tracks that cameras are tried on.
    pub random_tracks: usize,
    /// Share of random tracks whose residual is measured, and the standard normal quantile of that share; smaller
    /// residuals are extrapolated from there.
    pub measured_share: f64,
    pub measured_quantile: f64,
    /// What those residuals are at least, a constraint, as a share of the variance of the image points. Cameras that
    /// verify by that much need not be tried.
    pub least_measured: f64,
    /// Residuals that stand for those of the smallest share, and the least of them as a share of what the inliers
    /// leave.
    pub extrapolated: i32,
    pub least_extrapolated: f64,
    /// Bisections of the tilt of the distribution.
    pub tilt_steps: usize,
}

impl FalseAlarmOptions {
    pub const DEFAULT: Self = Self {
        // Never by chance.
        ln_decisive: -40.0,
        ln_acceptable: -7.0,
        // Refining makes them fit more than the seven tracks that determine them. Of 200 entirely wrong inputs of 3 to
        // 10 views none is answered, and eight right tracks among 200 in ten views are.
        ln_by_cameras: -10.0,
        // Five of the search, three of the refinement.
        noise_levels: 8.0,
        usual_sigmas: 2.0,
        // Some milliseconds at 10 views, for the few consensuses that may be accepted.
        random_tracks: 500,
        // Ten of 500 tracks: known to a third.
        measured_share: 0.02,
        measured_quantile: -2.053_749,
        // Cameras that do not bend the images of a set of tracks leave a fiftieth of random tracks .06 (three views) to
        // .4 (ten) of it, and what bends them is allowed to take most of that.
        least_measured: 0.01,
        // Ratios of 1.02 to 1.3 where cameras may be doubted.
        extrapolated: 64,
        // What is smaller has next to no probability.
        least_extrapolated: 0.25,
        // Three digits.
        tilt_steps: 12,
    };
}
