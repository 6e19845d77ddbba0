//! In which order seeds are tried: what is cheap first.

use super::blocks::Blocks;
use super::ended::{Ended, attempt_worth, metric_of};
use super::options::ExtensionOptions;
use super::starts::{QUICK_SEED, by_projective_extension, extend_projectively, stands};
use super::triplets::Pairs;
use crate::solver::attempt::{self, Attempt};
use crate::solver::block::Block;
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::projective::ProjectiveReconstruction;
use crate::solver::recorder::Recorder;
use crate::solver::view_selection::{SeedViews, ViewSelectionOptions};
use crate::solver::{near_duplicates, view_selection};

/// The blocks of an input, and what their first search, calibration and metric extension came to.
pub struct QuickPass {
    blocks: Blocks,
    pub ended: Ended,
    /// Whether nothing else needs to be tried.
    is_settled: bool,
}

impl QuickPass {
    pub fn new(problem: &Problem, recorder: &mut Recorder) -> Result<Self, Error> {
        let blocks = Blocks::of(problem);
        let (ended, is_settled) = blocks.by_calibration(problem, blocks.begin_quickly(problem), recorder)?;
        Ok(Self { blocks, ended, is_settled })
    }

    /// What else is tried where the quick pass has neither a calibration nor a precise reconstruction of most views. A
    /// calibration of few views stands unless what is found is worth more.
    ///
    /// In order of cost: what it found and small subsets of the blocks, extended projectively and calibrated then; where
    /// that is not METRIC and holds less than half of the views, triplets in the same way. Only where none of these
    /// stands: the blocks again, with everything that a search can try, and the subsets that are left. An input whose
    /// tracks are mostly complete is its only block; with depths it is searched at length at once.
    pub fn finish(self, problem: &Problem, recorder: &mut Recorder) -> Result<Ended, Error> {
        let Self { blocks, ended, is_settled } = self;
        if is_settled {
            return Ok(ended);
        }
        let is_quick = blocks.begin_quickly(problem);
        // A calibration of few views, than which another answer may be worth more. Nothing else is searched of a whole
        // input with depths: what it has found stands.
        let (part, found) = match ended.calibrated_extension(problem).is_some() {
            true => (Some(ended), None),
            false => (None, ended.seed().map(|attempt| (attempt, !is_quick))),
        };
        let subsets: Vec<SeedViews> = view_selection::subsets(&blocks.sets).into_iter().map(SeedViews::Block).collect();
        let is_short = blocks.is_whole || part.is_some();
        let first_subsets = if is_short { ExtensionOptions::DEFAULT.first_subsets } else { subsets.len() };
        let cheap = first_subsets.min(subsets.len());
        let (cheap, rest) = subsets.split_at(cheap);
        let mut best = by_projective_extension(problem, None, found, cheap, recorder)?;
        let leaves_most = |best: &Attempt| !best.is_good() && best.leaves_most_views(problem);
        if !blocks.is_whole && part.is_none() && best.as_ref().is_none_or(leaves_most) {
            let triplets = view_selection::triplets(problem, &vec![true; problem.views()]);
            let triplets: Vec<SeedViews> = triplets.into_iter().map(SeedViews::Triplet).collect();
            best = by_projective_extension(problem, best, None, &triplets, recorder)?;
        }
        if is_quick && part.is_none() && !stands(&best) {
            let (ended, is_settled) = blocks.by_calibration(problem, false, recorder)?;
            if is_settled || ended.calibrated_extension(problem).is_some() {
                return Ok(ended);
            }
            let found = ended.seed().map(|attempt| (attempt, false));
            best = by_projective_extension(problem, None, found, rest, recorder)?;
        }
        let part_worth = part.as_ref().map_or(f64::NEG_INFINITY, |part| part.worth(problem));
        let found = best.filter(|best| attempt_worth(best, problem) > part_worth);
        let found = found.map(|best| metric_of(problem, best, recorder)).transpose()?;
        let found = found.filter(|found| found.worth(problem) > part_worth);
        Ok(found.or(part).unwrap_or(Ended::Block(None)))
    }
}

/// The first projective reconstruction that a quick search leads to, without a calibration: of blocks, and where
/// tracks are incomplete and blocks have fewer than they should, of triplets; `None` where nothing stands.
///
/// * `is_promising`: which blocks, without near-duplicates, are worth a search
/// * `most_triplets`: how many triplets are searched
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
    let mut pairs = Pairs::new(problem);
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
