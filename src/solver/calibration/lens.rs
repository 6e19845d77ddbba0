//! What a lens, and a zoom behind one, would make of a calibration that was found without.

use super::Problem;
use super::fit::{Fit, posterior_noise};
use super::models::{Choice, knowledge};
use super::search::converge;
use super::verdict::{RMS_RATIO_LIMIT, Verdict};
use crate::domain::{Grade, Warning, WarningCode};
use crate::geometry::bundle::metric::Reconstruction;
use crate::geometry::bundle::zoom::Zooming;
use crate::geometry::bundle::zoom_lens::{LensZooming, SHARED_COUNT};
use crate::geometry::statistics::root_mean_square;

/// What a lens may add to log focal lengths of which every view has its own, beside what [`LensTrial`] sees of it, one
/// standard deviation: few lenses have the same distortion and centre at every focal length. No zoom is METRIC for it.
pub(super) const LENS_SIGMA: f64 = 0.05;
/// Gain in chi-square at which the observations ask for a lens: the .999 quantile of its three degrees of freedom.
const LENS_GAIN: f64 = 16.3;

/// What a lens that all views share makes of focal lengths of which each has its own: its principal point and `k1` are
/// free beside them.
pub(super) struct LensTrial {
    /// Of the logarithms of the focal lengths.
    pub shifts: Vec<f64>,
    /// Of the observations, and of what is believed of lenses.
    cost: f64,
    freedom: usize,
    /// Of chi-square.
    gain: f64,
    radial_k1: f64,
}

impl LensTrial {
    /// * `own`: the fit of `zooming`, which is at its minimum
    pub fn new(zooming: &Zooming, own: &Fit, choice: &Choice) -> Self {
        let prior = knowledge(own.noise, None, choice.scale_px);
        let mut behind_lens = LensZooming::pinhole(zooming.clone(), &prior);
        let report = behind_lens.adjust(choice.problem.observations, &converge(), choice.stop);
        let focals = behind_lens.zooming.focals.iter().zip(&zooming.focals);
        Self {
            shifts: focals.map(|(behind_lens, pinhole)| (behind_lens / pinhole).ln()).collect(),
            cost: report.cost,
            freedom: own.freedom.saturating_sub(SHARED_COUNT),
            gain: (own.cost - report.cost) / own.noise.powi(2),
            radial_k1: behind_lens.lens.radial,
        }
    }

    /// Says so where the observations ask for the lens and it moves what is told.
    pub fn warning(&self) -> Option<Warning> {
        let shift = root_mean_square(&self.shifts).filter(|shift| *shift > LENS_SIGMA && self.gain > LENS_GAIN)?;
        let detail = format!(
            "the views together ask for a lens (k1 about {:.2}), which is not estimated beside a focal length a view \
             and would move the focal lengths by {:.0} %",
            self.radial_k1,
            100.0 * shift.exp_m1()
        );
        Some(Warning::new(WarningCode::ModelMismatch, detail))
    }

    /// Of a misfit, sigma has what the lens moves; what it does not explain is that of nobody knows what.
    ///
    /// * `projective`: the fit of the projective cameras
    pub fn judge_misfit(&self, verdict: &mut Verdict, projective: &Fit) {
        let ratio = posterior_noise(self.cost, self.freedom) / projective.noise;
        if ratio > RMS_RATIO_LIMIT {
            let detail = format!("a lens beside them does not explain that: it fits {ratio:.2} times worse");
            verdict.cap(Grade::ProjectiveOnly, WarningCode::ModelMismatch, detail);
        }
    }
}

/// What the views' own focal lengths are where one for all is contradicted.
pub(super) struct Zoom {
    /// Root mean square of what lies between the logarithms of theirs and of the one.
    pub shift: f64,
    /// The smallest and the largest, normalised.
    pub range: (f64, f64),
}

/// Asks whether a focal length a view explains the observations better than one for all of `metric`, behind its lens,
/// by more than chance; if so, what they are.
///
/// * `own`: the fit of `metric`
pub(super) fn zoom(metric: &Reconstruction, own: &Fit, choice: &Choice) -> Option<Zoom> {
    let problem: &Problem = choice.problem;
    let prior = knowledge(own.noise, None, choice.scale_px);
    let mut freed = LensZooming::constant(metric, &prior);
    let report = freed.adjust(problem.observations, &converge(), choice.stop);
    let focals = freed.zooming.focals;
    let unknowns = 7 * focals.len() + 3 * super::observed_points(problem) + SHARED_COUNT;
    if !Fit::new(report.cost, unknowns.saturating_sub(7), problem).refutes(own) {
        return None;
    }
    let shifts: Vec<f64> = focals.iter().map(|focal| (focal / metric.intrinsics.focal).ln()).collect();
    let range = focals.iter().fold((f64::INFINITY, 0.0f64), |(low, high), focal| (low.min(*focal), high.max(*focal)));
    root_mean_square(&shifts).map(|shift| Zoom { shift, range })
}
