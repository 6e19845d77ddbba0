//! What the epipolar geometry of pairs of views says of every observation and track.
//!
//! Two views need but eight right matches among a few more, where a subspace of all views needs tracks that are right
//! throughout. On real matches, half of which or more are right, pairs tell a near miss from a hit: the residuals of a
//! model of many views are dominated by what that model leaves out.
//!
//! 1. Neighbouring views ([`STRIDES`] apart: their number is linear in the views, as is everything here) get a
//!    fundamental matrix by LO-RANSAC, and matrices and noise are refined together by expectation and maximisation
//!    ([`residuals`]): one noise for all pairs, a share of right matches for each.
//! 2. A pair whose agreement may be chance has no vote; of the others each match has a likelihood ratio, right against
//!    anywhere.
//! 3. The ratios of a track's pairs, and what else is known of its observations, give the odds of each of them and of
//!    the track ([`chain`]): one wrong observation spoils all pairs that it is in, and only those.
//!
//! # Pitfall
//! What slides along its epipolar lines has the votes of all pairs whose epipolar planes agree: with all centres on one
//! line pairs cannot tell it.

mod forward_backward;
mod residuals;
#[cfg(test)]
mod tests;
mod tracks;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::fundamental::{self, Fundamental, Match};
use super::ransac::Robust;
use crate::domain::StopToken;
use residuals::{Residuals, noise_of};
pub use tracks::Tracks;

/// Distances between the two views of a pair, in views. Neighbours have most in common; the next but one closes
/// triangles, so that a wrong observation disagrees with more than one. Wider pairs add nothing: with 3 the mean
/// average precision over real windows of five views is .9551, without .9554 (and [`chain`] holds two observations
/// back).
const STRIDES: [usize; 2] = [1, 2];
/// Matches that a fundamental matrix is estimated from at most, evenly taken.
const MOST_MATCHES: usize = 500;
/// Logarithm of the expected number of chance agreements from which on a pair has no vote: one in a thousand, which is
/// also what a consensus is accepted at. Without it, pairs of few right matches vote for what they happen to fit.
const LN_MEANINGFUL: f64 = -7.0;
/// Rounds of refining matrices and noise, and steps of the noise within each: the noise settles in about ten.
const ROUNDS: usize = 3;
const STEPS: usize = 8;

/// The votes of the pairs of views.
#[derive(Debug, Clone, PartialEq)]
pub struct Votes {
    /// First observation of each track, and the end of the last.
    ranges: Vec<usize>,
    /// Of each observation: logarithm of the likelihood ratio of its match with the track's observation before it, and
    /// with the one before that; 0 where no pair speaks.
    ratios: Vec<[f64; 2]>,
    /// Core noise that the pairs agree on, in the units of the tracks.
    pub noise: f64,
    /// Pairs of views that have a vote.
    pub pairs: usize,
}

/// Logarithms of the odds that something is right.
#[derive(Debug, Clone, PartialEq)]
pub struct LnOdds {
    /// One an observation, track by track.
    pub observations: Vec<f64>,
    /// That all observations of a track are right, one a track.
    pub tracks: Vec<f64>,
}

/// Two views with the matches that they have.
struct Pair {
    /// Later observation, and whether the earlier one is the one before it (0) or before that (1).
    places: Vec<(usize, usize)>,
    matches: Vec<Match>,
    fundamental: Fundamental,
    /// Of the matches that the matrix is estimated from.
    residuals: Residuals,
    sampled: Vec<Match>,
}

impl Votes {
    /// Asks every pair.
    ///
    /// * `noise`: standard deviation of a coordinate; rather too high than too low
    /// * `most_samples`: that a pair's matrix may take, see [`fundamental::robust_within`]
    /// * `seed`: of the samples drawn
    ///
    /// Returns `None` where no pair has a vote, or once `stop` fires.
    pub fn ask(tracks: &Tracks, noise: f64, most_samples: usize, seed: u64, stop: &StopToken) -> Option<Self> {
        let mut pairs = Vec::new();
        for (k, (places, matches)) in matched(tracks).into_iter().enumerate() {
            // A stream of its own for every pair: what one draws does not move the others.
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(k as u64);
            let robust = |sampled: &[Match]| fundamental::robust_within(sampled, noise, most_samples, &mut rng, stop);
            pairs.extend(Pair::estimate(places, matches, robust));
            if stop.is_stopped() {
                return None;
            }
        }
        let noise = refine(&mut pairs, noise);
        pairs.retain(|pair| pair.residuals.ln_false_alarms(noise) < LN_MEANINGFUL);
        if pairs.is_empty() {
            return None;
        }
        let mut ratios = vec![[0.0; 2]; tracks.observations().len()];
        for pair in &pairs {
            for (&(observation, back), seen) in pair.places.iter().zip(&pair.matches) {
                let ratio = pair.residuals.ln_ratio(pair.fundamental.sampson_squared(seen), noise);
                ratios[observation][back] = if ratio.is_nan() { 0.0 } else { ratio };
            }
        }
        let ranges = (0..tracks.len()).map(|track| tracks.range(track).start).chain([ratios.len()]).collect();
        Some(Self { ranges, ratios, noise, pairs: pairs.len() })
    }

    /// What the votes say together with what is known of each observation beside them.
    ///
    /// * `alone`: logarithms of the odds of each observation, track by track; 0 where nothing is known
    ///
    /// # Panics
    /// When there is not one for every observation.
    pub fn with(&self, alone: &[f64]) -> LnOdds {
        assert_eq!(alone.len(), self.ratios.len(), "one entry an observation");
        let mut found = LnOdds { observations: Vec::with_capacity(alone.len()), tracks: Vec::new() };
        for range in self.ranges.windows(2) {
            let range = range[0]..range[1];
            let posterior = forward_backward::posterior(&alone[range.clone()], &self.ratios[range]);
            found.observations.extend(posterior.observations);
            found.tracks.push(posterior.track);
        }
        found
    }

    /// What the votes say by themselves.
    pub fn alone(&self) -> LnOdds {
        self.with(&vec![0.0; self.ratios.len()])
    }
}

impl Pair {
    /// A robust matrix of the pair; `None` where there is none.
    fn estimate(
        places: Vec<(usize, usize)>,
        matches: Vec<Match>,
        robust: impl FnOnce(&[Match]) -> Option<Robust<Fundamental>>,
    ) -> Option<Self> {
        let count = matches.len().min(MOST_MATCHES);
        let sampled: Vec<Match> = (0..count).map(|k| matches[k * matches.len() / count]).collect();
        let fundamental = robust(&sampled)?.model;
        let residuals = Residuals::new(&sampled, squared(&fundamental, &sampled));
        Some(Self { places, matches, fundamental, residuals, sampled })
    }
}

fn squared(fundamental: &Fundamental, matches: &[Match]) -> Vec<f64> {
    matches.iter().map(|seen| fundamental.sampson_squared(seen)).collect()
}

/// Places of matches, see [`Pair::places`], and the matches.
type Placed = (Vec<(usize, usize)>, Vec<Match>);

/// The matches of every pair.
fn matched(tracks: &Tracks) -> Vec<Placed> {
    let mut pairs = vec![(Vec::new(), Vec::new()); STRIDES.len() * tracks.views()];
    let observations = tracks.observations();
    for track in 0..tracks.len() {
        let range = tracks.range(track);
        for later in range.clone() {
            for back in 0..STRIDES.len().min(later - range.start) {
                let (to, from) = (observations[later], observations[later - 1 - back]);
                let Some(stride) = STRIDES.iter().position(|stride| from.view + stride == to.view) else { continue };
                let (places, matches) = &mut pairs[STRIDES.len() * from.view + stride];
                places.push((later, back));
                matches.push(Match { from: from.xy, to: to.xy });
            }
        }
    }
    pairs
}

/// Refines matrices and noise together; returns the noise, `most` at most.
fn refine(pairs: &mut [Pair], most: f64) -> f64 {
    let mut noise = most;
    for _ in 0..ROUNDS {
        let mut weights = Vec::new();
        for _ in 0..STEPS {
            let mut sums = [0.0; 2];
            weights.clear();
            for pair in pairs.iter_mut() {
                let (of_pair, of_noise) = pair.residuals.expect(noise);
                weights.push(of_pair);
                sums = [sums[0] + of_noise[0], sums[1] + of_noise[1]];
            }
            noise = noise_of(sums, most);
        }
        for (pair, weights) in pairs.iter_mut().zip(&weights) {
            if let Some(refitted) = pair.fundamental.refitted(&pair.sampled, weights) {
                pair.residuals.squared = squared(&refitted, &pair.sampled);
                pair.fundamental = refitted;
            }
        }
    }
    noise
}
