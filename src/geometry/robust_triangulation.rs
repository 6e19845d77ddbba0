//! Points from tracks of which some observations are wrong.
//!
//! Tracks are linked from view to view: one wrong link parts a track into runs that are right each, so that
//! neighbouring observations make the hypotheses. Dropping the worst observation of a common fit would fail: wrong
//! links are far off and mask each other.

use nalgebra::Matrix3;

use super::fundamental::{Match, algebraic, matrix_of_cameras};
use super::measurement::Sighting;
use super::{Camera, Point, triangulation};

/// Sightings that a hypothesis is made of.
const RUNS: [usize; 2] = [3, 2];
/// Hypotheses of one length that a track has at most: of longer tracks every other start, or fewer.
const MOST_HYPOTHESES: usize = 30;
/// Refinement steps of a point.
const POINT_STEPS: usize = 8;
/// Gates a sighting beyond which the point of all sightings is not refined: no refinement makes them all agree.
const HOPELESS_GATES: f64 = 100.0;
/// Gates within which the squared Sampson distance of two sightings must be for both to agree with a point: it is the
/// least sum of their squared residuals, to first order.
const PAIR_GATES: f64 = 2.0;

/// Cameras that tracks are triangulated by, with the epipolar geometry of each with the next, which complete tracks ask
/// again and again.
pub struct Triangulator<'a> {
    cameras: &'a [Camera],
    to_next: Vec<Matrix3<f64>>,
}

/// A point and the sightings that agree with it.
#[derive(Debug, Clone, PartialEq)]
pub struct Robust {
    pub point: Point,
    /// One a sighting: within the gate and in front of the camera.
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
    /// * `gate`: squared residual within which a sighting agrees
    ///
    /// Returns `None` where no two sightings agree.
    pub fn robust(&self, sightings: &[Sighting], gate: f64) -> Option<Robust> {
        if sightings.len() < 2 {
            return None;
        }
        let cameras = self.cameras;
        let mut all = triangulation::linear(cameras, sightings);
        let hopeless = HOPELESS_GATES * gate * sightings.len() as f64;
        if triangulation::squared_residual(cameras, &all, sightings) < hopeless {
            all = triangulation::refine(cameras, sightings, all, POINT_STEPS).0;
            let agrees = agreeing(cameras, sightings, &all, gate);
            if agrees.iter().all(|&agrees| agrees) {
                return Some(Robust { point: all, agrees });
            }
        }
        let start = self.best_hypothesis(sightings, all, gate);
        let right = chosen(sightings, &agreeing(cameras, sightings, &start, gate));
        if right.len() < 2 {
            return None;
        }
        let (point, _) = triangulation::refine(cameras, &right, start, POINT_STEPS);
        let agrees = agreeing(cameras, sightings, &point, gate);
        (agrees.iter().filter(|&&agrees| agrees).count() >= 2).then_some(Robust { point, agrees })
    }

    /// The cheapest of the point of all sightings, of those of its runs and of that of its ends.
    ///
    /// A run of which two neighbours lie off each other's epipolar lines has no point: it is not triangulated.
    fn best_hypothesis(&self, sightings: &[Sighting], all: Point, gate: f64) -> Point {
        let mut best = (all, truncated(self.cameras, sightings, &all, gate, f64::INFINITY));
        let mut offer = |some: &[Sighting]| {
            let point = triangulation::linear(self.cameras, some);
            let cost = truncated(self.cameras, sightings, &point, gate, best.1);
            if cost < best.1 {
                best = (point, cost);
            }
        };
        let meets: Vec<bool> =
            sightings.windows(2).map(|pair| self.are_epipolar(&pair[0], &pair[1], PAIR_GATES * gate)).collect();
        for run in RUNS {
            let starts = (sightings.len() + 1).saturating_sub(run);
            for start in (0..starts).step_by(starts.div_ceil(MOST_HYPOTHESES).max(1)) {
                if meets[start..start + run - 1].iter().all(|&meets| meets) {
                    offer(&sightings[start..start + run]);
                }
            }
        }
        if let [first, .., last] = sightings
            && self.are_epipolar(first, last, PAIR_GATES * gate)
        {
            offer(&[*first, *last]);
        }
        best.0
    }

    /// Whether two sightings may be of one point.
    fn are_epipolar(&self, from: &Sighting, to: &Sighting, gate: f64) -> bool {
        let matrix = match to.view == from.view + 1 {
            true => self.to_next[from.view],
            false => matrix_of_cameras(&self.cameras[from.view], &self.cameras[to.view]),
        };
        let (error, gradient_squared) = algebraic(&matrix, &Match { from: from.xy, to: to.xy });
        // Cameras at one centre have no epipolar lines: then nothing is ruled out.
        error * error <= gate * gradient_squared
    }
}

fn chosen(sightings: &[Sighting], which: &[bool]) -> Vec<Sighting> {
    sightings.iter().zip(which).filter(|(_, chosen)| **chosen).map(|(sighting, _)| *sighting).collect()
}

fn agreeing(cameras: &[Camera], sightings: &[Sighting], point: &Point, gate: f64) -> Vec<bool> {
    sightings.iter().map(|sighting| squared_in_front(cameras, sighting, point) < gate).collect()
}

/// Squared residual, infinite behind the camera.
fn squared_in_front(cameras: &[Camera], sighting: &Sighting, point: &Point) -> f64 {
    let camera = &cameras[sighting.view];
    let depth = (camera.row(2) * point).x * point.w.signum();
    if depth > 0.0 { triangulation::reprojection(camera, point, &sighting.xy).norm_squared() } else { f64::INFINITY }
}

/// Squared residuals, each of the gate at most; given up once they reach `to_beat`.
fn truncated(cameras: &[Camera], sightings: &[Sighting], point: &Point, gate: f64, to_beat: f64) -> f64 {
    let mut cost = 0.0;
    for sighting in sightings {
        cost += squared_in_front(cameras, sighting, point).min(gate);
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

    fn cameras(scene: &testing::TestScene) -> Vec<Camera> {
        scene.poses.iter().map(|pose| pose.camera(&scene.intrinsics)).collect()
    }

    /// Observations of one point, some of them moved far away.
    fn sightings(scene: &testing::TestScene, point: usize, wrong: &[usize]) -> Vec<Sighting> {
        let of_point = scene.observations.iter().filter(|seen| seen.point == point);
        let mut sightings: Vec<Sighting> = of_point.map(|seen| Sighting { view: seen.camera, xy: seen.xy }).collect();
        for &k in wrong {
            sightings[k].xy += Vector2::new(0.2 + 0.05 * k as f64, -0.15 - 0.07 * k as f64);
        }
        sightings
    }

    #[test]
    fn a_run_of_three_is_found_among_wrong_observations() {
        for seed in 0..20 {
            let scene = testing::scene(seed, 8, 10, 1e-3);
            let cameras = cameras(&scene);
            for wrong in [vec![], vec![3], vec![0, 1], vec![0, 1, 5, 6, 7]] {
                let sightings = sightings(&scene, seed as usize % 10, &wrong);
                let found = Triangulator::new(&cameras).robust(&sightings, GATE).expect("a point");
                let expected: Vec<bool> = (0..8).map(|k| !wrong.contains(&k)).collect();
                assert_eq!(found.agrees, expected, "seed {seed}, wrong {wrong:?}");
            }
        }
    }

    #[test]
    fn what_no_two_sightings_agree_on_is_no_point() {
        let scene = testing::scene(3, 2, 10, 0.0);
        let cameras = cameras(&scene);
        assert_eq!(Triangulator::new(&cameras).robust(&sightings(&scene, 0, &[])[..1], GATE), None);
        // A point behind both cameras.
        let behind: Vec<Camera> = cameras.iter().map(|camera| -camera).collect();
        assert_eq!(Triangulator::new(&behind).robust(&sightings(&scene, 0, &[]), GATE), None);
    }
}
