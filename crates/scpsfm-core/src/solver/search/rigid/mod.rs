//! Search with depths by rigidity: two right tracks are equally far apart in every view.
//!
//! Where the depths are true up to one common scale, track j of view i is the point `d_ij (x/f, y/f, 1)` of that
//! camera's frame (principal point in the origin, square pixels, one focal length f), and the squared distance of two
//! tracks is `g a_i + b_i` with `g = 1/f^2`. Ten views leave eight constraints to a *pair*, where the column space of
//! the measurement matrix leaves none to four tracks: this search needs no sampling and finds four right tracks among
//! two hundred. Depths from epipolar geometry are true only up to a scale a view and a track: there nothing is
//! rigid, and the other searches remain.

mod graph;

use nalgebra::Vector3;

use graph::{Graph, Pair};

use super::options::RigidOptions;
use crate::domain::StopToken;
use crate::geometry::bundle::metric::{Intrinsics, Pose};
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::procrustes::{generalised, mean_position};
use crate::geometry::statistics::{DEVIATION_PER_MEDIAN, chi_square_gate, median};
use crate::geometry::{Camera, Point};
use crate::solver::a_contrario::ln_false_alarms_of;

const OPTIONS: RigidOptions = RigidOptions::DEFAULT;
/// Tracks that leave six unknowns a view determined, with one to verify.
pub const LEAST_TRACKS: usize = 4;

/// A rigid shape with the tracks that belong to it.
#[derive(Debug, Clone)]
pub struct Rigid {
    pub focal: f64,
    pub poses: Vec<Pose>,
    /// Position of every track of the block.
    pub points: Vec<Vector3<f64>>,
    /// Sum of squared residuals of every track: two image coordinates and the relative depth a view.
    pub squared: Vec<f64>,
    pub inlier: Vec<bool>,
    /// Sum over the tracks of the squared residual over its gate, at most 1 each.
    pub cost: f64,
}

impl Rigid {
    pub fn inlier_count(&self) -> usize {
        self.inlier.iter().filter(|&&inlier| inlier).count()
    }

    /// The cameras `K [R|t]`.
    pub fn cameras(&self) -> Vec<Camera> {
        let intrinsics = Intrinsics::from_focal(self.focal);
        self.poses.iter().map(|pose| pose.camera(&intrinsics)).collect()
    }

    pub fn homogeneous_points(&self) -> Vec<Point> {
        self.points.iter().map(|point| point.push(1.0)).collect()
    }

    /// Constraints that the inliers leave over: three coordinates a view and track, less poses, points and focal
    /// length.
    fn constraints(&self) -> f64 {
        let (views, inliers) = (self.poses.len(), self.inlier_count());
        (3 * views * inliers) as f64 - (6 * views + 3 * inliers) as f64 + 5.0
    }

    fn inlier_cost(&self) -> f64 {
        self.squared.iter().zip(&self.inlier).filter(|(_, inlier)| **inlier).map(|(cost, _)| cost).sum()
    }

    /// Noise by the inliers' residuals, one standard deviation of a coordinate; `None` without constraints.
    pub fn noise(&self) -> Option<f64> {
        let constraints = self.constraints();
        (constraints > 0.0).then(|| (self.inlier_cost() / constraints).sqrt()).filter(|noise| noise.is_finite())
    }

    /// Natural logarithm of the expected number of false alarms; see `Consensus::ln_false_alarms_by_residuals`. Depths
    /// count as third coordinates.
    ///
    /// * `spread`: standard deviation of unstructured coordinates, image points and relative depths together
    pub fn ln_false_alarms(&self, spread: f64) -> f64 {
        let (tracks, inliers, constraints) = (self.inlier.len(), self.inlier_count(), self.constraints());
        let Some(rms) = self.noise() else { return f64::INFINITY };
        ln_false_alarms_of(tracks, inliers, constraints, rms, spread)
    }
}

/// The image points and depths of a block, ready to be searched.
pub struct RigidSearch<'a> {
    block: &'a CompleteBlock,
    /// `depths[track * views + view]`.
    depths: &'a [f64],
    median_depth: f64,
    /// Standard deviation of image coordinates and relative depths: what unstructured data would leave.
    spread: f64,
    stop: &'a StopToken,
}

impl<'a> RigidSearch<'a> {
    /// `None` where there are no depths, or too few tracks or views to be rigid.
    ///
    /// * `image_spread`: standard deviation of the image points, normalised units
    pub fn new(block: &'a CompleteBlock, image_spread: f64, stop: &'a StopToken) -> Option<Self> {
        let depths = block.depths()?;
        if block.views() < 3 || block.tracks() < LEAST_TRACKS {
            return None;
        }
        let median_depth = median(&mut depths.to_vec());
        if !(median_depth > 0.0 && median_depth.is_finite()) {
            return None;
        }
        let mut deviations: Vec<f64> = depths.iter().map(|depth| (depth / median_depth - 1.0).abs()).collect();
        let depth_spread =
            (DEVIATION_PER_MEDIAN * median(&mut deviations)).clamp(OPTIONS.depth_spreads.0, OPTIONS.depth_spreads.1);
        let spread = (image_spread.powi(2) * depth_spread).cbrt();
        Some(Self { block, depths, median_depth, spread, stop })
    }

    pub fn spread(&self) -> f64 {
        self.spread
    }

    /// The best rigid consensus with pairs rigid at this noise (normalised units); `None` where no four tracks are
    /// rigid. Ends at the first that is never chance.
    pub fn run(&self, noise: f64) -> Option<Rigid> {
        let all: Vec<usize> = (0..self.block.tracks()).collect();
        let graph = self.rigid_pairs(&all, noise)?;
        let mut best = None;
        for focal in graph.best_focals(OPTIONS.focals_grown) {
            let edges = graph.edges(focal);
            let mut covered = vec![false; all.len()];
            for _ in 0..OPTIONS.cores_grown {
                let core = edges.core(&covered);
                if core.len() < LEAST_TRACKS {
                    break;
                }
                core.iter().for_each(|&track| covered[track] = true);
                if self.improve(&mut best, focal, &core, noise) {
                    return best;
                }
            }
        }
        best
    }

    /// The best rigid consensus that grows from tracks that were chosen otherwise, at the focal lengths at which most
    /// pairs of them are rigid at this noise (normalised units); `None` where none grows. All of them are the core:
    /// in noise that hides which pairs are rigid, the gate drops what is wrong as it tightens.
    ///
    /// * `tracks`: of the block
    pub fn around(&self, tracks: &[usize], noise: f64) -> Option<Rigid> {
        if tracks.len() < LEAST_TRACKS {
            return None;
        }
        let mut best = None;
        for focal in self.rigid_pairs(tracks, noise)?.best_focals(OPTIONS.focals_grown) {
            if self.improve(&mut best, focal, tracks, noise) {
                break;
            }
        }
        best
    }

    /// Grows a consensus from a core and keeps it where it is less likely to be chance than the best one; true once
    /// that is never chance.
    fn improve(&self, best: &mut Option<Rigid>, focal: f64, core: &[usize], noise: f64) -> bool {
        for factor in OPTIONS.grown_noise {
            let Some(grown) = self.grow(focal, core.to_vec(), factor * noise) else { continue };
            let settled = self.settle(grown);
            let certainty = settled.ln_false_alarms(self.spread);
            if best.as_ref().is_none_or(|best| certainty < best.ln_false_alarms(self.spread)) {
                *best = Some(settled);
            }
            if certainty < OPTIONS.ln_never_chance {
                return true;
            }
        }
        false
    }

    /// The consensus refitted on this block, which may have more tracks and views than the one it was found on.
    ///
    /// * `support`: tracks of this block to fit
    pub fn refit(&self, found: &Rigid, support: &[usize]) -> Option<Rigid> {
        let noise = found.noise()?.max(OPTIONS.least_noise);
        self.grow(found.focal, support.to_vec(), noise).map(|grown| self.settle(grown))
    }

    /// Refits at the noise that the inliers show, while that makes chance less likely.
    fn settle(&self, found: Rigid) -> Rigid {
        let mut best = found;
        for _ in 0..OPTIONS.noise_rounds {
            let Some(settled) = best.noise().map(|noise| noise.max(OPTIONS.least_noise)) else { break };
            let support = (0..best.inlier.len()).filter(|&track| best.inlier[track]).collect();
            match self.grow(best.focal, support, settled) {
                Some(refitted) if refitted.ln_false_alarms(self.spread) < best.ln_false_alarms(self.spread) => {
                    best = refitted;
                }
                _ => break,
            }
        }
        best
    }

    /// A track in the frame of a view, at this focal length.
    fn position(&self, view: usize, track: usize, focal: f64) -> Vector3<f64> {
        let point = self.block.point(view, track);
        self.depth(view, track) * Vector3::new(point.x / focal, point.y / focal, 1.0)
    }

    fn depth(&self, view: usize, track: usize) -> f64 {
        self.depths[track * self.block.views() + view]
    }

    /// Statistics over the views of all pairs of some tracks, and how many are rigid at each focal length.
    fn rigid_pairs(&self, tracks: &[usize], noise: f64) -> Option<Graph> {
        let (views, count) = (self.block.views(), tracks.len());
        let tolerance = self.median_depth * (OPTIONS.pair_tolerance * noise + OPTIONS.grid_tolerance);
        let mut graph = Graph { tracks: count, tolerance, pairs: Vec::with_capacity(count * (count - 1) / 2) };
        for (k, &a) in tracks.iter().enumerate() {
            if self.stop.is_stopped() {
                return None;
            }
            for &b in &tracks[k + 1..] {
                let mut pair = Pair::default();
                for view in 0..views {
                    let (first, second) = (self.block.point(view, a), self.block.point(view, b));
                    let (near, far) = (self.depth(view, a), self.depth(view, b));
                    pair.add((near * first - far * second).norm_squared(), (near - far).powi(2));
                }
                graph.pairs.push(pair.divided(views as f64));
            }
        }
        Some(graph)
    }

    /// From a core to a consensus: fit and gate in turn, the gate tightening.
    fn grow(&self, focal: f64, core: Vec<usize>, noise: f64) -> Option<Rigid> {
        let (mut focal, mut support) = (focal, core);
        let mut best: Option<Rigid> = None;
        for (step, inflation) in OPTIONS.gates.into_iter().enumerate() {
            if self.stop.is_stopped() {
                break;
            }
            if step == 0 || step + 1 == OPTIONS.gates.len() {
                focal = self.best_focal(focal, &support);
            }
            let (poses, _) = self.fit(focal, &support)?;
            let judged = self.judge(focal, poses, noise);
            let gate = inflation * self.gate(noise);
            let next: Vec<usize> = (0..self.block.tracks()).filter(|&track| judged.squared[track] < gate).collect();
            if best.as_ref().is_none_or(|best| judged.cost < best.cost) {
                best = Some(judged);
            }
            if next.len() < LEAST_TRACKS {
                break;
            }
            support = next;
        }
        best.filter(|best| best.inlier_count() >= LEAST_TRACKS)
    }

    /// Gate of a track's squared residual.
    fn gate(&self, noise: f64) -> f64 {
        chi_square_gate((3 * self.block.views()) as f64 - 3.0) * noise * noise
    }

    /// Poses and positions of some tracks at a focal length.
    fn fit(&self, focal: f64, support: &[usize]) -> Option<(Vec<Pose>, Vec<Vector3<f64>>)> {
        let views = 0..self.block.views();
        let seen: Vec<Vec<Vector3<f64>>> = views
            .clone()
            .map(|view| support.iter().map(|&track| self.position(view, track, focal)).collect())
            .collect();
        let weights: Vec<Vec<f64>> =
            views.map(|view| support.iter().map(|&track| self.weight(view, track)).collect()).collect();
        generalised(&seen, &weights)
    }

    /// The noise of a position grows with its depth.
    fn weight(&self, view: usize, track: usize) -> f64 {
        let depth = self.depth(view, track);
        if depth.abs() > f64::MIN_POSITIVE { depth.powi(-2) } else { 0.0 }
    }

    /// The focal length near `focal` under which the support is most rigid.
    fn best_focal(&self, focal: f64, support: &[usize]) -> f64 {
        let count = support.len().min(OPTIONS.focal_tracks);
        let support: Vec<usize> = (0..count).map(|k| support[k * support.len() / count]).collect();
        let cost = |log_focal: f64| {
            let focal = log_focal.exp();
            let Some((poses, shape)) = self.fit(focal, &support) else { return f64::INFINITY };
            let squared = |(k, &track): (usize, &usize)| self.squared(&poses, &shape[k], track, focal);
            support.iter().enumerate().map(squared).sum()
        };
        golden_section(cost, focal.ln(), OPTIONS.focal_half_width, OPTIONS.focal_steps).exp()
    }

    /// Squared residual of a track at a position: image coordinates and relative depth, over all views.
    fn squared(&self, poses: &[Pose], position: &Vector3<f64>, track: usize, focal: f64) -> f64 {
        let residual = |(view, pose): (usize, &Pose)| {
            let seen = pose.apply(position);
            let image = focal * seen.xy() / seen.z - self.block.point(view, track);
            image.norm_squared() + (seen.z / self.depth(view, track) - 1.0).powi(2)
        };
        let squared: f64 = poses.iter().enumerate().map(residual).sum();
        if squared.is_finite() { squared } else { f64::MAX }
    }

    /// Every track of the block under these poses.
    fn judge(&self, focal: f64, poses: Vec<Pose>, noise: f64) -> Rigid {
        let views = self.block.views();
        let gate = self.gate(noise);
        let (mut points, mut squared) = (Vec::new(), Vec::new());
        for track in 0..self.block.tracks() {
            let seen: Vec<Vector3<f64>> = (0..views).map(|view| self.position(view, track, focal)).collect();
            let position = mean_position(&poses, seen.iter(), (0..views).map(|view| self.weight(view, track)));
            squared.push(self.squared(&poses, &position, track, focal));
            points.push(position);
        }
        let inlier = squared.iter().map(|&squared| squared < gate).collect();
        let cost = squared.iter().map(|&squared| (squared / gate).min(1.0)).sum();
        Rigid { focal, poses, points, squared, inlier, cost }
    }
}

/// Minimum of a function near `middle`, by golden section over `middle +- half_width`.
pub fn golden_section(cost: impl Fn(f64) -> f64, middle: f64, half_width: f64, steps: usize) -> f64 {
    let ratio = (5f64.sqrt() - 1.0) / 2.0;
    let (mut low, mut high) = (middle - half_width, middle + half_width);
    let (mut left, mut right) = (high - ratio * (high - low), low + ratio * (high - low));
    let (mut cost_left, mut cost_right) = (cost(left), cost(right));
    for _ in 0..steps {
        if cost_left < cost_right {
            (high, right, cost_right) = (right, left, cost_left);
            left = high - ratio * (high - low);
            cost_left = cost(left);
        } else {
            (low, left, cost_left) = (left, right, cost_right);
            right = low + ratio * (high - low);
            cost_right = cost(right);
        }
    }
    (low + high) / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Input, Limits};
    use crate::solver::a_contrario::FalseAlarmOptions;
    use crate::solver::{block, spread};
    use crate::synthetic::{Scene, SceneOptions};

    fn found(options: &SceneOptions) -> (Scene, Option<Rigid>, f64) {
        let scene = Scene::generate(options).expect("valid options");
        let input = Input::new(scene.input.clone(), &Limits::default(), "scene").expect("valid scene");
        let block = block::of_all_views(&input);
        let spread = spread::spread(&block.complete);
        let stop = StopToken::default();
        let search = RigidSearch::new(&block.complete, spread, &stop).expect("depths");
        let rigid = search.run(options.noise.max(0.001));
        let certainty = rigid.as_ref().map_or(0.0, |rigid| rigid.ln_false_alarms(search.spread()));
        (scene, rigid, certainty)
    }

    #[test]
    fn four_right_tracks_among_two_hundred_are_found() {
        for seed in 0..5 {
            let options = SceneOptions { outliers: 0.98, with_depths: true, seed, ..SceneOptions::default() };
            let (scene, rigid, certainty) = found(&options);
            let rigid = rigid.expect("four rigid tracks");
            assert!(certainty < FalseAlarmOptions::DEFAULT.ln_decisive, "seed {seed}: {certainty}");
            assert_eq!(rigid.inlier, scene.truth.inlier, "seed {seed}");
            let error = (rigid.focal * 1000.0 / scene.truth.focal_px).ln().abs();
            assert!(error < 0.1, "seed {seed}: {error}");
        }
    }

    #[test]
    fn where_nothing_is_rigid_nothing_is_certain() {
        for seed in 0..5 {
            let options = SceneOptions { outliers: 1.0, with_depths: true, seed, ..SceneOptions::default() };
            let (_, _, certainty) = found(&options);
            assert!(certainty > FalseAlarmOptions::DEFAULT.ln_decisive / 4.0, "seed {seed}: {certainty}");
        }
    }

    #[test]
    fn the_golden_section_finds_a_minimum() {
        let found = golden_section(|x| (x - 0.3).powi(2), 0.2, 0.5, 30);
        assert!((found - 0.3).abs() < 1e-5, "{found}");
    }
}
