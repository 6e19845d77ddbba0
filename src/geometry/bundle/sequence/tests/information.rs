//! Information on intrinsics against its dense counterparts.

use super::super::information;
use super::*;
use crate::geometry::bundle::metric::{Information, Optimum, Parameter};
use crate::geometry::bundle::testing::{self, NOISE};
use crate::geometry::bundle::zoom::Zooming;

fn informed(sequence: &Sequence, sightings: &[Sighting], group: usize, models: &[IntrinsicsModel]) -> Information {
    let priors = vec![IntrinsicsPrior::NONE; models.len()];
    information(sequence, sightings, group, &Free::all(models), &priors, &StopToken::default()).expect("views")
}

fn agree(found: &Optimum, expected: &Optimum, what: &str) {
    let close = |found: f64, expected: f64, scale: f64| {
        assert!((found - expected).abs() <= 1e-5 * scale, "{what}: {found} instead of {expected}");
    };
    for parameter in Parameter::ALL {
        let variance = expected.variance_of(parameter).expect("observable");
        close(found.variance_of(parameter).expect("observable"), variance, variance);
        close(found.shift[parameter as usize], expected.shift[parameter as usize], variance.sqrt() * NOISE + 1e-6);
    }
    close(found.rise, expected.rise, expected.rise.abs() + NOISE * NOISE);
    close(found.log_determinant, expected.log_determinant, 1.0);
}

#[test]
fn one_group_is_as_well_known_as_in_a_block() {
    for (seed, views, tracks) in [(1, 8, 40), (2, 12, 30), (3, 45, 20)] {
        let scene = testing::scene(seed, views, tracks, NOISE);
        let (sequence, sightings) = sequence_of(&scene);
        let dense = Information::new(&reconstruction_of(&scene), &scene.observations).expect("views");
        let sparse = informed(&sequence, &sightings, 0, &[IntrinsicsModel::FIXED]);
        for model in IntrinsicsModel::all() {
            let prior = IntrinsicsPrior::NONE.knowing(Parameter::PrincipalX, 0.001, 0.01, NOISE);
            agree(
                &sparse.optimum(model, &prior),
                &dense.optimum(model, &prior),
                &format!("seed {seed}, {}", model.name()),
            );
        }
    }
}

#[test]
fn a_group_a_view_is_as_well_known_as_when_zooming() {
    let scene = testing::scene(4, 10, 40, 0.0);
    let (mut sequence, sightings) = sequence_of(&scene);
    sequence.intrinsics = vec![sequence.intrinsics[0]; 10];
    sequence.group_of = (0..10).collect();
    let expected = Zooming::from(&reconstruction_of(&scene)).log_focal_variances(&scene.observations);
    let variance = |view: usize, models: &[IntrinsicsModel]| {
        let information = informed(&sequence, &sightings, view, models);
        information.optimum(IntrinsicsModel::FOCAL, &IntrinsicsPrior::NONE).variance_of(Parameter::LogFocal)
    };
    for (view, expected) in expected.iter().enumerate() {
        let expected = expected.expect("observable");
        let found = variance(view, &[IntrinsicsModel::FOCAL; 10]).expect("observable");
        assert!((found / expected - 1.0).abs() < 1e-5, "view {view}: {found} instead of {expected}");
        let others_known = variance(view, &[IntrinsicsModel::FIXED; 10]).expect("observable");
        assert!(others_known < found, "view {view}: {others_known} {found}");
    }
}

/// What is known of another group tells of this one what it would were the other held.
#[test]
fn a_prior_of_another_group_is_used() {
    let (mut sequence, sightings) = chain(5, 12, 8, 5, 0.0);
    sequence.intrinsics = vec![sequence.intrinsics[0]; 2];
    sequence.group_of = (0..12).map(|view| view % 2).collect();
    let models = [IntrinsicsModel::FOCAL; 2];
    let focal = sequence.intrinsics[0].focal.ln();
    let variance = |models: &[IntrinsicsModel], sigma: f64| {
        let prior = IntrinsicsPrior::NONE.knowing(Parameter::LogFocal, focal, sigma, 0.001);
        let priors = [IntrinsicsPrior::NONE, prior];
        let stop = StopToken::default();
        information(&sequence, &sightings, 0, &Free::all(models), &priors, &stop)
            .and_then(|found| found.optimum(models[0], &IntrinsicsPrior::NONE).variance_of(Parameter::LogFocal))
            .expect("observable")
    };
    let held = variance(&[IntrinsicsModel::FOCAL, IntrinsicsModel::FIXED], 1.0);
    let (known, unknown) = (variance(&models, 1e-9), variance(&models, 1e9));
    assert!((known / held - 1.0).abs() < 1e-5 && unknown > 1.05 * held, "{held} {known} {unknown}");
}

#[test]
fn nothing_to_tell_is_none() {
    let (sequence, sightings) = chain(6, 8, 4, 4, 0.0);
    let free = Free::all(&[]);
    let stop = StopToken::default();
    assert!(information(&sequence, &sightings, 1, &free, &[], &stop).is_none(), "no such group");
    let mut broken = sequence.clone();
    broken.poses[2].translation.fill(f64::NAN);
    // Its observations are undefined, and it is left out.
    assert!(information(&broken, &sightings, 0, &free, &[], &stop).is_some());
}
