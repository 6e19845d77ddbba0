//! The grade, and the warnings that lower it.

use super::misfit::Comparison;
use super::options::CalibrationOptions;
use crate::domain::{Grade, Warning, WarningCode};

/// The grade with the warnings that led to it.
pub(super) struct Verdict<'a> {
    pub options: &'a CalibrationOptions,
    pub grade: Grade,
    pub warnings: Vec<Warning>,
    /// Whether the metric model does not fit: its sigma says nothing then.
    pub is_misfit: bool,
}

impl<'a> Verdict<'a> {
    /// Nothing speaks against it yet but these warnings.
    pub fn new(options: &'a CalibrationOptions, warnings: Vec<Warning>) -> Self {
        Self { options, grade: Grade::Metric, warnings, is_misfit: false }
    }

    /// Lowers the grade to this at most and says why.
    pub fn cap(&mut self, worst: Grade, code: WarningCode, detail: String) {
        self.grade = self.grade.worse(worst);
        self.warnings.push(Warning::new(code, detail));
    }

    pub fn has(&self, code: WarningCode) -> bool {
        self.warnings.iter().any(|warning| warning.code == code)
    }

    /// Grades by the standard deviation of the log focal length; `None`: unobservable.
    ///
    /// * `correlation`: factor on it, for noise that the observations of a track have in common
    pub fn judge_sigma(&mut self, sigma: Option<f64>, correlation: f64) {
        let grade = self.options.grades.grade(sigma);
        self.grade = self.grade.worse(grade);
        if grade != Grade::ProjectiveOnly || self.has(WarningCode::UnobservableFocal) {
            return;
        }
        let mut warning = self.options.grades.unobservable(sigma);
        if sigma.is_some() && correlation > 1.0 {
            let words = "noise that the observations of a track have in common makes it";
            warning.detail.push_str(&format!("; {words} {correlation:.1} times as large"));
        }
        self.warnings.push(warning);
    }

    /// Asks whether the metric reconstruction fits as well as the projective one.
    ///
    /// * `free`: what the metric one leaves free, in words
    pub fn judge_fit(&mut self, comparison: &Comparison, free: &str, scale_px: f64) {
        let Comparison { ratio, noise, .. } = *comparison;
        let options = &self.options.fit;
        if comparison.is_misfit(options) {
            let worst = if ratio > options.rms_ratio_refusal { Grade::ProjectiveOnly } else { Grade::Weak };
            let detail = format!(
                "the metric reconstruction fits {ratio:.2} times worse than the projective one ({:.2} px against \
                 {:.2} px) with {free} free: distortion, a zoom or wrong tracks",
                ratio * noise * scale_px,
                noise * scale_px,
            );
            self.cap(worst, WarningCode::ModelMismatch, detail);
            self.is_misfit = true;
        } else if comparison.is_violated(options) {
            let detail = format!(
                "with {free} free the tracks violate the calibration {:.1} times as much as their noise explains; \
                 sigma is as much larger",
                comparison.violation
            );
            self.warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
        }
    }

    /// Grades by a sigma that has grown for this reason.
    pub fn doubt(&mut self, sigma: Option<f64>, detail: String) {
        self.cap(self.options.grades.grade(sigma), WarningCode::ModelMismatch, detail);
    }

    /// Asks whether there is a lens of this focal length, in the longer image side, unless the caller said so.
    pub fn judge_plausibility(&mut self, focal: f64, is_known: bool, scale_px: f64) {
        if !is_known && !self.options.lenses.is_plausible(focal) {
            let detail = format!(
                "a focal length of {:.1} px, {focal:.2} of the longer image side, is that of no lens",
                focal * scale_px
            );
            self.cap(Grade::ProjectiveOnly, WarningCode::UnobservableFocal, detail);
        }
    }

    /// Asks for the observations in front of their cameras, and for enough tracks.
    pub fn judge_cheirality(&mut self, in_front: f64) {
        if in_front < self.options.grades.least_in_front {
            let detail = format!("{:.1} % of the observations lie behind their cameras", 100.0 * (1.0 - in_front));
            self.cap(Grade::ProjectiveOnly, WarningCode::Cheirality, detail);
        }
        if self.has(WarningCode::FewInliers) {
            self.grade = self.grade.worse(Grade::Weak);
        }
    }

    /// The sigma that is reported: not one that the fit contradicts. Whatever lowered the grade is worth at least the
    /// grade's least, and a model that does not fit its most: wrong minima behind a distorting lens were off by 20 to
    /// 30 %.
    pub fn reported(&self, sigma: Option<f64>) -> Option<f64> {
        let least = match (self.grade, self.is_misfit) {
            (Grade::Weak, true) => self.options.grades.weak_up_to,
            (Grade::Weak, false) => self.options.grades.metric_below,
            _ => 0.0,
        };
        sigma.map(|sigma| sigma.max(least))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_lens_is_as_wide_or_as_long() {
        let grade = |focal: f64, is_known: bool| {
            let mut verdict = Verdict::new(&CalibrationOptions::DEFAULT, Vec::new());
            verdict.judge_plausibility(focal, is_known, 1000.0);
            (verdict.grade, verdict.has(WarningCode::UnobservableFocal))
        };
        for focal in [0.2, 1.2, 100.0] {
            assert_eq!(grade(focal, false), (Grade::Metric, false), "{focal}");
        }
        for focal in [0.05, 500.0, f64::NAN] {
            assert_eq!(grade(focal, false), (Grade::ProjectiveOnly, true), "{focal}");
        }
        assert_eq!(grade(0.1, true), (Grade::Metric, false));
    }
}
