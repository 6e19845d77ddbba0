//! stub
use crate::domain::*;
use crate::geometry::bundle::{self, metric};
use nalgebra::*;
pub struct Problem<'a> {
    pub cameras: &'a [Matrix3x4<f64>],
    pub points: &'a [Vector4<f64>],
    pub observations: &'a [bundle::Observation],
    pub noise: f64,
}
pub struct Outcome {
    pub metric: Option<metric::Reconstruction>,
    pub sigma_log_focal: Option<f64>,
    pub grade: Grade,
    pub warnings: Vec<Warning>,
    pub rms_ratio: f64,
}
pub struct Stopped;
pub fn calibrate(_p: &Problem, _s: f64, _t: &StopToken) -> Result<Outcome, Stopped> {
    Ok(Outcome { metric: None, sigma_log_focal: None, grade: Grade::ProjectiveOnly, warnings: vec![], rms_ratio: 1.0 })
}
