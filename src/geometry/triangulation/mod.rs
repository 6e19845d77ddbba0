//! Points from cameras and image points: of one track here, of many side by side in [`batch`].

pub mod batch;
mod f64x8;

use nalgebra::{Matrix4, Vector2};

use super::null_vector::null_vector;
use super::observation::Observation;
use super::{Camera, Point};
use crate::simd::vectorised;

/// Smallest homogeneous depth that is divided by; points nearer to the principal plane have no image.
const MIN_DEPTH: f64 = 1e-9;
/// Levenberg damping at the start of a refinement, relative to the diagonal.
const INITIAL_DAMPING: f64 = 1e-3;
/// Factors on the damping after a step that is taken, and after one that is not.
const DAMPING_DOWN: f64 = 0.2;
const DAMPING_UP: f64 = 10.0;

/// Reprojection residual, projected minus observed, in the units of the image points.
///
/// # Pitfall
/// A point on the camera's principal plane is projected as if it were [`MIN_DEPTH`] off it: the residual is then huge
/// but finite, and its sign means nothing.
#[inline(always)]
pub fn reprojection(camera: &Camera, point: &Point, xy: &Vector2<f64>) -> Vector2<f64> {
    let image = camera * point;
    image.xy() / away_from_zero(image.z) - xy
}

/// Squared reprojection residual, by the observation's weight.
#[inline(always)]
pub fn weighted_squared(camera: &Camera, point: &Point, seen: &Observation) -> f64 {
    seen.weight * reprojection(camera, point, &seen.xy).norm_squared()
}

/// Weighted sum of squared reprojection residuals of a point over its observations.
#[inline(always)]
pub fn squared_residual(cameras: &[Camera], point: &Point, observations: &[Observation]) -> f64 {
    observations.iter().map(|seen| weighted_squared(&cameras[seen.view], point, seen)).sum()
}

/// Linear triangulation (Hartley & Zisserman, section 12.2): the unit 4-vector that is least inconsistent with
/// `x (P3 X) = P1 X`, `y (P3 X) = P2 X` over all observations, each camera's rows scaled by the norm of its third.
///
/// Needs two observations or more; with fewer the point returned is one of many. Of cameras that are all at the origin
/// of the frame, which tell no depth, it is the direction, a point at infinity.
pub fn linear(cameras: &[Camera], observations: &[Observation]) -> Point {
    let mut normal = vectorised(
        #[inline(always)]
        || inconsistency(cameras, observations),
    );
    let are_directions = hold_unseen(&mut normal);
    let point = null_vector(&normal).unwrap_or(Point::new(0.0, 0.0, 0.0, 1.0));
    if are_directions { in_front(cameras, observations, point) } else { point }
}

/// Where no camera tells the last unknown, as of cameras that are all at the origin, it stays what it is; whether that
/// is so.
#[inline(always)]
fn hold_unseen(normal: &mut Matrix4<f64>) -> bool {
    let is_unseen = normal.m44 == 0.0;
    if is_unseen {
        normal.m44 = normal.trace();
    }
    is_unseen
}

/// The direction or its opposite, whichever is in front of more of the cameras.
fn in_front(cameras: &[Camera], observations: &[Observation], direction: Point) -> Point {
    let depths = observations.iter().map(|seen| (cameras[seen.view].row(2) * direction).x.signum());
    if depths.sum::<f64>() < 0.0 { -direction } else { direction }
}

/// The quadratic form whose least direction [`linear`] wants.
#[inline(always)]
fn inconsistency(cameras: &[Camera], observations: &[Observation]) -> Matrix4<f64> {
    let mut normal = [[0.0; 4]; 4];
    for observation in observations {
        let columns: &[[f64; 3]; 4] = cameras[observation.view].as_ref();
        let third = columns.map(|column| column[2]);
        let of_direction: f64 = third[..3].iter().map(|entry| entry * entry).sum();
        let of_all = of_direction + third[3] * third[3];
        let weight = observation.weight / (of_direction + f64::EPSILON * of_all).max(f64::MIN_POSITIVE);
        for (axis, coordinate) in [observation.xy.x, observation.xy.y].into_iter().enumerate() {
            let row = columns.map(|column| column[2] * coordinate - column[axis]);
            accumulate(&mut normal, row.map(|entry| weight * entry), row);
        }
    }
    Matrix4::from(normal)
}

/// Refines a point by Levenberg-Marquardt on its weighted squared reprojection residuals, at most `iterations` steps.
///
/// Returns the point, of unit norm, and its sum of squared residuals; never worse than the start.
pub fn refine(cameras: &[Camera], observations: &[Observation], start: Point, iterations: usize) -> (Point, f64) {
    vectorised(
        #[inline(always)]
        || descend(cameras, observations, start, iterations),
    )
}

#[inline(always)]
fn descend(cameras: &[Camera], observations: &[Observation], start: Point, iterations: usize) -> (Point, f64) {
    let mut point = start.normalize();
    let mut cost = squared_residual(cameras, &point, observations);
    let mut damping = INITIAL_DAMPING;
    for _ in 0..iterations {
        let mut normal = [[0.0; 4]; 4];
        let mut gradient = Point::zeros();
        for observation in observations {
            let camera = &cameras[observation.view];
            let columns: &[[f64; 3]; 4] = camera.as_ref();
            let image = camera * point;
            let nearness = away_from_zero(image.z).recip();
            for axis in [0, 1] {
                let projected = image[axis] * nearness;
                let slope = columns.map(|column| (column[axis] - projected * column[2]) * nearness);
                let weighted = slope.map(|entry| observation.weight * entry);
                accumulate(&mut normal, weighted, slope);
                gradient += Point::from(weighted) * (projected - observation.xy[axis]);
            }
        }
        let mut normal = Matrix4::from(normal);
        // The scale of the homogeneous point is free: pin it.
        normal += point * point.transpose() * normal.trace();
        hold_unseen(&mut normal);
        for k in 0..4 {
            normal[(k, k)] *= 1.0 + damping;
        }
        let Some(step) = normal.cholesky().map(|factor| factor.solve(&gradient)) else { break };
        let candidate = (point - step).normalize();
        let candidate_cost = squared_residual(cameras, &candidate, observations);
        if candidate_cost < cost {
            let gain = (cost - candidate_cost) / cost;
            (point, cost) = (candidate, candidate_cost);
            damping *= DAMPING_DOWN;
            if gain < RELATIVE_TOLERANCE {
                break;
            }
        } else {
            damping *= DAMPING_UP;
        }
    }
    (point, cost)
}

/// Gain below which a refinement has arrived: ranking and gates do not see a part in a thousand.
const RELATIVE_TOLERANCE: f64 = 1e-3;

/// Adds the product of a column and a row.
#[inline(always)]
fn accumulate(sum: &mut [[f64; 4]; 4], column: [f64; 4], row: [f64; 4]) {
    for (sums, factor) in sum.iter_mut().zip(column) {
        for (sum, entry) in sums.iter_mut().zip(row) {
            *sum += factor * entry;
        }
    }
}

#[inline(always)]
fn away_from_zero(depth: f64) -> f64 {
    if depth.abs() < MIN_DEPTH { MIN_DEPTH.copysign(depth) } else { depth }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cameras() -> Vec<Camera> {
        (0..4)
            .map(|view| {
                let t = view as f64;
                Camera::new(1.2, 0.1 * t, 0.0, 0.4 * t, 0.0, 1.2, 0.05 * t, -0.2, 0.02 * t, 0.0, 1.0, 3.0 + 0.1 * t)
            })
            .collect()
    }

    fn observations(cameras: &[Camera], point: &Point, shift: f64) -> Vec<Observation> {
        cameras
            .iter()
            .enumerate()
            .map(|(view, camera)| {
                let image = camera * point;
                let wobble = Vector2::new((view as f64 * 2.1).sin(), (view as f64 * 3.7).cos()) * shift;
                Observation::new(view, 0, image.xy() / image.z + wobble)
            })
            .collect()
    }

    #[test]
    fn exact_points_are_found_exactly_also_at_infinity() {
        let cameras = cameras();
        for truth in [Point::new(0.3, -0.4, 1.0, 1.0), Point::new(0.1, 0.2, 1.0, 0.0)] {
            let seen = observations(&cameras, &truth, 0.0);
            let found = linear(&cameras, &seen);
            assert!(squared_residual(&cameras, &found, &seen) < 1e-18);
        }
    }

    #[test]
    fn refinement_reaches_a_stationary_point_and_never_gets_worse() {
        let cameras = cameras();
        let seen = observations(&cameras, &Point::new(0.3, -0.4, 1.0, 1.0), 0.01);
        let start = linear(&cameras, &seen);
        let (point, cost) = refine(&cameras, &seen, start, 20);
        assert!(cost <= squared_residual(&cameras, &start, &seen));
        for axis in 0..4 {
            let mut moved = point;
            moved[axis] += 1e-4;
            assert!(squared_residual(&cameras, &moved, &seen) >= cost * (1.0 - 1e-3));
        }
    }

    /// Cameras at the origin see directions, of which no observation tells how far away they end.
    #[test]
    fn cameras_that_only_turn_see_directions_in_front_of_them() {
        let turned = |view: usize| {
            let turn = nalgebra::Rotation3::from_euler_angles(0.1 * view as f64, -0.15 * view as f64, 0.05);
            Camera::from_fn(|row, column| if column < 3 { turn[(row, column)] } else { 0.0 })
        };
        let cameras: Vec<Camera> = (0..4).map(turned).collect();
        let truth = Point::new(0.3, -0.2, 1.0, 0.0).normalize();
        for shift in [0.0, 0.01] {
            let seen = observations(&cameras, &truth, shift);
            let found = linear(&cameras, &seen);
            let (refined, cost) = refine(&cameras, &seen, found, 20);
            let alone = batch::Batch::new(&cameras, &[&seen]);
            let beside = alone.refine(alone.linear(), |_| true, 20);
            for point in [found, refined, beside.point(0)] {
                assert_eq!(point.w, 0.0);
                assert!((point.dot(&truth).abs() - 1.0).abs() < 0.1 * shift + 1e-9, "{point} {truth}");
            }
            assert!(found.dot(&truth) > 0.0 && refined.dot(&truth) > 0.0, "in front");
            assert!(
                cost <= squared_residual(&cameras, &found, &seen)
                    && (beside.cost(0) - cost).abs() < 1e-3 * cost + 1e-18
            );
        }
    }

    #[test]
    fn degenerate_cameras_give_finite_points() {
        let flat = vec![Camera::zeros(); 3];
        let seen: Vec<Observation> = (0..3).map(|view| Observation::new(view, 0, Vector2::new(0.1, 0.2))).collect();
        let (point, cost) = refine(&flat, &seen, linear(&flat, &seen), 5);
        assert!(point.iter().all(|entry| entry.is_finite()) && cost.is_finite());
    }
}
