//! Cameras and points up to a common projective transform.

use nalgebra::{Matrix2, Matrix4, Vector2, Vector4};

use super::block::Block;
use super::consensus::{self, Consensus, LEAST_INLIERS, LEAST_VIEWS, NoiseOptions};
use super::noise_model::evidence;
use super::problem::Problem;
use super::view_selection::evenly;
use crate::geometry::bundle::projective;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::core_noise;
use crate::geometry::triangulation::weighted_squared;
use crate::geometry::{Camera, Point};

options! {
    /// What a reconstruction measures.
    pub struct ProjectiveOptions {
        /// Distance of a point from the line that fits a view best, in units of the noise, from which it lies off it.
        /// Points on a line are off by one; the noise is known to a factor of two.
        least_across: f64 = 4.0,
        /// Share of the points of a view that have to lie off it where they are few; of more, as many as verify a
        /// reconstruction by themselves. A line leaves six unknowns of a camera free, which fit three tracks or so.
        off_line_share: f64 = 0.25,
        /// Share of the points of a view that the line is fitted to, which are on it where most are.
        fitted_share: f64 = 0.5,
        /// The line is fitted again while that lowers the spread of its points to less than this share.
        settled: f64 = 0.95,
    }
}

const OPTIONS: ProjectiveOptions = ProjectiveOptions::DEFAULT;

/// Cameras and points up to a common projective transform, with the observations that agree with them.
#[derive(Debug, Clone)]
pub struct ProjectiveReconstruction {
    /// Registered views of the input, increasing.
    pub views: Vec<usize>,
    /// One a registered view.
    pub cameras: Vec<Camera>,
    /// Tracks of the input that have a point, increasing.
    pub tracks: Vec<usize>,
    pub points: Vec<Point>,
    /// Indices into `views` and `tracks`.
    pub observations: Vec<Observation>,
    /// One standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Tracks that a point was looked for of.
    pub tried: usize,
}

impl ProjectiveReconstruction {
    /// The inliers of a consensus, with all their observations.
    pub fn of_block(block: &Block, consensus: &Consensus) -> Self {
        let inliers = consensus.inliers();
        Self {
            views: block.views.clone(),
            cameras: consensus.cameras.clone(),
            tracks: inliers.iter().map(|&track| block.tracks[track]).collect(),
            points: inliers.iter().map(|&track| consensus.points[track]).collect(),
            observations: consensus::observations_of(&block.complete, &inliers),
            noise: consensus.noise,
            tried: block.tracks.len(),
        }
    }

    /// The same with the weights of the undone lens, so that the noise is that of the image.
    pub fn weighed(mut self, problem: &Problem) -> Self {
        if problem.undone.is_none() {
            return self;
        }
        for seen in &mut self.observations {
            let (view, track) = (self.views[seen.view], self.tracks[seen.point]);
            if let Some(k) = problem.seen_in(track, view) {
                seen.weight = problem.pinhole_observation(k).weight / problem.weights[k];
            }
        }
        let norms = self.squared_residuals().into_iter().map(f64::sqrt).collect();
        self.noise = core_noise(norms, self.unknowns()).unwrap_or(self.noise);
        self
    }

    fn unknowns(&self) -> usize {
        projective::unknowns(self.views.len(), self.tracks.len())
    }

    /// Whether enough points of three views or more lie off a line. Those on one measure one coordinate, where chance is
    /// reckoned with two, and leave the cameras free to fit a few points beside it, wherever these are.
    pub fn is_off_lines(&self) -> bool {
        let least_across = OPTIONS.least_across * NoiseOptions::DEFAULT.clamp(self.noise);
        let mut of_view = vec![Vec::new(); self.views.len()];
        self.observations.iter().for_each(|seen| of_view[seen.view].push(seen.xy));
        let is_off_line = |distances: &Vec<f64>| {
            let few = (OPTIONS.off_line_share * distances.len() as f64).ceil() as usize;
            let off = distances.iter().filter(|distance| **distance >= least_across).count();
            off >= LEAST_INLIERS.min(few).max(1)
        };
        of_view.into_iter().map(across).filter(is_off_line).count() >= LEAST_VIEWS
    }

    /// The tracks with most observations, evenly among equals: a calibration takes no more than these.
    pub fn most_observed(&self, most: usize) -> Self {
        let mut support = vec![0usize; self.tracks.len()];
        self.observations.iter().for_each(|seen| support[seen.point] += 1);
        let mut chosen: Vec<usize> = (0..self.tracks.len()).collect();
        if chosen.len() <= most {
            return self.clone();
        }
        // Evenly among equals, so that no end of the input is left out.
        chosen.sort_by_key(|&k| std::cmp::Reverse(support[k]));
        let last = support[chosen[most - 1]];
        let sure: Vec<usize> = chosen.iter().copied().filter(|&k| support[k] > last).collect();
        let equal: Vec<usize> = chosen.iter().copied().filter(|&k| support[k] == last).collect();
        let mut chosen = [evenly(&equal, most - sure.len()), sure].concat();
        chosen.sort_unstable();
        self.select(&chosen)
    }

    /// These of its tracks, increasing.
    fn select(&self, chosen: &[usize]) -> Self {
        let mut place = vec![usize::MAX; self.tracks.len()];
        chosen.iter().enumerate().for_each(|(new, &old)| place[old] = new);
        let kept = self.observations.iter().filter(|seen| place[seen.point] != usize::MAX);
        Self {
            views: self.views.clone(),
            cameras: self.cameras.clone(),
            tracks: chosen.iter().map(|&k| self.tracks[k]).collect(),
            points: chosen.iter().map(|&k| self.points[k]).collect(),
            observations: kept.map(|seen| Observation { point: place[seen.point], ..*seen }).collect(),
            noise: self.noise,
            tried: self.tried,
        }
    }

    /// How much better the observations fit than points anywhere in the image would, see [`evidence`].
    pub fn evidence(&self, outlier_density: f64) -> f64 {
        evidence(self.observations.len(), self.unknowns(), self.noise, outlier_density)
    }

    /// Squared reprojection residual of each observation, weighted.
    pub fn squared_residuals(&self) -> Vec<f64> {
        let squared = |seen: &Observation| weighted_squared(&self.cameras[seen.view], &self.points[seen.point], seen);
        self.observations.iter().map(squared).collect()
    }

    /// The same reconstruction in a frame in which "in front of the camera" means what it says: every camera and point
    /// at the sign at which depths are positive, and the mean principal plane at infinity, so that no point is there
    /// (Hartley & Zisserman, chapter 21: a quasi-affine frame).
    pub fn oriented(mut self) -> Self {
        let depth = |camera: &Camera, point: &Point| (camera.row(2) * point).x;
        let mut of_point = vec![0.0f64; self.points.len()];
        let mut of_camera = vec![0.0f64; self.cameras.len()];
        let signs: Vec<f64> = self
            .observations
            .iter()
            .map(|seen| depth(&self.cameras[seen.view], &self.points[seen.point]).signum())
            .collect();
        // The first camera decides; signs spread over what they share points with.
        if let Some(first) = of_camera.first_mut() {
            *first = 1.0;
        }
        for _ in 0..ORIENTATION_ROUNDS {
            vote(
                &mut of_point,
                self.observations.iter().zip(&signs).map(|(seen, sign)| (seen.point, sign * of_camera[seen.view])),
            );
            vote(
                &mut of_camera,
                self.observations.iter().zip(&signs).map(|(seen, sign)| (seen.view, sign * of_point[seen.point])),
            );
        }
        let sign = |sign: f64| if sign < 0.0 { -1.0 } else { 1.0 };
        self.cameras.iter_mut().zip(&of_camera).for_each(|(camera, own)| *camera *= sign(*own));
        self.points.iter_mut().zip(&of_point).for_each(|(point, own)| *point *= sign(*own));
        let plane: Vector4<f64> =
            self.cameras.iter().filter_map(|camera| camera.row(2).transpose().try_normalize(f64::MIN_POSITIVE)).sum();
        if let Some(frame) = frame_with_plane_at_infinity(&plane) {
            // The frame is orthogonal: its inverse is its transpose.
            self.cameras.iter_mut().for_each(|camera| *camera *= frame.transpose());
            self.points.iter_mut().for_each(|point| *point = frame * *point);
        }
        self
    }
}

/// Rounds after which every camera and point that observations join to the first has a sign.
const ORIENTATION_ROUNDS: usize = 6;

/// Sets each entry to the sign of the sum of its votes; without any it stays.
fn vote(signs: &mut [f64], votes: impl Iterator<Item = (usize, f64)>) {
    let mut sums = vec![0.0; signs.len()];
    votes.for_each(|(place, vote)| sums[place] += vote);
    for (sign, sum) in signs.iter_mut().zip(sums) {
        if sum != 0.0 {
            *sign = f64::signum(sum);
        }
    }
}

/// The orthogonal transform of points whose last coordinate is their distance from a plane; `None` of no plane.
fn frame_with_plane_at_infinity(plane: &Vector4<f64>) -> Option<Matrix4<f64>> {
    let plane = plane.try_normalize(f64::MIN_POSITIVE)?;
    // The reflection that takes the plane to the last axis (Householder).
    let last = Vector4::w();
    Some(match (plane - last).try_normalize(1e-12) {
        Some(normal) => Matrix4::identity() - 2.0 * normal * normal.transpose(),
        None => Matrix4::identity(),
    })
}

/// Distances of points from the line that fits half of them best (least trimmed squares, Rousseeuw 1984).
fn across(mut points: Vec<Vector2<f64>>) -> Vec<f64> {
    let fitted = (OPTIONS.fitted_share * points.len() as f64).ceil() as usize;
    let (mut count, mut before) = (points.len(), f64::INFINITY);
    loop {
        let Some(near) = points.get(..count).filter(|near| !near.is_empty()) else { return Vec::new() };
        let mean = near.iter().sum::<Vector2<f64>>() / count as f64;
        let covariance: Matrix2<f64> = near.iter().map(|xy| (xy - mean) * (xy - mean).transpose()).sum();
        let axes = (covariance / count as f64).symmetric_eigen();
        let least = axes.eigenvalues.imin();
        let spread = axes.eigenvalues[least].max(0.0).sqrt();
        let normal = axes.eigenvectors.column(least).into_owned();
        let distance = |xy: &Vector2<f64>| normal.dot(&(xy - mean)).abs();
        // Points that lie off the line of the others turn the first fits, and less each time.
        if spread >= OPTIONS.settled * before {
            return points.iter().map(distance).collect();
        }
        points.select_nth_unstable_by(fitted - 1, |a, b| f64::total_cmp(&distance(a), &distance(b)));
        (count, before) = (fitted, spread);
    }
}
