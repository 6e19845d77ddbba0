//! Learning without labels: the paper's L_num and L_proj (its eq. 11), each scene's own, summed over many scenes.
//!
//! The weights of a scene's tracks are the sigmoids of their logits; the matrix is what the network itself made of the
//! tracks: places in units of their view's spread, times the projective depths of its last block, holes filled.
//! Derivatives are exact ([`rank_terms`]) and reach the network through the weights; the matrix counts as given, for
//! the depths and the filled holes could otherwise be bent until wrong tracks fit.
//!
//! # What comes of it
//! After 200, 400 and 600 steps (`train-prior --unlabelled --seed 0 --steps 600`) the average precision on unseen
//! scenes is .884, .892 and .890; with labels, .956, .968 and .965 (the same steps of `train-prior --seed 0 --steps
//! 7000`, which ends at .971). In the search (`evaluate --priors --prior FILE --scenes outliers --seeds 20`) it ranks
//! with .999 at 95 % outliers (labels: 1.000), where 600 samples suffice with either. At 97 % it ranks with .988, and
//! 600, 6,000 and 60,000 samples alone reach a mean F1 of .353, .407 and .407; labels were not measured beside it
//! there. L_num asks for the same number of tracks of every scene, also of those with fewer right ones: they are most
//! of the loss (2,557 of it, L_proj .9, after 400 steps).
//!
//! L_DAQ has no part in it: it needs coordinates in which the principal point is known, and a scene's points come with
//! any origin. Observations have no loss of their own, so a network that learned this way ranks tracks only.

use burn_tensor::activation::sigmoid;
use burn_tensor::{DType, Tensor};
use nalgebra::DMatrix;

use super::Error;
use super::objective::{Loss, importance};
use super::tape::{Output, constant, numbers};
use crate::network::NetworkSettings;
use crate::network::losses::{CountTerm, RankTerm, rank_term};

/// Slope of the sigmoid in L_num: the paper's 1 lets all weights collapse to 0, 20 to 50 do not.
const KAPPA: f64 = 20.0;

/// The loss of what the network said; its parts are L_num and L_proj by the last block, means over the scenes.
///
/// # Errors
/// [`Error::Backend`] for a defect of burn; [`Error::NoDecomposition`] for columns that are not finite.
pub fn loss(output: Output, dtype: DType) -> Result<Loss, Error> {
    let NetworkSettings { alpha, min_inliers, .. } = NetworkSettings::default();
    let count = CountTerm::Sigmoid { min_inliers, kappa: KAPPA };
    let matrices = matrices(&output.columns)?;
    let device = output.columns.device();
    let blocks = output.tracks.len();
    let scalar = |value: f64| constant::<1>(vec![value], [1], dtype, &device);
    let (mut total, mut parts) = (scalar(0.0), [0.0; 2]);
    for (block, logits) in output.tracks.into_iter().enumerate() {
        let weights = sigmoid(logits);
        let [scenes, _, tracks] = weights.dims();
        let share = 1.0 / scenes as f64;
        let values = numbers(weights.clone())?;
        let mut slopes = Vec::with_capacity(values.len());
        parts = [0.0; 2];
        for (matrix, w) in matrices.iter().zip(values.chunks_exact(tracks)) {
            let (num, grad_num) = count.evaluate(w);
            let (proj, grad_proj) = rank_term(matrix, w, RankTerm::TAIL).map_err(|_| Error::NoDecomposition)?;
            parts = [parts[0] + share * num, parts[1] + share * proj];
            let both = grad_num.iter().zip(&grad_proj);
            slopes.extend(both.map(|(num, proj)| share * (num + alpha * proj)));
        }
        // A plane through the loss: its value and its slope, which is all that a step takes.
        let offset = parts[0] + alpha * parts[1] - values.iter().zip(&slopes).map(|(w, slope)| w * slope).sum::<f64>();
        let slopes = constant(slopes, [scenes, 1, tracks], dtype, &device);
        total = total + ((weights * slopes).sum() + scalar(offset)).mul_scalar(importance(block, blocks));
    }
    Ok(Loss { total, parts: parts.map(scalar) })
}

/// Every scene's matrix, 3n x m, columns of unit norm; their views have comparable energy by their own units.
fn matrices(columns: &Tensor<4>) -> Result<Vec<DMatrix<f64>>, Error> {
    let [_, views, _, tracks] = columns.dims();
    let rows = 3 * views;
    let of_scene = |values: &[f64]| {
        let mut matrix = DMatrix::from_row_slice(rows, tracks, values);
        // The third coordinate of a column is its depth, of mean 1: none has length 0.
        matrix.column_iter_mut().for_each(|mut column| {
            column.normalize_mut();
        });
        matrix
    };
    Ok(numbers(columns.clone())?.chunks_exact(rows * tracks).map(of_scene).collect())
}
