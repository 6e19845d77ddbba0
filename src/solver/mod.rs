//! The estimator: from an input to a solution. Stages, priors, hypothesis search, growing, calibration and grading.
//!
//! Depends on `network`, `geometry` and `domain`; knows nothing of jobs, transport or files.
//!
//! The way through: [`copies`] keeps one of the tracks that stand in the input several times; [`block`] chooses views
//! whose tracks are complete: all of them, or a few; [`attempt`] searches such a block, by [`portfolio`] (priors,
//! [`search`], [`grow`]; [`near_duplicates`] are left aside, the [`track_sampling`] of many tracks searched,
//! [`a_contrario`] verifies; [`depths`] where those verify what image points cannot; [`extend`] to complete tracks and
//! views that a search leaves aside) or [`baselines`], and [`calibration`] upgrades it. By image points, [`sequence`]
//! tries blocks in order of cost and extends what stands to the other views and tracks, projectively or metrically,
//! observation by observation; [`classification`] has the last word on every track and observation; [`assemble`] writes
//! it down.

pub(crate) mod a_contrario;
mod assemble;
mod attempt;
mod baselines;
mod between_block_variance;
pub(crate) mod block;
pub(crate) mod calibration;
mod classification;
mod copies;
mod depths;
mod extend;
pub(crate) mod grow;
pub(crate) mod learned;
mod near_duplicates;
mod per_track;
pub(crate) mod portfolio;
pub(crate) mod priors;
mod recorder;
pub(crate) mod search;
mod second_structures;
mod sequence;
#[cfg(test)]
mod tests;
mod track_sampling;
mod views;

use crate::domain::copies::Copies;
use crate::domain::result::{ObservationResults, ViewResult};
use crate::domain::{
    FocalPrior, Input, Observer, Solution, SolveSettings, Status, StopReason, StopToken, Warning, WarningCode,
};
use crate::geometry::measurement::Normalization;
use crate::parallel::Threads;
use attempt::Attempt;
use recorder::Recorder;

/// Why a solve ended without a solution. A scene that cannot be solved is a solution, not an error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// The stop token asked for it.
    #[error("stopped before a result stood: {0:?}")]
    Stopped(StopReason),
    /// A defect of ours, not of the input.
    #[error("internal solver error: {0}")]
    Internal(String),
}

/// Solves one input on the caller's thread; see [`solve_on`].
///
/// # Errors
/// As [`solve_on`].
pub fn solve(
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    solve_on(Threads::ONE, input, settings, observer, stop)
}

/// Solves one input.
///
/// Deterministic: the same input, settings and build give the same solution, but for times, on any number of threads.
/// Further ones than the caller's help where a reconstruction is extended and tracks are judged.
/// `observer` is told of every iteration; `stop` is asked at least every 50 ms or network iteration.
///
/// AUTO and GEOMETRY judge every observation by itself and extend a block to every view that can be registered: all
/// views at once where their tracks are complete and that decides quickly, else few of them. With depths, and by PAPER
/// and PSFM, the best block is solved, views outside it are left out with a warning, and blocks that disagree raise its
/// uncertainty.
///
/// Tracks that are [copies](Copies) of another count once, whatever the method.
///
/// # Errors
/// [`Error::Stopped`] when `stop` fired, [`Error::Internal`] for a defect.
pub fn solve_on(
    threads: Threads,
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    let mut solution = match Copies::of(input) {
        None => solve_views(threads, input, settings, observer, stop)?,
        Some(found) => copies::solve_once(input, &found, observer, |rest, observer| {
            solve_views(threads, rest, settings, observer, stop)
        })?,
    };
    views::complete(&mut solution, input);
    solution.input_sha256 = Some(input.to_raw().sha256());
    solution.trained_network = learned::may_be_asked(settings).then(trained_network);
    Ok(solution)
}

/// SHA-256, hexadecimal, of the trained network that AUTO asks in this process.
pub fn trained_network() -> String {
    crate::network::subspace::current_checksum().to_owned()
}

/// The solution but for what [`views::complete`] says of the views.
fn solve_views(
    threads: Threads,
    input: &Input,
    settings: &SolveSettings,
    observer: &mut dyn Observer,
    stop: &StopToken,
) -> Result<Solution, Error> {
    // The DAQ loss assumes constant intrinsics, so it is disabled when the focal length varies.
    let settings = &SolveSettings { use_daq: settings.use_daq && !settings.focal_per_view, ..settings.clone() };
    let mut recorder = Recorder::new(observer, block::observed_views(input).len());
    let ranges = input.track_ranges();
    let (normalization, mut warnings) = block::normalization(input);
    let scale_px = normalization.scale_px;
    let context = Context {
        input,
        settings,
        ranges: &ranges,
        normalization: &normalization,
        scale_px,
        seeding: false,
        quick: false,
        // What is solved as one block has one calibration.
        merges_cameras: true,
        focal_prior: None,
        threads,
        stop,
    };
    if sequence::applies(&context) {
        return solve_by_observation(&context, warnings, recorder);
    }
    warnings.extend(block::merged_cameras(input, false, settings.focal_per_view));
    let candidates = block::candidate_views(input, &ranges, stop);
    let mut best: Option<Attempt> = None;
    let mut others = Vec::new();
    for (k, views) in candidates.iter().enumerate() {
        context.stopped()?;
        recorder.begin_block(k, candidates.len());
        let block = block::extract(input, &ranges, &normalization, views);
        let attempt = attempt::solve_block(block, &context, &mut recorder)?;
        if best.as_ref().is_none_or(|best| attempt.merit() > best.merit()) {
            others.extend(best.replace(attempt));
        } else {
            others.push(attempt);
        }
        // A good block is still checked against a second one.
        if k > 0 && best.as_ref().is_some_and(Attempt::is_good) {
            break;
        }
    }
    context.stopped()?;
    if let Some(best) = &mut best {
        between_block_variance::reconcile(best, &others);
    }
    of_block(best, &context, warnings, recorder)
}

/// Solves an input by image points alone, each of which may be wrong by itself.
fn solve_by_observation(
    context: &Context,
    mut warnings: Vec<Warning>,
    mut recorder: Recorder,
) -> Result<Solution, Error> {
    // Where views share no focal length, groups part nothing.
    let merges_cameras = context.settings.focal_per_view;
    let whole = block::whole(context.input, context.ranges);
    let mut candidates = Vec::new();
    if whole.is_none() && !merges_cameras {
        candidates = block::candidate_views_of_one_camera(context.input, context.ranges, context.stop);
    }
    // Groups too small to calibrate alone are tried together.
    if whole.is_none() && candidates.is_empty() {
        candidates = block::candidate_views(context.input, context.ranges, context.stop);
    }
    let context = &Context { merges_cameras, ..*context };
    match sequence::solve(whole, &candidates, context, &mut recorder)? {
        sequence::Ended::Extended(extended) => {
            warnings.extend(block::merged_cameras(context.input, !merges_cameras, merges_cameras));
            let solution = sequence::solved(*extended, warnings, recorder);
            context.stopped()?;
            Ok(verified(solution))
        }
        sequence::Ended::Block(best) => {
            warnings.extend(block::merged_cameras(context.input, !merges_cameras, merges_cameras));
            of_block(best.map(|best| *best), context, warnings, recorder)
        }
    }
}

/// The solution, or none where judging leaves fewer tracks than geometry can verify.
fn verified(mut solution: Solution) -> Solution {
    let inliers = solution.inlier_track_count();
    if inliers >= grow::LEAST_INLIERS {
        return solution;
    }
    solution.status = Status::NoReconstruction;
    solution.grade = None;
    solution.calibrations.clear();
    solution.plane_at_infinity = None;
    solution.views.fill(ViewResult::default());
    solution.tracks.weight.fill(0.0);
    solution.tracks.inlier.fill(false);
    solution.tracks.point.fill(None);
    solution.tracks.part.clear();
    solution.observations = ObservationResults::unjudged(solution.observations.inlier.len());
    solution.splits.clear();
    (solution.noise_px, solution.reprojection_rms_px, solution.reprojection_mean_px) = (None, None, None);
    let detail = format!("{inliers} tracks hold under the final geometry; {} can be verified", grow::LEAST_INLIERS);
    solution.warnings.push(Warning::new(WarningCode::FewInliers, detail));
    solution
}

/// The solution that the best block gives.
fn of_block(
    best: Option<Attempt>,
    context: &Context,
    mut warnings: Vec<Warning>,
    recorder: Recorder,
) -> Result<Solution, Error> {
    let solution = match best {
        Some(attempt) if attempt.consensus.is_some() => {
            // Depths verify fewer, and PAPER and PSFM keep what they keep.
            let by_points = attempt.judges_observations();
            let solution = assemble::solved(context, attempt, warnings, recorder);
            if by_points { verified(solution) } else { solution }
        }
        best => {
            warnings.push(why_unsolved(context.input, best.as_ref()));
            assemble::unsolved(context, best.as_ref(), warnings, recorder)
        }
    };
    context.stopped()?;
    Ok(solution)
}

/// What every part of one solve works on.
#[derive(Clone, Copy)]
struct Context<'a> {
    input: &'a Input,
    settings: &'a SolveSettings,
    /// Observations of each track; see [`Input::track_ranges`].
    ranges: &'a [usize],
    normalization: &'a Normalization,
    /// Length of a normalised unit in pixels.
    scale_px: f64,
    /// The block is the seed of a sequence: as much of it is solved as carries a calibration, and no more.
    seeding: bool,
    /// Only what is cheap is searched.
    quick: bool,
    /// Whether all views are taken to be of one camera, whatever their groups.
    merges_cameras: bool,
    /// What is known of the focal length beside what the views bring: what another part of the input said.
    focal_prior: Option<FocalPrior>,
    threads: Threads,
    stop: &'a StopToken,
}

impl Context<'_> {
    /// `Err` once the token asks for a stop.
    fn stopped(&self) -> Result<(), Error> {
        self.stop.reason().map_or(Ok(()), |reason| Err(Error::Stopped(reason)))
    }

    /// Camera group of each of these views, counted among them, and how many there are.
    fn camera_groups_of(&self, views: &[usize]) -> (Vec<usize>, usize) {
        if self.merges_cameras {
            return (vec![0; views.len()], 1);
        }
        let (group_of, _) = block::camera_groups(self.input);
        let mut groups: Vec<usize> = views.iter().map(|&view| group_of[view]).collect();
        groups.sort_unstable();
        groups.dedup();
        (views.iter().map(|&view| groups.partition_point(|group| *group < group_of[view])).collect(), groups.len())
    }

    /// Weights of some tracks as weights of all, 0 elsewhere.
    fn scatter(&self, weights: &[f64], tracks: &[usize]) -> Vec<f32> {
        let mut all = vec![0.0; self.input.track_count()];
        for (&track, &weight) in tracks.iter().zip(weights) {
            all[track] = weight as f32;
        }
        all
    }
}

fn why_unsolved(input: &Input, best: Option<&Attempt>) -> Warning {
    match best {
        None if input.view_count() < block::LEAST_VIEWS => Warning::new(
            WarningCode::NoConsensus,
            format!("{} views given; a reconstruction needs at least {}", input.view_count(), block::LEAST_VIEWS),
        ),
        None => Warning::new(
            WarningCode::FewInliers,
            format!(
                "no {} views share enough tracks: at least {}, of which none is another's copy, must be seen in all of them",
                block::LEAST_VIEWS,
                block::LEAST_TRACKS
            ),
        ),
        Some(Attempt { decided: Some(decided), .. }) => Warning::new(
            WarningCode::FewInliers,
            format!(
                "the method kept {} tracks; {} determine the cameras",
                decided.inlier.iter().filter(|&&inlier| inlier).count(),
                grow::LEAST_SUPPORT
            ),
        ),
        Some(Attempt { doubted: Some((inliers, counted)), .. }) => Warning::new(
            WarningCode::FewInliers,
            format!(
                "{inliers} tracks hold under one geometry, but the trained network takes only {counted} of them to be \
                 right, and so few cameras can adapt to wrong ones; {} are needed. GEOMETRY does not ask the network",
                grow::LEAST_INLIERS
            ),
        ),
        Some(Attempt { crowded: Some((inliers, counted)), .. }) => Warning::new(
            WarningCode::FewInliers,
            format!(
                "{inliers} tracks hold under one geometry, but lie within the noise of each other in every view: they \
                 count as {counted}, and {} are needed",
                grow::LEAST_INLIERS
            ),
        ),
        Some(attempt) => Warning::new(
            WarningCode::NoConsensus,
            format!(
                "among the {} tracks complete over {} views no {} or more agree on one geometry more than by chance",
                attempt.block.tracks.len(),
                attempt.block.views.len(),
                grow::LEAST_INLIERS
            ),
        ),
    }
}
