//! What one head must do.

use super::*;
use crate::domain::Backend;
use crate::geometry::factorization::{RANK, dominant_subspace, subspace_residuals};
use crate::geometry::statistics::midpoint_median;
use crate::network::THRESHOLD;
use crate::network::tests::{balanced_matrix, contaminated_scene};
use crate::synthetic::metrics::agreement;
use crate::synthetic::scene::IMAGE_SIDE_PX;

fn settings(iterations: u32, use_daq: bool, backend: Backend) -> NetworkSettings {
    NetworkSettings { iterations, use_daq, backend, ..NetworkSettings::default() }
}

fn continued(view_scales: Vec<f64>) -> HeadObjective {
    let start = ContinuedStart { view_scales, relaxed_alpha: 14.0, least_alpha: 10.0, has_depths: true };
    HeadObjective::Continued { start, options: ContinuationOptions::DEFAULT }
}

/// By the continued objective, all views alike.
fn head(matrix: &DMatrix<f64>, settings: &NetworkSettings, seed: u64) -> Head {
    Head::new(matrix, settings, seed, continued(Vec::new())).expect("a valid matrix")
}

fn optimised(mut head: Head) -> Head {
    while !head.is_finished() {
        head.step().expect("a step");
    }
    head.update_weights().expect("an output");
    head
}

fn f1(finished: &Head, inlier: &[bool]) -> f64 {
    let kept: Vec<bool> = finished.weights().iter().map(|&w| w > THRESHOLD).collect();
    agreement(&kept, inlier).f1
}

/// Sets of very different sizes, from one head, with nothing told of their number.
#[test]
fn one_head_separates_half_to_ninety_six_in_a_hundred_wrong() {
    for (seed, outliers) in [(0, 0.5), (1, 0.9), (2, 0.96)] {
        let scene = contaminated_scene(10, 200, outliers, seed);
        let matrix = balanced_matrix(&scene);
        let finished = optimised(head(&matrix, &settings(500, true, Backend::Flex), seed));
        let f1 = f1(&finished, &scene.truth.inlier);
        assert!(f1 > 0.99, "F1 {f1} at {outliers}");
        let focal_error = finished.focal() * f64::from(IMAGE_SIDE_PX) / scene.truth.focal_px - 1.0;
        assert!(focal_error.abs() < 0.05, "focal length off by {focal_error} at {outliers}");
    }
}

#[test]
fn phases_follow_each_other() {
    let matrix = balanced_matrix(&contaminated_scene(5, 60, 0.7, 1));
    let mut head = head(&matrix, &settings(50, true, Backend::Flex), 0);
    let phases: Vec<Phase> = (0..50).map(|_| head.step().expect("a step").phase.expect("continued")).collect();
    let of = |phase| phases.iter().filter(|&&other| other == phase).count();
    assert_eq!((of(Phase::Relaxation), of(Phase::Rank), of(Phase::Growth)), (30, 10, 10));
    assert!(phases.is_sorted_by_key(|phase| *phase as u8) && head.is_finished());
    // Fewer iterations than phases.
    for iterations in 1..6 {
        let finished = optimised(self::head(&matrix, &settings(iterations, true, Backend::Flex), 0));
        assert!(finished.weights().iter().all(|w| (0.0..=1.0).contains(w)));
    }
}

/// L_DAQ moves the calibration after the relaxation and has no part before, and never without the setting.
#[test]
fn daq_moves_the_calibration_after_the_relaxation_only() {
    let matrix = balanced_matrix(&contaminated_scene(5, 60, 0.7, 1));
    let of = |use_daq| head(&matrix, &settings(50, use_daq, Backend::Flex), 0);
    let (mut with, mut without) = (of(true), of(false));
    let initial = with.focal();
    for _ in 0..30 {
        with.step().expect("a step");
        without.step().expect("a step");
    }
    assert_eq!(with.weights(), without.weights());
    assert_eq!(with.focal(), initial);
    let (with, without) = (optimised(with), optimised(without));
    assert_ne!(with.focal(), initial);
    assert_eq!(without.focal(), initial);
}

#[test]
fn one_start_one_answer() {
    let matrix = balanced_matrix(&contaminated_scene(5, 60, 0.7, 1));
    let bits = |seed, view_scales: &[f64]| {
        let settings = settings(40, true, Backend::Flex);
        let head = Head::new(&matrix, &settings, seed, continued(view_scales.to_vec())).expect("a valid matrix");
        optimised(head).weights().iter().map(|w| w.to_bits()).collect::<Vec<_>>()
    };
    let reweighted = [1.0, 2.0, 0.5, 1.5, 0.7];
    assert_eq!(bits(3, &reweighted), bits(3, &reweighted));
    assert_ne!(bits(3, &reweighted), bits(4, &reweighted));
    assert_ne!(bits(3, &reweighted), bits(3, &[]));
}

#[test]
fn backends_agree() {
    let scene = contaminated_scene(6, 80, 0.7, 4);
    let matrix = balanced_matrix(&scene);
    let [flex, ndarray] = [Backend::Flex, Backend::Ndarray].map(|backend| {
        let mut head = head(&matrix, &settings(25, true, backend), 9);
        (0..20).for_each(|_| {
            head.step().expect("a step");
        });
        head.weights().to_vec()
    });
    let apart = flex.iter().zip(&ndarray).fold(0.0f64, |largest, (a, b)| largest.max((a - b).abs()));
    // A few units in the last place of f32 in each iteration, and another order of summation.
    assert!(apart < 1e-3, "weights differ by {apart}");
}

#[test]
fn hostile_matrices_are_refused_or_survived() {
    let matrix = balanced_matrix(&contaminated_scene(5, 12, 0.0, 1));
    let few = matrix.columns(0, 4).into_owned();
    let refused = Head::new(&few, &settings(10, true, Backend::Flex), 0, continued(Vec::new()));
    assert_eq!(refused.err(), Some(Error::TooFewColumns { columns: 4 }));
    let zeros = DMatrix::zeros(6, 5);
    let twins = DMatrix::from_fn(15, 9, |row, _| matrix[(row, 0)]);
    for hostile in [zeros, twins, matrix] {
        let finished = optimised(head(&hostile, &settings(30, true, Backend::Flex), 0));
        assert!(finished.weights().iter().all(|w| (0.0..=1.0).contains(w)));
        assert!(finished.tolerance().expect("continued") > 0.0 && finished.focal().is_finite());
    }
}

/// The caller may give the tracks in the order of the image, so that neighbours are nearly alike.
#[test]
fn a_right_consensus_is_separate_in_the_order_of_the_image_too() {
    let matrix = balanced_matrix(&contaminated_scene(10, 100, 0.0, 6));
    let mut order: Vec<usize> = (0..matrix.ncols()).collect();
    let x_of_view_0 = |&track: &usize| matrix[(0, track)] / matrix[(2, track)];
    order.sort_by(|a, b| x_of_view_0(a).total_cmp(&x_of_view_0(b)));
    let sorted = matrix.select_columns(&order);
    let basis = dominant_subspace(&sorted, RANK).expect("finite");
    let own = midpoint_median(&mut subspace_residuals(&sorted, &basis));
    let of_wrong = wrong_residual(&sorted, &[1.0; 100], &basis);
    assert!(own < ContinuationOptions::DEFAULT.separation * of_wrong, "{own} {of_wrong}");
}

/// Beside the span of right tracks mismatched ones leave much more than these, beside that of wrong ones about as much.
#[test]
fn mismatched_tracks_tell_a_right_consensus_from_a_wrong_one() {
    for (outliers, is_right) in [(0.0, true), (1.0, false)] {
        let matrix = balanced_matrix(&contaminated_scene(10, 100, outliers, 6));
        let basis = dominant_subspace(&matrix, RANK).expect("finite");
        let own = midpoint_median(&mut subspace_residuals(&matrix, &basis));
        let of_wrong = wrong_residual(&matrix, &[1.0; 100], &basis);
        assert_eq!(own < ContinuationOptions::DEFAULT.separation * of_wrong, is_right, "{own} {of_wrong}");
    }
}
