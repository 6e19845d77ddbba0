//! How well the intrinsics of one group are determined, everything else marginalised.

use nalgebra::{SMatrix, SVector};

use super::super::Loss;
use super::super::metric::{Information, IntrinsicsModel, IntrinsicsPrior, Parameter};
use super::layout::Layout;
use super::minimise::pattern;
use super::normal::Normal;
use super::pattern::Pattern;
use super::reduced::Reduced;
use super::solver::SparseCholesky;
use super::{Free, Pace, Sequence, Sighting};
use crate::domain::StopToken;

const PARAMETERS: usize = Parameter::COUNT;
/// Dampings of the eliminated unknowns that are tried, as shares of their diagonal: the least that keeps the gauge's
/// directions positive. Refinement takes its effect on the others away.
const DAMPINGS: [f64; 4] = [1e-13, 1e-12, 1e-11, 1e-10];
/// Rounds of refinement: each takes a direction's error down by the share of the damping in it.
const REFINEMENTS: usize = 2;

/// What the observations say of all the intrinsics of one group together, at this state: poses, points and what `free`
/// frees of the other groups marginalised, the latter with what `priors` know of them.
///
/// What `free` says of the group itself is ignored, and its own prior is left to [`Information::optimum`]. Views that
/// are held count as known. For observations of weight 1 with unit variance.
///
/// Returns `None` where the group is out of range, no free pose or group sees anything, the system holds what is no
/// number, or it was stopped.
pub fn information(
    sequence: &Sequence,
    sightings: &[Sighting],
    group: usize,
    free: &Free,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
) -> Option<Information> {
    let intrinsics = *sequence.intrinsics.get(group)?;
    let mut models: Vec<IntrinsicsModel> = (0..sequence.intrinsics.len())
        .map(|other| free.models.get(other).copied().unwrap_or(IntrinsicsModel::FIXED))
        .collect();
    models[group] = IntrinsicsModel::FULL;
    let mut priors = priors.to_vec();
    if let Some(own) = priors.get_mut(group) {
        *own = IntrinsicsPrior::NONE;
    }
    let mut pace = Pace::new(stop);
    let free = Free { models: &models, ..*free };
    let layout = Layout::new(sequence, sightings, &free, Some(group), &mut pace)?;
    let whole = pattern(sequence, &layout, &mut pace)?;
    let mut normal = Normal::new(&layout, &whole, sequence);
    let mut reduced = Reduced::new(&layout, whole);
    let built = normal.fill(sequence, &layout, &priors, Loss::Squared, &mut pace)
        && reduced.build(&layout, &normal, 0.0, &mut pace);
    if !built {
        return None;
    }
    let eliminated = reduced.pattern.dimension() - PARAMETERS;
    let mut known = normal.cameras.diagonal.iter().map(|index| normal.cameras.values[*index]);
    let scales: Vec<f64> = known.by_ref().take(eliminated).collect();
    let known: Vec<f64> = known.collect();
    let (matrix, pull) = Split::new(&reduced, eliminated).eliminate(&scales)?;
    Information::assembled(intrinsics, matrix, pull, known.try_into().ok()?)
}

/// The reduced system in two: what is to be eliminated, and the intrinsics of the group at its end.
struct Split {
    pattern: Pattern,
    values: Vec<f64>,
    /// Couplings with the group's parameters, one after the other, and the right-hand side.
    columns: Vec<f64>,
    matrix: SMatrix<f64, PARAMETERS, PARAMETERS>,
    pull: SVector<f64, PARAMETERS>,
}

impl Split {
    fn new(reduced: &Reduced, eliminated: usize) -> Self {
        let mut matrix = SMatrix::zeros();
        let mut values = Vec::with_capacity(reduced.values.len());
        let mut columns = vec![0.0; eliminated * (PARAMETERS + 1)];
        columns[eliminated * PARAMETERS..].copy_from_slice(&reduced.vector[..eliminated]);
        reduced.pattern.for_each(|row, column, index| {
            let value = reduced.values[index];
            match (row.checked_sub(eliminated), column.checked_sub(eliminated)) {
                // In the order in which the pattern without the last block has them.
                (None, _) => values.push(value),
                (Some(row), None) => columns[row * eliminated + column] = value,
                (Some(row), Some(column)) => matrix[(row, column)] = value,
            }
        });
        let pull = SVector::from_column_slice(&reduced.vector[eliminated..]);
        Self { pattern: reduced.pattern.without_last(), values, columns, matrix, pull }
    }

    /// What is left of the group's information and pull.
    ///
    /// * `scales`: information on each eliminated unknown with everything else known
    fn eliminate(&self, scales: &[f64]) -> Option<(SMatrix<f64, PARAMETERS, PARAMETERS>, SVector<f64, PARAMETERS>)> {
        let n = scales.len();
        let (mut matrix, mut pull) = (self.matrix, self.pull);
        if n > 0 {
            let solved = self.solve(scales)?;
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            for (k, coupling) in self.columns.chunks_exact(n).take(PARAMETERS).enumerate() {
                for (l, solved) in solved.chunks_exact(n).enumerate() {
                    let through = dot(coupling, solved);
                    if l < PARAMETERS { matrix[(k, l)] -= through } else { pull[k] -= through }
                }
            }
        }
        Some((0.5 * (matrix + matrix.transpose()), pull))
    }

    /// The eliminated system's solutions for all columns.
    fn solve(&self, scales: &[f64]) -> Option<Vec<f64>> {
        let n = scales.len();
        let mut cholesky = SparseCholesky::new(&self.pattern, PARAMETERS + 1)?;
        let diagonal = self.pattern.diagonal();
        let factored = DAMPINGS.iter().any(|damping| {
            let mut damped = self.values.clone();
            for (&index, &scale) in diagonal.iter().zip(scales) {
                // Of what has no information at all nothing follows.
                damped[index] += if scale > 0.0 { damping * scale } else { 1.0 };
            }
            cholesky.factor(&damped)
        });
        if !factored {
            return None;
        }
        let mut solution = vec![0.0; self.columns.len()];
        for _ in 0..=REFINEMENTS {
            let mut left = self.columns.clone();
            self.pattern.for_each(|row, column, index| {
                let value = self.values[index];
                for first in (0..left.len()).step_by(n) {
                    if row >= column {
                        left[first + row] -= value * solution[first + column];
                    }
                    if row > column {
                        left[first + column] -= value * solution[first + row];
                    }
                }
            });
            cholesky.solve(&mut left);
            solution.iter_mut().zip(&left).for_each(|(sum, value)| *sum += value);
        }
        Some(solution)
    }
}
