//! What `cameras.json` holds. Field names and spellings are a contract: add, never rename.

use serde::Serialize;

use super::intrinsics_json::{LensJson, SigmasJson};
use super::result_json::view_label;
use super::{Label, LabelledInput, warnings};
use crate::domain::result::ViewResult;
use crate::domain::{Calibration, LeftOut, Solution, Status, Warning};

/// `cameras.json`.
#[derive(Debug, Clone, Serialize)]
pub struct CamerasJson {
    pub status: Status,
    /// Why there are no cameras, or none with a calibration; null where there are.
    pub reason: Option<ReasonJson>,
    /// One entry a view of the input.
    pub views: Vec<CameraJson>,
}

/// One view: `x ~ P X` in pixels, in the frame `P1 = [I|0]` of the first registered view of its part; `x ~ K (R X + t)`
/// where the result is metric, before the distortion `radial_k1` to `tangential_p2`, see [`Calibration`]. Matrices row
/// by row; null where there is none.
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
    #[serde(flatten)]
    pub lens: LensJson,
    /// The input's number of the view's camera; its calibration is among the `cameras` of `result.json`.
    pub camera_group: u32,
    /// One standard deviation of the log focal length of the group, for a view with a K; null there: unobservable.
    pub sigma_log_focal: Option<f64>,
    #[serde(flatten)]
    pub sigmas: SigmasJson,
    /// Why the view is not registered: where no view is, that of the whole.
    pub left_out: Option<ReasonJson>,
}

/// Why something is missing, for programs and for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ReasonJson {
    pub code: &'static str,
    pub detail: String,
}

impl From<LeftOut> for ReasonJson {
    fn from(left_out: LeftOut) -> Self {
        Self { code: left_out.name(), detail: left_out.to_string() }
    }
}

impl From<&Warning> for ReasonJson {
    fn from(warning: &Warning) -> Self {
        Self { code: warning.code.name(), detail: warning.detail.clone() }
    }
}

impl CamerasJson {
    /// The cameras of a solution; without the input, views are numbered from 0.
    pub fn new(solution: &Solution, input: Option<&LabelledInput>) -> Self {
        let reason = warnings::reason(solution).map(ReasonJson::from);
        let of_all = reason.as_ref().filter(|_| solution.status == Status::NoReconstruction);
        let camera = |(index, view): (usize, &ViewResult)| {
            let is_metric = view.rotation.is_some() && view.translation.is_some();
            let calibration = solution.calibration_of(view.camera_group).filter(|_| is_metric);
            CameraJson {
                view: view_label(solution, input, index),
                registered: view.projection.is_some(),
                part: view.projection.map(|_| view.part),
                P: view.projection,
                K: calibration.map(|shared| intrinsics(shared, view.focal_px)),
                R: view.rotation.filter(|_| is_metric),
                t: view.translation.filter(|_| is_metric),
                lens: calibration.map(LensJson::from).unwrap_or_default(),
                camera_group: view.camera_group,
                sigma_log_focal: calibration.and_then(|calibration| calibration.sigma_log_focal),
                sigmas: calibration.map(SigmasJson::from).unwrap_or_default(),
                left_out: view.left_out.map(ReasonJson::from).or_else(|| of_all.cloned()),
            }
        };
        Self { status: solution.status, views: solution.views.iter().enumerate().map(camera).collect(), reason }
    }
}

/// The calibration matrix `K`, row by row; `own`: the view's own focal length.
fn intrinsics(calibration: &Calibration, own: Option<f64>) -> [[f64; 3]; 3] {
    let [x, y] = calibration.principal_point_px;
    let focal_px = own.unwrap_or(calibration.focal_px);
    [[focal_px, 0.0, x], [0.0, focal_px * calibration.aspect, y], [0.0, 0.0, 1.0]]
}
