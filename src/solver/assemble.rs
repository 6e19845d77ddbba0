//! From the geometry of a block to the solution that callers read.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Matrix4};

use super::Context;
use super::attempt::Attempt;
use super::baselines::Decided;
use super::calibration::{Outcome, ViewFocal};
use super::classification::{self, Geometry, Judged, SplitPoint};
use super::recorder::Recorder;
use super::sequence::Projective;
use crate::domain::result::{ObservationResults, Sigmas, TrackResults, TrackSplit, ViewResult};
use crate::domain::{Calibration, Grade, Solution, Stage, Status, Warning, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, Parameter, Reconstruction};
use crate::geometry::daq::to_canonical_frame;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::root_mean_square;
use crate::geometry::{Camera, Point, triangulation};

/// The solution of a scene in which nothing could be reconstructed; the reason is among `warnings`.
pub fn unsolved(
    context: &Context,
    attempt: Option<&Attempt>,
    mut warnings: Vec<Warning>,
    recorder: Recorder,
) -> Solution {
    let (input, settings) = (context.input, context.settings);
    let (seconds, iterations) = (recorder.seconds(), recorder.iteration());
    let (stages, history) = recorder.finish();
    let mut tracks = TrackResults {
        weight: vec![0.0; input.track_count()],
        inlier: vec![false; input.track_count()],
        network_weight: Vec::new(),
        point: vec![None; input.track_count()],
        part: Vec::new(),
    };
    if let Some(attempt) = attempt {
        tracks.network_weight = network_weights(attempt, context);
        if let Some(decided) = &attempt.decided {
            own_verdicts(&attempt.block.tracks, decided, &mut tracks);
        }
        if let Some(track_scores) = attempt.track_scores.as_ref().filter(|track_scores| track_scores.ranks()) {
            let probabilities = track_scores.probabilities();
            tracks.weight = context.scatter(&probabilities, &attempt.block.tracks);
            let likely = track_scores.likely();
            let detail = format!(
                "{likely} tracks look right to the trained network and geometry verifies none: `weight` of the \
                 tracks is what it gives them, nothing has checked it"
            );
            warnings.push(Warning::new(WarningCode::UnverifiedRanking, detail));
        }
    }
    Solution {
        status: Status::NoReconstruction,
        grade: None,
        method: settings.method,
        winning_prior: None,
        iterations,
        seed: settings.seed,
        calibrations: Vec::new(),
        plane_at_infinity: None,
        views: vec![ViewResult::default(); input.view_count()],
        tracks,
        observations: ObservationResults::unjudged(input.observation_count()),
        splits: Vec::new(),
        noise_px: None,
        reprojection_rms_px: None,
        reprojection_mean_px: None,
        warnings,
        seconds,
        stages,
        prior_times: attempt.map_or_else(Vec::new, |attempt| attempt.prior_times.clone()),
        history,
        trained_network: None,
        input_sha256: None,
    }
}

/// The solution of a block that stands.
///
/// With grade PROJECTIVE_ONLY nothing metric is in it, the focal length included: a number that must not be used is
/// not given.
pub fn solved(context: &Context, mut attempt: Attempt, mut warnings: Vec<Warning>, mut recorder: Recorder) -> Solution {
    recorder.enter(Stage::Judge);
    let already = attempt.judged.take();
    let attempt = &attempt;
    let (Some(projective), Some(calibration)) = (&attempt.projective, &attempt.calibration) else {
        return unsolved(context, Some(attempt), warnings, recorder);
    };
    let mut judged = already.unwrap_or_else(|| judged(context, attempt, projective, &mut recorder));
    if let Some(weights) = &attempt.weights_by_depths {
        judge_by_depths(attempt, weights, &projective.cameras, context, &mut judged);
    }
    if let Some(decided) = &attempt.decided {
        mask(context, &attempt.block.tracks, decided, &mut judged);
    }
    // Where the first camera has no rank 3 the frame stays as it is: there is nothing metric to be consistent with.
    let frame = to_canonical_frame(&projective.cameras, &[]);
    let back = frame.as_ref().and_then(|frame| frame.homography.try_inverse()).unwrap_or_else(Matrix4::identity);
    judged.points.iter_mut().flatten().for_each(|point| *point = back * *point);
    let first_px = context.normalization.to_pixels(projective.views[0]);
    let splits = judged.splits.iter().map(|split| split_of(split, &back, &first_px)).collect();
    let cameras = frame.map_or_else(|| projective.cameras.clone(), |frame| frame.cameras);
    let usable = calibration.metric.as_ref().filter(|_| calibration.grade != Grade::ProjectiveOnly);
    let groups: BTreeSet<u32> = context.input.views().iter().map(|view| view.camera_group).collect();
    let only = groups.first().copied().filter(|_| groups.len() == 1);
    warnings.extend(calibration.warnings.iter().cloned().map(|warning| Warning { camera_group: only, ..warning }));
    warnings.extend(attempt.second_structure.clone());

    judged.tracks.point = final_points(context, attempt, usable, &judged, &first_px);
    judged.tracks.network_weight = network_weights(attempt, context);
    let (rms, mean) = reprojection(&judged.observations);
    let (seconds, iterations) = (recorder.seconds(), recorder.iteration());
    let (stages, history) = recorder.finish();
    Solution {
        status: Status::Solved,
        grade: Some(calibration.grade),
        method: context.settings.method,
        winning_prior: attempt.winning_prior,
        iterations,
        seed: context.settings.seed,
        calibrations: usable
            .map(|metric| pixel_calibrations(attempt, metric, calibration, context, projective.views[0]))
            .unwrap_or_default(),
        // Planes transform by the inverse transpose of what moves points: from normalised to pixels that is T1^-T.
        plane_at_infinity: calibration
            .plane_at_infinity
            .filter(|_| usable.is_some())
            .and_then(|plane| first_px.try_inverse().map(|inverse| (inverse.transpose() * plane).into())),
        views: views(context, attempt, projective, &cameras, usable),
        tracks: judged.tracks,
        observations: judged.observations,
        splits,
        noise_px: Some(projective.noise * context.scale_px),
        reprojection_rms_px: rms,
        reprojection_mean_px: mean,
        warnings,
        seconds,
        stages,
        prior_times: attempt.prior_times.clone(),
        history,
        trained_network: None,
        input_sha256: None,
    }
}

/// Share of its observations that a complete track must retain: of 100 permuted tracks in ten views about one holds
/// three observations of one point by chance.
const LEAST_RETAINED_SHARE: f64 = 0.6;

/// See [`Geometry::least_share`]: tracks of a sequence may be linked wrongly and hold several points.
pub fn least_share(context: &Context) -> f64 {
    let is_sequence = super::block::complete_views(context.input, context.ranges).is_none();
    if is_sequence { 0.0 } else { LEAST_RETAINED_SHARE }
}

/// Every track and observation judged by the projective cameras.
pub fn judged(context: &Context, attempt: &Attempt, projective: &Projective, recorder: &mut Recorder) -> Judged {
    let mut cameras = vec![None; context.input.view_count()];
    for (&view, camera) in projective.views.iter().zip(&projective.cameras) {
        cameras[view] = Some(*camera);
    }
    let weights = match attempt.judges_observations() {
        true => super::block::weights(context.input),
        false => Vec::new(),
    };
    let geometry = Geometry {
        cameras: &cameras,
        parts: None,
        normalization: context.normalization,
        lenses: &[],
        weights: &weights,
        linked: attempt.judges_observations(),
        least_share: if attempt.judges_observations() { least_share(context) } else { LEAST_RETAINED_SHARE },
        noise: projective.noise,
        outlier_density: classification::density_of_spread(attempt.spread),
        inlier_share: (projective.tracks.len() as f64 + 1.0) / (projective.tried as f64 + 2.0),
    };
    let mut told = |verdicts| recorder.judged(verdicts, context.input.track_count());
    classification::judge(context.input, context.ranges, &geometry, context.threads, context.stop, &mut told)
}

/// Tracks of the block by image points and depths together, in place of image points alone.
fn judge_by_depths(attempt: &Attempt, weights: &[f64], local: &[Camera], context: &Context, judged: &mut Judged) {
    let input = context.input;
    for (j, &track) in attempt.block.tracks.iter().enumerate() {
        judged.tracks.weight[track] = weights[j] as f32;
        let inlier = weights[j] > 0.5;
        if inlier == judged.tracks.inlier[track] {
            continue;
        }
        judged.tracks.inlier[track] = inlier;
        if context.stop.is_stopped() {
            return;
        }
        let observations = attempt.block.complete.track(j);
        let start = triangulation::linear(local, observations);
        let point = triangulation::refine(local, observations, start, POINT_STEPS).0;
        judged.points[track] = inlier.then_some(point);
        judged.retained[track] = if inlier {
            observations
                .iter()
                .map(|seen| Observation { view: attempt.block.views[seen.view], point: track, ..*seen })
                .collect()
        } else {
            Vec::new()
        };
        for k in context.ranges[track]..context.ranges[track + 1] {
            let Ok(view) = attempt.block.views.binary_search(&input.view_of(k)) else { continue };
            let place = input.caller_index(k);
            let residual = triangulation::reprojection(&local[view], &point, &observations[view].xy).norm();
            judged.observations.inlier[place] = inlier;
            judged.observations.weight[place] = judged.noise.weight(residual * residual) as f32;
            judged.observations.residual_px[place] =
                Some(residual * context.scale_px).filter(|residual| residual.is_finite());
        }
    }
}

/// The network's own weight of every track; empty where none ran, 0 for tracks it did not see.
pub fn network_weights(attempt: &Attempt, context: &Context) -> Vec<f32> {
    if attempt.network_weights.is_empty() {
        return Vec::new();
    }
    context.scatter(&attempt.network_weights, &attempt.block.tracks)
}

/// PAPER and PSFM: the method's own weights and verdicts in place of the geometry's.
fn own_verdicts(block_tracks: &[usize], decided: &Decided, tracks: &mut TrackResults) {
    tracks.weight.fill(0.0);
    tracks.inlier.fill(false);
    for (j, &track) in block_tracks.iter().enumerate() {
        tracks.weight[track] = decided.weights[j] as f32;
        tracks.inlier[track] = decided.inlier[j];
    }
}

/// The same, with what follows from it: a track that the method rejects has neither observations nor a point.
fn mask(context: &Context, block_tracks: &[usize], decided: &Decided, judged: &mut Judged) {
    own_verdicts(block_tracks, decided, &mut judged.tracks);
    for track in 0..context.input.track_count() {
        if !judged.tracks.inlier[track] {
            judged.retained[track].clear();
            judged.points[track] = None;
            for k in context.ranges[track]..context.ranges[track + 1] {
                judged.observations.inlier[context.input.caller_index(k)] = false;
            }
        }
    }
}

fn views(
    context: &Context,
    attempt: &Attempt,
    projective: &Projective,
    local: &[Camera],
    metric: Option<&Reconstruction>,
) -> Vec<ViewResult> {
    let mut views = vec![ViewResult::default(); context.input.view_count()];
    let first = projective.views[0];
    // In pixels the frame moves with the first view's pixel transform, so that its camera stays [I|0].
    let mut frame = Matrix4::identity();
    if let Some(inverse) = context.normalization.to_pixels(first).try_inverse() {
        frame.fixed_view_mut::<3, 3>(0, 0).copy_from(&inverse);
    }
    for (i, &view) in projective.views.iter().enumerate() {
        let projection = context.normalization.camera_px(view, &local[i]) * frame;
        let focal = own_focal(attempt, i);
        let is_determined = focal.is_none_or(|focal| focal.sigma_log.is_some());
        let pose = metric.filter(|_| is_determined).map(|metric| &metric.poses[i]);
        views[view] = ViewResult {
            projection: Some(std::array::from_fn(|row| std::array::from_fn(|column| projection[(row, column)]))),
            rotation: pose
                .map(|pose| std::array::from_fn(|row| std::array::from_fn(|column| pose.rotation[(row, column)]))),
            translation: pose.map(|pose| pose.translation.into()),
            focal_px: pose.and(focal).map(|own| own.focal * context.scale_px),
            ..ViewResult::default()
        };
    }
    views
}

/// Focal length of the `i`-th view of the block, where every view has its own.
fn own_focal(attempt: &Attempt, i: usize) -> Option<ViewFocal> {
    attempt.calibration.as_ref()?.focals.as_ref()?.get(i).copied()
}

/// Metric points where the result is metric, projective ones (pixel frame) elsewhere.
fn final_points(
    context: &Context,
    attempt: &Attempt,
    metric: Option<&Reconstruction>,
    judged: &Judged,
    first_px: &Matrix3<f64>,
) -> Vec<Option<[f64; 3]>> {
    let Some(metric) = metric else {
        let moved = |point: &Option<Point>| point.and_then(|point| dehomogenise(&to_pixel_frame(&point, first_px)));
        return judged.points.iter().map(moved).collect();
    };
    let mut cameras = vec![Camera::zeros(); context.input.view_count()];
    let mut lenses = vec![metric.intrinsics[0]; cameras.len()];
    let mut has_pose = vec![true; cameras.len()];
    for (i, &view) in attempt.views().iter().enumerate() {
        let own = own_focal(attempt, i);
        let shared = metric.intrinsics[metric.group_of[i]];
        lenses[view] = Intrinsics { focal: own.map_or(shared.focal, |own| own.focal), ..shared };
        cameras[view] = metric.poses[i].camera(&lenses[view]);
        has_pose[view] = own.is_none_or(|own| own.sigma_log.is_some());
    }
    let triangulated = |observations: &Vec<Observation>| {
        if observations.is_empty() || context.stop.is_stopped() {
            return None;
        }
        // These cameras know no distortion.
        let undone = |seen: &Observation| Some(Observation { xy: lenses[seen.view].undistort(&seen.xy)?, ..*seen });
        let observations: Vec<Observation> =
            observations.iter().filter(|seen| has_pose[seen.view]).filter_map(undone).collect();
        if observations.len() < LEAST_SIGHTINGS {
            return None;
        }
        let start = triangulation::linear(&cameras, &observations);
        dehomogenise(&triangulation::refine(&cameras, &observations, start, POINT_STEPS).0)
    };
    judged.retained.iter().map(triangulated).collect()
}

/// Observations that determine a point.
pub const LEAST_SIGHTINGS: usize = 2;
/// Refinement steps of a final point.
const POINT_STEPS: usize = 10;

/// A further point of a track, in the frame of the pixel cameras.
fn split_of(split: &SplitPoint, back: &Matrix4<f64>, first_px: &Matrix3<f64>) -> TrackSplit {
    TrackSplit {
        track: split.track as u32,
        number: split.number,
        weight: split.weight as f32,
        point: dehomogenise(&to_pixel_frame(&(back * split.point), first_px)),
    }
}

/// The point in the frame of pixel cameras: `P_px = T P H` with `H = diag(T1^-1, 1)`, so points move by `diag(T1, 1)`.
fn to_pixel_frame(point: &Point, first_px: &Matrix3<f64>) -> Point {
    let moved = first_px * point.xyz();
    Point::new(moved.x, moved.y, moved.z, point.w)
}

/// `None` for points at infinity.
pub fn dehomogenise(point: &Point) -> Option<[f64; 3]> {
    let scaled = point.xyz() / point.w;
    scaled.iter().all(|entry| entry.is_finite()).then(|| scaled.into())
}

/// The calibration in pixels: one for all views, or, where the input has several camera groups, one a group with a view
/// in rising order, their principal points about the image centre of the group's first view.
fn pixel_calibrations(
    attempt: &Attempt,
    metric: &Reconstruction,
    outcome: &Outcome,
    context: &Context,
    first_view: usize,
) -> Vec<Calibration> {
    let about = |view: usize, group: usize| pixel_calibration(&metric.intrinsics[group], outcome, context, view);
    let (group_of, groups) = super::block::camera_groups(context.input);
    if groups == 1 {
        return vec![about(first_view, 0)];
    }
    let of_group = |group: usize| {
        let first = group_of.iter().position(|of| *of == group)?;
        // One calibration for all, or that of the views that were solved.
        let of_metric = match metric.intrinsics.len() {
            1 => 0,
            _ => metric.group_of[attempt.views().iter().position(|&view| group_of[view] == group)?],
        };
        Some(about(first, of_metric))
    };
    (0..groups).filter_map(of_group).collect()
}

/// One calibration in pixels, its principal point about the image centre of this view.
///
/// * `outcome`: says what it is worth
pub fn pixel_calibration(intrinsics: &Intrinsics, outcome: &Outcome, context: &Context, view: usize) -> Calibration {
    let offset = intrinsics.principal_point * context.scale_px;
    Calibration {
        focal_px: intrinsics.focal * context.scale_px,
        sigma_log_focal: outcome.sigma_log_focal,
        principal_point_px: (context.normalization.centres_px[view] + offset).into(),
        aspect: intrinsics.aspect,
        radial_k1: intrinsics.radial[0],
        radial_k2: intrinsics.radial[1],
        radial_k3: intrinsics.radial[2],
        tangential_p1: intrinsics.tangential[0],
        tangential_p2: intrinsics.tangential[1],
        grade: Some(outcome.grade),
        sigmas: sigmas(intrinsics, outcome, context.scale_px),
    }
}

/// Standard deviations of what was estimated beside the focal length, in its units.
fn sigmas(intrinsics: &Intrinsics, outcome: &Outcome, scale_px: f64) -> Sigmas {
    let centre = outcome.sigma(Parameter::PrincipalX).zip(outcome.sigma(Parameter::PrincipalY));
    Sigmas {
        principal_point_px: centre.map(|(x, y)| [x * scale_px, y * scale_px]),
        // A small deviation of the logarithm is one of the ratio.
        aspect: outcome.sigma(Parameter::LogAspect).map(|sigma| sigma * intrinsics.aspect),
        radial_k1: outcome.sigma(Parameter::RadialK1),
        radial_k2: outcome.sigma(Parameter::RadialK2),
        radial_k3: outcome.sigma(Parameter::RadialK3),
        tangential_p1: outcome.sigma(Parameter::TangentialP1),
        tangential_p2: outcome.sigma(Parameter::TangentialP2),
    }
}

/// Root mean square and mean of the inlier observations' residuals.
pub fn reprojection(observations: &ObservationResults) -> (Option<f64>, Option<f64>) {
    let residuals: Vec<f64> = observations
        .inlier
        .iter()
        .zip(&observations.residual_px)
        .filter_map(|(&inlier, residual)| residual.filter(|_| inlier))
        .collect();
    let rms = root_mean_square(&residuals);
    (rms, rms.map(|_| residuals.iter().sum::<f64>() / residuals.len() as f64))
}
