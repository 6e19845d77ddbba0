//! Finite differences of every derivative, on scenes with noise and outliers.

use nalgebra::{DMatrix, DVector, Matrix3};

use super::*;
use crate::network::tests::{balanced_matrix, contaminated_scene, random_weights};
use crate::synthetic::scene::IMAGE_SIDE_PX;
use crate::synthetic::{Scene, SceneOptions, Truth};

const TERMS: Terms = Terms {
    count: CountTerm::Sigmoid { min_inliers: 15.0, kappa: 20.0 },
    rank: RankTerm::TAIL,
    daq_moves_weights: true,
};
/// Step of the central differences: their own error is then about 1e-9 of the second derivative's scale.
const STEP: f64 = 1e-5;

/// A point of the loss in general position.
struct Point {
    balanced: DMatrix<f64>,
    w: Vec<f64>,
    log_focal: f64,
    n_inf: [f64; 3],
}

impl Point {
    /// Weights spread over [0.05, 0.95] in a scene where 30 % of 40 tracks in 5 views are outliers.
    fn general(seed: u64) -> Self {
        let balanced = balanced_matrix(&contaminated_scene(5, 40, 0.3, seed));
        Self { balanced, w: random_weights(40, seed), log_focal: 0.3, n_inf: [0.2, -0.1, 0.3] }
    }

    fn evaluate(&self) -> Evaluation {
        evaluate(&self.balanced, &self.w, self.log_focal, self.n_inf, TERMS).expect("a finite matrix")
    }

    /// Central differences of a loss in every weight.
    fn differences(&mut self, loss: impl Fn(&Losses) -> f64) -> Vec<f64> {
        let columns = self.w.len();
        let difference = |column: usize| {
            let original = self.w[column];
            let mut at = |offset: f64| {
                self.w[column] = original + offset;
                loss(&self.evaluate().losses)
            };
            let slope = (at(STEP) - at(-STEP)) / (2.0 * STEP);
            self.w[column] = original;
            slope
        };
        (0..columns).map(difference).collect()
    }
}

/// Largest deviation as a share of the largest entry.
fn deviation(found: &[f64], expected: &[f64]) -> f64 {
    let largest = expected.iter().fold(0.0f64, |largest, entry| largest.max(entry.abs()));
    assert!(largest > 1e-6, "a gradient of zeros proves nothing");
    found.iter().zip(expected).fold(0.0f64, |worst, (a, b)| worst.max((a - b).abs())) / largest
}

#[test]
fn derivatives_by_the_weights_match_finite_differences() {
    for seed in 0..3 {
        let mut point = Point::general(seed);
        let exact = point.evaluate();
        let num = deviation(&exact.grad_w_num, &point.differences(|losses| losses.num));
        let proj = deviation(&exact.grad_w_proj, &point.differences(|losses| losses.proj));
        let daq = deviation(&exact.grad_w_daq, &point.differences(|losses| losses.daq));
        assert!(num < 1e-6, "seed {seed}: L_num off by {num:e}");
        assert!(proj < 1e-6, "seed {seed}: L_proj off by {proj:e}");
        assert!(daq < 1e-5, "seed {seed}: L_DAQ off by {daq:e}");
    }
}

#[test]
fn derivatives_by_the_calibration_match_finite_differences() {
    for seed in 0..3 {
        let mut point = Point::general(seed);
        let exact = point.evaluate();
        let mut daq_at = |offset: [f64; 4]| {
            let (log_focal, n_inf) = (point.log_focal, point.n_inf);
            point.log_focal += offset[0];
            for axis in 0..3 {
                point.n_inf[axis] += offset[axis + 1];
            }
            let value = point.evaluate().losses.daq;
            (point.log_focal, point.n_inf) = (log_focal, n_inf);
            value
        };
        let slopes: Vec<f64> = (0..4)
            .map(|k| {
                let along = |step: f64| std::array::from_fn(|axis| if axis == k { step } else { 0.0 });
                (daq_at(along(STEP)) - daq_at(along(-STEP))) / (2.0 * STEP)
            })
            .collect();
        let focal = deviation(&[exact.grad_log_focal], &slopes[..1]);
        let plane = deviation(&exact.grad_n_inf, &slopes[1..]);
        assert!(focal < 1e-6, "seed {seed}: log f off by {focal:e}");
        assert!(plane < 1e-6, "seed {seed}: n_inf off by {plane:e}");
    }
}

/// In a scene without noise and outliers the matrix has rank 4, and the residual vanishes at the true calibration and
/// at no other focal length.
#[test]
fn the_truth_is_a_zero_of_proj_and_daq() {
    let options = SceneOptions { views: 6, tracks: 30, noise: 0.0, outliers: 0.0, ..SceneOptions::default() };
    for seed in 0..3 {
        let options = SceneOptions { with_depths: true, seed, ..options.clone() };
        let scene = Scene::generate(&options).expect("valid options");
        let balanced = balanced_matrix(&scene);
        let w = [1.0; 30];
        let log_focal = (scene.truth.focal_px / f64::from(IMAGE_SIDE_PX)).ln();
        let cameras = gauge::CanonicalCameras::of(Spectrum::of(&balanced, &w).expect("finite").span());
        let n_inf = true_plane_at_infinity(&cameras, &scene.truth, log_focal.exp());
        let at = |log_focal: f64| evaluate(&balanced, &w, log_focal, n_inf, TERMS).expect("finite").losses;
        let truth = at(log_focal);
        assert!(truth.num < 1e-6, "30 inliers are more than 15: {}", truth.num);
        assert!(truth.proj < 1e-3, "seed {seed}: L_proj {}", truth.proj);
        assert!(truth.daq < 1e-3, "seed {seed}: L_DAQ {}", truth.daq);
        for wrong in [-0.1, 0.1] {
            assert!(at(log_focal + wrong).daq > 0.02, "seed {seed}: L_DAQ {} at {wrong}", at(log_focal + wrong).daq);
        }
    }
}

/// The n of `A_i - a_i nᵀ = s_i K R_i K⁻¹` over all views, R_i relative to the first: linear in n and the s_i.
fn true_plane_at_infinity(cameras: &gauge::CanonicalCameras, truth: &Truth, focal: f64) -> [f64; 3] {
    let views = cameras.rotational().len();
    let rotation = |view: usize| Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
    let k = Matrix3::from_diagonal(&Vector3::new(focal, focal, 1.0));
    let inverse = Matrix3::from_diagonal(&Vector3::new(1.0 / focal, 1.0 / focal, 1.0));
    let (mut system, mut right) = (DMatrix::zeros(9 * views, 3 + views), DVector::zeros(9 * views));
    for view in 0..views {
        let homography = k * rotation(view) * rotation(0).transpose() * inverse;
        for (entry, (row, column)) in (0..9).map(|entry| (9 * view + entry, (entry / 3, entry % 3))) {
            system[(entry, column)] = cameras.translational(view)[row];
            system[(entry, 3 + view)] = homography[(row, column)];
            right[entry] = cameras.rotational()[view][(row, column)];
        }
    }
    let solution = system.svd(true, true).solve(&right, 1e-12).expect("both factors were asked for");
    [0, 1, 2].map(|axis| solution[axis])
}

/// An exponent beyond what f32 can hold is capped, and still pushes the weights up.
#[test]
fn collapsed_weights_are_pushed_up() {
    let balanced = balanced_matrix(&contaminated_scene(5, 40, 0.3, 2));
    let terms = Terms { count: CountTerm::Sigmoid { min_inliers: 500.0, kappa: 20.0 }, ..TERMS };
    let evaluation = evaluate(&balanced, &[0.4; 40], 0.0, [0.0; 3], terms).expect("a finite matrix");
    assert_eq!(evaluation.losses.num, count::MAX_EXPONENT.exp());
    assert!(evaluation.grad_w_num.iter().all(|&gradient| gradient < -1.0 && (gradient as f32).is_finite()));
}

/// Weights that vanish, columns of zeros, fewer columns than rows: values and derivatives stay finite.
#[test]
fn degenerate_input_gives_finite_numbers() {
    let finite = |evaluation: &Evaluation| {
        let losses = evaluation.losses;
        [losses.num, losses.proj, losses.daq, evaluation.grad_log_focal]
            .iter()
            .chain(&evaluation.grad_n_inf)
            .chain(&evaluation.grad_w_num)
            .chain(&evaluation.grad_w_proj)
            .chain(&evaluation.grad_w_daq)
            .all(|value| value.is_finite())
    };
    let mut balanced = balanced_matrix(&contaminated_scene(5, 7, 0.0, 3));
    balanced.column_mut(2).fill(0.0);
    let weights = [vec![0.0; 7], vec![1.0; 7], vec![1e-160; 7], vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]];
    for w in weights {
        let evaluation = evaluate(&balanced, &w, 0.4, [0.1; 3], TERMS).expect("a finite matrix");
        assert!(finite(&evaluation), "weights {w:?}: {evaluation:?}");
    }
    balanced.fill(0.0);
    assert!(finite(&evaluate(&balanced, &[0.5; 7], 0.4, [0.1; 3], TERMS).expect("a finite matrix")));
    balanced.fill(1e200);
    let error = evaluate(&balanced, &[0.5; 7], 0.4, [0.1; 3], TERMS).expect_err("the scatter overflows");
    assert_eq!(error, Error::NoDecomposition { rows: 15 });
}
