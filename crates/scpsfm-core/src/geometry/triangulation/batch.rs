//! Tracks triangulated side by side: eight, or one.
//!
//! Tracks need not be seen by the same views: their `k`-th observations stand side by side, whatever the cameras. What
//! one comes to does not depend on its neighbours, to the last bit: a track that has arrived stands still while others
//! go on.

use super::f64xn::{DIAGONAL, F64xN, Mask, Points, Symmetric, choose, dot, normalised};
use crate::geometry::observation::Observation;
use crate::geometry::{Camera, Point};
use crate::simd::vectorised;

/// Tracks of a batch: two of the vectors of four that most processors have, so that one is computed with while the
/// other is on its way.
pub const LANES: usize = 8;

/// As many tracks as are worth their while side by side.
pub type Batch = SideBySide<LANES>;

/// Levenberg damping at the start of a refinement, relative to the diagonal.
const INITIAL_DAMPING: f64 = 1e-3;
/// Factors on the damping after a step that is taken, and after one that is not.
const DAMPING_DOWN: f64 = 0.2;
const DAMPING_UP: f64 = 10.0;
/// Gain below which a refinement has arrived: ranking and gates do not see a part in a thousand.
const RELATIVE_TOLERANCE: f64 = 1e-3;

#[inline(always)]
fn away_from_zero<const N: usize>(depth: F64xN<N>) -> F64xN<N> {
    depth.map(super::away_from_zero)
}

/// The `k`-th observation of every track.
#[derive(Clone, Copy)]
struct BatchedObservation<const N: usize> {
    /// The camera's columns, rows within.
    camera: [[F64xN<N>; 3]; 4],
    xy: [F64xN<N>; 2],
    /// That of the observation; 0 where the track has none, or does without it.
    weight: F64xN<N>,
}

impl<const N: usize> BatchedObservation<N> {
    /// The point's image, homogeneous.
    #[inline(always)]
    fn image(&self, point: &Points<N>) -> [F64xN<N>; 3] {
        let row = |r: usize| {
            let [a, b, c, d] = &self.camera;
            a[r] * point[0] + b[r] * point[1] + c[r] * point[2] + d[r] * point[3]
        };
        [row(0), row(1), row(2)]
    }

    #[inline(always)]
    fn squared_residual(&self, point: &Points<N>) -> F64xN<N> {
        let [x, y, z] = self.image(point);
        let nearness = away_from_zero(z).recip();
        let (x, y) = (x * nearness - self.xy[0], y * nearness - self.xy[1]);
        self.weight * (x * x + y * y)
    }
}

/// Up to `N` tracks.
pub struct SideBySide<const N: usize> {
    batched: Vec<BatchedObservation<N>>,
    tracks: usize,
}

/// A point for every track of a batch, and what it leaves.
#[derive(Debug, Clone, Copy)]
pub struct Triangulated<const N: usize> {
    points: Points<N>,
    costs: F64xN<N>,
}

impl<const N: usize> Triangulated<N> {
    /// The point of the `track`-th of the batch, of unit norm.
    pub fn point(&self, track: usize) -> Point {
        Point::new(self.points[0].0[track], self.points[1].0[track], self.points[2].0[track], self.points[3].0[track])
    }

    /// Its weighted sum of squared reprojection residuals.
    pub fn cost(&self, track: usize) -> f64 {
        self.costs.0[track]
    }

    /// These for the tracks of which `is_newer` says so, those before for the others.
    pub fn or(self, is_newer: impl Fn(usize) -> bool, before: Self) -> Self {
        let newer = std::array::from_fn(is_newer);
        Self { points: choose(newer, self.points, before.points), costs: self.costs.or(newer, before.costs) }
    }
}

impl<const N: usize> SideBySide<N> {
    /// These tracks, `N` at most; what is beyond is left out.
    pub fn new(cameras: &[Camera], tracks: &[&[Observation]]) -> Self {
        let longest = tracks.iter().map(|track| track.len()).max().unwrap_or(0);
        let nothing = BatchedObservation { camera: [[F64xN::ZERO; 3]; 4], xy: [F64xN::ZERO; 2], weight: F64xN::ZERO };
        let mut batched = vec![nothing; longest];
        for lane in 0..N {
            // A lane without a track repeats the first one, and a place without an observation has the camera of the
            // track's first: numbers that count nowhere, but are of a usual size.
            let Some(track) = tracks.get(lane).or(tracks.first()) else { continue };
            for (k, batched) in batched.iter_mut().enumerate() {
                let Some(seen) = track.get(k).or(track.first()) else { continue };
                let camera: &[[f64; 3]; 4] = cameras[seen.view].as_ref();
                for (lanes, entries) in batched.camera.iter_mut().zip(camera) {
                    for (lanes, entry) in lanes.iter_mut().zip(entries) {
                        lanes.0[lane] = *entry;
                    }
                }
                if k < track.len() {
                    batched.xy[0].0[lane] = seen.xy.x;
                    batched.xy[1].0[lane] = seen.xy.y;
                    batched.weight.0[lane] = seen.weight;
                }
            }
        }
        Self { batched, tracks: tracks.len().min(N) }
    }

    pub fn tracks(&self) -> usize {
        self.tracks
    }

    /// Does without the `k`-th observation of a track from now on.
    pub fn drop_observation(&mut self, track: usize, k: usize) {
        let BatchedObservation { weight, xy, .. } = &mut self.batched[k];
        // However far out it was: nothing times what has no end would be no number.
        (weight.0[track], xy[0].0[track], xy[1].0[track]) = (0.0, 0.0, 0.0);
    }

    /// Linear triangulation (Hartley & Zisserman, section 12.2): the unit 4-vector that is least inconsistent with
    /// `x (P3 X) = P1 X`, `y (P3 X) = P2 X` over all observations, each camera's rows scaled by the norm of its third.
    ///
    /// Of cameras that are all at the origin of the frame, which tell no depth, it is the direction, a point at
    /// infinity, but for the sign, which no residual tells.
    pub fn linear(&self) -> Triangulated<N> {
        vectorised(
            #[inline(always)]
            || {
                let points = self.null_vectors();
                Triangulated { points, costs: self.costs(&points) }
            },
        )
    }

    /// This point for every track.
    pub fn at(&self, point: &Point) -> Triangulated<N> {
        let points = [0, 1, 2, 3].map(|k| F64xN([point[k]; N]));
        Triangulated { points, costs: self.costs(&points) }
    }

    /// Refines the points of the tracks of which `is_wanted` says so by Levenberg-Marquardt on their weighted squared
    /// reprojection residuals, at most `iterations` steps; the others stay where they are. Never worse than the start.
    pub fn refine(
        &self,
        start: Triangulated<N>,
        is_wanted: impl Fn(usize) -> bool,
        iterations: usize,
    ) -> Triangulated<N> {
        let going = std::array::from_fn(|track| track < self.tracks && is_wanted(track));
        vectorised(
            #[inline(always)]
            || self.descend(start, going, iterations),
        )
    }

    /// Weighted squared reprojection residuals of the tracks' `k`-th observations, for each `k`; 0 of those that they
    /// do without.
    pub fn squared_residuals(&self, found: &Triangulated<N>) -> Vec<[f64; N]> {
        vectorised(
            #[inline(always)]
            || self.batched.iter().map(|seen| seen.squared_residual(&found.points).0).collect(),
        )
    }

    #[inline(always)]
    fn costs(&self, points: &Points<N>) -> F64xN<N> {
        let mut costs = F64xN::ZERO;
        for seen in &self.batched {
            costs += seen.squared_residual(points);
        }
        costs
    }

    #[inline(always)]
    fn null_vectors(&self) -> Points<N> {
        let mut normal = Symmetric::ZERO;
        for seen in &self.batched {
            let [a, b, c, d] = seen.camera;
            let of_direction = a[2] * a[2] + b[2] * b[2] + c[2] * c[2];
            let of_all = of_direction + d[2] * d[2];
            let weight = seen.weight / (of_direction + of_all * f64::EPSILON).map(|sum| sum.max(f64::MIN_POSITIVE));
            for axis in [0, 1] {
                let coordinate = seen.xy[axis];
                let row = [
                    a[2] * coordinate - a[axis],
                    b[2] * coordinate - b[axis],
                    c[2] * coordinate - c[axis],
                    d[2] * coordinate - d[axis],
                ];
                normal.add_square(weight, row);
            }
        }
        normal.hold_unseen();
        let vector = normal.null_vectors();
        let known = dot(vector, vector).0.map(f64::is_finite);
        choose(known, vector, [F64xN::ZERO, F64xN::ZERO, F64xN::ZERO, F64xN::ONE])
    }

    #[inline(always)]
    fn descend(&self, start: Triangulated<N>, mut going: Mask<N>, iterations: usize) -> Triangulated<N> {
        let Triangulated { mut points, mut costs } = start;
        let mut damping = F64xN::ONE * INITIAL_DAMPING;
        for _ in 0..iterations {
            if going == [false; N] {
                break;
            }
            let mut normal = Symmetric::ZERO;
            let mut gradient = [F64xN::ZERO; 4];
            for seen in &self.batched {
                let image = seen.image(&points);
                let nearness = away_from_zero(image[2]).recip();
                let [a, b, c, d] = &seen.camera;
                for axis in [0, 1] {
                    let projected = image[axis] * nearness;
                    let slope = [
                        (a[axis] - projected * a[2]) * nearness,
                        (b[axis] - projected * b[2]) * nearness,
                        (c[axis] - projected * c[2]) * nearness,
                        (d[axis] - projected * d[2]) * nearness,
                    ];
                    normal.add_square(seen.weight, slope);
                    let pull = seen.weight * (projected - seen.xy[axis]);
                    gradient[0] += slope[0] * pull;
                    gradient[1] += slope[1] * pull;
                    gradient[2] += slope[2] * pull;
                    gradient[3] += slope[3] * pull;
                }
            }
            // The scale of the homogeneous point is free: pin it.
            normal.add_square(normal.trace(), points);
            normal.hold_unseen();
            for diagonal in DIAGONAL {
                normal.0[diagonal] = normal.0[diagonal] * (F64xN::ONE + damping);
            }
            let step = normal.factor().solve(gradient);
            let candidates =
                normalised([points[0] - step[0], points[1] - step[1], points[2] - step[2], points[3] - step[3]]);
            let candidate_costs = self.costs(&candidates);
            let mut accepted = [false; N];
            for lane in 0..N {
                let (cost, candidate) = (costs.0[lane], candidate_costs.0[lane]);
                accepted[lane] = going[lane] && candidate < cost;
                damping.0[lane] *= if accepted[lane] { DAMPING_DOWN } else { DAMPING_UP };
                let has_arrived = accepted[lane] && cost - candidate < RELATIVE_TOLERANCE * cost;
                // Not a number: the system has no solution.
                going[lane] &= !(has_arrived || candidate.is_nan());
            }
            points = choose(accepted, candidates, points);
            costs = candidate_costs.or(accepted, costs);
        }
        Triangulated { points, costs }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::super::{linear, refine, reprojection, squared_residual};
    use super::*;

    const ITERATIONS: usize = 10;

    /// Cameras, and tracks of them: in all views or some, right or anywhere.
    fn tracks(count: usize, rng: &mut ChaCha8Rng) -> (Vec<Camera>, Vec<Vec<Observation>>) {
        let mut entry = || rng.random_range(-0.3..0.3);
        let cameras: Vec<Camera> = (0..12)
            .map(|_| {
                let turned = Camera::from_fn(|_, _| entry());
                turned + Camera::new(1.2, 0.0, 0.0, 0.0, 0.0, 1.2, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0)
            })
            .collect();
        let track = |_| {
            let point = Point::from_fn(|k, _| if k < 3 { rng.random_range(-1.0..1.0) } else { 1.0 });
            let (share, noise) = (rng.random_range(0.3..1.0), [0.0, 0.003, 0.5][rng.random_range(0..3)]);
            let seen: Vec<usize> = (0..cameras.len()).filter(|_| rng.random::<f64>() < share).collect();
            let mut shifted = || noise * rng.random_range(-1.0..1.0);
            let observation = |view: usize| {
                let image = cameras[view] * point;
                Observation::new(view, 0, image.xy() / image.z + Vector2::new(shifted(), shifted()))
            };
            seen.into_iter().map(observation).collect::<Vec<_>>()
        };
        let tracks = (0..count).map(track).filter(|track: &Vec<Observation>| track.len() >= 2).collect();
        (cameras, tracks)
    }

    fn sliced(tracks: &[Vec<Observation>]) -> Vec<&[Observation]> {
        tracks.iter().map(Vec::as_slice).collect()
    }

    #[test]
    fn many_come_to_what_each_comes_to_alone() {
        for seed in 0..10 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (cameras, tracks) = tracks(60, &mut rng);
            for chunk in tracks.chunks(LANES) {
                let batch = Batch::new(&cameras, &sliced(chunk));
                let start = batch.linear();
                let found = batch.refine(start, |track| track != 1, ITERATIONS);
                let residuals = batch.squared_residuals(&found);
                for (k, track) in chunk.iter().enumerate() {
                    let alone = linear(&cameras, track);
                    let expected = squared_residual(&cameras, &alone, track);
                    let apart = |found: f64, expected: f64| (found - expected).abs() > 1e-6 * expected + 1e-18;
                    assert!(!apart(start.cost(k), expected), "seed {seed}: {} {expected}", start.cost(k));
                    let (refined, least) = refine(&cameras, track, start.point(k), ITERATIONS);
                    let expected = if k == 1 { expected } else { least };
                    assert!(!apart(found.cost(k), expected), "seed {seed}: {} {expected}", found.cost(k));
                    if k != 1 {
                        assert!(found.point(k).dot(&refined).abs() > 1.0 - 1e-6, "seed {seed}");
                    }
                    for (seen, residuals) in track.iter().zip(&residuals) {
                        let squared = reprojection(&cameras[seen.view], &found.point(k), &seen.xy).norm_squared();
                        assert!(!apart(residuals[k], squared), "seed {seed}: {} {squared}", residuals[k]);
                    }
                }
            }
        }
    }

    /// To the last bit, and of what is dropped nothing is left.
    #[test]
    fn neighbours_and_dropped_observations_change_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (cameras, tracks) = tracks(LANES, &mut rng);
        let triangulated = |batch: &Batch| batch.refine(batch.linear(), |_| true, ITERATIONS);
        let together = triangulated(&Batch::new(&cameras, &sliced(&tracks)));
        for (k, track) in tracks.iter().enumerate() {
            let alone = triangulated(&Batch::new(&cameras, &[track]));
            assert_eq!((alone.point(0), alone.cost(0)), (together.point(k), together.cost(k)));
        }
        let mut longer: Vec<Vec<Observation>> = tracks.clone();
        let far = Observation::new(0, 0, Vector2::new(f64::MAX, 1e9));
        longer.iter_mut().enumerate().for_each(|(k, track)| track.insert(if k == 0 { 0 } else { track.len() }, far));
        let mut batch = Batch::new(&cameras, &sliced(&longer));
        for (k, track) in tracks.iter().enumerate() {
            batch.drop_observation(k, if k == 0 { 0 } else { track.len() });
        }
        for (k, track) in tracks.iter().enumerate() {
            let found = triangulated(&batch);
            assert_eq!((found.point(k), found.cost(k)), (together.point(k), together.cost(k)), "{}", track.len());
        }
    }

    #[test]
    fn nothing_and_nonsense_have_some_point() {
        let cameras = [Camera::zeros(), Camera::from_element(f64::NAN), Camera::identity()];
        assert_eq!(Batch::new(&cameras, &[]).tracks(), 0);
        assert!(Batch::new(&cameras, &[&[]]).linear().point(0).iter().all(|entry| entry.is_finite()));
        let seen: Vec<Observation> = (0..3).map(|view| Observation::new(view, 0, Vector2::new(0.1, 0.2))).collect();
        for views in [&seen[..1], &seen[..2], &seen[2..], &seen[..]] {
            let batch = Batch::new(&cameras, &[views]);
            let found = batch.refine(batch.linear(), |_| true, ITERATIONS);
            assert!(found.point(0).iter().all(|entry| entry.is_finite()), "{views:?}: {found:?}");
        }
    }
}
