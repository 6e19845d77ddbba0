//! Projective bundle adjustment: free 3x4 cameras and homogeneous points.

use nalgebra::{Matrix3x4, SVector, Vector2, Vector4};

use super::engine::minimise;

use super::problem::{BundleProblem, Jacobian, Step, image, move_each, unit_norm};
use super::{Observation, Options, Report};
use crate::domain::StopToken;

/// Unknowns of a camera (row by row) and of a point.
const CAMERA: usize = 12;
const POINT: usize = 4;

#[derive(Clone)]
pub(super) struct Projective {
    pub cameras: Vec<Matrix3x4<f64>>,
    pub points: Vec<Vector4<f64>>,
}

impl BundleProblem<CAMERA, POINT> for Projective {
    fn counts(&self) -> (usize, usize) {
        (self.cameras.len(), self.points.len())
    }

    #[inline]
    fn evaluate(&self, seen: Observation) -> (Vector2<f64>, impl FnOnce() -> Jacobian<CAMERA, POINT>) {
        let camera = &self.cameras[seen.view];
        let point = &self.points[seen.point];
        let (image, by_seen) = image(&(camera * point));
        let jacobian = move || {
            let mut jacobian = Jacobian::<CAMERA, POINT>::zeros();
            for (component, by_seen) in by_seen.iter().enumerate() {
                for row in 0..3 {
                    for column in 0..4 {
                        jacobian.camera[(4 * row + column, component)] = by_seen[row] * point[column];
                    }
                }
                jacobian.point.set_column(component, &camera.tr_mul(by_seen));
            }
            jacobian
        };
        (image - seen.xy, jacobian)
    }

    fn retract(&mut self, from: &Self, step: &Step<CAMERA, POINT>) {
        move_each(&mut self.cameras, &from.cameras, &step.cameras, |camera, step| {
            unit_norm(&(camera + Matrix3x4::from_row_slice(step.as_slice())))
        });
        move_each(&mut self.points, &from.points, &step.points, |point, step| unit_norm(&(point + step)));
    }

    fn camera_gauge(&self, camera: usize) -> SVector<f64, CAMERA> {
        SVector::from_column_slice(self.cameras[camera].transpose().as_slice())
    }

    fn point_gauge(&self, point: usize) -> SVector<f64, POINT> {
        self.points[point]
    }
}

/// Minimises the reprojection error over cameras and points of a projective reconstruction.
///
/// * `cameras`: 3x4, any scale; returned at unit Frobenius norm
/// * `points`: homogeneous, any scale; returned at unit norm
/// * `observations`: normalised image coordinates
///
/// # Pitfall
/// The result is one member of a 15-parameter family: cameras times any 4x4 homography. Nothing holds the frame that
/// the start was in; signs are kept, up to rounding.
pub fn adjust(
    cameras: &mut [Matrix3x4<f64>],
    points: &mut [Vector4<f64>],
    observations: &[Observation],
    options: &Options,
    stop: &StopToken,
) -> Report {
    let mut problem =
        Projective { cameras: cameras.iter().map(unit_norm).collect(), points: points.iter().map(unit_norm).collect() };
    let report = minimise(&mut problem, observations, options, stop);
    cameras.copy_from_slice(&problem.cameras);
    points.copy_from_slice(&problem.points);
    report
}

/// Unknowns of so many cameras and points that observations could determine: all but those of the frame.
pub fn unknowns(cameras: usize, points: usize) -> usize {
    (11 * cameras + 3 * points).saturating_sub(15)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::super::Loss;
    use super::super::testing::{self, NOISE};
    use super::*;

    fn start(seed: u64, perturbation: f64) -> (Projective, Vec<Observation>) {
        let scene = testing::scene(seed, 8, 30, NOISE);
        let (cameras, points) = testing::projectively_transformed(&scene, seed);
        let mut problem = Projective {
            cameras: cameras.iter().map(unit_norm).collect(),
            points: points.iter().map(unit_norm).collect(),
        };
        testing::perturb(problem.cameras.iter_mut().flat_map(|camera| camera.iter_mut()), perturbation, seed);
        testing::perturb(problem.points.iter_mut().flat_map(|point| point.iter_mut()), perturbation, seed + 1);
        (problem, scene.observations)
    }

    fn adjusted(problem: &mut Projective, observations: &[Observation]) -> Report {
        let Projective { cameras, points } = problem;
        adjust(cameras, points, observations, &Options::DEFAULT, &StopToken::default())
    }

    #[test]
    fn jacobian_agrees_with_finite_differences() {
        let (problem, observations) = start(1, 0.01);
        testing::check_jacobian(&problem, &observations);
    }

    #[test]
    fn converges_from_a_perturbed_start_to_the_noise_floor() {
        for seed in 0..5 {
            let (mut problem, observations) = start(seed, 0.003);
            let report = adjusted(&mut problem, &observations);
            let freedom = 2 * observations.len() - (11 * problem.cameras.len() + 3 * problem.points.len() - 15);
            let ratio = report.cost / (freedom as f64 * NOISE * NOISE);
            println!("seed {seed}: {report:?}, chi2 per degree of freedom {ratio:.3}");
            assert!((0.7..1.3).contains(&ratio), "seed {seed}: {ratio}");
        }
    }

    #[test]
    fn a_robust_loss_ignores_a_wrong_observation() {
        let (problem, mut observations) = start(3, 0.003);
        observations[7].xy += Vector2::new(0.4, -0.3);
        let rms_of_the_rest = |loss| {
            let Projective { mut cameras, mut points } = problem.clone();
            let options = Options { loss, ..Options::DEFAULT };
            adjust(&mut cameras, &mut points, &observations, &options, &StopToken::default());
            let squared = observations.iter().enumerate().filter(|(k, _)| *k != 7).map(|(_, seen)| {
                let y = cameras[seen.view] * points[seen.point];
                (Vector2::new(y.x / y.z, y.y / y.z) - seen.xy).norm_squared()
            });
            (squared.sum::<f64>() / (2.0 * (observations.len() - 1) as f64)).sqrt()
        };
        let (robust, plain) = (rms_of_the_rest(Loss::Cauchy { scale: 3.0 * NOISE }), rms_of_the_rest(Loss::Squared));
        assert!(robust < 1.1 * NOISE && plain > 1.5 * robust, "robust {robust}, plain {plain}");
    }

    #[test]
    fn missing_and_duplicate_observations_are_carried() {
        let (mut problem, mut observations) = start(4, 0.002);
        observations.retain(|seen| (seen.view + seen.point) % 3 != 0);
        observations.push(observations[5]);
        let report = adjusted(&mut problem, &observations);
        let per_coordinate = (report.cost / (2 * observations.len()) as f64).sqrt();
        assert!(per_coordinate < NOISE, "{per_coordinate}");
    }

    #[test]
    fn degenerate_input_neither_panics_nor_yields_nan() {
        let (problem, observations) = start(5, 0.003);
        let run = |mut problem: Projective, observations: &[Observation]| {
            let report = adjusted(&mut problem, observations);
            assert!(report.cost.is_finite() && report.cost <= report.initial_cost, "{report:?}");
            problem
        };
        let all_finite = |problem: &Projective| {
            problem.cameras.iter().flat_map(|camera| camera.iter()).all(|value| value.is_finite())
                && problem.points.iter().flat_map(|point| point.iter()).all(|value| value.is_finite())
        };

        run(Projective { cameras: vec![], points: vec![] }, &[]);
        run(problem.clone(), &[]);
        // A point at infinity, the camera centre, the null vector; a camera that sees one point, one that is zero.
        let mut odd = problem.clone();
        odd.points[0] = Vector4::new(1.0, 0.0, 0.0, 0.0);
        odd.points[1] = Vector4::zeros();
        let eigen = (odd.cameras[2].transpose() * odd.cameras[2]).symmetric_eigen();
        odd.points[2] = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
        odd.cameras[3] = Matrix3x4::zeros();
        let mut few = observations.clone();
        few.retain(|seen| seen.view != 4 || seen.point == 6);
        assert!(all_finite(&run(odd, &few)));
        // Indices out of range and coordinates that are no numbers.
        let mut hostile = observations.clone();
        hostile[0].view = 99;
        hostile[1].point = usize::MAX;
        hostile[2].xy.x = f64::NAN;
        hostile[3].xy.y = 1e300;
        assert!(all_finite(&run(problem.clone(), &hostile)));
        // Nothing but NaN: returned as it came.
        let mut broken = problem;
        broken.cameras[0].fill(f64::NAN);
        run(broken, &observations);
    }

    #[test]
    fn a_stopped_token_leaves_the_start() {
        let (mut problem, observations) = start(6, 0.003);
        let stop = StopToken::default();
        stop.stop(crate::domain::StopReason::Cancelled);
        let before = problem.points.clone();
        let report = adjust(&mut problem.cameras, &mut problem.points, &observations, &Options::DEFAULT, &stop);
        assert_eq!(report.iterations, 0);
        assert!(problem.points.iter().zip(&before).all(|(point, before)| (point - before.normalize()).norm() < 1e-12));
    }
}
