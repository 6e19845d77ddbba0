//! The thresholds of growing, adjusting and calibrating a sequence, with their reasons.

use std::ops::RangeInclusive;

use crate::geometry::bundle::{Loss, Options};
use crate::geometry::statistics::CHI_SQUARE_OF_TWO;
use crate::solver::view_selection::ViewSelectionOptions;

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

/// How a metric reconstruction is adjusted and its noise bounded.
#[derive(Debug, Clone, PartialEq)]
pub struct AdjustmentOptions {
    /// Views that are free in the adjustment around a new one: those that share most points with it.
    pub views_around: usize,
    /// Iterations around a new view.
    pub iterations_around: usize,
    /// Least share of the observations' freedom that is left to the residuals, however few landmarks there are.
    pub least_freedom: f64,
    /// Least noise that is believed, pixels.
    pub least_noise_px: f64,
}

impl AdjustmentOptions {
    pub const DEFAULT: Self = Self {
        views_around: 6,
        // They start at what was adjusted before.
        iterations_around: 3,
        least_freedom: 0.2,
        // Exact input would close every gate.
        least_noise_px: 0.01,
    };
}

/// How a block is extended metrically, and what is worth extending.
#[derive(Debug, Clone, PartialEq)]
pub struct ExtensionOptions {
    /// Angle between the rays from which the depth of a point is known well enough to support a pose, radians.
    pub least_angle: f64,
    /// The same for points that only two views see, which nothing verifies.
    pub least_angle_of_two: f64,
    /// Focal lengths that a view of a lens that is not known yet is tried with, in steps from that of another one, and
    /// the steps of an octave.
    pub other_focals: RangeInclusive<i32>,
    pub focals_per_octave: f64,
    /// Share of an extension's time before its calibration that registering takes, the rounds the rest.
    pub share_of_registering: f64,
    /// Share of the views that an extension must register for no other seed to be tried.
    pub enough_registered: f64,
    /// Growth of the retained observations, once each is judged by itself, from which a whole input is extended.
    pub worth_extending: f64,
    /// Subsets of a whole input that are tried before it is searched at length.
    pub first_subsets: usize,
    /// Evidence of a reconstruction, in that of one of the same views without a calibration, from which it is calibrated
    /// too.
    pub least_evidence_growth: f64,
}

impl ExtensionOptions {
    pub const DEFAULT: Self = Self {
        // At .3 degrees half a pixel of a thousand in either ray leaves a seventh of the depth open.
        least_angle: 0.005,
        // A twenty-eighth.
        least_angle_of_two: 0.02,
        // From a third to three times.
        other_focals: -6..=6,
        focals_per_octave: 4.0,
        // .71 and .67 as measured on 1,000 views with 350 and 87 observations a view.
        share_of_registering: 0.7,
        // One that carries most of them is a component of whatever another would lead to.
        enough_registered: 0.5,
        // With a tenth more of them sigma falls by a twentieth.
        worth_extending: 1.1,
        first_subsets: 3,
        // One that holds the same tracks differs by a few observations; a fiftieth more are others.
        least_evidence_growth: 1.02,
    };
}

/// How further components are looked for.
#[derive(Debug, Clone, PartialEq)]
pub struct ComponentOptions {
    /// Blocks that are tried for components at most, and how many may fail one after the other.
    pub most_components: u32,
    pub most_failures: usize,
    /// Deviation of the log focal length that other components are given, at least, where the first has one, and where
    /// it has none.
    pub prior_sigma: f64,
    pub vague_sigma: f64,
}

impl ComponentOptions {
    pub const DEFAULT: Self = Self {
        most_components: 100,
        // The best come first, and an input without overlap has any number of hopeless ones.
        most_failures: 3,
        // Components differ by more than each admits.
        prior_sigma: 0.02,
        // It only keeps them from running away.
        vague_sigma: 0.5,
    };
}

/// What of a sequence its calibration is made from.
#[derive(Debug, Clone, PartialEq)]
pub struct StretchOptions {
    /// Views that a calibration is compared with projective cameras on at most: of more, the stretch with most
    /// observations. A zoom is asked stretch after stretch.
    pub most_views: usize,
    /// Observations that a calibration is made from, and of one view at least and at most.
    pub observations: usize,
    pub of_view: (usize, usize),
    /// Squared standard deviations of the core within which an observation takes part: squares know no tails.
    pub core_squared: f64,
}

impl StretchOptions {
    pub const DEFAULT: Self = Self {
        // The adjustment of projective cameras is cubic in them, as that of a block.
        most_views: ViewSelectionOptions::DEFAULT.most_views_whole,
        // Other errors than noise bound what more of them would give.
        observations: 6_000,
        of_view: (50, 300),
        // One observation in a thousand is left out.
        core_squared: CHI_SQUARE_OF_TWO,
    };
}

/// How a sequence is divided into windows that check its calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct WindowOptions {
    /// Views of a window where there are many, and of the shortest one.
    pub views: usize,
    pub least_views: usize,
    /// Windows at most, evenly spread over the sequence.
    pub most_windows: usize,
    /// Observations of a view that a window holds.
    pub of_view: usize,
    /// Distance of the windows' focal length from that of all views, in standard deviations of the former, beyond which
    /// it is no chance.
    pub significant_distance: f64,
}

impl WindowOptions {
    pub const DEFAULT: Self = Self {
        views: 10,
        // Below, a window says little of a focal length.
        least_views: 4,
        // A variance of 50 values is known to a fifth.
        most_windows: 50,
        of_view: 150,
        // Chance takes one in four hundred that far.
        significant_distance: 3.0,
    };
}
