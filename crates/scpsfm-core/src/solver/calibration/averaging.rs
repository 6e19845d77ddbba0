//! What not knowing the model costs: standard deviations averaged over models.

use super::Uncalibrated;
use super::models::{Candidate, Selection};
use crate::domain::FocalPrior;
use crate::geometry::bundle::metric::{Extension, IntrinsicsModel, IntrinsicsPrior, Optimum, Parameter};

/// A model as the observations and what lenses are like weigh it.
struct Weighed<'a> {
    log_weight: f64,
    /// What it was linearised at.
    from: &'a Candidate,
    optimum: Optimum,
}

/// Standard deviations, the doubt about the model included.
pub(super) struct Sigmas {
    /// Of each group's intrinsics that the model frees, indexed by [`Parameter`], the log focal length's also where
    /// every view has its own, then of their mean; `None`: unobservable or not free.
    pub of_group: Vec<[Option<f64>; Parameter::COUNT]>,
    /// Of the log focal length of each view that has its own; `None`: unobservable.
    pub view_focals: Vec<Option<f64>>,
}

/// The standard deviation of a log focal length where the observations say less by this factor, and what is known of it
/// beforehand as much.
pub(super) fn widened(sigma: f64, factor: f64, known: Option<FocalPrior>) -> f64 {
    let of_prior = known.map_or(0.0, |known| known.sigma_log.powi(-2));
    let of_data = (sigma.powi(-2) - of_prior).max(0.0);
    (of_prior + of_data / factor.powi(2)).powf(-0.5).max(sigma)
}

impl Sigmas {
    /// The same where the observations say less by this factor, and what is known of focal lengths beforehand as much.
    pub fn widened(mut self, factor: f64, focal_priors: &[Option<FocalPrior>]) -> Self {
        for (of_group, prior) in self.of_group.iter_mut().zip(focal_priors) {
            let of_focal = of_group[Parameter::LogFocal as usize];
            let factor = of_focal.map_or(factor, |sigma| widened(sigma, factor, *prior) / sigma);
            of_group.iter_mut().flatten().for_each(|sigma| *sigma *= factor);
        }
        self.view_focals.iter_mut().flatten().for_each(|sigma| *sigma *= factor);
        self
    }
}

impl Uncalibrated<'_> {
    /// Standard deviations under the best model and all doubt about it.
    ///
    /// Bayesian model averaging (Hoeting, Madigan, Raftery & Volinsky 1999, eq. 3) over all combinations of extensions:
    /// the expected squared error of the value reported, `sum_k w_k (sigma_k^2 + (f_k - f)^2)`, with the weights from
    /// Laplace's approximation of each model's evidence under [`LensOptions`](super::options::LensOptions), a model
    /// with distortion once for each kind of lens. An extension that the data can neither confirm nor refute thus costs
    /// what it would move.
    ///
    /// The value reported is that of the best model's adjustment, which along a flat valley may end before the minimum
    /// that its linearisation predicts. The distance to that is part of the error, like those of other models.
    ///
    /// The same models behind lenses of the other projection take part where that was tried, as probable beforehand;
    /// poses and points are taken to be known alike behind either. The terms of distortion are averaged over the models
    /// of the best one's projection: in the other they are those of another series.
    ///
    /// * `priors`: those of the best model, or without what is known of a focal length
    /// * `inflation`: factor on all of them, for what a linearisation with independent noise does not see
    pub(super) fn sigmas(&self, selection: &Selection, priors: &[IntrinsicsPrior], inflation: f64) -> Sigmas {
        let Selection { best, tried, .. } = selection;
        let views = best.minimum.reconstruction.focals.len();
        let here = best.sigma_log_focal().and_then(|_| best.optimum(best.model, priors));
        let own = best.optimum(best.model, &best.priors);
        let Some((here, own)) = here.zip(own) else {
            let of_group = vec![[None; Parameter::COUNT]; self.groups()];
            return Sigmas { of_group, view_focals: vec![None; views] };
        };
        let unit = best.fit.noise.powi(2);
        let other = tried.iter().find(|tried| !tried.has_projections_of(best));
        let models: Vec<Weighed> = std::iter::once(best)
            .chain(other)
            .flat_map(|like| best.model.with_any_extensions().map(move |model| (like, model)))
            .flat_map(|(like, model)| self.weighed(selection, like, model, priors))
            .collect();
        let highest = models.iter().map(|model| model.log_weight).fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = models.iter().map(|model| (model.log_weight - highest).exp()).collect();
        // Of what has this weight, variance and value under each model, and this value under the best.
        let averaged = |of_models: &mut dyn Iterator<Item = (f64, (Option<f64>, f64))>, here: f64| {
            let (mut total, mut unknown, mut squared) = (0.0, 0.0, 0.0);
            for (weight, (variance, value)) in of_models {
                total += weight;
                match variance {
                    Some(variance) => squared += weight * (variance * unit + (value - here).powi(2)),
                    None => unknown = f64::max(unknown, weight),
                }
            }
            let sigma = (squared / total).sqrt() * inflation;
            Some(sigma).filter(|sigma| sigma.is_finite() && unknown <= self.options.models.negligible * total)
        };
        let free = best.model.parameters();
        let of_parameter = |group: usize, parameter: Parameter| {
            let is_free = free.contains(&parameter) || (views > 0 && parameter == Parameter::LogFocal);
            let is_comparable = |from: &Candidate| !parameter.is_of_lens() || from.has_projections_of(best);
            let value =
                |from: &Candidate, optimum: &Optimum| from.value(group, parameter) + optimum.shift_of(group, parameter);
            let of_model = |(&weight, Weighed { from, optimum, .. }): (&f64, &Weighed)| {
                let found = (optimum.variance_of(group, parameter), value(from, optimum));
                is_comparable(from).then_some((weight, found))
            };
            // With other priors the value keeps the distance that it has to the minimum with its own.
            let reported = value(best, &here) - own.shift_of(group, parameter);
            averaged(&mut weights.iter().zip(&models).filter_map(of_model), reported).filter(|_| is_free)
        };
        let groups = 0..self.groups();
        let of_group = groups.map(|group| Parameter::ALL.map(|parameter| of_parameter(group, parameter))).collect();
        let (here, own) = (best.own_focals(&here), best.own_focals(&own));
        let there: Vec<_> = models.iter().map(|model| model.from.own_focals(&model.optimum)).collect();
        let of_view = |view: usize| {
            let of_models = weights.iter().zip(&there).map(|(&weight, of_views)| (weight, of_views[view]));
            let shift = own[view].1 - best.minimum.reconstruction.focals[view].ln();
            averaged(&mut { of_models }, here[view].1 - shift)
        };
        Sigmas { of_group, view_focals: (0..views).map(of_view).collect() }
    }

    /// A model for each kind of lens that it may be of, from the candidate of one projection that was adjusted with most
    /// nearly the same extensions: where the observations are weak, a linearisation predicts only half of the gain that
    /// an adjustment finds.
    ///
    /// * `like`: one of that projection
    fn weighed<'c>(
        &self,
        selection: &'c Selection,
        like: &Candidate,
        model: IntrinsicsModel,
        priors: &[IntrinsicsPrior],
    ) -> Vec<Weighed<'c>> {
        let Selection { best, tried, .. } = selection;
        let differing = |candidate: &Candidate| {
            let extensions = Extension::ALL.into_iter();
            extensions.filter(|one| candidate.model.contains(*one) != model.contains(*one)).count()
        };
        // A richer model may have ended in another minimum, behind the cameras.
        let least = self.options.grades.least_in_front.min(best.minimum.cheirality);
        let is_like = |tried: &&Candidate| {
            let stands = tried.information.is_some() && tried.minimum.cheirality >= least;
            stands && tried.has_projections_of(like)
        };
        let adjusted = std::iter::once(best).chain(tried.iter().rev()).filter(is_like);
        let Some(from) = adjusted.min_by_key(|candidate| differing(candidate)) else { return Vec::new() };
        let of_kind = |(share, narrowing): (f64, f64)| {
            let narrowed = |prior: &IntrinsicsPrior| prior.narrowed(Parameter::RadialK1, narrowing);
            let priors: Vec<IntrinsicsPrior> = priors.iter().map(narrowed).collect();
            let optimum = from.optimum(model, &priors)?;
            let gain = (best.fit.cost - from.fit.cost - optimum.delta_cost) / best.fit.noise.powi(2);
            let log_weight = share.ln() + self.log_prior(model, &priors) + 0.5 * gain - 0.5 * optimum.log_determinant;
            Some(Weighed { log_weight, from, optimum })
        };
        self.options.lenses.kinds(model).into_iter().filter_map(of_kind).collect()
    }

    /// Logarithm of the prior probability of a model and of the density of its parameters where they are most likely,
    /// up to what all models share.
    fn log_prior(&self, model: IntrinsicsModel, priors: &[IntrinsicsPrior]) -> f64 {
        let lenses = &self.options.lenses;
        let of = |extension: Extension| match model.contains(extension) {
            true => {
                let of_group = |prior: &IntrinsicsPrior| -> f64 {
                    extension.parameters().iter().map(|parameter| prior.information[*parameter as usize].ln()).sum()
                };
                lenses.probability(extension).ln() + 0.5 * priors.iter().map(of_group).sum::<f64>()
            }
            false if model.admits(extension) => (1.0 - lenses.probability(extension)).ln(),
            false => 0.0,
        };
        Extension::ALL.into_iter().map(of).sum()
    }
}
