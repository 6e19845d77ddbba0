use super::*;
use crate::geometry::bundle::metric::{Information, IntrinsicsPrior};
use crate::synthetic::PhotographedOptions;
use crate::synthetic::photographed::{FocalKind, WrongKind};

/// A clean scene of this motion under a pinhole.
fn scene(motion: PhotographedMotion, seed: u64) -> Photographed {
    let options = PhotographedOptions {
        views: 12,
        tracks: 300,
        motion,
        turn_rad: 0.4,
        lens: LensKind::Pinhole,
        focal_px: 1500.0,
        focal: FocalKind::ConstantFocal,
        focal_ratio: 1.0,
        principal_point: [0.0; 2],
        aspect: 1.0,
        radial: [0.0; 2],
        wrong: WrongKind::Clean,
        ..PhotographedOptions::drawn(seed)
    };
    Photographed::generate(&options).unwrap_or_else(|error| panic!("{}: {error}", options.name()))
}

fn bound(scene: &Photographed) -> f64 {
    let bounds = of_photographed(scene).expect("a model");
    bounds.into_iter().fold(0.0, f64::max)
}

#[test]
fn turning_motions_determine_the_focal_length_and_a_translation_does_not() {
    for seed in 0..3 {
        for motion in PhotographedMotion::ALL {
            let bound = bound(&scene(motion, seed));
            println!("seed {seed}, {}: {bound:.5}", motion.name());
            match motion {
                PhotographedMotion::Translation => assert!(bound > 1.0, "seed {seed}: {bound}"),
                _ => assert!(bound > 1e-5 && bound < 0.2, "seed {seed}, {}: {bound}", motion.name()),
            }
        }
    }
}

#[test]
fn a_fronto_parallel_plane_determines_nothing() {
    let mut options = scene(PhotographedMotion::PlanarScene, 1).options;
    options.turn_rad = 0.0;
    let flat = bound(&Photographed::generate(&options).expect("valid"));
    assert!(flat > 1.0, "{flat}");
}

#[test]
fn more_unknowns_raise_the_bound_and_a_fisheye_has_one() {
    let plain = scene(PhotographedMotion::HandHeld, 2);
    let mut before = bound(&plain);
    let options = &plain.options;
    let displaced = PhotographedOptions { principal_point: [1e-4, 0.0], ..options.clone() };
    let distorted = PhotographedOptions { radial: [1e-4, 0.0], ..displaced.clone() };
    let drifting = PhotographedOptions { focal: FocalKind::DriftingFocal, ..distorted.clone() };
    for options in [displaced, distorted, drifting] {
        let now = bound(&Photographed::generate(&options).expect("valid"));
        assert!(now > before, "{now} after {before}");
        before = now;
    }
    assert!(before >= 0.05, "a zoom is not known better than its prior: {before}");
    let fisheye = PhotographedOptions { lens: LensKind::Fisheye, ..options.clone() };
    let of_fisheye = bound(&Photographed::generate(&fisheye).expect("valid"));
    assert!(of_fisheye > 1e-5 && of_fisheye < 0.2, "{of_fisheye}");
}

/// Without priors it is what the product's covariance says at the truth.
#[test]
fn the_bound_is_the_products_covariance() {
    for seed in 0..3 {
        let scene = scene(PhotographedMotion::WalkAround, seed);
        let Photographed { input, truth, options } = &scene;
        let side_px = f64::from(IMAGE_SIZE.width_px);
        let centre = Vector2::new(1599.0, 1199.0) / 2.0;
        let reconstruction = MetricReconstruction::new(
            Intrinsics::from_focal(options.focal_px / side_px),
            poses(&truth.rotations, &truth.translations),
            truth.points.iter().map(|point| Vector3::from(*point)).collect(),
        );
        let verifiable = truth.verifiable(&input.track);
        let observation = |k: usize| {
            let xy = (Vector2::new(input.x[k], input.y[k]) - centre) / side_px;
            Observation::new(input.view[k] as usize, input.track[k] as usize, xy)
        };
        let observations: Vec<Observation> = (0..input.x.len()).filter(|&k| verifiable[k]).map(observation).collect();
        let information = Information::new(&reconstruction, &observations).expect("poses");
        let optimum = information.optimum(IntrinsicsModel::FOCAL, &[IntrinsicsPrior::NONE]);
        let expected = optimum.variance_of(0, Parameter::LogFocal).expect("observable").sqrt()
            * effective_noise()
            * options.noise_px
            / side_px;
        let found = bound(&scene);
        assert!((found / expected - 1.0).abs() < 0.01, "seed {seed}: {found} for {expected}");
    }
}
