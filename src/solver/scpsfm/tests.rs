//! The heads and the choice among them, on matrices.

use super::*;
use crate::domain::{Limits, StopReason};
use crate::solver::block::of_all_views;
use crate::synthetic::metrics::agreement;
use crate::synthetic::{Scene, SceneOptions};

/// The measurement matrix of a scene of 10 views and 200 tracks, and which tracks are right.
fn scene(outliers: f64, seed: u64) -> (DMatrix<f64>, Vec<bool>) {
    let options = SceneOptions { outliers, seed, with_depths: true, ..SceneOptions::default() };
    let scene = Scene::generate(&options).expect("valid options");
    let input = crate::domain::Input::new(scene.input.clone(), &Limits::default(), "scene").expect("a valid scene");
    (of_all_views(&input).complete.measurement_matrix(), scene.truth.inlier)
}

fn search(stop: &StopToken, iterations: u32, heads: usize) -> HeadSearch<'_> {
    HeadSearch {
        settings: NetworkSettings { iterations, ..NetworkSettings::default() },
        has_depths: true,
        stop,
        options: HeadOptions { heads, ..HeadOptions::DEFAULT },
        continuation: ContinuationOptions::DEFAULT,
    }
}

fn run(search: &HeadSearch, matrix: &DMatrix<f64>) -> HeadChoice {
    search.run(matrix, &mut |_, _, _| ()).expect("an answer")
}

#[test]
fn the_first_head_is_accepted_where_it_stands_apart() {
    let stop = StopToken::default();
    for outliers in [0.9, 0.96] {
        let (matrix, inlier) = scene(outliers, 2);
        let choice = run(&search(&stop, 500, 2), &matrix);
        let kept: Vec<bool> = choice.weights.iter().map(|&w| w > THRESHOLD).collect();
        assert!(agreement(&kept, &inlier).f1 > 0.99, "{outliers}");
        assert_eq!((choice.is_verified, choice.heads), (true, 1), "{outliers}");
    }
}

#[test]
fn nothing_is_accepted_where_every_track_is_wrong() {
    let stop = StopToken::default();
    let (matrix, _) = scene(1.0, 5);
    let choice = run(&search(&stop, 200, 3), &matrix);
    assert_eq!((choice.is_verified, choice.heads), (false, 3));
}

/// Views and tracks without observations: the others get the same bits, such tracks weight 0.
#[test]
fn padding_with_zeros_changes_nothing() {
    let stop = StopToken::default();
    let (matrix, _) = scene(0.9, 3);
    let search = search(&stop, 60, 2);
    let plain = run(&search, &matrix);
    let mut padded = DMatrix::zeros(matrix.nrows() + 6, matrix.ncols() + 7);
    padded.view_mut((0, 0), (12, matrix.ncols())).copy_from(&matrix.rows(0, 12));
    padded.view_mut((15, 0), (matrix.nrows() - 12, matrix.ncols())).copy_from(&matrix.rows(12, matrix.nrows() - 12));
    let choice = run(&search, &padded);
    let bits = |weights: &[f64]| weights.iter().map(|w| w.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&choice.weights[..matrix.ncols()]), bits(&plain.weights));
    assert!(choice.weights[matrix.ncols()..].iter().all(|&w| w == 0.0));
    assert_eq!((choice.is_verified, choice.heads), (plain.is_verified, plain.heads));
}

#[test]
fn one_seed_one_answer() {
    let stop = StopToken::default();
    let (matrix, _) = scene(0.98, 3);
    let of = |seed| {
        let mut search = search(&stop, 30, 3);
        search.settings.seed = seed;
        run(&search, &matrix)
    };
    assert_eq!(of(1), of(1));
    assert_ne!(of(1).weights, of(2).weights);
}

/// A stop is heeded in the iteration in which it comes; what earlier heads said stands.
#[test]
fn a_stop_ends_the_search_at_once() {
    let stop = StopToken::default();
    let (matrix, _) = scene(0.98, 3);
    let mut reported = Vec::new();
    let choice = search(&stop, 30, 16).run(&matrix, &mut |place, step, _| {
        reported.push((place, step.iteration));
        if (place, step.iteration) == (1, 7) {
            stop.stop(StopReason::Cancelled);
        }
    });
    assert_eq!(choice.expect("an answer").heads, 1);
    assert_eq!((reported.len(), reported.last()), (37, Some(&(1, 7))));
}

#[test]
fn hardly_anything_observed_is_no_answer() {
    let stop = StopToken::default();
    for matrix in [DMatrix::zeros(30, 20), DMatrix::from_element(3, 20, 1.0), DMatrix::from_element(30, 4, 1.0)] {
        let choice = run(&search(&stop, 30, 2), &matrix);
        assert_eq!(choice, HeadChoice { weights: vec![0.0; matrix.ncols()], is_verified: false, heads: 0 });
    }
}

/// Of two sets of rank 4, the larger; of two of one size, the one that fits one calibration.
#[test]
fn the_choice_weighs_size_rank_and_calibration() {
    let stop = StopToken::default();
    let search = search(&stop, 30, 2);
    let head = |kept, energy, daq_residual| FinishedHead {
        weights: Vec::new(),
        kept,
        tolerance: 0.1,
        energy,
        is_separate: true,
        daq_residual,
    };
    let chosen = |heads: &[FinishedHead]| search.choice(heads);
    assert_eq!(chosen(&[head(5, 0.001, 0.1), head(6, 0.001, 0.1)]), 1);
    assert_eq!(chosen(&[head(5, 0.001, 0.1), head(6, 0.03, 0.1)]), 0);
    assert_eq!(chosen(&[head(5, 0.001, 2.0), head(5, 0.001, 0.1)]), 1);
    assert_eq!(chosen(&[head(3, 0.0, WORST_DAQ), head(4, 0.0, 3.0)]), 1);
    assert!(search.is_verified(&head(5, 0.0, 0.1)) && !search.is_verified(&head(4, 0.0, 0.1)));
    assert!(search.is_accepted(&head(4, 0.0, 0.1)) && !search.is_accepted(&head(8, 0.0, 0.5)));
    let without = HeadSearch { settings: NetworkSettings { use_daq: false, ..search.settings.clone() }, ..search };
    assert_eq!(without.choice(&[head(5, 0.001, 2.0), head(5, 0.001, 0.1)]), 0, "the first of equals");
    assert!(!without.is_accepted(&head(7, 0.0, 0.0)) && without.is_accepted(&head(8, 0.0, 0.0)));
}
