//! From an extended sequence to the solution that callers read.

use nalgebra::Matrix4;

use super::Extended;
use super::model::{Landmark, Model, Scene};
use super::register::Unregistered;
use crate::domain::result::ViewResult;
use crate::domain::{Grade, Solution, Stage, Status, Warning, WarningCode};
use crate::geometry::bundle::metric::Pose;
use crate::geometry::{Camera, Point};
use crate::solver::assemble::{dehomogenise, network_weights, pixel_calibrations, reprojection};
use crate::solver::judge::{self, Geometry, Judged};
use crate::solver::recorder::Recorder;

/// Views named one by one in a warning; past these they are only counted.
const MOST_LISTED_VIEWS: usize = 20;

/// The solution of a sequence.
///
/// With grade PROJECTIVE_ONLY nothing metric is in it: points are then in the frame of the projective cameras.
pub fn solved(extended: Extended, mut warnings: Vec<Warning>, mut recorder: Recorder) -> Solution {
    recorder.enter(Stage::Judge);
    let Extended { seed, scene, model, calibration, unregistered } = extended;
    let context = &scene.context;
    let mut judged = judged(&scene, &model);
    let metric = calibration.grade != Grade::ProjectiveOnly;
    warnings.extend(calibration.warnings.iter().cloned());
    warnings.extend(seed.second_structure.clone());
    warnings.extend(left_out(&unregistered, super::super::block::observed_views(context.input).len()));
    let registered = model.registered();
    let frames = frames(&scene, &model);
    judged.tracks.point = points(&judged, &model, &frames, metric);
    judged.tracks.network_weight = network_weights(&seed, context);
    let (rms, mean) = reprojection(&judged.observations);
    let reconstruction = calibration.metric.as_ref().filter(|_| metric);
    let calibrations = reconstruction.map(|metric| {
        let metric = crate::geometry::bundle::metric::Reconstruction { intrinsics: model.intrinsics, ..metric.clone() };
        pixel_calibrations(&metric, calibration.sigma_log_focal, context, registered[0])
    });
    let views = views(&scene, &model, &frames, metric);
    let (seconds, iterations) = (recorder.seconds(), recorder.iteration());
    let (stages, history) = recorder.finish();
    Solution {
        status: Status::Solved,
        grade: Some(calibration.grade),
        method: context.settings.method,
        winning_prior: seed.winning_prior,
        iterations,
        seed: context.settings.seed,
        calibrations: calibrations.unwrap_or_default(),
        // The frame is affine to the metric one: its plane at infinity is (0, 0, 0, 1).
        plane_at_infinity: metric.then_some([0.0; 3]),
        views,
        tracks: judged.tracks,
        observations: judged.observations,
        noise_px: Some(model.noise * context.scale_px),
        reprojection_rms_px: rms,
        reprojection_mean_px: mean,
        warnings,
        seconds,
        stages,
        prior_times: seed.prior_times.clone(),
        history,
    }
}

/// Every track and observation judged by all registered views.
fn judged(scene: &Scene, model: &Model) -> Judged {
    let context = &scene.context;
    let camera = |pose: &Option<Pose>| pose.map(|pose| pose.camera(&model.intrinsics));
    let cameras: Vec<Option<Camera>> = model.poses.iter().map(camera).collect();
    let tried = model.landmarks.iter().flatten().count();
    let verified = super::adjust::verified(model).len();
    let of_track: Vec<u32> =
        model.landmarks.iter().map(|landmark| landmark.map_or(0, |landmark| landmark.part)).collect();
    let geometry = Geometry {
        cameras: &cameras,
        parts: Some((&model.part_of, &of_track)),
        normalization: context.normalization,
        lens: Some(&model.intrinsics).filter(|intrinsics| intrinsics.radial != 0.0),
        linked: true,
        noise: model.noise,
        outlier_density: scene.outlier_density,
        inlier_share: (verified as f64 + 1.0) / (tried.max(verified) as f64 + 2.0),
    };
    judge::judge(context.input, context.ranges, &geometry, context.stop)
}

/// For each part the homography of its first view, see [`first_view_frame`].
fn frames(scene: &Scene, model: &Model) -> Vec<Option<Matrix4<f64>>> {
    let parts = model.part_of.iter().copied().max().unwrap_or(0);
    let first = |part: u32| model.of_part(part).first().and_then(|&view| first_view_frame(scene, model, view));
    (0..=parts).map(first).collect()
}

/// The homography that takes the pixel camera of a view to `[I|0]` and leaves the plane at infinity where it is.
fn first_view_frame(scene: &Scene, model: &Model, view: usize) -> Option<Matrix4<f64>> {
    let pose = model.poses[view]?;
    let to_pixels = scene.context.normalization.to_pixels(view);
    let inverse = (to_pixels * model.intrinsics.matrix() * pose.rotation).try_inverse()?;
    let centre = -(pose.rotation.tr_mul(&pose.translation));
    let mut frame = Matrix4::identity();
    frame.fixed_view_mut::<3, 3>(0, 0).copy_from(&inverse);
    frame.fixed_view_mut::<3, 1>(0, 3).copy_from(&centre);
    Some(frame)
}

fn views(scene: &Scene, model: &Model, frames: &[Option<Matrix4<f64>>], metric: bool) -> Vec<ViewResult> {
    let result = |(view, pose): (usize, &Option<Pose>)| {
        let frame = frames[model.part_of[view] as usize].as_ref();
        let (Some(pose), Some(frame)) = (pose, frame) else { return ViewResult::default() };
        let camera = scene.context.normalization.camera_px(view, &pose.camera(&model.intrinsics)) * frame;
        ViewResult {
            projection: Some(std::array::from_fn(|row| std::array::from_fn(|column| camera[(row, column)]))),
            rotation: metric
                .then(|| std::array::from_fn(|row| std::array::from_fn(|column| pose.rotation[(row, column)]))),
            translation: metric.then(|| pose.translation.into()),
            focal_px: None,
            part: model.part_of[view],
        }
    };
    model.poses.iter().enumerate().map(result).collect()
}

/// The points of the judged tracks: metric, or in the frame of the first view of their part.
fn points(judged: &Judged, model: &Model, frames: &[Option<Matrix4<f64>>], metric: bool) -> Vec<Option<[f64; 3]>> {
    let back: Vec<Option<Matrix4<f64>>> =
        frames.iter().map(|frame| frame.filter(|_| !metric).and_then(|frame| frame.try_inverse())).collect();
    let placed = |(point, landmark): (&Option<Point>, &Option<Landmark>)| {
        let part = landmark.map_or(0, |landmark| landmark.part as usize);
        point.and_then(|point| dehomogenise(&back[part].map_or(point, |back| back * point)))
    };
    judged.points.iter().zip(&model.landmarks).map(placed).collect()
}

fn left_out(unregistered: &[Unregistered], observed: usize) -> Option<Warning> {
    if unregistered.is_empty() {
        return None;
    }
    let named = unregistered.iter().take(MOST_LISTED_VIEWS).map(|left| match left.agreeing {
        0 if left.points == 0 => format!("{} (sees no point of the reconstruction)", left.view),
        agreeing => format!("{} ({agreeing} of the {} points it sees agree on a pose)", left.view, left.points),
    });
    let mut names: Vec<String> = named.collect();
    if unregistered.len() > MOST_LISTED_VIEWS {
        names.push(format!("and {} more", unregistered.len() - MOST_LISTED_VIEWS));
    }
    Some(Warning::new(
        WarningCode::ViewsLeftOut,
        format!("{} of {observed} views could not be registered: {}", unregistered.len(), names.join(", ")),
    ))
}
