//! SCPSFM: the paper's network by itself. Several heads, optimisations of the continued objective
//! ([`crate::network::continuation`] says what a head is), and the choice among them by the paper's eq. 10.
//!
//! The decision is `w > 1/2` of the chosen head. It samples nothing and adjusts nothing, and nothing later changes it:
//! with a handful of right tracks any four columns have rank 4, and a refit of the consensus lowers F1 at 98 % wrong
//! tracks from .864 to .68 (seeds 0 to 9).
//!
//! A head of kept tracks S has `J = -|S| + Σ_{k>=5} σ_k²(M_S) / tau² + 3 e` (eq. 10, its rank constraint as eq. 8's
//! distance at the noise, its self-calibration constraint as the DAQ residual `e = 1/2 min Σ_i | S_i/|S_i| - ω/|ω| |²`
//! over K and the plane at infinity; the paper sums the norms). Without the DAQ term: no e. The lowest J is chosen.
//!
//! Heads end with one that is accepted: at least four tracks that stand apart from wrong ones and whose e is small, or
//! without the DAQ term at least eight that stand apart. A chosen head is verified where it is accepted with at least
//! five tracks, or where at least eight stand apart: a motion near a degenerate one has a large e with right tracks,
//! too. The rest is an answer that nothing has verified: it is reported as such and not reconstructed.

mod options;
#[cfg(test)]
mod tests;

use nalgebra::DMatrix;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::baselines::{self, Decided, NetworkIteration};
use super::problem::Problem;
use super::recorder::Recorder;
use crate::domain::{StopToken, Task};
use crate::geometry::daq::hypothesis_residual;
use crate::geometry::factorization::{RANK, cameras_of, dominant_subspace, subspace_residuals};
use crate::geometry::measurement::{CompleteBlock, balance};
use crate::geometry::statistics::midpoint_median;
use crate::network::continuation::{ContinuationOptions, Finished, Head, HeadIteration, HeadStart, wrong_residual};
use crate::network::{Error, NetworkSettings, PriorNetwork, THRESHOLD, standard_normal};

pub use options::HeadOptions;

/// Views below which the network has nothing to compare.
const NETWORK_LEAST_VIEWS: usize = 2;
/// Added to J of a head that keeps fewer than four tracks: more than any set near rank 4 has.
const TOO_FEW: f64 = 100.0;
/// DAQ residual of such a head; there are no cameras to take it of.
const WORST_DAQ: f64 = 10.0;
/// Between the seeds of two heads' networks: callers' seeds are small numbers, which must not meet.
const SEED_STRIDE: u64 = 1 << 32;
/// Stream of the view scales, apart from that of the networks.
const VIEW_SCALES: u64 = 1;

/// Decides which tracks of a block are right.
///
/// * `tracks`: those of the input that the block's are
///
/// # Errors
/// The network's own.
pub fn decide(
    problem: &Problem,
    block: &CompleteBlock,
    tracks: &[usize],
    recorder: &mut Recorder,
) -> Result<Decided, Error> {
    let settings = problem.settings;
    let search = HeadSearch {
        settings: NetworkSettings::from(settings),
        has_depths: block.has_depths(),
        stop: problem.stop,
        options: HeadOptions::DEFAULT,
        continuation: ContinuationOptions::DEFAULT,
    };
    let heads = search.options.heads;
    let mut earlier = 0;
    let choice = search.run(&block.measurement_matrix(), &mut |head, step, reported| {
        let HeadIteration { iteration, losses, .. } = *step;
        if iteration == 1 {
            earlier = recorder.standing.iteration;
        }
        recorder.begin_step(Task::Heads, head + 1, heads);
        let HeadProgress { weights, focal } = reported;
        let within = (head as f64 + f64::from(iteration) / f64::from(settings.iterations)) / heads as f64;
        let step = NetworkIteration { iteration, earlier, losses, weights, focal };
        baselines::report(problem, tracks, &step, within, recorder);
    })?;
    let inlier = choice.weights.iter().map(|&weight| weight > THRESHOLD).collect();
    Ok(Decided { inlier, weights: choice.weights, is_verified: choice.is_verified })
}

/// State of the head that is being optimised, reported with every iteration.
pub struct HeadProgress<'a> {
    /// One a column of the whole matrix.
    pub weights: &'a [f64],
    /// In the units of the matrix.
    pub focal: f64,
}

/// What a search ended with.
#[derive(Debug, Clone, PartialEq)]
pub struct HeadChoice {
    /// Of the chosen head, one a column of the matrix.
    pub weights: Vec<f64>,
    /// Whether its tracks can be taken for right.
    pub is_verified: bool,
    /// Heads that were optimised.
    pub heads: usize,
}

/// Heads on one measurement matrix.
pub struct HeadSearch<'a> {
    pub settings: NetworkSettings,
    pub has_depths: bool,
    pub stop: &'a StopToken,
    pub options: HeadOptions,
    pub continuation: ContinuationOptions,
}

/// A head that ended, and what the choice goes by.
struct FinishedHead {
    weights: Vec<f64>,
    kept: usize,
    tolerance: f64,
    /// `Σ_{k>=5} σ_k²` of the kept columns.
    energy: f64,
    /// Whether the kept tracks stand apart from wrong ones.
    is_separate: bool,
    daq_residual: f64,
}

impl HeadSearch<'_> {
    /// Optimises heads until one is accepted; the one to choose.
    ///
    /// Rows and columns without an observation are left out beforehand, so that padding with zeros changes nothing;
    /// such columns get weight 0. When stopped, the answer is that of the heads before.
    ///
    /// * `matrix`: 3n x m, not balanced
    /// * `report`: called with every iteration and the head, from 0, that it is of
    ///
    /// # Errors
    /// The network's own.
    pub fn run(
        &self,
        matrix: &DMatrix<f64>,
        report: &mut dyn FnMut(usize, &HeadIteration, HeadProgress),
    ) -> Result<HeadChoice, Error> {
        let columns: Vec<usize> =
            (0..matrix.ncols()).filter(|&j| matrix.column(j).iter().any(|&entry| entry != 0.0)).collect();
        let rows: Vec<usize> = (0..matrix.nrows())
            .filter(|&row| matrix.rows(row - row % 3, 3).iter().any(|&entry| entry != 0.0))
            .collect();
        let mut choice = HeadChoice { weights: vec![0.0; matrix.ncols()], is_verified: false, heads: 0 };
        if columns.len() < PriorNetwork::MIN_COLUMNS || rows.len() < 3 * NETWORK_LEAST_VIEWS {
            return Ok(choice);
        }
        let balanced = balance(&matrix.select_columns(&columns).select_rows(&rows));
        let mut heads: Vec<FinishedHead> = Vec::new();
        let mut rng = ChaCha8Rng::seed_from_u64(self.settings.seed);
        rng.set_stream(VIEW_SCALES);
        let mut chosen = 0;
        for place in 0..self.options.heads {
            let start = self.start(place, rows.len() / 3, &mut rng);
            let mut all = vec![0.0; matrix.ncols()];
            let Some(finished) = self.optimise(&balanced, start, &mut |step, head| {
                scatter(head.weights(), &columns, &mut all);
                report(place, step, HeadProgress { weights: &all, focal: head.focal() });
            })?
            else {
                break;
            };
            heads.push(self.judged(&balanced, finished));
            chosen = self.choice(&heads);
            if self.is_accepted(&heads[chosen]) {
                break;
            }
        }
        choice.heads = heads.len();
        if let Some(chosen) = heads.get(chosen) {
            choice.is_verified = self.is_verified(chosen);
            scatter(&chosen.weights, &columns, &mut choice.weights);
        }
        Ok(choice)
    }

    /// Where a head starts; `place` counts from 0.
    fn start(&self, place: usize, views: usize, rng: &mut ChaCha8Rng) -> HeadStart {
        let (relaxed_alpha, least_alpha) = self.options.alphas[place % self.options.alphas.len()];
        let deviation = self.options.view_scale_deviation;
        let view_scales = match place {
            0 => Vec::new(),
            _ => (0..views).map(|_| (deviation * standard_normal(rng)).exp()).collect(),
        };
        HeadStart {
            seed: self.settings.seed.wrapping_add(place as u64 * SEED_STRIDE),
            view_scales,
            relaxed_alpha,
            least_alpha,
            has_depths: self.has_depths,
        }
    }

    /// Optimises one head to its end; `None` when stopped.
    fn optimise(
        &self,
        balanced: &DMatrix<f64>,
        start: HeadStart,
        report: &mut dyn FnMut(&HeadIteration, &Head),
    ) -> Result<Option<Finished>, Error> {
        let mut head = Head::new(balanced, &self.settings, start, self.continuation.clone())?;
        while !head.is_finished() {
            if self.stop.is_stopped() {
                return Ok(None);
            }
            let step = head.step()?;
            report(&step, &head);
        }
        head.finish().map(Some)
    }

    /// A head with what the choice goes by.
    fn judged(&self, balanced: &DMatrix<f64>, finished: Finished) -> FinishedHead {
        let Finished { weights, tolerance, .. } = finished;
        let kept: Vec<usize> = (0..weights.len()).filter(|&j| weights[j] > THRESHOLD).collect();
        let mut head = FinishedHead {
            weights,
            kept: kept.len(),
            tolerance,
            energy: 0.0,
            is_separate: false,
            daq_residual: WORST_DAQ,
        };
        if kept.len() < RANK {
            return head;
        }
        let consensus = balanced.select_columns(&kept);
        let Some(basis) = dominant_subspace(&consensus, RANK) else { return head };
        head.energy = subspace_residuals(&consensus, &basis).iter().map(|residual| residual.powi(2)).sum();
        let freedom = kept.len().saturating_sub(RANK).max(1) as f64;
        let of_wrong = wrong_residual(balanced, &head.weights, &basis);
        head.is_separate = (head.energy / freedom).sqrt() < self.options.separation * of_wrong;
        if self.settings.use_daq {
            head.daq_residual = hypothesis_residual(&cameras_of(&basis));
        }
        head
    }

    /// Place of the head of least J; of equals the first.
    fn choice(&self, heads: &[FinishedHead]) -> usize {
        let mut tolerances: Vec<f64> = heads.iter().map(|head| head.tolerance).collect();
        let tolerance = midpoint_median(&mut tolerances);
        let objective = |head: &FinishedHead| {
            let daq = if self.settings.use_daq { self.options.daq_weight * head.daq_residual } else { 0.0 };
            let too_few = if head.kept < RANK { TOO_FEW } else { 0.0 };
            head.energy / tolerance.powi(2) - head.kept as f64 + daq + too_few
        };
        let objectives: Vec<f64> = heads.iter().map(objective).collect();
        (0..objectives.len()).min_by(|&a, &b| objectives[a].total_cmp(&objectives[b])).unwrap_or(0)
    }

    /// Whether no further head is needed: with the DAQ term, where the tracks stand apart and fit one calibration.
    fn is_accepted(&self, head: &FinishedHead) -> bool {
        if !self.settings.use_daq {
            return self.is_of_low_rank(head);
        }
        let fits = head.daq_residual < self.options.daq_acceptable;
        head.is_separate && head.kept >= self.options.accepted_by_daq && fits
    }

    /// Whether the tracks can be taken for right. Any four have rank 4 and stand apart: of these a small e, which one
    /// of sixteen heads on twenty scenes without a right track has by chance, ends the heads but is no evidence.
    fn is_verified(&self, head: &FinishedHead) -> bool {
        head.kept > RANK && (self.is_accepted(head) || self.is_of_low_rank(head))
    }

    /// Whether the tracks stand apart and are so many that their rank says something.
    fn is_of_low_rank(&self, head: &FinishedHead) -> bool {
        head.is_separate && head.kept >= self.options.accepted_by_rank
    }
}

/// Writes the weights of some columns to their places.
fn scatter(weights: &[f64], columns: &[usize], all: &mut [f64]) {
    for (&column, &weight) in columns.iter().zip(weights) {
        all[column] = weight;
    }
}
