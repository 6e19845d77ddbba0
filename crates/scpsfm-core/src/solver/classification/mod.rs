//! The last word on every track and observation, under the final geometry and noise.
//!
//! A right observation has a core of Gaussian noise and a tail of three times that width; a wrong one may be anywhere
//! in the image. A track is judged by what it retains once observations that are more likely wrong than right are
//! dropped, at a price for each.

mod track_classifier;

use crate::domain::result::{ObservationResults, TrackResults};
use crate::domain::{Input, LeftOut};
use crate::geometry::bundle::metric::Intrinsics;
use crate::geometry::observation::Observation;
use crate::geometry::robust_triangulation::{self, Triangulator};
use crate::geometry::triangulation::batch::LANES;
use crate::geometry::{Camera, Point};
use crate::solver::consensus::LEAST_VIEWS;
use crate::solver::noise_model::NoiseModel;
use crate::solver::per_track::{BATCH, TRACKS_A_RUN, WORTH_A_THREAD};
use crate::solver::problem::{LEAST_RETAINED_SHARE, Problem};
use track_classifier::TrackClassifier;

options! {
    /// How tracks are judged by their residuals.
    pub struct ClassificationOptions {
        /// Share of the observations of right tracks that a view must keep under a calibration. Views of a second
        /// camera that was not declared kept .09 to .17 in one scene and .19 to .58 in another; the views of the first
        /// 120 scenes of `evaluate --photographed`, up to 70 % of whose tracks are wrong, .46 and more.
        least_kept_share: f64 = 0.33,
        /// Refinement steps of a point.
        point_steps: usize = 10,
        /// The same before an observation far beyond the gate is dropped. Which is the worst shows early, and of a
        /// wrong track four in ten observations are dropped one after the other.
        dropping_steps: usize = 4,
        /// Gates from which on the further steps bring no observation back. Twice the distance.
        far_gates: f64 = 4.0,
    }
}

const OPTIONS: ClassificationOptions = ClassificationOptions::DEFAULT;

/// The geometry to judge by, indexed by the input's views and tracks.
pub struct Geometry {
    /// Normalised pinhole of every view; `None`: not registered.
    pub cameras: Vec<Option<Camera>>,
    /// The lens of each view, whose distortion is undone before the cameras are asked; empty: all are pinholes.
    pub lenses: Vec<Intrinsics>,
    /// Whether a calibration is given, so that a point is in front of a camera or not.
    pub is_metric: bool,
    /// The component of each view, and the one that each track is in: components have frames of their own.
    pub component_of_view: Vec<u32>,
    pub component_of_track: Vec<u32>,
    /// Whether single observations may be wrong, for example after a wrong link: those that agree on one point
    /// are looked for then, however few they are beside the others, and weigh by their sigmas. The cameras must be
    /// metric, or oriented with the plane at infinity off the points. Otherwise the worst observation is dropped as
    /// long as it is too far from the point of the others.
    pub by_observation: bool,
    /// Core noise, one standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Prior probability that a track is right.
    pub inlier_share: f64,
    /// Whether it is of static tracks, which are no part of a reconstruction of others.
    pub of_static: bool,
}

impl Geometry {
    /// The observations of a track in the registered views of its component.
    pub fn of_track(&self, problem: &Problem, track: usize) -> Vec<usize> {
        let is_seen = |view: usize| {
            self.cameras[view].is_some() && self.component_of_view[view] == self.component_of_track[track]
        };
        problem.of_track(track).filter(|&k| is_seen(problem.view_of(k))).collect()
    }

    /// Observation `k` where a pinhole would see it; what a lens images nowhere stays where it is, far from any point.
    pub fn observation(&self, problem: &Problem, k: usize) -> Observation {
        let seen = problem.observation(k);
        let seen = Observation { weight: self.given_weight(problem, k), ..seen };
        self.lenses.get(seen.view).and_then(|lens| lens.undistorted(&seen)).unwrap_or(seen)
    }

    /// Weight of observation `k` by the sigma that it came with.
    pub fn given_weight(&self, problem: &Problem, k: usize) -> f64 {
        if self.by_observation { problem.weights[k] } else { 1.0 }
    }

    /// Share of its observations in registered views that a right track retains.
    fn least_share(&self, problem: &Problem) -> f64 {
        if self.by_observation { problem.least_share } else { LEAST_RETAINED_SHARE }
    }
}

/// Every track and observation of the input, judged. Points stay homogeneous, projective and normalised.
pub struct Judged {
    pub tracks: TrackResults,
    pub observations: ObservationResults,
    /// Retained observations of each inlier track, with views of the input.
    pub retained: Vec<Vec<Observation>>,
    pub points: Vec<Option<Point>>,
    /// The other points that linked tracks join, by track: one wrong link is enough.
    pub splits: Vec<TrackPoint>,
    /// The points of tracks that two registered views of one component see and that are more likely right than wrong,
    /// by track. This verifies nothing: two observations fit a point in three of their four coordinates, and a wrong
    /// track may be within the noise of the epipolar line by chance.
    pub two_view_points: Vec<TrackPoint>,
    /// The noise that everything was judged by.
    pub noise: NoiseModel,
}

/// A point that a track shows beside, or in place of, one that is verified.
pub struct TrackPoint {
    pub track: usize,
    /// As [`ObservationResults::split`] has it: 0 for the track's own point, the others from 1.
    pub number: u32,
    /// Probability that it is right.
    pub weight: f64,
    pub point: Point,
    /// The observations that show it.
    pub retained: Vec<Observation>,
}

/// Judges every track that has three observations in registered views or more; the others, and static ones that the
/// geometry is not of, have weight 0 and no residuals. Tracks with two that are likely right are listed apart.
///
/// Twice: with a wide tail first, then with the tail that the tracks show which are right in all their observations.
/// Where there is none, a wrong observation is told from a right one nearer by: at 8 to 9 core deviations instead of 12
/// at .3 % noise.
///
/// Once `stop` fires the rest stays unjudged: nobody will look at the result. `progress` is called with how many
/// verdicts there are, up to two a track. How many threads there are changes nothing.
pub fn judge(problem: &Problem, geometry: &Geometry, progress: &mut dyn FnMut(usize)) -> Judged {
    let noise = NoiseModel::new(geometry.noise, problem.outlier_density);
    let judged = judge_under(problem, geometry, noise, progress);
    match noise.with_tail(&whole_tracks(problem, geometry, &judged)) {
        Some(noise) => judge_under(problem, geometry, noise, &mut |tracks| progress(problem.tracks() + tracks)),
        None => judged,
    }
}

/// Weighted squared residuals, in core variances, of the tracks that are right as a whole: a track with a dropped
/// observation may be wrong in others.
fn whole_tracks(problem: &Problem, geometry: &Geometry, judged: &Judged) -> Vec<f64> {
    (0..problem.tracks())
        .filter(|&track| judged.tracks.inlier[track])
        .filter(|&track| judged.retained[track].len() == problem.of_track(track).len())
        .flat_map(|track| problem.of_track(track))
        .filter_map(|k| {
            Some((geometry.given_weight(problem, k), judged.observations.residual_px[problem.input.caller_index(k)]?))
        })
        .map(|(weight, residual)| weight * (residual / problem.scale_px / geometry.noise).powi(2))
        .collect()
}

fn judge_under(problem: &Problem, geometry: &Geometry, noise: NoiseModel, progress: &mut dyn FnMut(usize)) -> Judged {
    let cameras = robust_triangulation::or_zeros(&geometry.cameras);
    let triangulator = Triangulator::new(&cameras);
    let least_share = geometry.least_share(problem);
    let classifier = TrackClassifier { problem, cameras: &cameras, triangulator, geometry, least_share, noise };
    let mut judged = Judged::nothing(problem.input, noise);
    let threads = problem.threads.if_worth(problem.tracks() >= WORTH_A_THREAD);
    for first in (0..problem.tracks()).step_by(BATCH) {
        let last = problem.tracks().min(first + BATCH);
        let side_by_side = |k: usize| match problem.stop.is_stopped() {
            true => Vec::new(),
            false => classifier.find(first + k * LANES..last.min(first + (k + 1) * LANES)),
        };
        let mut progress = |batches| progress(first + batches * LANES);
        let found = threads.map((last - first).div_ceil(LANES), TRACKS_A_RUN / LANES, side_by_side, &mut progress);
        found.iter().flatten().for_each(|finding| classifier.write(&mut judged, finding));
    }
    judged
}

impl Judged {
    /// The views that keep too few of the observations of right tracks, each with how many of them it has and keeps:
    /// the pose of a view behind another lens than its own agrees with a few of its points. None where most views do
    /// so, which then are more likely right than what judged them, or where too few views would be left.
    pub fn contradicted_views(&self, problem: &Problem) -> Vec<(usize, LeftOut)> {
        let of_view = |view: usize| {
            let seen = problem.of_view[view].iter().map(|&k| k as usize);
            let right = seen.filter(|&k| self.tracks.inlier[problem.track_of(k)]);
            let right = right.map(|k| problem.input.caller_index(k));
            let judged: Vec<usize> = right.filter(|&k| self.observations.residual_px[k].is_some()).collect();
            let kept = judged.iter().filter(|&&k| self.observations.inlier[k]).count();
            (!judged.is_empty()).then_some((view, judged.len(), kept))
        };
        let views: Vec<(usize, usize, usize)> = (0..problem.views()).filter_map(of_view).collect();
        let registered = views.len();
        let few = |(view, points, kept): (usize, usize, usize)| {
            let reason = LeftOut::NotRegistered { points: points as u32, agreeing: kept as u32 };
            ((kept as f64) < OPTIONS.least_kept_share * points as f64).then_some((view, reason))
        };
        let found: Vec<(usize, LeftOut)> = views.into_iter().filter_map(few).collect();
        let left = registered - found.len();
        if left < found.len().max(LEAST_VIEWS) { Vec::new() } else { found }
    }

    /// Nothing judged yet.
    fn nothing(input: &Input, noise: NoiseModel) -> Self {
        let count = input.track_count();
        Self {
            tracks: TrackResults::unjudged(count),
            observations: ObservationResults::unjudged(input.observation_count()),
            retained: vec![Vec::new(); count],
            points: vec![None; count],
            splits: Vec::new(),
            two_view_points: Vec::new(),
            noise,
        }
    }
}
