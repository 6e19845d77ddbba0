//! One block of views solved from search to calibration.

use super::a_contrario::LN_ACCEPTABLE;
use super::baselines::{self, Decided};
use super::block::Block;
use super::calibration::{self, Outcome};
use super::classification::Judged;
use super::grow::{self, Consensus, LEAST_INLIERS};
use super::learned::TrackScores;
use super::portfolio::{self, Portfolio, VerifiedBy};
use super::recorder::Recorder;
use super::sequence::Projective;
use super::{Context, Error};
use super::{depths, extend, near_duplicates, second_structures, track_sampling};
use crate::domain::result::PriorTime;
use crate::domain::{FocalPrior, Grade, Method, Prior, Stage, View, Warning, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, Reconstruction};

/// Noise that growing starts from when the caller gives none, as a share of the image side. High on purpose: twice too
/// low loses the scene, ten times too high costs nothing.
pub const INITIAL_NOISE: f64 = 0.005;
/// Tracks that a search looks at, at most and where there are many views: bundle adjustment costs their number times
/// the square of the views, and more tracks make a consensus neither easier to find nor much more exact.
const SEARCHED_TRACKS: (usize, usize) = (600, 200);
/// Tracks times squared views that a search may hold between those two.
const SEARCHED_WORK: usize = 60_000;
/// Inlier tracks, and observations of them, that a calibration is made from: beyond, it takes minutes, and other errors
/// than noise bound what it gives.
const MOST_CALIBRATED: usize = 600;
const CALIBRATED_OBSERVATIONS: usize = 20_000;
/// Tracks that PAPER optimises weights for: the network holds some 40 kB a track at full width.
const PAPER_TRACKS: usize = 5_000;

/// What is said of motions and scenes that carry no calibration.
const CRITICAL: [WarningCode; 4] =
    [WarningCode::PureTranslation, WarningCode::PureRotation, WarningCode::PlanarScene, WarningCode::PlanarOrRotation];

/// Merit of a WEAK attempt, see [`Attempt::merit`].
pub const WEAK_MERIT: u8 = 3;

/// What became of one block.
pub struct Attempt {
    pub block: Block,
    /// Spread of the image points that were searched, see [`portfolio::spread`]: a crowd that joins later takes up
    /// little of the image.
    pub spread: f64,
    /// The consensus over the tracks of the block; `None` when nothing stands.
    pub consensus: Option<Consensus>,
    /// The consensus as a reconstruction of its inliers, or what that was extended to; `None` when nothing stands.
    pub projective: Option<Projective>,
    /// Every observation judged by `projective`, where that was done already.
    pub judged: Option<Judged>,
    /// What the consensus was verified by.
    pub verified_by: VerifiedBy,
    pub calibration: Option<Outcome>,
    pub winning_prior: Option<Prior>,
    /// What the trained network says of the tracks that were searched; `None` where it was not asked.
    pub track_scores: Option<TrackScores>,
    /// Tracks that hold under one geometry, and how many of them count; `None` but where too few count.
    pub doubted: Option<(usize, usize)>,
    /// Tracks that hold under one geometry and lie within the noise of each other, and how many of them count; `None`
    /// but where too few count.
    pub crowded: Option<(usize, usize)>,
    /// That the tracks left out agree on a motion of their own.
    pub second_structure: Option<Warning>,
    /// Probability of each track of the block to be right by image points and depths together; `None` where depths
    /// do not judge.
    pub weights_by_depths: Option<Vec<f64>>,
    /// The method's own verdicts where it searches nothing (PAPER, PSFM).
    pub decided: Option<Decided>,
    /// The network's weights, one a track of the block; empty where none ran.
    pub network_weights: Vec<f64>,
    pub prior_times: Vec<PriorTime>,
}

impl Attempt {
    /// Nothing found yet.
    fn new(block: Block) -> Self {
        Self {
            spread: portfolio::spread(&block.complete),
            block,
            consensus: None,
            projective: None,
            judged: None,
            verified_by: VerifiedBy::ImagePoints,
            calibration: None,
            winning_prior: None,
            track_scores: None,
            doubted: None,
            crowded: None,
            second_structure: None,
            weights_by_depths: None,
            decided: None,
            network_weights: Vec::new(),
            prior_times: Vec::new(),
        }
    }

    /// Views that have a camera, increasing.
    pub fn views(&self) -> &[usize] {
        self.projective.as_ref().map_or(&[], |projective| &projective.views)
    }

    /// Whether single observations are judged: where image points alone verify and the method decides nothing itself.
    pub fn judges_observations(&self) -> bool {
        matches!(self.verified_by, VerifiedBy::ImagePoints) && self.decided.is_none()
    }

    /// Larger is better: solved before unsolved, then by grade, then by the certainty of the focal length.
    pub fn merit(&self) -> (u8, f64) {
        let Some(calibration) = &self.calibration else { return (u8::from(self.consensus.is_some()), 0.0) };
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

    /// Whether there is a calibration that may be used.
    pub fn is_calibrated(&self) -> bool {
        self.merit().0 >= WEAK_MERIT
    }

    /// Whether the calibration has found a lens that distorts.
    pub fn has_lens(&self) -> bool {
        let distorts = |metric: &Reconstruction| metric.intrinsics.iter().any(Intrinsics::distorts);
        self.calibration.as_ref().and_then(|calibration| calibration.metric.as_ref()).is_some_and(distorts)
    }

    /// Whether nothing says that observations within the tracks are wrong: a calibration that fits as well as
    /// projective cameras do, or a motion or scene found that carries none, which wrong observations would refute.
    pub fn is_trusted(&self) -> bool {
        self.calibration.as_ref().is_some_and(|calibration| {
            let warns =
                |codes: &[WarningCode]| calibration.warnings.iter().any(|warning| codes.contains(&warning.code));
            let fits = calibration.grade != Grade::ProjectiveOnly && !warns(&[WarningCode::ModelMismatch]);
            fits || self.is_good() || warns(&CRITICAL)
        })
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

/// Solves a block, or as many of its tracks as its method can afford.
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn solve_block(block: Block, context: &Context, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let mut attempt = search_block(block, context, recorder)?;
    calibrate(&mut attempt, context, recorder)?;
    Ok(attempt)
}

/// Searches a block, or as many of its tracks as its method can afford, for a consensus.
///
/// # Errors
/// As [`solve_block`].
pub fn search_block(block: Block, context: &Context, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let most = match context.settings.method {
        Method::Auto | Method::Geometry if context.seeding => SEARCHED_TRACKS.1,
        Method::Auto | Method::Geometry => {
            let views = block.views.len().max(1);
            (SEARCHED_WORK / (views * views)).clamp(SEARCHED_TRACKS.1, SEARCHED_TRACKS.0)
        }
        Method::Paper => PAPER_TRACKS,
        Method::Psfm => usize::MAX,
    };
    recorder.enter(Stage::Search);
    let mut attempt = match context.settings.method {
        Method::Auto | Method::Geometry => searched(&block, most, context, recorder)?,
        Method::Paper | Method::Psfm => {
            let mut attempt = Attempt::new(block.sample(most, context.settings.seed));
            decide(&mut attempt, context, recorder)?;
            attempt
        }
    };
    context.stopped()?;
    let projective = attempt.consensus.as_ref().map(|consensus| Projective::of_block(&attempt.block, consensus));
    attempt.projective = match attempt.judges_observations() {
        true => projective.map(Projective::oriented),
        false => projective,
    };
    Ok(attempt)
}

/// Calibrates what stands of an attempt.
///
/// # Errors
/// As [`solve_block`].
pub fn calibrate(attempt: &mut Attempt, context: &Context, recorder: &mut Recorder) -> Result<(), Error> {
    let (Some(consensus), Some(projective)) = (&attempt.consensus, &attempt.projective) else { return Ok(()) };
    recorder.enter(Stage::Calibrate);
    attempt.calibration = Some(match attempt.verified_by {
        VerifiedBy::ImagePoints => calibrate_projective(projective, context)?,
        VerifiedBy::Depths { focal } => depths::calibrate(&attempt.block.complete, consensus, focal, context.stop),
    });
    if let Some(intrinsics) = attempt.calibration.as_ref().and_then(Outcome::intrinsics) {
        recorder.standing.focal_px = Some(intrinsics.focal * context.scale_px);
    }
    recorder.registered(projective.views.len());
    recorder.tell(1.0);
    Ok(())
}

/// The noise that a solve starts from, normalised units.
fn initial_noise(context: &Context) -> f64 {
    let noise = context.settings.noise_px.map_or(INITIAL_NOISE, |noise_px| noise_px / context.scale_px);
    noise.clamp(grow::NOISE_BOUNDS.0, grow::NOISE_BOUNDS.1)
}

/// AUTO and GEOMETRY: a sample of the tracks without crowds, and where that holds nothing, one of all.
fn searched(block: &Block, most: usize, context: &Context, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let seed = context.settings.seed;
    if let Some(thinned) = near_duplicates::thinned(block, most, initial_noise(context), seed) {
        let mut attempt = Attempt::new(thinned);
        search(&mut attempt, context, recorder)?;
        if attempt.consensus.is_some() {
            return Ok(attempt);
        }
        recorder.begin_again();
    }
    let (sample, track_scores) = track_sampling::sample(block, most, context)?;
    let mut attempt = Attempt { track_scores, ..Attempt::new(sample) };
    search(&mut attempt, context, recorder)?;
    Ok(attempt)
}

/// The portfolio, its consensus refined.
fn search(attempt: &mut Attempt, context: &Context, recorder: &mut Recorder) -> Result<(), Error> {
    let complete = &attempt.block.complete;
    let tracks = &attempt.block.tracks;
    let found = Portfolio::new(complete, context.settings, initial_noise(context), context.stop)
        .geometry_first(context.seeding)
        .quickly(context.quick)
        .with_track_scores(attempt.track_scores.take())
        .run(recorder, &|weights| context.scatter(weights, tracks))
        .map_err(|error| Error::Internal(error.to_string()))?;
    context.stopped()?;
    attempt.winning_prior = found.winning_prior;
    attempt.track_scores = found.track_scores;
    attempt.doubted = found.doubted;
    attempt.crowded = found.crowded;
    attempt.prior_times = found.prior_times;
    attempt.network_weights = found.network_weights;
    let Some(consensus) = found.consensus else { return Ok(()) };
    recorder.enter(Stage::Refine);
    attempt.verified_by = found.verified_by;
    if matches!(found.verified_by, VerifiedBy::Depths { .. }) {
        attempt.weights_by_depths =
            found.rigid.and_then(|rigid| depths::weights(complete, &consensus, &rigid, attempt.spread, context.stop));
        attempt.consensus = Some(consensus);
        return Ok(());
    }
    let (refined, ln_false_alarms) = grow::refine(complete, &consensus, attempt.spread, context.stop);
    recorder.standing.inliers = refined.inlier_count() as u32;
    recorder.standing.best_score = Some(refined.score);
    recorder.tell(1.0);
    let counted = match &attempt.track_scores {
        Some(track_scores) => track_scores.counted(&refined.inliers()),
        None => refined.inlier_count(),
    };
    if counted < LEAST_INLIERS {
        attempt.doubted = (counted < refined.inlier_count()).then_some((refined.inlier_count(), counted));
        return Ok(());
    }
    // Another noise and other inliers than those that were accepted.
    if ln_false_alarms >= LN_ACCEPTABLE {
        return Ok(());
    }
    attempt.second_structure = second_structures::find(complete, &refined, context.stop);
    context.stopped()?;
    if context.seeding {
        attempt.consensus = Some(refined);
        return Ok(());
    }
    let extended = extend::extend(&attempt.block, &refined, context);
    context.stopped()?;
    if let Some((block, consensus)) = extended {
        attempt.network_weights = carry_over(&attempt.network_weights, &attempt.block, &block);
        recorder.standing.inliers = consensus.inlier_count() as u32;
        (attempt.block, attempt.consensus) = (block, Some(consensus));
    } else {
        attempt.consensus = Some(refined);
    }
    let complete = &attempt.block.complete;
    if let (Some(rigid), Some(consensus)) = (&found.rigid, &attempt.consensus)
        && consensus.noise > depths::STRONG_NOISE
    {
        attempt.weights_by_depths = depths::weights(complete, consensus, rigid, attempt.spread, context.stop);
    }
    Ok(())
}

/// The network's weights of the searched tracks, for a larger block; 0 for tracks that it was not shown.
fn carry_over(weights: &[f64], searched: &Block, block: &Block) -> Vec<f64> {
    if weights.is_empty() {
        return Vec::new();
    }
    let weight = |track: &usize| searched.tracks.binary_search(track).ok().map_or(0.0, |place| weights[place]);
    block.tracks.iter().map(weight).collect()
}

/// PAPER and PSFM: the method's own set of tracks, reconstructed as it is.
fn decide(attempt: &mut Attempt, context: &Context, recorder: &mut Recorder) -> Result<(), Error> {
    let noise = initial_noise(context);
    let completed = baselines::with_epipolar_depths(&attempt.block.complete, context, noise);
    context.stopped()?;
    let complete = completed.as_ref().unwrap_or(&attempt.block.complete);
    let decided = match context.settings.method {
        Method::Psfm => baselines::psfm(complete, noise),
        _ => baselines::paper(complete, &attempt.block.tracks, context, recorder)
            .map_err(|error| Error::Internal(error.to_string()))?,
    };
    context.stopped()?;
    recorder.enter(Stage::Refine);
    attempt.network_weights = decided.network_weights.clone();
    attempt.consensus = baselines::reconstruct(complete, &decided.inlier, noise, context.stop);
    attempt.decided = Some(decided);
    recorder.tell(1.0);
    Ok(())
}

/// Calibrates from a reconstruction, or as much of it as a calibration takes; the worst of its camera groups.
fn calibrate_projective(projective: &Projective, context: &Context) -> Result<Outcome, Error> {
    let most = MOST_CALIBRATED.min(CALIBRATED_OBSERVATIONS / projective.views.len().max(1));
    let some = projective.most_observed(most);
    let (group_of, groups) = context.camera_groups_of(&projective.views);
    let of_group = |group: usize| {
        let views = projective.views.iter().zip(&group_of).filter(|(_, of)| **of == group);
        focal_prior(views.map(|(&view, _)| &context.input.views()[view]))
    };
    let told = context.focal_prior.filter(|_| groups == 1);
    let focal_priors: Vec<Option<FocalPrior>> = (0..groups).map(|group| told.or_else(|| of_group(group))).collect();
    let problem = calibration::Problem {
        cameras: &some.cameras,
        points: &some.points,
        observations: &some.observations,
        noise: some.noise,
        focal_per_view: context.settings.focal_per_view,
        group_of: &group_of,
        focal_priors: &focal_priors,
    };
    let outcomes = calibration::calibrate(&problem, context.scale_px, context.stop)?;
    Ok(Outcome::worst(outcomes).unwrap_or_else(|| Outcome::refused(Vec::new())))
}

/// What is known beforehand of the one focal length of these views; `None` where nothing is.
///
/// The priors of one camera's views tell one piece of knowledge several times: their mean, weighted by information,
/// has the standard deviation of one of them, not that of a mean. Where they differ, by so much more.
pub fn focal_prior<'a>(views: impl Iterator<Item = &'a View>) -> Option<FocalPrior> {
    let told: Vec<(f64, f64)> = views
        .filter_map(|view| view.focal_prior)
        .map(|prior| (prior.focal_px.ln(), prior.sigma_log.powi(-2)))
        .collect();
    let total: f64 = told.iter().map(|(_, information)| information).sum();
    let mean = told.iter().map(|(log, information)| information * log).sum::<f64>() / total;
    let spread = told.iter().map(|(log, information)| information * (log - mean).powi(2)).sum::<f64>() / total;
    let sigma_log = (told.len() as f64 / total + spread).sqrt();
    let usable = mean.is_finite() && sigma_log.is_finite() && sigma_log > 0.0;
    usable.then(|| FocalPrior { focal_px: mean.exp(), sigma_log })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prior(views: &[Option<(f64, f64)>]) -> Option<FocalPrior> {
        let view = |prior: &Option<(f64, f64)>| View {
            focal_prior: prior.map(|(focal_px, sigma_log)| FocalPrior { focal_px, sigma_log }),
            ..View::default()
        };
        let views: Vec<View> = views.iter().map(view).collect();
        focal_prior(views.iter())
    }

    #[test]
    fn priors_of_several_views_are_one_piece_of_knowledge() {
        assert_eq!(prior(&[]), None);
        assert_eq!(prior(&[None, None]), None);
        let told = prior(&[Some((800.0, 0.1)), None, Some((800.0, 0.1))]).expect("a prior");
        assert!((told.focal_px - 800.0).abs() < 1e-9 && (told.sigma_log - 0.1).abs() < 1e-12, "{told:?}");
        let vague = prior(&[Some((800.0, 0.01)), Some((1600.0, 1.0))]).expect("a prior");
        assert!((vague.focal_px - 800.0).abs() < 1.0, "the vaguer one hardly counts: {vague:?}");
        let torn = prior(&[Some((800.0, 0.01)), Some((1600.0, 0.01))]).expect("a prior");
        assert!((torn.sigma_log - 0.5 * 2f64.ln()).abs() < 1e-3, "{torn:?}");
        assert_eq!(prior(&[Some((800.0, f64::MAX))]), None, "nothing is known");
    }
}
