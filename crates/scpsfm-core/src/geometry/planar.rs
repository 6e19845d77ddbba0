//! Self-calibration from views of a plane.
//!
//! A homography from the plane to a view takes the plane's two circular points to the image of the absolute conic
//! (Triggs 1998, "Autocalibration from planar scenes", section 2): two equations a view on the intrinsics, once the
//! plane is known in one view. The unknowns are the focal length of each camera group and the plane's normal there.

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, Vector2, Vector3};

use super::bundle::critical::Homographies;
use super::bundle::metric::{Intrinsics, MetricReconstruction, Pose};
use super::daq::scan_focal;
use super::levenberg_marquardt::{self, LeastSquares, Options, damped_step};
use super::metric::oriented;
use super::observation::Observation;
use super::procrustes::nearest_rotation;
use crate::domain::StopToken;

/// Focal lengths and normals that are tried, in tilts to the optical axis, up to 75 degrees, and turns about it:
/// neighbours are some 15 degrees apart, and the refinement pulls in what is nearer than half of that.
const FOCALS: usize = 16;
const TILTS: usize = 6;
const TILT_STEP: f64 = std::f64::consts::PI / 12.0;
/// The refinement: its start is near the minimum, and bundle adjustment follows.
const OPTIONS: Options = Options { relative_tolerance: 1e-6, initial_damping: 1e-3, ..Options::DEFAULT };
/// Log focal lengths and normals that are nearer than this are the same start: adjustment takes them to one minimum.
const SAME: f64 = 0.05;

/// The focal length of each group and the plane in the reference view.
#[derive(Debug, Clone)]
struct Plane {
    log_focals: Vec<f64>,
    /// Two directions within the plane and its normal, away from the camera, all of the reference view.
    basis: Matrix3<f64>,
}

/// A homography from the reference view to another.
#[derive(Debug, Clone, Copy)]
struct ViewHomography {
    homography: Matrix3<f64>,
    group: usize,
}

/// Unknowns of the plane: two turns of its basis.
const TURNS: usize = 2;

impl Plane {
    /// * `tilt`, `turn`: of the normal to the optical axis, and about it
    fn new(groups: usize, log_focal: f64, tilt: f64, turn: f64) -> Self {
        let axis = Vector3::new(turn.cos(), turn.sin(), 0.0);
        Self { log_focals: vec![log_focal; groups], basis: Rotation3::from_scaled_axis(axis * tilt).into_inner() }
    }

    /// What a homography is between directions of the cameras.
    fn of_directions(&self, view: &ViewHomography, reference_group: usize) -> Matrix3<f64> {
        let calibration = |group: usize| Vector3::new(self.log_focals[group].exp(), self.log_focals[group].exp(), 1.0);
        let (from, to) = (calibration(reference_group), calibration(view.group));
        Matrix3::from_fn(|row, column| view.homography[(row, column)] * from[column] / to[row])
    }

    /// By how much what a view sees of the plane's two directions is not of one length and at right angles: zero where
    /// focal lengths and plane are right.
    fn residuals(&self, view: &ViewHomography, reference_group: usize) -> [f64; 2] {
        let map = self.of_directions(view, reference_group);
        let [a, b] = [0, 1].map(|k| map * self.basis.column(k));
        let (aa, bb) = (a.norm_squared(), b.norm_squared());
        [(aa - bb) / (aa + bb), 2.0 * a.dot(&b) / (aa + bb)]
    }

    /// Derivatives of both residuals by the log focal length of the reference view, by that of the view, and by turns
    /// of the basis about its two directions.
    fn derivatives(&self, view: &ViewHomography, reference_group: usize) -> [[f64; 2 + TURNS]; 2] {
        let map = self.of_directions(view, reference_group);
        // Of the map by the log focal lengths.
        let of_image = |k: usize| f64::from(u8::from(k < 2));
        let by_reference = Matrix3::from_fn(|row, column| map[(row, column)] * of_image(column));
        let by_view = Matrix3::from_fn(|row, column| -map[(row, column)] * of_image(row));
        let [first, second, normal] = [0, 1, 2].map(|k| self.basis.column(k).into_owned());
        let (a, b, along) = (map * first, map * second, map * normal);
        // A turn about the first direction takes the second to the normal, one about the second the first away from it.
        let of_first = [by_reference * first, by_view * first, Vector3::zeros(), -along];
        let of_second = [by_reference * second, by_view * second, along, Vector3::zeros()];
        let (aa, ab, bb) = (a.norm_squared(), a.dot(&b), b.norm_squared());
        let sum = aa + bb;
        let derivatives = |k: usize| {
            let (da, db) = (of_first[k], of_second[k]);
            let (aa_by, ab_by, bb_by) = (2.0 * a.dot(&da), a.dot(&db) + b.dot(&da), 2.0 * b.dot(&db));
            let of_length = 2.0 * (bb * aa_by - aa * bb_by) / (sum * sum);
            let of_angle = 2.0 * (ab_by * sum - ab * (aa_by + bb_by)) / (sum * sum);
            (of_length, of_angle)
        };
        [std::array::from_fn(|k| derivatives(k).0), std::array::from_fn(|k| derivatives(k).1)]
    }

    /// * `step`: of the log focal lengths, then the turns of the basis about its two directions
    fn moved(&self, step: &DVector<f64>) -> Self {
        let groups = self.log_focals.len();
        let turn = self.basis * Vector3::new(step[groups], step[groups + 1], 0.0);
        let basis = Rotation3::from_scaled_axis(turn) * self.basis;
        Self { log_focals: self.log_focals.iter().zip(step.iter()).map(|(log, step)| log + step).collect(), basis }
    }

    fn is_near(&self, other: &Self) -> bool {
        let apart = |(own, other): (&f64, &f64)| (own - other).abs();
        let focals = self.log_focals.iter().zip(&other.log_focals).map(apart).fold(0.0, f64::max);
        focals < SAME && (self.basis.column(2) - other.basis.column(2)).norm() < SAME
    }
}

struct Equations {
    views: Vec<ViewHomography>,
    /// Of the reference view.
    reference_group: usize,
    matrix: DMatrix<f64>,
    /// Half the gradient of the cost.
    gradient: DVector<f64>,
}

impl LeastSquares for Equations {
    type State = Plane;

    fn cost(&self, plane: &Plane) -> f64 {
        let squares = |view| plane.residuals(view, self.reference_group).map(|residual| residual * residual);
        self.views.iter().flat_map(squares).sum()
    }

    fn linearise(&mut self, plane: &Plane) {
        let groups = plane.log_focals.len();
        self.matrix.fill(0.0);
        self.gradient.fill(0.0);
        let mut row = self.gradient.clone();
        for view in &self.views {
            let residuals = plane.residuals(view, self.reference_group);
            let derivatives = plane.derivatives(view, self.reference_group);
            for (residual, [by_reference, by_view, turns @ ..]) in residuals.into_iter().zip(derivatives) {
                row.fill(0.0);
                row[self.reference_group] += by_reference;
                row[view.group] += by_view;
                row.rows_mut(groups, TURNS).copy_from_slice(&turns);
                self.matrix.ger(1.0, &row, &row, 1.0);
                self.gradient.axpy(residual, &row, 1.0);
            }
        }
    }

    fn step(&mut self, from: &Plane, damping: f64, to: &mut Plane) -> Option<f64> {
        let (step, predicted) = damped_step(&self.matrix, &self.gradient, damping)?;
        *to = from.moved(&step);
        Some(predicted)
    }
}

/// Metric reconstructions that views of a plane may be of, those that satisfy the equations best first, at most `most`.
///
/// Their cameras are ideal but for the focal length of their group, and their points lie on the plane: they are where
/// bundle adjustment may start from.
///
/// * `group_of`: camera group of each view
/// * `observations`: of the points of the plane
pub fn upgrades(
    homographies: &Homographies,
    group_of: &[usize],
    observations: &[Observation],
    most: usize,
    stop: &StopToken,
) -> Vec<MetricReconstruction> {
    let Some(first) = homographies.views.first() else { return Vec::new() };
    let (Some(back), Some(&last)) = (first.try_inverse(), group_of.iter().max()) else { return Vec::new() };
    let groups = 1 + last;
    let view = |(view, &group): (&Matrix3<f64>, &usize)| ViewHomography { homography: view * back, group };
    let unknowns = groups + TURNS;
    let mut equations = Equations {
        views: homographies.views.iter().zip(group_of).map(view).collect(),
        reference_group: group_of[0],
        matrix: DMatrix::zeros(unknowns, unknowns),
        gradient: DVector::zeros(unknowns),
    };
    let turns = |tilt: usize| if tilt == 0 { 1 } else { 6 * tilt };
    let normals: Vec<(f64, f64)> = (0..TILTS)
        .flat_map(|tilt| {
            let turn = move |k: usize| std::f64::consts::TAU * k as f64 / turns(tilt) as f64;
            (0..turns(tilt)).map(move |k| (TILT_STEP * tilt as f64, turn(k)))
        })
        .collect();
    let mut starts: Vec<(f64, Plane)> = (0..FOCALS)
        .filter_map(|k| {
            let log_focal = scan_focal(k, FOCALS).ln();
            let planes = normals.iter().map(|(tilt, turn)| Plane::new(groups, log_focal, *tilt, *turn));
            let costs = planes.map(|plane| (equations.cost(&plane), plane));
            let (_, mut best) = costs.min_by(|a, b| a.0.total_cmp(&b.0))?;
            let report = levenberg_marquardt::minimise(&mut equations, &mut best, &OPTIONS, stop);
            report.cost.is_finite().then_some((report.cost, best))
        })
        .collect();
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut chosen: Vec<Plane> = Vec::with_capacity(most);
    for (_, start) in starts {
        if chosen.len() < most && !chosen.iter().any(|other| other.is_near(&start)) {
            chosen.push(start);
        }
    }
    let position = |point: &Vector2<f64>| {
        let seen = first * point.push(1.0);
        seen.xy() / seen.z
    };
    let positions: Vec<Vector2<f64>> = homographies.points.iter().map(position).collect();
    chosen.iter().filter_map(|start| upgrade(start, &equations, &positions, observations)).collect()
}

/// The reconstruction of focal lengths and a plane, whose points are where the reference view sees them.
///
/// Returns `None` where a pose or the depth is not a number.
fn upgrade(
    start: &Plane,
    equations: &Equations,
    positions: &[Vector2<f64>],
    observations: &[Observation],
) -> Option<MetricReconstruction> {
    let Equations { views, reference_group, .. } = equations;
    let focal = start.log_focals[*reference_group].exp();
    // Where the ray of an image point meets the plane at distance 1, in the plane's own coordinates.
    let on_plane = |seen: &Vector2<f64>| {
        let ray = start.basis.tr_mul(&(seen / focal).push(1.0));
        Some(Vector3::new(ray.x / ray.z, ray.y / ray.z, 0.0)).filter(|point| point.iter().all(|x| x.is_finite()))
    };
    let points: Vec<Vector3<f64>> = positions.iter().map(|seen| on_plane(seen).unwrap_or_default()).collect();
    let maps: Vec<Matrix3<f64>> =
        views.iter().map(|view| start.of_directions(view, *reference_group) * start.basis).collect();
    let mut depths = vec![0.0; maps.len()];
    for seen in observations.iter().filter(|seen| seen.is_usable(maps.len(), points.len())) {
        let point = &points[seen.point];
        depths[seen.view] += (maps[seen.view].row(2) * Vector3::new(point.x, point.y, 1.0)).x.signum();
    }
    let pose = |(map, depth): (&Matrix3<f64>, &f64)| {
        // A homography's sign is free: the points are in front.
        let map = map * depth.signum();
        let [first, second, translation] = [0, 1, 2].map(|k| map.column(k).into_owned());
        let scale = (first.norm() + second.norm()) / 2.0;
        let turned = Matrix3::from_columns(&[first / scale, second / scale, first.cross(&second) / (scale * scale)]);
        let (rotation, translation) = (nearest_rotation(&turned)?, translation / scale);
        translation.iter().all(|x| x.is_finite()).then_some(Pose { rotation, translation })
    };
    let poses = maps.iter().zip(&depths).map(pose).collect::<Option<Vec<_>>>()?;
    let of_group = |log_focal: &f64| Intrinsics::from_focal(log_focal.exp());
    let reconstruction = MetricReconstruction {
        intrinsics: start.log_focals.iter().map(of_group).collect(),
        group_of: views.iter().map(|view| view.group).collect(),
        ..MetricReconstruction::new(Intrinsics::from_focal(focal), poses, points)
    };
    oriented(reconstruction, observations)
}

#[cfg(test)]
mod tests {
    use super::super::bundle::testing::{self, Motion, NOISE};
    use super::super::homography::Correspondences;
    use super::*;

    fn homographies(seed: u64, views: usize, noise: f64) -> (testing::TestScene, Homographies) {
        let scene = testing::scene_of(seed, views, 30, noise, Motion::General, true);
        let seen = Correspondences::new(&scene.observations, views);
        let found = seen.homographies_from(0, noise.max(1e-6)).expect("complete tracks").views;
        let points = scene.observations.iter().filter(|seen| seen.view == 0).map(|seen| seen.xy).collect();
        (scene, Homographies { views: found, points })
    }

    #[test]
    fn derivatives_agree_with_finite_differences() {
        let (_, plane) = homographies(1, 4, 0.0);
        // The reference view has the first focal length, the others the second.
        let mut at = Plane::new(2, 0.3, 0.5, 1.0);
        at.log_focals[1] = 0.2;
        for homography in plane.views {
            let view = ViewHomography { homography, group: 1 };
            for (component, derivative) in at.derivatives(&view, 0).into_iter().enumerate() {
                for k in 0..4 {
                    let side = |width: f64| {
                        let mut step = DVector::zeros(4);
                        step[k] = width;
                        at.moved(&step).residuals(&view, 0)[component]
                    };
                    let numeric = (side(1e-6) - side(-1e-6)) / 2e-6;
                    assert!((numeric - derivative[k]).abs() < 1e-7, "{component}, {k}: {numeric}, {}", derivative[k]);
                }
            }
        }
    }

    #[test]
    fn one_of_the_starts_is_near_the_truth() {
        for (noise, within) in [(0.0, 1e-4), (NOISE, 0.2)] {
            for seed in 0..20 {
                let (scene, plane) = homographies(seed, 8, noise);
                let found = upgrades(&plane, &[0; 8], &scene.observations, 4, &StopToken::default());
                let error = |metric: &MetricReconstruction| (metric.intrinsics[0].focal / scene.intrinsics.focal).ln();
                let errors: Vec<f64> = found.iter().map(error).collect();
                println!("seed {seed}, noise {noise}: log focal off by {errors:.4?}");
                assert!(errors.iter().any(|error| error.abs() < within), "seed {seed}, noise {noise}: {errors:?}");
                let mut residuals = scene.observations.iter().map(|seen| found[0].residual(seen).norm());
                assert!(noise > 0.0 || residuals.all(|residual| residual < 1e-6), "seed {seed}");
            }
        }
    }

    #[test]
    fn nothing_and_nonsense_give_nothing() {
        let found = |plane: &Homographies, group_of: &[usize]| upgrades(plane, group_of, &[], 4, &StopToken::default());
        assert!(found(&Homographies { views: vec![], points: vec![] }, &[]).is_empty());
        let broken = Homographies { views: vec![Matrix3::from_element(f64::NAN); 3], points: vec![] };
        assert!(found(&broken, &[0; 3]).is_empty());
        let singular = Homographies { views: vec![Matrix3::zeros(); 3], points: vec![Vector2::zeros()] };
        assert!(found(&singular, &[0; 3]).is_empty());
    }
}
