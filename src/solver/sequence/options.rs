//! The thresholds of growing a reconstruction, with their reasons.

use crate::geometry::bundle::{Loss, Options};

/// How views are added.
#[derive(Debug, Clone, PartialEq)]
pub struct GrowthOptions {
    /// Points that a view must see before it is tried, and that must agree with its camera.
    pub least_agreeing: usize,
    /// Share of the points seen that must agree.
    pub least_share: f64,
    /// Points of a view beyond which its camera is not made better.
    pub most_points: usize,
    /// Growth of the points that a view sees after which a failed one is tried again: fewer new ones hardly change its
    /// odds.
    pub retry_growth: f64,
    /// Trials of a view by a component.
    pub most_trials: usize,
    /// Whether a view that joins may give tracks their points, so that its tracks are triangulated at once.
    pub gives_points: bool,
    /// Growth of the registered views after which all are adjusted. A geometric growth keeps the cost of all
    /// adjustments together at six times that of the last.
    pub adjust_growth: f64,
    /// Views at most.
    pub most_views: usize,
    /// Observations of a view that an adjustment holds while more views are to come.
    pub of_view: usize,
    /// Iterations of such an adjustment, and of each of the last ones.
    pub growing_iterations: usize,
    pub final_iterations: usize,
    /// Rounds of adjusting and triangulating that end the growth; the third moves nothing that a gate would see.
    pub final_rounds: usize,
    /// Cost gained by a step, as a share, below which an adjustment that will be repeated ends.
    pub tolerance: f64,
    /// Scale of the Cauchy loss in units of the core noise: detectors have tails that a wider one would follow.
    pub cauchy_scale: f64,
    /// Noise that may be found, in that of the start: what fits four times worse is wrong, and without a bound wrong
    /// observations widen their own gates.
    pub noise_growth: f64,
}

impl GrowthOptions {
    /// Of metric cameras.
    pub const METRIC: Self = Self {
        // Three determine a pose, and each of the other five agrees with a wrong one by chance in one case of a
        // hundred.
        least_agreeing: 8,
        // Below, the samples of the robust pose do not suffice.
        least_share: 0.1,
        most_points: 2_000,
        retry_growth: 1.2,
        // By the last it sees some 1.7 times the points of the first.
        most_trials: 4,
        gives_points: true,
        adjust_growth: 1.2,
        most_views: usize::MAX,
        of_view: 100,
        growing_iterations: 6,
        final_iterations: 20,
        final_rounds: 3,
        tolerance: 1e-4,
        cauchy_scale: 2.0,
        noise_growth: 4.0,
    };

    /// Of projective cameras.
    pub const PROJECTIVE: Self = Self {
        // Six determine a camera, and each of the others agrees with a wrong one by chance in a few cases of a
        // thousand.
        least_agreeing: 9,
        // More than the three tenths down to which resection is reliable.
        least_share: 0.4,
        most_points: 500,
        most_trials: usize::MAX,
        // Projective adjustment is cubic in them.
        most_views: 100,
        of_view: 150,
        final_iterations: 10,
        ..Self::METRIC
    };

    /// How to adjust at this core noise.
    pub fn adjustment(&self, max_iterations: usize, noise: f64) -> Options {
        let loss = Loss::Cauchy { scale: self.cauchy_scale * noise };
        Options { max_iterations, relative_tolerance: self.tolerance, loss, ..Options::default() }
    }
}
