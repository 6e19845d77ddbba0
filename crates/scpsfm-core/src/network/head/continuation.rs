//! The paper's network under a continued objective: from a problem that is convex in the weights to the paper's own.
//!
//! Of `L_num + alpha L_proj + beta L_DAQ` (paper, eq. 11), with q rising from 0 to 1 over the first 60 % of the
//! iterations and `N = Σ_j w_j`:
//!
//! | iterations | L_num | L_proj | its weight |
//! |---|---|---|---|
//! | to 60 % ([`Phase::Relaxation`]) | `exp(t - N)`, beyond t its tangent; t from 15 to 5 | `Σ_{k>=5} σ_k + (1-q) Σ_{k<=4} σ_k` | alpha to a second value, geometrically |
//! | to 80 % ([`Phase::Rank`]) | the same, t = 5 | `Σ_{k>=5} σ_k` | to what the tail of the consensus asks for |
//! | to the end ([`Phase::Growth`]) | the same | `Σ_{k>=5} σ_k²` (eq. 8) | `1/tau²`, tau a multiple of the measured noise |
//!
//! # Where this departs from the paper, and why
//! F1 of `w > 1/2` in 10 views, 200 tracks, .3 % noise, true depths, measured with a prototype of the same recipe in
//! another language. With all of it 1.0 to 96 %, .994 at 97 %, .911 at 98 % (30 scenes, prototype); figures of single
//! ablations are over seeds 0 to 9, where the whole has .864 at 98 %.
//!
//! | what | the paper | here | without it |
//! |---|---|---|---|
//! | L_proj (eq. 11) | `Σ_{k>=5} σ_k` throughout | from the nuclear norm, convex in w, to that | .86 at 96 %, .70 at 97 % |
//! | L_num (eq. 7) | `exp(t - Σ s(w - 1/2))` | `N = Σ w`; beyond t its tangent `1 + t - N`, the surrogate of eq. 10 | 0 at 50 %: nothing asks for more than t tracks |
//! | t | 15 | 15 to 5 | 5 throughout is as good |
//! | alpha | 1 | 10 to 30, then by the consensus' own tail | one alpha fits one number of right tracks and one noise |
//! | end | the same L_proj | eq. 8's squared distance at the measured noise | right tracks of larger noise stay out |
//! | bound of tau | - | .8 of what wrong tracks leave ([`wrong_residual`]) | one of ten scenes without a right track: all tracks kept and taken for right |
//! | segmentation head | ReLU (PointNet) | leaky, slope .1 | features of few right tracks die |
//! | L_DAQ (eq. 9) | into the weights, too | from 60 % and without a derivative by the weights: moves K, and the plane at infinity through layers that the weights share | harm from any onset |
//!
//! The rest is as in [`crate::network`]: balanced columns, batch statistics, a quarter of the width, one Adam state.

use nalgebra::DMatrix;

use super::options::ContinuationOptions;
use crate::domain::Phase;
use crate::geometry::factorization::{RANK, dominant_subspace, subspace_residuals};
use crate::geometry::statistics::{chi_square_gate, chi_square_median, midpoint_median};
use crate::network::losses::{self, RankTerm};
use crate::network::{Error, NetworkSettings, THRESHOLD};

/// Where one head starts, and what distinguishes it from others.
#[derive(Debug, Clone, PartialEq)]
pub struct ContinuedStart {
    /// Factor on each view's rows in the relaxation; empty: all views alike.
    pub view_scales: Vec<f64>,
    /// Alpha at the end of the relaxation, and the least that the consensus may set, at the reference shape.
    pub relaxed_alpha: f64,
    pub least_alpha: f64,
    /// Whether the matrix holds depths; else they are 1.
    pub has_depths: bool,
}

/// The objective of every iteration of one head, and what it takes from the weights on the way.
pub struct Continuation {
    options: ContinuationOptions,
    start: ContinuedStart,
    iterations: u32,
    /// L_proj's weight and the paper's `t` at the first iteration.
    initial_alpha: f64,
    initial_min_inliers: f64,
    /// The matrix with its views reweighted, for the relaxation.
    reweighted: Option<DMatrix<f64>>,
    /// Factor on every alpha for the shape of the matrix.
    shape: f64,
    /// Alpha that the consensus asks for.
    consensus_alpha: f64,
    tolerance: f64,
}

impl Continuation {
    /// * `balanced`: 3n x m, columns of unit norm
    pub fn new(
        balanced: &DMatrix<f64>,
        settings: &NetworkSettings,
        start: ContinuedStart,
        options: ContinuationOptions,
    ) -> Self {
        let (rows, columns) = balanced.shape();
        let shape = (columns as f64 / (rows.saturating_sub(RANK).max(1)) as f64 / options.reference_shape).sqrt();
        Self {
            iterations: settings.iterations,
            initial_alpha: settings.alpha,
            initial_min_inliers: settings.min_inliers,
            reweighted: (!start.view_scales.is_empty()).then(|| reweighted(balanced, &start.view_scales)),
            shape: shape.max(1.0),
            consensus_alpha: start.relaxed_alpha,
            tolerance: options.tolerance.0,
            start,
            options,
        }
    }

    /// Of an iteration, counted from 0 as everywhere here.
    pub fn phase(&self, iteration: u32) -> Phase {
        match iteration {
            iteration if iteration < self.rank_start() => Phase::Relaxation,
            iteration if iteration < self.growth_start() => Phase::Rank,
            _ => Phase::Growth,
        }
    }

    /// Whether L_DAQ has a part in an iteration.
    pub fn uses_daq(&self, iteration: u32) -> bool {
        self.phase(iteration) != Phase::Relaxation
    }

    /// Residual (sine of the angle to the span) at which the growth ends.
    pub fn tolerance(&self) -> f64 {
        self.tolerance
    }

    /// First iteration after the relaxation.
    fn rank_start(&self) -> u32 {
        (f64::from(self.iterations) * self.options.relaxation_end).ceil() as u32
    }

    fn growth_start(&self) -> u32 {
        self.rank_start().max((f64::from(self.iterations) * self.options.growth_start) as u32)
    }

    /// First iteration of the second half of the growth.
    fn second_growth_start(&self) -> u32 {
        let half = f64::from(self.iterations) * 0.5 * (1.0 + self.options.growth_start);
        self.growth_start().max(half as u32)
    }

    /// Takes from the consensus what the phase that begins with an iteration needs.
    ///
    /// * `weights`: one a column of `balanced`, those that the iteration sees
    ///
    /// # Errors
    /// [`Error::NoDecomposition`] when the matrix overflows.
    pub fn begin_phases(&mut self, iteration: u32, balanced: &DMatrix<f64>, weights: &[f64]) -> Result<(), Error> {
        if iteration == self.rank_start() {
            self.consensus_alpha = self.alpha_of_consensus(balanced, weights)?;
        }
        if iteration == self.growth_start() {
            self.tolerance = self.tolerance_of_consensus(self.options.first_gate_factor, balanced, weights);
        }
        if iteration == self.second_growth_start() {
            self.tolerance = self.tolerance_of_consensus(1.0, balanced, weights);
        }
        Ok(())
    }

    /// The matrix, weight and kind of L_proj of an iteration.
    pub fn rank_term<'a>(&'a self, iteration: u32, balanced: &'a DMatrix<f64>) -> (&'a DMatrix<f64>, f64, RankTerm) {
        match self.phase(iteration) {
            Phase::Relaxation => {
                let q = self.relaxed(iteration);
                let alpha = self.initial_alpha * (self.start.relaxed_alpha / self.initial_alpha).powf(q);
                let matrix = self.reweighted.as_ref().unwrap_or(balanced);
                (matrix, self.shape * alpha, RankTerm::SingularValues { leading: 1.0 - q })
            }
            Phase::Rank => {
                let past = self.share(iteration) - self.options.relaxation_end;
                let ramp = (past / self.options.alpha_ramp).clamp(0.0, 1.0);
                let from = self.start.relaxed_alpha;
                let alpha = from * (self.consensus_alpha / from).powf(ramp);
                (balanced, self.shape * alpha, RankTerm::TAIL)
            }
            Phase::Growth => (balanced, self.tolerance.powi(-2), RankTerm::Energy),
        }
    }

    /// Share of the iterations that is done.
    fn share(&self, iteration: u32) -> f64 {
        f64::from(iteration) / f64::from(self.iterations)
    }

    /// Share of the relaxation that is done, q.
    fn relaxed(&self, iteration: u32) -> f64 {
        (self.share(iteration) / self.options.relaxation_end).min(1.0)
    }

    /// The paper's `t` of an iteration.
    pub fn min_inliers(&self, iteration: u32) -> f64 {
        self.initial_min_inliers * self.options.final_min_inliers.powf(self.relaxed(iteration))
    }

    /// The alpha, at the reference shape, under which a track of the consensus costs what the options say.
    fn alpha_of_consensus(&self, balanced: &DMatrix<f64>, weights: &[f64]) -> Result<f64, Error> {
        let largest = weights.iter().copied().fold(0.0, f64::max);
        let near = |w: &&f64| **w > self.options.consensus_share * largest;
        let count = weights.iter().filter(near).count().max(self.options.least_consensus);
        let mut ranked: Vec<usize> = (0..weights.len()).collect();
        ranked.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]));
        ranked.truncate(count);
        let consensus = balanced.select_columns(&ranked);
        let tail = losses::rank_term(&consensus, &vec![1.0; ranked.len()], RankTerm::TAIL)?.0 / ranked.len() as f64;
        let alpha = self.options.cost_per_track / (tail * self.shape);
        Ok(alpha.clamp(self.start.least_alpha, self.options.most_alpha))
    }

    /// Residuals, in units of the measured noise, at which a track leaves the consensus: in any case, and as far as the
    /// consensus stands apart from wrong tracks.
    ///
    /// * `rows`: of the matrix
    /// * `kept`: tracks of the consensus
    fn gates(&self, rows: usize, kept: usize) -> (f64, f64) {
        let options = &self.options;
        if self.start.has_depths {
            let freedom = rows.saturating_sub(RANK).max(1) as f64;
            let gate = (chi_square_gate(freedom) / chi_square_median(freedom)).sqrt().max(options.least_gate);
            return (gate, gate);
        }
        let gate = options.gate_without_depths;
        (gate, gate + options.gate_per_decade * (kept as f64 / options.gate_tracks).log10().max(0.0))
    }

    /// The residual at which growth ends: so many standard deviations of the consensus' own, its degrees of freedom
    /// counted, and more where it stands apart from wrong tracks all the same, but no more than a share of what these
    /// leave. Above that they are worth their cost, and all of them may join.
    ///
    /// * `factor`: multiplies the gates
    /// * `balanced`: 3n x m
    /// * `weights`: one a column
    fn tolerance_of_consensus(&self, factor: f64, balanced: &DMatrix<f64>, weights: &[f64]) -> f64 {
        let (least, most) = self.options.tolerance;
        let kept: Vec<usize> = (0..weights.len()).filter(|&j| weights[j] > THRESHOLD).collect();
        if kept.len() <= RANK {
            return least;
        }
        let consensus = balanced.select_columns(&kept);
        let Some(basis) = dominant_subspace(&consensus, RANK) else { return least };
        let mut squared: Vec<f64> = subspace_residuals(&consensus, &basis).iter().map(|r| r.powi(2)).collect();
        let freedom = (kept.len() - RANK) as f64 / kept.len() as f64;
        let noise = (midpoint_median(&mut squared) / freedom).sqrt();
        let of_wrong = wrong_residual(balanced, weights, &basis);
        let (gate, apart) = self.gates(balanced.nrows(), kept.len());
        let tolerance = (factor * gate * noise).max((factor * apart * noise).min(self.options.separation * of_wrong));
        tolerance.min(most).min(self.options.wrong_share * of_wrong).max(least)
    }
}

/// What wrong tracks leave beside the span of a consensus: the median residual of the tracks that are not in it, or of
/// its own with their observations mismatched, whichever is less.
///
/// The mismatched columns take each view from another track of the consensus, as far apart in its order as its size
/// allows. Where all is kept, or nearly all, they are what there is to compare with: beside the span of wrong tracks
/// they leave as much as the tracks themselves.
///
/// * `balanced`: 3n x m
/// * `weights`: one a column; above [`THRESHOLD`] it is in the consensus
/// * `basis`: of the consensus' span, orthonormal, 3n x 4
pub fn wrong_residual(balanced: &DMatrix<f64>, weights: &[f64], basis: &DMatrix<f64>) -> f64 {
    let (kept, others): (Vec<usize>, Vec<usize>) = (0..weights.len()).partition(|&j| weights[j] > THRESHOLD);
    let consensus = balanced.select_columns(&kept);
    let count = consensus.ncols();
    // Neighbours in the caller's order may be neighbours in the image, so the views are spread over the whole
    // consensus.
    let stride = (count / (balanced.nrows() / 3).max(1)).max(1);
    let mismatched =
        DMatrix::from_fn(balanced.nrows(), count, |row, j| consensus[(row, (j + row / 3 * stride) % count)]);
    let left = |columns: &DMatrix<f64>| midpoint_median(&mut subspace_residuals(columns, basis));
    let of_mismatched = left(&mismatched);
    if others.is_empty() { of_mismatched } else { of_mismatched.min(left(&balanced.select_columns(&others))) }
}

/// The matrix with each view's rows multiplied by its factor, columns at unit norm again.
fn reweighted(balanced: &DMatrix<f64>, view_scales: &[f64]) -> DMatrix<f64> {
    let mut matrix = balanced.clone();
    for (view, scale) in view_scales.iter().enumerate() {
        let mut rows = matrix.rows_mut(3 * view, 3);
        rows *= *scale;
    }
    for mut column in matrix.column_iter_mut() {
        let norm = column.norm();
        if norm > f64::MIN_POSITIVE {
            column /= norm;
        }
    }
    matrix
}
