//! The grade, and the warnings that lower it.

use super::misfit::Comparison;
use crate::domain::{Grade, Warning, WarningCode};

/// Standard deviations of the log focal length that bound the grades.
pub(super) const METRIC_BELOW: f64 = 0.02;
pub(super) const WEAK_UP_TO: f64 = 0.1;
/// Standard deviation of the log focal length, a factor of 2.7, beyond which the focal length counts as unobservable.
pub(super) const UNOBSERVABLE_ABOVE: f64 = 1.0;
/// Ratio of the metric to the projective posterior noise that speaks of a wrong model; the paper's synthetic scenes
/// stay within 1.05. With few degrees of freedom it exceeds its limit by chance: the loss of fit must also be more than
/// [`MISFIT_DEVIATIONS`](super::fit::MISFIT_DEVIATIONS).
pub(super) const RMS_RATIO_LIMIT: f64 = 1.15;
/// The same ratio from which the metric reconstruction is not to be used at all.
const RMS_RATIO_REFUSAL: f64 = 3.0;
/// Factor on sigma by a misfit from which it is reported: more than half of the sigma comes of it.
const INFLATION_LIMIT: f64 = 2.0;
/// Share of the observations that must lie in front of their cameras, or the reconstruction is not to be used: what was
/// seen was not behind the camera. A forward-moving car gave 2.9 % behind, with a focal length of a quarter of the
/// true.
pub const CHEIRALITY_LIMIT: f64 = 0.99;
/// Focal lengths that lenses have, in the longer image side: rectilinear ones end at a field of view of 135 degrees
/// (.2), telescopes at half a degree. Beyond, a minimum is no camera: of windows of a forward-moving car one was taken
/// for a lens of 170 degrees, at a sigma of 10 %.
const FOCAL_RANGE: (f64, f64) = (0.15, 120.0);

/// The grade with the warnings that led to it.
pub(super) struct Verdict {
    pub grade: Grade,
    pub warnings: Vec<Warning>,
    /// Whether the metric model does not fit: its sigma says nothing then.
    pub is_misfit: bool,
}

impl Verdict {
    /// Nothing speaks against it yet but these warnings.
    pub fn new(warnings: Vec<Warning>) -> Self {
        Self { grade: Grade::Metric, warnings, is_misfit: false }
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
    pub fn judge_sigma(&mut self, sigma: Option<f64>) {
        self.grade = self.grade.worse(grade_of_sigma(sigma));
        if grade_of_sigma(sigma) != Grade::ProjectiveOnly || self.has(WarningCode::UnobservableFocal) {
            return;
        }
        let detail = match sigma {
            Some(sigma) => format!(
                "the motion determines the logarithm of the focal length only to {sigma:.2} (one standard deviation), \
                 more than {WEAK_UP_TO}"
            ),
            None => "the motion does not determine the focal length".to_owned(),
        };
        self.warnings.push(Warning::new(WarningCode::UnobservableFocal, detail));
    }

    /// Asks whether the metric reconstruction fits as well as the projective one.
    ///
    /// * `free`: what the metric one leaves free, in words
    pub fn judge_fit(&mut self, comparison: &Comparison, free: &str, scale_px: f64) {
        let Comparison { ratio, noise, .. } = *comparison;
        if comparison.is_misfit() {
            let worst = if ratio > RMS_RATIO_REFUSAL { Grade::ProjectiveOnly } else { Grade::Weak };
            let detail = format!(
                "the metric reconstruction fits {ratio:.2} times worse than the projective one ({:.2} px against \
                 {:.2} px) with {free} free: distortion, a zoom or wrong tracks",
                ratio * noise * scale_px,
                noise * scale_px,
            );
            self.cap(worst, WarningCode::ModelMismatch, detail);
            self.is_misfit = true;
        } else if comparison.inflation > INFLATION_LIMIT {
            let detail = format!(
                "with {free} free the tracks violate the calibration {:.1} times as much as their noise explains; \
                 sigma is as much larger",
                comparison.inflation
            );
            self.warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
        }
    }

    /// Grades by a sigma that has grown for this reason.
    pub fn doubt(&mut self, sigma: Option<f64>, detail: String) {
        self.cap(grade_of_sigma(sigma), WarningCode::ModelMismatch, detail);
    }

    /// Asks whether there is a lens of this focal length, in the longer image side, unless the caller said so.
    pub fn judge_plausibility(&mut self, focal: f64, is_known: bool, scale_px: f64) {
        if !is_known && !is_plausible(focal) {
            let detail = format!(
                "a focal length of {:.1} px, {focal:.2} of the longer image side, is that of no lens",
                focal * scale_px
            );
            self.cap(Grade::ProjectiveOnly, WarningCode::UnobservableFocal, detail);
        }
    }

    /// Asks for the observations in front of their cameras, and for enough tracks.
    pub fn judge_cheirality(&mut self, in_front: f64) {
        if in_front < CHEIRALITY_LIMIT {
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
            (Grade::Weak, true) => WEAK_UP_TO,
            (Grade::Weak, false) => METRIC_BELOW,
            _ => 0.0,
        };
        sigma.map(|sigma| sigma.max(least))
    }
}

/// Whether there is a lens of this focal length, in the longer image side.
pub(super) fn is_plausible(focal: f64) -> bool {
    (FOCAL_RANGE.0..=FOCAL_RANGE.1).contains(&focal)
}

/// The grade that a standard deviation of the log focal length alone would give; `None`: unobservable.
pub fn grade_of_sigma(sigma: Option<f64>) -> Grade {
    match sigma {
        Some(sigma) if sigma < METRIC_BELOW => Grade::Metric,
        Some(sigma) if sigma <= WEAK_UP_TO => Grade::Weak,
        _ => Grade::ProjectiveOnly,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_lens_is_as_wide_or_as_long() {
        let grade = |focal: f64, is_known: bool| {
            let mut verdict = Verdict::new(Vec::new());
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
