//! Whether sigma is what it says: the share of the calibrations whose error is within one and three of it.

use nalgebra::Vector2;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// What is unknown of the lens, beside its focal length: largest displacement of a coordinate of the principal point,
/// in image sides, and of `k1`.
#[derive(Debug, Clone, Copy)]
struct Lens {
    displaced: f64,
    radial: f64,
}

const CENTRAL: Lens = Lens { displaced: 0.0, radial: 0.0 };
const DISPLACED: Lens = Lens { displaced: 0.05, radial: 0.0 };
const DISTORTING: Lens = Lens { displaced: 0.05, radial: 0.1 };
const LOW_DISTORTION: Lens = Lens { displaced: 0.0, radial: 0.04 };

impl Lens {
    /// A scene through such a lens; with distortion, only what falls into the image.
    fn scene(self, seed: u64, noise: f64) -> TestScene {
        let tracks = if self.radial > 0.0 { 60 } else { 20 };
        let mut scene = testing::scene(seed, 10, tracks, 0.0);
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xc0ff);
        let mut within = |range: f64| if range > 0.0 { rng.random_range(-range..range) } else { 0.0 };
        scene.intrinsics.principal_point = Vector2::new(within(self.displaced), within(self.displaced));
        scene.intrinsics.radial[0] = within(self.radial);
        scene.observe(noise, &mut rng);
        if self.radial > 0.0 {
            scene.crop();
        }
        scene
    }
}

/// Errors of the log focal length over sigma, of the calibrations graded METRIC.
struct Coverage {
    deviations: Vec<f64>,
    scenes: usize,
}

impl Coverage {
    fn of(seeds: u64, noise: f64, lens: Lens) -> Self {
        let mut deviations = Vec::new();
        for seed in 0..seeds {
            let scene = lens.scene(seed, noise);
            let outcome = calibrated(&scene, seed, noise);
            if outcome.grade != Grade::Metric {
                continue;
            }
            let found = outcome.intrinsics().expect("metric").focal;
            let deviation = (found / scene.intrinsics.focal).ln() / outcome.sigma_log_focal.expect("graded");
            if deviation.abs() > 3.0 {
                println!(
                    "noise {noise}, {lens:?}, seed {seed}: {deviation:.1} sigma of {:?}, {} {:?}",
                    outcome.sigma_log_focal,
                    outcome.model.name(),
                    codes(&outcome)
                );
            }
            deviations.push(deviation);
        }
        Self { deviations, scenes: seeds as usize }
    }

    fn within(&self, sigmas: f64) -> f64 {
        let count = self.deviations.iter().filter(|deviation| deviation.abs() <= sigmas).count();
        count as f64 / self.deviations.len().max(1) as f64
    }

    fn tell(&self, what: &str) {
        println!(
            "{what}: {} of {} METRIC; within 1, 2, 3 sigma: {:.3}, {:.3}, {:.3}",
            self.deviations.len(),
            self.scenes,
            self.within(1.0),
            self.within(2.0),
            self.within(3.0)
        );
    }
}

fn all(seeds: u64, lenses: &[Lens]) -> Coverage {
    let mut all = Coverage { deviations: Vec::new(), scenes: 0 };
    for &lens in lenses {
        for noise in [0.003, 0.001] {
            let coverage = Coverage::of(seeds, noise, lens);
            coverage.tell(&format!("noise {noise}, {lens:?}"));
            all.scenes += coverage.scenes;
            all.deviations.extend(coverage.deviations);
        }
    }
    all.tell("all");
    all
}

/// 20 seeds of each kind: enough to see a sigma that is off by a factor.
#[test]
fn sigma_is_about_the_error() {
    let all = all(20, &[CENTRAL, DISPLACED]);
    assert!(all.deviations.len() > 40, "{} METRIC", all.deviations.len());
    assert!(all.within(3.0) >= 0.95, "{:.3} within 3 sigma", all.within(3.0));
    assert!((0.45..0.85).contains(&all.within(1.0)), "{:.3} within 1 sigma", all.within(1.0));
}

#[test]
#[ignore = "2000 calibrations, a minute or two: run it after a change of what sigma is made of"]
fn sigma_is_the_error_over_two_thousand_scenes() {
    let all = all(500, &[CENTRAL, DISPLACED]);
    assert!(all.deviations.len() > 1500, "{} METRIC", all.deviations.len());
    assert!(all.within(3.0) >= 0.97, "{:.3} within 3 sigma", all.within(3.0));
    assert!((0.60..=0.76).contains(&all.within(1.0)), "{:.3} within 1 sigma", all.within(1.0));
}

#[test]
#[ignore = "1000 calibrations, a minute or two: run it after a change of what sigma is made of"]
fn sigma_is_the_error_through_distorting_lenses() {
    let all = all(500, &[DISTORTING]);
    assert!(all.within(3.0) >= 0.97, "{:.3} within 3 sigma", all.within(3.0));
    assert!((0.60..=0.80).contains(&all.within(1.0)), "{:.3} within 1 sigma", all.within(1.0));
}

/// Distortion that noise hides is not taken, and costs what it would move. Where every lens distorts, sigma is still
/// too small: the average over models expects that half of them do not. Were it to expect distortion of four in five,
/// .614 would be within 1 sigma here, and .770 of the pinholes.
#[test]
#[ignore = "does not hold yet: .581 of 687 are within 1 sigma, .513 at noise .003; 1000 calibrations, a minute or two"]
fn sigma_is_the_error_through_lenses_of_low_distortion() {
    let all = all(500, &[LOW_DISTORTION]);
    assert!(all.within(3.0) >= 0.97, "{:.3} within 3 sigma", all.within(3.0));
    assert!((0.60..=0.80).contains(&all.within(1.0)), "{:.3} within 1 sigma", all.within(1.0));
}

/// Noise of the scenes through a strange lens, in image sides.
const STRANGE_NOISE: f64 = 0.0007;

/// What the lens has beside a focal length.
const ESTIMATED: [Parameter; 6] = [
    Parameter::LogFocal,
    Parameter::PrincipalX,
    Parameter::PrincipalY,
    Parameter::LogAspect,
    Parameter::RadialK1,
    Parameter::RadialK2,
];

/// A lens of which all of these are to be estimated: each is far enough from where a pinhole has it that chance does
/// not decide whether it is freed.
fn strange_lens(seed: u64) -> TestScene {
    let mut scene = testing::scene(seed, 10, 100, 0.0);
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x1e45);
    let mut beyond = |least: f64, most: f64| {
        let size = rng.random_range(least..most);
        if rng.random::<bool>() { size } else { -size }
    };
    scene.intrinsics.principal_point = Vector2::new(beyond(0.03, 0.06), beyond(0.03, 0.06));
    scene.intrinsics.aspect = beyond(0.03, 0.08).exp();
    scene.intrinsics.radial = [-0.25, 0.2, 0.0];
    scene.observe(STRANGE_NOISE, &mut rng);
    scene.crop();
    scene
}

/// The sigmas of the other intrinsics against their errors, over 100 scenes.
#[test]
fn sigmas_of_the_other_intrinsics_are_about_their_errors() {
    let mut deviations: Vec<(Parameter, Coverage)> =
        ESTIMATED.into_iter().map(|parameter| (parameter, Coverage { deviations: Vec::new(), scenes: 100 })).collect();
    for seed in 0..100 {
        let scene = strange_lens(seed);
        let outcome = calibrated_from_truth(&scene, STRANGE_NOISE);
        // Capped: sigma is that of the grade then.
        if outcome.grade != Grade::Metric {
            println!("seed {seed}: {:?} {:?} {:?}", outcome.grade, outcome.sigma_log_focal, codes(&outcome));
            continue;
        }
        let found = outcome.intrinsics().expect("metric");
        for (parameter, coverage) in &mut deviations {
            let Some(sigma) = outcome.sigma(*parameter) else { continue };
            coverage.deviations.push((found.value(*parameter) - scene.intrinsics.value(*parameter)) / sigma);
        }
        let told = |of: &(Parameter, Coverage)| of.1.deviations.last().copied().unwrap_or(f64::NAN);
        println!("seed {seed}: {} {:.2?}", outcome.model.name(), deviations.iter().map(told).collect::<Vec<_>>());
    }
    for (parameter, coverage) in &deviations {
        coverage.tell(&format!("{parameter:?}"));
    }
    for (parameter, coverage) in &deviations {
        let (count, within) = (coverage.deviations.len(), coverage.within(1.0));
        assert!(count >= 50, "{parameter:?} was estimated in {count} scenes");
        // Sigma may be too large rather than too small: these lenses have no third radial term, which the doubt about
        // the model knows nothing of (the second was within 1 sigma in .91).
        assert!((0.55..=0.95).contains(&within), "{parameter:?}: {within:.2} of {count} within 1 sigma");
        assert!(coverage.within(3.0) >= 0.95, "{parameter:?}: {:.2} within 3 sigma", coverage.within(3.0));
    }
}

/// What is not estimated has no sigma, and that of the focal length is as it was told.
#[test]
fn only_what_is_free_has_a_sigma() {
    let outcome = calibrated(&testing::scene(3, 10, 60, 0.001), 3, 0.001);
    assert_eq!(outcome.model, IntrinsicsModel::FOCAL);
    for parameter in Parameter::ALL {
        let sigma = outcome.sigma(parameter);
        assert_eq!(sigma.is_some(), parameter == Parameter::LogFocal, "{parameter:?}: {sigma:?}");
    }
    assert_eq!(outcome.sigma(Parameter::LogFocal), outcome.sigma_log_focal);
    let raised = Outcome { sigma_log_focal: outcome.sigma_log_focal.map(|sigma| 3.0 * sigma), ..outcome.clone() };
    let of = |outcome: &Outcome| outcome.sigma(Parameter::LogFocal).expect("observable");
    assert!((of(&raised) / of(&outcome) - 3.0).abs() < 1e-12);
}
