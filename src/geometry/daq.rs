//! stub
use super::Camera;
pub fn hypothesis_residual(_c: &[Camera]) -> f64 {
    0.0
}
