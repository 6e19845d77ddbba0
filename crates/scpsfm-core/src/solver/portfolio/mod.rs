//! The portfolio: proposals rank tracks, guided search verifies, the best consensus stands.
//!
//! What is cheap goes first: rigid distances where depths are given, the scores of the network that was trained
//! beforehand, reweighting, consistency, and uniform sampling, which needs no ranking to be right. Where they decide
//! nothing, heads of the paper's network are optimised ([`super::scpsfm`]), and what each keeps is verified by
//! geometry, by rigid distances, too. A decisive consensus ends the search: a head takes longer than everything else.
//! Each proposal's own time is kept.

mod best;
mod proposals;
mod stats;

use std::time::Instant;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::consensus::{Consensus, LEAST_INLIERS};
use super::learned::{self, TrackScores};
use super::recorder::Recorder;
use super::scpsfm::{HeadOptions, HeadSearch};
use super::search::rigid::Rigid;
use super::search::{affine, subspace};
use super::spread;
use crate::domain::result::ProposalTime;
use crate::domain::{Proposal, SolveSettings, StopToken};
use crate::geometry::measurement::CompleteBlock;
use crate::network::NetworkSettings;
use best::Best;
pub use best::VerifiedBy;
use stats::ProposalStats;

options! {
    /// How a block is searched, and what decides between consensuses.
    pub struct PortfolioOptions {
        /// Rounds of a search: every noise of the ladder twice.
        rounds: u32 = 16,
        /// Of a quick one: the noise as assumed, which is rather too high.
        quick_rounds: u32 = 1,
        /// Round, counted from 0, from which heads of the network are optimised, and rounds after which there is
        /// another. Once all that is cheaper has decided nothing at any noise of the ladder. Two heads, each verified
        /// at four of the noises: four found no more (5 to 11 % noise, two scenes each).
        first_head_round: u32 = 8,
        rounds_per_head: u32 = 4,
        /// Samples a round, of a proposal and of uniform sampling, without depths and with. A sample costs
        /// microseconds.
        affine_samples: (usize, usize) = (2_000, 6_000),
        subspace_samples: (usize, usize) = (250, 1_000),
        /// Hypotheses a round and proposal that are grown.
        shortlist: usize = 2,
        /// Noise that each round grows at, in units of what is assumed; they repeat. Every other round at more noise
        /// than assumed, doubling up to sixteen times: a level that is twice too low loses the scene, and the caller
        /// may have given none.
        noise_ladder: [f64; 8] = [1.0, 2.0, 1.0, 4.0, 1.0, 8.0, 1.0, 16.0],
        /// Consensuses of near-duplicates after which a search is over. Whatever includes one of so many explains all
        /// of it, and outbids what is right.
        most_near_duplicates: usize = 4,
        /// Gain in the logarithm of the false alarms below which two consensuses are the same. A single track more
        /// changes it by tens.
        ln_margin: f64 = 5.0,
        /// Share of the accepted consensus's inliers and certainty that counts as having found it.
        sufficient_share: f64 = 0.95,
    }
}

const OPTIONS: PortfolioOptions = PortfolioOptions::DEFAULT;

/// What the search found.
#[derive(Default)]
pub struct Found {
    pub consensus: Option<Consensus>,
    /// What the consensus was verified by.
    pub verified_by: VerifiedBy,
    /// The rigid consensus behind it or beside it, where depths were given and one is not chance, and what proposed it.
    pub rigid: Option<(Proposal, Rigid)>,
    pub winning_proposal: Option<Proposal>,
    /// Inliers of a consensus that the trained network keeps from being accepted, and how many of them count.
    pub rejected_by_network: Option<(usize, usize)>,
    /// Inliers of the largest consensus of near-duplicates, and how many of them count.
    pub near_duplicates: Option<(usize, usize)>,
    /// What the trained network says of the block; `None` where it was not asked.
    pub track_scores: Option<TrackScores>,
    /// The weights of the network that was trained beforehand, or where it was not asked those of the best head of the
    /// paper's, one a track of the block; empty without a network.
    pub network_weights: Vec<f64>,
    pub proposal_times: Vec<ProposalTime>,
}

enum Search {
    Affine(affine::AffineSearch),
    Subspace(subspace::SubspaceSearch),
}

/// How much of a search is worth its time.
#[derive(Debug, Clone, Copy, Default)]
pub struct Effort {
    /// The block is the seed of more: as much of it is solved as carries a calibration, and no more. Its own statistics
    /// go first, whatever the trained network says: to hear that first was measured to cost a seed a hundredth of F1.
    pub is_seed: bool,
    /// The search ends after [`PortfolioOptions::quick_rounds`], without the paper's network.
    pub is_quick: bool,
}

/// Searches one block.
pub struct Portfolio<'a> {
    block: &'a CompleteBlock,
    settings: &'a SolveSettings,
    stop: &'a StopToken,
    search: Search,
    /// Noise that the caller or a default assumes, and that of the current round.
    assumed_noise: f64,
    noise: f64,
    /// Standard deviation of the image points, the yardstick of the false alarms.
    spread: f64,
    rng: ChaCha8Rng,
    stats: Vec<ProposalStats>,
    best: Option<Best>,
    near_duplicates: Option<(usize, usize)>,
    /// Consensuses of near-duplicates.
    near_duplicate_count: usize,
    rigid: Option<(Proposal, Rigid)>,
    track_scores: Option<TrackScores>,
    effort: Effort,
}

impl<'a> Portfolio<'a> {
    /// * `noise`: noise that growing starts from, normalised units; rather too high than too low
    /// * `track_scores`: what the trained network says of the block, where it was asked already
    pub fn new(
        block: &'a CompleteBlock,
        settings: &'a SolveSettings,
        noise: f64,
        effort: Effort,
        track_scores: Option<TrackScores>,
        stop: &'a StopToken,
    ) -> Self {
        let search = if block.has_depths() {
            Search::Subspace(subspace::SubspaceSearch::new(block, noise, settings.use_daq))
        } else {
            Search::Affine(affine::AffineSearch::new(block))
        };
        Self {
            block,
            settings,
            stop,
            search,
            assumed_noise: noise,
            noise,
            spread: spread::spread(block),
            rng: ChaCha8Rng::seed_from_u64(settings.seed),
            stats: Proposal::ALL.into_iter().map(ProposalStats::new).collect(),
            best: None,
            near_duplicates: None,
            near_duplicate_count: 0,
            rigid: None,
            track_scores,
            effort,
        }
    }

    /// Runs the search; `spread_weights` maps the block's weights to the caller's tracks.
    ///
    /// The focal length of a head is not reported: nothing of a search has verified it.
    ///
    /// # Errors
    /// The network's own, which are defects.
    pub fn run(
        mut self,
        recorder: &mut Recorder,
        spread_weights: &dyn Fn(&[f64]) -> Vec<f32>,
    ) -> Result<Found, crate::network::Error> {
        let rounds = if self.effort.is_quick { OPTIONS.quick_rounds } else { OPTIONS.rounds };
        let mut heads = None;
        let mut head_round = 0;
        self.ask(recorder, spread_weights);
        for round in 0..rounds {
            self.set_noise(round);
            self.propose_rigid(round);
            self.propose_at_once(round);
            self.propose(Proposal::Uniform, &vec![1.0; self.block.tracks()], None);
            self.stand(recorder);
            if round >= OPTIONS.first_head_round && self.may_optimise() {
                let heads = heads.get_or_insert_with(|| self.head_search());
                if (round - OPTIONS.first_head_round).is_multiple_of(OPTIONS.rounds_per_head) {
                    let within = |share: f64| (f64::from(round) + share) / f64::from(rounds);
                    if self.optimise_head(heads, recorder, spread_weights, &within)? {
                        head_round = round;
                    }
                }
                self.propose_head(&heads.latest_weights(), head_round, round);
                self.stand(recorder);
            }
            recorder.report(f64::from(round + 1) / f64::from(rounds));
            if self.is_over() || self.stop.is_stopped() {
                break;
            }
        }
        Ok(self.finish(heads))
    }

    /// Whether heads of the network may be optimised.
    fn may_optimise(&self) -> bool {
        self.settings.method.uses_network() && !self.effort.is_quick && self.is_wanted(Proposal::Network)
    }

    fn head_search(&self) -> HeadSearch {
        HeadSearch::continued(self.block, NetworkSettings::from(self.settings), HeadOptions::DEFAULT)
    }

    /// Asks the network that was trained beforehand.
    fn ask(&mut self, recorder: &mut Recorder, spread_weights: &dyn Fn(&[f64]) -> Vec<f32>) {
        if !learned::may_be_asked(self.settings) {
            return;
        }
        let begun = Instant::now();
        self.track_scores = self.track_scores.take().or_else(|| TrackScores::of(self.block));
        self.stats(Proposal::Learned).seconds += begun.elapsed().as_secs_f64();
        if let Some(track_scores) = self.track_scores.as_ref().filter(|_| self.settings.weights_every > 0) {
            recorder.weights(&spread_weights(&track_scores.probabilities()));
        }
    }

    /// The noise that a round searches and grows at.
    fn set_noise(&mut self, round: u32) {
        self.noise = self.assumed_noise * OPTIONS.noise_ladder[round as usize % OPTIONS.noise_ladder.len()];
        if let Search::Subspace(search) = &mut self.search {
            search.set_noise(self.noise);
        }
    }

    /// One more head, where there is to be one; whether there was.
    ///
    /// * `within`: share of the search that is done where this share of the head is
    fn optimise_head(
        &mut self,
        heads: &mut HeadSearch,
        recorder: &mut Recorder,
        spread_weights: &dyn Fn(&[f64]) -> Vec<f32>,
        within: &dyn Fn(f64) -> f64,
    ) -> Result<bool, crate::network::Error> {
        if heads.is_over() {
            return Ok(false);
        }
        let begun = Instant::now();
        let SolveSettings { weights_every: every, iterations, .. } = *self.settings;
        let mut work = 0;
        heads.optimise_next(self.stop, &mut |step| {
            work += 1;
            recorder.optimised(step.head, step.losses);
            recorder.report(within(f64::from(work) / f64::from(iterations)));
            if every > 0 && step.head.iteration.is_multiple_of(every) {
                recorder.weights(&spread_weights(step.weights));
            }
        })?;
        let stats = self.stats(Proposal::Network);
        stats.seconds += begun.elapsed().as_secs_f64();
        stats.work += work;
        Ok(true)
    }

    /// Inliers that count as verified by geometry.
    fn counted(&self, consensus: &Consensus) -> usize {
        let count = consensus.inlier_count();
        self.track_scores.as_ref().map_or(count, |track_scores| track_scores.counted(&consensus.inliers()))
    }

    /// Notes inliers that lie within the noise of each other, where the noise is no more than assumed: more makes any
    /// tracks one.
    fn note_near_duplicates(&mut self, consensus: &Consensus) {
        let (inliers, distinct) = (consensus.inlier_count(), consensus.distinct_count(self.spread));
        let is_near_duplicate =
            inliers >= LEAST_INLIERS && distinct < LEAST_INLIERS && self.noise <= self.assumed_noise;
        self.near_duplicate_count += usize::from(is_near_duplicate);
        if is_near_duplicate && self.near_duplicates.is_none_or(|(most, _)| inliers > most) {
            self.near_duplicates = Some((inliers, distinct));
        }
    }

    /// Keeps the better one.
    fn offer(&mut self, grown: Best) {
        if self.best.as_ref().is_none_or(|best| grown.displaces(best)) {
            self.best = Some(grown);
        }
    }

    fn is_decisive(&self) -> bool {
        self.best.as_ref().is_some_and(Best::decides)
    }

    /// Whether nothing more is to be expected: something decisive stands, or near-duplicates alone are found by image
    /// points and there are no depths to go by.
    fn is_over(&self) -> bool {
        let nothing_else = !self.best.as_ref().is_some_and(Best::is_acceptable) && !self.block.has_depths();
        self.is_decisive() || (nothing_else && self.near_duplicate_count >= OPTIONS.most_near_duplicates)
    }

    /// Writes the best consensus into the progress.
    fn stand(&self, recorder: &mut Recorder) {
        if let Some(best) = &self.best {
            recorder.progress.inliers = best.consensus.inlier_count() as u32;
            recorder.progress.best_cost = Some(best.consensus.score);
        }
    }

    fn stats(&mut self, proposal: Proposal) -> &mut ProposalStats {
        let place = Proposal::ALL.iter().position(|&other| other == proposal).unwrap_or(0);
        &mut self.stats[place]
    }

    fn finish(self, heads: Option<HeadSearch>) -> Found {
        let with_network = self.settings.method.uses_network();
        let with_depths = self.block.has_depths();
        let Self { best, near_duplicates, stats, rigid, track_scores, .. } = self;
        let rejected_by_network =
            best.as_ref().filter(|best| !best.is_acceptable()).and_then(Best::rejected_by_network);
        let accepted = best.filter(Best::is_acceptable);
        let proposal_times = stats
            .into_iter()
            .filter(|stats| with_network || !matches!(stats.proposal, Proposal::Network | Proposal::Learned))
            .filter(|stats| with_depths || stats.proposal != Proposal::Rigidity)
            .map(|stats| stats.time(accepted.as_ref()))
            .collect();
        let verified_by = accepted.as_ref().map_or(VerifiedBy::ImagePoints, |best| best.verified_by);
        let (consensus, winning_proposal) = accepted.map(|best| (best.consensus, best.proposal)).unzip();
        Found {
            consensus,
            verified_by,
            rigid,
            winning_proposal,
            rejected_by_network,
            near_duplicates,
            network_weights: match (&track_scores, heads) {
                (Some(track_scores), _) => track_scores.probabilities(),
                (None, Some(heads)) => heads.weights(),
                (None, None) => Vec::new(),
            },
            track_scores,
            proposal_times,
        }
    }
}
