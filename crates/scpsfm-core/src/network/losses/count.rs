//! L_num: too few inliers (paper, eq. 7).

/// Largest exponent of L_num: e³⁰ is about 1e13, and its gradient still fits into the f32 of the network. The gradient
/// keeps the capped value instead of vanishing, or weights that collapsed could never come back.
pub const MAX_EXPONENT: f64 = 30.0;

/// What L_num is; `min_inliers` is the paper's `t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CountTerm {
    /// `exp(t - Σ_j s(κ (w_j - 1/2)))` with the sigmoid s: eq. 7 with κ = 1.
    Sigmoid { min_inliers: f64, kappa: f64 },
    /// `exp(t - N)` up to `N = Σ_j w_j = t` and its tangent `1 + t - N` beyond, the surrogate of eq. 10.
    Tangent { min_inliers: f64 },
}

impl CountTerm {
    /// Its value and its derivative by each weight.
    pub fn evaluate(self, w: &[f64]) -> (f64, Vec<f64>) {
        match self {
            Self::Sigmoid { min_inliers, kappa } => {
                let soft: Vec<f64> = w.iter().map(|w| 1.0 / (1.0 + (-kappa * (w - 0.5)).exp())).collect();
                let value = (min_inliers - soft.iter().sum::<f64>()).min(MAX_EXPONENT).exp();
                (value, soft.iter().map(|s| -kappa * s * (1.0 - s) * value).collect())
            }
            Self::Tangent { min_inliers } => {
                let missing = min_inliers - w.iter().sum::<f64>();
                let (value, slope) = if missing > 0.0 {
                    let value = missing.min(MAX_EXPONENT).exp();
                    (value, -value)
                } else {
                    (1.0 + missing, -1.0)
                };
                (value, vec![slope; w.len()])
            }
        }
    }
}
