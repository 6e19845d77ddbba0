//! Which intrinsics the data carry.

use super::Uncalibrated;
use super::fit::Fit;
use super::options::{CalibrationOptions, GradeOptions, ModelOptions};
use super::search::{Minimum, Search};
use crate::domain::{FocalPrior, LensProjection, Warning, WarningCode};
use crate::geometry::bundle::metric::{
    Extension, Information, Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Optimum, Parameter,
};
use crate::solver::error::Error;

/// A metric reconstruction under one model, with what the observations say of the intrinsics there.
pub(super) struct Candidate {
    pub model: IntrinsicsModel,
    /// What it was adjusted with, one a camera group.
    pub priors: Vec<IntrinsicsPrior>,
    pub minimum: Minimum,
    /// Of the observations alone, without what the prior costs.
    pub fit: Fit,
    pub information: Option<Information>,
}

impl Candidate {
    /// * `minimum`: of this model with these priors
    pub fn new(minimum: Minimum, model: IntrinsicsModel, priors: Vec<IntrinsicsPrior>, problem: &Uncalibrated) -> Self {
        let of_priors = IntrinsicsPrior::cost_of(&priors, model, &minimum.reconstruction.intrinsics);
        let fit = Fit::metric(minimum.cost - of_priors, &minimum.reconstruction, model, problem);
        let information = Information::new(&minimum.reconstruction, problem.observations);
        Self { model, priors, minimum, fit, information }
    }

    /// What a model makes of the observations, to second order.
    pub fn optimum(&self, model: IntrinsicsModel, priors: &[IntrinsicsPrior]) -> Option<Optimum> {
        self.information.as_ref().map(|information| information.optimum(model, priors))
    }

    /// Standard deviation of a parameter of a group under a model; `None`: unobservable.
    pub fn sigma(
        &self,
        group: usize,
        parameter: Parameter,
        model: IntrinsicsModel,
        priors: &[IntrinsicsPrior],
    ) -> Option<f64> {
        let variance = self.optimum(model, priors)?.variance_of(group, parameter)?;
        Some(variance.sqrt() * self.fit.noise).filter(|sigma| sigma.is_finite())
    }

    /// Standard deviation of the log focal length if the model is right, the largest of the groups that have one.
    pub fn sigma_log_focal(&self) -> Option<f64> {
        (0..self.priors.len()).filter_map(|group| self.sigma_of_focal(group)).reduce(f64::max)
    }

    /// Value of a parameter of a group, of the log focal length in the mean where views have their own.
    pub fn value(&self, group: usize, parameter: Parameter) -> f64 {
        let reconstruction = &self.minimum.reconstruction;
        match parameter {
            Parameter::LogFocal if reconstruction.has_own_focals() => self.minimum.log_focal(),
            _ => reconstruction.intrinsics[group].value(parameter),
        }
    }

    /// Variance, for observations with unit variance, and value of the log focal length of each view that has its own
    /// at the minimum of a model.
    pub fn own_focals(&self, optimum: &Optimum) -> Vec<(Option<f64>, f64)> {
        let Some(information) = &self.information else { return Vec::new() };
        let focals = self.minimum.reconstruction.focals.iter();
        let of_views = information.own_focals(optimum).into_iter().zip(focals);
        of_views.map(|((variance, shift), focal)| (variance, focal.ln() + shift)).collect()
    }

    /// Whether each group's lens is of the same projection as the other's.
    pub fn has_projections_of(&self, other: &Self) -> bool {
        self.projections() == other.projections()
    }

    /// Of each group's lens.
    pub fn projections(&self) -> Vec<LensProjection> {
        self.minimum.reconstruction.intrinsics.iter().map(|lens| lens.projection).collect()
    }

    /// Whether it costs no more than a simpler model, which is part of it, does with its priors: its adjustment ended
    /// nowhere else.
    fn is_no_dearer_than(&self, simpler: &Self) -> bool {
        let optimum = simpler.optimum(simpler.model, &self.priors);
        optimum.is_some_and(|optimum| self.minimum.cost <= simpler.fit.cost + optimum.delta_cost)
    }

    /// Standard deviation of the log focal length of one group if the model is right.
    fn sigma_of_focal(&self, group: usize) -> Option<f64> {
        self.sigma(group, Parameter::LogFocal, self.model, &self.priors)
    }
}

/// The model that was chosen, and what else was adjusted on the way.
pub(super) struct Selection {
    pub best: Candidate,
    /// Other models of the same minimum that were adjusted, simpler and richer, and all of them behind lenses of the
    /// other projection.
    pub tried: Vec<Candidate>,
    /// Other minima under the same model.
    pub others: Vec<Minimum>,
}

impl Selection {
    /// Of a candidate without anything else tried.
    pub fn of(best: Candidate) -> Self {
        Self { best, tried: Vec::new(), others: Vec::new() }
    }

    /// Puts another minimum in place of the best, of which nothing else was adjusted; returns what was the best. What
    /// was tried of the other projection is kept: it explains the same observations.
    pub fn replace(&mut self, better: Candidate) -> Candidate {
        self.tried.retain(|tried| !tried.has_projections_of(&better));
        std::mem::replace(&mut self.best, better)
    }
}

impl Uncalibrated<'_> {
    /// What is known of the intrinsics of each group beforehand, weighed by this noise.
    pub(super) fn priors(&self, noise: f64) -> Vec<IntrinsicsPrior> {
        let of_group = |focal: &Option<FocalPrior>| self.options.lenses.prior(noise, *focal, self.scale_px);
        self.focal_priors.iter().map(of_group).collect()
    }

    /// What minima are searched by with these priors.
    pub(super) fn search<'s>(&'s self, priors: &'s [IntrinsicsPrior]) -> Search<'s> {
        Search { problem: self, priors }
    }

    fn significant_gain(&self, extension: Extension) -> f64 {
        let freedom = self.groups() * extension.parameters().len();
        self.options.models.significant_gain(freedom)
    }

    /// The minimum of a model from here, with the prior weighed by the noise that this leaves.
    ///
    /// * `noise`: to begin with
    pub(super) fn adjusted(&self, from: MetricReconstruction, model: IntrinsicsModel, mut noise: f64) -> Candidate {
        let adjusted = |from: MetricReconstruction, noise: f64| {
            let priors = self.priors(noise);
            let minimum = self.search(&priors).converged(from, model);
            Candidate::new(minimum, model, priors, self)
        };
        let mut found = adjusted(from, noise);
        let options = &self.options.models;
        for _ in 1..options.noise_rounds {
            if (options.same_noise..=1.0 / options.same_noise).contains(&(found.fit.noise / noise)) {
                break;
            }
            noise = found.fit.noise;
            found = adjusted(found.minimum.reconstruction, noise);
        }
        found
    }

    /// What a model that was chosen by more views makes of these alone.
    ///
    /// * `metric`: near its minimum
    pub(super) fn on_stretch(&self, chosen: &Candidate, metric: &MetricReconstruction) -> Candidate {
        let intrinsics = chosen.minimum.reconstruction.intrinsics.clone();
        let reconstruction = MetricReconstruction { intrinsics, ..metric.clone() };
        let minimum = self.search(&chosen.priors).converged(reconstruction, chosen.model);
        Candidate::new(minimum, chosen.model, chosen.priors.clone(), self)
    }

    /// The model that the data carry, from one that is near: without the extensions that they do not ask for, and with
    /// those that they do.
    fn select(&self, from: Candidate, warnings: &mut Vec<Warning>) -> Result<Selection, Error> {
        let found = self.without_needless(from)?;
        self.with_needed(found, warnings)
    }

    /// Takes away extension after extension, the least significant first, as long as there is one that the data do not
    /// ask for, or that leaves the focal length undetermined.
    fn without_needless(&self, rich: Candidate) -> Result<Selection, Error> {
        let mut found = Selection::of(rich);
        loop {
            let mut accepted = None;
            for extension in self.doubtful(&found.best) {
                Error::check(self.stop)?;
                let best = &found.best;
                let model = best.model.without(extension);
                let without = best.minimum.reconstruction.clone().of_model(model);
                let simpler = self.adjusted(without, model, best.fit.noise);
                // What is said of an extension that is not taken is said where it is added.
                if simpler.information.is_some() && !self.is_taken(&simpler, best, extension, &mut Vec::new()) {
                    accepted = Some(simpler);
                    break;
                }
                found.tried.push(simpler);
            }
            match accepted {
                Some(simpler) => found.tried.push(std::mem::replace(&mut found.best, simpler)),
                None => return Ok(found),
            }
        }
    }

    /// Frees extension after extension, the most significant first, as long as the data ask for one and still determine
    /// the focal length.
    fn with_needed(&self, mut found: Selection, warnings: &mut Vec<Warning>) -> Result<Selection, Error> {
        loop {
            let mut taken = None;
            for (extension, _) in self.promising(&found.best) {
                Error::check(self.stop)?;
                let model = found.best.model.with(extension);
                let tried = found.tried.iter().position(|tried| tried.model == model);
                let richer = match tried.map(|tried| found.tried.remove(tried)) {
                    Some(tried) if tried.is_no_dearer_than(&found.best) => tried,
                    _ => self.adjusted(found.best.minimum.reconstruction.clone(), model, found.best.fit.noise),
                };
                if self.is_taken(&found.best, &richer, extension, warnings) {
                    taken = Some(richer);
                    break;
                }
                found.tried.push(richer);
            }
            match taken {
                Some(richer) => found.tried.push(std::mem::replace(&mut found.best, richer)),
                None => return Ok(found),
            }
        }
    }

    /// The model that the data carry, as of [`Self::select`], with lenses of the other projection tried where they may
    /// stand in the place of those that were found.
    ///
    /// Fisheyes in the place of wide barrels become the best where the chi-square falls by a significant gain for the
    /// other projection and for each parameter more. It may rise by as much for each parameter fewer: the two series of
    /// distortion are not nested. Perspective lenses in the place of fisheyes only take part in sigma: the observations
    /// are those that fit behind the fisheye. One that images no more than a perspective lens does is none: it took its
    /// focal length from the distortion of that.
    ///
    /// * `minima`: others, put behind the same lenses as the best
    /// * `warnings`: those of the best are added
    pub(super) fn select_of_any_projection(
        &self,
        from: Candidate,
        minima: &mut [Minimum],
        warnings: &mut Vec<Warning>,
    ) -> Result<Selection, Error> {
        let ModelOptions { fisheye_from, perspective_up_to, significant_gain_of_one, .. } = self.options.models;
        let perspective = |radii: &[Option<f64>], group: usize, lens: &Intrinsics| {
            radii[group].map_or(*lens, |radius| lens.nearest_perspective(radius))
        };
        let in_perspective = |of: &Candidate, radii: &[Option<f64>]| {
            let radial = [Extension::RadialK1, Extension::RadialK2, Extension::RadialK3];
            let model = radial.into_iter().fold(of.model, IntrinsicsModel::with);
            let start = of.minimum.with_lenses(|group, lens| perspective(radii, group, lens));
            self.adjusted(start.reconstruction, model, of.fit.noise)
        };
        let is_no_fisheye = |lens: &Intrinsics, radius: f64| lens.is_fisheye() && radius <= fisheye_from;
        let from = match self.radii(&from.minimum.reconstruction, is_no_fisheye) {
            Some(radii) => {
                let replaced = |minimum: &mut Minimum| {
                    *minimum = minimum.with_lenses(|group, lens| perspective(&radii, group, lens));
                };
                minima.iter_mut().for_each(replaced);
                in_perspective(&from, &radii)
            }
            None => from,
        };
        let mut of_model = Vec::new();
        let mut found = self.select(from, &mut of_model)?;
        let best = &found.best;
        let may_be_fisheye =
            |lens: &Intrinsics, radius: f64| !lens.is_fisheye() && lens.radial[0] < 0.0 && radius > fisheye_from;
        if let Some(radii) = self.radii(&best.minimum.reconstruction, may_be_fisheye) {
            let fisheye = |group: usize, lens: &Intrinsics| {
                radii[group].map_or_else(|| lens.simplest(), |radius| lens.nearest_fisheye(radius))
            };
            let simplest = IntrinsicsModel::focal(best.model.is_per_view());
            let from = best.minimum.with_lenses(fisheye);
            let mut of_fisheyes = Vec::new();
            let from = self.adjusted(from.reconstruction, simplest, best.fit.noise);
            let other = self.select(from, &mut of_fisheyes)?;
            let parameters = |candidate: &Candidate| candidate.model.parameters().len() as f64;
            let added = 1.0 + (parameters(&other.best) - parameters(best)) * self.groups() as f64;
            let gain = (best.fit.cost - other.best.fit.cost) / best.fit.noise.min(other.best.fit.noise).powi(2);
            if gain <= added * significant_gain_of_one {
                found.tried.extend(other.tried.into_iter().chain([other.best]));
                warnings.extend(of_model);
                return Ok(found);
            }
            minima.iter_mut().for_each(|minimum| *minimum = minimum.with_lenses(fisheye));
            let mut behind = other;
            behind.tried.extend(found.tried.into_iter().chain([found.best]));
            warnings.extend(of_fisheyes);
            return Ok(behind);
        }
        let may_be_perspective = |lens: &Intrinsics, radius: f64| lens.is_fisheye() && radius < perspective_up_to;
        if let Some(radii) = self.radii(&best.minimum.reconstruction, may_be_perspective) {
            let other = in_perspective(best, &radii);
            found.tried.push(other);
        }
        warnings.extend(of_model);
        Ok(found)
    }

    /// Whether the focal length of a group, or of as many views as a calibration takes where each has its own, may be
    /// determined well enough: by its standard deviation, and by how far it still is from the minimum, where a descent
    /// along a flat valley did not arrive. The limit is above that of WEAK by `sigma_inflation`: averaging over models
    /// may lower sigma.
    ///
    /// * `fit`: of projective cameras; a lens that does not fit adds to their noise
    pub(super) fn may_be_observable(&self, best: &Candidate, fit: &Fit) -> bool {
        let CalibrationOptions { models, grades, .. } = self.options;
        let Some(optimum) = best.optimum(best.model, &best.priors) else { return false };
        let limit = models.sigma_inflation * grades.weak_up_to;
        let noise = best.fit.noise.min(fit.noise);
        let is_determined = |(variance, shift): &(Option<f64>, f64)| {
            variance.is_some_and(|variance| variance.sqrt() * noise <= limit) && shift.abs() <= limit
        };
        let focals = &best.minimum.reconstruction.focals;
        if focals.is_empty() {
            let focal = Parameter::LogFocal;
            let of_group = |group: usize| (optimum.variance_of(group, focal), optimum.shift_of(group, focal));
            return (0..self.groups()).any(|group| is_determined(&of_group(group)));
        }
        let of_views = best.own_focals(&optimum).into_iter().zip(focals);
        let of_views = of_views.map(|((variance, there), here)| (variance, there - here.ln()));
        of_views.filter(is_determined).count() as f64 >= grades.least_determined * focals.len() as f64
    }

    /// The largest radius at unit depth at which each group observes whose lens is to be replaced; `None` where none is.
    fn radii(
        &self,
        reconstruction: &MetricReconstruction,
        is_replaced: impl Fn(&Intrinsics, f64) -> bool,
    ) -> Option<Vec<Option<f64>>> {
        let mut radii = vec![0.0f64; self.groups()];
        for seen in self.observations {
            if let Some(ray) = reconstruction.intrinsics_of(seen.view).ray(&seen.xy) {
                let of_group = &mut radii[reconstruction.group_of[seen.view]];
                *of_group = of_group.max(ray.norm());
            }
        }
        let of_lenses = reconstruction.intrinsics.iter().zip(radii);
        let found: Vec<_> =
            of_lenses.map(|(lens, radius)| Some(radius).filter(|_| is_replaced(lens, radius))).collect();
        found.iter().any(Option::is_some).then_some(found)
    }

    /// Extensions to try to do without, those that gain least first: the linearisation predicts less than a multiple
    /// (one over `worth_a_trial`) of the significant gain, or a focal length that is too uncertain.
    fn doubtful(&self, best: &Candidate) -> Vec<Extension> {
        let CalibrationOptions { models, grades: GradeOptions { metric_below, .. }, .. } = self.options;
        let Some(here) = best.optimum(best.model, &best.priors) else { return Vec::new() };
        let doubt = |extension: Extension| {
            let simpler = best.model.without(extension);
            let there = best.optimum(simpler, &best.priors)?;
            let gain = (there.delta_cost - here.delta_cost) / best.fit.noise.powi(2);
            let inflates = |group: usize| {
                let rich = best.sigma_of_focal(group).unwrap_or(f64::INFINITY);
                let simple = best.sigma(group, Parameter::LogFocal, simpler, &best.priors).unwrap_or(f64::INFINITY);
                rich == f64::INFINITY || rich > metric_below.max(models.sigma_inflation * simple)
            };
            let is_doubtful =
                gain * models.worth_a_trial < self.significant_gain(extension) || (0..self.groups()).any(inflates);
            is_doubtful.then_some((extension, gain))
        };
        let mut found: Vec<(Extension, f64)> = best.model.removable().filter_map(doubt).collect();
        found.sort_by(|a, b| a.1.total_cmp(&b.1));
        found.into_iter().map(|(extension, _)| extension).collect()
    }

    /// Extensions that the linearisation predicts to be significant, with the gain beyond what is, largest first.
    fn promising(&self, best: &Candidate) -> Vec<(Extension, f64)> {
        let Some(here) = best.optimum(best.model, &best.priors) else { return Vec::new() };
        let beyond = |extension: Extension| {
            let there = best.optimum(best.model.with(extension), &best.priors)?;
            let left = (best.fit.cost + there.delta_cost).max(0.0) / best.fit.cost.max(f64::MIN_POSITIVE);
            let gain = (here.delta_cost - there.delta_cost) / (best.fit.noise.powi(2) * left.max(f64::EPSILON));
            let needed = self.significant_gain(extension);
            (gain > self.options.models.worth_a_trial * needed).then_some((extension, gain - needed))
        };
        let mut found: Vec<(Extension, f64)> = Extension::ALL
            .into_iter()
            .filter(|extension| !best.model.contains(*extension) && best.model.admits(*extension))
            .filter_map(beyond)
            .collect();
        found.sort_by(|a, b| b.1.total_cmp(&a.1));
        found
    }

    /// Whether an extension is significant and leaves the focal length observable.
    ///
    /// * `richer`: the best candidate with it
    fn is_taken(
        &self,
        best: &Candidate,
        richer: &Candidate,
        extension: Extension,
        warnings: &mut Vec<Warning>,
    ) -> bool {
        // What the simpler model costs with the same prior.
        let Some(simple) = best.optimum(best.model, &richer.priors) else { return false };
        let gain = (best.fit.cost + simple.delta_cost - richer.minimum.cost) / richer.fit.noise.powi(2);
        if gain <= self.significant_gain(extension) {
            return false;
        }
        let CalibrationOptions { models, grades: GradeOptions { metric_below, .. }, .. } = self.options;
        let observable = |group: usize| match (best.sigma_of_focal(group), richer.sigma_of_focal(group)) {
            (Some(simple), Some(rich)) => rich <= metric_below.max(models.sigma_inflation * simple),
            (Some(_), None) => false,
            // What neither model determines of one group says nothing of the others.
            (None, rich) => rich.is_some() || self.groups() > 1,
        };
        if (0..self.groups()).all(observable) {
            return true;
        }
        let shift = (richer.minimum.log_focal() - best.minimum.log_focal()).abs();
        if let Some(sigma) = best.sigma_log_focal().filter(|sigma| shift > models.model_shift * sigma) {
            warnings.push(self.not_taken(best, richer, extension, shift / sigma));
        }
        false
    }

    fn not_taken(&self, best: &Candidate, richer: &Candidate, extension: Extension, deviations: f64) -> Warning {
        let focal_px = |candidate: &Candidate| candidate.minimum.log_focal().exp() * self.scale_px;
        let detail = format!(
            "the data ask for a free {}, which moves the focal length from {:.1} to {:.1} px, {deviations:.1} standard \
             deviations, but leaves it too uncertain",
            extension.name(),
            focal_px(best),
            focal_px(richer),
        );
        Warning::new(WarningCode::ModelMismatch, detail)
    }
}
