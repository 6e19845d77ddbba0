//! From the geometry of a block to the solution that callers read.

use nalgebra::{Matrix3, Matrix4};

use super::attempt::Attempt;
use super::judge::{self, Geometry, Judged};
use super::recorder::Recorder;
use crate::domain::result::{ObservationResults, TrackResults, ViewResult};
use crate::domain::{
    Calibration, Grade, Input, Method, Solution, SolveSettings, Stage, Status, StopToken, Warning, WarningCode,
};
use crate::geometry::bundle::metric::Reconstruction;
use crate::geometry::daq::to_first_view_frame;
use crate::geometry::measurement::{Normalization, Sighting};
use crate::geometry::{Camera, Point, triangulation};

/// Views named one by one in a warning; past these they are only counted.
const MOST_LISTED_VIEWS: usize = 20;

/// The solution of a scene in which nothing could be reconstructed; the reason is among `warnings`.
pub fn unsolved(
    input: &Input,
    settings: &SolveSettings,
    attempt: Option<&Attempt>,
    warnings: Vec<Warning>,
    recorder: Recorder,
) -> Solution {
    let seconds = recorder.seconds();
    let (stages, history) = recorder.finish();
    let mut tracks = TrackResults {
        weight: vec![0.0; input.track_count()],
        inlier: vec![false; input.track_count()],
        network_weight: Vec::new(),
        point: vec![None; input.track_count()],
    };
    if let Some(attempt) = attempt {
        own_verdicts(attempt, settings.method, &mut tracks);
    }
    Solution {
        status: Status::NoReconstruction,
        grade: None,
        method: settings.method,
        winning_prior: None,
        iterations: attempt.map_or(0, |attempt| attempt.iterations),
        seed: settings.seed,
        calibrations: Vec::new(),
        plane_at_infinity: None,
        views: vec![ViewResult::default(); input.view_count()],
        tracks,
        observations: ObservationResults {
            inlier: vec![false; input.observation_count()],
            residual_px: vec![None; input.observation_count()],
        },
        noise_px: None,
        reprojection_rms_px: None,
        reprojection_mean_px: None,
        warnings,
        seconds,
        stages,
        prior_times: attempt.map_or_else(Vec::new, |attempt| attempt.prior_times.clone()),
        history,
    }
}

/// The solution of a block that stands.
pub fn solved(
    input: &Input,
    settings: &SolveSettings,
    ranges: &[usize],
    normalization: &Normalization,
    attempt: Attempt,
    mut warnings: Vec<Warning>,
    mut recorder: Recorder,
    stop: &StopToken,
) -> Solution {
    recorder.enter(Stage::Judge);
    let Some(consensus) = &attempt.consensus else {
        return unsolved(input, settings, Some(&attempt), warnings, recorder);
    };
    // Where the first camera has no rank 3 the frame stays as it is: there is nothing metric to be consistent with.
    let local =
        to_first_view_frame(&consensus.cameras, &[]).map_or_else(|| consensus.cameras.clone(), |frame| frame.cameras);
    let mut cameras = vec![None; input.view_count()];
    for (&view, camera) in attempt.block.views.iter().zip(&local) {
        cameras[view] = Some(*camera);
    }
    let judged = judge::judge(
        input,
        ranges,
        &Geometry {
            cameras: &cameras,
            normalization,
            noise: consensus.noise,
            outlier_density: outlier_density(&attempt),
            inlier_share: (consensus.inlier_count() as f64 + 1.0) / (attempt.block.tracks.len() as f64 + 2.0),
        },
        stop,
    );
    let calibration = attempt.calibration.as_ref();
    let grade = calibration.map_or(Grade::ProjectiveOnly, |calibration| calibration.grade);
    let metric = calibration.and_then(|calibration| calibration.metric.as_ref());
    let usable = metric.filter(|_| grade != Grade::ProjectiveOnly);
    warnings.extend(calibration.into_iter().flat_map(|calibration| calibration.warnings.iter().cloned()));
    warnings.extend(left_out(input, &attempt.block.views));

    let plane = calibration.and_then(|calibration| calibration.plane_at_infinity).filter(|_| usable.is_some());
    let first_px = normalization.to_pixels(attempt.block.views[0]);
    let views = views(input, &attempt, &local, usable, normalization);
    let Judged { mut tracks, observations, retained, points } = judged;
    tracks.point = final_points(&attempt, usable, &retained, &points, &first_px);
    own_verdicts(&attempt, settings.method, &mut tracks);
    let (rms, mean) = reprojection(&observations);
    let seconds = recorder.seconds();
    let (stages, history) = recorder.finish();
    Solution {
        status: Status::Solved,
        grade: Some(grade),
        method: settings.method,
        winning_prior: attempt.winning_prior,
        iterations: attempt.iterations,
        seed: settings.seed,
        calibrations: metric
            .map(|metric| {
                pixel_calibration(metric, calibration.and_then(|c| c.sigma_log_focal), normalization, &attempt)
            })
            .into_iter()
            .collect(),
        // Planes transform by the inverse transpose of what moves points: from normalised to pixels that is T1^-T.
        plane_at_infinity: plane
            .and_then(|plane| first_px.try_inverse().map(|inverse| (inverse.transpose() * plane).into())),
        views,
        tracks,
        observations,
        noise_px: Some(consensus.noise * normalization.scale_px),
        reprojection_rms_px: rms,
        reprojection_mean_px: mean,
        warnings,
        seconds,
        stages,
        prior_times: attempt.prior_times,
        history,
    }
}

/// Weights that the method or the network gave itself, in place of or beside the geometry's.
fn own_verdicts(attempt: &Attempt, method: Method, tracks: &mut TrackResults) {
    if method.uses_network() {
        tracks.network_weight = vec![0.0; tracks.weight.len()];
        for (&track, weight) in attempt.block.tracks.iter().zip(&attempt.network_weights) {
            tracks.network_weight[track] = weight.unwrap_or(0.0) as f32;
        }
    }
    if let Some(decided) = &attempt.decided {
        tracks.weight.fill(0.0);
        tracks.inlier.fill(false);
        for (j, &track) in attempt.block.tracks.iter().enumerate() {
            tracks.weight[track] = decided.weights[j] as f32;
            tracks.inlier[track] = decided.inlier[j];
        }
    }
}

fn outlier_density(attempt: &Attempt) -> f64 {
    // A uniform distribution of that standard deviation is sqrt(12) times as wide.
    1.0 / (12.0f64.sqrt() * super::portfolio::spread(&attempt.block.complete))
}

fn left_out(input: &Input, registered: &[usize]) -> Option<Warning> {
    let missing: Vec<usize> = (0..input.view_count()).filter(|view| !registered.contains(view)).collect();
    if missing.is_empty() {
        return None;
    }
    let mut names: Vec<String> = missing.iter().take(MOST_LISTED_VIEWS).map(usize::to_string).collect();
    if missing.len() > MOST_LISTED_VIEWS {
        names.push(format!("and {} more", missing.len() - MOST_LISTED_VIEWS));
    }
    Some(Warning::new(
        WarningCode::ViewsLeftOut,
        format!(
            "{} of {} views are outside the block of complete tracks that was solved and were left out: {}",
            missing.len(),
            input.view_count(),
            names.join(", ")
        ),
    ))
}

fn views(
    input: &Input,
    attempt: &Attempt,
    local: &[Camera],
    metric: Option<&Reconstruction>,
    normalization: &Normalization,
) -> Vec<ViewResult> {
    let mut views = vec![ViewResult::default(); input.view_count()];
    let first = attempt.block.views[0];
    // In pixels the frame moves with the first view's pixel transform, so that its camera stays [I|0].
    let mut frame = Matrix4::identity();
    if let Some(inverse) = normalization.to_pixels(first).try_inverse() {
        frame.fixed_view_mut::<3, 3>(0, 0).copy_from(&inverse);
    }
    for (i, &view) in attempt.block.views.iter().enumerate() {
        let projection = normalization.camera_px(view, &local[i]) * frame;
        let pose = metric.map(|metric| &metric.poses[i]);
        views[view] = ViewResult {
            projection: Some(std::array::from_fn(|row| std::array::from_fn(|column| projection[(row, column)]))),
            rotation: pose
                .map(|pose| std::array::from_fn(|row| std::array::from_fn(|column| pose.rotation[(row, column)]))),
            translation: pose.map(|pose| pose.translation.into()),
        };
    }
    views
}

/// Metric points where the result is metric, projective ones (pixel frame) elsewhere.
fn final_points(
    attempt: &Attempt,
    metric: Option<&Reconstruction>,
    retained: &[Vec<Sighting>],
    points: &[Option<Point>],
    first_px: &Matrix3<f64>,
) -> Vec<Option<[f64; 3]>> {
    let Some(metric) = metric else {
        return points
            .iter()
            .map(|point| point.and_then(|point| dehomogenise(&to_pixel_frame(&point, first_px))))
            .collect();
    };
    let most = attempt.block.views.iter().copied().max().unwrap_or(0);
    let mut cameras = vec![Camera::zeros(); most + 1];
    for (i, &view) in attempt.block.views.iter().enumerate() {
        cameras[view] = metric.poses[i].camera(&metric.intrinsics);
    }
    retained
        .iter()
        .map(|sightings| {
            if sightings.is_empty() {
                return None;
            }
            let start = triangulation::linear(&cameras, sightings);
            dehomogenise(&triangulation::refine(&cameras, sightings, start, POINT_STEPS).0)
        })
        .collect()
}

/// Refinement steps of a final point.
const POINT_STEPS: usize = 10;

/// The point in the frame of pixel cameras: `P_px = T P H` with `H = diag(T1^-1, 1)`, so points move by `diag(T1, 1)`.
fn to_pixel_frame(point: &Point, first_px: &Matrix3<f64>) -> Point {
    let moved = first_px * point.xyz();
    Point::new(moved.x, moved.y, moved.z, point.w)
}

/// `None` for points at infinity.
fn dehomogenise(point: &Point) -> Option<[f64; 3]> {
    let scaled = point.xyz() / point.w;
    scaled.iter().all(|entry| entry.is_finite()).then(|| scaled.into())
}

fn pixel_calibration(
    metric: &Reconstruction,
    sigma_log_focal: Option<f64>,
    normalization: &Normalization,
    attempt: &Attempt,
) -> Calibration {
    let centre = normalization.centres_px[attempt.block.views[0]];
    let offset = metric.intrinsics.principal_point * normalization.scale_px;
    Calibration {
        focal_px: metric.intrinsics.focal * normalization.scale_px,
        sigma_log_focal,
        principal_point_px: (centre + offset).into(),
        aspect: metric.intrinsics.aspect,
    }
}

/// Root mean square and mean of the inlier observations' residuals.
fn reprojection(observations: &ObservationResults) -> (Option<f64>, Option<f64>) {
    let residuals: Vec<f64> = observations
        .inlier
        .iter()
        .zip(&observations.residual_px)
        .filter_map(|(&inlier, residual)| residual.filter(|_| inlier))
        .collect();
    if residuals.is_empty() {
        return (None, None);
    }
    let count = residuals.len() as f64;
    let rms = (residuals.iter().map(|residual| residual * residual).sum::<f64>() / count).sqrt();
    (Some(rms), Some(residuals.iter().sum::<f64>() / count))
}
