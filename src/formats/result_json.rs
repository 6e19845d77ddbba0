//! What `result.json` and `cameras.json` hold. Field names and spellings are a contract: add, never rename.

use serde::Serialize;

use crate::domain::result::{PriorTime, ViewResult};
use crate::domain::{Calibration, Grade, Method, Solution, Status, Warning};

use super::{Label, LabelledInput};

/// The summary of a result.
///
/// Infinity is not JSON: where the focal length is unobservable, `sigma_log_focal` is null and `focal_unobservable`
/// is true. That is so of every `PROJECTIVE_ONLY` result: it has no `focal_px`, no `principal_point_px`, no `aspect`, no
/// radial distortion and no `plane_at_infinity` either. Where nothing was calibrated for another reason, `focal_unobservable` is null too.
#[derive(Debug, Clone, Serialize)]
pub struct ResultJson {
    pub status: Status,
    pub grade: Option<Grade>,
    /// Of the first camera group; see `cameras` where there are several.
    pub focal_px: Option<f64>,
    pub sigma_log_focal: Option<f64>,
    pub focal_unobservable: Option<bool>,
    pub principal_point_px: Option<[f64; 2]>,
    /// Vertical over horizontal focal length.
    pub aspect: Option<f64>,
    /// `x = f u s + px`, `y = aspect f v s + py` with `s = 1 + radial_k1 r^2 + radial_k2 r^4`, `r^2 = u^2 + v^2`, for a
    /// point at `(u, v, 1)`.
    pub radial_k1: Option<f64>,
    pub radial_k2: Option<f64>,
    /// One entry a camera group; absent where all views share one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cameras: Option<Vec<CalibrationJson>>,
    /// `(n, 1)` in pixels, in the frame `P1 = [I|0]` of the first registered view.
    pub plane_at_infinity: Option<[f64; 3]>,
    /// Counts.
    pub inlier_tracks: usize,
    pub inlier_observations: usize,
    pub registered_views: usize,
    pub reprojection_rms_px: Option<f64>,
    pub reprojection_mean_px: Option<f64>,
    pub noise_px: Option<f64>,
    pub warnings: Vec<Warning>,
    pub method: Method,
    pub winning_prior: Option<&'static str>,
    pub iterations: u32,
    pub seed: u64,
    pub seconds: f64,
    pub stages: Vec<StageJson>,
    pub prior_times: Vec<PriorTimeJson>,
    /// Version of the program that wrote the file.
    pub version: &'static str,
}

/// Intrinsics of one camera group.
#[derive(Debug, Clone, Serialize)]
pub struct CalibrationJson {
    pub focal_px: f64,
    pub sigma_log_focal: Option<f64>,
    pub focal_unobservable: bool,
    pub principal_point_px: [f64; 2],
    pub aspect: f64,
    pub radial_k1: f64,
    pub radial_k2: f64,
}

/// Seconds spent in a stage.
#[derive(Debug, Clone, Serialize)]
pub struct StageJson {
    pub name: &'static str,
    pub seconds: f64,
}

/// When a prior, verified alone, would have sufficed.
#[derive(Debug, Clone, Serialize)]
pub struct PriorTimeJson {
    pub prior: &'static str,
    /// Null: it never did within the search.
    pub seconds: Option<f64>,
    pub iterations: u32,
}

impl From<&Calibration> for CalibrationJson {
    fn from(calibration: &Calibration) -> Self {
        Self {
            focal_px: calibration.focal_px,
            sigma_log_focal: calibration.sigma_log_focal,
            focal_unobservable: calibration.sigma_log_focal.is_none(),
            principal_point_px: calibration.principal_point_px,
            aspect: calibration.aspect,
            radial_k1: calibration.radial_k1,
            radial_k2: calibration.radial_k2,
        }
    }
}

impl From<&PriorTime> for PriorTimeJson {
    fn from(time: &PriorTime) -> Self {
        Self { prior: time.prior.name(), seconds: time.seconds, iterations: time.iterations }
    }
}

impl From<&Solution> for ResultJson {
    fn from(solution: &Solution) -> Self {
        let cameras: Vec<CalibrationJson> = solution.calibrations.iter().map(CalibrationJson::from).collect();
        let first = cameras.first();
        Self {
            status: solution.status,
            grade: solution.grade,
            focal_px: first.map(|camera| camera.focal_px),
            sigma_log_focal: first.and_then(|camera| camera.sigma_log_focal),
            focal_unobservable: (solution.is_metric() || solution.is_focal_unobservable())
                .then(|| solution.is_focal_unobservable()),
            principal_point_px: first.map(|camera| camera.principal_point_px),
            aspect: first.map(|camera| camera.aspect),
            radial_k1: first.map(|camera| camera.radial_k1),
            radial_k2: first.map(|camera| camera.radial_k2),
            plane_at_infinity: solution.plane_at_infinity,
            inlier_tracks: solution.inlier_track_count(),
            inlier_observations: solution.inlier_observation_count(),
            registered_views: solution.registered_views().len(),
            reprojection_rms_px: solution.reprojection_rms_px,
            reprojection_mean_px: solution.reprojection_mean_px,
            noise_px: solution.noise_px,
            warnings: solution.warnings.clone(),
            method: solution.method,
            winning_prior: solution.winning_prior.map(|prior| prior.name()),
            iterations: solution.iterations,
            seed: solution.seed,
            seconds: solution.seconds,
            stages: solution
                .stages
                .iter()
                .map(|time| StageJson { name: time.stage.name(), seconds: time.seconds })
                .collect(),
            prior_times: solution.prior_times.iter().map(PriorTimeJson::from).collect(),
            version: env!("CARGO_PKG_VERSION"),
            cameras: (cameras.len() > 1).then_some(cameras),
        }
    }
}

/// `cameras.json`.
#[derive(Debug, Clone, Serialize)]
pub struct CamerasJson {
    /// One entry a view of the input.
    pub views: Vec<CameraJson>,
}

/// One view: `x ~ P X` in pixels, in the frame `P1 = [I|0]` of the first registered view; `x ~ K (R X + t)` where the
/// result is metric, before the radial distortion of [`ResultJson::radial_k1`]. Matrices row by row; null where there is
/// none.
#[derive(Debug, Clone, Serialize)]
#[allow(non_snake_case, reason = "the field's names for these matrices are capitals")]
pub struct CameraJson {
    /// The caller's id of the view: a number, or a text where the input has names.
    pub view: Label,
    pub registered: bool,
    /// Reconstruction that a registered view belongs to; each has a frame and a scale of its own.
    pub part: Option<u32>,
    pub P: Option<[[f64; 4]; 3]>,
    pub K: Option<[[f64; 3]; 3]>,
    pub R: Option<[[f64; 3]; 3]>,
    pub t: Option<[f64; 3]>,
    pub radial_k1: Option<f64>,
    pub radial_k2: Option<f64>,
}

impl CamerasJson {
    /// The cameras of a solution; without the input, views are numbered from 0.
    pub fn new(solution: &Solution, input: Option<&LabelledInput>) -> Self {
        let groups = camera_groups(solution, input);
        let camera = |(index, view): (usize, &ViewResult)| {
            let is_metric = view.rotation.is_some() && view.translation.is_some();
            let calibration = groups.get(index).and_then(|&group| solution.calibrations.get(group));
            CameraJson {
                view: view_label(input, index),
                registered: view.projection.is_some(),
                part: view.projection.map(|_| view.part),
                P: view.projection,
                K: calibration.filter(|_| is_metric).map(|shared| intrinsics(shared, view.focal_px)),
                R: view.rotation.filter(|_| is_metric),
                t: view.translation.filter(|_| is_metric),
                radial_k1: calibration.filter(|_| is_metric).map(|calibration| calibration.radial_k1),
                radial_k2: calibration.filter(|_| is_metric).map(|calibration| calibration.radial_k2),
            }
        };
        Self { views: solution.views.iter().enumerate().map(camera).collect() }
    }
}

/// Position of each view's camera group among the calibrations. Groups are numbered in ascending order of their ids;
/// a single calibration is everyone's.
pub(super) fn camera_groups(solution: &Solution, input: Option<&LabelledInput>) -> Vec<usize> {
    match input {
        Some(input) if solution.calibrations.len() > 1 => {
            let mut ids: Vec<u32> = input.raw.views.iter().map(|view| view.camera_group).collect();
            let all = ids.clone();
            ids.sort_unstable();
            ids.dedup();
            all.iter().map(|id| ids.partition_point(|other| other < id)).collect()
        }
        _ => vec![0; solution.views.len()],
    }
}

/// The calibration matrix `K`, row by row; `own`: the view's own focal length.
fn intrinsics(calibration: &Calibration, own: Option<f64>) -> [[f64; 3]; 3] {
    let [x, y] = calibration.principal_point_px;
    let focal_px = own.unwrap_or(calibration.focal_px);
    [[focal_px, 0.0, x], [0.0, focal_px * calibration.aspect, y], [0.0, 0.0, 1.0]]
}

/// The caller's id of view `index`, or the index where the input is not at hand.
pub fn view_label(input: Option<&LabelledInput>, index: usize) -> Label {
    input.and_then(|input| input.view_labels.get(index).cloned()).unwrap_or(Label::Number(index as u64))
}

/// The caller's id of track `index`, or the index where the input is not at hand.
pub fn track_label(input: Option<&LabelledInput>, index: usize) -> Label {
    input.and_then(|input| input.track_labels.get(index).cloned()).unwrap_or(Label::Number(index as u64))
}
