//! How a second structure moves: against the camera, whose calibration is known, and against the scene.

use std::collections::BTreeSet;

use nalgebra::{Rotation3, Vector3};

use super::{OPTIONS, Structure};
use crate::domain::Grade;
use crate::domain::second_structure::{SecondStructure, SecondStructureKind, StructurePoint, StructurePose};
use crate::geometry::Camera;
use crate::geometry::bundle::metric::{Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Pose};
use crate::geometry::bundle::sequence;
use crate::geometry::bundle::{Loss, Options};
use crate::geometry::metric::{cheirality, upgrade_calibrated};
use crate::geometry::observation::Observation;
use crate::geometry::statistics::{CHI_SQUARE_OF_TWO, median};
use crate::solver::calibration::CalibrationOptions;
use crate::solver::classification::Geometry;
use crate::solver::consensus::{LEAST_INLIERS, LEAST_VIEWS};
use crate::solver::error::Error;
use crate::solver::problem::Problem;
use crate::solver::projective::ProjectiveReconstruction;
use crate::solver::reconstruction::Reconstruction;
use crate::solver::sequence::{GrowthOptions, widest_angle};
use crate::solver::view_selection::evenly;

/// Views that must see a point for it to be reported, as of a point of the scene.
const LEAST_OBSERVATIONS: usize = 2;

/// What is said of a structure: nothing of its motion without a metric reconstruction of the scene, nor where its
/// tracks make none under the calibration of that.
pub fn describe(
    problem: &Problem,
    reconstruction: &Reconstruction,
    structure: &Structure,
    number: u32,
) -> Result<SecondStructure, Error> {
    let unknown = SecondStructure { number, kind: None, poses: Vec::new(), points: Vec::new() };
    let Some(found) = structure.reconstruction.as_ref().filter(|_| reconstruction.grade != Grade::ProjectiveOnly)
    else {
        return Ok(unknown);
    };
    let Some((metric, observations)) = calibrated(problem, &reconstruction.geometry, found)? else {
        return Ok(unknown);
    };
    let mut of_view = vec![0; metric.poses.len()];
    observations.iter().for_each(|at| of_view[at.view] += 1);
    // Fewer points do not bear a pose out.
    let pose_in_scene =
        |(k, view): (usize, &usize)| reconstruction.poses[*view].filter(|_| of_view[k] >= LEAST_INLIERS);
    let scene: Vec<Option<Pose>> = found.views.iter().enumerate().map(pose_in_scene).collect();
    let mut seen = vec![0; metric.points.len()];
    observations.iter().filter(|at| scene[at.view].is_some()).for_each(|at| seen[at.point] += 1);
    let kept: Vec<Vector3<f64>> =
        metric.points.iter().zip(&seen).filter(|(_, seen)| **seen >= LEAST_OBSERVATIONS).map(|(at, _)| *at).collect();
    let pose = |(k, pose): (usize, &Pose)| {
        scene[k]?;
        Some(StructurePose {
            view: found.views[k] as u32,
            rotation: pose.rotation_rows(),
            translation: pose.translation.into(),
        })
    };
    let point = |(k, point): (usize, &Vector3<f64>)| {
        let is_reported = structure.tracks[found.tracks[k]] && seen[k] >= LEAST_OBSERVATIONS;
        is_reported.then(|| StructurePoint { track: found.tracks[k] as u32, point: (*point).into() })
    };
    Ok(SecondStructure {
        number,
        kind: kind(&scene, &metric, &kept, reconstruction.geometry.noise),
        poses: metric.poses.iter().enumerate().filter_map(pose).collect(),
        points: metric.points.iter().enumerate().filter_map(point).collect(),
    })
}

/// The metric reconstruction of a structure under the calibration of the scene, in a frame and at a scale of its own,
/// with the observations, in the image, of the points that fit; `None` where there is none that most points fit, that
/// is in front of its cameras, has parallax and is the only one.
fn calibrated(
    problem: &Problem,
    geometry: &Geometry,
    found: &ProjectiveReconstruction,
) -> Result<Option<(MetricReconstruction, Vec<Observation>)>, Error> {
    let lenses: Vec<Intrinsics> = found.views.iter().map(|&view| geometry.lenses[view]).collect();
    let of_rays = |(camera, lens): (&Camera, &Intrinsics)| Some(lens.pinhole().matrix().try_inverse()? * camera);
    let cameras: Option<Vec<Camera>> = found.cameras.iter().zip(&lenses).map(of_rays).collect();
    let Some(cameras) = cameras else { return Ok(None) };
    let in_image = |seen: &Observation| {
        let k = problem.seen_in(found.tracks[seen.point], found.views[seen.view])?;
        Some(Observation { xy: problem.xy[k], weight: geometry.given_weight(problem, k), ..*seen })
    };
    let observations: Vec<Observation> = found.observations.iter().filter_map(in_image).collect();
    let (model, priors) = (IntrinsicsModel::FIXED, vec![IntrinsicsPrior::NONE; lenses.len()]);
    let CalibrationOptions { fit, grades, .. } = &problem.calibration_options;
    let of_scene = geometry.noise.max(fit.least_noise);
    let adjusted = |upgraded: MetricReconstruction| {
        // Every view has the lens that it has in the scene.
        let mut metric =
            MetricReconstruction { intrinsics: lenses.clone(), group_of: (0..lenses.len()).collect(), ..upgraded };
        // A wrong track may fit projective cameras that bend to it.
        let loss = Loss::Cauchy { scale: GrowthOptions::METRIC.cauchy_scale * of_scene };
        let options = Options { max_iterations: OPTIONS.iterations, loss, ..Options::DEFAULT };
        let report = sequence::adjust_all(&mut metric, &observations, model, &priors, &options, problem.stop);
        (metric, report.cost)
    };
    let (views, planes) = (OPTIONS.plane_views, OPTIONS.planes);
    let upgraded = upgrade_calibrated(&cameras, &found.points, &found.observations, views, planes);
    let mut minima: Vec<(MetricReconstruction, f64)> = upgraded.into_iter().map(adjusted).collect();
    problem.stopped()?;
    minima.retain(|(_, cost)| cost.is_finite());
    minima.sort_by(|a, b| a.1.total_cmp(&b.1));
    let Some(((metric, cost), others)) = minima.split_first() else { return Ok(None) };
    let kept = agreeing(metric, &observations, OPTIONS.most_rms * of_scene);
    let of_kept: f64 = kept.iter().map(|seen| metric.weighted_squared(seen)).sum();
    let unit = (of_kept / (2 * kept.len()).max(1) as f64).max(of_scene.powi(2));
    let is_rival = |(other, other_cost): &(MetricReconstruction, f64)| {
        other_cost - cost < grades.indistinguishable * unit && turned_apart(metric, other) > OPTIONS.other_poses
    };
    let points = |seen: &[Observation]| seen.iter().map(|seen| seen.point).collect::<BTreeSet<_>>().len();
    let stands = 2 * points(&kept) > points(&observations)
        && points(&kept) >= LEAST_INLIERS
        && cheirality(metric, &kept) >= grades.least_in_front
        && median(&mut ray_angles(metric, &kept)) >= OPTIONS.least_angle
        && !others.iter().any(is_rival);
    Ok(stands.then(|| (metric.clone(), kept)))
}

/// The observations of the points that are within this root mean square of all of theirs.
fn agreeing(metric: &MetricReconstruction, observations: &[Observation], limit: f64) -> Vec<Observation> {
    let mut sums = vec![(0.0, 0.0); metric.points.len()];
    for seen in observations {
        let (sum, count) = &mut sums[seen.point];
        *sum += metric.weighted_squared(seen);
        *count += 2.0;
    }
    let agrees = |seen: &&Observation| sums[seen.point].0 <= sums[seen.point].1 * limit * limit;
    observations.iter().filter(agrees).copied().collect()
}

/// The largest difference between the rotations of a view against the first in two reconstructions, radians.
fn turned_apart(one: &MetricReconstruction, other: &MetricReconstruction) -> f64 {
    let against_first =
        |metric: &MetricReconstruction, view: usize| metric.poses[view].rotation * metric.poses[0].rotation.transpose();
    let apart = |view: usize| {
        let turn = against_first(one, view) * against_first(other, view).transpose();
        Rotation3::from_matrix_unchecked(turn).angle()
    };
    (0..one.poses.len()).map(apart).fold(0.0, f64::max)
}

/// For each observed point the widest angle between its rays, radians.
fn ray_angles(metric: &MetricReconstruction, observations: &[Observation]) -> Vec<f64> {
    let mut rays: Vec<Vec<Vector3<f64>>> = vec![Vec::new(); metric.points.len()];
    for seen in observations {
        let pose = &metric.poses[seen.view];
        rays[seen.point].push(pose.rotation.tr_mul(&pose.apply(&metric.points[seen.point])).normalize());
    }
    rays.iter().filter(|rays| !rays.is_empty()).map(|rays| widest_angle(rays)).collect()
}

/// Whether a structure rests against the scene between many views, at the ratio of the two scales at which it rests
/// between most; `None` where too few views have both poses.
///
/// * `scene`: the pose of each of its views in the scene
/// * `metric`: the structure, of these views
/// * `points`: those of its points that fit
/// * `noise`: one standard deviation of a coordinate
fn kind(
    scene: &[Option<Pose>],
    metric: &MetricReconstruction,
    points: &[Vector3<f64>],
    noise: f64,
) -> Option<SecondStructureKind> {
    let view = |(k, scene): (usize, &Option<Pose>)| {
        Some(ComparedView { scene: (*scene)?, own: metric.poses[k], focal: metric.intrinsics_of(k).focal })
    };
    let views: Vec<ComparedView> = scene.iter().enumerate().filter_map(view).collect();
    if views.len() < LEAST_VIEWS {
        return None;
    }
    let points = evenly(points, OPTIONS.compared_points);
    let pairs: Vec<(usize, usize)> = (0..views.len()).flat_map(|j| (0..j).map(move |i| (i, j))).collect();
    let ratio = |(i, j): (usize, usize)| ratio_of_scales(&views[i], &views[j]);
    let scales = evenly(&pairs, OPTIONS.compared_scales).into_iter().map(ratio).filter(|ratio| *ratio > 0.0);
    let resting =
        |ratio: f64| pairs.iter().filter(|(i, j)| rests(&views[*i], &views[*j], ratio, &points, noise)).count();
    // Without one the camera only turned, and no scale matters.
    let most = scales.chain([1.0]).map(resting).max().unwrap_or(0);
    Some(match most as f64 >= OPTIONS.least_resting * pairs.len() as f64 {
        true => SecondStructureKind::RepeatedStructure,
        false => SecondStructureKind::MovingBody,
    })
}

/// A view with its poses in the scene and in the frame of a structure.
struct ComparedView {
    scene: Pose,
    own: Pose,
    /// Normalised.
    focal: f64,
}

/// The scale of a structure in that of the scene at which its frame moves least between two views.
///
/// At a ratio `s` the frame of the structure is in the scene at `R' (s tₛ - t)`.
fn ratio_of_scales(first: &ComparedView, second: &ComparedView) -> f64 {
    let own = |view: &ComparedView| view.scene.rotation.tr_mul(&view.own.translation);
    let centre = |view: &ComparedView| -view.scene.rotation.tr_mul(&view.scene.translation);
    let moved = own(first) - own(second);
    let moved_camera = centre(first) - centre(second);
    -moved.dot(&moved_camera) / moved.norm_squared()
}

/// Whether most points of a structure, were they to rest in the scene where they are in the first view, would be imaged
/// in the second as they are.
fn rests(first: &ComparedView, second: &ComparedView, ratio: f64, points: &[Vector3<f64>], noise: f64) -> bool {
    let gate = CHI_SQUARE_OF_TWO * (noise / second.focal).powi(2);
    let agrees = |point: &&Vector3<f64>| {
        let in_scene = first.scene.rotation.tr_mul(&(ratio * first.own.apply(point) - first.scene.translation));
        let (at_rest, as_it_is) = (second.scene.apply(&in_scene), second.own.apply(point));
        at_rest.z > 0.0 && (at_rest.xy() / at_rest.z - as_it_is.xy() / as_it_is.z).norm_squared() <= gate
    };
    2 * points.iter().filter(agrees).count() > points.len()
}
