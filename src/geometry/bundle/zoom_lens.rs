//! Metric bundle adjustment of a camera that zooms behind a lens that its views share: the principal point and the
//! first radial coefficient are free.
//!
//! It tells what a lens that is not as [`Zooming`] takes it moves, and whether focal lengths that were taken to be one
//! are.

use super::engine::{Belief, Problem, Sink, Step, minimise};
use super::metric::{Intrinsics, IntrinsicsPrior, POINT, Parameter, Projection, Reconstruction};
use super::zoom::{VIEW, Zooming};
use super::{Observation, Options, Report};
use crate::domain::StopToken;

/// What is free beside a focal length, a pose a view.
const SHARED: [Parameter; SHARED_COUNT] = [Parameter::PrincipalX, Parameter::PrincipalY, Parameter::Radial];
/// Their number.
pub const SHARED_COUNT: usize = 3;

/// A metric reconstruction with a focal length a view behind one lens, up to a similarity.
#[derive(Debug, Clone)]
pub struct LensZooming {
    pub zooming: Zooming,
    /// That of all views but for the focal length.
    pub lens: Intrinsics,
    prior: IntrinsicsPrior,
}

impl LensZooming {
    /// Behind the lens that [`Zooming`] takes for granted.
    pub fn pinhole(zooming: Zooming, prior: &IntrinsicsPrior) -> Self {
        Self { zooming, lens: Intrinsics::from_focal(1.0), prior: *prior }
    }

    /// With the same calibration in every view.
    pub fn constant(reconstruction: &Reconstruction, prior: &IntrinsicsPrior) -> Self {
        Self { zooming: Zooming::from(reconstruction), lens: reconstruction.intrinsics, prior: *prior }
    }

    /// Minimises the reprojection error, and what `prior` believes of the lens, over focal lengths, poses, points, the
    /// principal point and `k1`. The cost contains what the prior adds.
    pub fn adjust(&mut self, observations: &[Observation], options: &Options, stop: &StopToken) -> Report {
        minimise(self, observations, options, stop)
    }

    fn intrinsics(&self, view: usize) -> Intrinsics {
        Intrinsics { focal: self.zooming.focals[view], ..self.lens }
    }
}

impl Problem<SHARED_COUNT, VIEW, POINT> for LensZooming {
    fn camera_count(&self) -> usize {
        self.zooming.poses.len()
    }

    fn point_count(&self) -> usize {
        self.zooming.points.len()
    }

    fn observe(&self, observation: &Observation, sink: &mut impl Sink<SHARED_COUNT, VIEW, POINT>) {
        let Zooming { poses, points, .. } = &self.zooming;
        let intrinsics = self.intrinsics(observation.camera);
        let seen = Projection::new(&intrinsics, &poses[observation.camera], &points[observation.point]);
        sink.take(seen.image - observation.xy, || seen.gradients().jacobian(&SHARED, Parameter::LogFocal));
    }

    fn retract(&mut self, from: &Self, step: &Step<SHARED_COUNT, VIEW, POINT>) {
        self.lens = from.lens;
        for (parameter, by) in SHARED.iter().zip(step.globals.iter()) {
            self.lens.shift(*parameter, *by);
        }
        self.zooming.move_by(&from.zooming, step);
    }

    fn global_beliefs(&self) -> [Belief; SHARED_COUNT] {
        SHARED.map(|parameter| Belief {
            information: self.prior.information[parameter as usize],
            deviation: self.prior.deviation(parameter, &self.lens),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{self, NOISE};
    use super::*;

    #[test]
    fn jacobian_agrees_with_finite_differences() {
        let scene = testing::scene(1, 4, 8, NOISE);
        let truth =
            Reconstruction { intrinsics: scene.intrinsics, poses: scene.poses.clone(), points: scene.points.clone() };
        let mut zooming = LensZooming::constant(&truth, &IntrinsicsPrior::NONE);
        zooming.zooming.focals = vec![0.9, 1.0, 1.2, 1.5];
        zooming.lens.radial = -0.2;
        zooming.lens.second_radial = 0.1;
        zooming.lens.aspect = 1.1;
        zooming.lens.principal_point = nalgebra::Vector2::new(0.02, -0.03);
        testing::check_jacobian(&zooming, &scene.observations);
    }
}
