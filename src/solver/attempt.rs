//! One block of views solved from search to calibration.

use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use super::block::Block;
use super::calibration::{self, Outcome};
use super::direct::{self, Decided};
use super::grow::{self, Consensus};
use super::portfolio::{self, Portfolio};
use super::recorder::Recorder;
use super::{Error, stopped};
use crate::domain::result::PriorTime;
use crate::domain::{Grade, Method, Prior, SolveSettings, Stage, StopToken};

/// Noise that growing starts from when the caller gives none, as a share of the image side. High on purpose: twice too
/// low loses the scene, ten times too high costs nothing.
const INITIAL_NOISE: f64 = 0.005;
/// Tracks that the search looks at; more of them do not make a consensus easier to find, and time grows with them.
const MOST_SEARCHED_TRACKS: usize = 600;

/// What became of one block.
pub struct Attempt {
    pub block: Block,
    /// The consensus over all tracks of the block; `None` when nothing stands.
    pub consensus: Option<Consensus>,
    pub calibration: Option<Outcome>,
    pub winning_prior: Option<Prior>,
    pub iterations: u32,
    /// The method's own verdicts where it searches nothing (PAPER, PSFM).
    pub decided: Option<Decided>,
    /// The network's weights, one a track of the block; `None` for a track that the search left out.
    pub network_weights: Vec<Option<f64>>,
    pub prior_times: Vec<PriorTime>,
}

impl Attempt {
    /// Larger is better: solved before unsolved, then by grade, then by the certainty of the focal length.
    pub fn merit(&self) -> (u8, f64) {
        let Some(calibration) = &self.calibration else { return (u8::from(self.consensus.is_some()), 0.0) };
        let grade = match calibration.grade {
            Grade::Metric => 4,
            Grade::Weak => 3,
            Grade::ProjectiveOnly => 2,
        };
        (grade, -calibration.sigma_log_focal.unwrap_or(f64::INFINITY))
    }

    /// Whether no other block needs to be tried.
    pub fn is_good(&self) -> bool {
        self.calibration
            .as_ref()
            .is_some_and(|calibration| calibration.grade == Grade::Metric && calibration.rms_ratio < MOST_MISFIT)
    }
}

/// Ratio of metric to projective residuals above which a block is distrusted and the next one tried: a consensus with
/// one wrong track or a dominant plane fits projectively and not metrically.
const MOST_MISFIT: f64 = 4.0;

/// Solves a block.
///
/// * `track_count`: tracks of the input, for interim weights
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn solve_block(
    block: Block,
    track_count: usize,
    settings: &SolveSettings,
    scale_px: f64,
    recorder: &mut Recorder,
    stop: &StopToken,
) -> Result<Attempt, Error> {
    let noise = settings.noise_px.map_or(INITIAL_NOISE, |noise_px| noise_px / scale_px);
    let mut attempt = Attempt {
        block,
        consensus: None,
        calibration: None,
        winning_prior: None,
        iterations: 0,
        decided: None,
        network_weights: Vec::new(),
        prior_times: Vec::new(),
    };
    recorder.enter(Stage::Search);
    match settings.method {
        Method::Auto | Method::Geometry => {
            search(&mut attempt, track_count, settings, scale_px, noise, recorder, stop)?
        }
        Method::Paper | Method::Psfm => decide(&mut attempt, track_count, settings, scale_px, noise, recorder, stop)?,
    }
    stopped(stop)?;
    if let Some(consensus) = &attempt.consensus {
        recorder.enter(Stage::Calibrate);
        attempt.calibration = Some(calibrate(&attempt.block, consensus, scale_px, stop)?);
        if let Some(metric) = attempt.calibration.as_ref().and_then(|outcome| outcome.metric.as_ref()) {
            recorder.standing.focal_px = Some(metric.intrinsics.focal * scale_px);
        }
        recorder.tell(1.0);
    }
    Ok(attempt)
}

/// AUTO and GEOMETRY: the portfolio on at most [`MOST_SEARCHED_TRACKS`] tracks, its consensus refined on all.
fn search(
    attempt: &mut Attempt,
    track_count: usize,
    settings: &SolveSettings,
    scale_px: f64,
    noise: f64,
    recorder: &mut Recorder,
    stop: &StopToken,
) -> Result<(), Error> {
    let complete = &attempt.block.complete;
    let searched = searched_tracks(complete.tracks(), settings.seed);
    let subset = complete.select(&searched);
    let tracks: Vec<usize> = searched.iter().map(|&j| attempt.block.tracks[j]).collect();
    let found = Portfolio::new(&subset, settings, noise, stop)
        .run(recorder, scale_px, &|weights| scatter(weights, &tracks, track_count))
        .map_err(|error| Error::Internal(error.to_string()))?;
    stopped(stop)?;
    attempt.winning_prior = found.winning_prior;
    attempt.iterations = found.iterations;
    attempt.prior_times = found.prior_times;
    attempt.network_weights = vec![None; complete.tracks()];
    for (&track, &weight) in searched.iter().zip(&found.network_weights) {
        attempt.network_weights[track] = Some(weight);
    }
    let Some(consensus) = found.consensus else { return Ok(()) };
    recorder.enter(Stage::Refine);
    let settled = grow::refine(complete, &consensus, portfolio::spread(complete), stop);
    recorder.standing.inliers = settled.inlier_count() as u32;
    recorder.standing.best_score = Some(settled.score);
    recorder.tell(1.0);
    if settled.inlier_count() >= portfolio::LEAST_INLIERS {
        attempt.consensus = Some(settled);
    }
    Ok(())
}

/// PAPER and PSFM: the method's own set of tracks, reconstructed as it is.
fn decide(
    attempt: &mut Attempt,
    track_count: usize,
    settings: &SolveSettings,
    scale_px: f64,
    noise: f64,
    recorder: &mut Recorder,
    stop: &StopToken,
) -> Result<(), Error> {
    let complete = &attempt.block.complete;
    let decided = match settings.method {
        Method::Psfm => direct::psfm(complete, noise),
        _ => {
            let tracks = &attempt.block.tracks;
            let spread_weights = |weights: &[f64]| scatter(weights, tracks, track_count);
            direct::paper(complete, settings, recorder, scale_px, &spread_weights, stop)
                .map_err(|error| Error::Internal(error.to_string()))?
        }
    };
    stopped(stop)?;
    recorder.enter(Stage::Refine);
    attempt.iterations = decided.iterations;
    attempt.network_weights = decided.network_weights.iter().map(|&weight| Some(weight)).collect();
    attempt.consensus = direct::reconstruct(complete, &decided.inlier, noise, stop);
    attempt.decided = Some(decided);
    recorder.tell(1.0);
    Ok(())
}

/// Calibrates from the inliers of a consensus.
fn calibrate(block: &Block, consensus: &Consensus, scale_px: f64, stop: &StopToken) -> Result<Outcome, Error> {
    let inliers = consensus.inliers();
    let points: Vec<_> = inliers.iter().map(|&track| consensus.points[track]).collect();
    let observations = grow::observations_of(&block.complete, &inliers);
    let problem = calibration::Problem {
        cameras: &consensus.cameras,
        points: &points,
        observations: &observations,
        noise: consensus.noise,
    };
    Ok(calibration::calibrate(&problem, scale_px, stop)?)
}

/// All tracks, or a random choice of [`MOST_SEARCHED_TRACKS`], increasing.
fn searched_tracks(tracks: usize, seed: u64) -> Vec<usize> {
    if tracks <= MOST_SEARCHED_TRACKS {
        return (0..tracks).collect();
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut chosen = index::sample(&mut rng, tracks, MOST_SEARCHED_TRACKS).into_vec();
    chosen.sort_unstable();
    chosen
}

/// Weights of some tracks as weights of all, 0 elsewhere.
fn scatter(weights: &[f64], tracks: &[usize], track_count: usize) -> Vec<f32> {
    let mut all = vec![0.0; track_count];
    for (&track, &weight) in tracks.iter().zip(weights) {
        all[track] = weight as f32;
    }
    all
}
