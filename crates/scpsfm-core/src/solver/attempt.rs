//! One block of views from search to calibration.

use super::a_contrario::FalseAlarmOptions;
use super::baselines::{self, Decided};
use super::block::Block;
use super::calibration::{self, Outcome};
use super::classification::Judged;
use super::consensus::{Consensus, LEAST_INLIERS, NoiseOptions};
use super::depths::{self, DepthOptions, TrackWeights};
use super::error::Error;
use super::grow;
use super::learned::TrackScores;
use super::portfolio::{Effort, Found, Portfolio, VerifiedBy};
use super::problem::Problem;
use super::projective::ProjectiveReconstruction;
use super::recorder::Recorder;
use super::search::rigid::{LEAST_TRACKS, Rigid};
use super::{all_tracks, near_duplicates, scpsfm, spread, static_tracks, track_sampling, view_selection};
use crate::domain::{FocalPrior, Grade, Method, Stage, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, MetricReconstruction};
use crate::geometry::statistics::median;

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
        /// Standard deviation of the log focal length that an undone lens stands for where the motion determines none.
        /// The last step between sampled lenses is 1.5 %.
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

const OPTIONS: AttemptOptions = AttemptOptions::DEFAULT;

/// What describes motions and scenes that are special cases.
const CRITICAL: [WarningCode; 5] = [
    WarningCode::LittleMotion,
    WarningCode::PureTranslation,
    WarningCode::PureRotation,
    WarningCode::PlanarScene,
    WarningCode::PlanarOrRotation,
];

/// Merit of a WEAK attempt, see [`Attempt::merit`].
pub const WEAK_MERIT: u8 = 3;

/// What became of one block.
pub struct Attempt {
    pub block: Block,
    /// What the search found, its consensus refined and over the tracks of the block; without one where nothing stands,
    /// or where it was found by other tracks.
    pub found: Found,
    /// The consensus as a reconstruction of its inliers, or what that was extended to; `None` where nothing stands.
    pub projective: Option<ProjectiveReconstruction>,
    /// Every track and observation judged by it, where that was done already.
    pub judged: Option<Judged>,
    pub calibration: Option<Outcome>,
    /// Probability of tracks to be right by image points and depths together; `None` where depths say nothing more.
    pub weights_by_depths: Option<TrackWeights>,
    /// The method's own verdicts where it searches nothing (PAPER, SCPSFM, PSFM).
    pub decided: Option<Decided>,
}

impl Attempt {
    /// Nothing found yet.
    fn new(block: Block) -> Self {
        Self {
            block,
            found: Found::default(),
            projective: None,
            judged: None,
            calibration: None,
            weights_by_depths: None,
            decided: None,
        }
    }

    /// What was found of some of the views of a block by other tracks than its complete ones; `None`: nothing.
    pub fn of_projective(block: Block, found: Option<ProjectiveReconstruction>) -> Self {
        Self { projective: found.map(ProjectiveReconstruction::oriented), ..Self::new(block) }
    }

    /// Views that have a camera, increasing.
    pub fn views(&self) -> &[usize] {
        self.projective.as_ref().map_or(&[], |projective| &projective.views)
    }

    /// Whether it has less than half of the views.
    pub fn leaves_most_views(&self, problem: &Problem) -> bool {
        2 * self.views().len() < problem.observed_views().len()
    }

    /// Evidence of what stands, see [`ProjectiveReconstruction::evidence`]; 0 where nothing does.
    pub fn evidence(&self, problem: &Problem) -> f64 {
        self.projective.as_ref().map_or(0.0, |found| found.evidence(problem.outlier_density))
    }

    /// Whether single observations are judged: where image points alone verify and the method decides nothing itself.
    pub fn judges_observations(&self) -> bool {
        matches!(self.found.verified_by, VerifiedBy::ImagePoints) && self.decided.is_none()
    }

    /// Whether depths verify it.
    pub fn is_by_depths(&self) -> bool {
        matches!(self.found.verified_by, VerifiedBy::Depths { .. })
    }

    /// Inliers that what verifies it can verify; 0 where the method keeps what it keeps (PAPER, SCPSFM, PSFM).
    pub fn least_inliers(&self) -> usize {
        match self.found.verified_by {
            _ if self.decided.is_some() => 0,
            VerifiedBy::ImagePoints => LEAST_INLIERS,
            VerifiedBy::Depths { .. } => LEAST_TRACKS,
        }
    }

    /// The rigid consensus behind it or beside it.
    fn rigid(&self) -> Option<&Rigid> {
        self.found.rigid.as_ref().map(|(_, rigid)| rigid)
    }

    /// Whether depths verify it, and it is worth more than what image points alone say of these views at this noise
    /// (normalised units): in noise so strong dozens of wrong tracks fit some plane. Not than what has further views,
    /// nor at less noise, where its own few tracks may hold wrong observations.
    pub fn outweighs(&self, views: &[usize], noise: f64) -> bool {
        let has = |view: &usize| self.views().binary_search(view).is_ok();
        self.is_by_depths() && noise > DepthOptions::DEFAULT.strong_noise && views.iter().all(has)
    }

    /// Whether depths verify it, in noise so strong that image points verify nothing beside them. False for fewer than
    /// [`LEAST_INLIERS`] tracks, whose residuals do not tell noise from wrong observations, and for mixed residuals.
    pub fn is_beyond_image_points(&self) -> bool {
        let is_noisy = |found: &ProjectiveReconstruction| {
            found.noise > DepthOptions::DEFAULT.strong_noise && found.tracks.len() >= LEAST_INLIERS
        };
        self.is_by_depths() && self.projective.as_ref().is_some_and(is_noisy) && !self.has_mixed_residuals()
    }

    /// Whether the residuals are of several kinds, most small and some large: tracks that hold wrong observations were
    /// fitted at too high a noise. Never up to [`NoiseOptions::initial`], where the gates keep wrong
    /// observations out.
    pub fn has_mixed_residuals(&self) -> bool {
        let noisy = self.projective.as_ref().filter(|found| found.noise > NoiseOptions::DEFAULT.initial);
        noisy.is_some_and(|found| are_mixed(found.squared_residuals()))
    }

    /// Says that image points verify what it was extended to, whatever verified the seed.
    pub fn verified_by_image_points(&mut self) {
        if self.is_by_depths() {
            self.found.verified_by = VerifiedBy::ImagePoints;
            self.weights_by_depths = None;
        }
    }

    /// Larger is better: solved before unsolved, then by grade, then by the certainty of the focal length.
    pub fn merit(&self) -> (u8, f64) {
        let Some(calibration) = &self.calibration else { return (u8::from(self.projective.is_some()), 0.0) };
        let grade = match calibration.grade {
            Grade::Metric => WEAK_MERIT + 1,
            Grade::Weak => WEAK_MERIT,
            Grade::ProjectiveOnly => 2,
        };
        (grade, -calibration.sigma_log_focal.unwrap_or(f64::INFINITY))
    }

    /// Whether there is a metric reconstruction, whatever it is worth.
    pub fn has_metric(&self) -> bool {
        self.calibration.as_ref().is_some_and(|calibration| calibration.metric.is_some())
    }

    /// Whether its camera only turned, so that its points are directions.
    pub fn has_common_centre(&self) -> bool {
        let metric = self.calibration.as_ref().and_then(|calibration| calibration.metric.as_ref());
        metric.is_some_and(|metric| metric.has_common_centre)
    }

    /// Whether there is a calibration that may be used.
    pub fn is_calibrated(&self) -> bool {
        self.merit().0 >= WEAK_MERIT
    }

    /// Whether the calibration has found a lens that distorts.
    pub fn has_lens(&self) -> bool {
        let distorts = |metric: &MetricReconstruction| metric.intrinsics.iter().any(Intrinsics::distorts);
        self.calibration.as_ref().and_then(|calibration| calibration.metric.as_ref()).is_some_and(distorts)
    }

    /// Whether nothing says that observations within the tracks are wrong: a calibration that fits as well as
    /// projective cameras do, or a plane or special motion found, which wrong observations would refute; and residuals of
    /// one kind.
    pub fn is_trusted(&self) -> bool {
        self.calibration.as_ref().is_some_and(|calibration| {
            let warns = |is: &dyn Fn(WarningCode) -> bool| calibration.warnings.iter().any(|warning| is(warning.code));
            let fits = calibration.grade != Grade::ProjectiveOnly && !warns(&WarningCode::is_misfit);
            fits || self.is_good() || warns(&|code| CRITICAL.contains(&code))
        }) && !self.has_mixed_residuals()
    }

    /// Whether no other block needs to be tried: it has the best grade that its camera can have, and no zoom is METRIC.
    pub fn is_good(&self) -> bool {
        let is_good = |calibration: &Outcome| match calibration.focals {
            Some(_) => calibration.grade != Grade::ProjectiveOnly,
            None => calibration.grade == Grade::Metric,
        };
        self.calibration.as_ref().is_some_and(is_good)
    }
}

/// Whether squared residuals are of several kinds, most small and some large.
fn are_mixed(mut squared: Vec<f64>) -> bool {
    let mean = squared.iter().sum::<f64>() / squared.len().max(1) as f64;
    median(&mut squared) < OPTIONS.least_median_share * mean
}

/// Solves a block, or as many of its tracks as its method can afford.
pub fn solve_block(problem: &Problem, block: Block, effort: Effort, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let mut attempt = search_block(problem, block, effort, recorder)?;
    calibrate(problem, &mut attempt, recorder)?;
    Ok(attempt)
}

/// Solves the densest blocks of views, one after the other until one is METRIC; the best of them. Other views are left
/// out.
pub fn solve_densest(problem: &Problem, recorder: &mut Recorder) -> Result<Option<Attempt>, Error> {
    let candidates = view_selection::candidate_views(problem);
    let mut best: Option<Attempt> = None;
    for (k, views) in candidates.iter().enumerate() {
        problem.stopped()?;
        recorder.begin_block(k, candidates.len());
        let attempt = solve_block(problem, problem.block(views), Effort::default(), recorder)?;
        best = better(best, attempt);
        if best.as_ref().is_some_and(Attempt::is_good) {
            break;
        }
    }
    Ok(best)
}

/// The one of the two that has more merit, the first of equals.
pub fn better(best: Option<Attempt>, attempt: Attempt) -> Option<Attempt> {
    match best {
        Some(best) if best.merit() >= attempt.merit() => Some(best),
        _ => Some(attempt),
    }
}

/// Searches a block, or as many of its tracks as its method can afford, for a consensus.
pub fn search_block(
    problem: &Problem,
    block: Block,
    effort: Effort,
    recorder: &mut Recorder,
) -> Result<Attempt, Error> {
    recorder.enter(Stage::Search);
    let mut attempt = match problem.settings.method {
        Method::Auto | Method::Geometry => searched(problem, block, effort, recorder)?,
        Method::Paper | Method::Scpsfm => {
            decided(problem, block.sample(OPTIONS.network_tracks, problem.settings.seed), recorder)?
        }
        Method::Psfm => decided(problem, block, recorder)?,
    };
    problem.stopped()?;
    let projective =
        attempt.found.consensus.as_ref().map(|consensus| ProjectiveReconstruction::of_block(&attempt.block, consensus));
    if attempt.judges_observations() {
        let found = projective.map(|found| found.weighed(problem).oriented());
        attempt.projective = found.filter(ProjectiveReconstruction::is_off_lines);
        attempt.found.consensus.take_if(|_| attempt.projective.is_none());
    } else {
        attempt.projective = projective;
    }
    Ok(attempt)
}

/// Calibrates what stands of an attempt. Behind an undone lens a focal length that the motion does not determine is that
/// of the lens: an extension, which adjusts it in the images, asks whether it holds.
pub fn calibrate(problem: &Problem, attempt: &mut Attempt, recorder: &mut Recorder) -> Result<(), Error> {
    let Some(projective) = &attempt.projective else { return Ok(()) };
    recorder.enter(Stage::Calibrate);
    attempt.calibration = Some(match (&attempt.found.verified_by, &attempt.found.consensus) {
        (VerifiedBy::Depths { focal }, Some(consensus)) => {
            depths::calibrate(problem, &attempt.block.complete, consensus, *focal)
        }
        _ => {
            let found = calibrate_projective(problem, projective, &problem.focal_priors)?;
            let is_open = found.grade == Grade::ProjectiveOnly
                && found.warnings.iter().any(|warning| warning.code == WarningCode::UnobservableFocal);
            match problem.undone.as_ref().filter(|_| is_open && !problem.has_own_focals()) {
                Some(undone) => {
                    let of_lenses = undone.focal_priors(problem.scale_px, OPTIONS.undone_sigma);
                    let known = problem.focal_priors.iter().zip(of_lenses).map(|(known, of_lens)| known.or(of_lens));
                    calibrate_projective(problem, projective, &known.collect::<Vec<_>>())?
                }
                None => found,
            }
        }
    });
    if let Some(intrinsics) = attempt.calibration.as_ref().and_then(Outcome::intrinsics) {
        recorder.progress.focal_px = Some(intrinsics.focal * problem.scale_px);
    }
    recorder.registered(projective.views.len());
    recorder.report(1.0);
    Ok(())
}

/// AUTO and GEOMETRY: a sample of the tracks that move, and where that holds nothing, one of all.
fn searched(problem: &Problem, block: Block, effort: Effort, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let (most, of_many_views) = OPTIONS.searched_tracks;
    let most = match effort.is_seed {
        true => of_many_views,
        false => (OPTIONS.searched_work / block.views.len().max(1).pow(2)).clamp(of_many_views, most),
    };
    let block = near_duplicates::without(&problem.representative, block);
    if let Some(moving) = static_tracks::without(&problem.is_static, &block) {
        let (sample, track_scores) = track_sampling::sample(problem, &moving, most, !effort.is_seed)?;
        let attempt = search(problem, sample, track_scores, effort, recorder)?;
        if attempt.found.consensus.is_some() {
            return Ok(attempt);
        }
        recorder.begin_again();
    }
    let (sample, track_scores) = track_sampling::sample(problem, &block, most, !effort.is_seed)?;
    search(problem, sample, track_scores, effort, recorder)
}

/// The portfolio, its consensus refined.
fn search(
    problem: &Problem,
    block: Block,
    track_scores: Option<TrackScores>,
    effort: Effort,
    recorder: &mut Recorder,
) -> Result<Attempt, Error> {
    let mut attempt = Attempt::new(block);
    let (complete, tracks) = (&attempt.block.complete, &attempt.block.tracks);
    attempt.found =
        Portfolio::new(complete, problem.settings, problem.initial_noise, effort, track_scores, problem.stop)
            .run(recorder, &|weights| problem.scatter(weights, tracks))
            .map_err(|error| Error::Internal(error.to_string()))?;
    problem.stopped()?;
    let Some(consensus) = attempt.found.consensus.take() else { return Ok(attempt) };
    recorder.enter(Stage::Refine);
    if attempt.is_by_depths() {
        return Ok(verified_by_depths(problem, attempt, consensus));
    }
    let (mut refined, ln_false_alarms) = grow::refine(complete, &consensus, spread::spread(complete), problem.stop);
    recorder.progress.inliers = refined.inlier_count() as u32;
    recorder.progress.best_cost = Some(refined.score);
    recorder.report(1.0);
    let counted = match &attempt.found.track_scores {
        Some(track_scores) => track_scores.counted(&refined.inliers()),
        None => refined.inlier_count(),
    };
    if counted < LEAST_INLIERS {
        attempt.found.rejected_by_network =
            (counted < refined.inlier_count()).then_some((refined.inlier_count(), counted));
        return Ok(by_depths(problem, attempt));
    }
    // Another noise and other inliers than those that were accepted.
    if ln_false_alarms >= FalseAlarmOptions::DEFAULT.ln_acceptable {
        return Ok(by_depths(problem, attempt));
    }
    if effort.is_seed {
        attempt.found.consensus = Some(refined);
        return Ok(attempt);
    }
    if let Some((block, consensus)) = all_tracks::extend(problem, &attempt.block, &refined) {
        attempt.found.network_weights = carry_over(&attempt.found.network_weights, &attempt.block, &block);
        recorder.progress.inliers = consensus.inlier_count() as u32;
        // What the network says of a sample, it does not say of all.
        attempt.found.track_scores = None;
        (attempt.block, refined) = (block, consensus);
    }
    problem.stopped()?;
    if refined.noise > DepthOptions::DEFAULT.strong_noise {
        attempt.weights_by_depths = depths::weights(problem, &attempt.block, &refined, attempt.rigid());
    }
    attempt.found.consensus = Some(refined);
    Ok(attempt)
}

/// The rigid consensus of an attempt whose image points verify nothing; the attempt as it is where there is none.
fn by_depths(problem: &Problem, mut attempt: Attempt) -> Attempt {
    let Some((proposal, rigid)) = &attempt.found.rigid else { return attempt };
    let consensus = depths::consensus(&attempt.block.complete, rigid, problem.initial_noise);
    attempt.found.verified_by = VerifiedBy::Depths { focal: rigid.focal };
    attempt.found.winning_proposal = Some(*proposal);
    attempt.found.rejected_by_network = None;
    verified_by_depths(problem, attempt, consensus)
}

fn verified_by_depths(problem: &Problem, mut attempt: Attempt, consensus: Consensus) -> Attempt {
    attempt.weights_by_depths = depths::weights(problem, &attempt.block, &consensus, attempt.rigid());
    attempt.found.consensus = Some(consensus);
    attempt
}

/// The network's weights of the searched tracks, for a larger block; 0 for tracks that it was not shown.
fn carry_over(weights: &[f64], searched: &Block, block: &Block) -> Vec<f64> {
    if weights.is_empty() {
        return Vec::new();
    }
    let weight = |track: &usize| searched.tracks.binary_search(track).ok().map_or(0.0, |place| weights[place]);
    block.tracks.iter().map(weight).collect()
}

/// PAPER, SCPSFM and PSFM: the method's own set of tracks, reconstructed as it is.
fn decided(problem: &Problem, block: Block, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let mut attempt = Attempt::new(block);
    let noise = problem.initial_noise;
    let completed = baselines::with_epipolar_depths(problem, &attempt.block.complete, noise);
    problem.stopped()?;
    let complete = completed.as_ref().unwrap_or(&attempt.block.complete);
    let tracks = &attempt.block.tracks;
    let decided = match problem.settings.method {
        Method::Psfm => Ok(baselines::psfm(complete, noise)),
        _ => scpsfm::decide(problem, complete, tracks, recorder),
    };
    let decided = decided.map_err(|error| Error::Internal(error.to_string()))?;
    problem.stopped()?;
    recorder.enter(Stage::Refine);
    if problem.settings.method.uses_network() {
        attempt.found.network_weights = decided.weights.clone();
    }
    if decided.is_verified {
        attempt.found.consensus = baselines::reconstruct(complete, &decided.inlier, noise, problem.stop);
    }
    attempt.decided = Some(decided);
    recorder.report(1.0);
    Ok(attempt)
}

/// Calibrates from a reconstruction, or as much of it as a calibration takes; the worst of its cameras.
///
/// * `known`: what is known of the focal length of each camera beforehand
fn calibrate_projective(
    problem: &Problem,
    projective: &ProjectiveReconstruction,
    known: &[Option<FocalPrior>],
) -> Result<Outcome, Error> {
    let most = OPTIONS.most_calibrated.min(OPTIONS.calibrated_observations / projective.views.len().max(1));
    let some = projective.most_observed(most);
    let (group_of, cameras) = problem.cameras_of(&projective.views);
    let focal_priors: Vec<Option<FocalPrior>> = cameras.iter().map(|&camera| known[camera]).collect();
    let reconstruction = (some.cameras.as_slice(), some.points.as_slice());
    let to_calibrate =
        problem.uncalibrated(reconstruction, &some.observations, some.noise, &group_of, &focal_priors, &|| ());
    let mut outcomes = calibration::calibrate(&to_calibrate)?;
    if let Some(undone) = &problem.undone {
        for metric in outcomes.iter_mut().filter_map(|outcome| outcome.metric.as_mut()) {
            for (lens, &camera) in metric.intrinsics.iter_mut().zip(&cameras) {
                *lens = undone.behind(camera, lens);
            }
        }
    }
    Ok(Outcome::worst(outcomes).unwrap_or_else(|| Outcome::refused(Vec::new())))
}
