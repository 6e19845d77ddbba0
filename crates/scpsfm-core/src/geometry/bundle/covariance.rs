//! How well the intrinsics are determined, whatever the gauge.

use nalgebra::{DMatrix, DVector};

use super::Observation;
use super::intrinsics::{Intrinsics, Parameter};
use super::intrinsics_model::{IntrinsicsModel, IntrinsicsPrior};
use super::metric::MetricReconstruction;
use super::sequence::System;
use super::whitened::centre;
use super::without_views::{Function, PARAMETERS, WithoutViews, place, scale_of};

/// Information on the intrinsics, scaled by what they would have with everything else known, that counts as none.
const NULL_INTRINSICS: f64 = 1e-10;

/// What the observations say of the intrinsics of all camera groups together, poses and points marginalised, at one
/// reconstruction.
///
/// For observations with unit variance. From one linearisation it tells of every model at once where its minimum is,
/// how low, and how well determined: a score test in place of an adjustment a model. Where the reconstruction has focal
/// lengths a view, these are free in every model, and what it says of [`Parameter::LogFocal`] is said of their mean.
#[derive(Debug, Clone)]
pub struct Information {
    intrinsics: Vec<Intrinsics>,
    reduced: WithoutViews,
}

/// The minimum of the cost over the intrinsics of one model, to second order.
///
/// Parameters that the model does not free are where a pinhole has them, a focal length that it does not free stays.
#[derive(Debug, Clone)]
pub struct Optimum {
    shift: DVector<f64>,
    variance: Vec<Option<f64>>,
    /// Cost there, prior included, minus the cost of the observations here.
    pub delta_cost: f64,
    /// Natural logarithm of the determinant of the information on what is free. Null directions count as barely known.
    pub log_determinant: f64,
    /// Of the shared parameters that are free and determined.
    covariance: DMatrix<f64>,
}

impl Optimum {
    /// Variance of a parameter of a camera group for observations with unit variance; multiply by the squared noise.
    /// `None`: the observations do not determine it (the variance is infinite). What is not free has variance 0.
    pub fn variance_of(&self, group: usize, parameter: Parameter) -> Option<f64> {
        self.variance[place(group, parameter)]
    }

    /// Value there minus value here.
    pub fn shift_of(&self, group: usize, parameter: Parameter) -> f64 {
        self.shift[place(group, parameter)]
    }

    /// Variance and shift of a function of the views with the shared parameters free.
    fn of(&self, function: &Function) -> (Option<f64>, f64) {
        let undetermined =
            self.variance.iter().zip(function.coupling.iter()).any(|(known, along)| known.is_none() && *along != 0.0);
        let variance = function.variance.filter(|_| !undetermined);
        let shared = function.coupling.dot(&(&self.covariance * &function.coupling));
        (variance.map(|own| own + shared), function.shift - function.coupling.dot(&self.shift))
    }
}

impl Information {
    /// Linearises at this reconstruction.
    ///
    /// The seven directions of a similarity are projected out. Returns `None` without poses, or where the system
    /// holds what is no number.
    pub fn new(reconstruction: &MetricReconstruction, observations: &[Observation]) -> Option<Self> {
        let mut metric = reconstruction.clone();
        if metric.poses.is_empty() {
            return None;
        }
        centre(&mut metric.poses, &mut metric.points);
        let reduced = WithoutViews::new(&System::new(&metric, observations)?, &metric)?;
        let finite = reduced.matrix.iter().chain(reduced.negative_gradient.iter()).all(|value| value.is_finite());
        finite.then_some(Self { intrinsics: metric.intrinsics, reduced })
    }

    /// Variance of the log focal length of each view that has its own under a model, and its value at the minimum of
    /// the model minus its value here; `None` where the observations do not determine it.
    pub fn own_focals(&self, optimum: &Optimum) -> Vec<(Option<f64>, f64)> {
        let of_view = self.reduced.own_focals.iter().flat_map(|own| &own.of_view);
        of_view.map(|function| optimum.of(function)).collect()
    }

    /// Where the cost of a model, the same of every camera group, is least, how low it is there, and how well that is
    /// determined.
    ///
    /// A null direction of the information makes every parameter that takes part in it infinitely uncertain, rather
    /// than vanish in a pseudo-inverse.
    ///
    /// * `priors`: one a camera group
    pub fn optimum(&self, model: IntrinsicsModel, priors: &[IntrinsicsPrior]) -> Optimum {
        let WithoutViews { matrix, negative_gradient, own_focals, known } = &self.reduced;
        let parameters = model.parameters();
        let groups = self.intrinsics.len();
        let free: Vec<usize> =
            (0..groups).flat_map(|group| parameters.iter().map(move |parameter| place(group, *parameter))).collect();
        let mut shift = DVector::zeros(PARAMETERS * groups);
        let (mut information, mut deviation) = (shift.clone(), shift.clone());
        for (group, (intrinsics, prior)) in self.intrinsics.iter().zip(priors).enumerate() {
            for parameter in Parameter::ALL {
                let k = place(group, parameter);
                information[k] = prior.information[parameter as usize];
                deviation[k] = prior.deviation(parameter, intrinsics);
                if parameter != Parameter::LogFocal && !parameters.contains(&parameter) {
                    shift[k] = -intrinsics.value(parameter);
                }
            }
        }
        let gradient = negative_gradient - matrix * &shift;
        let scale: Vec<f64> = free.iter().map(|&k| scale_of(known[k] + information[k])).collect();
        let scaled = DMatrix::from_fn(free.len(), free.len(), |row, column| {
            let (k, l) = (free[row], free[column]);
            let of_prior = if k == l { information[k] } else { 0.0 };
            (matrix[(k, l)] + of_prior) * scale[row] * scale[column]
        });
        let target = DVector::from_fn(free.len(), |row, _| {
            let k = free[row];
            (gradient[k] - information[k] * deviation[k]) * scale[row]
        });
        // Of nothing there is no decomposition.
        let eigen = (!free.is_empty()).then(|| scaled.symmetric_eigen());
        let mut variance = vec![Some(0.0); shift.len()];
        let mut covariance = DMatrix::zeros(shift.len(), shift.len());
        let mut log_determinant = -2.0 * scale.iter().map(|scale| scale.ln()).sum::<f64>();
        for (&value, vector) in
            eigen.iter().flat_map(|eigen| eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()))
        {
            log_determinant += value.max(NULL_INTRINSICS).ln();
            let along = vector.dot(&target);
            for (row, &k) in free.iter().enumerate() {
                let share = vector[row].powi(2);
                if value > NULL_INTRINSICS {
                    shift[k] += scale[row] * vector[row] * along / value;
                    variance[k] = variance[k].map(|sum| sum + share / value * scale[row].powi(2));
                    for (column, &l) in free.iter().enumerate() {
                        covariance[(k, l)] += vector[row] * vector[column] / value * scale[row] * scale[column];
                    }
                } else if share > NULL_INTRINSICS {
                    variance[k] = None;
                }
            }
        }
        let of_priors: f64 = free.iter().map(|&k| information[k] * (deviation[k] + shift[k]).powi(2)).sum();
        let delta_cost = shift.dot(&(matrix * &shift)) - 2.0 * negative_gradient.dot(&shift) + of_priors;
        let mut optimum = Optimum { shift, variance, delta_cost, log_determinant, covariance };
        for (group, mean) in own_focals.iter().flat_map(|own| &own.mean).enumerate() {
            let k = place(group, Parameter::LogFocal);
            (optimum.variance[k], optimum.shift[k]) = optimum.of(mean);
        }
        optimum
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector2, Vector3};

    use super::super::Options;
    use super::super::metric::Extension;
    use super::super::sequence::adjust_all;
    use super::super::testing::{self, Motion, NOISE, TestScene};
    use super::*;
    use crate::domain::StopToken;

    fn optimum(scene: &TestScene, model: IntrinsicsModel) -> Optimum {
        let information = Information::new(&scene.reconstruction(), &scene.observations).expect("poses");
        information.optimum(model, &[IntrinsicsPrior::NONE])
    }

    /// The same scene with the world's origin elsewhere and in another unit.
    fn moved(scene: &TestScene, by: Vector3<f64>, unit: f64) -> TestScene {
        let mut moved = scene.clone();
        moved.points.iter_mut().for_each(|point| *point = (*point + by) * unit);
        moved.poses.iter_mut().for_each(|pose| pose.translation = (pose.translation - pose.rotation * by) * unit);
        moved
    }

    /// Far from the origin, a turn of a view and a shift of it are alike to a hundred billionth; taken as known, they
    /// made the focal length certain.
    #[test]
    fn sigma_does_not_depend_on_where_the_origin_is() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 10, 20, 0.0);
            for model in [IntrinsicsModel::FOCAL, IntrinsicsModel::FULL] {
                let expected = optimum(&scene, model).variance;
                for distance in [1e2, 1e4, 1e6] {
                    let far = moved(&scene, Vector3::new(1.0, -0.5, 0.3) * distance, 1.0);
                    let found = optimum(&far, model).variance;
                    println!("seed {seed}, {distance:e} away: {found:.4?} for {expected:.4?}");
                    for (found, expected) in found.iter().zip(&expected) {
                        let (found, expected) = (found.expect("observable"), expected.expect("observable"));
                        assert!((found - expected).abs() <= 0.01 * expected, "seed {seed}, {distance:e} away");
                    }
                }
            }
        }
    }

    #[test]
    fn sigma_does_not_depend_on_the_unit_of_the_scene() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 10, 20, 0.0);
            let expected = optimum(&scene, IntrinsicsModel::FULL).variance;
            for unit in [1e-6, 1e-3, 1e3, 1e6] {
                let found = optimum(&moved(&scene, Vector3::zeros(), unit), IntrinsicsModel::FULL).variance;
                println!("seed {seed}, unit {unit:e}: {found:.4?} for {expected:.4?}");
                for (found, expected) in found.iter().zip(&expected) {
                    let (found, expected) = (found.expect("observable"), expected.expect("observable"));
                    assert!((found - expected).abs() <= 1e-4 * expected, "seed {seed}, unit {unit:e}");
                }
            }
        }
    }

    #[test]
    fn translation_and_forward_motion_leave_the_focal_length_free() {
        for motion in [Motion::Translation, Motion::Forward] {
            for seed in 0..3 {
                let scene = testing::scene_of(seed, 10, 20, 0.0, motion, false);
                let optimum = optimum(&scene, IntrinsicsModel::FOCAL);
                println!("{motion:?} seed {seed}: {optimum:?}");
                assert_eq!(optimum.variance_of(0, Parameter::LogFocal), None, "{motion:?} seed {seed}");
            }
        }
    }

    #[test]
    fn general_motion_determines_everything_and_more_freedom_costs() {
        for seed in 0..3 {
            let scene = testing::scene(seed, 10, 20, 0.0);
            let deviation = |model| {
                let optimum = optimum(&scene, model);
                assert!(optimum.variance.iter().all(Option::is_some), "seed {seed}: {optimum:?}");
                optimum.variance_of(0, Parameter::LogFocal).expect("observable").sqrt() * NOISE
            };
            let model = IntrinsicsModel::FOCAL.with(Extension::PrincipalPoint);
            let chain = [IntrinsicsModel::FOCAL, model, model.with(Extension::Aspect), IntrinsicsModel::FULL];
            let sigmas = chain.map(deviation);
            println!("seed {seed}: sigma of log f {sigmas:.5?}");
            // Cramer-Rao bound of this setting: median .5 % over scenes.
            assert!((1e-4..0.02).contains(&sigmas[0]), "seed {seed}: {sigmas:?}");
            assert!(sigmas.windows(2).all(|pair| pair[1] >= pair[0]), "seed {seed}: {sigmas:?}");
        }
    }

    /// Standard deviations of the views' own log focal lengths at the truth.
    fn own_sigmas(scene: &TestScene, model: IntrinsicsModel) -> (Vec<Option<f64>>, Optimum) {
        let information =
            Information::new(&scene.reconstruction().with_own_focals(), &scene.observations).expect("poses");
        let optimum = information.optimum(model, &[IntrinsicsPrior::NONE]);
        let sigma = |(variance, _): (Option<f64>, f64)| variance.map(|variance| variance.sqrt() * NOISE);
        (information.own_focals(&optimum).into_iter().map(sigma).collect(), optimum)
    }

    #[test]
    fn a_focal_length_a_view_is_less_certain_than_one_for_all() {
        let model = IntrinsicsModel::FOCAL_PER_VIEW;
        for seed in 0..3 {
            let scene = testing::scene(seed, 10, 40, 0.0);
            let sigma =
                |optimum: &Optimum| optimum.variance_of(0, Parameter::LogFocal).expect("observable").sqrt() * NOISE;
            let constant = sigma(&optimum(&scene, IntrinsicsModel::FOCAL));
            let (own, optimum) = own_sigmas(&scene, model);
            let (behind_lens, _) = own_sigmas(&scene, model.with(Extension::RadialK1));
            println!("seed {seed}: {constant:.5} for all, {own:.5?}, behind a lens {behind_lens:.5?}");
            let own: Vec<f64> = own.into_iter().map(|sigma| sigma.expect("observable")).collect();
            assert_eq!(own.len(), 10);
            for (own, behind_lens) in own.iter().zip(behind_lens) {
                assert!(*own > constant && behind_lens.is_some_and(|sigma| sigma >= *own), "seed {seed}");
            }
            // Focal lengths that share a frame of points err together: their mean is no surer than one for all would
            // be, nor less sure than each.
            let largest = own.iter().copied().fold(0.0, f64::max);
            assert!((constant..largest).contains(&sigma(&optimum)), "seed {seed}: {}", sigma(&optimum));
        }
        // Wherever the origin is.
        let scene = testing::scene(1, 10, 40, 0.0);
        let (expected, _) = own_sigmas(&scene, model);
        for distance in [1e2, 1e4, 1e6] {
            let (found, _) = own_sigmas(&moved(&scene, Vector3::new(1.0, -0.5, 0.3) * distance, 1.0), model);
            println!("{distance:e} away: {found:.5?} for {expected:.5?}");
            for (found, expected) in found.iter().zip(&expected) {
                let (found, expected) = (found.expect("observable"), expected.expect("observable"));
                assert!((found - expected).abs() < 0.005 * expected, "{distance:e} away: {found} for {expected}");
            }
        }
        // Null but for rounding: a sigma of several e-folds.
        let scene = testing::scene_of(1, 10, 40, 0.0, Motion::Translation, false);
        let (found, optimum) = own_sigmas(&scene, model);
        let free = |sigma: Option<f64>| sigma.is_none_or(|sigma| sigma > 1.0);
        assert!(found.iter().all(|sigma| free(*sigma)), "{found:?}");
        assert!(free(optimum.variance_of(0, Parameter::LogFocal).map(|variance| variance.sqrt() * NOISE)));
    }

    /// What one linearisation predicts of a richer model, an adjustment of that model finds.
    #[test]
    fn the_optimum_of_a_richer_model_is_predicted() {
        for seed in 0..5 {
            let mut scene = testing::scene(seed, 8, 40, 0.0);
            scene.intrinsics.principal_point = Vector2::new(0.002, -0.001);
            scene.intrinsics.radial[0] = 0.001;
            scene.observe(0.0005, &mut rand::SeedableRng::seed_from_u64(seed));
            let adjusted = |start: &MetricReconstruction, model, prior: &IntrinsicsPrior| {
                let mut start = start.clone();
                let options = Options { max_iterations: 100, relative_tolerance: 1e-13, ..Options::DEFAULT };
                let stop = StopToken::default();
                let report =
                    adjust_all(&mut start, &scene.observations, model, std::slice::from_ref(prior), &options, &stop);
                (start, report.cost)
            };
            let prior = IntrinsicsPrior::NONE.knowing(Parameter::PrincipalX, 0.001, 0.01, 0.0005);
            let mut pinhole = scene.reconstruction();
            pinhole.intrinsics = vec![Intrinsics::from_focal(scene.intrinsics.focal)];
            let (simple, cost) = adjusted(&pinhole, IntrinsicsModel::FOCAL, &prior);
            let constant = simple.clone();
            let information = Information::new(&simple, &scene.observations).expect("poses");
            for model in IntrinsicsModel::FOCAL.with_any_extensions() {
                let predicted = information.optimum(model, &[prior]);
                let (found, found_cost) = adjusted(&simple, model, &prior);
                let rise = found_cost - cost;
                for parameter in Parameter::ALL {
                    let shift = found.intrinsics[0].value(parameter) - simple.intrinsics[0].value(parameter);
                    let sigma = predicted.variance_of(0, parameter).expect("observable").sqrt() * 0.0005;
                    let error = (predicted.shift_of(0, parameter) - shift).abs();
                    assert!(error <= 0.1 * sigma + 1e-9, "seed {seed}, {}: {parameter:?} off by {error}", model.name());
                }
                let error = (predicted.delta_cost - rise).abs() / (0.0005 * 0.0005);
                println!("seed {seed}, {}: chi-square off by {error:.3}", model.name());
                assert!(error < 0.2, "seed {seed}, {}: {error}", model.name());
            }
            // The same of focal lengths of which every view has its own.
            let (simple, _) = adjusted(&simple.with_own_focals(), IntrinsicsModel::FOCAL_PER_VIEW, &prior);
            let information = Information::new(&simple, &scene.observations).expect("poses");
            for model in IntrinsicsModel::FOCAL_PER_VIEW.with_any_extensions() {
                let predicted = information.own_focals(&information.optimum(model, &[prior]));
                let (found, _) = adjusted(&simple, model, &prior);
                assert_eq!(predicted.len(), 8);
                for (view, (variance, shift)) in predicted.into_iter().enumerate() {
                    let error = (shift - (found.focals[view] / simple.focals[view]).ln()).abs();
                    let sigma = variance.expect("observable").sqrt() * 0.0005;
                    assert!(error <= 0.1 * sigma + 1e-9, "seed {seed}, {}: view {view} off by {error}", model.name());
                }
            }
            // And back: from a rich model to the simple one. Not from the richest: what three radial terms do to each
            // other is beyond the second order.
            let model = [Extension::PrincipalPoint, Extension::Aspect, Extension::RadialK1, Extension::RadialK2]
                .into_iter()
                .fold(IntrinsicsModel::FOCAL, IntrinsicsModel::with);
            let (rich, rich_cost) = adjusted(&constant, model, &prior);
            let information = Information::new(&rich, &scene.observations).expect("poses");
            let back = information.optimum(IntrinsicsModel::FOCAL, &[prior]);
            let of_prior = prior.cost(&model.parameters(), &rich.intrinsics[0]);
            let error = (back.delta_cost - (cost - rich_cost + of_prior)).abs() / (0.0005 * 0.0005);
            assert!(error < 0.02 * (cost - rich_cost) / (0.0005 * 0.0005) + 0.2, "seed {seed}: {error}");
        }
    }

    #[test]
    fn an_adjustment_of_camera_groups_ends_at_the_predicted_optimum() {
        let model = IntrinsicsModel::FOCAL.with(Extension::RadialK1);
        for seed in 0..3 {
            println!("seed {seed}");
            let scene = testing::scene(seed, 8, 40, NOISE);
            let adjusted = |mut start: MetricReconstruction, model: IntrinsicsModel| {
                let options = Options { max_iterations: 100, relative_tolerance: 1e-13, ..Options::DEFAULT };
                let priors = [IntrinsicsPrior::NONE; 2];
                adjust_all(&mut start, &scene.observations, model, &priors, &options, &StopToken::default());
                start
            };
            let simple =
                adjusted(scene.reconstruction().in_groups(&[0, 0, 0, 0, 1, 1, 1, 1], 2), IntrinsicsModel::FOCAL);
            let rich = adjusted(simple.clone(), model);
            let information = Information::new(&simple, &scene.observations).expect("poses");
            let predicted = information.optimum(model, &[IntrinsicsPrior::NONE; 2]);
            for (group, parameter) in
                [0, 1].into_iter().flat_map(|group| model.parameters().into_iter().map(move |p| (group, p)))
            {
                let [from, to] = [&simple, &rich].map(|found| found.intrinsics[group].value(parameter));
                let sigma = predicted.variance_of(group, parameter).expect("observable").sqrt() * NOISE;
                let error = (to - from - predicted.shift_of(group, parameter)).abs() / sigma;
                assert!(error < 0.2, "group {group}, {parameter:?}: off by {error} sigma");
            }
        }
    }
}
