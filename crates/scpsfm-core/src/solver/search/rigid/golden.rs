//! Minimisation of a function of one variable.

/// Minimum of a function near `middle`, by golden section over `middle +- half_width`.
pub fn golden_section(cost: impl Fn(f64) -> f64, middle: f64, half_width: f64, steps: usize) -> f64 {
    let ratio = (5f64.sqrt() - 1.0) / 2.0;
    let (mut low, mut high) = (middle - half_width, middle + half_width);
    let (mut left, mut right) = (high - ratio * (high - low), low + ratio * (high - low));
    let (mut cost_left, mut cost_right) = (cost(left), cost(right));
    for _ in 0..steps {
        if cost_left < cost_right {
            (high, right, cost_right) = (right, left, cost_left);
            left = high - ratio * (high - low);
            cost_left = cost(left);
        } else {
            (low, left, cost_left) = (left, right, cost_right);
            right = low + ratio * (high - low);
            cost_right = cost(right);
        }
    }
    (low + high) / 2.0
}

#[cfg(test)]
mod tests {
    use super::golden_section;

    #[test]
    fn the_golden_section_finds_a_minimum() {
        let found = golden_section(|x| (x - 0.3).powi(2), 0.2, 0.5, 30);
        assert!((found - 0.3).abs() < 1e-5, "{found}");
    }
}
