//! Metric bundle adjustment: intrinsics that the views share, but for focal lengths of their own where they have these,
//! rotations, translations and Euclidean points.

use nalgebra::{Matrix3, Matrix3x4, Rotation3, Vector2, Vector3};

use super::Observation;
pub use super::covariance::{Information, Optimum};
pub use super::intrinsics::{Intrinsics, Parameter};
pub use super::intrinsics_model::{Extension, IntrinsicsModel, IntrinsicsPrior};

/// Unknowns of a pose (rotation vector, then translation), of a view with a focal length of its own, whose logarithm
/// comes after its pose, and of a point.
pub(super) const POSE: usize = 6;
pub(super) const VIEW: usize = POSE + 1;
pub(super) const POINT: usize = 3;

/// World to camera: `x = R X + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Pose {
    /// A world point in camera coordinates.
    #[inline(always)]
    pub fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    /// Turned about the camera's own centre and moved, `x -> dR x + dt` in camera coordinates, by a rotation vector and
    /// a translation. About the origin of the world, a camera far from it could turn only against the damping of its
    /// lever.
    #[inline]
    pub(crate) fn moved(&self, [a, b, c, x, y, z]: [f64; POSE]) -> Self {
        let turn = Rotation3::from_scaled_axis(Vector3::new(a, b, c));
        Self { rotation: turn * self.rotation, translation: turn * self.translation + Vector3::new(x, y, z) }
    }

    /// The rotation row by row.
    pub fn rotation_rows(&self) -> [[f64; 3]; 3] {
        // Arrays of a matrix are its columns.
        self.rotation.transpose().into()
    }

    /// The camera matrix `K [R|t]`.
    pub fn camera(&self, intrinsics: &Intrinsics) -> Matrix3x4<f64> {
        let mut camera = Matrix3x4::zeros();
        camera.fixed_columns_mut::<3>(0).copy_from(&self.rotation);
        camera.set_column(3, &self.translation);
        intrinsics.matrix() * camera
    }
}

/// A point as a view sees it, `K [R|t] X` behind a lens.
pub(crate) struct Projection<'a> {
    intrinsics: &'a Intrinsics,
    pose: &'a Pose,
    /// In camera coordinates.
    pub at: Vector3<f64>,
    /// Infinite or not a number at depth zero.
    pub image: Vector2<f64>,
}

pub(crate) struct ProjectionGradients {
    /// By the intrinsics, in the order of [`Parameter`].
    pub by_parameter: [[f64; Parameter::COUNT]; 2],
    /// As [`Pose::moved`] moves the pose.
    pub by_pose: [[f64; POSE]; 2],
    pub by_point: [Vector3<f64>; 2],
}

impl<'a> Projection<'a> {
    #[inline(always)]
    pub fn new(intrinsics: &'a Intrinsics, pose: &'a Pose, point: &Vector3<f64>) -> Self {
        let at = pose.apply(point);
        Self { intrinsics, pose, at, image: intrinsics.project(&at) }
    }

    #[inline(always)]
    pub fn gradients(&self) -> ProjectionGradients {
        let (by_parameter, by_seen) = self.intrinsics.gradients(&self.at);
        // Not by `map`, which is not inlined here.
        let by_pose = std::array::from_fn(|component| {
            let by_seen: &Vector3<f64> = &by_seen[component];
            let turn = self.at.cross(by_seen);
            [turn.x, turn.y, turn.z, by_seen.x, by_seen.y, by_seen.z]
        });
        ProjectionGradients {
            by_parameter,
            by_pose,
            by_point: std::array::from_fn(|component| self.pose.rotation.tr_mul(&by_seen[component])),
        }
    }
}

/// A metric reconstruction, up to a similarity.
#[derive(Debug, Clone, PartialEq)]
pub struct MetricReconstruction {
    /// One a camera group, whose views share it; where they have focal lengths of their own, with the geometric mean of
    /// these.
    pub intrinsics: Vec<Intrinsics>,
    /// Camera group of each view.
    pub group_of: Vec<usize>,
    /// The focal length of each view; empty where views have that of their group.
    pub focals: Vec<f64>,
    pub poses: Vec<Pose>,
    pub points: Vec<Vector3<f64>>,
    /// Whether the camera only turned: all poses are at the origin of the world and stay there, and points are
    /// directions, of which no observation tells the length.
    pub has_common_centre: bool,
}

impl MetricReconstruction {
    /// With one calibration for all views.
    pub fn new(intrinsics: Intrinsics, poses: Vec<Pose>, points: Vec<Vector3<f64>>) -> Self {
        Self {
            intrinsics: vec![intrinsics],
            group_of: vec![0; poses.len()],
            focals: Vec::new(),
            poses,
            points,
            has_common_centre: false,
        }
    }

    /// The same with a focal length of each view, that of its group unless it has these already.
    pub fn with_own_focals(mut self) -> Self {
        if self.focals.is_empty() {
            self.focals = (0..self.poses.len()).map(|view| self.intrinsics_of(view).focal).collect();
        }
        self
    }

    /// The same of camera groups, each with the geometric mean of its views' focal lengths.
    ///
    /// * `group_of`: the group of each view
    pub fn in_groups(mut self, group_of: &[usize], groups: usize) -> Self {
        self = self.with_own_focals();
        self.intrinsics = vec![self.intrinsics[0]; groups];
        self.group_of = group_of.to_vec();
        self.average_focals();
        self.focals.clear();
        self
    }

    /// Unknowns of a view's pose and of a point.
    pub fn unknowns_each(has_common_centre: bool) -> (usize, usize) {
        if has_common_centre { (3, 2) } else { (6, 3) }
    }

    /// Unknowns that observations of so many points could determine, the gauge taken off.
    ///
    /// * `shared`: free intrinsics of all camera groups together
    pub fn unknowns(&self, points: usize, shared: usize) -> usize {
        let (of_view, of_point) = Self::unknowns_each(self.has_common_centre);
        let gauge = if self.has_common_centre { 3 } else { 7 };
        (of_view * self.poses.len() + of_point * points + self.focals.len() + shared).saturating_sub(gauge)
    }

    pub fn has_own_focals(&self) -> bool {
        !self.focals.is_empty()
    }

    /// The simplest model that all lenses are of: with the extensions that any of them has.
    pub fn model(&self) -> IntrinsicsModel {
        let has = |extension: &Extension| {
            let is_free =
                |lens: &Intrinsics| extension.parameters().iter().any(|parameter| lens.value(*parameter) != 0.0);
            self.intrinsics.iter().any(is_free)
        };
        let simplest = IntrinsicsModel::focal(self.has_own_focals());
        Extension::ALL.into_iter().filter(has).fold(simplest, IntrinsicsModel::with)
    }

    /// The same with lenses of this model, still to be adjusted: what it does not free is as in the simplest lens.
    pub fn of_model(mut self, model: IntrinsicsModel) -> Self {
        for lens in &mut self.intrinsics {
            let before = std::mem::replace(lens, lens.simplest());
            for parameter in model.extensions().flat_map(Extension::parameters) {
                lens.shift(*parameter, before.value(*parameter));
            }
        }
        self
    }

    /// Intrinsics of a view.
    ///
    /// # Panics
    /// When the view or its group is out of range.
    #[inline(always)]
    pub fn intrinsics_of(&self, view: usize) -> Intrinsics {
        let shared = self.intrinsics[self.group_of[view]];
        match self.focals.get(view) {
            Some(&focal) => Intrinsics { focal, ..shared },
            None => shared,
        }
    }

    pub fn scale_focals(&mut self, factor: f64) {
        self.intrinsics.iter_mut().for_each(|intrinsics| intrinsics.focal *= factor);
        self.focals.iter_mut().for_each(|focal| *focal *= factor);
    }

    /// The same with other focal lengths, still to be adjusted; what lenses distort in the image stays, to first order.
    pub fn with_scaled_focals(mut self, factor: f64) -> Self {
        self.scale_focals(factor);
        for lens in &mut self.intrinsics {
            lens.tangential = lens.tangential.map(|term| term * factor);
            lens.radial = std::array::from_fn(|k| lens.radial[k] * factor.powi(2 * (k as i32 + 1)));
        }
        self
    }

    /// Takes the geometric mean of the views' own focal lengths as that of their group.
    pub fn average_focals(&mut self) {
        for (group, intrinsics) in self.intrinsics.iter_mut().enumerate() {
            let of_group = self.focals.iter().zip(&self.group_of).filter(|(_, of)| **of == group);
            let logs: Vec<f64> = of_group.map(|(focal, _)| focal.ln()).collect();
            if !logs.is_empty() {
                intrinsics.focal = (logs.iter().sum::<f64>() / logs.len() as f64).exp();
            }
        }
    }

    /// Logarithm of the focal length, the mean over the camera groups.
    pub fn log_focal(&self) -> f64 {
        let logs = self.intrinsics.iter().map(|intrinsics| intrinsics.focal.ln());
        logs.sum::<f64>() / self.intrinsics.len() as f64
    }

    /// The cameras `K [R|t]`.
    pub fn cameras(&self) -> Vec<Matrix3x4<f64>> {
        self.poses.iter().enumerate().map(|(view, pose)| pose.camera(&self.intrinsics_of(view))).collect()
    }

    /// Predicted minus observed image point, unweighted; infinite or not a number at depth zero.
    ///
    /// # Panics
    /// When the observation's indices are out of range.
    pub fn residual(&self, seen: &Observation) -> Vector2<f64> {
        self.intrinsics_of(seen.view).project(&self.poses[seen.view].apply(&self.points[seen.point])) - seen.xy
    }

    /// The squared [`residual`](Self::residual) by the observation's weight.
    pub fn weighted_squared(&self, seen: &Observation) -> f64 {
        seen.weight * self.residual(seen).norm_squared()
    }
}

#[cfg(test)]
mod tests {
    use super::super::Options;
    use super::super::sequence::adjust_all;
    use super::super::testing::{self, NOISE};
    use super::*;
    use crate::domain::StopToken;

    #[test]
    fn lenses_are_of_the_model_of_their_extensions() {
        let mut reconstruction = testing::scene(1, 4, 10, 0.0).reconstruction();
        assert_eq!(reconstruction.model(), IntrinsicsModel::FOCAL);
        let lens = &mut reconstruction.intrinsics[0];
        (lens.aspect, lens.radial, lens.principal_point) = (1.03, [-0.2, 0.1, 0.0], Vector2::new(0.01, 0.0));
        let model = reconstruction.model();
        let expected = [Extension::PrincipalPoint, Extension::Aspect, Extension::RadialK1, Extension::RadialK2];
        assert_eq!(model.extensions().collect::<Vec<_>>(), expected);
        assert!(reconstruction.clone().with_own_focals().model().is_per_view());
        let simpler = model.without(Extension::Aspect).without(Extension::RadialK2);
        let found = reconstruction.clone().of_model(simpler);
        assert_eq!(found.model(), simpler);
        let [lens, before] = [&found, &reconstruction].map(|of| of.intrinsics[0]);
        assert_eq!((lens.aspect, lens.radial), (1.0, [-0.2, 0.0, 0.0]));
        assert_eq!((lens.focal, lens.principal_point), (before.focal, before.principal_point));
    }

    #[test]
    fn a_distorted_image_hardly_depends_on_the_focal_length() {
        let mut reconstruction = testing::scene(1, 4, 10, 0.0).reconstruction();
        let lens = &mut reconstruction.intrinsics[0];
        (lens.radial, lens.tangential) = ([-0.2, 0.1, 0.05], [0.004, -0.003]);
        for factor in [0.5, 2.0] {
            let scaled = reconstruction.clone().with_scaled_focals(factor);
            let [lens, before] = [&scaled, &reconstruction].map(|of| of.intrinsics[0]);
            assert_eq!(lens.focal, factor * before.focal);
            let direction = Vector3::new(0.3, -0.2, 1.0);
            let other = Vector3::new(0.3 / factor, -0.2 / factor, 1.0);
            assert!((lens.project(&other) - before.project(&direction)).norm() < 1e-12);
        }
    }

    #[test]
    fn converges_from_a_perturbed_start_to_the_noise_floor() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 8, 30, NOISE);
            let mut start = testing::perturbed(&scene.reconstruction(), 0.02, seed);
            let report = adjust_all(
                &mut start,
                &scene.observations,
                IntrinsicsModel::FOCAL,
                &[IntrinsicsPrior::NONE],
                &Options { max_iterations: 60, ..Options::DEFAULT },
                &StopToken::default(),
            );
            let freedom = 2 * scene.observations.len() - (6 * 8 + 3 * 30 - 7 + 1);
            let ratio = report.cost / (freedom as f64 * NOISE * NOISE);
            let focal_error = start.intrinsics[0].focal / scene.intrinsics.focal - 1.0;
            println!("seed {seed}: {report:?}, chi2 per degree of freedom {ratio:.3}, focal off by {focal_error:.4}");
            assert!((0.7..1.3).contains(&ratio), "seed {seed}: {ratio}");
            assert!(focal_error.abs() < 0.03, "seed {seed}: {focal_error}");
            let orthogonal = start
                .poses
                .iter()
                .all(|pose| (pose.rotation * pose.rotation.transpose() - Matrix3::identity()).norm() < 1e-10);
            assert!(orthogonal);
        }
    }

    /// No observation tells how long a direction is, and of one on the optical axis hardly anything does by its depth.
    #[test]
    fn directions_keep_their_length() {
        for seed in 0..10 {
            let mut scene = testing::scene_of(seed, 5, 40, 0.0, testing::Motion::Rotation, false);
            scene.observe(NOISE, &mut rand::SeedableRng::seed_from_u64(seed));
            let mut start = scene.reconstruction();
            let centre = start.poses[0].rotation.tr_mul(&-start.poses[0].translation);
            start.points.iter_mut().for_each(|point| *point = (*point - centre).normalize());
            start.poses.iter_mut().for_each(|pose| pose.translation = Vector3::zeros());
            start.has_common_centre = true;
            let axis = start.poses[0].rotation.tr_mul(&Vector3::z());
            start.points.push(axis);
            let mut observations = scene.observations.clone();
            for view in 0..3 {
                let seen = Observation::new(view, start.points.len() - 1, Vector2::zeros());
                observations.push(Observation { xy: start.residual(&seen), ..seen });
            }
            let options = Options { max_iterations: 60, relative_tolerance: 1e-12, ..Options::DEFAULT };
            let (model, priors) = (IntrinsicsModel::FOCAL, [IntrinsicsPrior::NONE]);
            adjust_all(&mut start, &observations, model, &priors, &options, &StopToken::default());
            for (k, point) in start.points.iter().enumerate() {
                assert!((point.norm() - 1.0).abs() < 0.05, "seed {seed}, point {k}: {point}");
            }
            assert!(start.poses.iter().all(|pose| pose.translation == Vector3::zeros()), "seed {seed}");
        }
    }

    #[test]
    fn a_prior_moves_its_parameter_by_what_it_is_worth() {
        let scene = testing::scene(4, 6, 20, NOISE);
        let adjusted = |prior: &IntrinsicsPrior| {
            let mut start = scene.reconstruction();
            let options = Options { max_iterations: 60, relative_tolerance: 1e-12, ..Options::DEFAULT };
            let report = adjust_all(
                &mut start,
                &scene.observations,
                IntrinsicsModel::FOCAL,
                std::slice::from_ref(prior),
                &options,
                &StopToken::default(),
            );
            (start.intrinsics[0].focal.ln(), report.cost)
        };
        let (free, cost) = adjusted(&IntrinsicsPrior::NONE);
        let mut reconstruction = scene.reconstruction();
        reconstruction.intrinsics[0].focal = free.exp();
        let information = Information::new(&reconstruction, &scene.observations).expect("poses");
        let optimum = information.optimum(IntrinsicsModel::FOCAL, &[IntrinsicsPrior::NONE]);
        let variance = optimum.variance_of(0, Parameter::LogFocal).expect("observable");
        let sigma = variance.sqrt() * NOISE;
        // As well known as the data say, one sigma away: it moves the estimate half the way, and costs half a
        // chi-square.
        let prior = IntrinsicsPrior::NONE.knowing(Parameter::LogFocal, free + sigma, sigma, NOISE);
        let (pulled, dearer) = adjusted(&prior);
        let (way, rise) = ((pulled - free) / sigma, (dearer - cost) / (NOISE * NOISE));
        println!("way {way}, rise {rise}");
        assert!((way - 0.5).abs() < 0.05 && (rise - 0.5).abs() < 0.05, "way {way}, rise {rise}");
    }

    #[test]
    fn fixed_intrinsics_stay_fixed() {
        let scene = testing::scene(2, 4, 12, NOISE);
        let mut start = testing::perturbed(&scene.reconstruction(), 0.01, 2);
        let before = start.intrinsics.clone();
        let options = Options::DEFAULT;
        let (model, prior) = (IntrinsicsModel::FIXED, IntrinsicsPrior::NONE);
        let report = adjust_all(&mut start, &scene.observations, model, &[prior], &options, &StopToken::default());
        assert!(report.iterations > 0);
        assert_eq!(start.intrinsics, before);
    }

    #[test]
    fn degenerate_input_neither_panics_nor_yields_nan() {
        let scene = testing::scene(3, 4, 8, NOISE);
        let run = |mut start: MetricReconstruction, observations: &[Observation]| {
            let options = Options::DEFAULT;
            for model in [IntrinsicsModel::FIXED, IntrinsicsModel::FOCAL, IntrinsicsModel::FULL] {
                let prior = IntrinsicsPrior::NONE;
                let report = adjust_all(&mut start, observations, model, &[prior], &options, &StopToken::default());
                assert!(report.cost.is_finite() && report.cost <= report.initial_cost, "{report:?}");
                if let Some(information) = Information::new(&start, observations) {
                    information.optimum(model, &[prior]);
                }
            }
            start
        };
        run(MetricReconstruction::new(scene.intrinsics, vec![], vec![]), &scene.observations);
        run(scene.reconstruction(), &[]);
        let mut odd = scene.reconstruction();
        // Depth zero, far away, and a camera that sees a single point.
        odd.points[0] = odd.poses[0].rotation.tr_mul(&-odd.poses[0].translation);
        odd.points[1] *= 1e9;
        let few: Vec<_> = scene.observations.iter().filter(|seen| seen.view != 2 || seen.point == 3).copied().collect();
        let odd = run(odd, &few);
        assert!(odd.intrinsics[0].focal.is_finite() && odd.points.iter().all(|point| point.norm().is_finite()));
        let mut broken = scene.reconstruction();
        broken.poses[1].translation.fill(f64::NAN);
        run(broken, &scene.observations);
    }
}
