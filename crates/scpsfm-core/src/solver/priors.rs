//! Geometric priors: which tracks look right before any hypothesis stands.
//!
//! A prior is a non-negative weight per track, larger where the track is more likely right; only ratios matter.

use nalgebra::{DMatrix, DVector};

use crate::domain::StopToken;
use crate::geometry::factorization::{dominant_eigenvectors, dominant_subspace, subspace_residuals};
use crate::geometry::statistics::median;

options! {
    /// How tracks are weighed.
    pub struct PriorOptions {
        /// Power that turns the consistency of a track into a sampling weight.
        consistency_power: i32 = 4,
        /// Least weight, so that no track is excluded by a prior alone. A round that changes no weight by as much is
        /// the last.
        least_weight: f64 = 1e-6,
        /// The same of the network's weights. A track the network has given up is still drawn now and then.
        network_floor: f64 = 1e-3,
        /// Rounds of reweighting.
        irls_rounds: usize = 60,
        /// Floor of the residual scale at the start and at the end of the annealing (sines of angles).
        irls_floors: (f64, f64) = (0.3, 1e-3),
        /// Share of the rounds over which the floor is lowered.
        irls_annealing: f64 = 0.7,
        /// Shrinking of the residual scale a round without depths, and where all that is asked is whether many agree, a
        /// second body say. From a view's spread to the floor in the first half of the rounds.
        affine_shrink: f64 = 0.88,
        /// The usual pace of graduated non-convexity (Yang, Antonante, Tzoumas & Carlone 2020: 1.4 a round). Of forty
        /// scenes with a second body and forty without, the same are told apart as at the slow pace (a test), in half
        /// the rounds.
        affine_shrink_of_many: f64 = 1.0 / 1.4,
        /// Floor of the residual without depths, in units of a view's spread. What perspective adds to right tracks at
        /// moderate depths.
        affine_floor: f64 = 0.08,
        /// Weight from which a track agrees with the subspace. Its residual is within the scale of the round.
        affine_agrees: f64 = 0.25,
        /// Squared floors below which a scale tells who will agree. The tracks that do hold the subspace, others never
        /// did join them later.
        clear_floors: f64 = 16.0,
    }
}

const OPTIONS: PriorOptions = PriorOptions::DEFAULT;

/// Consistency of the tracks' motion: `|mean_i z_ij|^2 / mean_i |z_ij|^2`, to the fourth power, with z the blocks of
/// `rows_per_view` coordinates of a matrix whose views are centred.
///
/// 1 for a track at the same centred place in all views, about 1/n for one that jumps. Good for small rotations only:
/// in an orbit right tracks wander too.
pub fn consistency(centred: &DMatrix<f64>, rows_per_view: usize) -> Vec<f64> {
    let views = centred.nrows() / rows_per_view;
    centred
        .column_iter()
        .map(|column| {
            let mean_squared: f64 = (0..rows_per_view)
                .map(|row| {
                    let mean = (0..views).map(|view| column[rows_per_view * view + row]).sum::<f64>() / views as f64;
                    mean * mean
                })
                .sum();
            let energy = column.norm_squared() / views as f64;
            let share = if energy > f64::MIN_POSITIVE { mean_squared / energy } else { 0.0 };
            share.powi(OPTIONS.consistency_power) + OPTIONS.least_weight
        })
        .collect()
}

/// Iteratively reweighted least squares on the dominant subspace, least sum of unsquared residuals
/// (Lerman & Maunu 2018, fast median subspace), with annealed floor: weights `1 / max(r, floor)`.
///
/// * `matrix`: d x m, columns of comparable norm
/// * `rank`: dimension of the subspace
///
/// Returns the inverse squared residuals under the last subspace; `None` when a decomposition fails or `stop` fires.
pub fn irls(matrix: &DMatrix<f64>, rank: usize, stop: &StopToken) -> Option<Vec<f64>> {
    let mut weights = vec![1.0f64; matrix.ncols()];
    let mut residuals = vec![1.0; matrix.ncols()];
    for round in 0..OPTIONS.irls_rounds {
        if stop.is_stopped() {
            return None;
        }
        let mut weighted = matrix.clone();
        for (mut column, weight) in weighted.column_iter_mut().zip(&weights) {
            column *= weight.sqrt();
        }
        let basis = dominant_subspace(&weighted, rank)?;
        residuals = subspace_residuals(matrix, &basis);
        let annealed = round as f64 / (OPTIONS.irls_rounds as f64 * OPTIONS.irls_annealing);
        let floor = (OPTIONS.irls_floors.0 * (OPTIONS.irls_floors.1 / OPTIONS.irls_floors.0).powf(annealed))
            .max(OPTIONS.irls_floors.1);
        for (weight, residual) in weights.iter_mut().zip(&residuals) {
            *weight = 1.0 / residual.max(floor);
        }
    }
    Some(residuals.iter().map(|residual| 1.0 / residual.max(OPTIONS.irls_floors.1).powi(2)).collect())
}

/// Dimension of what right tracks span under affine cameras, about their mean.
const AFFINE_RANK: usize = 3;

/// The same idea for image points without depths: a rank-3 affine subspace of the centred coordinates (2n x m) under
/// graduated Geman-McClure weights. The floor is wide: perspective makes right tracks deviate from affine.
///
/// * `centred`: 2n x m
/// * `least`: tracks that must agree: the scale shrinks faster ([`PriorOptions::affine_shrink_of_many`]) and the search
///   ends early; 0: no such condition
///
/// Returns the weights of the last round; `None` when a decomposition fails or `stop` fires, or as soon as it is clear
/// that fewer tracks will agree.
pub fn affine_irls(centred: &DMatrix<f64>, least: usize, stop: &StopToken) -> Option<Vec<f64>> {
    let shrink = if least > 0 { OPTIONS.affine_shrink_of_many } else { OPTIONS.affine_shrink };
    let rows = centred.nrows() as f64;
    let energy: Vec<f64> = centred.column_iter().map(|column| column.norm_squared()).collect();
    let mut weights = DVector::from_element(centred.ncols(), 1.0f64);
    let mut weighted = centred.clone();
    let mut scale = None;
    for _ in 0..OPTIONS.irls_rounds {
        if stop.is_stopped() {
            return None;
        }
        let total = weights.sum();
        let mean = centred * &weights / total;
        for ((mut weighted, column), weight) in weighted.column_iter_mut().zip(centred.column_iter()).zip(&weights) {
            weighted.zip_apply(&column, |scaled, entry| *scaled = weight.sqrt() * entry);
        }
        // About the mean: sum w (y - mean) (y - mean)' = sum w y y' - total mean mean'.
        let mut scatter = &weighted * weighted.transpose();
        scatter.ger(-total, &mean, &mean, 1.0);
        let basis = dominant_eigenvectors(&scatter, AFFINE_RANK)?;
        let (inside, along) = (basis.tr_mul(centred), centred.tr_mul(&mean));
        let (mean_inside, mean_energy) = (basis.tr_mul(&mean), mean.norm_squared());
        let squared: Vec<f64> = inside
            .column_iter()
            .zip(energy.iter().zip(&along))
            .map(|(inside, (energy, along))| {
                let offset = energy - 2.0 * along + mean_energy;
                (offset - (inside - &mean_inside).norm_squared()).max(0.0) / rows
            })
            .collect();
        let floor = OPTIONS.affine_floor.powi(2);
        let next: f64 = match scale {
            None => median(&mut squared.clone()),
            Some(scale) => floor.max(shrink * scale),
        };
        let next = next.max(f64::MIN_POSITIVE);
        let mut moved = 0.0f64;
        for (weight, squared) in weights.iter_mut().zip(&squared) {
            let reweighted = (next / (next + squared)).powi(2);
            moved = moved.max((reweighted - *weight).abs());
            *weight = reweighted;
        }
        if next < OPTIONS.clear_floors * floor && agreeing(weights.as_slice()) < least {
            return None;
        }
        if scale == Some(floor) && moved < OPTIONS.least_weight {
            break;
        }
        scale = Some(next);
    }
    Some(weights.iter().map(|weight| weight + OPTIONS.least_weight).collect())
}

/// Tracks that agree with an affine ranking.
pub fn agreeing(ranking: &[f64]) -> usize {
    ranking.iter().filter(|weight| **weight > OPTIONS.affine_agrees).count()
}

/// The network's weights as a prior, `max(w, 1e-3)^2`.
pub fn from_network(weights: &[f64]) -> Vec<f64> {
    weights.iter().map(|weight| weight.max(OPTIONS.network_floor).powi(2)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Columns in a 3-dimensional subspace, then as many anywhere.
    const HALF: usize = 40;

    fn half_and_half() -> DMatrix<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut random = |rows, columns| DMatrix::from_fn(rows, columns, |_, _| rng.random_range(-1.0..1.0));
        let inside = random(20, 3) * random(3, HALF);
        let mut matrix = random(20, 2 * HALF);
        matrix.columns_mut(0, HALF).copy_from(&inside);
        matrix
    }

    fn separates(prior: &[f64]) {
        let least_right = prior[..HALF].iter().copied().fold(f64::INFINITY, f64::min);
        let most_wrong = prior[HALF..].iter().copied().fold(0.0, f64::max);
        assert!(least_right > most_wrong, "{prior:?}");
    }

    #[test]
    fn reweighting_separates_a_subspace_from_clutter() {
        separates(&irls(&half_and_half(), 3, &StopToken::default()).expect("finite"));
        separates(&affine_irls(&half_and_half(), 0, &StopToken::default()).expect("finite"));
    }

    #[test]
    fn a_track_that_stays_is_consistent_and_one_that_jumps_is_not() {
        let matrix = DMatrix::from_columns(&[
            nalgebra::DVector::from_vec(vec![1.0, 0.5, 1.0, 0.5, 1.0, 0.5]),
            nalgebra::DVector::from_vec(vec![1.0, 0.0, -0.5, 0.9, -0.5, -0.9]),
        ]);
        let prior = consistency(&matrix, 2);
        assert!(prior[0] > 0.99 && prior[1] < 0.01, "{prior:?}");
    }
}
