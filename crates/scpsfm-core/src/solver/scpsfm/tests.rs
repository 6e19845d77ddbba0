//! The heads and the choice among them, on matrices.

use super::*;
use crate::domain::{Limits, Phase, StopReason};
use crate::solver::block::of_all_views;
use crate::synthetic::metrics::agreement;
use crate::synthetic::{Scene, SceneOptions};

/// The measurement matrix of a scene of 10 views and 200 tracks, and which tracks are right.
fn scene(outliers: f64, seed: u64) -> (DMatrix<f64>, Vec<bool>) {
    scene_of(&SceneOptions { outliers, seed, ..SceneOptions::default() })
}

fn scene_of(options: &SceneOptions) -> (DMatrix<f64>, Vec<bool>) {
    let options = SceneOptions { with_depths: true, ..options.clone() };
    let scene = Scene::generate(&options).expect("valid options");
    let input = crate::domain::Input::new(scene.input.clone(), &Limits::default(), "scene").expect("a valid scene");
    (of_all_views(&input).complete.measurement_matrix(), scene.truth.inlier)
}

/// Up to so many heads of so many iterations, by the continued objective.
fn search(matrix: &DMatrix<f64>, iterations: u32, heads: usize) -> HeadSearch {
    let settings = NetworkSettings { iterations, ..NetworkSettings::default() };
    HeadSearch::of_matrix(matrix, true, settings, HeadOptions { heads, ..HeadOptions::DEFAULT })
}

fn run(mut search: HeadSearch) -> HeadSearch {
    let stop = StopToken::default();
    while !search.is_over() {
        assert!(search.optimise_next(&stop, &mut |_| ()).expect("a head"));
    }
    search
}

/// F1 of `w > 1/2`.
fn f1(ended: &HeadSearch, inlier: &[bool]) -> f64 {
    let kept: Vec<bool> = ended.weights().iter().map(|&w| w > THRESHOLD).collect();
    agreement(&kept, inlier).f1
}

#[test]
fn the_first_head_is_accepted_where_it_stands_apart() {
    for outliers in [0.9, 0.96] {
        let (matrix, inlier) = scene(outliers, 2);
        let ended = run(search(&matrix, 500, 2));
        assert!(f1(&ended, &inlier) > 0.99, "{outliers}");
        assert_eq!((ended.is_verified(), ended.heads.len()), (true, 1), "{outliers}");
    }
}

/// At strong noise most heads end with no more than four tracks; the choice goes by the others.
#[test]
fn heads_that_kept_hardly_anything_have_no_say_in_the_choice() {
    let mut were_most = false;
    for seed in 0..3 {
        let (matrix, inlier) = scene_of(&SceneOptions { outliers: 0.9, noise: 0.09, seed, ..SceneOptions::default() });
        let ended = run(search(&matrix, 500, 6));
        let f1 = f1(&ended, &inlier);
        assert!(f1 > 0.85, "seed {seed}: {f1}");
        were_most |= 2 * ended.heads.iter().filter(|head| head.kept <= RANK).count() >= ended.heads.len();
    }
    assert!(were_most, "none of the scenes is a case of it");
}

#[test]
fn nothing_is_accepted_where_every_track_is_wrong() {
    let ended = run(search(&scene(1.0, 5).0, 200, 3));
    assert_eq!((ended.is_verified(), ended.heads.len()), (false, 3));
}

/// Views and tracks without observations: the others get the same bits, such tracks weight 0.
#[test]
fn padding_with_zeros_changes_nothing() {
    let (matrix, _) = scene(0.9, 3);
    let plain = run(search(&matrix, 60, 2));
    let mut padded = DMatrix::zeros(matrix.nrows() + 6, matrix.ncols() + 7);
    padded.view_mut((0, 0), (12, matrix.ncols())).copy_from(&matrix.rows(0, 12));
    padded.view_mut((15, 0), (matrix.nrows() - 12, matrix.ncols())).copy_from(&matrix.rows(12, matrix.nrows() - 12));
    let ended = run(search(&padded, 60, 2));
    let bits = |weights: &[f64]| weights.iter().map(|w| w.to_bits()).collect::<Vec<_>>();
    let (weights, last) = (ended.weights(), matrix.ncols());
    assert_eq!(bits(&weights[..last]), bits(&plain.weights()));
    assert!(weights[last..].iter().all(|&w| w == 0.0));
    assert_eq!((ended.is_verified(), ended.heads.len()), (plain.is_verified(), plain.heads.len()));
}

#[test]
fn one_seed_one_answer() {
    let (matrix, _) = scene(0.98, 3);
    let of = |seed| {
        let settings = NetworkSettings { iterations: 30, seed, ..NetworkSettings::default() };
        run(HeadSearch::of_matrix(&matrix, true, settings, HeadOptions { heads: 3, ..HeadOptions::DEFAULT })).weights()
    };
    assert_eq!(of(1), of(1));
    assert_ne!(of(1), of(2));
}

/// A stop is heeded in the iteration in which it comes; what earlier heads said stands.
#[test]
fn a_stop_ends_the_search_at_once() {
    let stop = StopToken::default();
    let mut search = search(&scene(0.98, 3).0, 30, 16);
    let mut reported = Vec::new();
    let mut next = || {
        search.optimise_next(&stop, &mut |step| {
            reported.push((step.head.head, step.head.iteration));
            if reported.last() == Some(&(2, 7)) {
                stop.stop(StopReason::Cancelled);
            }
        })
    };
    assert_eq!((next(), next()), (Ok(true), Ok(false)));
    assert_eq!(search.heads.len(), 1);
    assert_eq!((reported.len(), reported.last()), (37, Some(&(2, 7))));
}

/// What a report says of the phases, the tolerance and the best head so far.
#[test]
fn reports_name_phase_tolerance_and_the_best_head() {
    let mut search = search(&scene(0.98, 3).0, 50, 2);
    let mut reported: Vec<HeadProgress> = Vec::new();
    let stop = StopToken::default();
    for _ in 0..2 {
        search.optimise_next(&stop, &mut |step| reported.push(step.head)).expect("a head");
    }
    let (first, second) = reported.split_at(50);
    assert!(first.iter().all(|step| step.head == 1 && step.best_daq_residual.is_none()));
    assert!(second.iter().all(|step| step.head == 2 && step.best_daq_residual == Some(search.heads[0].daq_residual)));
    for step in &reported {
        assert_eq!(step.tolerance.is_some(), step.phase == Some(Phase::Growth), "{step:?}");
        assert!((0.0..=200.0).contains(&step.weight_sum) && step.weight_histogram.iter().sum::<u32>() == 200);
    }
}

#[test]
fn hardly_anything_observed_is_no_answer() {
    for matrix in [DMatrix::zeros(30, 20), DMatrix::from_element(3, 20, 1.0), DMatrix::from_element(30, 4, 1.0)] {
        let ended = run(search(&matrix, 30, 2));
        assert_eq!((ended.weights(), ended.is_verified(), ended.heads.len()), (vec![0.0; matrix.ncols()], false, 0));
    }
}

/// Of two sets of rank 4, the larger; of two of one size, the one that fits one calibration.
#[test]
fn the_choice_weighs_size_rank_and_calibration() {
    let (matrix, _) = scene(0.9, 1);
    let head = |kept, energy, daq_residual| FinishedHead {
        weights: Vec::new(),
        kept,
        tolerance: 0.1,
        energy,
        is_separate: true,
        daq_residual,
    };
    // Place of the chosen head, whether it is verified, and whether the search is over with it.
    let chosen = |use_daq, heads: Vec<FinishedHead>| {
        let mut search = search(&matrix, 30, 16);
        search.settings.use_daq = use_daq;
        search.heads = heads;
        let place = search.heads.iter().position(|head| std::ptr::eq(head, search.best().expect("a head")));
        (place.expect("one of them"), search.is_verified(), search.is_over())
    };
    assert_eq!(chosen(true, vec![head(5, 0.001, 0.1), head(6, 0.001, 0.1)]), (1, true, true));
    assert_eq!(chosen(true, vec![head(5, 0.001, 0.1), head(6, 0.03, 0.1)]), (0, true, true));
    assert_eq!(chosen(true, vec![head(5, 0.001, 2.0), head(5, 0.001, 0.1)]), (1, true, true));
    assert_eq!(chosen(true, vec![head(3, 0.0, WORST_DAQ), head(4, 0.0, 3.0)]), (1, false, false));
    assert_eq!(chosen(true, vec![head(4, 0.0, 0.1)]), (0, false, true));
    assert_eq!(chosen(true, vec![head(8, 0.0, 0.5)]), (0, true, false));
    assert_eq!(chosen(false, vec![head(5, 0.001, 2.0), head(5, 0.001, 0.1)]), (0, false, false), "the first of equals");
    assert_eq!(chosen(false, vec![head(7, 0.0, 0.0)]), (0, false, false));
    assert_eq!(chosen(false, vec![head(8, 0.0, 0.0)]), (0, true, true));
    // Four tracks tell no noise.
    let four = || FinishedHead { tolerance: 0.02, ..head(4, 0.0, 1.4) };
    assert_eq!(chosen(true, vec![four(), four(), head(20, 0.05, 0.4)]), (2, true, false));
}
