//! Finite differences of every kind of term, and the norms that they are.

use nalgebra::DMatrix;

use super::*;
use crate::network::tests::{balanced_matrix, contaminated_scene, random_weights};

const STEP: f64 = 1e-5;
const LOG_FOCAL: f64 = 0.3;
const PLANE: [f64; 3] = [0.2, -0.1, 0.3];
const TERMS: [RankTerm; 4] = [
    RankTerm::SingularValues { leading: 1.0 },
    RankTerm::SingularValues { leading: 0.4 },
    RankTerm::SingularValues { leading: 0.0 },
    RankTerm::Energy,
];

/// 40 columns of 5 views, 30 % of them wrong, with weights spread over [0.05, 0.95].
fn point(seed: u64) -> (DMatrix<f64>, Vec<f64>) {
    (balanced_matrix(&contaminated_scene(5, 40, 0.3, seed)), random_weights(40, seed))
}

/// On the tangent or before it.
fn at(matrix: &DMatrix<f64>, w: &[f64], min_inliers: f64, rank: RankTerm) -> Evaluation {
    let terms = Terms { count: CountTerm::Tangent { min_inliers }, rank, daq_moves_weights: false };
    evaluate(matrix, w, LOG_FOCAL, PLANE, terms).expect("a finite matrix")
}

/// Central difference of a function around 0.
fn slope(at: impl Fn(f64) -> f64) -> f64 {
    (at(STEP) - at(-STEP)) / (2.0 * STEP)
}

/// `N` is about 20: a `t` of 25 is on the exponential, one of 15 on the tangent.
#[test]
fn derivatives_match_finite_differences() {
    for (seed, term) in TERMS.into_iter().enumerate() {
        let (matrix, w) = point(seed as u64);
        for t in [15.0, 25.0] {
            let exact = at(&matrix, &w, t, term);
            let largest = exact.grad_w_proj.iter().fold(0.0f64, |largest, entry| largest.max(entry.abs()));
            for column in 0..w.len() {
                let moved = |offset: f64| {
                    let mut w = w.clone();
                    w[column] += offset;
                    at(&matrix, &w, t, term).losses
                };
                let (num, proj) = (slope(|x| moved(x).num), slope(|x| moved(x).proj));
                assert!((exact.grad_w_num[column] / num - 1.0).abs() < 1e-6, "L_num, t {t}, column {column}: {num}");
                assert!((exact.grad_w_proj[column] - proj).abs() < 1e-6 * largest, "{term:?}, column {column}");
            }
        }
    }
}

/// L_num and its derivative have no jump at t.
#[test]
fn the_tangent_meets_the_exponential() {
    let (matrix, w) = point(1);
    let count: f64 = w.iter().sum();
    let at = |t| at(&matrix, &w, t, TERMS[0]);
    let (above, below) = (at(count + 1e-9), at(count - 1e-9));
    assert!((above.losses.num - 1.0).abs() < 1e-8 && (below.losses.num - 1.0).abs() < 1e-8);
    assert!((above.grad_w_num[0] + 1.0).abs() < 1e-8 && below.grad_w_num[0] == -1.0);
    assert!((at(count - 30.0).losses.num + 29.0).abs() < 1e-9, "it falls on with every further track");
}

/// At the start of the relaxation L_proj is the nuclear norm, at its end the paper's; the energy is eq. 8's distance.
#[test]
fn the_ends_of_the_continuation_are_known_norms() {
    let (matrix, w) = point(2);
    let proj = |term| at(&matrix, &w, 15.0, term).losses.proj;
    let mut weighted = matrix.clone();
    weighted.column_iter_mut().zip(&w).for_each(|(mut column, w)| column *= *w);
    let sigma = weighted.singular_values();
    assert!((proj(TERMS[0]) - sigma.sum()).abs() < 1e-6, "{} {}", proj(TERMS[0]), sigma.sum());
    let tail: f64 = sigma.iter().skip(4).sum();
    assert!((proj(TERMS[2]) - tail).abs() < 1e-6, "{} {tail}", proj(TERMS[2]));
    let tail: f64 = sigma.iter().skip(4).map(|sigma| sigma * sigma).sum();
    assert!((proj(TERMS[3]) - tail).abs() < 1e-12, "{} {tail}", proj(TERMS[3]));
}
