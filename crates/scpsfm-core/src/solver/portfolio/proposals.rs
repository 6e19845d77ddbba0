//! What is proposed, and how a proposal becomes a consensus.

use std::time::Instant;

use super::best::Best;
use super::{OPTIONS, Portfolio, Search, VerifiedBy};
use crate::domain::Proposal;
use crate::geometry::factorization::{RANK, dominant_subspace};
use crate::geometry::statistics::median;
use crate::network::THRESHOLD;
use crate::solver::a_contrario::{self, FalseAlarmOptions};
use crate::solver::learned::TrackScores;
use crate::solver::search::rigid::{Rigid, RigidSearch};
use crate::solver::search::{Sampler, Seed, Shortlist, affine};
use crate::solver::{depths, grow, priors};

impl<'a> Portfolio<'a> {
    /// Whether this proposal may find anything yet.
    pub(super) fn is_wanted(&self, proposal: Proposal) -> bool {
        !self.is_over() && !self.stop.is_stopped() && !self.settings.excluded_proposals.contains(&proposal)
    }

    /// Whether a round is the first one at its noise since another round.
    fn is_new_noise(since: u32, round: u32) -> bool {
        let noise = |round: u32| OPTIONS.noise_ladder[round as usize % OPTIONS.noise_ladder.len()];
        (since..round).all(|earlier| noise(earlier) != noise(round))
    }

    /// The search for rigid tracks, where depths are given and true up to one scale, and a proposal may use it; not of
    /// a zoom, which moves distances with the focal length.
    fn rigid_search(&self, proposal: Proposal) -> Option<RigidSearch<'a>> {
        let is_wanted = self.is_wanted(proposal) && self.is_wanted(Proposal::Rigidity);
        if !is_wanted || self.settings.focal_per_view {
            return None;
        }
        RigidSearch::new(self.block, self.spread, self.stop)
    }

    /// Tracks whose distances stay the same, once a noise level.
    pub(super) fn propose_rigid(&mut self, round: u32) {
        if !Self::is_new_noise(0, round) {
            return;
        }
        let Some(search) = self.rigid_search(Proposal::Rigidity) else { return };
        let pairs = self.block.tracks() * (self.block.tracks() - 1) / 2;
        self.stats(Proposal::Rigidity).work += pairs as u32;
        self.propose_rigid_consensus(Proposal::Rigidity, &search, |search, noise| search.run(noise));
    }

    /// A rigid consensus, grown by image points, and as depths verify it where that is not decisive.
    fn propose_rigid_consensus(
        &mut self,
        proposal: Proposal,
        search: &RigidSearch,
        find: impl FnOnce(&RigidSearch, f64) -> Option<Rigid>,
    ) {
        let begun = Instant::now();
        let found = find(search, self.noise);
        self.stats(proposal).seconds += begun.elapsed().as_secs_f64();
        let Some(rigid) = found else { return };
        self.verify(proposal, vec![depths::seed(&rigid)]);
        let certainty = |rigid: &Rigid| rigid.ln_false_alarms(search.spread());
        if !self.is_decisive() {
            let found = Best {
                ln_false_alarms: certainty(&rigid),
                verified_by: VerifiedBy::Depths { focal: rigid.focal },
                consensus: depths::consensus(self.block, &rigid, self.noise),
                counted: rigid.inlier_count(),
                proposal,
            };
            self.stats(proposal).record(&found);
            self.offer(found);
        }
        let least = self.rigid.as_ref().map_or(FalseAlarmOptions::DEFAULT.ln_decisive, |(_, rigid)| certainty(rigid));
        if certainty(&rigid) < least {
            self.rigid = Some((proposal, rigid));
        }
    }

    /// What needs no optimisation, in the order in which it is to be believed.
    ///
    /// Of mostly right tracks the statistics of the scene itself rank better than what was learned from others: on real
    /// photographs they put nearly every right track first. Where few are right they rank worse the fewer there are.
    pub(super) fn propose_at_once(&mut self, round: u32) {
        let many = self.effort.is_seed || self.track_scores.as_ref().is_none_or(TrackScores::expects_many);
        if many && round == 0 {
            self.propose_geometric();
        }
        self.propose_learned(round);
        if !many && round == 0 {
            self.propose_geometric();
        }
    }

    /// The trained network's scores: grown as it stands at first, then searched from.
    fn propose_learned(&mut self, round: u32) {
        if !self.is_wanted(Proposal::Learned) {
            return;
        }
        let Some(track_scores) = self.track_scores.clone() else { return };
        // The levels of the noise repeat, and so would what is grown from the same tracks.
        if (round as usize) < OPTIONS.noise_ladder.len() && matches!(self.search, Search::Affine(_)) {
            self.verify(Proposal::Learned, affine::seed(self.block, track_scores.start()).into_iter().collect());
        }
        self.propose(Proposal::Learned, &track_scores.probabilities(), Some(&track_scores.truncations()));
    }

    /// The proposals that need no optimisation, once.
    fn propose_geometric(&mut self) {
        if self.is_wanted(Proposal::Irls) {
            self.propose_irls();
        }
        if self.is_wanted(Proposal::Consistency) {
            self.propose_consistency();
        }
    }

    fn propose_irls(&mut self) {
        let begun = Instant::now();
        let irls = match &self.search {
            Search::Affine(search) => priors::affine_irls(search.centred(), 0, self.stop),
            Search::Subspace(search) => priors::irls(search.balanced(), RANK, self.stop),
        };
        self.stats(Proposal::Irls).seconds += begun.elapsed().as_secs_f64();
        if let Some(weights) = irls {
            self.propose_ranking(Proposal::Irls, &weights);
            self.propose(Proposal::Irls, &weights, None);
        }
    }

    fn propose_consistency(&mut self) {
        let begun = Instant::now();
        let consistency = match &self.search {
            Search::Affine(search) => priors::consistency(search.centred(), 2),
            Search::Subspace(search) => priors::consistency(&centred_rows(search.balanced()), 3),
        };
        self.stats(Proposal::Consistency).seconds += begun.elapsed().as_secs_f64();
        self.propose(Proposal::Consistency, &consistency, None);
    }

    /// Samples tracks by their weights and grows what that finds.
    ///
    /// * `truncations`: see [`affine::AffineSearch::run`]; of a search with depths nothing depends on them
    pub(super) fn propose(&mut self, proposal: Proposal, weights: &[f64], truncations: Option<&[f64]>) {
        if !self.is_wanted(proposal) {
            return;
        }
        let begun = Instant::now();
        let sampler = Sampler::new(weights);
        let uniform = proposal == Proposal::Uniform;
        let samples = |(guided, free): (usize, usize)| if uniform { free } else { guided };
        let (seeds, drawn) = match &self.search {
            Search::Affine(search) => {
                let mut shortlist = Shortlist::new(OPTIONS.shortlist);
                let drawn = samples(OPTIONS.affine_samples);
                let even = vec![1.0; self.block.tracks()];
                let truncations = truncations.unwrap_or(&even);
                search.run(&sampler, truncations, drawn, &mut self.rng, &mut shortlist, self.stop);
                let seeds = shortlist.into_entries();
                let seeds: Vec<Seed> =
                    seeds.flat_map(|hypothesis| search.seeds(self.block, &hypothesis, truncations)).collect();
                (seeds, drawn)
            }
            Search::Subspace(search) => {
                let mut shortlist = Shortlist::new(OPTIONS.shortlist);
                let drawn = samples(OPTIONS.subspace_samples);
                search.run(&sampler, drawn, &mut self.rng, &mut shortlist, self.stop);
                (shortlist.into_entries().map(|basis| search.seed(self.block, &basis)).collect(), drawn)
            }
        };
        let stats = self.stats(proposal);
        stats.seconds += begun.elapsed().as_secs_f64();
        if proposal != Proposal::Network {
            stats.work += drawn as u32;
        }
        self.verify(proposal, seeds);
    }

    /// What a head keeps: once a noise level grown as it stands and by rigid distances, then searched from its ranking.
    ///
    /// * `weights`: of the head, one a track
    /// * `since`: round that it was optimised in
    pub(super) fn propose_head(&mut self, weights: &[f64], since: u32, round: u32) {
        if Self::is_new_noise(since, round) {
            self.propose_kept(weights);
        }
        self.propose(Proposal::Network, &priors::from_network(weights), None);
    }

    /// The tracks that a head keeps, as they are.
    fn propose_kept(&mut self, weights: &[f64]) {
        let kept: Vec<usize> = (0..weights.len()).filter(|&track| weights[track] > THRESHOLD).collect();
        let seed = match &self.search {
            _ if kept.len() < RANK => None,
            Search::Affine(_) => affine::seed(self.block, kept.clone()),
            Search::Subspace(search) => dominant_subspace(&search.balanced().select_columns(&kept), RANK)
                .map(|basis| search.seed(self.block, &basis)),
        };
        self.verify(Proposal::Network, seed.into_iter().collect());
        if let Some(search) = self.rigid_search(Proposal::Network) {
            self.propose_rigid_consensus(Proposal::Network, &search, |search, noise| search.around(&kept, noise));
        }
    }

    /// Grows the tracks of most weight, without sampling.
    fn propose_ranking(&mut self, proposal: Proposal, weights: &[f64]) {
        if matches!(self.search, Search::Affine(_)) {
            let costs: Vec<f64> = weights.iter().map(|weight| -weight).collect();
            self.verify(proposal, affine::seeds_from_ranking(self.block, &costs));
        }
    }

    /// Grows seeds until one is decisive, and keeps the statistics.
    fn verify(&mut self, proposal: Proposal, seeds: Vec<Seed>) {
        for seed in seeds {
            let begun = Instant::now();
            let grown = grow::grow(self.block, seed, self.noise, self.stop);
            let counted = grown.as_ref().map_or(0, |consensus| self.counted(consensus));
            let ln_false_alarms = grown.as_ref().map_or(f64::INFINITY, |consensus| {
                a_contrario::ln_false_alarms(self.block, consensus, self.spread, self.stop)
            });
            self.stats(proposal).seconds += begun.elapsed().as_secs_f64();
            let Some(consensus) = grown else { continue };
            self.note_near_duplicates(&consensus);
            let grown = Best { consensus, proposal, ln_false_alarms, verified_by: VerifiedBy::ImagePoints, counted };
            self.stats(proposal).record(&grown);
            self.offer(grown);
            if self.is_over() || self.stop.is_stopped() {
                break;
            }
        }
    }
}

/// Every row centred on its median.
fn centred_rows(matrix: &nalgebra::DMatrix<f64>) -> nalgebra::DMatrix<f64> {
    let mut centred = matrix.clone();
    for mut row in centred.row_iter_mut() {
        let mut values: Vec<f64> = row.iter().copied().collect();
        let middle = median(&mut values);
        row.add_scalar_mut(-middle);
    }
    centred
}
