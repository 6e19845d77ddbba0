//! The thresholds of growing, adjusting and calibrating a sequence, with their reasons.

use std::ops::RangeInclusive;

use crate::geometry::bundle::{Loss, Options};
use crate::geometry::statistics::CHI_SQUARE_OF_TWO;
use crate::solver::consensus;
use crate::solver::view_selection::ViewSelectionOptions;

options! {
    /// How views are added; the values are those of metric cameras.
    pub struct GrowthOptions {
        /// Points that a view must see before it is tried, and that must agree with its camera. Three determine a pose.
        /// Each of the other five agrees with a wrong one by chance in four cases of ten thousand at a noise of a
        /// thousandth of the image, in four of a thousand at three thousandths; some thousand poses are tried.
        least_agreeing: usize = 8,
        /// Share of the points seen that must agree. Below, the samples of the robust pose do not suffice.
        least_share: f64 = 0.1,
        /// Points of a view beyond which its camera is not made better.
        most_points: usize = 2_000,
        /// Growth of the points that a view sees after which a failed one is tried again: fewer new ones hardly change
        /// its odds.
        retry_growth: f64 = 1.2,
        /// Trials of a view by a component. By the last it sees some 1.7 times the points of the first.
        most_trials: usize = 4,
        /// Points that must agree with a view for it to leave another component, in those that hold it there. One of
        /// the two is wrong or sees little of it; twice as many tell which, and no view goes back.
        moving_ratio: usize = 2,
        /// Whether a view that joins may give tracks their points, so that its tracks are triangulated at once.
        gives_points: bool = true,
        /// Growth of the registered views after which all are adjusted. A geometric growth keeps the cost of all
        /// adjustments together at six times that of the last.
        adjust_growth: f64 = 1.2,
        /// Views at most.
        most_views: usize = usize::MAX,
        /// Observations of a view that an adjustment holds while more views are to come.
        of_view: usize = 100,
        /// Iterations of such an adjustment, and of each of the last ones.
        growing_iterations: usize = 6,
        final_iterations: usize = 20,
        /// Rounds of adjusting and triangulating that end the growth; the third moves nothing that a gate would see.
        final_rounds: usize = 3,
        /// Cost gained by a step, as a share, below which an adjustment that will be repeated ends.
        tolerance: f64 = 1e-4,
        /// Scale of the Cauchy loss in units of the core noise: detectors have tails that a wider one would follow.
        cauchy_scale: f64 = 2.0,
        /// Noise that may be found, in that of the start: what fits four times worse is wrong, and without a bound
        /// wrong observations widen their own gates.
        noise_growth: f64 = 4.0,
    }
}

impl GrowthOptions {
    pub const METRIC: Self = Self::DEFAULT;

    /// Of the views that are left when nothing else joins, and of those that stay to the end: what a component of its own
    /// or a merger could take is not to be held by so few points. At the noise of images, three thousandths and less,
    /// three beside those of the pose agree with a wrong one once in ten million poses or less.
    pub const LAST: Self = Self { least_agreeing: 6, ..Self::METRIC };

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
        Options { max_iterations, relative_tolerance: self.tolerance, loss, ..Options::DEFAULT }
    }
}

options! {
    /// How a metric reconstruction is adjusted and its noise bounded.
    pub struct AdjustmentOptions {
        /// Views that are free in the adjustment around a new one: those that share most points with it.
        views_around: usize = 6,
        /// Iterations around a new view. They start at what was adjusted before.
        iterations_around: usize = 3,
        /// Least noise that is believed, pixels. Exact input would close every gate.
        least_noise_px: f64 = 0.01,
    }
}

options! {
    /// How a block is extended metrically, and what is worth extending.
    pub struct ExtensionOptions {
        /// Angle between the rays from which the depth of a point is known well enough to support a pose, radians. At
        /// .3 degrees half a pixel of a thousand in either ray leaves a seventh of the depth open.
        least_angle: f64 = 0.005,
        /// The same for points that only two views see, which nothing verifies. It leaves a twenty-eighth open.
        least_angle_of_two: f64 = 0.02,
        /// Focal lengths that a view of a lens that is not known yet is tried with, in steps from that of another one,
        /// and the steps of an octave. From a third to three times.
        other_focals: RangeInclusive<i32> = -6..=6,
        focals_per_octave: f64 = 4.0,
        /// Share of an extension's time before its calibration that registering takes, the rounds the rest. .71 and .67
        /// as measured on 1,000 views with 350 and 87 observations a view.
        share_of_registering: f64 = 0.7,
        /// Share of the views that an extension must register for no other seed to be tried. One that carries most of
        /// them is a component of whatever another would lead to.
        enough_registered: f64 = 0.5,
        /// Share of the observations that an extension must explain for no other seed to be tried. Of an input of which
        /// 70 % is wrong 30 % are right; a body that was calibrated in the place of the scene had 14 %.
        enough_explained: f64 = 0.25,
        /// Factor by which a calibrated lens may move an observation away from the principal point where the scene has
        /// depth. Pincushion lenses move corners by a tenth at most; in 540 scenes of `evaluate --photographed` no right
        /// calibration was above 1.08. A camera that turns behind a strong barrel lens fits as one that moves about a
        /// bowl behind a pincushion lens of 1.11 to 1.39.
        most_magnification: f64 = 1.1,
        /// Growth of the retained observations, once each is judged by itself, from which a whole input is extended.
        /// With a tenth more of them sigma falls by a twentieth.
        worth_extending: f64 = 1.1,
        /// Subsets that are tried of a whole input before it is searched at length.
        first_subsets: usize = 3,
        /// Evidence of a reconstruction, in that of one that was calibrated and has all of its views, from which it is
        /// calibrated too. One that holds the same tracks differs by a few observations; a fiftieth more are others.
        /// Calibrating each took 140 s instead of 26 where it took longest, for the same grade.
        least_evidence_growth: f64 = 1.02,
        /// Starts that lead to it again before no others are tried. Of 600 photographed scenes none has another answer
        /// so, and one takes a third of the time.
        enough_repeated: usize = 2,
        /// A reconstruction without a calibration replaces a calibrated one above this ratio of their evidence. A
        /// calibration of most views stands so; one of 12 of 35 views, with recall .13, stood before poses of 25 with
        /// recall .999.
        worth_of_calibration: f64 = 2.0,
        /// Noise from which an input is solved once more, in units of the assumed one: about that of a detector where
        /// the assumed one is the default. Two scenes of 307 that were mixed at 28 px are right from 1 px on.
        lower_noise: f64 = 0.1,
    }
}

options! {
    /// How three views that share tracks in pairs become a seed.
    pub struct TripletOptions {
        /// Noise of the matches, in units of what is assumed, which is rather too high: a dozen matches that agree
        /// within ten times their noise may do so by chance.
        noise_levels: [f64; 3] = [1.0, 0.3, 0.1],
        /// Tracks of a pair at most, evenly spread: as many as make a block no better.
        most_tracks: usize = ViewSelectionOptions::DEFAULT.enough_tracks,
        /// Iterations of the first adjustment of their cameras: those of an algebraic solution.
        iterations: usize = 30,
        /// Share of the tracks of the pairs of which the adjusted cameras must have a point. The matrix of another body
        /// contradicts the other two, as three matrices have three unknowns more than three cameras.
        least_share: f64 = 0.7,
    }
}

options! {
    /// How further components are looked for.
    pub struct ComponentOptions {
        /// Blocks that are tried for components at most, and how many may fail one after the other.
        most_components: u32 = 100,
        /// The best come first, and an input without overlap has any number of hopeless ones.
        most_failures: usize = 3,
    }
}

options! {
    /// What of a sequence its calibration is made from.
    pub struct StretchOptions {
        /// Views that a calibration is compared with projective cameras on at most: of more, the stretch with most
        /// observations. A zoom is asked stretch after stretch. The adjustment of projective cameras is cubic in them,
        /// as that of a block.
        most_views: usize = ViewSelectionOptions::DEFAULT.most_views_whole,
        /// Views of each camera that this stretch must hold for all cameras to be calibrated together: as many as one
        /// needs by itself. In 16 sequences of two cameras and 42 to 58 views, sigma fell to half in the median, to a
        /// sixth at best, and rose by a ninth at worst.
        least_of_camera: usize = consensus::LEAST_VIEWS,
        /// Observations that a calibration is made from, and of one view at least and at most. Other errors than noise
        /// bound what more of them would give.
        observations: usize = 6_000,
        of_view: (usize, usize) = (50, 300),
        /// Squared standard deviations of the core within which an observation takes part: squares know no tails. One
        /// observation in a thousand is left out.
        core_squared: f64 = CHI_SQUARE_OF_TWO,
    }
}

options! {
    /// How a sequence is divided into windows that check its calibration.
    pub struct WindowOptions {
        /// Views of a window where there are many, and of the shortest one.
        views: usize = 10,
        /// Below, a window says little of a focal length.
        least_views: usize = 4,
        /// Windows at most, evenly spread over the sequence. A variance of 50 values is known to a fifth.
        most_windows: usize = 50,
        /// Observations of a view that a window holds.
        of_view: usize = 150,
        /// Distance of the windows' focal length from that of all views, in standard deviations of the former, beyond
        /// which it is no chance. Chance takes one in four hundred that far.
        significant_distance: f64 = 3.0,
    }
}
