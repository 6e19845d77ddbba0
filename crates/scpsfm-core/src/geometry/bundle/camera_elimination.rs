//! A problem whose cameras take the part of points and whose points that of cameras.
//!
//! Nothing in the engine knows which is which: what it calls points it eliminates, one small block each, and the system
//! that is left has the size of the rest. Of eight points in ten views that rest has 32 unknowns where the cameras are
//! eliminated, and 120 where the points are.

use nalgebra::{SVector, Vector2};

use super::Observation;
use super::problem::{BundleProblem, Jacobian, Layout, Step};

/// Share of the unknowns of the cameras that those of the points may have at most: with as many of either, a camera's
/// larger blocks cost more to eliminate.
const MOST_SHARE: f64 = 0.5;

/// Whether it is cheaper to eliminate the cameras than the points, and every camera has as many residuals as unknowns:
/// one that has fewer has no block of its own to eliminate.
pub(super) fn is_worth_it<const C: usize, const P: usize>(problem: &impl BundleProblem<C, P>, layout: &Layout) -> bool {
    let (cameras, points) = problem.counts();
    if (P * points) as f64 > MOST_SHARE * (C * cameras) as f64 {
        return false;
    }
    let mut residuals = vec![0; cameras];
    layout.observations.iter().for_each(|seen| residuals[seen.view] += 2);
    residuals.iter().all(|&count| count >= C)
}

/// The layout of the problem with cameras and points exchanged.
pub(super) fn layout(layout: &Layout, cameras: usize) -> Layout {
    Layout::sorted(layout.observations.iter().copied().map(exchanged).collect(), cameras)
}

fn exchanged(seen: Observation) -> Observation {
    Observation { view: seen.point, point: seen.view, ..seen }
}

/// A problem with cameras and points exchanged.
#[derive(Clone)]
pub(super) struct CameraElimination<T>(pub T);

impl<const C: usize, const P: usize, T: BundleProblem<C, P>> BundleProblem<P, C> for CameraElimination<T> {
    fn counts(&self) -> (usize, usize) {
        let (cameras, points) = self.0.counts();
        (points, cameras)
    }

    #[inline]
    fn evaluate(&self, seen: Observation) -> (Vector2<f64>, impl FnOnce() -> Jacobian<P, C>) {
        let (residual, jacobian) = self.0.evaluate(exchanged(seen));
        let exchanged_jacobian = || {
            let Jacobian { camera, point } = jacobian();
            Jacobian { camera: point, point: camera }
        };
        (residual, exchanged_jacobian)
    }

    fn retract(&mut self, from: &Self, step: &Step<P, C>) {
        self.0.retract(&from.0, &Step { cameras: step.points.clone(), points: step.cameras.clone() });
    }

    fn camera_gauge(&self, camera: usize) -> SVector<f64, P> {
        self.0.point_gauge(camera)
    }

    fn point_gauge(&self, point: usize) -> SVector<f64, C> {
        self.0.camera_gauge(point)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Options;
    use super::super::critical::Homographies;
    use super::super::engine::{descend, minimise};
    use super::super::projective::Projective;
    use super::super::testing::{self, Motion, NOISE};
    use super::*;
    use crate::domain::StopToken;
    use crate::geometry::homography::Correspondences;

    /// Adjusts a problem as it is and with cameras and points exchanged, from the same start.
    fn both_end_at_the_same_cost<const C: usize, const P: usize>(
        problem: &impl BundleProblem<C, P>,
        observations: &[Observation],
        case: &str,
    ) {
        let (cameras, points) = problem.counts();
        let straight = Layout::new(observations, cameras, points);
        assert!(is_worth_it(problem, &straight), "{case}");
        let options = Options::squared(100);
        let expected = descend(&mut problem.clone(), &straight, &options, &StopToken::default());
        let exchanged = layout(&straight, cameras);
        let found = descend(&mut CameraElimination(problem.clone()), &exchanged, &options, &StopToken::default());
        let apart = |a: f64, b: f64| (a - b).abs() / b;
        assert!(apart(found.initial_cost, expected.initial_cost) < 1e-12, "{case}");
        assert!(expected.cost < 0.5 * expected.initial_cost, "{case}: {expected:?}");
        assert!(apart(found.cost, expected.cost) < 1e-5, "{case}: {found:?} {expected:?}");
        let mut adjusted = problem.clone();
        let chosen = minimise(&mut adjusted, observations, &options, &StopToken::default());
        assert_eq!(chosen, found, "{case}");
        let again = minimise(&mut adjusted, observations, &Options::squared(0), &StopToken::default());
        assert!(apart(again.initial_cost, found.cost) < 1e-9, "{case}: what was found is not what is left");
    }

    #[test]
    fn exchanged_problems_end_where_problems_do() {
        for seed in 0..10 {
            for tracks in [8, 12] {
                let case = format!("seed {seed}, {tracks} tracks");
                let scene = testing::scene(seed, 10, tracks, NOISE);
                let (cameras, points) = testing::projectively_transformed(&scene, seed);
                let mut problem = Projective { cameras, points };
                testing::perturb(problem.cameras.iter_mut().flat_map(|camera| camera.iter_mut()), 0.003, seed);
                testing::perturb(problem.points.iter_mut().flat_map(|point| point.iter_mut()), 0.003, seed + 1);
                both_end_at_the_same_cost::<12, 4>(&problem, &scene.observations, &case);

                let plane = testing::scene_of(seed, 10, tracks, NOISE, Motion::General, true);
                let points = plane.observations.iter().filter(|seen| seen.view == 0).map(|seen| seen.xy);
                let seen = Correspondences::new(&plane.observations, 10);
                let views = seen.homographies_from(0, NOISE).expect("complete tracks").views;
                let mut problem = Homographies { views, points: points.collect() };
                testing::perturb(problem.points.iter_mut().flat_map(|point| point.iter_mut()), 0.01, seed);
                both_end_at_the_same_cost::<9, 2>(&problem, &plane.observations, &case);
            }
        }
    }

    #[test]
    fn many_points_and_views_that_see_few_are_left_as_they_are() {
        let scene = testing::scene(1, 10, 30, NOISE);
        let (cameras, points) = testing::projectively_transformed(&scene, 1);
        let problem = |count: usize| Projective { cameras: cameras.clone(), points: points[..count].to_vec() };
        let is_exchanged = |problem: &Projective, observations: &[Observation]| {
            is_worth_it(problem, &Layout::new(observations, problem.cameras.len(), problem.points.len()))
        };
        assert!(is_exchanged(&problem(15), &scene.observations));
        assert!(!is_exchanged(&problem(16), &scene.observations));
        let blind = |seen: &&Observation| seen.view != 3 || seen.point < 5;
        let few: Vec<Observation> = scene.observations.iter().filter(blind).copied().collect();
        assert!(!is_exchanged(&problem(15), &few));
    }
}
