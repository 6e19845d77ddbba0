//! How well the intrinsics are determined, whatever the gauge.

use nalgebra::{DMatrix, DVector, SMatrix, SVector};

use super::engine::Layout;
use super::intrinsics::Intrinsics;
use super::intrinsics_model::{IntrinsicsModel, IntrinsicsPrior, Parameter};
use super::metric::{Metric, POINT, POSE, Pose, Reconstruction};
use super::reduced::{Linearisation, Reduced};
use super::whitened::{WhitenedViews, centre};
use super::{Loss, Observation};

const PARAMETERS: usize = Parameter::COUNT;
/// Of every pair of intrinsics.
type Coupled = SMatrix<f64, PARAMETERS, PARAMETERS>;
/// Part of a parameter's information, as the root of a share, that a direction of the poses may take and still count as
/// apart from the intrinsics: what rounding leaves where the two have nothing to do with each other.
const APART: f64 = 1e-11;
/// Information on the intrinsics, scaled by what they would have with everything else known, that counts as none.
const NULL_INTRINSICS: f64 = 1e-10;

/// What the observations say of all the intrinsics together, poses and points marginalised, at one reconstruction.
///
/// For observations with unit variance. From one linearisation it tells of every model at once where its minimum is,
/// how low, and how well determined: a score test in place of an adjustment a model.
#[derive(Debug, Clone, Copy)]
pub struct Information {
    intrinsics: Intrinsics,
    matrix: Coupled,
    /// Half the downward gradient of the cost.
    pull: SVector<f64, PARAMETERS>,
    /// The matrix' diagonal were poses and points known.
    known: [f64; PARAMETERS],
}

/// The minimum of the cost over the intrinsics of one model, to second order; indexed by [`Parameter`].
///
/// Parameters that the model does not free are where a pinhole has them, a focal length that it does not free stays.
#[derive(Debug, Clone, Copy)]
pub struct Optimum {
    /// Value there minus value here.
    pub shift: [f64; PARAMETERS],
    /// Variances for observations with unit variance; multiply by the squared noise. `None`: the observations do not
    /// determine it (the variance is infinite). What is not free has variance 0.
    pub variance: [Option<f64>; PARAMETERS],
    /// Cost there, prior included, minus the cost of the observations here.
    pub rise: f64,
    /// Natural logarithm of the determinant of the information on what is free. Null directions count as barely known.
    pub log_determinant: f64,
}

impl Optimum {
    /// Variance of one parameter.
    pub fn variance_of(&self, parameter: Parameter) -> Option<f64> {
        self.variance[parameter as usize]
    }
}

impl Information {
    /// Linearises at this reconstruction.
    ///
    /// The seven directions of a similarity are projected out. Returns `None` without poses, or where the system
    /// holds what is no number.
    pub fn new(reconstruction: &Reconstruction, observations: &[Observation]) -> Option<Self> {
        let poses = reconstruction.poses.len();
        if poses == 0 {
            return None;
        }
        let layout = Layout::new(observations, poses, reconstruction.points.len());
        let mut centred = reconstruction.clone();
        centre(&mut centred.poses, &mut centred.points);
        let problem = Metric { reconstruction: centred, free: Parameter::ALL, prior: IntrinsicsPrior::NONE };
        let mut linearisation = Linearisation::<PARAMETERS, POSE, POINT>::new(&layout, poses);
        linearisation.fill(&problem, &layout, Loss::Squared);
        let known = std::array::from_fn(|k| linearisation.globals_diagonal()[k]);
        let mut reduced = Reduced::new(&layout, poses);
        if !reduced.build(&problem, &layout, &linearisation, 0.0) {
            return None;
        }
        let (matrix, pull) = without_poses(&reduced.matrix, &reduced.vector, &known, &problem.reconstruction.poses)?;
        let finite = matrix.iter().chain(pull.iter()).all(|value| value.is_finite());
        finite.then_some(Self { intrinsics: reconstruction.intrinsics, matrix, pull, known })
    }

    /// Where the cost of a model is least, how low it is there, and how well that is determined.
    ///
    /// A null direction of the information makes every parameter that takes part in it infinitely uncertain, rather
    /// than vanish in a pseudo-inverse.
    pub fn optimum(&self, model: IntrinsicsModel, prior: &IntrinsicsPrior) -> Optimum {
        let free: Vec<usize> = model.parameters().into_iter().map(|parameter| parameter as usize).collect();
        let mut shift = SVector::<f64, PARAMETERS>::zeros();
        for parameter in Parameter::ALL {
            if parameter != Parameter::LogFocal && !free.contains(&(parameter as usize)) {
                shift[parameter as usize] = -self.intrinsics.value(parameter);
            }
        }
        let deviation = Parameter::ALL.map(|parameter| prior.deviation(parameter, &self.intrinsics));
        let pull = self.pull - self.matrix * shift;
        let scale: Vec<f64> = free.iter().map(|&k| scale_of(self.known[k] + prior.information[k])).collect();
        let scaled = DMatrix::from_fn(free.len(), free.len(), |row, column| {
            let (k, l) = (free[row], free[column]);
            let believed = if k == l { prior.information[k] } else { 0.0 };
            (self.matrix[(k, l)] + believed) * scale[row] * scale[column]
        });
        let target = DVector::from_fn(free.len(), |row, _| {
            let k = free[row];
            (pull[k] - prior.information[k] * deviation[k]) * scale[row]
        });
        // Of nothing there is no decomposition.
        let eigen = (!free.is_empty()).then(|| scaled.symmetric_eigen());
        let mut variance = [Some(0.0); PARAMETERS];
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
                } else if share > NULL_INTRINSICS {
                    variance[k] = None;
                }
            }
        }
        let believed: f64 = free.iter().map(|&k| prior.information[k] * (deviation[k] + shift[k]).powi(2)).sum();
        let rise = shift.dot(&(self.matrix * shift)) - 2.0 * self.pull.dot(&shift) + believed;
        Optimum { shift: shift.into(), variance, rise, log_determinant }
    }
}

/// Unit information for a parameter of which something is known.
fn scale_of(information: f64) -> f64 {
    if information > 0.0 { information.sqrt().recip() } else { 1.0 }
}

/// Eliminates the poses from the reduced system, whose first unknowns are the intrinsics; its lower triangle is given.
///
/// A direction of the poses on which rounding hides what the observations say, but which goes along with the
/// intrinsics, is taken to be as free as it can be: the intrinsics have no information left along with it. Taken as
/// known, it would make them certain.
fn without_poses(
    matrix: &[f64],
    vector: &[f64],
    known: &[f64; PARAMETERS],
    poses: &[Pose],
) -> Option<(Coupled, SVector<f64, PARAMETERS>)> {
    let dimension = PARAMETERS + POSE * poses.len();
    let at = |row: usize, column: usize| matrix[column * dimension + row];
    let mut information = Coupled::from_fn(|row, column| at(row.max(column), row.min(column)));
    let mut pull = SVector::from_fn(|row, _| vector[row]);
    let views = WhitenedViews::<POSE>::new(matrix, PARAMETERS, poses)?;
    let of_view =
        |view: usize, column: usize| SVector::<f64, POSE>::from_fn(|row, _| at(PARAMETERS + POSE * view + row, column));
    let coupling: Vec<DVector<f64>> =
        (0..PARAMETERS).map(|column| views.function(|view| of_view(view, column))).collect();
    let gradient =
        views.function(|view| SVector::<f64, POSE>::from_fn(|row, _| vector[PARAMETERS + POSE * view + row]));
    let mut free = Vec::new();
    for (value, direction) in views.directions() {
        let along = SVector::<f64, PARAMETERS>::from_fn(|row, _| coupling[row].dot(&direction));
        match value {
            Some(value) => {
                information -= along * along.transpose() / value;
                pull -= along * (gradient.dot(&direction) / value);
            }
            None => free.push(along),
        }
    }
    let scale = SVector::<f64, PARAMETERS>::from_fn(|row, _| scale_of(known[row]));
    for along in free {
        let along = along.component_mul(&scale);
        if along.amax() <= APART {
            continue;
        }
        // The most that leaves the information positive.
        let scaled = Coupled::from_fn(|row, column| information[(row, column)] * scale[row] * scale[column]);
        let Some(solved) = scaled.cholesky().map(|factor| factor.solve(&along)) else { continue };
        let taken = along * along.transpose() / along.dot(&solved);
        information -= Coupled::from_fn(|row, column| taken[(row, column)] / (scale[row] * scale[column]));
    }
    Some((information, pull))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector2, Vector3};

    use super::super::Options;
    use super::super::metric::{Extension, adjust};
    use super::super::testing::{self, Motion, NOISE, TestScene};
    use super::*;
    use crate::domain::StopToken;

    fn truth(scene: &TestScene) -> Reconstruction {
        Reconstruction { intrinsics: scene.intrinsics, poses: scene.poses.clone(), points: scene.points.clone() }
    }

    fn optimum(scene: &TestScene, model: IntrinsicsModel) -> Optimum {
        let information = Information::new(&truth(scene), &scene.observations).expect("poses");
        information.optimum(model, &IntrinsicsPrior::NONE)
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

    /// One pose of which the observations say next to nothing but together with the focal length.
    #[test]
    fn a_pose_that_is_hidden_by_rounding_leaves_the_focal_length_free() {
        // A turn of one view against the other is no similarity.
        let pose = |x: f64| Pose { rotation: Matrix3::identity(), translation: Vector3::new(x, 0.0, 0.0) };
        let dimension = PARAMETERS + 2 * POSE;
        let system = |weak: f64, coupled: f64| {
            let mut matrix = DMatrix::<f64>::identity(dimension, dimension);
            let (first, second) = (PARAMETERS, PARAMETERS + POSE);
            matrix[(second, first)] = 1.0 - weak;
            matrix[(first, 0)] = coupled * (weak / 2.0).sqrt();
            matrix[(second, 0)] = -matrix[(first, 0)];
            let poses = [pose(0.0), pose(1.0)];
            without_poses(matrix.as_slice(), &vec![0.0; dimension], &[1.0; PARAMETERS], &poses).expect("finite").0
        };
        for weak in [1e-4, 1e-9, 1e-15] {
            let left = system(weak, 0.999)[(0, 0)];
            println!("{weak:e}: {left}");
            assert!(left < 0.01, "{weak:e}: {left}");
        }
        assert_eq!(system(1e-15, 0.0)[(0, 0)], 1.0, "what is apart from the poses is left alone");
    }

    #[test]
    fn translation_and_forward_motion_leave_the_focal_length_free() {
        for motion in [Motion::Translation, Motion::Forward] {
            for seed in 0..3 {
                let scene = testing::scene_of(seed, 10, 20, 0.0, motion, false);
                let optimum = optimum(&scene, IntrinsicsModel::FOCAL);
                println!("{motion:?} seed {seed}: {optimum:?}");
                assert_eq!(optimum.variance_of(Parameter::LogFocal), None, "{motion:?} seed {seed}");
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
                optimum.variance_of(Parameter::LogFocal).expect("observable").sqrt() * NOISE
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

    /// What one linearisation foretells of a richer model, an adjustment of that model finds.
    #[test]
    fn the_optimum_of_a_richer_model_is_foretold() {
        for seed in 0..5 {
            let mut scene = testing::scene(seed, 8, 40, 0.0);
            scene.intrinsics.principal_point = Vector2::new(0.002, -0.001);
            scene.intrinsics.radial = 0.001;
            scene.observe(0.0005, &mut rand::SeedableRng::seed_from_u64(seed));
            let adjusted = |start: &Reconstruction, model, prior: &IntrinsicsPrior| {
                let mut start = start.clone();
                let options = Options { max_iterations: 100, relative_tolerance: 1e-13, ..Options::default() };
                let stop = StopToken::default();
                let report = adjust(&mut start, &scene.observations, model, prior, &options, &stop);
                (start, report.cost)
            };
            let prior = IntrinsicsPrior::NONE.knowing(Parameter::PrincipalX, 0.001, 0.01, 0.0005);
            let mut pinhole = truth(&scene);
            pinhole.intrinsics = Intrinsics::from_focal(scene.intrinsics.focal);
            let (simple, cost) = adjusted(&pinhole, IntrinsicsModel::FOCAL, &prior);
            let information = Information::new(&simple, &scene.observations).expect("poses");
            for model in IntrinsicsModel::all() {
                let foretold = information.optimum(model, &prior);
                let (found, found_cost) = adjusted(&simple, model, &prior);
                let rise = found_cost - cost;
                for parameter in Parameter::ALL {
                    let shift = found.intrinsics.value(parameter) - simple.intrinsics.value(parameter);
                    let sigma = foretold.variance_of(parameter).expect("observable").sqrt() * 0.0005;
                    let error = (foretold.shift[parameter as usize] - shift).abs();
                    assert!(error <= 0.1 * sigma + 1e-9, "seed {seed}, {}: {parameter:?} off by {error}", model.name());
                }
                let error = (foretold.rise - rise).abs() / (0.0005 * 0.0005);
                println!("seed {seed}, {}: chi-square off by {error:.3}", model.name());
                assert!(error < 0.2, "seed {seed}, {}: {error}", model.name());
            }
            // And back: from the richest model to the simple one.
            let (rich, rich_cost) = adjusted(&simple, IntrinsicsModel::FULL, &prior);
            let information = Information::new(&rich, &scene.observations).expect("poses");
            let back = information.optimum(IntrinsicsModel::FOCAL, &prior);
            let believed = prior.cost(IntrinsicsModel::FULL, &rich.intrinsics);
            let error = (back.rise - (cost - rich_cost + believed)).abs() / (0.0005 * 0.0005);
            assert!(error < 0.02 * (cost - rich_cost) / (0.0005 * 0.0005) + 0.2, "seed {seed}: {error}");
        }
    }
}
