//! Metric bundle adjustment of a camera that zooms: a focal length a view, else a pinhole with square pixels and the
//! principal point where it was guessed.

use std::ops::Range;

use faer::{MatRef, Side};
use nalgebra::{DMatrix, Vector3};

use super::covariance::NULL_POSE;
use super::engine::{Layout, Problem, Sink, Step, minimise};
use super::metric::{Intrinsics, POINT, POSE, Parameter, Pose, Projection, Reconstruction};
use super::reduced::{Linearisation, Reduced};
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
        let n = VIEW * views;
        let layout = Layout::new(observations, views, self.points.len());
        let mut linearisation = Linearisation::<0, VIEW, POINT>::new(&layout, views);
        linearisation.fill(self, &layout, Loss::Squared);
        let mut reduced = Reduced::new(&layout, views);
        if n == 0 || !reduced.build(self, &layout, &linearisation, 0.0) {
            return None;
        }
        let full = DMatrix::from_column_slice(n, n, &reduced.matrix);
        // Unit diagonal, so that rotations, translations and focal lengths are compared alike.
        let scale: Vec<f64> = (0..n).map(|k| full[(k, k)].max(f64::MIN_POSITIVE).sqrt().recip()).collect();
        let scaled =
            DMatrix::from_fn(n, n, |row, column| full[(row.max(column), row.min(column))] * scale[row] * scale[column]);
        if scaled.iter().any(|value| !value.is_finite()) {
            return None;
        }
        let eigen = MatRef::from_column_major_slice(scaled.as_slice(), n, n).self_adjoint_eigen(Side::Lower).ok()?;
        let values = (0..n).map(|k| eigen.S()[k]).collect();
        Some(Information { scale, values, vectors: DMatrix::from_fn(n, n, |row, k| eigen.U()[(row, k)]) })
    }
}

/// What observations say of the views, points marginalised: the eigenvalues of the reduced normal equations, ascending,
/// and their vectors, both after unknown `k` was multiplied by the inverse of `scale[k]`.
struct Information {
    scale: Vec<f64>,
    values: Vec<f64>,
    vectors: DMatrix<f64>,
}

impl Information {
    /// Variance of the mean log focal length of these views; `None` where it is not determined.
    fn variance(&self, views: Range<usize>) -> Option<f64> {
        let count = views.len().max(1) as f64;
        let rows: Vec<(usize, f64)> =
            views.map(|view| VIEW * view + VIEW - 1).map(|row| (row, self.scale[row] / count)).collect();
        let norm_squared: f64 = rows.iter().map(|(_, factor)| factor * factor).sum();
        let largest = self.values.last()?;
        let mut sum = 0.0;
        // Null directions are those of the similarity, which no focal length takes part in, and of views that see too
        // little.
        for (k, value) in self.values.iter().enumerate() {
            let along: f64 = rows.iter().map(|&(row, factor)| factor * self.vectors[(row, k)]).sum();
            if *value > NULL_POSE * largest {
                sum += along * along / value;
            } else if along * along > TAKES_PART * norm_squared {
                return None;
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
        let scene = testing::scene_of(1, 10, 40, 0.0, Motion::Translation, false);
        let variances = Zooming::from(&truth(&scene)).log_focal_variances(&scene.observations);
        // Null but for rounding: a sigma of several e-folds.
        let free = |variance: &Option<f64>| variance.is_none_or(|variance| variance.sqrt() * NOISE > 1.0);
        assert!(variances.iter().all(free), "{variances:?}");
        assert!(free(&Zooming::from(&truth(&scene)).mean_log_focal_variance(&scene.observations)));
    }
}
