//! The dual absolute quadric (DAQ): its residual over the views, its refinement, and where to start.
//!
//! Cameras are in the frame of the first view, `P1 = [I|0]`, see [`to_canonical_frame`]. May depend on `bundle` for
//! the intrinsics, otherwise on linear algebra alone.

mod frame;
mod starts;

use nalgebra::{Matrix3, Matrix3x4, SMatrix, SVector, Vector3};

pub use self::frame::{CanonicalFrame, oriented, to_canonical_frame};
pub use self::starts::{scan, scan_focal, scan_planes, view_focal, view_focal_starts};
use super::bundle::metric::Intrinsics;
use super::levenberg_marquardt::{self, LeastSquares, Normal, Options};
use crate::domain::StopToken;

/// Unknowns of the refinement: log focal and the plane at infinity.
const UNKNOWNS: usize = 4;
/// Distinct entries of a symmetric 3x3 matrix.
const ENTRIES: usize = 6;
/// First damping of the refinement, whose Jacobian is well scaled, so that little is needed; and the share of the
/// residual by which a step has to lower it for another to follow.
const INITIAL_DAMPING: f64 = 1e-3;
const RELATIVE_TOLERANCE: f64 = 1e-8;
/// Information beside what the views give, as a share of it: for directions that no view determines (pure rotation).
const BESIDE: f64 = 1e-12;
/// Focal lengths of the short scan that a hypothesis gets, and views it is tried from: the refinement pulls in starts
/// that are a factor of 1.5 away.
const HYPOTHESIS_FOCALS: usize = 8;
const HYPOTHESIS_VIEWS: usize = 2;
/// Starts of a hypothesis that are refined, and their iterations.
const HYPOTHESIS_STARTS: usize = 3;
const HYPOTHESIS_ITERATIONS: usize = 12;

/// The DAQ of a camera with constant intrinsics, in the frame of the first view (paper, eq. 5).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Daq {
    pub intrinsics: Intrinsics,
    /// `n` of the plane `(n, 1)`.
    pub plane_at_infinity: Vector3<f64>,
}

impl Daq {
    /// Square pixels and the principal point where it was guessed.
    pub fn new(focal: f64, plane_at_infinity: Vector3<f64>) -> Self {
        Self { intrinsics: Intrinsics::from_focal(focal), plane_at_infinity }
    }

    /// Dual image of the absolute conic, `K K'`.
    pub fn diac(&self) -> Matrix3<f64> {
        let calibration = self.intrinsics.matrix();
        calibration * calibration.transpose()
    }

    fn moved(&self, step: &SVector<f64, UNKNOWNS>) -> Self {
        let focal = self.intrinsics.focal * step[0].exp();
        let plane_at_infinity = self.plane_at_infinity + step.fixed_rows::<3>(1);
        Self { intrinsics: Intrinsics { focal, ..self.intrinsics }, plane_at_infinity }
    }
}

/// The DAQ residual `1/2 sum_i |S_i/|S_i| - w/|w||^2` with `S_i = P_i Q P_i'` and `w = K K'`.
///
/// The paper (eq. 9) sums the norms; their squares are smooth at the solution. A view whose projection of the quadric
/// vanishes counts 1, as the worst there is. Between 0 and the number of views.
pub fn residual(cameras: &[Matrix3x4<f64>], daq: &Daq) -> f64 {
    let diac = daq.diac();
    let unit = diac / diac.norm();
    let halves = cameras.iter().map(|camera| {
        let homography = infinite_homography(camera, daq);
        let seen = homography * diac * homography.transpose();
        let norm = seen.norm();
        if norm > f64::MIN_POSITIVE && norm.is_finite() { 0.5 * (seen / norm - unit).norm_squared() } else { 1.0 }
    });
    halves.sum()
}

/// `A - a n'` for `P = [A|a]`: the homography that the plane at infinity induces between the first view and this one.
fn infinite_homography(camera: &Matrix3x4<f64>, daq: &Daq) -> Matrix3<f64> {
    camera.fixed_columns::<3>(0) - camera.column(3) * daq.plane_at_infinity.transpose()
}

/// Entries of a symmetric matrix such that the Euclidean norm of the vector is the Frobenius norm of the matrix.
fn entries(matrix: &Matrix3<f64>) -> SVector<f64, ENTRIES> {
    let root = std::f64::consts::SQRT_2;
    SVector::from([matrix.m11, matrix.m22, matrix.m33, root * matrix.m12, root * matrix.m13, root * matrix.m23])
}

/// The residual of one view and its derivatives by log focal and the plane at infinity.
///
/// `None` when the projection of the quadric vanishes.
fn linearise(camera: &Matrix3x4<f64>, daq: &Daq) -> Option<(SVector<f64, ENTRIES>, SMatrix<f64, ENTRIES, UNKNOWNS>)> {
    let diac = daq.diac();
    let homography = infinite_homography(camera, daq);
    let Intrinsics { focal, aspect, .. } = daq.intrinsics;
    let by_log_focal = Matrix3::from_diagonal(&Vector3::new(1.0, aspect * aspect, 0.0)) * (2.0 * focal * focal);
    let seen = homography * diac * homography.transpose();
    let (norm, first_norm) = (seen.norm(), diac.norm());
    if !(norm > f64::MIN_POSITIVE && norm.is_finite() && first_norm.is_finite()) {
        return None;
    }
    // Derivative of `S/|S|` along `dS`.
    let of_unit = |matrix: &Matrix3<f64>, norm: f64, along: &Matrix3<f64>| {
        (along - matrix * (matrix.dot(along) / (norm * norm))) / norm
    };
    let mut jacobian = SMatrix::<f64, ENTRIES, UNKNOWNS>::zeros();
    let of_seen = of_unit(&seen, norm, &(homography * by_log_focal * homography.transpose()));
    jacobian.set_column(0, &entries(&(of_seen - of_unit(&diac, first_norm, &by_log_focal))));
    let weighted = diac * homography.transpose();
    for k in 0..3 {
        let half = camera.column(3) * weighted.row(k);
        jacobian.set_column(1 + k, &entries(&of_unit(&seen, norm, &-(half + half.transpose()))));
    }
    Some((entries(&(seen / norm - diac / first_norm)), jacobian))
}

/// Which unknowns the refinement moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Free {
    FocalAndPlane,
    /// The intrinsics are known.
    Plane,
}

/// Minimises [`residual`] by Levenberg-Marquardt from `start`; returns the best state and its residual.
///
/// Never worse than the start; not a number only if the start is.
pub fn refine(cameras: &[Matrix3x4<f64>], start: Daq, free: Free, max_iterations: usize) -> (Daq, f64) {
    let options = Options {
        max_iterations,
        relative_tolerance: RELATIVE_TOLERANCE,
        initial_damping: INITIAL_DAMPING,
        ..Options::DEFAULT
    };
    let mut best = start;
    let mut refinement = Refinement { cameras, free, normal: Normal::zeros() };
    let report = levenberg_marquardt::minimise(&mut refinement, &mut best, &options, &StopToken::default());
    (best, report.cost)
}

struct Refinement<'a> {
    cameras: &'a [Matrix3x4<f64>],
    free: Free,
    normal: Normal<UNKNOWNS>,
}

impl LeastSquares for Refinement<'_> {
    type State = Daq;

    fn cost(&self, daq: &Daq) -> f64 {
        residual(self.cameras, daq)
    }

    fn linearise(&mut self, daq: &Daq) {
        self.normal = Normal::zeros();
        for (residual, mut jacobian) in self.cameras.iter().filter_map(|camera| linearise(camera, daq)) {
            if self.free == Free::Plane {
                jacobian.column_mut(0).fill(0.0);
            }
            // The cost is half the sum of the squares.
            self.normal.matrix += 0.5 * jacobian.tr_mul(&jacobian);
            self.normal.gradient += 0.5 * jacobian.tr_mul(&residual);
        }
        let beside = BESIDE * (1.0 + self.normal.matrix.trace());
        self.normal.matrix += SMatrix::from_diagonal_element(beside);
    }

    fn step(&mut self, from: &Daq, damping: f64, to: &mut Daq) -> Option<f64> {
        let (step, predicted) = self.normal.solve(damping)?;
        *to = from.moved(&step);
        Some(predicted)
    }
}

/// How badly cameras can be those of one constant calibration: the least [`residual`] over focal length and plane at
/// infinity, from a few starts. Any projective frame will do.
///
/// Meant to rank hypotheses, where it is the term that tells true inliers from a chance consensus of low rank: at
/// 98 % outliers mean F1 .975 with it, .68 without. A score, not a veto: near-degenerate true sets reach 1.3.
///
/// Returns the number of cameras, the worst value there is, when the first camera has no rank 3 or no start stands.
pub fn hypothesis_residual(cameras: &[Matrix3x4<f64>]) -> f64 {
    let worst = cameras.len() as f64;
    let Some(frame) = to_canonical_frame(cameras, &[]) else { return worst };
    let mut starts = scan(&frame.cameras, HYPOTHESIS_FOCALS, HYPOTHESIS_VIEWS);
    starts.truncate(HYPOTHESIS_STARTS);
    starts
        .iter()
        .map(|(start, _)| refine(&frame.cameras, *start, Free::FocalAndPlane, HYPOTHESIS_ITERATIONS).1)
        .filter(|residual| residual.is_finite())
        .fold(worst, f64::min)
}

#[cfg(test)]
mod tests {
    use super::super::bundle::testing::{self, NOISE};
    use super::*;
    use nalgebra::Vector2;

    /// Cameras of a scene in a random projective frame, brought back to the frame of the first view, with the truth.
    fn framed(seed: u64) -> (Vec<Matrix3x4<f64>>, f64) {
        let scene = testing::scene(seed, 10, 20, 0.0);
        let (cameras, points) = testing::projectively_transformed(&scene, seed);
        let frame = to_canonical_frame(&cameras, &points).expect("rank 3");
        (frame.cameras, scene.intrinsics.focal)
    }

    #[test]
    fn derivatives_agree_with_finite_differences() {
        let (cameras, focal) = framed(1);
        let mut daq = Daq::new(1.2 * focal, Vector3::new(0.3, -0.2, 0.1));
        daq.intrinsics.principal_point = Vector2::new(0.05, -0.1);
        daq.intrinsics.aspect = 1.1;
        for camera in &cameras {
            let (_, jacobian) = linearise(camera, &daq).expect("not degenerate");
            for k in 0..UNKNOWNS {
                let side = |width: f64| {
                    let mut step = SVector::<f64, UNKNOWNS>::zeros();
                    step[k] = width;
                    linearise(camera, &daq.moved(&step)).expect("not degenerate").0
                };
                let numeric = (side(1e-6) - side(-1e-6)) / 2e-6;
                assert!((numeric - jacobian.column(k)).norm() < 1e-7, "unknown {k}: {numeric} {jacobian}");
            }
        }
    }

    #[test]
    fn the_residual_is_half_the_squared_norm_of_what_is_linearised() {
        let (cameras, focal) = framed(2);
        let daq = Daq::new(0.7 * focal, Vector3::new(-0.1, 0.4, 0.2));
        let sum: f64 =
            cameras.iter().map(|camera| 0.5 * linearise(camera, &daq).expect("not degenerate").0.norm_squared()).sum();
        assert!((residual(&cameras, &daq) - sum).abs() < 1e-12);
    }

    #[test]
    fn refinement_of_the_best_start_finds_the_focal_length() {
        for seed in 0..10 {
            let (cameras, focal) = framed(seed);
            let mut found: Vec<(Daq, f64)> = scan(&cameras, 40, 4);
            found.truncate(8);
            let refined = found.iter().map(|(start, _)| refine(&cameras, *start, Free::FocalAndPlane, 50));
            let (best, cost) = refined.min_by(|a, b| a.1.total_cmp(&b.1)).expect("starts");
            println!("seed {seed}: focal {} of {focal}, residual {cost:e}", best.intrinsics.focal);
            assert!((best.intrinsics.focal / focal - 1.0).abs() < 1e-4, "seed {seed}");
        }
    }

    #[test]
    fn a_known_calibration_needs_only_its_plane() {
        let (cameras, focal) = framed(3);
        let (start, _) = scan(&cameras, 40, 4)[0];
        let (best, cost) = refine(&cameras, Daq::new(focal, start.plane_at_infinity), Free::Plane, 50);
        assert_eq!(best.intrinsics.focal, focal);
        assert!(cost < 1e-8, "{cost}");
    }

    #[test]
    fn hypotheses_of_true_cameras_score_far_below_arbitrary_ones() {
        for seed in 0..10 {
            let scene = testing::scene(seed, 10, 20, NOISE);
            let (mut cameras, _) = testing::projectively_transformed(&scene, seed);
            testing::perturb(cameras.iter_mut().flat_map(|camera| camera.iter_mut()), 0.003, seed);
            let of_truth = hypothesis_residual(&cameras);
            testing::perturb(cameras.iter_mut().flat_map(|camera| camera.iter_mut()), 1.0, seed);
            let of_noise = hypothesis_residual(&cameras);
            println!("seed {seed}: {of_truth:.4} {of_noise:.4}");
            assert!(of_truth < 0.1 && of_noise > 4.0 * of_truth, "seed {seed}: {of_truth} {of_noise}");
        }
    }

    #[test]
    fn hostile_cameras_get_the_worst_score() {
        assert_eq!(hypothesis_residual(&[]), 0.0);
        assert_eq!(hypothesis_residual(&[Matrix3x4::zeros(); 3]), 3.0);
        assert_eq!(hypothesis_residual(&[Matrix3x4::from_element(f64::NAN); 2]), 2.0);
        let rotation_only = [Matrix3x4::identity(); 4];
        assert!(hypothesis_residual(&rotation_only) <= 4.0);
        let one_zero = [Matrix3x4::identity(), Matrix3x4::zeros()];
        assert!(hypothesis_residual(&one_zero) <= 2.0);
    }
}
