//! The Levenberg-Marquardt method (Madsen, Nielsen & Tingleff 2004, section 3.2): one loop, one damping policy.
//!
//! A problem says what a state costs, linearises, and solves its damped normal equations; [`Normal`] does the latter
//! for problems whose number of unknowns is known beforehand.

use nalgebra::allocator::Allocator;
use nalgebra::{DefaultAllocator, Dim, OMatrix, OVector, SMatrix, SVector};

use crate::domain::StopToken;

/// Dampings tried for one step before the state is declared a minimum.
const MAX_ATTEMPTS: usize = 8;
/// Factor on the damping after the first rejected step, and its own factor with each further one: the attempts span
/// 5e15, from the least damping to one that allows but a small step downhill.
const DAMPING_UP: f64 = 8.0;
const GROWTH_UP: f64 = 2.0;
/// Bounds of the factor after an accepted one: a step that gains what was predicted divides the damping by five, one
/// that gains next to nothing doubles it.
const ACCEPTED_FACTORS: (f64, f64) = (0.2, 2.0);
/// Accepted steps over which the pace of a descent is measured: as many as rank the starts of a calibration.
const PACE_STEPS: usize = 12;

/// What the loop asks of a sum of squares, or of a robust loss that is reweighted at every linearisation.
pub(crate) trait LeastSquares {
    type State: Clone;

    /// Least damping, relative to the diagonal. The default is that of dense problems: with less, rounding in the gauge
    /// directions is amplified into the step.
    const MIN_DAMPING: f64 = 1e-10;

    /// The cost of a state; infinite or not a number where it has none.
    fn cost(&self, state: &Self::State) -> f64;

    /// Builds the normal equations at a state.
    fn linearise(&mut self, state: &Self::State);

    /// Solves the normal equations, damped relative to their diagonal, and moves `from` by the solution into `to`.
    ///
    /// Returns the decrease of the cost that the linearisation predicts, not a number where that is not known; `None`
    /// where the system has no solution.
    fn step(&mut self, from: &Self::State, damping: f64, to: &mut Self::State) -> Option<f64>;

    /// The same with what the state moved to costs; may improve on a step that does not cost less than `present`.
    fn attempt(&mut self, from: &Self::State, damping: f64, _present: f64, to: &mut Self::State) -> Option<StepCost> {
        let predicted = self.step(from, damping, to)?;
        Some(StepCost { cost: self.cost(to), predicted })
    }
}

/// A step that was tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StepCost {
    pub cost: f64,
    /// By how much the linearisation says that the cost is lower.
    pub predicted: f64,
}

/// What a residual costs, as a function of its norm `r` in normalised image units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Loss {
    /// `r^2`
    Squared,
    /// `s^2 ln(1 + r^2 / s^2)` with `s` the scale; iteratively reweighted.
    Cauchy { scale: f64 },
}

impl Loss {
    /// Cost of a residual of this squared norm.
    #[inline]
    pub fn cost(self, squared: f64) -> f64 {
        match self {
            Loss::Squared => squared,
            Loss::Cauchy { scale } => scale * scale * (squared / (scale * scale)).ln_1p(),
        }
    }

    /// Factor on residual and Jacobian that makes least squares follow the loss: the root of its derivative.
    #[inline]
    pub fn root_weight(self, squared: f64) -> f64 {
        match self {
            Loss::Squared => 1.0,
            Loss::Cauchy { scale } => (1.0 + squared / (scale * scale)).sqrt().recip(),
        }
    }
}

/// When to start and end, and what residuals cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Accepted steps at most.
    pub max_iterations: usize,
    /// Ends when a step lowers the cost by less than this share of it.
    pub relative_tolerance: f64,
    /// First damping, relative to the diagonal of the normal equations.
    pub initial_damping: f64,
    /// Ends as hopeless where the steps that are left, at the pace of the last [`PACE_STEPS`], do not bring the cost
    /// below this; infinite: never.
    pub hopeless_above: f64,
    /// Read by bundle adjustment alone; other problems have a loss of their own.
    pub loss: Loss,
}

impl Options {
    /// Converges from an algebraic solution: 30 steps are rarely used up, and a cost that moves by less than 1e-7 is
    /// far below the noise it is compared with.
    pub const DEFAULT: Self = Self {
        max_iterations: 30,
        relative_tolerance: 1e-7,
        initial_damping: 1e-4,
        hopeless_above: f64::INFINITY,
        loss: Loss::Squared,
    };

    /// Plain least squares with these iterations.
    pub fn squared(max_iterations: usize) -> Self {
        Self { max_iterations, ..Self::DEFAULT }
    }
}

/// What the loop did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// Before and after.
    pub initial_cost: f64,
    pub cost: f64,
    /// Accepted steps.
    pub iterations: usize,
    /// Whether it ended as hopeless, see [`Options::hopeless_above`].
    pub is_hopeless: bool,
}

impl Report {
    /// Report of a run without steps.
    pub(crate) fn at(cost: f64) -> Self {
        Self { initial_cost: cost, cost, iterations: 0, is_hopeless: false }
    }
}

/// Minimises the cost from `state`, which is replaced by the best one found.
///
/// The cost never rises. `stop` is asked before every damped solve.
pub(crate) fn minimise<P: LeastSquares>(
    problem: &mut P,
    state: &mut P::State,
    options: &Options,
    stop: &StopToken,
) -> Report {
    let mut report = Report::at(problem.cost(state));
    // After the last steps, each at its number modulo theirs.
    let mut costs = [report.cost; PACE_STEPS];
    let mut trial = state.clone();
    let mut damping = options.initial_damping.max(P::MIN_DAMPING);
    while report.iterations < options.max_iterations && report.cost > 0.0 && !stop.is_stopped() {
        problem.linearise(state);
        let mut growth = DAMPING_UP;
        let accepted = (0..MAX_ATTEMPTS).take_while(|_| !stop.is_stopped()).find_map(|_| {
            let lowered = problem.attempt(state, damping, report.cost, &mut trial);
            // Written so that NaN fails.
            let lowered = lowered.filter(|attempt| attempt.cost < report.cost);
            if lowered.is_none() {
                damping *= growth;
                growth *= GROWTH_UP;
            }
            lowered
        });
        let Some(StepCost { cost, predicted }) = accepted else { break };
        std::mem::swap(state, &mut trial);
        let gain = report.cost - cost;
        damping = (damping * factor_after(gain / predicted)).max(P::MIN_DAMPING);
        report.cost = cost;
        report.iterations += 1;
        let before = std::mem::replace(&mut costs[report.iterations % PACE_STEPS], cost);
        if gain < options.relative_tolerance * cost {
            break;
        }
        report.is_hopeless = report.iterations >= PACE_STEPS
            && is_hopeless(before, cost, options.max_iterations - report.iterations, options.hopeless_above);
        if report.is_hopeless {
            break;
        }
    }
    report
}

/// See [`Options::hopeless_above`].
///
/// * `before`: cost [`PACE_STEPS`] ago
/// * `left`: steps
fn is_hopeless(before: f64, cost: f64, left: usize, hopeless_above: f64) -> bool {
    cost * (cost / before).powf(left as f64 / PACE_STEPS as f64) > hopeless_above
}

/// Nielsen's factor on the damping after a step that gained this share of what was predicted; the least where that is
/// not a number.
fn factor_after(gain_ratio: f64) -> f64 {
    let (least, most) = ACCEPTED_FACTORS;
    (1.0 - (2.0 * gain_ratio - 1.0).powi(3)).max(least).min(most)
}

/// The normal equations of `N` unknowns.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Normal<const N: usize> {
    pub matrix: SMatrix<f64, N, N>,
    /// Half the gradient of the cost.
    pub gradient: SVector<f64, N>,
}

impl<const N: usize> Normal<N> {
    pub fn zeros() -> Self {
        Self { matrix: SMatrix::zeros(), gradient: SVector::zeros() }
    }

    /// Adds a residual of this derivative.
    #[inline]
    pub fn add(&mut self, derivative: &SVector<f64, N>, residual: f64, weight: f64) {
        self.matrix.ger(weight, derivative, derivative, 1.0);
        self.gradient.axpy(weight * residual, derivative, 1.0);
    }

    /// The damped step and the decrease of the cost that it promises; `None` where the matrix is not positive definite.
    pub fn solve(&self, damping: f64) -> Option<(SVector<f64, N>, f64)> {
        damped_step(&self.matrix, &self.gradient, damping)
    }
}

/// The step that normal equations lead to, damped relative to their diagonal, and the decrease of the cost that it
/// promises; `None` where the matrix is not positive definite.
///
/// * `gradient`: half the gradient of the cost
pub(crate) fn damped_step<D: Dim>(
    matrix: &OMatrix<f64, D, D>,
    gradient: &OVector<f64, D>,
    damping: f64,
) -> Option<(OVector<f64, D>, f64)>
where
    DefaultAllocator: Allocator<D, D> + Allocator<D>,
{
    let mut damped = matrix.clone();
    for k in 0..damped.nrows() {
        damped[(k, k)] += damping * matrix[(k, k)] + f64::MIN_POSITIVE;
    }
    let step = damped.cholesky()?.solve(&-gradient);
    let predicted = -step.dot(&(gradient * 2.0 + matrix * &step));
    Some((step, predicted))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::*;

    /// Rosenbrock's valley: `(10 (y - x²), 1 - x)`.
    struct Valley(Normal<2>);

    impl LeastSquares for Valley {
        type State = Vector2<f64>;

        fn cost(&self, at: &Vector2<f64>) -> f64 {
            (10.0 * (at.y - at.x * at.x)).powi(2) + (1.0 - at.x).powi(2)
        }

        fn linearise(&mut self, at: &Vector2<f64>) {
            self.0 = Normal::zeros();
            self.0.add(&Vector2::new(-20.0 * at.x, 10.0), 10.0 * (at.y - at.x * at.x), 1.0);
            self.0.add(&Vector2::new(-1.0, 0.0), 1.0 - at.x, 1.0);
        }

        fn step(&mut self, from: &Vector2<f64>, damping: f64, to: &mut Vector2<f64>) -> Option<f64> {
            let (step, predicted) = self.0.solve(damping)?;
            *to = from + step;
            Some(predicted)
        }
    }

    const OPTIONS: Options =
        Options { max_iterations: 100, relative_tolerance: 1e-12, initial_damping: 1e-3, ..Options::DEFAULT };

    #[test]
    fn the_minimum_of_a_curved_valley_is_found() {
        let mut state = Vector2::new(-1.2, 1.0);
        let report = minimise(&mut Valley(Normal::zeros()), &mut state, &OPTIONS, &StopToken::default());
        assert!((state - Vector2::new(1.0, 1.0)).norm() < 1e-6, "{state} {report:?}");
        assert!(report.iterations < 40 && report.cost < report.initial_cost, "{report:?}");
    }

    /// Steps of which each takes a tenth of the cost: .9³⁰ of it is left after 30.
    #[test]
    fn a_descent_ends_where_its_pace_leads_nowhere() {
        let [now, last] = [PACE_STEPS as i32, 30].map(|steps| 0.9f64.powi(steps));
        let ends = |hopeless_above: f64| is_hopeless(1.0, now, 30 - PACE_STEPS, hopeless_above);
        assert!(ends(0.99 * last) && !ends(1.01 * last) && !ends(f64::INFINITY));
        let mut state = Vector2::new(-1.2, 1.0);
        let options = Options { hopeless_above: 1e-3, ..OPTIONS };
        let report = minimise(&mut Valley(Normal::zeros()), &mut state, &options, &StopToken::default());
        assert!(!report.is_hopeless && report.cost < 1e-12, "{report:?}");
        // A thousandth of every step leads nowhere.
        let mut state = Vector2::new(-1.2, 1.0);
        let report = minimise(&mut Slow(Valley(Normal::zeros())), &mut state, &options, &StopToken::default());
        assert!(report.is_hopeless && (PACE_STEPS..30).contains(&report.iterations), "{report:?}");
    }

    /// A thousandth of every step.
    struct Slow(Valley);

    impl LeastSquares for Slow {
        type State = Vector2<f64>;

        fn cost(&self, at: &Vector2<f64>) -> f64 {
            self.0.cost(at)
        }

        fn linearise(&mut self, at: &Vector2<f64>) {
            self.0.linearise(at);
        }

        fn step(&mut self, from: &Vector2<f64>, damping: f64, to: &mut Vector2<f64>) -> Option<f64> {
            let predicted = self.0.step(from, damping, to)?;
            *to = from + (*to - from) * 1e-3;
            Some(predicted)
        }
    }

    #[test]
    fn a_state_without_a_cost_is_left_alone() {
        let mut state = Vector2::new(f64::NAN, 1.0);
        let report = minimise(&mut Valley(Normal::zeros()), &mut state, &OPTIONS, &StopToken::default());
        assert!(state.x.is_nan() && report.iterations == 0);
    }

    #[test]
    fn dampings_follow_the_gain() {
        assert_eq!(factor_after(1.0), 0.2);
        assert_eq!(factor_after(0.5), 1.0);
        assert_eq!(factor_after(0.0), 2.0);
        assert_eq!(factor_after(f64::NAN), 0.2);
    }
}
