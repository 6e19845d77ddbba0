//! What several blocks of one input say of each other's calibration.
//!
//! The formal uncertainty of one block knows nothing of model errors: distortion, a moving principal point, a wrong
//! track. Another block of the same camera does; where the two disagree by more than they admit, both admit too little.

use super::attempt::Attempt;
use super::calibration::grade_of_sigma;
use crate::domain::{Grade, Warning, WarningCode};

/// Growth of sigma from which a warning says why.
const WORTH_A_WARNING: f64 = 2.0;

/// Log focal length and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    pub log_focal: f64,
    pub sigma: f64,
}

impl Estimate {
    /// The estimate of a block that claims one, i.e. is graded METRIC or WEAK.
    fn of(attempt: &Attempt) -> Option<Self> {
        // Blocks of a zoom hold other views, and their focal lengths differ as they may.
        let calibration = attempt.calibration.as_ref().filter(|calibration| calibration.focals.is_none())?;
        let focal = calibration.intrinsics()?.focal;
        let sigma = calibration.sigma_log_focal?;
        let claims = calibration.grade != Grade::ProjectiveOnly && focal > 0.0;
        claims.then(|| Self { log_focal: focal.ln(), sigma })
    }
}

/// Raises the sigma of `chosen` until it and the other blocks agree, grades it anew and says so.
///
/// Every block is taken to have, beside its own sigma, an error of one common size tau: the moment estimate
/// `2 tau^2 = mean(d^2 - sigma_0^2 - sigma_i^2)` over the differences `d` to the others, not below 0.
pub fn reconcile(chosen: &mut Attempt, others: &[Attempt]) {
    let Some(own) = Estimate::of(chosen) else { return };
    let others: Vec<Estimate> = others.iter().filter_map(Estimate::of).collect();
    let sigma = inflated(own, &others);
    let Some(calibration) = &mut chosen.calibration else { return };
    calibration.sigma_log_focal = Some(sigma);
    calibration.grade = calibration.grade.worse(grade_of_sigma(Some(sigma)));
    if sigma > WORTH_A_WARNING * own.sigma {
        let apart = others.iter().map(|other| (other.log_focal - own.log_focal).abs()).fold(0.0, f64::max);
        calibration.warnings.push(Warning::new(
            WarningCode::ModelMismatch,
            format!(
                "another block of views has a focal length that differs by {:.1} %, more than either's uncertainty \
                 allows; sigma was raised from {:.2} to {:.2} %",
                100.0 * apart.exp_m1(),
                100.0 * own.sigma,
                100.0 * sigma
            ),
        ));
    }
}

fn inflated(own: Estimate, others: &[Estimate]) -> f64 {
    if others.is_empty() {
        return own.sigma;
    }
    let excess: f64 = others
        .iter()
        .map(|other| (other.log_focal - own.log_focal).powi(2) - own.sigma.powi(2) - other.sigma.powi(2))
        .sum::<f64>()
        / others.len() as f64;
    (own.sigma.powi(2) + excess.max(0.0) / 2.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(log_focal: f64, sigma: f64) -> Estimate {
        Estimate { log_focal, sigma }
    }

    #[test]
    fn blocks_that_agree_leave_sigma_alone_and_others_raise_it() {
        let own = estimate(0.0, 0.01);
        assert_eq!(inflated(own, &[]), 0.01);
        assert_eq!(inflated(own, &[estimate(0.012, 0.01)]), 0.01);
        // Two equal blocks .2 apart: each is off by .2 / sqrt 2.
        let raised = inflated(own, &[estimate(0.2, 0.01)]);
        assert!((raised - 0.2 / 2f64.sqrt()).abs() < 1e-3, "{raised}");
        // A block that admits to know little refutes nothing.
        assert_eq!(inflated(own, &[estimate(0.08, 0.09)]), 0.01);
    }
}
