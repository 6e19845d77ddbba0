//! The paper's measures of one answer, and where the paper is silent what was chosen.

use nalgebra::{Matrix3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::domain::{Grade, Method, Solution, Status, WarningCode};
use crate::geometry::procrustes::absolute_orientation;
use crate::synthetic::metrics::{Agreement, agreement};
use crate::synthetic::{Scene, Truth};

/// How good one answer is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measures {
    pub f1: f64,
    pub precision: f64,
    pub recall: f64,
    /// The same by observation; the only fair count where a wrong track is wrong in a few views.
    /// `None` for the oracle, which judges tracks. PSFM counts here at its own threshold.
    pub observations: Option<Observations>,
    /// Whether anything was reconstructed.
    pub solved: bool,
    /// Root mean square distance, in pixels, between the reprojected points and the true image points, noise not
    /// included, over the true inliers that the answer kept; `None`: nothing was reconstructed.
    pub error_2d_px: Option<f64>,
    /// Mean of `|X - X_true| / |X_true|` over the same tracks, after the similarity that fits them best (Umeyama 1991;
    /// the paper names no alignment), origin as in the paper's generator: near the cameras. `None` without a metric
    /// reconstruction.
    pub error_3d: Option<f64>,
    /// `ln(f / f_true)`; `None` where no focal length was given, or the truth has several.
    pub log_focal_error: Option<f64>,
    /// One standard deviation that the answer claims for it; the Cramer-Rao bound for the oracle.
    pub sigma_log_focal: Option<f64>,
    pub grade: Option<Grade>,
    pub warnings: Vec<WarningCode>,
    pub seconds: f64,
    /// Of AUTO and GEOMETRY: what stood first, by prior.
    pub winning_proposal: Option<crate::domain::Proposal>,
    /// Network iterations spent.
    pub iterations: u32,
}

/// Agreement by observation.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Observations {
    pub f1: f64,
    pub precision: f64,
    pub recall: f64,
}

impl From<Agreement> for Observations {
    fn from(Agreement { precision, recall, f1 }: Agreement) -> Self {
        Self { f1, precision, recall }
    }
}

impl Measures {
    /// Scores a solution.
    pub fn of(scene: &Scene, solution: &Solution) -> Self {
        let truth = &scene.truth;
        let inliers = match solution.method {
            Method::Psfm => best_threshold(&solution.tracks.weight, &truth.inlier),
            _ => agreement(&solution.tracks.inlier, &truth.inlier),
        };
        let kept: Vec<usize> = (0..truth.inlier.len())
            .filter(|&track| {
                truth.inlier[track] && solution.tracks.inlier[track] && solution.tracks.point[track].is_some()
            })
            .collect();
        // The reprojection of a scene with lens terms depends on what the answer calls its pinhole: it is not compared.
        let pinhole = scene.options.radial_k1 == 0.0 && scene.options.zoom == 0.0;
        let solved = solution.status == Status::Solved && !kept.is_empty() && pinhole;
        Self {
            f1: inliers.f1,
            precision: inliers.precision,
            recall: inliers.recall,
            observations: Some(agreement(&solution.observations.inlier, &truth.observation_right).into()),
            solved: solution.status == Status::Solved,
            error_2d_px: if solved { error_2d_px(truth, solution, &kept) } else { None },
            error_3d: if solved && solution.is_metric() {
                let found: Vec<Vector3<f64>> =
                    kept.iter().filter_map(|&track| solution.tracks.point[track]).map(Vector3::from).collect();
                error_3d(&found, &true_points(truth, &kept))
            } else {
                None
            },
            log_focal_error: solution
                .calibrations
                .first()
                .filter(|_| scene.options.zoom == 0.0)
                .map(|calibration| (calibration.focal_px / truth.focal_px).ln())
                .filter(|error| error.is_finite()),
            sigma_log_focal: solution.calibrations.first().and_then(|calibration| calibration.sigma_log_focal),
            grade: solution.grade,
            warnings: solution.warnings.iter().map(|warning| warning.code).collect(),
            seconds: solution.seconds,
            winning_proposal: solution.winning_proposal,
            iterations: solution.iterations,
        }
    }
}

/// The agreement at the weight threshold that suits the truth best: the most that a method which only ranks can reach.
fn best_threshold(weights: &[f32], truth: &[bool]) -> Agreement {
    let mut ranked: Vec<usize> = (0..weights.len()).collect();
    ranked.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]).then(a.cmp(&b)));
    let mut found = vec![false; weights.len()];
    let mut best = agreement(&found, truth);
    for track in ranked {
        found[track] = true;
        let reached = agreement(&found, truth);
        if reached.f1 > best.f1 {
            best = reached;
        }
    }
    best
}

/// The world points of some tracks.
pub fn true_points(truth: &Truth, tracks: &[usize]) -> Vec<Vector3<f64>> {
    tracks.iter().map(|&track| Vector3::from(truth.points[track])).collect()
}

/// The image point of a track, noise not included.
pub fn true_image_px(truth: &Truth, view: usize, track: usize) -> Vector2<f64> {
    let rotation = Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
    let seen = rotation * Vector3::from(truth.points[track]) + Vector3::from(truth.translations[view]);
    truth.focal_px * seen.xy() / seen.z + Vector2::from(truth.principal_point_px)
}

/// Root mean square distance of the reprojections from the true image points, over the registered views.
fn error_2d_px(truth: &Truth, solution: &Solution, kept: &[usize]) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    for view in 0..solution.views.len() {
        let Some(camera) = camera_of(solution, view) else { continue };
        for &track in kept {
            let Some(point) = solution.tracks.point[track] else { continue };
            let seen = camera * nalgebra::Vector4::new(point[0], point[1], point[2], 1.0);
            let error = (seen.xy() / seen.z - true_image_px(truth, view, track)).norm_squared();
            if error.is_finite() {
                (sum, count) = (sum + error, count + 1);
            }
        }
    }
    (count > 0).then(|| (sum / count as f64).sqrt())
}

/// The pixel camera that goes with the solution's points: metric where they are metric.
fn camera_of(solution: &Solution, view: usize) -> Option<nalgebra::Matrix3x4<f64>> {
    let found = &solution.views[view];
    let (Some(calibration), Some(rotation), Some(translation)) =
        (solution.calibrations.first(), &found.rotation, &found.translation)
    else {
        return found.projection.map(|rows| nalgebra::Matrix3x4::from_fn(|row, column| rows[row][column]));
    };
    let [px, py] = calibration.principal_point_px;
    let (fx, fy) = (calibration.focal_px, calibration.aspect * calibration.focal_px);
    let intrinsics = Matrix3::new(fx, 0.0, px, 0.0, fy, py, 0.0, 0.0, 1.0);
    let mut pose = nalgebra::Matrix3x4::zeros();
    pose.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::from_fn(|row, column| rotation[row][column]));
    pose.set_column(3, &Vector3::from(*translation));
    Some(intrinsics * pose)
}

/// Mean relative distance of points from the true ones after the best similarity; `None` for fewer than three points
/// or when nothing finite comes of it.
pub fn error_3d(found: &[Vector3<f64>], truth: &[Vector3<f64>]) -> Option<f64> {
    let aligned = aligned(found, truth)?;
    let sum: f64 = aligned.iter().zip(truth).map(|(point, truth)| (point - truth).norm() / truth.norm()).sum();
    let mean = sum / truth.len() as f64;
    mean.is_finite().then_some(mean)
}

/// Root mean square distance of points from the true ones after the best similarity; `None` where [`aligned`] has none.
/// Of camera centres it is the absolute trajectory error.
pub fn rms_after_alignment(found: &[Vector3<f64>], truth: &[Vector3<f64>]) -> Option<f64> {
    let squared = aligned(found, truth)?.into_iter().zip(truth).map(|(found, truth)| (found - truth).norm_squared());
    Some((squared.sum::<f64>() / truth.len() as f64).sqrt())
}

/// The points moved onto `truth` by the similarity of least squares (Umeyama 1991); `None` for fewer than three points,
/// or where nothing finite comes of it.
pub fn aligned(points: &[Vector3<f64>], truth: &[Vector3<f64>]) -> Option<Vec<Vector3<f64>>> {
    if points.len() < 3 || points.len() != truth.len() {
        return None;
    }
    // The rotation of least squares is the same with and without a scale.
    let pose = absolute_orientation(points, truth, &vec![1.0; points.len()])?;
    let centre = |list: &[Vector3<f64>]| list.iter().sum::<Vector3<f64>>() / list.len() as f64;
    let (from, to) = (centre(points), centre(truth));
    let turned: Vec<Vector3<f64>> = points.iter().map(|point| pose.rotation * (point - from)).collect();
    let variance: f64 = turned.iter().map(Vector3::norm_squared).sum();
    let scale = turned.iter().zip(truth).map(|(turned, truth)| turned.dot(&(truth - to))).sum::<f64>() / variance;
    scale.is_finite().then(|| turned.iter().map(|turned| scale * turned + to).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Input, Limits, Silent, SolveSettings, StopToken};
    use crate::synthetic::SceneOptions;

    #[test]
    fn a_similarity_is_undone_exactly() {
        let truth = [[0.0, 1.0, 3.0], [1.0, -0.5, 2.0], [-1.0, 0.2, 4.0], [0.3, 0.9, 2.5]].map(Vector3::from);
        let turn = nalgebra::Rotation3::from_euler_angles(0.3, -1.0, 2.0);
        let moved: Vec<Vector3<f64>> =
            truth.iter().map(|point| 0.2 * (turn * point) + Vector3::new(5.0, -3.0, 1.0)).collect();
        assert!(error_3d(&moved, &truth).expect("four points") < 1e-12);
        let mut wrong = moved.clone();
        wrong[0].x += 0.05;
        let error = error_3d(&wrong, &truth).expect("four points");
        assert!(error > 0.005 && error < 0.2, "{error}");
        assert_eq!(error_3d(&moved[..2], &truth[..2]), None);
        assert!(rms_after_alignment(&moved[1..], &truth[1..]).expect("three points") < 1e-12);
        assert!(rms_after_alignment(&wrong, &truth).expect("four points") > 0.005);
        assert_eq!(error_3d(&[Vector3::repeat(f64::NAN); 4], &truth), None);
    }

    #[test]
    fn the_best_threshold_is_between_right_and_wrong() {
        let truth = [true, true, false, false];
        assert_eq!(best_threshold(&[0.9, 0.4, 0.3, 0.1], &truth).f1, 1.0);
        // One wrong track above a right one: two of three.
        assert!((best_threshold(&[0.9, 0.4, 0.5, 0.1], &truth).f1 - 0.8).abs() < 1e-12);
    }

    #[test]
    fn an_exact_scene_is_scored_as_exact() {
        let options = SceneOptions { noise: 1e-6, outliers: 0.5, tracks: 60, views: 6, ..SceneOptions::default() };
        let scene = Scene::generate(&options).expect("valid");
        let input = Input::new(scene.input.clone(), &Limits::default(), "scene").expect("valid");
        let settings = SolveSettings { method: Method::Geometry, ..SolveSettings::default() };
        let solution =
            crate::solver::solve(&input, &settings, &mut Silent, &StopToken::default()).expect("nothing stops it");
        let measures = Measures::of(&scene, &solution);
        assert_eq!(measures.f1, 1.0, "{measures:?}");
        assert!(measures.error_2d_px.expect("solved") < 0.01, "{measures:?}");
        assert!(measures.error_3d.expect("metric") < 1e-4, "{measures:?}");
        assert!(measures.log_focal_error.expect("metric").abs() < 1e-4, "{measures:?}");
    }
}
