//! Points from tracks of which some observations are wrong.
//!
//! Tracks are linked from view to view: one wrong link parts a track into runs that are right each, so that
//! neighbouring observations make the hypotheses. Dropping the worst observation of a common fit would fail: wrong
//! links are far off and mask each other.

use nalgebra::Matrix3;

use super::fundamental::{Match, algebraic, matrix_of_cameras};
use super::observation::Observation;
use super::{Camera, Point, triangulation};

/// Observations that a hypothesis is made of.
const RUNS: [usize; 2] = [3, 2];
/// Hypotheses of one length that a track has at most: of longer tracks every other start, or fewer.
const MOST_HYPOTHESES: usize = 30;
/// Refinement steps of a point.
const POINT_STEPS: usize = 8;
/// Gates an observation beyond which the point of all observations is not refined: no refinement makes them all agree.
const HOPELESS_GATES: f64 = 100.0;
/// Gates within which the squared Sampson distance of two observations must be for both to agree with a point: it is
/// the least sum of their squared residuals, to first order.
const PAIR_GATES: f64 = 2.0;

/// Cameras that tracks are triangulated by, with the epipolar geometry of each with the next, which complete tracks ask
/// again and again.
pub struct Triangulator<'a> {
    cameras: &'a [Camera],
    to_next: Vec<Matrix3<f64>>,
}

/// Cameras of all views, zero where a view has none: nothing is observed there, but a [`Triangulator`] wants a slice.
pub fn or_zeros(cameras: &[Option<Camera>]) -> Vec<Camera> {
    cameras.iter().map(|camera| camera.unwrap_or_else(Camera::zeros)).collect()
}

/// A point and the observations that agree with it.
#[derive(Debug, Clone, PartialEq)]
pub struct RobustPoint {
    pub point: Point,
    /// One an observation: within the gate and in front of the camera.
    pub agrees: Vec<bool>,
}

impl<'a> Triangulator<'a> {
    /// * `cameras`: metric or affine to metric, so that "in front" means something
    pub fn new(cameras: &'a [Camera]) -> Self {
        let to_next = cameras.windows(2).map(|pair| matrix_of_cameras(&pair[0], &pair[1])).collect();
        Self { cameras, to_next }
    }

    /// The point of least truncated squared residuals, in front of its cameras.
    ///
    /// * `gate`: weighted squared residual within which an observation agrees
    ///
    /// Returns `None` where no two observations agree.
    pub fn robust(&self, observations: &[Observation], gate: f64) -> Option<RobustPoint> {
        if observations.len() < 2 {
            return None;
        }
        let cameras = self.cameras;
        let mut all = triangulation::linear(cameras, observations);
        let hopeless = HOPELESS_GATES * gate * observations.len() as f64;
        if triangulation::squared_residual(cameras, &all, observations) < hopeless {
            all = triangulation::refine(cameras, observations, all, POINT_STEPS).0;
            let agrees = agreeing(cameras, observations, &all, gate);
            if agrees.iter().all(|&agrees| agrees) {
                return Some(RobustPoint { point: all, agrees });
            }
        }
        let start = self.best_hypothesis(observations, all, gate);
        let agrees = |seen: &&Observation| squared_in_front(cameras, seen, &start) < gate;
        let right: Vec<Observation> = observations.iter().filter(agrees).copied().collect();
        if right.len() < 2 {
            return None;
        }
        let (point, _) = triangulation::refine(cameras, &right, start, POINT_STEPS);
        let agrees = agreeing(cameras, observations, &point, gate);
        (agrees.iter().filter(|&&agrees| agrees).count() >= 2).then_some(RobustPoint { point, agrees })
    }

    /// The cheapest of the point of all observations, of those of its runs and of that of its ends.
    ///
    /// A run of which two neighbours lie off each other's epipolar lines has no point: it is not triangulated.
    fn best_hypothesis(&self, observations: &[Observation], all: Point, gate: f64) -> Point {
        let mut best = (all, truncated(self.cameras, observations, &all, gate, f64::INFINITY));
        let mut offer = |some: &[Observation]| {
            let point = triangulation::linear(self.cameras, some);
            let cost = truncated(self.cameras, observations, &point, gate, best.1);
            if cost < best.1 {
                best = (point, cost);
            }
        };
        let meets: Vec<bool> =
            observations.windows(2).map(|pair| self.are_epipolar(&pair[0], &pair[1], PAIR_GATES * gate)).collect();
        for run in RUNS {
            let starts = (observations.len() + 1).saturating_sub(run);
            for start in (0..starts).step_by(starts.div_ceil(MOST_HYPOTHESES).max(1)) {
                if meets[start..start + run - 1].iter().all(|&meets| meets) {
                    offer(&observations[start..start + run]);
                }
            }
        }
        if let [first, .., last] = observations
            && self.are_epipolar(first, last, PAIR_GATES * gate)
        {
            offer(&[*first, *last]);
        }
        best.0
    }

    /// Whether two observations may be of one point.
    fn are_epipolar(&self, from: &Observation, to: &Observation, gate: f64) -> bool {
        let matrix = match to.view == from.view + 1 {
            true => self.to_next[from.view],
            false => matrix_of_cameras(&self.cameras[from.view], &self.cameras[to.view]),
        };
        let (error, gradient_squared) = algebraic(&matrix, &Match { from: from.xy, to: to.xy });
        // Cameras at one centre have no epipolar lines: then nothing is ruled out.
        error * error <= gate * gradient_squared
    }
}

fn agreeing(cameras: &[Camera], observations: &[Observation], point: &Point, gate: f64) -> Vec<bool> {
    observations.iter().map(|observation| squared_in_front(cameras, observation, point) < gate).collect()
}

/// Weighted squared residual, infinite behind the camera.
pub fn squared_in_front(cameras: &[Camera], observation: &Observation, point: &Point) -> f64 {
    let camera = &cameras[observation.view];
    let depth = (camera.row(2) * point).x;
    // A direction, with `w` of zero, is oriented as it is.
    let depth = if point.w < 0.0 { -depth } else { depth };
    if depth > 0.0 { triangulation::weighted_squared(camera, point, observation) } else { f64::INFINITY }
}

/// Squared residuals, each of the gate at most; given up once they reach `to_beat`.
fn truncated(cameras: &[Camera], observations: &[Observation], point: &Point, gate: f64, to_beat: f64) -> f64 {
    let mut cost = 0.0;
    for observation in observations {
        cost += squared_in_front(cameras, observation, point).min(gate);
        if cost >= to_beat {
            break;
        }
    }
    cost
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::super::bundle::testing;
    use super::*;

    const GATE: f64 = 1e-4;

    /// Observations of one point, some of them moved far away.
    fn observations(scene: &testing::TestScene, point: usize, wrong: &[usize]) -> Vec<Observation> {
        let of_point = scene.observations.iter().filter(|seen| seen.point == point);
        let mut observations: Vec<Observation> = of_point.copied().collect();
        for &k in wrong {
            observations[k].xy += Vector2::new(0.2 + 0.05 * k as f64, -0.15 - 0.07 * k as f64);
        }
        observations
    }

    #[test]
    fn a_run_of_three_is_found_among_wrong_observations() {
        for seed in 0..20 {
            let scene = testing::scene(seed, 8, 10, 1e-3);
            let cameras = scene.cameras();
            for wrong in [vec![], vec![3], vec![0, 1], vec![0, 1, 5, 6, 7]] {
                let observations = observations(&scene, seed as usize % 10, &wrong);
                let found = Triangulator::new(&cameras).robust(&observations, GATE).expect("a point");
                let expected: Vec<bool> = (0..8).map(|k| !wrong.contains(&k)).collect();
                assert_eq!(found.agrees, expected, "seed {seed}, wrong {wrong:?}");
            }
        }
    }

    #[test]
    fn what_no_two_observations_agree_on_is_no_point() {
        let scene = testing::scene(3, 2, 10, 0.0);
        let cameras = scene.cameras();
        assert_eq!(Triangulator::new(&cameras).robust(&observations(&scene, 0, &[])[..1], GATE), None);
        // A point behind both cameras.
        let behind: Vec<Camera> = cameras.iter().map(|camera| -camera).collect();
        assert_eq!(Triangulator::new(&behind).robust(&observations(&scene, 0, &[]), GATE), None);
    }
}
