//! Metric bundle adjustment of a camera that zooms: a focal length a view, else a pinhole with square pixels and the
//! principal point where it was guessed.

use std::ops::Range;

use nalgebra::{SVector, Vector3};

use super::engine::{Layout, Problem, Sink, Step, minimise};
use super::metric::{Intrinsics, POINT, POSE, Parameter, Pose, Projection, Reconstruction};
use super::reduced::{Linearisation, Reduced};
use super::whitened::{WhitenedViews, centre};
use super::{Loss, Observation, Options, Report};
use crate::domain::StopToken;
use crate::geometry::Camera;

/// Unknowns of a view: those of its pose, then the log focal length.
pub(super) const VIEW: usize = POSE + 1;
/// Share of a log focal length in a null direction from which it counts as undetermined.
const TAKES_PART: f64 = 1e-8;

/// A metric reconstruction with a focal length a view, up to a similarity.
#[derive(Debug, Clone, PartialEq)]
pub struct Zooming {
    /// In image sides.
    pub focals: Vec<f64>,
    pub poses: Vec<Pose>,
    pub points: Vec<Vector3<f64>>,
}

impl From<&Reconstruction> for Zooming {
    /// The same focal length in every view.
    fn from(constant: &Reconstruction) -> Self {
        Self {
            focals: vec![constant.intrinsics.focal; constant.poses.len()],
            poses: constant.poses.clone(),
            points: constant.points.clone(),
        }
    }
}

impl Problem<0, VIEW, POINT> for Zooming {
    fn camera_count(&self) -> usize {
        self.poses.len()
    }

    fn point_count(&self) -> usize {
        self.points.len()
    }

    fn observe(&self, observation: &Observation, sink: &mut impl Sink<0, VIEW, POINT>) {
        let intrinsics = Intrinsics::from_focal(self.focals[observation.camera]);
        let seen = Projection::new(&intrinsics, &self.poses[observation.camera], &self.points[observation.point]);
        sink.take(seen.image - observation.xy, || seen.gradients().jacobian(&[], Parameter::LogFocal));
    }

    fn retract(&mut self, from: &Self, step: &Step<0, VIEW, POINT>) {
        self.move_by(from, step);
    }
}

/// The same with the focal lengths as they are.
#[derive(Debug, Clone)]
struct Held(Zooming);

impl Problem<0, POSE, POINT> for Held {
    fn camera_count(&self) -> usize {
        self.0.camera_count()
    }

    fn point_count(&self) -> usize {
        self.0.point_count()
    }

    fn observe(&self, observation: &Observation, sink: &mut impl Sink<0, POSE, POINT>) {
        let Zooming { focals, poses, points } = &self.0;
        let intrinsics = Intrinsics::from_focal(focals[observation.camera]);
        let seen = Projection::new(&intrinsics, &poses[observation.camera], &points[observation.point]);
        sink.take(seen.image - observation.xy, || seen.gradients().jacobian(&[], Parameter::LogFocal));
    }

    fn retract(&mut self, from: &Self, step: &Step<0, POSE, POINT>) {
        self.0.move_all_but_focals(&from.0, step);
    }
}

impl Zooming {
    /// Minimises the reprojection error over focal lengths, poses and points.
    pub fn adjust(&mut self, observations: &[Observation], options: &Options, stop: &StopToken) -> Report {
        minimise(self, observations, options, stop)
    }

    /// Minimises it over poses and points alone.
    pub fn adjust_held(&mut self, observations: &[Observation], options: &Options, stop: &StopToken) -> Report {
        let mut held = Held(self.clone());
        let report = minimise(&mut held, observations, options, stop);
        *self = held.0;
        report
    }

    /// Overwrites `self` with `from` moved by `step`, of which the globals are another's.
    pub(super) fn move_by<const G: usize>(&mut self, from: &Self, step: &Step<G, VIEW, POINT>) {
        self.move_all_but_focals(from, step);
        for ((focal, from), step) in self.focals.iter_mut().zip(&from.focals).zip(&step.cameras) {
            *focal = from * step[POSE].exp();
        }
    }

    /// Moves poses, the first unknowns of a view, and points.
    fn move_all_but_focals<const G: usize, const C: usize>(&mut self, from: &Self, step: &Step<G, C, POINT>) {
        for ((pose, from), step) in self.poses.iter_mut().zip(&from.poses).zip(&step.cameras) {
            *pose = from.moved(std::array::from_fn(|k| step[k]));
        }
        for ((point, from), step) in self.points.iter_mut().zip(&from.points).zip(&step.points) {
            *point = from + step;
        }
    }

    /// Mean of the natural logarithms of the focal lengths.
    pub fn mean_log_focal(&self) -> f64 {
        self.focals.iter().map(|focal| focal.ln()).sum::<f64>() / self.focals.len().max(1) as f64
    }

    /// The cameras `K [R|t]`.
    pub fn cameras(&self) -> Vec<Camera> {
        self.poses.iter().zip(&self.focals).map(|(pose, focal)| pose.camera(&Intrinsics::from_focal(*focal))).collect()
    }

    /// With one focal length for all views, their geometric mean: for what only asks for poses and points.
    pub fn at_mean_focal(&self) -> Reconstruction {
        Reconstruction {
            intrinsics: Intrinsics::from_focal(self.mean_log_focal().exp()),
            poses: self.poses.clone(),
            points: self.points.clone(),
        }
    }

    /// Variances of the log focal lengths, everything else marginalised, for observations with unit variance: multiply
    /// by the squared noise. `None` for a view whose focal length the observations do not determine.
    pub fn log_focal_variances(&self, observations: &[Observation]) -> Vec<Option<f64>> {
        let information = self.information(observations);
        let variance = |view: usize| information.as_ref()?.variance(view..view + 1);
        (0..self.focals.len()).map(variance).collect()
    }

    /// The same of the mean of the log focal lengths.
    pub fn mean_log_focal_variance(&self, observations: &[Observation]) -> Option<f64> {
        self.information(observations)?.variance(0..self.focals.len())
    }

    fn information(&self, observations: &[Observation]) -> Option<Information> {
        let views = self.poses.len();
        let layout = Layout::new(observations, views, self.points.len());
        let mut linearisation = Linearisation::<0, VIEW, POINT>::new(&layout, views);
        let mut centred = self.clone();
        centre(&mut centred.poses, &mut centred.points);
        linearisation.fill(&centred, &layout, Loss::Squared);
        let mut reduced = Reduced::new(&layout, views);
        if !reduced.build(&centred, &layout, &linearisation, 0.0) {
            return None;
        }
        WhitenedViews::new(&reduced.matrix, 0, &centred.poses).map(Information)
    }
}

/// What observations say of the views, points marginalised.
struct Information(WhitenedViews<VIEW>);

impl Information {
    /// Variance of the mean log focal length of these views; `None` where it is not determined.
    fn variance(&self, views: Range<usize>) -> Option<f64> {
        let Self(information) = self;
        if views.clone().any(|view| information.unseen(view, POSE) > TAKES_PART) {
            return None;
        }
        let count = views.len().max(1) as f64;
        let mean = information.function(|view| {
            let mut gradient = SVector::zeros();
            gradient[POSE] = if views.contains(&view) { count.recip() } else { 0.0 };
            gradient
        });
        let mut sum = 0.0;
        for (value, direction) in information.directions() {
            let along = mean.dot(&direction).powi(2);
            match value {
                Some(value) => sum += along / value,
                None if along > TAKES_PART * mean.norm_squared() => return None,
                None => {}
            }
        }
        (sum > 0.0).then_some(sum)
    }
}

#[cfg(test)]
mod tests {
    use super::super::metric::Information as MetricInformation;
    use super::super::metric::{IntrinsicsModel, IntrinsicsPrior, Parameter};
    use super::super::testing::{self, Motion, NOISE};
    use super::*;

    fn truth(scene: &testing::TestScene) -> Reconstruction {
        Reconstruction { intrinsics: scene.intrinsics, poses: scene.poses.clone(), points: scene.points.clone() }
    }

    #[test]
    fn jacobian_agrees_with_finite_differences() {
        let scene = testing::scene(1, 4, 8, NOISE);
        let mut zooming = Zooming::from(&truth(&scene));
        zooming.focals = vec![0.9, 1.0, 1.2, 1.5];
        testing::check_jacobian(&zooming, &scene.observations);
        testing::check_jacobian(&Held(zooming), &scene.observations);
    }

    #[test]
    fn a_focal_length_a_view_is_less_certain_than_one_for_all() {
        for seed in 0..3 {
            let scene = testing::scene(seed, 10, 40, 0.0);
            let constant = MetricInformation::new(&truth(&scene), &scene.observations)
                .map(|information| information.optimum(IntrinsicsModel::FOCAL, &IntrinsicsPrior::NONE))
                .and_then(|optimum| optimum.variance_of(Parameter::LogFocal))
                .expect("observable");
            let zooming = Zooming::from(&truth(&scene));
            let variances = zooming.log_focal_variances(&scene.observations);
            println!("seed {seed}: {constant:.3} for all, {variances:.2?}");
            assert_eq!(variances.len(), 10);
            for variance in &variances {
                assert!(variance.expect("observable") > constant, "seed {seed}");
            }
            // Focal lengths that share a frame of points err together: their mean is no surer than one for all would be,
            // nor less sure than each.
            let mean = zooming.mean_log_focal_variance(&scene.observations).expect("observable");
            let largest = variances.iter().flatten().fold(0.0f64, |largest, variance| largest.max(*variance));
            assert!((constant..largest).contains(&mean), "seed {seed}: {mean:.3}");
        }
        // Wherever the origin is.
        let scene = testing::scene(1, 10, 40, 0.0);
        let expected = Zooming::from(&truth(&scene)).log_focal_variances(&scene.observations);
        for distance in [1e2, 1e4, 1e6] {
            let by = Vector3::new(1.0, -0.5, 0.3) * distance;
            let mut far = truth(&scene);
            far.points.iter_mut().for_each(|point| *point += by);
            far.poses.iter_mut().for_each(|pose| pose.translation -= pose.rotation * by);
            let found = Zooming::from(&far).log_focal_variances(&scene.observations);
            println!("{distance:e} away: {found:.3?} for {expected:.3?}");
            for (found, expected) in found.iter().zip(&expected) {
                let (found, expected) = (found.expect("observable"), expected.expect("observable"));
                assert!((found - expected).abs() < 0.01 * expected, "{distance:e} away: {found} for {expected}");
            }
        }
        let scene = testing::scene_of(1, 10, 40, 0.0, Motion::Translation, false);
        let variances = Zooming::from(&truth(&scene)).log_focal_variances(&scene.observations);
        // Null but for rounding: a sigma of several e-folds.
        let free = |variance: &Option<f64>| variance.is_none_or(|variance| variance.sqrt() * NOISE > 1.0);
        assert!(variances.iter().all(free), "{variances:?}");
        assert!(free(&Zooming::from(&truth(&scene)).mean_log_focal_variance(&scene.observations)));
    }
}
