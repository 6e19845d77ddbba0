//! Robust estimation from contaminated data: one LO-MSAC loop (Torr & Zisserman 2000; Chum, Matas & Kittler 2003), with
//! the minimal solvers as plug-ins.

use nalgebra::{SVector, Vector2};
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use super::levenberg_marquardt::{self, Normal, Options};
use crate::domain::StopToken;

/// Probability with which one sample without outliers is to be among those drawn.
const CONFIDENCE: f64 = 0.99;
/// Samples between two looks at the stop token: some milliseconds.
const STOP_EVERY: usize = 32;

/// A kind of model, and the data it is sought in. A model is refined by the gradients of its residuals of two
/// coordinates, by `N` unknowns, unless the estimator has a [`refined`](Self::refined) of its own: then `N` is 0, and
/// [`residual`](Self::residual) and [`moved`](Self::moved) are left out.
pub(crate) trait Estimator<const N: usize>: Sized {
    type Model: Clone;

    /// Data that determine a model, up to a few solutions.
    const SAMPLE: usize;
    /// Gates within which a datum agrees with the model of a sample: what few noisy data determine is noisier than what
    /// many do.
    const SAMPLE_GATES: f64 = 4.0;

    fn len(&self) -> usize;

    /// Distinct data, [`Self::SAMPLE`] of them. Where they are not drawn uniformly, the search ends after more or fewer
    /// samples than its confidence asks for.
    fn sample(&self, rng: &mut ChaCha8Rng) -> Vec<usize> {
        index::sample(rng, self.len(), Self::SAMPLE).into_vec()
    }

    /// The models that fit a sample of [`Self::SAMPLE`] distinct data.
    fn minimal(&self, sample: &[usize]) -> impl IntoIterator<Item = Self::Model>;

    /// Squared residual of a datum; infinite or not a number where it has none.
    fn squared_residual(&self, model: &Self::Model, datum: usize) -> f64;

    /// Residual, in the units of a datum of weight 1, its gradients and the weight of its square; `None` where a datum
    /// has none.
    fn residual(&self, _model: &Self::Model, _datum: usize) -> Option<(Vector2<f64>, [SVector<f64, N>; 2], f64)> {
        None
    }

    /// The model moved by a step; `None` where that is none.
    fn moved(&self, _model: &Self::Model, _step: &SVector<f64, N>) -> Option<Self::Model> {
        None
    }

    /// Direction in which a model moves without changing any residual, which a refinement pins; zero where there is
    /// none.
    fn gauge(&self, _model: &Self::Model) -> SVector<f64, N> {
        SVector::zeros()
    }

    /// The model fitted to the data that are within about this squared residual of it; `None` where there are too few.
    ///
    /// By Levenberg-Marquardt on the residuals, under a Geman-McClure loss of scale `sqrt(gate)`; never worse than the
    /// start.
    fn refined(&self, start: &Self::Model, gate: f64) -> Option<Self::Model> {
        let mut model = start.clone();
        let mut refinement = Refinement { estimator: self, gate, normal: Normal::<N>::zeros() };
        levenberg_marquardt::minimise(&mut refinement, &mut model, &REFINEMENT, &StopToken::default());
        Some(model)
    }
}

/// The refinement of a model that is nearly right.
const REFINEMENT: Options = Options { max_iterations: 10, relative_tolerance: 1e-6, ..Options::DEFAULT };
/// Gates beyond which a datum weighs nothing in a refinement: a hundredth of its weight is left there.
const WEIGHED_GATES: f64 = 9.0;

struct Refinement<'a, const N: usize, E> {
    estimator: &'a E,
    gate: f64,
    normal: Normal<N>,
}

impl<const N: usize, E: Estimator<N>> levenberg_marquardt::LeastSquares for Refinement<'_, N, E> {
    type State = E::Model;

    fn cost(&self, model: &E::Model) -> f64 {
        let squared = (0..self.estimator.len()).map(|datum| self.estimator.squared_residual(model, datum));
        // What is not a number costs as much as an outlier may.
        squared.map(|squared| (self.gate * squared / (squared + self.gate)).min(self.gate)).sum()
    }

    fn linearise(&mut self, model: &E::Model) {
        self.normal = Normal::zeros();
        for datum in 0..self.estimator.len() {
            let Some((residual, gradients, weight)) = self.estimator.residual(model, datum) else { continue };
            let squared = weight * residual.norm_squared();
            // Written so that NaN is left out.
            let is_near = squared < WEIGHED_GATES * self.gate;
            if !is_near {
                continue;
            }
            let weight = weight * (self.gate / (squared + self.gate)).powi(2);
            for (gradient, residual) in gradients.iter().zip(residual.iter()) {
                self.normal.add(gradient, *residual, weight);
            }
        }
        // As much information along it as along all others together.
        let gauge = self.estimator.gauge(model);
        self.normal.matrix += gauge * gauge.transpose() * self.normal.matrix.trace();
    }

    fn step(&mut self, from: &E::Model, damping: f64, to: &mut E::Model) -> Option<f64> {
        let (step, predicted) = self.normal.solve(damping)?;
        *to = self.estimator.moved(from, &step)?;
        Some(predicted)
    }
}

/// What most data agree on.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RobustModel<M> {
    pub model: M,
    /// One a datum: whether its squared residual is within the gate.
    pub inlier: Vec<bool>,
    /// Mean over the data of the squared residual in units of the gate, each 1 at most.
    pub cost: f64,
}

impl<M> RobustModel<M> {
    pub fn inlier_count(&self) -> usize {
        self.inlier.iter().filter(|&&inlier| inlier).count()
    }
}

/// The model of least truncated squared residuals.
///
/// * `gate`: squared residual within which a datum agrees
/// * `start`: a model to begin with, as if a sample had given it
/// * `inliers_to_beat`: of another model, as if a sample had given it: one with fewer inliers is of no use
///
/// Draws until [`CONFIDENCE`] is reached for the share of inliers found, `most_samples` at most. Every sample that is
/// better than those before is optimised: fitted to the data within [`Estimator::SAMPLE_GATES`] gates, then to those
/// within one. Once `stop` fires, the best so far.
///
/// Returns `None` for too few data, no usable gate, or when no sample gives a model.
pub(crate) fn estimate<const N: usize, E: Estimator<N>>(
    estimator: &E,
    gate: f64,
    start: Option<E::Model>,
    inliers_to_beat: usize,
    most_samples: usize,
    rng: &mut ChaCha8Rng,
    stop: &StopToken,
) -> Option<RobustModel<E::Model>> {
    if estimator.len() < E::SAMPLE || !(gate > 0.0 && gate.is_finite()) {
        return None;
    }
    let wanted = most_samples.min(samples_wanted(inliers_to_beat, estimator.len(), E::SAMPLE));
    let mut search = Search { estimator, gate, best: None, best_sample_cost: f64::INFINITY, wanted };
    start.into_iter().for_each(|start| search.offer(start));
    let mut drawn = 0;
    while drawn < search.wanted && !(drawn % STOP_EVERY == 0 && stop.is_stopped()) {
        drawn += 1;
        let sample = estimator.sample(rng);
        for model in estimator.minimal(&sample) {
            search.offer(model);
        }
    }
    let (model, cost) = search.best?;
    let inlier = (0..estimator.len()).map(|datum| estimator.squared_residual(&model, datum) < gate).collect();
    Some(RobustModel { model, inlier, cost: cost / estimator.len() as f64 })
}

struct Search<'a, const N: usize, E: Estimator<N>> {
    estimator: &'a E,
    gate: f64,
    best: Option<(E::Model, f64)>,
    /// Least cost of a sample's model as it came, at the gate of samples.
    best_sample_cost: f64,
    /// Samples to draw.
    wanted: usize,
}

impl<const N: usize, E: Estimator<N>> Search<'_, N, E> {
    /// Takes a sample's model where it is better than those before, and optimises it.
    fn offer(&mut self, model: E::Model) {
        let wide = E::SAMPLE_GATES * self.gate;
        let Some(cost) = self.cost_below(&model, wide, self.best_sample_cost) else { return };
        self.best_sample_cost = cost;
        let near = self.estimator.refined(&model, wide);
        let nearest = near.as_ref().and_then(|near| self.estimator.refined(near, self.gate));
        let mut improved = false;
        for candidate in [Some(model), near, nearest].into_iter().flatten() {
            let to_beat = self.best.as_ref().map_or(f64::INFINITY, |(_, cost)| *cost);
            if let Some(cost) = self.cost_below(&candidate, self.gate, to_beat) {
                self.best = Some((candidate, cost));
                improved = true;
            }
        }
        if let Some((best, _)) = self.best.as_ref().filter(|_| improved) {
            self.wanted = self.wanted.min(samples_wanted(self.inlier_count(best), self.estimator.len(), E::SAMPLE));
        }
    }

    /// Sum of the squared residuals in units of a gate, each 1 at most; `None` as soon as it is not below `to_beat`.
    fn cost_below(&self, model: &E::Model, gate: f64, to_beat: f64) -> Option<f64> {
        let mut cost = 0.0;
        for datum in 0..self.estimator.len() {
            // What is not a number counts as an outlier.
            cost += (self.estimator.squared_residual(model, datum) / gate).min(1.0);
            if cost >= to_beat {
                return None;
            }
        }
        Some(cost)
    }

    fn inlier_count(&self, model: &E::Model) -> usize {
        (0..self.estimator.len()).filter(|&datum| self.estimator.squared_residual(model, datum) < self.gate).count()
    }
}

/// Samples of distinct data after which one without outliers was drawn with [`CONFIDENCE`].
fn samples_wanted(inliers: usize, data: usize, sample: usize) -> usize {
    let right: f64 = (0..sample).map(|k| inliers.saturating_sub(k) as f64 / (data - k) as f64).product();
    ((1.0 - CONFIDENCE).ln() / (-right).ln_1p()).ceil().max(1.0) as usize
}

pub(crate) fn chosen<T: Copy, const N: usize>(items: &[T], sample: &[usize]) -> [T; N] {
    std::array::from_fn(|k| items[sample[k]])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_as_many_as_the_inliers_ask_for() {
        assert_eq!(samples_wanted(100, 100, 8), 1);
        // ln .01 / ln (1 - 2⁻⁸), of many data.
        assert_eq!(samples_wanted(500_000, 1_000_000, 8), 1177);
        // C(12, 6) / C(40, 6) of the samples are right.
        assert_eq!(samples_wanted(12, 40, 6), 19_128);
        assert!(samples_wanted(7, 100, 8) > 1_000_000);
        assert_eq!(samples_wanted(0, 100, 3), usize::MAX);
    }
}
