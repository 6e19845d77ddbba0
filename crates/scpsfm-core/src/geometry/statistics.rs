//! The little statistics that gates and noise estimates need.

/// Standard normal quantile of .999, the level of every inlier gate: one right track in a thousand is lost.
pub const GATE_QUANTILE: f64 = 3.090_232;

/// Chi-square quantiles of .999 for one and two degrees of freedom, rounded: of one unknown and of an image point.
pub const CHI_SQUARE_OF_ONE: f64 = 10.8;
pub const CHI_SQUARE_OF_TWO: f64 = 13.8;

/// Median of the norm of two independent normal coordinates (Rayleigh) in standard deviations.
const RAYLEIGH_MEDIAN: f64 = 1.177_41;
/// Share of the observations' freedom that must be left to the residuals for their noise to be believed. With less the
/// fit decides what they are: a component of three points fitted these exactly, and closed the gates of all that came
/// after it.
const LEAST_FREEDOM: f64 = 0.2;

/// Normal consistency of the median absolute deviation.
pub const DEVIATION_PER_MEDIAN: f64 = 1.4826;

/// Chi-square quantile at the level of [`GATE_QUANTILE`] for `dof` degrees of freedom.
///
/// Within 2 % for `dof` >= 3.
pub fn chi_square_gate(dof: f64) -> f64 {
    chi_square_quantile(dof, GATE_QUANTILE)
}

/// Median of a chi-square variable of `dof` degrees of freedom.
pub fn chi_square_median(dof: f64) -> f64 {
    chi_square_quantile(dof, 0.0)
}

/// Quantile of a chi-square variable of `dof` degrees of freedom, at the level of this one of the normal distribution:
/// the approximation of Wilson & Hilferty (1931).
pub fn chi_square_quantile(dof: f64, normal_quantile: f64) -> f64 {
    let spread = 2.0 / (9.0 * dof);
    dof * (1.0 - spread + normal_quantile * spread.sqrt()).max(0.0).powi(3)
}

/// Median of the values, which are reordered; the lower one of two. 0 for an empty slice.
pub fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The median, of an even number of values the mean of the middle two: of a handful of values the lower of the two is
/// biased. 0 for none.
pub fn midpoint_median(values: &mut [f64]) -> f64 {
    let lower = median(values);
    if values.is_empty() || values.len() % 2 == 1 {
        return lower;
    }
    let upper = values[values.len() / 2..].iter().copied().fold(f64::INFINITY, f64::min);
    0.5 * (lower + upper)
}

/// Core noise, one standard deviation of a coordinate, by the median of these norms of residuals, for what their
/// freedom leaves of it; `None` where that is next to nothing, as a few points fit any noise, and without residuals.
pub fn core_noise(mut norms: Vec<f64>, unknowns: usize) -> Option<f64> {
    let freedom = 1.0 - unknowns as f64 / (2 * norms.len()) as f64;
    (freedom >= LEAST_FREEDOM).then(|| median(&mut norms) / RAYLEIGH_MEDIAN / freedom.sqrt())
}

/// `None` for no values.
pub fn root_mean_square(values: &[f64]) -> Option<f64> {
    let mean = values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64;
    (!values.is_empty()).then(|| mean.sqrt())
}

/// Natural logarithm of the binomial coefficient `C(n, k)`, by Stirling's series.
pub fn ln_choose(n: usize, k: usize) -> f64 {
    if k > n {
        return f64::NEG_INFINITY;
    }
    ln_factorial(n) - ln_factorial(k) - ln_factorial(n - k)
}

fn ln_factorial(n: usize) -> f64 {
    if n < 2 {
        return 0.0;
    }
    let x = n as f64;
    x * x.ln() - x + 0.5 * (std::f64::consts::TAU * x).ln() + 1.0 / (12.0 * x) - 1.0 / (360.0 * x.powi(3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_agree_with_tables() {
        for (dof, gate, middle) in [(3.0, 16.266, 2.366), (7.0, 24.322, 6.346), (17.0, 40.790, 16.338)] {
            assert!((chi_square_gate(dof) / gate - 1.0).abs() < 0.02, "gate {dof}");
            assert!((chi_square_median(dof) / middle - 1.0).abs() < 0.02, "median {dof}");
        }
    }

    #[test]
    fn binomials_agree_with_pascals_triangle() {
        for (n, k, exact) in [(10, 3, 120.0f64), (52, 5, 2_598_960.0), (4, 4, 1.0), (5, 0, 1.0)] {
            assert!((ln_choose(n, k) - exact.ln()).abs() < 1e-4, "C({n},{k})");
        }
        assert_eq!(ln_choose(3, 4), f64::NEG_INFINITY);
    }

    #[test]
    fn median_of_even_odd_and_none() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&mut [4.0, 1.0, 3.0, 2.0]), 2.0);
        assert_eq!(median(&mut []), 0.0);
        assert_eq!(midpoint_median(&mut [3.0, 1.0, 2.0]), 2.0);
        assert_eq!(midpoint_median(&mut [4.0, 1.0, 3.0, 2.0]), 2.5);
        assert_eq!(midpoint_median(&mut []), 0.0);
    }

    /// Two coordinates of each of 100 observations; with 198 unknowns the residuals are those that the fit has chosen.
    #[test]
    fn noise_is_told_by_residuals_that_have_freedom() {
        let noise = |unknowns: usize| core_noise(vec![2.0 * RAYLEIGH_MEDIAN; 100], unknowns);
        assert_eq!(noise(0), Some(2.0));
        assert!(noise(100).is_some_and(|noise| (noise - 2.0 * 2f64.sqrt()).abs() < 1e-12));
        assert_eq!(noise(198), None);
        assert_eq!([0, 6].map(|unknowns| core_noise(Vec::new(), unknowns)), [None; 2]);
    }
}
