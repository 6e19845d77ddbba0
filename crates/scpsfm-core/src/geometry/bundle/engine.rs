//! Adjustment of a problem by dense normal equations.

use std::marker::PhantomData;

use super::camera_elimination::{self, CameraElimination};
use super::problem::{BundleProblem, Layout, UNDEFINED_SQUARED, usable_squared_norm};
use super::reduced::{Linearisation, Reduced};
use super::{Loss, Observation, Options, Report};
use crate::domain::StopToken;
use crate::geometry::levenberg_marquardt;

/// Sum of the loss over the observations.
fn cost<const C: usize, const P: usize>(problem: &impl BundleProblem<C, P>, layout: &Layout, loss: Loss) -> f64 {
    let mut sum = 0.0;
    for seen in &layout.observations {
        let (residual, _) = problem.evaluate(*seen);
        sum += loss.cost(seen.weight * usable_squared_norm(&residual).unwrap_or(UNDEFINED_SQUARED));
    }
    sum
}

/// Minimises the loss over all unknowns, starting from and ending in `problem`.
///
/// The cost never rises. `stop` is asked before every damped solve; a stopped, stuck or degenerate problem keeps its
/// last good state.
pub(crate) fn minimise<const C: usize, const P: usize>(
    problem: &mut impl BundleProblem<C, P>,
    observations: &[Observation],
    options: &Options,
    stop: &StopToken,
) -> Report {
    let (cameras, points) = problem.counts();
    let layout = Layout::new(observations, cameras, points);
    if !camera_elimination::is_worth_it(problem, &layout) {
        return descend(problem, &layout, options, stop);
    }
    let layout = camera_elimination::layout(&layout, cameras);
    let mut exchanged = CameraElimination(problem.clone());
    let report = descend(&mut exchanged, &layout, options, stop);
    *problem = exchanged.0;
    report
}

/// The loop, eliminating what the problem calls points.
pub(super) fn descend<const C: usize, const P: usize, T: BundleProblem<C, P>>(
    problem: &mut T,
    layout: &Layout,
    options: &Options,
    stop: &StopToken,
) -> Report {
    let (cameras, _) = problem.counts();
    let mut dense = Dense {
        layout,
        loss: options.loss,
        linearisation: Linearisation::new(layout, cameras),
        reduced: Reduced::new(layout, cameras),
        problem: PhantomData,
    };
    levenberg_marquardt::minimise(&mut dense, problem, options, stop)
}

/// A problem with its normal equations, whose reduced system is dense.
struct Dense<'a, const C: usize, const P: usize, T> {
    layout: &'a Layout,
    loss: Loss,
    linearisation: Linearisation<'a, C, P>,
    reduced: Reduced<C, P>,
    problem: PhantomData<T>,
}

impl<const C: usize, const P: usize, T: BundleProblem<C, P>> levenberg_marquardt::LeastSquares for Dense<'_, C, P, T> {
    type State = T;

    fn cost(&self, problem: &T) -> f64 {
        cost(problem, self.layout, self.loss)
    }

    fn linearise(&mut self, problem: &T) {
        self.linearisation.fill(problem, self.loss);
    }

    fn step(&mut self, from: &T, damping: f64, to: &mut T) -> Option<f64> {
        let predicted = self.reduced.solve(from, &self.linearisation, damping)?;
        let step = &self.reduced.step;
        step.is_finite().then(|| to.retract(from, step))?;
        Some(predicted)
    }
}
