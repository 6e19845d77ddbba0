//! Several estimates of one focal length as one, and what they say of each other.
//!
//! The formal uncertainty of one adjustment knows noise and nothing else; distortion beyond the model, a wrong track or
//! a motion that hardly turns moves estimates apart by more than they admit. They are fused by information weight, with
//! a common misfit that makes their chi-square what it should be (DerSimonian & Laird 1986).

use super::calibration::{GradeOptions, Outcome};
use crate::domain::{Warning, WarningCode};
use crate::geometry::statistics::chi_square_quantile;

/// Growth of sigma from which a warning says why, and the sigma from which anyone minds: a quarter of a METRIC one.
const WORTH_A_WARNING: f64 = 3.0;
const WORTH_MINDING: f64 = 0.005;

/// Level of the chi-square of their differences beyond which these are no chance, one in twenty, as a quantile of the
/// normal distribution.
const SIGNIFICANT: f64 = 1.645;

/// Log focal length and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    pub log_focal: f64,
    pub sigma: f64,
}

/// Several estimates as one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fused {
    pub log_focal: f64,
    pub sigma: f64,
    /// What that would be without misfit.
    pub formal: f64,
    /// Standard deviation of what each has beside its own sigma.
    pub misfit: f64,
    /// Chi-square per degree of freedom without it, and the degrees.
    pub chi_square: f64,
    pub freedom: f64,
}

/// Fuses estimates that have this share of their observations in common; `None` for fewer than two.
///
/// The covariance of two estimates is `shared * min(sigma_1^2, sigma_2^2)`: the observations in common carry at most
/// the information of the weaker one.
pub fn fuse(estimates: &[Estimate], shared: f64) -> Option<Fused> {
    if estimates.len() < 2 {
        return None;
    }
    let weights = |misfit: f64| -> Vec<f64> {
        estimates.iter().map(|estimate| (estimate.sigma.powi(2) + misfit * misfit).recip()).collect()
    };
    // Variance of the weighted sum: what two have in common adds up.
    let variance_of_sum = |weight: &[f64], misfit: f64| -> f64 {
        let mut variance = 0.0;
        for (k, (&of_one, one)) in weight.iter().zip(estimates).enumerate() {
            variance += of_one * of_one * (one.sigma.powi(2) + misfit * misfit);
            for (&of_other, other) in weight[..k].iter().zip(estimates) {
                variance += 2.0 * of_one * of_other * shared * one.sigma.min(other.sigma).powi(2);
            }
        }
        variance
    };
    let weight = weights(0.0);
    let total: f64 = weight.iter().sum();
    let mean = weight.iter().zip(estimates).map(|(weight, estimate)| weight * estimate.log_focal).sum::<f64>() / total;
    let statistic: f64 =
        weight.iter().zip(estimates).map(|(weight, estimate)| weight * (estimate.log_focal - mean).powi(2)).sum();
    // What it is expected to be: the number of estimates less one, where they have nothing in common.
    let expected = (estimates.len() as f64 - variance_of_sum(&weight, 0.0) / total).max(f64::MIN_POSITIVE);
    let formal = variance_of_sum(&weight, 0.0).sqrt() / total;
    let scale = total - weight.iter().map(|weight| weight * weight).sum::<f64>() / total;
    let misfit = ((statistic - expected).max(0.0) / scale).sqrt();
    let weight = weights(misfit);
    let total: f64 = weight.iter().sum();
    let log_focal =
        weight.iter().zip(estimates).map(|(weight, estimate)| weight * estimate.log_focal).sum::<f64>() / total;
    let sigma = variance_of_sum(&weight, misfit).sqrt() / total;
    let usable = sigma.is_finite() && misfit.is_finite() && log_focal.is_finite();
    usable.then_some(Fused {
        log_focal,
        sigma,
        formal,
        misfit,
        chi_square: statistic / expected,
        freedom: (estimates.len() - 1) as f64,
    })
}

impl Fused {
    /// Whether the estimates differ by more than chance explains.
    pub fn differ(&self) -> bool {
        self.chi_square * self.freedom > chi_square_quantile(self.freedom, SIGNIFICANT)
    }

    /// By how much these estimates, of `which`, differ.
    pub fn spread(&self, which: &str) -> String {
        format!(
            "{which} differ in focal length by {:.2} % (one standard deviation beside their own), chi-square {:.1} a \
             degree of freedom",
            100.0 * self.misfit,
            self.chi_square
        )
    }
}

/// Raises the sigma of a calibration, grades it anew and says so, with the reason.
pub fn raise(outcome: &mut Outcome, sigma: f64, reason: &str, grades: &GradeOptions) {
    let Some(own) = outcome.sigma_log_focal else { return };
    outcome.raise_sigma(sigma, grades);
    if sigma > WORTH_A_WARNING * own && sigma > WORTH_MINDING {
        let detail = format!("{reason}; sigma was raised from {:.3} to {:.3} %", 100.0 * own, 100.0 * sigma);
        outcome.warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimates(values: &[(f64, f64)]) -> Vec<Estimate> {
        values.iter().map(|&(log_focal, sigma)| Estimate { log_focal, sigma }).collect()
    }

    #[test]
    fn estimates_that_agree_fuse_by_information() {
        let fused = fuse(&estimates(&[(0.0, 0.01), (0.005, 0.01), (-0.003, 0.01), (0.002, 0.01)]), 0.0).expect("four");
        assert_eq!(fused.misfit, 0.0);
        assert!((fused.sigma - 0.005).abs() < 1e-12, "{fused:?}");
        assert_eq!(fuse(&estimates(&[(0.0, 0.01)]), 0.0), None);
    }

    /// The strong one knows all that the weak one does: together they know hardly less than the strong one alone, and
    /// differ by the root of the difference of their variances (Hausman 1978, "Specification tests in econometrics").
    #[test]
    fn what_two_estimates_have_in_common_is_bounded_by_the_weaker() {
        let fused = |by: f64| fuse(&estimates(&[(0.0, 0.005), (by, 0.01)]), 1.0).expect("two");
        assert!((0.005..0.0055).contains(&fused(0.0).formal), "{:?}", fused(0.0));
        let expected = (0.01f64.powi(2) - 0.005f64.powi(2)).sqrt();
        assert!((fused(expected).chi_square - 1.0).abs() < 1e-9, "{:?}", fused(expected));
        assert!(!fused(1.8 * expected).differ() && fused(2.1 * expected).differ());
    }

    #[test]
    fn estimates_that_differ_by_more_than_they_admit_raise_sigma() {
        let fused = fuse(&estimates(&[(0.1, 0.001), (-0.1, 0.001), (0.1, 0.001), (-0.1, 0.001)]), 0.0).expect("four");
        // Four values of standard deviation .115: their mean is known to half of that.
        assert!((fused.misfit - 0.1155).abs() < 1e-3 && (fused.sigma - 0.0577).abs() < 1e-3, "{fused:?}");
        assert!(fused.differ());
        // A little more than expected is chance, of two and of many.
        let of = |by: f64, count: usize| {
            let values: Vec<_> = (0..count).map(|k| (if k.is_multiple_of(2) { by } else { -by }, 0.01)).collect();
            fuse(&estimates(&values), 0.0).expect("several")
        };
        for (by, count, differ) in [(0.012, 2, false), (0.015, 2, true), (0.011, 20, false), (0.014, 20, true)] {
            let fused = of(by, count);
            assert!(fused.misfit > 0.0 && fused.differ() == differ, "{by}, {count}: {fused:?}");
        }
        // One that knows nothing refutes nothing.
        let fused = fuse(&estimates(&[(0.0, 0.001), (0.5, 0.6)]), 0.0).expect("two");
        assert_eq!(fused.misfit, 0.0);
    }
}
