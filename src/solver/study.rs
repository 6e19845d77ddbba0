//! One prior alone: how well it ranks, and what a search of a given length finds under it; and the same of windows of
//! real sequences. For `scpsfm evaluate --priors`; a solve does not come through here.

use std::time::Instant;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::grow::{self, Consensus};
use super::learned::Opinion;
use super::portfolio::{LN_DECISIVE, spread};
use super::search::{Sampler, Shortlist, affine};
use super::{block, priors};
use crate::domain::{Input, Prior, StopToken};
use crate::geometry::epipolar_votes::{Tracks, Votes};
use crate::geometry::fundamental::MOST_SAMPLES;
use crate::geometry::measurement::{CompleteBlock, Sighting};

/// Hypotheses of a search that are grown: enough that the ranking of hypotheses is not what is measured.
const SHORTLIST: usize = 6;
/// Noise that growing starts from, normalised units: a solve's own without a hint.
const NOISE: f64 = 0.005;

/// A scene made ready for every prior.
pub struct Study {
    block: CompleteBlock,
    search: affine::Search,
    stop: StopToken,
}

/// What a prior says of every track, larger where it is more likely right.
pub struct Ranking {
    pub prior: Prior,
    pub weights: Vec<f64>,
    pub seconds: f64,
    opinion: Option<Opinion>,
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
        let ranges = block::track_ranges(input);
        let (normalization, _) = block::normalization(input);
        let views: Vec<usize> = (0..input.view_count()).collect();
        let block = block::extract(input, &ranges, &normalization, &views).complete;
        Self { search: affine::Search::new(&block), block, stop: stop.clone() }
    }

    /// Asks a prior; `None` for one that does not rank image points by themselves.
    pub fn rank(&self, prior: Prior) -> Option<Ranking> {
        let begun = Instant::now();
        let mut opinion = None;
        let weights = match prior {
            Prior::Uniform => vec![1.0; self.block.tracks()],
            Prior::Irls => priors::affine_irls(self.search.centred(), &self.stop)?,
            Prior::Consistency => priors::consistency(self.search.centred(), 2),
            Prior::Learned => opinion.insert(Opinion::of(&self.block)?).probabilities(),
            Prior::Network | Prior::Rigidity => return None,
        };
        Some(Ranking { prior, weights, seconds: begun.elapsed().as_secs_f64(), opinion })
    }

    /// What the best hypothesis of so many samples under the trained network says of every track, larger where it is
    /// more likely right, when a nat of the network's odds counts `per_nat` in the score of hypotheses; `None` where the
    /// network has no answer.
    pub fn best_under(&self, per_nat: f64, samples: usize, seed: u64) -> Option<Vec<f64>> {
        let opinion = Opinion::of(&self.block)?;
        let truncations = opinion.truncations_at(per_nat);
        let mut shortlist = Shortlist::new(1);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let sampler = Sampler::new(&opinion.probabilities());
        self.search.run(&sampler, &truncations, samples, &mut rng, &mut shortlist, &self.stop);
        let best = shortlist.into_entries().next()?;
        Some(self.search.costs(&best, &truncations).into_iter().map(|cost| -cost).collect())
    }

    /// Searches under a prior with so many samples, and grows the best hypotheses.
    pub fn search(&self, ranking: &Ranking, samples: usize, seed: u64) -> Found {
        let begun = Instant::now();
        let mut best: Option<(f64, Consensus)> = None;
        let (truncations, mut seeds) = match &ranking.opinion {
            Some(opinion) => (opinion.truncations(), affine::seed(&self.block, opinion.start()).into_iter().collect()),
            None => (self.search.even_truncations(), Vec::new()),
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
            let grown = grow::grow(&self.block, seed.cameras, seed.points, seed.support, NOISE, &self.stop);
            let Some(consensus) = grown else { continue };
            let certainty = consensus.ln_false_alarms(spread);
            if best.as_ref().is_none_or(|(least, _)| certainty < *least) {
                best = Some((certainty, consensus));
            }
            if best.as_ref().is_some_and(|(least, _)| *least < LN_DECISIVE) {
                break;
            }
        }
        let inlier = best.map_or_else(|| vec![false; self.block.tracks()], |(_, consensus)| consensus.inlier);
        Found { inlier, seconds: ranking.seconds + begun.elapsed().as_secs_f64() }
    }
}

/// Views of a window: those of a block that seeds a sequence, for long complete ones hold few tracks.
pub const WINDOW_VIEWS: usize = 5;

/// Consecutive views of a sequence with the tracks that three or more of them show: fewer verify nothing.
pub struct Window {
    tracks: Tracks,
    /// Observations of the input, in the order of the tracks.
    pub observations: Vec<usize>,
}

/// What is said of every observation of a window, larger where it is more likely right; `None` from those who say
/// nothing.
pub struct WindowRankings {
    /// Pairs of views.
    pub epipolar: Option<Vec<f64>>,
    /// The network that was trained beforehand.
    pub learned: Option<Vec<f64>>,
    /// Both. No search is guided by it: on real sequences the scene's own statistics decide every seed, and hearing these
    /// first took three of nine views from one sequence and gave none a better calibration.
    pub together: Option<Vec<f64>>,
    /// Of asking the pairs, and of asking the network.
    pub seconds: [f64; 2],
}

/// Every window of an input, those that show no tracks left out.
pub fn windows(input: &Input) -> Vec<Window> {
    let ranges = block::track_ranges(input);
    let (normalization, _) = block::normalization(input);
    let seen = |k: usize, first: usize| {
        let view = input.view_of(k);
        Sighting { view: view - first, xy: normalization.normalize(view, input.point_px(k)) }
    };
    let window = |first: usize| {
        let inside = |track: usize| -> Vec<usize> {
            let within = first..first + WINDOW_VIEWS;
            (ranges[track]..ranges[track + 1]).filter(|&k| within.contains(&input.view_of(k))).collect()
        };
        let shown: Vec<Vec<usize>> =
            (0..input.track_count()).map(inside).filter(|seen| seen.len() >= block::LEAST_VIEWS).collect();
        let tracks = Tracks::new(WINDOW_VIEWS, shown.iter().map(|track| track.iter().map(|&k| seen(k, first))));
        Window { tracks, observations: shown.concat() }
    };
    let last = (input.view_count() + 1).saturating_sub(WINDOW_VIEWS);
    (0..last).map(window).filter(|window| !window.observations.is_empty()).collect()
}

impl Window {
    /// Asks pairs of views and the trained network.
    pub fn rank(&self, seed: u64, stop: &StopToken) -> WindowRankings {
        let begun = Instant::now();
        let votes = Votes::ask(&self.tracks, NOISE, MOST_SAMPLES, seed, stop);
        let voted = begun.elapsed().as_secs_f64();
        let opinion = Opinion::of_tracks(&self.tracks);
        let seconds = [voted, begun.elapsed().as_secs_f64() - voted];
        let together = match (&votes, &opinion) {
            (Some(votes), Some(opinion)) => Some(opinion.with_votes(votes)),
            (Some(votes), None) => Some(Opinion::of_votes(votes)),
            (None, opinion) => opinion.clone(),
        };
        let said = |opinion: &Opinion| opinion.observations().to_vec();
        WindowRankings {
            epipolar: votes.map(|votes| votes.alone().observations),
            learned: opinion.as_ref().map(said),
            together: together.as_ref().map(said),
            seconds,
        }
    }
}
