//! The intrinsics of a camera in result.json and cameras.json. Field names, spellings and their order are a contract.

use serde::Serialize;

use crate::domain::{Calibration, LensProjection};

/// What a camera of `result.json` says of its intrinsics. All is null where there is no calibration.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct IntrinsicsJson {
    pub focal_px: Option<f64>,
    /// Null: unobservable where `focal_unobservable` is true, else there is no calibration.
    pub sigma_log_focal: Option<f64>,
    pub focal_unobservable: Option<bool>,
    pub principal_point_px: Option<[f64; 2]>,
    /// Vertical over horizontal focal length.
    pub aspect: Option<f64>,
    #[serde(flatten)]
    pub lens: LensJson,
    #[serde(flatten)]
    pub sigmas: SigmasJson,
}

/// Of the lens, see [`Calibration`] for the model.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct LensJson {
    pub lens_projection: Option<LensProjection>,
    pub radial_k1: Option<f64>,
    pub radial_k2: Option<f64>,
    pub radial_k3: Option<f64>,
    pub tangential_p1: Option<f64>,
    pub tangential_p2: Option<f64>,
}

/// One standard deviation of each that was estimated, in its unit; null: it was not, or an older version solved it.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct SigmasJson {
    pub sigma_principal_point_px: Option<[f64; 2]>,
    pub sigma_aspect: Option<f64>,
    pub sigma_radial_k1: Option<f64>,
    pub sigma_radial_k2: Option<f64>,
    pub sigma_radial_k3: Option<f64>,
    pub sigma_tangential_p1: Option<f64>,
    pub sigma_tangential_p2: Option<f64>,
}

impl From<&Calibration> for IntrinsicsJson {
    fn from(calibration: &Calibration) -> Self {
        Self {
            focal_px: Some(calibration.focal_px),
            sigma_log_focal: calibration.sigma_log_focal,
            focal_unobservable: Some(calibration.sigma_log_focal.is_none()),
            principal_point_px: Some(calibration.principal_point_px),
            aspect: Some(calibration.aspect),
            lens: calibration.into(),
            sigmas: calibration.into(),
        }
    }
}

impl From<&Calibration> for LensJson {
    fn from(calibration: &Calibration) -> Self {
        Self {
            lens_projection: Some(calibration.lens_projection),
            radial_k1: Some(calibration.radial_k1),
            radial_k2: Some(calibration.radial_k2),
            radial_k3: Some(calibration.radial_k3),
            tangential_p1: Some(calibration.tangential_p1),
            tangential_p2: Some(calibration.tangential_p2),
        }
    }
}

impl From<&Calibration> for SigmasJson {
    fn from(calibration: &Calibration) -> Self {
        let sigmas = &calibration.sigmas;
        Self {
            sigma_principal_point_px: sigmas.principal_point_px,
            sigma_aspect: sigmas.aspect,
            sigma_radial_k1: sigmas.radial_k1,
            sigma_radial_k2: sigmas.radial_k2,
            sigma_radial_k3: sigmas.radial_k3,
            sigma_tangential_p1: sigmas.tangential_p1,
            sigma_tangential_p2: sigmas.tangential_p2,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Who compares files line by line sees no difference between versions.
    #[test]
    fn fields_are_written_in_their_order() {
        let intrinsics = IntrinsicsJson::from(&Calibration::pinhole(900.0, [450.0, 600.0]));
        let written = serde_json::to_string(&intrinsics).expect("serialisable");
        let expected = "{\"focal_px\":900.0,\"sigma_log_focal\":null,\"focal_unobservable\":true,\
            \"principal_point_px\":[450.0,600.0],\"aspect\":1.0,\"lens_projection\":\"PERSPECTIVE\",\"radial_k1\":0.0,\
            \"radial_k2\":0.0,\"radial_k3\":0.0,\"tangential_p1\":0.0,\"tangential_p2\":0.0,\
            \"sigma_principal_point_px\":null,\"sigma_aspect\":null,\"sigma_radial_k1\":null,\"sigma_radial_k2\":null,\
            \"sigma_radial_k3\":null,\"sigma_tangential_p1\":null,\"sigma_tangential_p2\":null}";
        assert_eq!(written, expected);
    }
}
