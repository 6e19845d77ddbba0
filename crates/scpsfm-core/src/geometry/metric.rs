//! From a projective to a metric reconstruction, given the DAQ; its cheirality, and its points triangulated anew.

use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

use super::bundle::critical::Translating;
use super::bundle::metric::{Intrinsics, MetricReconstruction, Pose};
use super::daq::{self, CanonicalFrame, Daq, Free, to_canonical_frame};
use super::observation::Observation;
use super::procrustes::nearest_rotation;
use super::statistics::median;
use super::{Camera, Point, triangulation};

/// Iterations in which a plane at infinity is refined: it converges in 10 to 20.
const PLANE_ITERATIONS: usize = 40;

/// Distance at which points are held, in median depths: beyond it the depth of a point moves no observation, while a
/// point at infinity would have no coordinates.
const FARTHEST: f64 = 1e3;

/// Upgrades a projective reconstruction: the nearest rotations, and of the two mirror images the one with more
/// observations in front of their cameras. The median depth becomes 1.
///
/// * `own_focals`: whether every view has the focal length that the quadric gives it, or all that of the quadric
///
/// Returns `None` when a pose or the depth is not a number, a camera without rank, a DAQ without meaning; also where
/// the quadric gives a view no focal length of its own.
pub fn upgrade(
    frame: &CanonicalFrame,
    daq: &Daq,
    own_focals: bool,
    observations: &[Observation],
) -> Option<MetricReconstruction> {
    // `P H` is metric and `H^-1 X` Euclidean with `H = [K 0; -n' K 1]`.
    let calibration = daq.intrinsics.matrix();
    let mut homography = Matrix4::identity();
    homography.fixed_view_mut::<3, 3>(0, 0).copy_from(&calibration);
    homography.fixed_view_mut::<1, 3>(3, 0).copy_from(&-(daq.plane_at_infinity.transpose() * calibration));
    let back = homography.try_inverse()?;
    let focals = match own_focals {
        true => frame.cameras.iter().map(|camera| Some(daq::view_focal(camera, daq)?.0)).collect::<Option<Vec<_>>>()?,
        false => Vec::new(),
    };
    let points = frame.points.iter().map(|point| euclidean(&(back * point))).collect();
    let mut reconstruction = MetricReconstruction {
        group_of: vec![0; frame.cameras.len()],
        focals,
        ..MetricReconstruction::new(daq.intrinsics, Vec::new(), points)
    };
    for (view, camera) in frame.cameras.iter().enumerate() {
        let uncalibrate = reconstruction.intrinsics_of(view).matrix().try_inverse()?;
        let upgraded = uncalibrate * camera * homography;
        let pose = pose(&upgraded.fixed_columns::<3>(0).into_owned(), &upgraded.column(3).into_owned())?;
        reconstruction.poses.push(pose);
    }
    reconstruction.average_focals();
    oriented(reconstruction, observations)
}

/// Upgrades a projective reconstruction of cameras whose intrinsics are known and undone, so that they image rays at
/// unit depth: as [`upgrade`], with each of the planes at infinity of least residual, best first.
///
/// * `views`: how many of those with the widest baselines to the first the planes are taken from
/// * `planes`: how many are refined
///
/// Empty where [`upgrade`] gives none, and where no view has a baseline to the first.
pub fn upgrade_calibrated(
    cameras: &[Camera],
    points: &[Point],
    observations: &[Observation],
    views: usize,
    planes: usize,
) -> Vec<MetricReconstruction> {
    let Some(frame) = to_canonical_frame(cameras, points) else { return Vec::new() };
    let starts = daq::scan_planes(&frame.cameras, 1.0, views).into_iter().take(planes);
    let mut refined: Vec<(Daq, f64)> =
        starts.map(|(start, _)| daq::refine(&frame.cameras, start, Free::Plane, PLANE_ITERATIONS)).collect();
    refined.sort_by(|a, b| a.1.total_cmp(&b.1));
    refined.iter().filter_map(|(daq, _)| upgrade(&frame, daq, false, observations)).collect()
}

/// A camera that moved without turning as a metric reconstruction, were this its focal length: mirrored and scaled as
/// [`upgrade`] does.
///
/// Returns `None` when the depth is not a number.
pub fn upgrade_translation(
    translation: &Translating,
    focal: f64,
    observations: &[Observation],
) -> Option<MetricReconstruction> {
    let back = Vector3::new(focal.recip(), focal.recip(), 1.0);
    let pose = |moved: &Vector3<f64>| Pose { rotation: Matrix3::identity(), translation: moved.component_mul(&back) };
    let point = |point: &Vector3<f64>| euclidean(&point.xy().push(1.0).component_mul(&back).push(point.z));
    let reconstruction = MetricReconstruction::new(
        Intrinsics::from_focal(focal),
        translation.translations.iter().map(pose).collect(),
        translation.points.iter().map(point).collect(),
    );
    oriented(reconstruction, observations)
}

/// Coordinates of a homogeneous point; far out in its direction where it is at infinity.
fn euclidean(point: &Vector4<f64>) -> Vector3<f64> {
    let position = point.xyz() / point.w;
    if position.iter().all(|value| value.is_finite()) { position } else { point.xyz() * f64::MAX.sqrt() }
}

/// Of the two mirror images the one with more observations in front of their cameras, at a median depth of 1, with far
/// points held at [`FARTHEST`]; `None` where that depth is not a number.
pub(super) fn oriented(
    mut reconstruction: MetricReconstruction,
    observations: &[Observation],
) -> Option<MetricReconstruction> {
    if cheirality(&reconstruction, observations) < 0.5 {
        reconstruction.poses.iter_mut().for_each(|pose| pose.translation.neg_mut());
        reconstruction.points.iter_mut().for_each(|point| point.neg_mut());
    }
    let mut depths: Vec<f64> = depths(&reconstruction, observations).map(f64::abs).collect();
    let median = median(&mut depths);
    if !(median > f64::MIN_POSITIVE && median.is_finite()) {
        return None;
    }
    reconstruction.poses.iter_mut().for_each(|pose| pose.translation /= median);
    for point in &mut reconstruction.points {
        *point /= median;
        let norm = point.norm();
        if norm > FARTHEST {
            *point = if norm.is_finite() { *point * (FARTHEST / norm) } else { Vector3::new(0.0, 0.0, FARTHEST) };
        }
    }
    Some(reconstruction)
}

/// The rotation nearest to a 3x3 matrix up to scale, and the translation at that scale.
fn pose(left: &Matrix3<f64>, right: &Vector3<f64>) -> Option<Pose> {
    let sign = if left.determinant() < 0.0 { -1.0 } else { 1.0 };
    let rotation = nearest_rotation(&(left * sign))?;
    // The matrix is this rotation stretched by its singular values, whose mean is the scale.
    let translation = right * (3.0 / rotation.dot(left));
    translation.iter().all(|value| value.is_finite()).then_some(Pose { rotation, translation })
}

fn depths<'a>(
    reconstruction: &'a MetricReconstruction,
    observations: &'a [Observation],
) -> impl Iterator<Item = f64> + 'a {
    observations.iter().filter_map(|seen| {
        let (pose, point) = (reconstruction.poses.get(seen.view)?, reconstruction.points.get(seen.point)?);
        Some(pose.apply(point).z)
    })
}

/// Share of the observations whose point lies in front of its camera; 0 without observations.
pub fn cheirality(reconstruction: &MetricReconstruction, observations: &[Observation]) -> f64 {
    let (count, front) = depths(reconstruction, observations)
        .fold((0usize, 0usize), |(count, front), depth| (count + 1, front + usize::from(depth > 0.0)));
    if count > 0 { front as f64 / count as f64 } else { 0.0 }
}

/// Triangulates some points anew from the cameras, where that lowers their cost; how many moved.
///
/// * `may_move`: one a point
///
/// # Panics
/// When the group of a view is out of range.
pub fn retriangulate(
    reconstruction: &mut MetricReconstruction,
    observations: &[Observation],
    may_move: &[bool],
) -> usize {
    if !may_move.contains(&true) {
        return 0;
    }
    let mut of_point = vec![Vec::new(); reconstruction.points.len()];
    let (views, points) = (reconstruction.poses.len(), reconstruction.points.len());
    let counts = |seen: &&Observation| seen.is_usable(views, points) && may_move.get(seen.point) == Some(&true);
    observations.iter().filter(counts).for_each(|seen| of_point[seen.point].push(*seen));
    let cameras = reconstruction.cameras();
    let mut moved = 0;
    for (point, seen) in of_point.iter().enumerate() {
        let pinhole = |seen: &Observation| reconstruction.intrinsics_of(seen.view).undistorted(seen);
        let undistorted: Vec<Observation> = seen.iter().filter_map(pinhole).collect();
        // One observation fits a point at any depth.
        if undistorted.len() < 2 {
            continue;
        }
        let homogeneous = triangulation::linear(&cameras, &undistorted);
        let position: Vector3<f64> = homogeneous.xyz() / homogeneous.w;
        let cost = |reconstruction: &MetricReconstruction| -> f64 {
            seen.iter().map(|seen| reconstruction.weighted_squared(seen)).sum()
        };
        let before = cost(reconstruction);
        let former = std::mem::replace(&mut reconstruction.points[point], position);
        let now = cost(reconstruction);
        if now.is_finite() && (now < before || before.is_nan()) {
            moved += 1;
        } else {
            reconstruction.points[point] = former;
        }
    }
    moved
}

#[cfg(test)]
mod tests {
    use super::super::bundle::metric::{IntrinsicsModel, IntrinsicsPrior};
    use super::super::bundle::sequence::adjust_all;
    use super::super::bundle::{Options, testing};
    use super::super::daq::{refine, scan};
    use super::*;
    use crate::domain::StopToken;

    #[test]
    fn upgrades_an_exact_reconstruction_exactly() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 8, 20, 0.0);
            let (cameras, points) = testing::projectively_transformed(&scene, seed);
            let frame = to_canonical_frame(&cameras, &points).expect("rank 3");
            let refined = scan(&frame.cameras, 40, 4)
                .into_iter()
                .take(8)
                .map(|(start, _)| refine(&frame.cameras, start, Free::FocalAndPlane, 80));
            let (daq, _) = refined.min_by(|a, b| a.1.total_cmp(&b.1)).expect("starts");
            let upgraded = upgrade(&frame, &daq, false, &scene.observations).expect("metric");
            assert_eq!(cheirality(&upgraded, &scene.observations), 1.0, "seed {seed}");
            for seen in &scene.observations {
                let error = upgraded.residual(seen).norm();
                assert!(error < 1e-5, "seed {seed}: {error}");
            }
        }
    }

    #[test]
    fn calibrated_cameras_are_upgraded_exactly() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 8, 20, 0.0);
            let (cameras, points) = testing::projectively_transformed(&scene, seed);
            let to_rays = scene.intrinsics.matrix().try_inverse().expect("a focal length");
            let cameras: Vec<Camera> = cameras.iter().map(|camera| to_rays * camera).collect();
            let found = upgrade_calibrated(&cameras, &points, &scene.observations, 4, 3);
            let upgraded = found.first().expect("metric");
            assert_eq!(cheirality(upgraded, &scene.observations), 1.0, "seed {seed}");
            for seen in &scene.observations {
                let ray = scene.intrinsics.ray(&seen.xy).expect("in front");
                let error = upgraded.residual(&Observation { xy: ray, ..*seen }).norm();
                assert!(error < 1e-6, "seed {seed}: {error}");
            }
        }
        // No baseline tells the plane.
        assert!(upgrade_calibrated(&[Camera::identity(); 3], &[], &[], 4, 3).is_empty());
    }

    /// Far out, behind the cameras or not a number, behind a lens or not. What is at its minimum stays, and so does
    /// what may not move.
    #[test]
    fn diverged_points_are_triangulated_anew() {
        for (seed, radial_k1) in [(0, 0.0), (1, -0.2)] {
            let mut scene = testing::scene(seed, 6, 20, 0.0);
            scene.intrinsics.radial[0] = radial_k1;
            scene.observe(1e-4, &mut rand::SeedableRng::seed_from_u64(seed));
            let mut right = scene.reconstruction();
            let (model, priors) = (IntrinsicsModel::FIXED, [IntrinsicsPrior::NONE]);
            let options = Options { relative_tolerance: 1e-14, ..Options::squared(50) };
            adjust_all(&mut right, &scene.observations, model, &priors, &options, &StopToken::default());
            let mut found = right.clone();
            found.points[1] *= 1e7;
            found.points[2] = -found.points[2];
            found.points[3].x = f64::NAN;
            found.points[4] *= 2.0;
            let may_move: Vec<bool> = (0..20).map(|point| point != 4).collect();
            assert_eq!(retriangulate(&mut found, &scene.observations, &may_move), 3, "seed {seed}");
            assert_eq!(found.points[4], right.points[4] * 2.0, "seed {seed}");
            for point in [1, 2, 3] {
                let error = (found.points[point] - right.points[point]).norm();
                assert!(error < 0.01, "seed {seed}, point {point}: {error}");
            }
            assert_eq!(found.points[5..], right.points[5..], "seed {seed}");
            // One observation tells no depth.
            let before = found.clone();
            assert_eq!(retriangulate(&mut found, &scene.observations[..1], &[true; 20]), 0, "seed {seed}");
            assert_eq!(found.points, before.points, "seed {seed}");
        }
    }

    #[test]
    fn a_meaningless_quadric_or_scene_gives_none() {
        let scene = testing::scene(1, 4, 8, 0.0);
        let (cameras, points) = testing::projectively_transformed(&scene, 1);
        let frame = to_canonical_frame(&cameras, &points).expect("rank 3");
        let nan = Daq::new(1.0, Vector3::from_element(f64::NAN));
        assert!(upgrade(&frame, &nan, false, &scene.observations).is_none());
        assert!(upgrade(&frame, &Daq::new(0.0, Vector3::zeros()), false, &scene.observations).is_none());
        assert!(upgrade(&frame, &Daq::new(1.0, Vector3::zeros()), false, &[]).is_none());
    }
}
