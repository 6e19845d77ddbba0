//! The best that anyone can do: the Cramer-Rao bound of the focal lengths, at the truth.

use nalgebra::{DMatrix, DVector, Matrix3, Vector2, Vector3};

use crate::domain::LensProjection;
use crate::geometry::bundle::metric::{
    Extension, Intrinsics, IntrinsicsModel, MetricReconstruction, Parameter, Pose, Projection,
};
use crate::geometry::observation::Observation;
use crate::solver::calibration::CalibrationOptions;
use crate::synthetic::photographed::{FocalKind, IMAGE_SIZE, LensKind, PhotographedMotion, effective_noise};
use crate::synthetic::scene::IMAGE_SIDE_PX;
use crate::synthetic::{Photographed, Scene};

/// Information on every unknown, as a share of what the observations say of it were all else known: it holds the frame.
/// What is weakest of real scenes, the bending of long walks, has a hundred times that.
const HELD: f64 = 1e-11;

/// What is known of the geometry beforehand: a bound is that of the smallest model that holds the truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Geometry {
    General,
    /// The camera's centre is the origin in all views: points have directions only.
    Rotation,
    /// All points are on the plane `z = 0`.
    Plane,
}

impl Geometry {
    /// Unknowns of a pose, the rotation first.
    fn pose(self) -> usize {
        if self == Geometry::Rotation { 3 } else { 6 }
    }

    /// The directions in which a point may move.
    fn of_point(self, point: &Vector3<f64>) -> Vec<Vector3<f64>> {
        match self {
            Geometry::General => vec![Vector3::x(), Vector3::y(), Vector3::z()],
            Geometry::Plane => vec![Vector3::x(), Vector3::y()],
            Geometry::Rotation => {
                let mut axis = Vector3::zeros();
                axis[point.iamin()] = 1.0;
                let across = point.cross(&axis).normalize() * point.norm();
                vec![across, point.normalize().cross(&across)]
            }
        }
    }
}

/// The bound of a scene whose views each have a camera of their own: focal lengths, principal points, k1, poses and
/// points unknown, the priors of the intrinsics the solver's. `None`: unobservable.
pub fn of_scene(scene: &Scene) -> Option<Vec<f64>> {
    let (truth, side_px) = (&scene.truth, f64::from(IMAGE_SIDE_PX));
    let views = truth.rotations.len();
    let centre_px = (side_px - 1.0) / 2.0;
    let intrinsics = |view: usize| Intrinsics {
        principal_point: (Vector2::from(truth.principal_points_px[view]).add_scalar(-centre_px)) / side_px,
        radial: [truth.radial_k1[view], 0.0, 0.0],
        ..Intrinsics::from_focal(truth.focals_px[view] / side_px)
    };
    let reconstruction = MetricReconstruction {
        intrinsics: (0..views).map(intrinsics).collect(),
        group_of: (0..views).collect(),
        focals: Vec::new(),
        poses: poses(&truth.rotations, &truth.translations),
        points: truth.points.iter().map(|point| Vector3::from(*point)).collect(),
        has_common_centre: false,
    };
    let right = |k: &usize| truth.observation_right[*k] && truth.inlier[scene.input.track[*k] as usize];
    let observations: Vec<Observation> = (0..scene.input.x.len())
        .filter(right)
        .map(|k| observation(scene.input.view[k], scene.input.track[k]))
        .collect();
    let model = IntrinsicsModel::FOCAL.with(Extension::PrincipalPoint).with(Extension::RadialK1);
    sigmas(&reconstruction, &observations, model, scene.options.noise, Geometry::General)
}

/// The bound of a photographed scene from the verifiable observations, under the smallest model of intrinsics and
/// geometry that holds the truth, with the solver's priors. `None`: unobservable.
pub fn of_photographed(scene: &Photographed) -> Option<Vec<f64>> {
    let (truth, options) = (&scene.truth, &scene.options);
    let model = smallest_model(scene);
    let scale_px = f64::from(IMAGE_SIZE.width_px.max(IMAGE_SIZE.height_px));
    let groups = 1 + truth.camera_groups.iter().copied().max().unwrap_or(0);
    let intrinsics = |group: u32| {
        let of_group = truth.camera_groups.iter().zip(&truth.focals_px).filter(|(of, _)| **of == group);
        let logs: Vec<f64> = of_group.map(|(_, focal_px)| (focal_px / scale_px).ln()).collect();
        Intrinsics {
            principal_point: Vector2::from(
                options.principal_point.map(|shift| shift * f64::from(IMAGE_SIZE.width_px) / scale_px),
            ),
            aspect: options.aspect,
            projection: match options.lens {
                LensKind::Fisheye => LensProjection::Fisheye,
                _ => LensProjection::Perspective,
            },
            radial: [options.radial[0], options.radial[1], 0.0],
            ..Intrinsics::from_focal((logs.iter().sum::<f64>() / logs.len() as f64).exp())
        }
    };
    let own_focals = || truth.focals_px.iter().map(|focal_px| focal_px / scale_px).collect();
    let reconstruction = MetricReconstruction {
        intrinsics: (0..groups).map(intrinsics).collect(),
        group_of: truth.camera_groups.iter().map(|&group| group as usize).collect(),
        focals: if model.is_per_view() { own_focals() } else { Vec::new() },
        poses: poses(&truth.rotations, &truth.translations),
        points: truth.points.iter().map(|point| Vector3::from(*point)).collect(),
        has_common_centre: false,
    };
    let ids = scene.input.view.iter().zip(&scene.input.track);
    let verifiable = ids.zip(truth.verifiable(&scene.input.track)).filter(|(_, verifiable)| *verifiable);
    let observations: Vec<Observation> = verifiable.map(|((&view, &track), _)| observation(view, track)).collect();
    let geometry = match options.motion {
        PhotographedMotion::PureRotation => Geometry::Rotation,
        PhotographedMotion::PlanarScene => Geometry::Plane,
        _ => Geometry::General,
    };
    sigmas(&reconstruction, &observations, model, effective_noise() * options.noise_px / scale_px, geometry)
}

/// The smallest model of intrinsics that holds the truth, of those that the solver knows.
fn smallest_model(scene: &Photographed) -> IntrinsicsModel {
    let options = &scene.options;
    let needed = [
        (Extension::PrincipalPoint, options.principal_point != [0.0; 2]),
        (Extension::Aspect, options.aspect != 1.0),
        (Extension::RadialK1, options.radial != [0.0; 2]),
        (Extension::RadialK2, options.radial[1] != 0.0),
    ];
    let simplest = IntrinsicsModel::focal(options.focal == FocalKind::DriftingFocal);
    let with = |model: IntrinsicsModel, (extension, needed)| if needed { model.with(extension) } else { model };
    needed.into_iter().fold(simplest, with)
}

fn poses(rotations: &[[[f64; 3]; 3]], translations: &[[f64; 3]]) -> Vec<Pose> {
    let pose = |(rotation, translation): (&[[f64; 3]; 3], &[f64; 3])| Pose {
        rotation: Matrix3::from_fn(|row, column| rotation[row][column]),
        translation: Vector3::from(*translation),
    };
    rotations.iter().zip(translations).map(pose).collect()
}

/// Where it is does not matter: the bound is at the truth.
fn observation(view: u32, track: u32) -> Observation {
    Observation::new(view as usize, track as usize, Vector2::zeros())
}

/// Cramer-Rao bound of the standard deviation of each view's log focal length.
///
/// The derivatives are those of the product's adjustment and the priors those of its calibration, what a zoom adds to
/// focal lengths of the views included. Where nothing determines a focal length, the bound is huge.
///
/// * `noise`: of an observation's coordinate, in image sides
fn sigmas(
    truth: &MetricReconstruction,
    observations: &[Observation],
    model: IntrinsicsModel,
    noise: f64,
    geometry: Geometry,
) -> Option<Vec<f64>> {
    let layout = Layout { shared: model.parameters(), per_view: model.is_per_view(), geometry, truth };
    let mut of_point: Vec<Vec<usize>> = vec![Vec::new(); truth.points.len()];
    observations.iter().for_each(|observation| of_point[observation.point].push(observation.view));
    let dimension = layout.of_view(truth.poses.len());
    let mut reduced = DMatrix::<f64>::zeros(dimension, dimension);
    for (point, views) in truth.points.iter().zip(&of_point).filter(|(_, views)| !views.is_empty()) {
        layout.add(point, views, &mut reduced);
    }
    reduced /= noise * noise;
    // At a noise of 1 the information is the inverse of the variance.
    let lenses = &CalibrationOptions::DEFAULT.lenses;
    let prior = lenses.prior(1.0, None, 1.0);
    for group in 0..truth.intrinsics.len() {
        for (k, parameter) in layout.shared.iter().enumerate() {
            let place = layout.of_group(group) + k;
            reduced[(place, place)] += prior.information[*parameter as usize];
        }
    }
    let scale: Vec<f64> =
        reduced.diagonal().iter().map(|value| if *value > 0.0 { value.sqrt().recip() } else { 1.0 }).collect();
    let mut scaled =
        DMatrix::from_fn(dimension, dimension, |row, column| reduced[(row, column)] * scale[row] * scale[column]);
    (0..dimension).for_each(|k| scaled[(k, k)] += HELD);
    let factor = scaled.cholesky()?;
    let variance = |place: usize| {
        let mut unit = DVector::zeros(dimension);
        unit[place] = scale[place];
        factor.l().solve_lower_triangular(&unit).map(|column| column.norm_squared())
    };
    let added = if layout.per_view { lenses.zoom_sigma.powi(2) } else { 0.0 };
    (0..truth.poses.len()).map(|view| Some((variance(layout.focal(view))? + added).sqrt())).collect()
}

/// Where each unknown is: the intrinsics that views share, group by group, then each view's own.
struct Layout<'a> {
    shared: Vec<Parameter>,
    per_view: bool,
    geometry: Geometry,
    truth: &'a MetricReconstruction,
}

impl Layout<'_> {
    fn of_group(&self, group: usize) -> usize {
        self.shared.len() * group
    }

    fn of_view(&self, view: usize) -> usize {
        let own = self.geometry.pose() + usize::from(self.per_view);
        self.of_group(self.truth.intrinsics.len()) + own * view
    }

    /// The log focal length of a view.
    fn focal(&self, view: usize) -> usize {
        match self.per_view {
            true => self.of_view(view) + self.geometry.pose(),
            // The first of the parameters.
            false => self.of_group(self.truth.group_of[view]),
        }
    }

    /// Adds what the observations of a point say of all else.
    fn add(&self, point: &Vector3<f64>, views: &[usize], reduced: &mut DMatrix<f64>) {
        let directions = self.geometry.of_point(point);
        let mut of_point = DMatrix::<f64>::zeros(directions.len(), directions.len());
        let mut places: Vec<usize> = views.iter().flat_map(|&view| self.places(view)).collect();
        places.sort_unstable();
        places.dedup();
        let mut coupling = DMatrix::<f64>::zeros(places.len(), directions.len());
        for &view in views {
            let intrinsics = self.truth.intrinsics_of(view);
            let gradients = Projection::new(&intrinsics, &self.truth.poses[view], point).gradients();
            let here = self.places(view);
            for axis in 0..2 {
                let by_parameter = |parameter: &Parameter| gradients.by_parameter[axis][*parameter as usize];
                let shared = self.shared.iter().map(by_parameter);
                let pose = gradients.by_pose[axis].iter().copied().take(self.geometry.pose());
                let own = self.per_view.then(|| by_parameter(&Parameter::LogFocal));
                let row: Vec<f64> = shared.chain(pose).chain(own).collect();
                let by_point = DVector::from_iterator(
                    directions.len(),
                    directions.iter().map(|direction| gradients.by_point[axis].dot(direction)),
                );
                of_point.ger(1.0, &by_point, &by_point, 1.0);
                for (&place, value) in here.iter().zip(&row) {
                    here.iter().zip(&row).for_each(|(&other, of_other)| reduced[(place, other)] += value * of_other);
                    // Every place of a view is among those of its point.
                    let Ok(found) = places.binary_search(&place) else { continue };
                    by_point.iter().enumerate().for_each(|(k, by)| coupling[(found, k)] += value * by);
                }
            }
        }
        // A point without parallax has no depth to speak of: it is held.
        (0..directions.len()).for_each(|k| of_point[(k, k)] *= 1.0 + HELD);
        let Some(inverse) = of_point.cholesky().map(|factor| factor.inverse()) else { return };
        let taken = &coupling * inverse * coupling.transpose();
        for (row, &place) in places.iter().enumerate() {
            places.iter().enumerate().for_each(|(column, &other)| reduced[(place, other)] -= taken[(row, column)]);
        }
    }

    /// The unknowns that an image in a view depends on: its group's, its pose and its focal length.
    fn places(&self, view: usize) -> Vec<usize> {
        let group = self.of_group(self.truth.group_of[view]);
        (group..group + self.shared.len()).chain(self.of_view(view)..self.of_view(view + 1)).collect()
    }
}

#[cfg(test)]
mod tests;
