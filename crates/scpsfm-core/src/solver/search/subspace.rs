//! Guided search with depths: four columns of the balanced measurement matrix span the column space.

use nalgebra::DMatrix;
use rand_chacha::ChaCha8Rng;

use super::options::{SamplingOptions, SubspaceOptions};
use super::{Sampler, Seed, Shortlist};
use crate::domain::StopToken;
use crate::geometry::factorization::{RANK, cameras_of, dominant_subspace, subspace_residuals};
use crate::geometry::measurement::{CompleteBlock, balance};
use crate::geometry::{daq, triangulation};

const OPTIONS: SubspaceOptions = SamplingOptions::DEFAULT.subspace;
/// Columns that the subspace is refitted to at least: one more than it needs.
const LEAST_COLUMNS: usize = RANK + 1;

/// The balanced measurement matrix of a block with depths, ready to be searched.
#[derive(Debug, Clone)]
pub struct SubspaceSearch {
    balanced: DMatrix<f64>,
    tolerance: f64,
    use_daq: bool,
}

impl SubspaceSearch {
    /// * `noise`: standard deviation of the image points in normalised units; depths are taken to be as good
    pub fn new(block: &CompleteBlock, noise: f64, use_daq: bool) -> Self {
        let mut search = Self { balanced: balance(&block.measurement_matrix()), tolerance: 0.0, use_daq };
        search.set_noise(noise);
        search
    }

    /// Searches on at another noise.
    pub fn set_noise(&mut self, noise: f64) {
        self.tolerance =
            (OPTIONS.tolerance_per_noise * noise).clamp(OPTIONS.tolerance_bounds.0, OPTIONS.tolerance_bounds.1);
    }

    /// The balanced measurement matrix, 3n x m.
    pub fn balanced(&self) -> &DMatrix<f64> {
        &self.balanced
    }

    /// Draws `samples` samples; those that could enter the shortlist are optimised locally first.
    pub fn run(
        &self,
        sampler: &Sampler,
        samples: usize,
        rng: &mut ChaCha8Rng,
        shortlist: &mut Shortlist<DMatrix<f64>>,
        stop: &StopToken,
    ) {
        let mut best = f64::INFINITY;
        for k in 0..samples {
            if k.is_multiple_of(OPTIONS.samples_per_look) && stop.is_stopped() {
                return;
            }
            let Some(sample) = sampler.draw(rng) else { continue };
            let columns = self.balanced.select_columns(&sample);
            let basis = columns.qr().q();
            if basis.ncols() < RANK {
                continue;
            }
            let cost = self.truncated_cost(&basis);
            // Only a sample that beats the best one so far is worth a local optimisation.
            if cost < best {
                best = cost;
                let basis = self.optimise_locally(basis);
                shortlist.offer(self.cost(&basis), basis);
            }
        }
    }

    fn truncated_cost(&self, basis: &DMatrix<f64>) -> f64 {
        let truncation = self.tolerance * self.tolerance;
        subspace_residuals(&self.balanced, basis)
            .iter()
            .map(|residual| (residual * residual / truncation).min(1.0))
            .sum()
    }

    /// Truncated cost plus the weighted DAQ residual of the cameras in the subspace.
    fn cost(&self, basis: &DMatrix<f64>) -> f64 {
        let penalty =
            if self.use_daq { OPTIONS.daq_weight * daq::hypothesis_residual(&cameras_of(basis)) } else { 0.0 };
        self.truncated_cost(basis) + penalty
    }

    /// Refits the subspace to the columns within a shrinking tolerance.
    fn optimise_locally(&self, basis: DMatrix<f64>) -> DMatrix<f64> {
        let (mut best, mut best_cost) = (basis.clone(), self.truncated_cost(&basis));
        let mut current = basis;
        for tolerance in OPTIONS.local_tolerances {
            let mut kept: Vec<usize> = Vec::new();
            for _ in 0..OPTIONS.local_rounds {
                let residuals = subspace_residuals(&self.balanced, &current);
                let near = nearest(&residuals, tolerance * self.tolerance);
                if near == kept {
                    break;
                }
                let Some(refitted) = dominant_subspace(&self.balanced.select_columns(&near), RANK) else { break };
                (current, kept) = (refitted, near);
                let cost = self.truncated_cost(&current);
                if cost < best_cost {
                    (best, best_cost) = (current.clone(), cost);
                }
            }
        }
        best
    }

    /// The seed of a column space given by an orthonormal basis (3n x 4): its cameras, and the columns within the
    /// tolerance.
    pub fn seed(&self, block: &CompleteBlock, basis: &DMatrix<f64>) -> Seed {
        let support = nearest(&subspace_residuals(&self.balanced, basis), self.tolerance);
        let cameras = cameras_of(basis);
        let points = support.iter().map(|&track| triangulation::linear(&cameras, block.track(track))).collect();
        Seed { cameras, points, support }
    }
}

/// Columns whose residual is below the tolerance, at least [`LEAST_COLUMNS`] of them, increasing.
fn nearest(residuals: &[f64], tolerance: f64) -> Vec<usize> {
    let mut ranked: Vec<usize> = (0..residuals.len()).collect();
    ranked.sort_by(|&a, &b| residuals[a].total_cmp(&residuals[b]).then(a.cmp(&b)));
    let within = ranked.iter().take_while(|&&track| residuals[track] < tolerance).count();
    ranked.truncate(within.max(LEAST_COLUMNS.min(residuals.len())));
    ranked.sort_unstable();
    ranked
}
