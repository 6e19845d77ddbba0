//! From an extended sequence to the solution that callers read.

use nalgebra::Matrix4;

use super::Extended;
use super::model::{Landmark, Model, Scene};
use super::register::Unregistered;
use crate::domain::result::{TrackSplit, ViewResult};
use crate::domain::{Calibration, Grade, LeftOut, Solution, Stage, Status, Warning};
use crate::geometry::Point;
use crate::geometry::bundle::metric::{Intrinsics, Pose};
use crate::geometry::observation::Observation;
use crate::solver::assemble::{
    LEAST_SIGHTINGS, dehomogenise, least_share, network_weights, pixel_calibration, reprojection,
};
use crate::solver::block;
use crate::solver::calibration::Outcome;
use crate::solver::classification::{self, Geometry, Judged, SplitPoint};
use crate::solver::recorder::Recorder;

/// The solution of a sequence.
///
/// With grade PROJECTIVE_ONLY nothing metric is in it: points are then in the frame of the projective cameras.
pub fn solved(extended: Extended, mut warnings: Vec<Warning>, mut recorder: Recorder) -> Solution {
    recorder.enter(Stage::Judge);
    let grade = extended.grade();
    let Extended { seed, scene, model, calibrations, unregistered } = extended;
    let context = &scene.context;
    let mut judged = judged(&scene, &model, &mut recorder);
    let metric = grade != Grade::ProjectiveOnly;
    warnings.extend(told(&calibrations, &scene));
    warnings.extend(seed.second_structure.clone());
    let frames = frames(&scene, &model);
    let back = back(&frames, metric);
    let is_told = |retained: &[Observation]| !metric || is_held(&model, retained);
    judged.tracks.point = points(&judged, &model, &back, is_told);
    let splits = splits(&judged, &model, &back, is_told);
    judged.tracks.part = parts(&judged, &model);
    judged.tracks.network_weight = network_weights(&seed, context);
    let (rms, mean) = reprojection(&judged.observations);
    let mut views = views(&scene, &model, &frames, metric);
    unregistered.iter().for_each(|left| views[left.view].left_out = Some(left.reason()));
    let (seconds, iterations) = (recorder.seconds(), recorder.iteration());
    let (stages, history) = recorder.finish();
    Solution {
        status: Status::Solved,
        grade: Some(grade),
        method: context.settings.method,
        winning_prior: seed.winning_prior,
        iterations,
        seed: context.settings.seed,
        calibrations: if metric { in_pixels(&scene, &model, &calibrations) } else { Vec::new() },
        // The frame is affine to the metric one: its plane at infinity is (0, 0, 0, 1).
        plane_at_infinity: metric.then_some([0.0; 3]),
        views,
        tracks: judged.tracks,
        observations: judged.observations,
        splits,
        noise_px: Some(model.noise * context.scale_px),
        reprojection_rms_px: rms,
        reprojection_mean_px: mean,
        warnings,
        seconds,
        stages,
        prior_times: seed.prior_times.clone(),
        history,
        trained_network: None,
        input_sha256: None,
    }
}

/// What is to be said of the calibrations, each group's named where there are several.
fn told(calibrations: &[Outcome], scene: &Scene) -> Vec<Warning> {
    let id_of = |group: usize| {
        let view = scene.camera_of.iter().position(|of| *of == group)?;
        Some(scene.context.input.views()[view].camera_group)
    };
    let is_common = |warning: &Warning| calibrations.iter().all(|outcome| outcome.warnings.contains(warning));
    let of_group = |(group, outcome): (usize, &Outcome)| -> Vec<Warning> {
        let named = |warning: &Warning| match id_of(group) {
            // One for all groups, or none to tell apart.
            _ if scene.context.merges_cameras => warning.clone(),
            _ if calibrations.len() > 1 && is_common(warning) => warning.clone(),
            Some(id) if calibrations.len() > 1 => {
                Warning::new(warning.code, format!("camera group {id}: {}", warning.detail)).of_group(id)
            }
            Some(id) => warning.clone().of_group(id),
            None => warning.clone(),
        };
        // What is said of all is said once.
        let is_repeated = |warning: &&Warning| group > 0 && is_common(warning);
        outcome.warnings.iter().filter(|warning| !is_repeated(warning)).map(named).collect()
    };
    calibrations.iter().enumerate().flat_map(of_group).collect()
}

/// The calibration of each camera group in pixels, its principal point about the image centre of the group's first
/// view; where views have their own focal lengths, with the geometric mean of the group's, or of all for one of which
/// none is determined.
fn in_pixels(scene: &Scene, model: &Model, calibrations: &[Outcome]) -> Vec<Calibration> {
    let (group_of, groups) = block::camera_groups(scene.context.input);
    let determined = model.determined();
    let of_group = |group: usize| {
        let view = group_of.iter().position(|of| *of == group)?;
        // One for all where the groups are merged.
        let camera = scene.camera_of[view];
        let of_views: Vec<usize> = determined.iter().copied().filter(|&view| group_of[view] == group).collect();
        let outcome = calibrations.get(camera)?;
        if !scene.has_own_focals() {
            return Some(pixel_calibration(&model.lenses[camera].intrinsics, outcome, &scene.context, view));
        }
        let counted = if of_views.is_empty() { &determined } else { &of_views };
        let mean = Intrinsics { focal: model.log_focal(camera, counted).exp(), ..model.lenses[camera].intrinsics };
        let mut calibration = pixel_calibration(&mean, outcome, &scene.context, view);
        if of_views.is_empty() {
            calibration.grade = Some(Grade::ProjectiveOnly);
            calibration.sigma_log_focal = None;
        }
        Some(calibration)
    };
    (0..groups).filter_map(of_group).collect()
}

/// Every track and observation judged by all registered views.
fn judged(scene: &Scene, model: &Model, recorder: &mut Recorder) -> Judged {
    let context = &scene.context;
    let cameras = model.cameras(scene);
    let lenses: Vec<Intrinsics> = (0..cameras.len()).map(|view| model.intrinsics_of(scene, view)).collect();
    let tried = model.landmarks.iter().flatten().count();
    let verified = super::adjust::verified(model).len();
    let of_track: Vec<u32> =
        model.landmarks.iter().map(|landmark| landmark.map_or(0, |landmark| landmark.part)).collect();
    let geometry = Geometry {
        cameras: &cameras,
        parts: Some((&model.part_of, &of_track)),
        normalization: context.normalization,
        lenses: &lenses,
        weights: &scene.weights,
        linked: true,
        least_share: least_share(context),
        noise: model.noise,
        outlier_density: scene.outlier_density,
        inlier_share: (verified as f64 + 1.0) / (tried.max(verified) as f64 + 2.0),
    };
    let mut told = |verdicts| recorder.judged(verdicts, scene.tracks());
    classification::judge(context.input, context.ranges, &geometry, context.threads, context.stop, &mut told)
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
    let inverse = (to_pixels * model.intrinsics_of(scene, view).matrix() * pose.rotation).try_inverse()?;
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
        let camera =
            scene.context.normalization.camera_px(view, &pose.camera(&model.intrinsics_of(scene, view))) * frame;
        let metric = metric && model.is_determined(view);
        ViewResult {
            projection: Some(std::array::from_fn(|row| std::array::from_fn(|column| camera[(row, column)]))),
            rotation: metric
                .then(|| std::array::from_fn(|row| std::array::from_fn(|column| pose.rotation[(row, column)]))),
            translation: metric.then(|| pose.translation.into()),
            focal_px: (metric && scene.has_own_focals())
                .then(|| model.intrinsics_of(scene, view).focal * scene.context.scale_px),
            part: model.part_of[view],
            ..ViewResult::default()
        }
    };
    model.poses.iter().enumerate().map(result).collect()
}

/// What takes the points of each part to where the caller has them: nowhere where the result is metric, else to the
/// frame of the first view of their part.
fn back(frames: &[Option<Matrix4<f64>>], metric: bool) -> Vec<Option<Matrix4<f64>>> {
    frames.iter().map(|frame| frame.filter(|_| !metric).and_then(|frame| frame.try_inverse())).collect()
}

/// A judged point of a track where the caller has it.
fn placed(point: &Point, track: usize, model: &Model, back: &[Option<Matrix4<f64>>]) -> Option<[f64; 3]> {
    let part = model.landmarks[track].map_or(0, |landmark| landmark.part as usize);
    dehomogenise(&back[part].map_or(*point, |back| back * point))
}

/// Whether views with a pose hold the point of these observations: what others alone see is in no metric result.
fn is_held(model: &Model, retained: &[Observation]) -> bool {
    let has_pose = |seen: &&Observation| model.is_determined(seen.view);
    retained.iter().filter(has_pose).count() >= LEAST_SIGHTINGS
}

/// The points of the judged tracks whose retained observations say so.
fn points(
    judged: &Judged,
    model: &Model,
    back: &[Option<Matrix4<f64>>],
    is_told: impl Fn(&[Observation]) -> bool,
) -> Vec<Option<[f64; 3]>> {
    let place = |(track, point): (usize, &Option<Point>)| {
        point.filter(|_| is_told(&judged.retained[track])).and_then(|point| placed(&point, track, model, back))
    };
    judged.points.iter().enumerate().map(place).collect()
}

/// The other points of tracks that join several, placed as these are.
fn splits(
    judged: &Judged,
    model: &Model,
    back: &[Option<Matrix4<f64>>],
    is_told: impl Fn(&[Observation]) -> bool,
) -> Vec<TrackSplit> {
    let split = |split: &SplitPoint| TrackSplit {
        track: split.track as u32,
        number: split.number,
        weight: split.weight as f32,
        point: placed(&split.point, split.track, model, back).filter(|_| is_told(&split.retained)),
    };
    judged.splits.iter().map(split).collect()
}

/// The part that each track's point is in the frame of; empty where there is one.
fn parts(judged: &Judged, model: &Model) -> Vec<u32> {
    if model.part_of.iter().all(|&part| part == 0) {
        return Vec::new();
    }
    let part = |(point, landmark): (&Option<[f64; 3]>, &Option<Landmark>)| {
        landmark.filter(|_| point.is_some()).map_or(0, |landmark| landmark.part)
    };
    judged.tracks.point.iter().zip(&model.landmarks).map(part).collect()
}

impl Unregistered {
    fn reason(&self) -> LeftOut {
        LeftOut::NotRegistered { points: self.points as u32, agreeing: self.agreeing as u32 }
    }
}
