//! One prior alone: how well it ranks, and what a search of a given length finds under it.

use std::time::Instant;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::domain::{Input, Proposal, StopToken};
use crate::geometry::measurement::CompleteBlock;
use crate::solver::a_contrario::{self, FalseAlarmOptions};
use crate::solver::consensus::Consensus;
use crate::solver::grow;
use crate::solver::learned::TrackScores;
use crate::solver::search::{Sampler, Shortlist, affine};
use crate::solver::spread::spread;
use crate::solver::{block, priors};

/// Hypotheses of a search that are grown: enough that the ranking of hypotheses is not what is measured.
const SHORTLIST: usize = 6;
/// Noise that growing starts from, normalised units: a solve's own without a hint.
const NOISE: f64 = 0.005;

/// A scene made ready for every prior.
pub struct Study {
    block: CompleteBlock,
    search: affine::AffineSearch,
    stop: StopToken,
}

/// What a prior says of every track, larger where it is more likely right.
pub struct Ranking {
    pub weights: Vec<f64>,
    pub seconds: f64,
    track_scores: Option<TrackScores>,
}

/// What a search under a prior found.
pub struct Found {
    /// One entry a track.
    pub inlier: Vec<bool>,
    /// Of ranking, searching and growing.
    pub seconds: f64,
}

impl Study {
    /// The input's tracks that are complete over all its views, their depths left aside.
    pub fn new(input: &Input, stop: &StopToken) -> Self {
        let block = block::of_all_views(input).complete;
        Self { search: affine::AffineSearch::new(&block), block, stop: stop.clone() }
    }

    /// Asks a prior; `None` for one that does not rank image points by themselves.
    pub fn rank(&self, prior: Proposal) -> Option<Ranking> {
        let begun = Instant::now();
        let mut track_scores = None;
        let weights = match prior {
            Proposal::Uniform => vec![1.0; self.block.tracks()],
            Proposal::Irls => priors::affine_irls(self.search.centred(), 0, &self.stop)?,
            Proposal::Consistency => priors::consistency(self.search.centred(), 2),
            Proposal::Learned => track_scores.insert(TrackScores::of(&self.block)?).probabilities(),
            Proposal::Network | Proposal::Rigidity => return None,
        };
        Some(Ranking { weights, seconds: begun.elapsed().as_secs_f64(), track_scores })
    }

    /// What the best hypothesis of so many samples under the trained network says of every track, larger where it is
    /// more likely right, when a nat of the network's odds counts `per_nat` in the score of hypotheses; `None` where
    /// the network has no answer.
    pub fn best_under(&self, per_nat: f64, samples: usize, seed: u64) -> Option<Vec<f64>> {
        let track_scores = TrackScores::of(&self.block)?;
        let truncations = track_scores.truncations_at(per_nat);
        let mut shortlist = Shortlist::new(1);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let sampler = Sampler::new(&track_scores.probabilities());
        self.search.run(&sampler, &truncations, samples, &mut rng, &mut shortlist, &self.stop);
        let best = shortlist.into_entries().next()?;
        Some(self.search.costs(&best, &truncations).into_iter().map(|cost| -cost).collect())
    }

    /// Searches under a prior with so many samples, and grows the best hypotheses.
    pub fn search(&self, ranking: &Ranking, samples: usize, seed: u64) -> Found {
        let begun = Instant::now();
        let mut best: Option<(f64, Consensus)> = None;
        let (truncations, mut seeds) = match &ranking.track_scores {
            Some(track_scores) => {
                (track_scores.truncations(), affine::seed(&self.block, track_scores.start()).into_iter().collect())
            }
            None => (vec![1.0; self.block.tracks()], Vec::new()),
        };
        let mut shortlist = Shortlist::new(SHORTLIST);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let sampler = Sampler::new(&ranking.weights);
        self.search.run(&sampler, &truncations, samples, &mut rng, &mut shortlist, &self.stop);
        let spread = spread(&self.block);
        for hypothesis in shortlist.into_entries() {
            seeds.extend(self.search.seeds(&self.block, &hypothesis, &truncations));
        }
        for seed in seeds {
            let grown = grow::grow(&self.block, seed, NOISE, &self.stop);
            let Some(consensus) = grown else { continue };
            let certainty = a_contrario::ln_false_alarms(&self.block, &consensus, spread, &self.stop);
            if best.as_ref().is_none_or(|(least, _)| certainty < *least) {
                best = Some((certainty, consensus));
            }
            if best.as_ref().is_some_and(|(least, _)| *least < FalseAlarmOptions::DEFAULT.ln_decisive) {
                break;
            }
        }
        let inlier = best.map_or_else(|| vec![false; self.block.tracks()], |(_, consensus)| consensus.inlier);
        Found { inlier, seconds: ranking.seconds + begun.elapsed().as_secs_f64() }
    }
}
