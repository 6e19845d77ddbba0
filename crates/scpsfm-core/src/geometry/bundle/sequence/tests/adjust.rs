//! Where adjustments end.

use super::super::worker_pool::BATCH;
use super::*;
use crate::geometry::bundle::Loss;
use crate::geometry::bundle::metric::{Extension, Parameter};
use crate::geometry::bundle::testing::{self, NOISE};

#[test]
fn two_groups_are_recovered() {
    for seed in 0..3 {
        let (mut truth, mut observations) = chain(seed, 16, 12, 6, 0.0);
        truth.group_of = (0..16).map(|view| view % 2).collect();
        truth.intrinsics = vec![Intrinsics::from_focal(1.1), Intrinsics::from_focal(0.8)];
        truth.intrinsics[1].radial[0] = -0.08;
        observe(&truth, &mut observations, 0.0, seed);
        let mut start = perturbed(&truth, 0.01, seed);
        start.intrinsics[1].radial[0] = 0.0;
        let models = [IntrinsicsModel::FOCAL, IntrinsicsModel::FOCAL.with(Extension::RadialK1)];
        let report = adjusted(&mut start, &observations, &models, &thorough());
        println!("seed {seed}: {report:?} {:?}", start.intrinsics);
        for (found, expected) in start.intrinsics.iter().zip(&truth.intrinsics) {
            for parameter in Parameter::ALL {
                let error = found.value(parameter) - expected.value(parameter);
                assert!(error.abs() < 1e-6, "seed {seed}: {parameter:?} off by {error}");
            }
        }
    }
}

#[test]
fn a_chain_converges_to_the_noise_floor() {
    for seed in 0..3 {
        let (truth, observations) = chain(seed, 60, 8, 5, 0.001);
        let mut start = perturbed(&truth, 0.02, seed);
        let report = adjusted(&mut start, &observations, &[IntrinsicsModel::FOCAL], &thorough());
        let freedom = 2 * observations.len() - (6 * 60 + 3 * truth.points.len() - 7 + 1);
        let ratio = report.cost / (freedom as f64 * 0.001 * 0.001);
        let focal_error = start.intrinsics[0].focal / truth.intrinsics[0].focal - 1.0;
        println!("seed {seed}: {report:?}, chi2 per degree of freedom {ratio:.3}, focal off by {focal_error:.5}");
        assert!((0.85..1.15).contains(&ratio), "seed {seed}: {ratio}");
        assert!(focal_error.abs() < 0.01, "seed {seed}: {focal_error}");
    }
}

/// What bends at next to no cost is straightened with the usual options: where points only follow the tangent, thirty
/// steps leave the cost .6 % above the minimum.
#[test]
fn drift_is_undone_in_few_steps() {
    for seed in 1..3 {
        let (truth, observations) = chain(seed, 100, 20, 5, 0.001);
        let models = [IntrinsicsModel::FOCAL];
        let best = adjusted(&mut truth.clone(), &observations, &models, &thorough());
        let mut start = bent(&truth, 0.5);
        let report = adjusted(&mut start, &observations, &models, &Options::DEFAULT);
        println!("seed {seed}: least {best:?}, from a bend {report:?}");
        assert!(report.initial_cost > 50.0 * best.cost, "seed {seed}: {report:?}");
        assert!(report.cost / best.cost - 1.0 < 1e-6, "seed {seed}: {report:?} {best:?}");
    }
}

#[test]
fn disconnected_chains_converge_together() {
    let (mut truth, mut observations) = chain(5, 30, 8, 5, 0.0);
    let mut start = perturbed(&truth, 0.01, 5);
    // A second copy far away, which shares nothing but the intrinsics.
    let (views, points) = (truth.poses.len(), truth.points.len());
    let shift = Vector3::new(0.0, 100.0, 0.0);
    for sequence in [&mut truth, &mut start] {
        for view in 0..views {
            let pose = sequence.poses[view];
            sequence.poses.push(Pose { translation: pose.translation - pose.rotation * shift, ..pose });
            sequence.group_of.push(0);
        }
        sequence.points.extend_from_within(..);
        sequence.points[points..].iter_mut().for_each(|point| *point += shift);
    }
    let second = |seen: &Observation| Observation { view: seen.view + views, point: seen.point + points, ..*seen };
    observations.extend(observations.clone().iter().map(second));
    observe(&truth, &mut observations, 0.0, 5);
    let report = adjusted(&mut start, &observations, &[IntrinsicsModel::FOCAL], &thorough());
    println!("{report:?}");
    assert!(report.cost < 1e-18 * observations.len() as f64, "{report:?}");
    assert!((start.intrinsics[0].focal / truth.intrinsics[0].focal - 1.0).abs() < 1e-6);
}

#[test]
fn what_is_held_stays_to_the_bit() {
    for views in [16, 60] {
        let (truth, observations) = chain(6, views, 6, 5, 0.001);
        let start = perturbed(&truth, 0.005, 6);
        let free_views: Vec<bool> = (0..views).map(|view| view % 3 == 1).collect();
        let free = Free { models: &[IntrinsicsModel::FIXED], views: Some(&free_views) };
        let mut sequence = start.clone();
        let report =
            adjust(&mut sequence, &observations, &free, &[], &thorough(), quiet(&StopToken::default(), &mut || ()));
        assert!(report.cost < 0.9 * report.initial_cost, "{report:?}");
        assert_eq!(sequence.intrinsics, start.intrinsics);
        for (view, free) in free_views.iter().enumerate() {
            assert_eq!(sequence.poses[view] != start.poses[view], *free, "view {view}");
        }
        // Points alone, which no system of cameras connects.
        let free = Free { models: &[], views: Some(&[]) };
        let mut sequence = start.clone();
        let report =
            adjust(&mut sequence, &observations, &free, &[], &thorough(), quiet(&StopToken::default(), &mut || ()));
        assert!(report.cost < report.initial_cost && report.iterations > 0, "{report:?}");
        assert_eq!(sequence.poses, start.poses);
    }
}

/// A local adjustment agrees with one in which all that is held is taken as it is: what moves is at a minimum.
#[test]
fn free_views_among_held_ones_find_the_truth() {
    let (truth, observations) = chain(7, 20, 8, 5, 0.0);
    let free_views: Vec<bool> = (0..20).map(|view| (8..12).contains(&view)).collect();
    let free = Free { models: &[IntrinsicsModel::FIXED], views: Some(&free_views) };
    let mut start = perturbed(&truth, 0.01, 7);
    start.intrinsics = truth.intrinsics.clone();
    for view in (0..20).filter(|view| !free_views[*view]) {
        start.poses[view] = truth.poses[view];
    }
    adjust(&mut start, &observations, &free, &[], &thorough(), quiet(&StopToken::default(), &mut || ()));
    for (found, expected) in start.poses.iter().zip(&truth.poses) {
        let error = (found.rotation - expected.rotation).norm() + (found.translation - expected.translation).norm();
        assert!(error < 1e-8, "{error}");
    }
}

#[test]
fn a_weight_counts_like_so_many_observations() {
    let (truth, observations) = chain(8, 10, 6, 5, 0.002);
    let start = perturbed(&truth, 0.005, 8);
    let twice = |seen: &Observation| seen.point.is_multiple_of(3);
    let weighted: Vec<Observation> =
        observations.iter().map(|seen| Observation { weight: if twice(seen) { 2.0 } else { 1.0 }, ..*seen }).collect();
    let repeated: Vec<Observation> =
        observations.iter().chain(observations.iter().filter(|seen| twice(seen))).copied().collect();
    let run = |observations: &[Observation]| {
        let mut sequence = start.clone();
        let report = adjusted(&mut sequence, observations, &[IntrinsicsModel::FOCAL], &thorough());
        (report.cost, sequence.intrinsics[0].focal)
    };
    let ((cost, focal), (same_cost, same_focal)) = (run(&weighted), run(&repeated));
    assert!((cost / same_cost - 1.0).abs() < 1e-10, "{cost} {same_cost}");
    assert!((focal / same_focal - 1.0).abs() < 1e-6, "{focal} {same_focal}");
    let (unweighted, _) = run(&observations);
    assert!(cost > 1.1 * unweighted, "{cost} {unweighted}");
}

/// Several batches, groups, a held view, a point twice in a view: sums come to the same, whoever adds them up.
#[test]
fn threads_change_nothing_to_the_last_bit() {
    let (mut truth, mut observations) = chain(5, 24, 180, 5, 0.002);
    truth.intrinsics = vec![Intrinsics::from_focal(1.1), Intrinsics::from_focal(0.9), Intrinsics::from_focal(1.3)];
    truth.group_of = (0..24).map(|view| view % 3).collect();
    observe(&truth, &mut observations, 0.002, 5);
    observations.push(observations[7]);
    assert!(observations.len() > BATCH, "{} make one batch", observations.len());
    let models = [IntrinsicsModel::FULL, IntrinsicsModel::FIXED, IntrinsicsModel::FOCAL];
    let views: Vec<bool> = (0..24).map(|view| view != 9).collect();
    let free = Free { models: &models, views: Some(&views) };
    let options = Options { max_iterations: 4, loss: Loss::Cauchy { scale: 0.004 }, ..Options::DEFAULT };
    let on = |threads: usize| {
        let (mut start, mut beats) = (perturbed(&truth, 0.01, 5), 0);
        let stop = StopToken::default();
        let run = Run { threads: Threads::new(threads), stop: &stop, heartbeat: &mut || beats += 1 };
        let report = adjust(&mut start, &observations, &free, &[], &options, run);
        (start, report, beats)
    };
    let alone = on(1);
    assert!(alone.1.iterations == 4 && alone.2 >= 4 && alone.1.cost < 0.5 * alone.1.initial_cost, "{:?}", alone.1);
    for threads in [2, 3, 7] {
        assert!(on(threads) == alone, "{threads} threads");
    }
}

/// Of a system that is sparse, and of one that is eliminated by panels.
#[test]
fn threads_change_nothing_to_other_systems_either() {
    for (truth, observations) in [chain(6, 60, 60, 5, 0.002), sequence_of(&testing::scene(5, 10, 1_000, NOISE))] {
        assert!(observations.len() > BATCH / 2, "{} are too few for a second thread", observations.len());
        let on = |threads: usize| {
            let (mut start, stop) = (perturbed(&truth, 0.003, 5), StopToken::default());
            let run = Run { threads: Threads::new(threads), stop: &stop, heartbeat: &mut || () };
            let options = Options { max_iterations: 3, ..Options::DEFAULT };
            let report = adjust(&mut start, &observations, &Free::all(&[IntrinsicsModel::FOCAL]), &[], &options, run);
            (start, report)
        };
        assert!(on(3) == on(1));
    }
}
