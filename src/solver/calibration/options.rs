//! The thresholds of the calibration, with their reasons.
//!
//! Lengths and focal lengths are in units of the longer image side; `log` is the natural logarithm. A field that counts
//! standard deviations, or is in units of the noise, says so.

use crate::domain::{FocalPrior, Grade, Warning, WarningCode};
use crate::geometry::bundle;
use crate::geometry::bundle::metric::{Extension, IntrinsicsPrior, Parameter};
use crate::geometry::statistics::{CHI_SQUARE_OF_ONE, CHI_SQUARE_OF_TWO, GATE_QUANTILE, chi_square_quantile};
use crate::solver::grow::LEAST_INLIERS;

/// Thresholds of a calibration, by stage.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationOptions {
    pub fit: FitOptions,
    pub critical: CriticalOptions,
    pub search: SearchOptions,
    pub lenses: LensOptions,
    pub models: ModelOptions,
    pub grades: GradeOptions,
}

impl CalibrationOptions {
    pub const DEFAULT: Self = Self {
        fit: FitOptions::DEFAULT,
        critical: CriticalOptions::DEFAULT,
        search: SearchOptions::DEFAULT,
        lenses: LensOptions::DEFAULT,
        models: ModelOptions::DEFAULT,
        grades: GradeOptions::DEFAULT,
    };
}

/// How fits are compared.
#[derive(Debug, Clone, PartialEq)]
pub struct FitOptions {
    /// Iterations that bring the projective reconstruction to its minimum, to which the metric one is compared.
    pub projective_iterations: usize,
    /// Iterations from the metric reconstruction to the minima without a lens that are compared.
    pub undistorted_iterations: usize,
    /// Least noise that is used: exact input would make every deviation significant and every focal length certain, by
    /// its rounding alone.
    pub least_noise: f64,
    /// Inlier tracks below which geometry cannot verify a consensus.
    pub least_inliers: usize,
    /// Degrees of freedom from which the posterior noise is used.
    pub enough_freedom: usize,
    /// Loss of fit of a model with fewer unknowns, in standard deviations of its F statistic, that chance does not
    /// explain.
    pub misfit_deviations: f64,
    /// Ratio of the metric to the projective posterior noise that speaks of a wrong model. With few degrees of freedom
    /// it exceeds its limit by chance: the loss of fit must also be more than [`Self::misfit_deviations`].
    pub rms_ratio_limit: f64,
    /// The same ratio from which the metric reconstruction is not to be used at all.
    pub rms_ratio_refusal: f64,
    /// Factor on sigma by a misfit from which it is reported.
    pub inflation_limit: f64,
}

impl FitOptions {
    pub const DEFAULT: Self = Self {
        // The caller has adjusted it before.
        projective_iterations: 10,
        // Both are near.
        undistorted_iterations: 10,
        // A hundredth of a pixel in a 1000-pixel image.
        least_noise: 1e-5,
        least_inliers: LEAST_INLIERS,
        // It is then known to 13 %.
        enough_freedom: 30,
        misfit_deviations: 4.0,
        // The paper's synthetic scenes stay within 1.05.
        rms_ratio_limit: 1.15,
        rms_ratio_refusal: 3.0,
        // More than half of the sigma comes of it.
        inflation_limit: 2.0,
    };

    /// Standard deviation of a coordinate that goes with a sum of squares over so many degrees of freedom.
    pub fn posterior_noise(&self, cost: f64, freedom: usize) -> f64 {
        (cost / freedom.max(1) as f64).sqrt().max(self.least_noise)
    }
}

/// How motions and scenes are told of which projective cameras do not tell the calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct CriticalOptions {
    /// Median homography residual, in units of the noise, below which the scene counts as planar or the camera as only
    /// rotating.
    pub homography_limit: f64,
    /// The same up to which the views may still be those of a plane or of a rotation behind a lens, or of a scene that is
    /// nearly a plane.
    pub lens_limit: f64,
    /// Iterations of the projective cameras that a rotation behind a lens is tested against.
    pub parallax_iterations: usize,
    /// Median distance from the epipolar lines of a translation, in units of the noise, above which the motion is none
    /// and nothing is adjusted.
    pub epipolar_limit: f64,
    /// Loss of fit, in standard deviations of its statistic, from which a rotation is refuted in favour of a plane, and
    /// a plane in favour of depth. Up to [`FitOptions::misfit_deviations`] a rotation stands, and between the two the
    /// data do not decide.
    pub plane_deviations: f64,
    /// Spread of the camera's positions off the line that fits them best, relative to that along it, up to which the
    /// motion is along one line.
    pub most_off_line: f64,
    /// Distance of the point that a straight motion heads for from the image centre up to which it is along the optical
    /// axis.
    pub near_axis: f64,
}

impl CriticalOptions {
    pub const DEFAULT: Self = Self {
        // Measured: 1.1 to 1.8 for those, above 11 for general motion.
        homography_limit: 3.0,
        // A little beyond the least of general motion: the tests that follow tell it from these, and a scene that is
        // nearly a plane has starts from both.
        lens_limit: 12.0,
        // They start where the lens was not undone.
        parallax_iterations: 30,
        // A translation has about .7; the epipoles are only a start.
        epipolar_limit: 3.0,
        // Rotations without parallax have up to 5.5, with what singular cameras fit of noise taken off; with parallax 215
        // and more. Depth, even with the short baselines of forward motion, has 50 and more.
        plane_deviations: 8.0,
        // Noise leaves a few hundredths.
        most_off_line: 0.2,
        near_axis: 0.1,
    };
}

/// How minima are searched for.
#[derive(Debug, Clone, PartialEq)]
pub struct SearchOptions {
    /// Focal lengths of the scan.
    pub scan_focals: usize,
    /// Views that it looks at: those with the widest baselines to the first.
    pub scan_views: usize,
    /// Focal lengths about each of which the best entry of the scan is refined, within this difference in log focal.
    pub scan_centres: [f64; 4],
    pub scan_half_width: f64,
    /// Best entries of the scan that are refined.
    pub refined_from_scan: usize,
    /// Refined starts kept, and the iterations of their refinement.
    pub refined_starts: usize,
    pub refine_iterations: usize,
    /// Starts that are adjusted: at least two, and no fewer than `refined_starts`.
    pub starts: usize,
    /// Windows of the scan whose best entry is a start as it stands: they keep starts apart that the refinement would
    /// draw into one minimum. Their range, and the half width of each in log focal.
    pub window_range: (f64, f64),
    pub window_half_width: f64,
    /// Difference in log focal below which refined starts are the same.
    pub same_start: f64,
    /// And in the plane at infinity, in units of one plus its norm.
    pub same_plane: f64,
    /// Focal lengths that the refinement may end at; beyond, it ran away along a null direction.
    pub refined_focals: std::ops::RangeInclusive<f64>,
    /// Iterations and tolerance of the first adjustment, which only has to rank the starts.
    pub first_iterations: usize,
    pub first_tolerance: f64,
    /// Starts that are adjusted to convergence, and the iterations and the tolerance allowed.
    pub converged: usize,
    pub final_iterations: usize,
    pub final_tolerance: f64,
    /// Multiple of the cheapest minimum's cost: a start that at its pace does not get below is not adjusted to
    /// convergence.
    pub hopeless_cost: f64,
    /// Adjusted starts this near in log focal, and within this share in cost, are the same minimum.
    pub same_minimum: f64,
    pub same_cost: f64,
    /// Points that take part in the search: more tell no minimum from another that these do not.
    pub points: usize,
    /// Points below which the search does not thin out a view.
    pub least_points_of_view: usize,
    /// Factors on the focal length of a reconstruction from which other minima are looked for.
    pub other_focals: [f64; 4],
    /// Iterations in which poses and points follow a focal length that is held.
    pub following_iterations: usize,
    /// Starts from a plane that are adjusted.
    pub planar_starts: usize,
}

impl SearchOptions {
    pub const DEFAULT: Self = Self {
        scan_focals: 40,
        scan_views: 4,
        scan_centres: [0.5, 1.0, 2.0, 4.0],
        // Half an octave: neighbours touch.
        scan_half_width: 0.5 * std::f64::consts::LN_2,
        refined_from_scan: 3,
        refined_starts: 4,
        // It converges in 10 to 20.
        refine_iterations: 40,
        // With the refined ones alone a third of the scenes at .3 % noise was within 1 % of the focal length, with
        // these .92.
        starts: 8,
        window_range: (0.45, 3.2),
        // Neighbours overlap a little.
        window_half_width: 0.15,
        same_start: 0.02,
        same_plane: 0.05,
        refined_focals: 0.05..=50.0,
        first_iterations: 12,
        first_tolerance: 1e-4,
        converged: 3,
        final_iterations: 60,
        final_tolerance: 1e-9,
        // A rival is within a few per cent, and one stuck at thirty times the cost took half the time of a calibration.
        hopeless_cost: 4.0,
        same_minimum: 0.01,
        same_cost: 0.1,
        points: 150,
        least_points_of_view: 20,
        // A forward motion has them half or twice as far.
        other_focals: [0.5, 0.75, 1.33, 2.0],
        following_iterations: 12,
        // The plane's equations have few minima, and sorted by these the right one is among the first.
        planar_starts: 4,
    };

    /// The first adjustment of a start.
    pub fn first(&self) -> bundle::Options {
        bundle::Options {
            max_iterations: self.first_iterations,
            relative_tolerance: self.first_tolerance,
            ..bundle::Options::default()
        }
    }

    /// An adjustment to convergence.
    pub fn to_convergence(&self) -> bundle::Options {
        bundle::Options {
            max_iterations: self.final_iterations,
            relative_tolerance: self.final_tolerance,
            ..bundle::Options::default()
        }
    }
}

/// What lenses are like, before any observation.
#[derive(Debug, Clone, PartialEq)]
pub struct LensOptions {
    /// Standard deviation of each coordinate of the principal point from the image centre.
    pub principal_point_sigma: f64,
    /// The same of the log aspect.
    pub log_aspect_sigma: f64,
    /// Of `k1`.
    pub radial_k1_sigma: f64,
    /// Of `k2` and `k3`.
    pub later_radial_sigma: f64,
    /// Of `p1` and `p2`.
    pub tangential_sigma: f64,
    /// Probability, before any observation, that a camera needs its principal point or radial distortion freed, that of
    /// the second radial term where it has a first.
    pub likely: f64,
    /// The same of a third radial term and of tangential distortion.
    pub unlikely: f64,
    /// The same of the aspect.
    pub rare: f64,
    /// What a lens may add to log focal lengths of which every view has its own, one standard deviation.
    pub zoom_sigma: f64,
    /// Focal lengths that lenses have.
    pub focals: std::ops::RangeInclusive<f64>,
}

impl LensOptions {
    pub const DEFAULT: Self = Self {
        // Lenses are centred to a few hundredths, and only cropping takes the principal point farther.
        principal_point_sigma: 0.05,
        // Digitised video has pixels up to a tenth off square.
        log_aspect_sigma: 0.1,
        // Phones and cameras have a few hundredths, wide lenses -.3.
        radial_k1_sigma: 0.2,
        // Calibrations on boards give k2 and k3 the size of k1, with either sign.
        later_radial_sigma: 0.2,
        // Calibrations on boards give some thousandths, and what a decentred lens mostly does is displace the principal
        // point.
        tangential_sigma: 0.005,
        // Principal points and distortion are as often in order (rectified, rendered) as not.
        likely: 0.5,
        // Few lenses need a third term, or are so far off centre that it shows.
        unlikely: 0.2,
        // Pixels are square in all but old video.
        rare: 0.05,
        // Few lenses have the same distortion and centre at every focal length, and one for all is what is estimated.
        // It exceeds what METRIC allows: no zoom is METRIC.
        zoom_sigma: 0.05,
        // Rectilinear ones end at a field of view of 135 degrees (.2), telescopes at half a degree. Beyond, a minimum
        // is no camera: of windows of a forward-moving car one was taken for a lens of 170 degrees, at a sigma of 10 %.
        focals: 0.15..=120.0,
    };

    /// What is known of the intrinsics beforehand, at this noise: what lenses are like, and what the caller says.
    pub fn prior(&self, noise: f64, focal: Option<FocalPrior>, scale_px: f64) -> IntrinsicsPrior {
        let lenses = IntrinsicsPrior::NONE
            .knowing(Parameter::PrincipalX, 0.0, self.principal_point_sigma, noise)
            .knowing(Parameter::PrincipalY, 0.0, self.principal_point_sigma, noise)
            .knowing(Parameter::LogAspect, 0.0, self.log_aspect_sigma, noise)
            .knowing(Parameter::RadialK1, 0.0, self.radial_k1_sigma, noise)
            .knowing(Parameter::RadialK2, 0.0, self.later_radial_sigma, noise)
            .knowing(Parameter::RadialK3, 0.0, self.later_radial_sigma, noise)
            .knowing(Parameter::TangentialP1, 0.0, self.tangential_sigma, noise)
            .knowing(Parameter::TangentialP2, 0.0, self.tangential_sigma, noise);
        match focal {
            Some(prior) => {
                lenses.knowing(Parameter::LogFocal, (prior.focal_px / scale_px).ln(), prior.sigma_log, noise)
            }
            None => lenses,
        }
    }

    /// Probability, before any observation, that a camera needs the extension.
    pub fn probability(&self, extension: Extension) -> f64 {
        match extension {
            Extension::PrincipalPoint | Extension::RadialK1 | Extension::RadialK2 => self.likely,
            Extension::RadialK3 | Extension::Tangential => self.unlikely,
            Extension::Aspect => self.rare,
        }
    }

    /// Whether there is a lens of this focal length.
    pub fn is_plausible(&self, focal: f64) -> bool {
        self.focals.contains(&focal)
    }
}

/// How a model is chosen, and what not knowing which is right costs.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelOptions {
    /// Gain in chi-square at which an extension of one degree of freedom is taken, one of two, and the normal quantile
    /// of the level for more.
    pub significant_gain_of_one: f64,
    pub significant_gain_of_two: f64,
    pub significance: f64,
    /// Share of the significant gain that a linearisation must foretell for an adjustment to be tried: it is off where
    /// the richer model is far.
    pub worth_a_trial: f64,
    /// Share of the noise that a prior was weighed by, below which what is left makes it worth weighing anew.
    pub same_noise: f64,
    /// Times that it is weighed at most, the first included.
    pub noise_rounds: usize,
    /// How much a richer model may raise the standard deviation of the log focal length and still be taken: beyond, it
    /// fits by giving up what was to be found.
    pub sigma_inflation: f64,
    /// Shift of the log focal length between models, in standard deviations, that speaks of a wrong model.
    pub model_shift: f64,
    /// Radius at unit depth that a barrel's images must exceed for a fisheye to be tried in its place.
    pub fisheye_from: f64,
    /// Weight of a model below which it has no say in whether the focal length is observable.
    pub negligible: f64,
    /// Where the profile of the cost is sampled, in standard deviations to either side and at most in log focal.
    pub profile_deviations: f64,
    pub profile_longest: f64,
    /// Iterations there.
    pub profile_iterations: usize,
}

impl ModelOptions {
    pub const DEFAULT: Self = Self {
        // The .999 quantiles of chi-square and of the normal distribution.
        significant_gain_of_one: CHI_SQUARE_OF_ONE,
        significant_gain_of_two: CHI_SQUARE_OF_TWO,
        significance: GATE_QUANTILE,
        worth_a_trial: 0.5,
        // A prior that is weighed by a misfit's noise is too strong: with a third radial term of .4, k1 to k3 were up
        // to 7.4 sigma off.
        same_noise: 0.9,
        // The noise falls by the misfit at once, and by little after.
        noise_rounds: 4,
        sigma_inflation: 3.0,
        model_shift: 3.0,
        // 35 degrees: up to there three radial terms image an equidistant fisheye to 2e-5 of a focal length.
        fisheye_from: 0.7,
        negligible: 1e-3,
        profile_deviations: 3.0,
        // A factor of 1.35.
        profile_longest: 0.3,
        // Few-view scenes with hardly any turning and chains of 40 views converge within nine, to 1e-13 of the cost (a
        // test).
        profile_iterations: 15,
    };

    /// Gain in chi-square at which an extension of so many degrees of freedom is taken.
    pub fn significant_gain(&self, freedom: usize) -> f64 {
        match freedom {
            1 => self.significant_gain_of_one,
            2 => self.significant_gain_of_two,
            many => chi_square_quantile(many as f64, self.significance),
        }
    }
}

/// What bounds the grades.
#[derive(Debug, Clone, PartialEq)]
pub struct GradeOptions {
    /// Standard deviations of the log focal length that bound the grades.
    pub metric_below: f64,
    pub weak_up_to: f64,
    /// The same beyond which the focal length counts as unobservable.
    pub unobservable_above: f64,
    /// Share of the observations that must lie in front of their cameras, or the reconstruction is not to be used: what
    /// was seen was not behind the camera.
    pub least_in_front: f64,
    /// Difference in log focal from which another minimum is another calibration.
    pub other_calibration: f64,
    /// Difference in chi-square up to which the data do not tell two minima apart.
    pub indistinguishable: f64,
    /// Standard deviation of a coordinate of the principal point, from the observations alone, above which they do not
    /// determine it.
    pub principal_point_unobservable_above: f64,
    /// Difference between a prior and what the observations say, in standard deviations of the difference, that one of
    /// the two does not survive.
    pub prior_contradicted: f64,
    /// Share of the views whose focal length must be determined where each has its own: of fewer, what most of the
    /// images show says nothing of the camera.
    pub least_determined: f64,
}

impl GradeOptions {
    pub const DEFAULT: Self = Self {
        metric_below: 0.02,
        weak_up_to: 0.1,
        // A factor of 2.7.
        unobservable_above: 1.0,
        // A forward-moving car gave 2.9 % behind, with a focal length of a quarter of the true.
        least_in_front: 0.99,
        other_calibration: 0.02,
        // The .999 quantile for two degrees of freedom.
        indistinguishable: CHI_SQUARE_OF_TWO,
        // No lens is worse centred than that.
        principal_point_unobservable_above: 0.05,
        prior_contradicted: 3.0,
        least_determined: 0.5,
    };

    /// The grade that a standard deviation of the log focal length alone would give; `None`: unobservable.
    pub fn grade(&self, sigma: Option<f64>) -> Grade {
        match sigma {
            Some(sigma) if sigma < self.metric_below => Grade::Metric,
            Some(sigma) if sigma <= self.weak_up_to => Grade::Weak,
            _ => Grade::ProjectiveOnly,
        }
    }

    /// Why a standard deviation, `None` where there is none, gives no calibration.
    pub fn unobservable(&self, sigma: Option<f64>) -> Warning {
        let detail = match sigma {
            Some(sigma) => format!(
                "the motion determines the logarithm of the focal length only to {sigma:.2} (one standard deviation), \
                 more than {}",
                self.weak_up_to
            ),
            None => "the motion does not determine the focal length".to_owned(),
        };
        Warning::new(WarningCode::UnobservableFocal, detail)
    }
}
