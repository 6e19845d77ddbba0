//! Points from cameras and image points: of one track here, of many side by side in [`batch`].

pub mod batch;
pub(super) mod f64xn;

use nalgebra::Vector2;

use self::batch::SideBySide;
use super::observation::Observation;
use super::{Camera, Point};

/// Smallest homogeneous depth that is divided by; points nearer to the principal plane have no image.
const MIN_DEPTH: f64 = 1e-9;

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

/// Linear triangulation of one track, see [`SideBySide::linear`]; a direction is oriented.
///
/// Needs two observations or more; with fewer the point returned is one of many.
pub fn linear(cameras: &[Camera], observations: &[Observation]) -> Point {
    let point = SideBySide::<1>::new(cameras, &[observations]).linear().point(0);
    if point.w == 0.0 { in_front(cameras, observations, point) } else { point }
}

/// The direction or its opposite, whichever is in front of more of the cameras.
fn in_front(cameras: &[Camera], observations: &[Observation], direction: Point) -> Point {
    let depths = observations.iter().map(|seen| (cameras[seen.view].row(2) * direction).x.signum());
    if depths.sum::<f64>() < 0.0 { -direction } else { direction }
}

/// Refines the point of one track, see [`SideBySide::refine`]; returns it, of unit norm, and its sum of squared
/// residuals.
pub fn refine(cameras: &[Camera], observations: &[Observation], start: Point, iterations: usize) -> (Point, f64) {
    let alone = SideBySide::<1>::new(cameras, &[observations]);
    let found = alone.refine(alone.at(&start.normalize()), |_| true, iterations);
    (found.point(0), found.cost(0))
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
