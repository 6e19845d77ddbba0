//! Settings: on the wire every field may be left out, in the domain every field has its value.

use super::enums::{Twin, optional_to_wire};
use crate::domain::{Backend, InvalidInput, Method, SolveSettings};
use crate::rpc::proto;

/// Fills in the defaults, then checks every field.
///
/// # Errors
/// Violations of `job.settings.<field>`.
pub fn from_wire(settings: Option<proto::SolveSettings>) -> Result<SolveSettings, InvalidInput> {
    let given = settings.unwrap_or_default();
    let method = Method::from_wire(given.method, "job.settings.method")?.unwrap_or_default();
    let default = SolveSettings::of_method(method);
    let settings = SolveSettings {
        method,
        use_daq: given.use_daq.unwrap_or(default.use_daq),
        alpha: given.alpha.unwrap_or(default.alpha),
        beta: given.beta.unwrap_or(default.beta),
        min_inliers: given.min_inliers.unwrap_or(default.min_inliers),
        kappa: given.kappa.unwrap_or(default.kappa),
        learning_rate: given.learning_rate.unwrap_or(default.learning_rate),
        iterations: given.iterations.unwrap_or(default.iterations),
        network_width: given.network_width.unwrap_or(default.network_width),
        epipolar_depths: given.epipolar_depths.unwrap_or(default.epipolar_depths),
        seed: given.seed,
        noise_px: given.noise_px,
        focal_per_view: given.focal_per_view,
        weights_every: given.weights_every,
        backend: Backend::from_wire(given.backend, "job.settings.backend")?,
        // Ablations are no service to callers.
        excluded_proposals: Vec::new(),
    };
    settings.validate()?;
    Ok(settings)
}

/// Every field, defaults written out.
pub fn to_wire(settings: &SolveSettings) -> proto::SolveSettings {
    proto::SolveSettings {
        method: settings.method.to_wire(),
        use_daq: Some(settings.use_daq),
        alpha: Some(settings.alpha),
        beta: Some(settings.beta),
        min_inliers: Some(settings.min_inliers),
        kappa: Some(settings.kappa),
        learning_rate: Some(settings.learning_rate),
        iterations: Some(settings.iterations),
        network_width: Some(settings.network_width),
        epipolar_depths: Some(settings.epipolar_depths),
        seed: settings.seed,
        noise_px: settings.noise_px,
        focal_per_view: settings.focal_per_view,
        weights_every: settings.weights_every,
        backend: optional_to_wire(settings.backend),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_out_is_the_default_and_what_is_given_comes_back() {
        assert_eq!(from_wire(None), Ok(SolveSettings::default()));
        let scpsfm = proto::SolveSettings { method: Method::Scpsfm.to_wire(), ..Default::default() };
        assert_eq!(from_wire(Some(scpsfm)), Ok(SolveSettings::of_method(Method::Scpsfm)));
        let given = SolveSettings {
            method: Method::Paper,
            use_daq: false,
            beta: 0.0,
            epipolar_depths: true,
            seed: u64::MAX,
            noise_px: Some(0.5),
            focal_per_view: true,
            weights_every: 10,
            backend: Some(Backend::Ndarray),
            ..SolveSettings::default()
        };
        assert_eq!(from_wire(Some(to_wire(&given))), Ok(given));
    }

    #[test]
    fn out_of_range_and_unknown_values_name_their_field() {
        let wrong = |settings| {
            let error = from_wire(Some(settings)).expect_err("invalid");
            error.violations().iter().map(|violation| violation.field.clone()).collect::<Vec<_>>()
        };
        let empty = proto::SolveSettings::default();
        assert_eq!(wrong(proto::SolveSettings { method: 77, ..empty }), ["job.settings.method"]);
        assert_eq!(wrong(proto::SolveSettings { backend: -1, ..empty }), ["job.settings.backend"]);
        assert_eq!(wrong(proto::SolveSettings { alpha: Some(f64::NAN), ..empty }), ["job.settings.alpha"]);
        assert_eq!(wrong(proto::SolveSettings { iterations: Some(0), ..empty }), ["job.settings.iterations"]);
    }
}
