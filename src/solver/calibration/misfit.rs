//! Whether a metric reconstruction fits as well as a projective one.

use nalgebra::Vector4;

use super::fit::{Fit, MISFIT_DEVIATIONS, posterior_noise};
use super::models::{Candidate, Choice};
use super::observed_points;
use crate::geometry::bundle::metric::{self, Reconstruction};
use crate::geometry::bundle::{Options, projective};
use crate::geometry::observation::Observation;

/// Iterations from the metric reconstruction to the minima that are compared; both are near.
const ITERATIONS: usize = 10;

/// A metric reconstruction, compared with the projective one of the same points.
#[derive(Debug, Clone, Copy)]
pub(super) struct Comparison {
    /// Posterior noise of the metric over that of the projective one.
    pub ratio: f64,
    /// Of the projective one, normalised units.
    pub noise: f64,
    /// Loss of fit in standard deviations of the F statistic.
    deviations: f64,
    /// Root of the F statistic: by how much what self-calibration asks of the projective reconstruction is off, over what
    /// noise would explain.
    excess: f64,
}

impl Comparison {
    /// Of the fits of both.
    pub fn new(projective: &Fit, metric: &Fit) -> Self {
        Self {
            ratio: posterior_noise(metric.cost, metric.freedom) / projective.noise,
            noise: projective.noise,
            deviations: projective.loss_deviations(metric.cost, metric.freedom),
            excess: projective.statistic(metric.cost, metric.freedom).max(0.0).sqrt(),
        }
    }

    /// Of a calibration with the projective reconstruction, in coordinates of the undistorted image where it has a lens: no
    /// projective camera has one, and would fit worse for it.
    ///
    /// * `fit`: of the projective reconstruction of the points as they are
    pub fn of(best: &Candidate, fit: &Fit, choice: &Choice) -> Self {
        let lens = best.model.extensions().filter(|extension| extension.is_of_lens());
        let terms = lens.map(|extension| extension.parameters().len()).sum::<usize>();
        if terms == 0 {
            return Self::new(fit, &best.fit);
        }
        let observations = undistorted(&best.minimum.reconstruction, choice.problem.observations);
        let problem = &super::Problem { observations: &observations, ..*choice.problem };
        let options = Options::squared(ITERATIONS);

        let mut pinhole = best.minimum.reconstruction.clone();
        (pinhole.intrinsics.radial, pinhole.intrinsics.tangential) = ([0.0; 3], [0.0; 2]);
        let (mut cameras, mut points) =
            (pinhole.cameras(), pinhole.points.iter().map(|point| point.push(1.0)).collect::<Vec<Vector4<f64>>>());
        let report = projective::adjust(&mut cameras, &mut points, &observations, &options, choice.stop);
        let projective = Fit::projective(report.cost, problem, observed_points(problem), terms);

        let model = best.model.without_lens();
        let report = metric::adjust(&mut pinhole, &observations, model, &best.prior, &options, choice.stop);
        let believed = best.prior.cost(model, &pinhole.intrinsics);
        Self::new(&projective, &Fit::metric(report.cost - believed, best.model, problem))
    }

    /// Factor on the standard deviations of the calibration (Birge's ratio), 1 where chance explains the difference.
    ///
    /// A calibration rests on the few constraints that it puts on a projective reconstruction. Where these are violated
    /// by more than the noise, whatever the reason, it is as much less certain: four cameras that were taken for one were
    /// off by 3 to 17 % at a sigma of .5 %, with residuals hardly larger (2 to 20 %) and this ratio at 3 to 10.
    pub fn inflation(&self) -> f64 {
        if self.is_significant() { self.excess.max(1.0) } else { 1.0 }
    }

    /// Whether chance does not explain the difference.
    pub fn is_significant(&self) -> bool {
        self.deviations > MISFIT_DEVIATIONS
    }
}

/// The observations where pinholes would have made them; without those that the lens images nowhere.
fn undistorted(metric: &Reconstruction, observations: &[Observation]) -> Vec<Observation> {
    let of_pinhole = |seen: &Observation| {
        let xy = metric.intrinsics_of(seen.view).undistort(&seen.xy)?;
        Some(Observation { xy, ..*seen })
    };
    observations.iter().filter_map(of_pinhole).collect()
}
