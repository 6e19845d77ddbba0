//! The thresholds of the calibration, with their reasons.
//!
//! Lengths and focal lengths are in units of the longer image side; `log` is the natural logarithm. A field that counts
//! standard deviations, or is in units of the noise, says so.

use crate::domain::{FocalPrior, Grade, Warning, WarningCode};
use crate::geometry::bundle;
use crate::geometry::bundle::metric::{Extension, Intrinsics, IntrinsicsModel, IntrinsicsPrior, Parameter};
use crate::geometry::statistics::{CHI_SQUARE_OF_ONE, CHI_SQUARE_OF_TWO, GATE_QUANTILE, chi_square_quantile};
use crate::solver::consensus::LEAST_INLIERS;

options! {
    /// Thresholds of a calibration, by stage.
    pub struct CalibrationOptions {
        fit: FitOptions = FitOptions::DEFAULT,
        critical: CriticalOptions = CriticalOptions::DEFAULT,
        search: SearchOptions = SearchOptions::DEFAULT,
        lenses: LensOptions = LensOptions::DEFAULT,
        models: ModelOptions = ModelOptions::DEFAULT,
        grades: GradeOptions = GradeOptions::DEFAULT,
    }
}

options! {
    /// How fits are compared.
    pub struct FitOptions {
        /// Iterations that bring the projective reconstruction to its minimum, to which the metric one is compared. The
        /// caller has adjusted it before.
        projective_iterations: usize = 10,
        /// Iterations from the metric reconstruction to the minima without a lens that are compared. Both are near.
        undistorted_iterations: usize = 10,
        /// Least noise that is used: exact input would make every deviation significant and every focal length certain,
        /// by its rounding alone. A hundredth of a pixel in a 1000-pixel image.
        least_noise: f64 = 1e-5,
        /// Inlier tracks below which geometry cannot verify a consensus.
        least_inliers: usize = LEAST_INLIERS,
        /// Degrees of freedom from which the posterior noise is used. It is then known to 13 %.
        enough_freedom: usize = 30,
        /// Loss of fit of a model with fewer unknowns, in standard deviations of its F statistic, that chance does not
        /// explain.
        misfit_deviations: f64 = 4.0,
        /// Ratio of the metric to the projective posterior noise that speaks of a wrong model. With few degrees of
        /// freedom it exceeds its limit by chance: the loss of fit must also be more than [`Self::misfit_deviations`].
        /// The paper's synthetic scenes stay within 1.05.
        rms_ratio_limit: f64 = 1.15,
        /// The same ratio from which the metric reconstruction is not to be used at all.
        rms_ratio_refusal: f64 = 3.0,
        /// Factor on sigma by a misfit from which it is reported. More than half of the sigma comes of it.
        violation_limit: f64 = 2.0,
    }
}

impl FitOptions {
    /// Standard deviation of a coordinate that goes with a sum of squares over so many degrees of freedom.
    pub fn posterior_noise(&self, cost: f64, freedom: usize) -> f64 {
        (cost / freedom.max(1) as f64).sqrt().max(self.least_noise)
    }
}

options! {
    /// How motions and scenes are told of which projective cameras do not tell the calibration.
    pub struct CriticalOptions {
        /// Median homography residual, in units of the noise, below which the scene counts as planar or the camera as
        /// only rotating. Measured: 1.1 to 1.8 for those, above 11 for general motion.
        homography_limit: f64 = 3.0,
        /// The same up to which the views may still be those of a plane or of a rotation behind a lens, or of a scene
        /// that is nearly a plane: twice the most that turning cameras left behind lenses with a `k1` of -.5 to .5, 13.3
        /// of 120 scenes. Of 265 calibrations of photographed scenes 38 have 12 to 40, and to look at these took a
        /// fiftieth of the time: the tests that follow tell scenes with depth, and one that is nearly a plane has starts
        /// from both.
        lens_limit: f64 = 25.0,
        /// Share of the observations up to which those that homographies do not explain are a minority, and may be
        /// wrong. Homographies explain views whose points fit but for the worst quarter.
        most_unsupported: f64 = 0.25,
        /// Iterations of the projective cameras that a rotation behind a lens is tested against. They start where the
        /// lens was not undone.
        parallax_iterations: usize = 30,
        /// Median distance from the epipolar lines of a translation, in units of the noise, above which the motion is
        /// none and nothing is adjusted. A translation has about .7; the epipoles are only a start.
        epipolar_limit: f64 = 3.0,
        /// Loss of fit, in standard deviations of its statistic, from which a rotation is refuted in favour of a plane,
        /// and a plane in favour of depth. Up to [`FitOptions::misfit_deviations`] a rotation stands, and between the
        /// two the data do not decide. Rotations without parallax have up to 5.5, with what singular cameras fit of
        /// noise taken off; with parallax 215 and more. Depth, even with the short baselines of forward motion, has 50
        /// and more.
        plane_deviations: f64 = 8.0,
    }
}

options! {
    /// How minima are searched for.
    pub struct SearchOptions {
        /// Focal lengths of the scan.
        scan_focals: usize = 40,
        /// Views that it looks at: those with the widest baselines to the first.
        scan_views: usize = 4,
        /// Focal lengths about each of which the best entry of the scan is refined, within this difference in log
        /// focal.
        scan_centres: [f64; 4] = [0.5, 1.0, 2.0, 4.0],
        /// Half an octave: neighbours touch.
        scan_half_width: f64 = 0.5 * std::f64::consts::LN_2,
        /// Best entries of the scan that are refined.
        refined_from_scan: usize = 3,
        /// Refined starts kept, and the iterations of their refinement.
        refined_starts: usize = 4,
        /// It converges in 10 to 20.
        refine_iterations: usize = 40,
        /// Starts that are adjusted: at least two, and no fewer than `refined_starts`. With the refined ones alone a
        /// third of the scenes at .3 % noise was within 1 % of the focal length, with these .92.
        starts: usize = 8,
        /// Windows of the scan whose best entry is a start as it stands: they keep starts apart that the refinement
        /// would draw into one minimum. Their range, and the half width of each in log focal.
        window_range: (f64, f64) = (0.45, 3.2),
        /// Neighbours overlap a little.
        window_half_width: f64 = 0.15,
        /// Difference in log focal below which refined starts are the same.
        same_start: f64 = 0.02,
        /// And in the plane at infinity, in units of one plus its norm.
        same_plane: f64 = 0.05,
        /// Focal lengths that the refinement may end at; beyond, it ran away along a null direction.
        refined_focals: std::ops::RangeInclusive<f64> = 0.05..=50.0,
        /// Iterations and tolerance of the first adjustment, which only has to rank the starts, and after which those
        /// with a focal length a view begin from those with one for all.
        first_iterations: usize = 12,
        first_tolerance: f64 = 1e-4,
        /// Starts that are adjusted to convergence, and the iterations and the tolerance allowed. An end where a step
        /// gains less than .003 of chi-square takes a sixth less time, and gave two of 120 scenes a wrong focal length:
        /// flat valleys may end in a fall.
        converged: usize = 3,
        final_iterations: usize = 60,
        final_tolerance: f64 = 1e-9,
        /// Multiple of the cheapest minimum's cost: a start that at its pace does not get below is not adjusted to
        /// convergence. A rival is within a few per cent, and one that is stuck far above took half the time of a
        /// calibration.
        hopeless_cost: f64 = 4.0,
        /// Adjusted starts this near in log focal, and within this share in cost, are the same minimum.
        same_minimum: f64 = 0.01,
        same_cost: f64 = 0.1,
        /// Mean squared residual of a point, in the median of all points, above which it may have diverged. Noise takes
        /// one point of three views in 30,000 so far; such a point is triangulated and stays where that costs more.
        diverged_above: f64 = 10.0,
        /// Points that take part in the search: more tell no minimum from another that these do not.
        points: usize = 150,
        /// Points below which the search does not thin out a view.
        least_points_of_view: usize = 20,
        /// Factors on the focal length of a reconstruction from which other minima are looked for. A forward motion has
        /// them half or twice as far.
        other_focals: [f64; 4] = [0.5, 0.75, 1.33, 2.0],
        /// Iterations in which poses and points follow a focal length that is held.
        following_iterations: usize = 12,
        /// Starts from a plane that are adjusted. The plane's equations have few minima, and sorted by these the right
        /// one is among the first.
        planar_starts: usize = 4,
    }
}

impl SearchOptions {
    /// The first adjustment of a start.
    pub fn first(&self) -> bundle::Options {
        bundle::Options {
            max_iterations: self.first_iterations,
            relative_tolerance: self.first_tolerance,
            ..bundle::Options::DEFAULT
        }
    }

    /// An adjustment to convergence.
    pub fn to_convergence(&self) -> bundle::Options {
        bundle::Options {
            max_iterations: self.final_iterations,
            relative_tolerance: self.final_tolerance,
            ..bundle::Options::DEFAULT
        }
    }
}

options! {
    /// What lenses are like, before any observation.
    pub struct LensOptions {
        /// Standard deviation of each coordinate of the principal point from the image centre. Lenses are centred to a
        /// few hundredths, and only cropping takes the principal point farther.
        principal_point_sigma: f64 = 0.05,
        /// The same of the log aspect. Digitised video has pixels up to a tenth off square.
        log_aspect_sigma: f64 = 0.1,
        /// Of `k1`, where it is estimated: that of wide lenses, which have up to -.3.
        radial_k1_sigma: f64 = 0.2,
        /// The same of lenses of low distortion. Phones and cameras have a few hundredths.
        low_distortion_k1_sigma: f64 = 0.04,
        /// Share of these among the lenses that distort: as many as wide ones. With wide ones alone a
        /// `k1` of .04 that gained 10 in chi-square had a weight of .03.
        low_distortion_share: f64 = 0.5,
        /// Of `k2` and `k3`. Calibrations on boards give k2 and k3 the size of k1, with either sign.
        later_radial_sigma: f64 = 0.2,
        /// Of `p1` and `p2`. Calibrations on boards give some thousandths, and what a decentred lens mostly does is
        /// displace the principal point.
        tangential_sigma: f64 = 0.005,
        /// Probability, before any observation, that a camera needs its principal point or radial distortion freed,
        /// that of the second radial term where it has a first. Principal points and distortion are as often in order
        /// (rectified, rendered) as not.
        likely: f64 = 0.5,
        /// The same of a third radial term where there is a second, and of tangential distortion where there is a first.
        /// Few lenses need a third term, or are so far off centre that it shows.
        unlikely: f64 = 0.2,
        /// The same of the aspect. Pixels are square in all but old video.
        rare: f64 = 0.05,
        /// What a lens may add to log focal lengths of which every view has its own, one standard deviation. Few lenses
        /// have the same distortion and centre at every focal length, and one for all is what is estimated. It exceeds
        /// what METRIC allows: no zoom is METRIC.
        zoom_sigma: f64 = 0.05,
        /// Focal lengths that lenses have. Rectilinear ones end at a field of view of 135 degrees (.2), telescopes at
        /// half a degree. Beyond, a minimum is no camera: of windows of a forward-moving car one was taken for a lens
        /// of 170 degrees, at a sigma of 10 %.
        focals: std::ops::RangeInclusive<f64> = 0.15..=120.0,
    }
}

impl LensOptions {
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

    /// The kinds of lens that a model may be of: the probability of each among these, and the factor by which the prior
    /// standard deviation of its `k1` is smaller.
    pub fn kinds(&self, model: IntrinsicsModel) -> Vec<(f64, f64)> {
        match model.contains(Extension::RadialK1) {
            true => vec![
                (1.0 - self.low_distortion_share, 1.0),
                (self.low_distortion_share, self.radial_k1_sigma / self.low_distortion_k1_sigma),
            ],
            false => vec![(1.0, 1.0)],
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

    /// By how many standard deviations principal point and aspect are off where cameras have them, of what the model
    /// frees.
    ///
    /// Terms of distortion are not counted: long lenses have large ones, in units of their focal length.
    pub fn deviations(&self, model: IntrinsicsModel, found: &Intrinsics) -> Vec<f64> {
        let mut deviations = Vec::new();
        if model.contains(Extension::PrincipalPoint) {
            deviations.extend(found.principal_point.iter().map(|at| at / self.principal_point_sigma));
        }
        if model.contains(Extension::Aspect) {
            deviations.push(found.aspect.ln() / self.log_aspect_sigma);
        }
        deviations
    }

    /// Whether there is a lens of this focal length.
    pub fn is_plausible(&self, focal: f64) -> bool {
        self.focals.contains(&focal)
    }
}

options! {
    /// How a model is chosen, and what not knowing which is right costs.
    pub struct ModelOptions {
        /// Gain in chi-square at which an extension of one degree of freedom is taken, one of two, and the normal
        /// quantile of the level for more. The .999 quantiles of chi-square and of the normal distribution.
        significant_gain_of_one: f64 = CHI_SQUARE_OF_ONE,
        significant_gain_of_two: f64 = CHI_SQUARE_OF_TWO,
        significance: f64 = GATE_QUANTILE,
        /// Share of the significant gain that a linearisation must predict for an adjustment to be tried: it is off
        /// where the richer model is far.
        worth_a_trial: f64 = 0.5,
        /// Share of the noise that a prior was weighed by, below which, or beyond whose inverse, what is left makes it
        /// worth weighing anew. A prior that is weighed by a misfit's noise is too strong: with a third radial term of
        /// .4, k1 to k3 were up to 7.4 sigma off.
        same_noise: f64 = 0.9,
        /// Times that it is weighed at most, the first included. The noise falls by the misfit at once, and by little
        /// after.
        noise_rounds: usize = 4,
        /// How much a richer model may raise the standard deviation of the log focal length and still be taken: beyond,
        /// it fits by giving up what was to be found.
        sigma_inflation: f64 = 3.0,
        /// Shift of the log focal length between models, in standard deviations, that speaks of a wrong model.
        model_shift: f64 = 3.0,
        /// Radius at unit depth that a fisheye's images must exceed, and a barrel's for a fisheye to be tried in its
        /// place. 35 degrees: up to there three radial terms image an equidistant fisheye to 2e-5 of a focal length.
        fisheye_from: f64 = 0.7,
        /// Radius at unit depth up to which a perspective lens may stand for a fisheye. 60 degrees: there three radial
        /// terms leave a root mean square of .8 px in an image 1,600 px wide of 120 degrees, with every five degrees more
        /// two and a half times as much, and from 65 degrees they fold.
        perspective_up_to: f64 = 1.73,
        /// Weight of a model below which it has no say in whether the focal length is observable.
        negligible: f64 = 1e-3,
        /// Where the profile of the cost is sampled, in standard deviations to either side and at most in log focal.
        profile_deviations: f64 = 3.0,
        /// A factor of 1.35.
        profile_longest: f64 = 0.3,
        /// Iterations there. Few-view scenes with hardly any turning and chains of 40 views converge within nine, to
        /// 1e-13 of the cost (a test).
        profile_iterations: usize = 15,
    }
}

impl ModelOptions {
    /// Gain in chi-square at which an extension of so many degrees of freedom is taken.
    pub fn significant_gain(&self, freedom: usize) -> f64 {
        match freedom {
            1 => self.significant_gain_of_one,
            2 => self.significant_gain_of_two,
            many => chi_square_quantile(many as f64, self.significance),
        }
    }
}

options! {
    /// What bounds the grades.
    pub struct GradeOptions {
        /// Standard deviations of the log focal length that bound the grades.
        metric_below: f64 = 0.02,
        weak_up_to: f64 = 0.1,
        /// The same beyond which the focal length counts as unobservable. A factor of 2.7.
        unobservable_above: f64 = 1.0,
        /// Share of the observations that must lie in front of their cameras, or the reconstruction is not to be used:
        /// what was seen was not behind the camera. A forward-moving car gave 2.9 % behind, with a focal length of a
        /// quarter of the true.
        least_in_front: f64 = 0.99,
        /// Difference in log focal from which another minimum is another calibration.
        other_calibration: f64 = 0.02,
        /// Difference in chi-square up to which the data do not tell two minima apart. The .999 quantile for two
        /// degrees of freedom.
        indistinguishable: f64 = CHI_SQUARE_OF_TWO,
        /// Standard deviation of a coordinate of the principal point, from the observations alone, above which they do
        /// not determine it. No lens is worse centred than that.
        principal_point_unobservable_above: f64 = 0.05,
        /// Difference between a prior and what the observations say, in standard deviations of the difference, that one
        /// of the two does not survive.
        prior_contradicted: f64 = 3.0,
        /// Share of the views whose focal length must be determined where each has its own: of fewer, what most of the
        /// images show says nothing of the camera.
        least_determined: f64 = 0.5,
    }
}

impl GradeOptions {
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
