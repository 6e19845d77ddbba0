//! The thresholds of the projective growth, with their reasons.

use super::adjust::{CAUCHY_SCALE, TOLERANCE};

/// How a projective reconstruction grows.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectiveOptions {
    /// Observations that must agree with a point for it to take part: two make it, one verifies it.
    pub least_support: usize,
    /// Points that a view must see and that must agree with its camera: six determine it, and each of the others agrees
    /// with a wrong one by chance in a few cases of a thousand.
    pub least_agreeing: usize,
    /// Share of the points seen that must agree: more than the three tenths down to which resection is reliable.
    pub least_share: f64,
    /// Points of a view beyond which its camera is not made better.
    pub most_resected: usize,
    /// Growth of the points that a view sees after which a failed one is tried again.
    pub retry_growth: f64,
    /// Growth of the registered views after which all are adjusted.
    pub adjust_growth: f64,
    /// Views at most: projective adjustment is cubic in them.
    pub most_views: usize,
    /// Observations of a view that an adjustment holds.
    pub of_view: usize,
    /// Iterations of an adjustment while growing, and of each of the last ones.
    pub growing_iterations: usize,
    pub final_iterations: usize,
    /// Rounds of adjusting and triangulating that end the growth; the third moves nothing that a gate would see.
    pub final_rounds: usize,
    /// Cost gained by a step, as a share, below which an adjustment that will be repeated ends.
    pub tolerance: f64,
    /// Scale of the Cauchy loss in units of the noise: as of metric adjustments.
    pub cauchy_scale: f64,
    /// Noise that may be found, in that of the start: without a bound wrong observations widen their own gates.
    pub noise_growth: f64,
}

impl Default for ProjectiveOptions {
    fn default() -> Self {
        Self {
            least_support: 3,
            least_agreeing: 9,
            least_share: 0.4,
            most_resected: 500,
            retry_growth: 1.2,
            adjust_growth: 1.2,
            most_views: 100,
            of_view: 150,
            growing_iterations: 6,
            final_iterations: 10,
            final_rounds: 3,
            tolerance: TOLERANCE,
            cauchy_scale: CAUCHY_SCALE,
            noise_growth: 4.0,
        }
    }
}
