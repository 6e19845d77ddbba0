//! From blocks of complete tracks to a reconstruction of all views.
//!
//! Tracks of real sequences live a few views, and a right track may hold wrong observations: no block of complete
//! tracks holds them all. A block that was searched is the seed. Where it is calibrated, view after view is resected
//! against the points that stand ([`register`], [`growth`]), its tracks are triangulated ([`structure`]), and bundle
//! adjustment with the calibration free keeps the whole straight ([`adjust`]); where it is not, the same is done
//! without a calibration ([`projective_growth`]), and the whole is calibrated then. Where no block leads to most views,
//! three that share tracks in pairs are the seed ([`triplets`]). Views that share too few tracks with it become
//! [`components`] of their own under the same calibration, and are merged where all that they share tells how
//! ([`merging`]). What the whole says of the calibration is graded anew ([`calibrate`]) and checked between its
//! [`windows`]. This file decides which seeds are tried and what is made of them; [`extended`] is the metric extension
//! of one.

mod adjust;
mod calibrate;
mod calibrated_views;
mod components;
mod extended;
mod growth;
mod lens;
mod merging;
mod model;
mod options;
mod own_focals;
mod projective_growth;
mod register;
mod structure;
mod triplets;
mod windows;

use std::ops::ControlFlow;

pub use extended::Extended;
pub use merging::MergingOptions;
pub use options::{ExtensionOptions, GrowthOptions};
pub use structure::widest_angle;

use super::attempt::{self, Attempt, Effort};
use super::block::Block;
use super::consensus::{self, LEAST_INLIERS};
use super::error::Error;
use super::learned::TrackScoreOptions;
use super::problem::Problem;
use super::projective::ProjectiveReconstruction;
use super::reconstruction::Reconstruction;
use super::recorder::Recorder;
use super::view_selection::{SeedViews, ViewSelectionOptions};
use super::{near_duplicates, view_selection};
use crate::domain::Stage;
use extended::extend;

/// How subsets are searched, of which many are tried.
const QUICK_SEED: Effort = Effort { is_seed: true, is_quick: true };

/// What came of an input.
pub enum Ended {
    Extended(Box<Extended>),
    /// A block, projective or not, that has no metric extension: the best one that was tried.
    Block(Option<Box<Attempt>>),
}

/// Solves an input. Where pinholes give no calibration of most views, solves it once more with the lenses undone that
/// explain seeds better, before anything else is tried of pinholes, and where that calibrates a part, with the lenses
/// undone that were calibrated; what is undone stays so in the problem where that answer stands.
///
/// # Errors
/// [`Error::Stopped`]; [`Error::Internal`] for defects.
pub fn solve(problem: &mut Problem, recorder: &mut Recorder) -> Result<Ended, Error> {
    let quick = QuickPass::new(problem, recorder)?;
    let mut behind = None;
    // An extension to most views shows how much pinholes explain, which what else there is to try hardly changes.
    let lenses_first = quick.result().asks_for_lens(problem) && quick.result().holds_most_views();
    if lenses_first {
        behind = lens::solve_behind(problem, quick.result(), recorder)?;
        let replaces = |ended: &Ended| ended.holds_most_views() && ended.replaces(quick.result(), problem);
        if let Some(found) = behind.take_if(|found| replaces(&found.ended)) {
            return Ok(found.accept(problem));
        }
        recorder.begin_again();
    }
    let ended = quick.finish(problem, recorder)?;
    if !ended.asks_for_lens(problem) {
        return Ok(ended);
    }
    if !lenses_first {
        behind = lens::solve_behind(problem, &ended, recorder)?;
    }
    match behind.filter(|found| found.ended.replaces(&ended, problem)) {
        Some(found) => Ok(found.accept(problem)),
        None => Ok(ended),
    }
}

/// The blocks of an input, and what their first search, calibration and metric extension came to.
struct QuickPass {
    blocks: Blocks,
    /// Breaks where nothing else needs to be tried.
    result: ControlFlow<Ended, Ended>,
}

impl QuickPass {
    fn new(problem: &Problem, recorder: &mut Recorder) -> Result<Self, Error> {
        let blocks = Blocks::of(problem);
        let result = blocks.by_calibration(problem, blocks.begin_quickly(problem), recorder)?;
        Ok(Self { blocks, result })
    }

    fn result(&self) -> &Ended {
        match &self.result {
            ControlFlow::Break(ended) | ControlFlow::Continue(ended) => ended,
        }
    }

    /// Solves and extends block after block until one carries a reconstruction of most of the views.
    ///
    /// In order of cost: the blocks, searched quickly, calibrated and extended metrically; what they found and small
    /// subsets of them, extended projectively and calibrated then; where that is not METRIC and holds less than half of
    /// the views, triplets in the same way. Only where none of these stands: the blocks again, with everything that a
    /// search can try, and the subsets that are left. An input whose tracks are mostly complete is its only block; with
    /// depths it is searched at length at once.
    ///
    /// # Errors
    /// [`Error::Stopped`]; [`Error::Internal`] for defects.
    fn finish(self, problem: &Problem, recorder: &mut Recorder) -> Result<Ended, Error> {
        let Self { blocks, result } = self;
        let is_quick = blocks.begin_quickly(problem);
        // A calibrated reconstruction that another might be better than.
        let mut metric: Option<Box<Extended>> = None;
        let first = match result {
            ControlFlow::Break(ended) => return Ok(ended),
            ControlFlow::Continue(Ended::Extended(extended)) if extended.is_calibrated(problem) => {
                metric = Some(extended);
                None
            }
            ControlFlow::Continue(ended) => ended.seed(),
        };
        let subsets = view_selection::subsets(&blocks.sets);
        let is_short = blocks.is_whole || metric.is_some();
        let cheap = if is_short { ExtensionOptions::DEFAULT.first_subsets.min(subsets.len()) } else { subsets.len() };
        let (cheap, rest) = subsets.split_at(cheap);
        // Nothing else is searched of a whole input with depths: what it has found stands.
        let mut best = by_projective_extension(problem, None, starts(first, !is_quick, cheap), recorder)?;
        let leaves_most = |best: &Attempt| !best.is_good() && best.leaves_most_views(problem);
        if !blocks.is_whole && metric.is_none() && best.as_ref().is_none_or(leaves_most) {
            let triplets = view_selection::triplets(problem, &vec![true; problem.views()]);
            let starts = triplets.into_iter().map(|views| Start::Views(SeedViews::Triplet(views))).collect();
            best = by_projective_extension(problem, best, starts, recorder)?;
        }
        if is_quick && metric.is_none() && !stands(&best) {
            let first = match blocks.by_calibration(problem, false, recorder)? {
                ControlFlow::Break(ended) => return Ok(ended),
                ControlFlow::Continue(Ended::Extended(extended)) if extended.is_calibrated(problem) => {
                    return Ok(Ended::Extended(extended));
                }
                ControlFlow::Continue(ended) => ended.seed(),
            };
            best = by_projective_extension(problem, None, starts(first, false, rest), recorder)?;
        }
        let metric = metric.map(Ended::Extended);
        let may_replace = |best: &Attempt, metric: &Ended| {
            best.is_trusted() || worth(best.evidence(problem), false) > metric.worth(problem)
        };
        let best = best.filter(|best| metric.as_ref().is_none_or(|metric| may_replace(best, metric)));
        Ok(match (best.map(|best| metric_of(problem, best, recorder)).transpose()?, metric) {
            (Some(found), Some(metric)) if !found.outranks(&metric, problem) => metric,
            (None, Some(metric)) => metric,
            (found, _) => found.unwrap_or(Ended::Block(None)),
        })
    }
}

/// The first projective reconstruction that a quick search leads to, without a calibration: of blocks, and where
/// tracks are incomplete and blocks have fewer than they should, of triplets; `None` where nothing stands.
///
/// * `is_promising`: which blocks, without near-duplicates, are worth a search
/// * `most_triplets`: how many triplets are searched
///
/// # Errors
/// As [`solve`].
pub fn reconstruct_quickly(
    problem: &Problem,
    is_promising: impl Fn(&Block) -> bool,
    most_triplets: usize,
    recorder: &mut Recorder,
) -> Result<Option<ProjectiveReconstruction>, Error> {
    let Blocks { sets, is_whole } = Blocks::of(problem);
    let blocks: Vec<Block> =
        sets.iter().map(|views| near_duplicates::without(&problem.representative, problem.block(views))).collect();
    let are_sparse = blocks.iter().all(|block| block.tracks.len() < ViewSelectionOptions::DEFAULT.wanted_tracks);
    for block in blocks.into_iter().filter(is_promising) {
        problem.stopped()?;
        let mut attempt = attempt::search_block(problem, block, QUICK_SEED, recorder)?;
        extend_projectively(problem, &mut attempt, false, recorder)?;
        if attempt.projective.is_some() {
            return Ok(attempt.projective);
        }
    }
    if is_whole || !are_sparse {
        return Ok(None);
    }
    let mut pairs = triplets::Pairs::new(problem);
    let triplets = view_selection::triplets(problem, &vec![true; problem.views()]);
    for views in triplets.into_iter().take(most_triplets) {
        problem.stopped()?;
        let mut attempt = pairs.attempt(&views, recorder)?;
        extend_projectively(problem, &mut attempt, false, recorder)?;
        if attempt.projective.is_some() {
            return Ok(attempt.projective);
        }
    }
    Ok(None)
}

impl Ended {
    /// Whether there is a reconstruction without a calibration of most views, which a lens may be missing from.
    fn asks_for_lens(&self, problem: &Problem) -> bool {
        if problem.input.has_depths() {
            return false;
        }
        match self {
            Ended::Extended(extended) => !extended.is_calibrated(problem) || !extended.holds_most_views(),
            Ended::Block(attempt) => attempt.as_ref().is_some_and(|attempt| {
                attempt.projective.is_some()
                    && attempt.judges_observations()
                    && (!attempt.is_calibrated() || attempt.leaves_most_views(problem))
            }),
        }
    }

    /// Whether it is an extension that holds most views, see [`Extended::holds_most_views`].
    fn holds_most_views(&self) -> bool {
        matches!(self, Ended::Extended(extended) if extended.holds_most_views())
    }

    /// The extension that carries the calibration; `None` where there is none. The calibration of a block takes an
    /// undone lens as exact; only an extension adjusts it in the images.
    fn calibrated_extension(&self, problem: &Problem) -> Option<&Extended> {
        match self {
            Ended::Extended(extended) => Some(&**extended).filter(|extended| extended.is_calibrated(problem)),
            Ended::Block(_) => None,
        }
    }

    /// Whether this answer behind lenses replaces one without.
    fn replaces(&self, of_pinholes: &Self, problem: &Problem) -> bool {
        self.calibrated_extension(problem).is_some()
            && lens::explains_enough(self.evidence(problem), of_pinholes.evidence(problem))
    }

    /// How well the observations fit, see [`evidence`](super::noise_model::evidence).
    pub fn evidence(&self, problem: &Problem) -> f64 {
        match self {
            Ended::Extended(extended) => extended.evidence(problem),
            Ended::Block(attempt) => attempt.as_ref().map_or(0.0, |attempt| attempt.evidence(problem)),
        }
    }

    /// Whether it is better than another one that was found in a different way: of two with a calibration, one that fits
    /// as well as projective cameras, then one with more evidence; else one that is worth more.
    fn outranks(&self, other: &Self, problem: &Problem) -> bool {
        let [own, others] = [self, other].map(|ended| ended.calibrated_extension(problem));
        match own.zip(others) {
            Some((own, other)) => (own.fits(), self.evidence(problem)) > (other.fits(), other.evidence(problem)),
            None => self.worth(problem) > other.worth(problem),
        }
    }

    /// As [`worth`].
    fn worth(&self, problem: &Problem) -> f64 {
        worth(self.evidence(problem), self.calibrated_extension(problem).is_some())
    }

    /// What it began from.
    fn seed(self) -> Option<Attempt> {
        match self {
            Ended::Extended(extended) => Some(extended.seed),
            Ended::Block(attempt) => attempt.map(|attempt| *attempt),
        }
    }
}

/// Sets of views that a reconstruction may begin with, best first.
struct Blocks {
    sets: Vec<Vec<usize>>,
    /// Whether it is the one of [`view_selection::whole`].
    is_whole: bool,
}

impl Blocks {
    fn of(problem: &Problem) -> Self {
        match view_selection::whole(problem) {
            Some(whole) => Self { sets: vec![whole], is_whole: true },
            None => Self { sets: view_selection::blocks(problem), is_whole: false },
        }
    }

    /// Whether the first search does not try everything. In the one block of a whole input depths decide in the first
    /// round or take all of them. Other blocks are several, of which another may do.
    fn begin_quickly(&self, problem: &Problem) -> bool {
        !(self.is_whole && problem.input.has_depths())
    }

    /// Calibrates the blocks and extends them from there; breaks where nothing else needs to be tried.
    fn by_calibration(
        &self,
        problem: &Problem,
        is_quick: bool,
        recorder: &mut Recorder,
    ) -> Result<ControlFlow<Ended, Ended>, Error> {
        let ended = if self.is_whole {
            let attempt = of_whole(problem, &self.sets[0], is_quick, recorder)?;
            // A second search, which tries everything, has the last word. With depths there is one only, and subsets
            // follow.
            let is_last = !is_quick && !problem.input.has_depths() && attempt.projective.is_some();
            if is_last || attempt.is_trusted() || attempt.is_beyond_image_points() {
                return Ok(ControlFlow::Break(finished(problem, attempt, recorder)?));
            }
            match attempt.is_calibrated() {
                true => metric_of(problem, attempt, recorder)?,
                false => Ended::Block(Some(Box::new(attempt))),
            }
        } else {
            by_calibrated_blocks(problem, &self.sets, Effort { is_seed: true, is_quick }, recorder)?
        };
        let is_settled = matches!(&ended, Ended::Extended(extended) if extended.is_settled(problem));
        Ok(if is_settled { ControlFlow::Break(ended) } else { ControlFlow::Continue(ended) })
    }
}

/// Whether there is a reconstruction.
fn stands(attempt: &Option<Attempt>) -> bool {
    attempt.as_ref().is_some_and(|attempt| attempt.projective.is_some())
}

/// The whole input as one block, with the views that its search left aside, and the tracks that depths did not verify.
fn of_whole(problem: &Problem, views: &[usize], is_quick: bool, recorder: &mut Recorder) -> Result<Attempt, Error> {
    let effort = Effort { is_quick, is_seed: false };
    let mut attempt = attempt::search_block(problem, problem.block(views), effort, recorder)?;
    if views.len() < problem.observed_views().len() || !attempt.judges_observations() {
        extend_projectively(problem, &mut attempt, true, recorder)?;
    }
    attempt::calibrate(problem, &mut attempt, &[], recorder)?;
    Ok(attempt)
}

/// Blocks that are calibrated and extended from there.
fn by_calibrated_blocks(
    problem: &Problem,
    candidates: &[Vec<usize>],
    effort: Effort,
    recorder: &mut Recorder,
) -> Result<Ended, Error> {
    let mut best: Option<Extended> = None;
    let mut unextended: Option<Attempt> = None;
    recorder.expect_extension();
    for (k, views) in candidates.iter().enumerate() {
        problem.stopped()?;
        // A block of several cameras determines each of them less well than one of its own.
        let is_of_one = |views: &[usize]| problem.cameras_of(views).1.len() == 1;
        let begun = best.as_ref().filter(|best| best.is_calibrated(problem));
        if !is_of_one(views) && begun.is_some_and(|best| is_of_one(&best.seed.block.views)) {
            continue;
        }
        recorder.begin_block(k, candidates.len());
        let attempt = attempt::solve_block(problem, problem.block(views), effort, &[], recorder)?;
        if attempt.is_good() {
            let extended = extend(problem, attempt, recorder)?;
            if !extended.stands() {
                unextended = better(unextended, extended.seed);
                continue;
            }
            let enough = extended.is_calibrated(problem) && extended.holds_most_views();
            if best.as_ref().is_none_or(|best| extended.merit(problem) > best.merit(problem)) {
                best = Some(extended);
            }
            if enough {
                break;
            }
        } else {
            unextended = better(unextended, attempt);
        }
    }
    if let Some(best) = best {
        return Ok(Ended::Extended(Box::new(best)));
    }
    match unextended {
        Some(seed) => metric_of(problem, seed, recorder),
        None => Ok(Ended::Block(None)),
    }
}

/// What a projective extension begins from.
enum Start {
    /// What was found already.
    Found {
        attempt: Box<Attempt>,
        /// Whether it stands as it is where its extension leaves too little.
        keeps: bool,
    },
    Views(SeedViews),
}

/// What was found already, then the blocks of these sets of views.
fn starts(found: Option<Attempt>, keeps: bool, sets: &[Vec<usize>]) -> Vec<Start> {
    let found = found.map(|attempt| Start::Found { attempt: Box::new(attempt), keeps });
    found.into_iter().chain(sets.iter().map(|views| Start::Views(SeedViews::Block(views.clone())))).collect()
}

/// The best of one that stands and of these, each extended to all views without a calibration and, where it is not
/// known yet, calibrated then; the first that is METRIC.
fn by_projective_extension(
    problem: &Problem,
    best: Option<Attempt>,
    starts: Vec<Start>,
    recorder: &mut Recorder,
) -> Result<Option<Attempt>, Error> {
    let (mut best, mut unsolved) = if stands(&best) { (best, None) } else { (None, best) };
    let mut pairs = triplets::Pairs::new(problem);
    let count = starts.len();
    for (k, start) in starts.into_iter().enumerate() {
        problem.stopped()?;
        let (mut attempt, keeps) = match start {
            Start::Found { attempt, keeps } => (*attempt, keeps),
            Start::Views(views) => {
                recorder.begin_block(k, count);
                let attempt = match views {
                    SeedViews::Block(views) => {
                        attempt::search_block(problem, problem.block(&views), QUICK_SEED, recorder)?
                    }
                    SeedViews::Triplet(views) => pairs.attempt(&views, recorder)?,
                };
                (attempt, false)
            }
        };
        extend_projectively(problem, &mut attempt, keeps, recorder)?;
        if attempt.projective.is_none() {
            unsolved = unsolved.or(Some(attempt));
            continue;
        }
        // The same one, reached from elsewhere, or a part of it: calibrating takes longer than all else.
        let is_known = |best: &Attempt| {
            let is_part = attempt.views().iter().all(|view| best.views().binary_search(view).is_ok());
            let grown = attempt.evidence(problem) / best.evidence(problem);
            is_part && grown < ExtensionOptions::DEFAULT.least_evidence_growth
        };
        if best.as_ref().is_some_and(|best| is_known(best) || outweighs(best, &attempt)) {
            continue;
        }
        attempt::calibrate(problem, &mut attempt, &[], recorder)?;
        let worth = |attempt: &Attempt| worth(attempt.evidence(problem), attempt.is_calibrated());
        if best.as_ref().is_none_or(|best| outweighs(&attempt, best) || worth(&attempt) > worth(best)) {
            best = Some(attempt);
        }
        if best.as_ref().is_some_and(Attempt::is_good) {
            break;
        }
    }
    Ok(best.or(unsolved))
}

/// What a reconstruction is worth: its evidence, not below 0, and with a calibration
/// [`ExtensionOptions::worth_of_calibration`] times that.
fn worth(evidence: f64, is_calibrated: bool) -> f64 {
    let factor = if is_calibrated { ExtensionOptions::DEFAULT.worth_of_calibration } else { 1.0 };
    factor * evidence.max(0.0)
}

/// Whether an attempt is verified by depths, and worth more than another that is not, see [`Attempt::outweighs`].
fn outweighs(attempt: &Attempt, other: &Attempt) -> bool {
    let of_other = other.projective.as_ref().filter(|_| !other.is_by_depths());
    of_other.is_some_and(|other| attempt.outweighs(&other.views, other.noise))
}

/// Extends an attempt metrically where it has a metric reconstruction and that stands.
///
/// An attempt without a calibration has the focal length that happens to fit best, which other views may refute: its
/// extension stands only where it explains more than the projective reconstruction that it began from. One that depths
/// outweigh does not stand, whatever it says of the calibration.
fn metric_of(problem: &Problem, attempt: Attempt, recorder: &mut Recorder) -> Result<Ended, Error> {
    if !attempt.has_metric() || attempt.is_beyond_image_points() {
        return Ok(Ended::Block(Some(Box::new(attempt))));
    }
    let was_calibrated = attempt.is_calibrated();
    let mut extended = extend(problem, attempt, recorder)?;
    if extended.seed.outweighs(&extended.model.registered(), extended.model.noise) {
        return Ok(Ended::Block(Some(Box::new(extended.seed))));
    }
    let explains_more = || extended.evidence(problem) > extended.seed.evidence(problem);
    // One that takes a calibration back stands in any case: the seed would go on giving it.
    if extended.stands() && (was_calibrated || extended.is_calibrated(problem) || explains_more()) {
        extended.seed.verified_by_image_points();
        Ok(Ended::Extended(Box::new(extended)))
    } else {
        Ok(Ended::Block(Some(Box::new(extended.seed))))
    }
}

/// An attempt on the whole input, extended where it leaves views aside, where several cameras or a lens that distorts
/// take part, where observations are not equally noisy, and where some are to be gained once each is judged by itself.
fn finished(problem: &Problem, mut attempt: Attempt, recorder: &mut Recorder) -> Result<Ended, Error> {
    let is_whole = attempt.views().len() == problem.observed_views().len();
    let is_one_pinhole = !attempt.has_lens() && problem.cameras_of(attempt.views()).1.len() == 1;
    let is_done = is_whole && is_one_pinhole && !problem.input.has_sigmas();
    if !attempt.judges_observations() {
        return Ok(Ended::Block(Some(Box::new(attempt))));
    }
    if let Some(found) = Reconstruction::of_attempt(problem, &attempt).filter(|_| is_done) {
        recorder.enter(Stage::Classify);
        let judged = found.judged(problem, &attempt, recorder);
        let retained: usize = attempt.block.tracks.iter().map(|&track| judged.retained[track].len()).sum();
        let known = attempt.projective.as_ref().map_or(0, |found| found.observations.len());
        if retained as f64 <= ExtensionOptions::DEFAULT.worth_extending * known as f64 {
            attempt.judged = Some(judged);
            return Ok(Ended::Block(Some(Box::new(attempt))));
        }
    }
    if !attempt.has_metric() {
        extend_projectively(problem, &mut attempt, true, recorder)?;
        attempt::calibrate(problem, &mut attempt, &[], recorder)?;
    }
    metric_of(problem, attempt, recorder)
}

/// Extends what an attempt has found to all views and tracks, as far as image points verify it by themselves.
///
/// * `keeps`: whether what was found stands where that leaves too little, else nothing does; what depths verify stands
///   in any case, and where it outweighs the extension, see [`Attempt::outweighs`]
fn extend_projectively(
    problem: &Problem,
    attempt: &mut Attempt,
    keeps: bool,
    recorder: &mut Recorder,
) -> Result<(), Error> {
    if attempt.is_beyond_image_points() {
        return Ok(());
    }
    let Some(start) = attempt.projective.take() else { return Ok(()) };
    recorder.enter(Stage::Extend);
    let by_depths = !attempt.judges_observations();
    // Of few tracks that depths have verified one more may agree by chance.
    let least = if by_depths { TrackScoreOptions::DEFAULT.surely_enough } else { LEAST_INLIERS };
    let before = (keeps || by_depths).then(|| start.clone());
    let mut options = GrowthOptions::PROJECTIVE;
    if keeps && start.views.len() < problem.observed_views().len() {
        // The complete tracks of a whole input have their points: views that join give none and move none.
        options = GrowthOptions { gives_points: false, adjust_growth: f64::INFINITY, final_rounds: 1, ..options };
    }
    let extended = projective_growth::extend(problem, start, &options, recorder)?;
    let is_enough = extended.views.len() >= consensus::LEAST_VIEWS && extended.tracks.len() >= least;
    attempt.projective = before;
    if is_enough && !attempt.outweighs(&extended.views, extended.noise) {
        attempt.projective = Some(extended);
        attempt.verified_by_image_points();
    } else if attempt.projective.is_none() {
        // The reason is that of an attempt without a consensus.
        attempt.found.consensus = None;
    }
    Ok(())
}

/// The one of the two that has more merit, the first of equals.
fn better(best: Option<Attempt>, attempt: Attempt) -> Option<Attempt> {
    match best {
        Some(best) if best.merit() >= attempt.merit() => Some(best),
        _ => Some(attempt),
    }
}
