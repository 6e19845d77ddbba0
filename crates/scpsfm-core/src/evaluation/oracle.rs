//! What the best could do who knows the truth: the limit that every method is held against.

use std::time::Instant;

use nalgebra::{Matrix3, Matrix4, Rotation3, Vector2, Vector3, Vector4};

use super::measures::{Measures, error_3d, true_image_px, true_points};
use crate::domain::StopToken;
use crate::geometry::bundle::Options;
use crate::geometry::bundle::metric::{
    Information, Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Parameter, Pose,
};
use crate::geometry::bundle::sequence;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::chi_square_gate;
use crate::geometry::{Camera, triangulation};
use crate::synthetic::Scene;
use crate::synthetic::metrics::agreement;
use crate::synthetic::scene::IMAGE_SIDE_PX;

/// Refinement steps of a point under the true cameras.
const POINT_STEPS: usize = 8;
/// Iterations of the adjustment, which starts at the truth.
const ADJUSTMENT_ITERATIONS: usize = 60;
const ADJUSTMENT_TOLERANCE: f64 = 1e-10;
/// Least noise that the gate assumes, as a share of the width: exact scenes have rounding.
const LEAST_NOISE: f64 = 1e-9;

/// Scores the oracle on a scene whose tracks are complete: the true cameras and the true noise gate every track, metric
/// bundle adjustment of the true inliers, started at the truth, gives the rest.
///
/// Knows pinholes only: scenes with distortion or a zoom have no oracle.
pub fn measure(scene: &Scene) -> Measures {
    let begun = Instant::now();
    let world = World::new(scene);
    let found: Vec<bool> = (0..scene.options.tracks).map(|track| world.accepts(track)).collect();
    let inliers = agreement(&found, &scene.truth.inlier);
    let calibrated = world.calibrate();
    Measures {
        f1: inliers.f1,
        precision: inliers.precision,
        recall: inliers.recall,
        observations: None,
        solved: true,
        error_2d_px: calibrated.as_ref().map(|calibrated| calibrated.error_2d_px),
        error_3d: calibrated.as_ref().and_then(|calibrated| calibrated.error_3d),
        log_focal_error: calibrated.as_ref().map(|calibrated| calibrated.log_focal_error),
        sigma_log_focal: calibrated.and_then(|calibrated| calibrated.bound),
        grade: None,
        warnings: Vec::new(),
        seconds: begun.elapsed().as_secs_f64(),
        winning_proposal: None,
        iterations: 0,
    }
}

/// A scene in normalised units: the image width is 1, the true principal point the origin.
struct World<'a> {
    scene: &'a Scene,
    poses: Vec<Pose>,
    cameras: Vec<Camera>,
    focal: f64,
    noise: f64,
}

struct Calibrated {
    log_focal_error: f64,
    /// Cramer-Rao bound of the standard deviation of the log focal length, at the truth; `None`: unobservable.
    bound: Option<f64>,
    error_2d_px: f64,
    error_3d: Option<f64>,
}

impl<'a> World<'a> {
    fn new(scene: &'a Scene) -> Self {
        let truth = &scene.truth;
        let focal = truth.focal_px / f64::from(IMAGE_SIDE_PX);
        let intrinsics = Intrinsics::from_focal(focal);
        let poses: Vec<Pose> = truth
            .rotations
            .iter()
            .zip(&truth.translations)
            .map(|(rotation, translation)| Pose {
                rotation: *Rotation3::from_matrix(&Matrix3::from_fn(|row, column| rotation[row][column])).matrix(),
                translation: Vector3::from(*translation),
            })
            .collect();
        let cameras = poses.iter().map(|pose| pose.camera(&intrinsics)).collect();
        Self { scene, poses, cameras, focal, noise: scene.options.noise.max(LEAST_NOISE) }
    }

    /// The generator writes view by view, track by track.
    fn place(&self, view: usize, track: usize) -> usize {
        view * self.scene.options.tracks + track
    }

    fn point(&self, view: usize, track: usize) -> Vector2<f64> {
        let input = &self.scene.input;
        let place = self.place(view, track);
        let offset = Vector2::new(input.x[place], input.y[place]) - Vector2::from(self.scene.truth.principal_point_px);
        offset / f64::from(IMAGE_SIDE_PX)
    }

    fn accepts(&self, track: usize) -> bool {
        let views = self.cameras.len() as f64;
        let variance = self.noise * self.noise;
        if self.scene.options.with_depths {
            return self.squared_with_depths(track) < chi_square_gate(3.0 * views - 4.0) * variance;
        }
        let observations: Vec<Observation> =
            (0..self.cameras.len()).map(|view| Observation::new(view, track, self.point(view, track))).collect();
        let start = triangulation::linear(&self.cameras, &observations);
        let (_, squared) = triangulation::refine(&self.cameras, &observations, start, POINT_STEPS);
        squared < chi_square_gate(2.0 * views - 3.0) * variance
    }

    /// Squared residual of a track with depths, image coordinates and relative depths in one unit: the homogeneous
    /// point of least squares under `P X = depth (x, 1)`, rows divided by the depth.
    fn squared_with_depths(&self, track: usize) -> f64 {
        let mut normal = Matrix4::zeros();
        let mut right = Vector4::zeros();
        let mut rows: Vec<(Vector4<f64>, f64)> = Vec::with_capacity(3 * self.cameras.len());
        for (view, camera) in self.cameras.iter().enumerate() {
            let xy = self.point(view, track);
            let depth = self.scene.input.depth[self.place(view, track)];
            let third = camera.row(2).transpose();
            let row = |k: usize| (camera.row(k).transpose() - xy[k] * third) / depth;
            rows.extend([(row(0), 0.0), (row(1), 0.0), (third / depth, 1.0)]);
        }
        for (row, value) in &rows {
            normal += row * row.transpose();
            right += *row * *value;
        }
        let Some(point) = normal.cholesky().map(|factor| factor.solve(&right)) else { return f64::INFINITY };
        rows.iter().map(|(row, value)| (value - row.dot(&point)).powi(2)).sum()
    }

    /// Metric bundle adjustment of the true inliers; `None` when they leave nothing over to calibrate from.
    fn calibrate(&self) -> Option<Calibrated> {
        let truth = &self.scene.truth;
        let inliers: Vec<usize> = (0..truth.inlier.len()).filter(|&track| truth.inlier[track]).collect();
        let unknowns = 6 * self.poses.len() + 3 * inliers.len() + 1;
        if 2 * self.poses.len() * inliers.len() + 7 <= unknowns {
            return None;
        }
        let observations: Vec<Observation> = inliers
            .iter()
            .enumerate()
            .flat_map(|(point, &track)| {
                (0..self.poses.len()).map(move |view| Observation::new(view, point, self.point(view, track)))
            })
            .collect();
        let points = true_points(truth, &inliers);
        let mut found =
            MetricReconstruction::new(Intrinsics::from_focal(self.focal), self.poses.clone(), points.clone());
        let bound = Information::new(&found, &observations).and_then(|information| {
            information.optimum(IntrinsicsModel::FOCAL, &[IntrinsicsPrior::NONE]).variance_of(0, Parameter::LogFocal)
        });
        let options = Options {
            max_iterations: ADJUSTMENT_ITERATIONS,
            relative_tolerance: ADJUSTMENT_TOLERANCE,
            ..Options::DEFAULT
        };
        sequence::adjust_all(
            &mut found,
            &observations,
            IntrinsicsModel::FOCAL,
            &[IntrinsicsPrior::NONE],
            &options,
            &StopToken::default(),
        );
        let side = f64::from(IMAGE_SIDE_PX);
        let squared: f64 = observations
            .iter()
            .map(|seen| {
                let noise_free =
                    true_image_px(truth, seen.view, inliers[seen.point]) - Vector2::from(truth.principal_point_px);
                found.residual(&Observation { xy: noise_free / side, ..*seen }).norm_squared()
            })
            .sum();
        let log_focal_error = (found.intrinsics[0].focal / self.focal).ln();
        log_focal_error.is_finite().then(|| Calibrated {
            log_focal_error,
            bound: bound.map(|variance| variance.sqrt() * self.noise),
            error_2d_px: side * (squared / observations.len() as f64).sqrt(),
            error_3d: error_3d(&found.points, &points),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::SceneOptions;

    #[test]
    fn knows_all_inliers_and_calibrates_within_its_own_bound() {
        for with_depths in [false, true] {
            let mut errors = Vec::new();
            for seed in 0..10 {
                let scene =
                    Scene::generate(&SceneOptions { with_depths, seed, ..SceneOptions::default() }).expect("valid");
                let measures = measure(&scene);
                println!("seed {seed}: {measures:?}");
                assert!(measures.f1 > 0.95, "seed {seed}");
                let bound = measures.sigma_log_focal.expect("observable");
                errors.push(measures.log_focal_error.expect("calibrated") / bound);
            }
            // Ten normal deviates of variance one: the sum of squares is chi-square, .9999 quantile 35.6.
            let sum: f64 = errors.iter().map(|error| error * error).sum();
            assert!(sum < 35.6 && sum > 0.6, "{errors:?}");
        }
    }
}
