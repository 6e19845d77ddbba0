//! The last word on every track and observation, under the final geometry and noise.
//!
//! A right observation has a core of Gaussian noise and a tail of three times that width; a wrong one may be anywhere
//! in the image. A track is judged by what it retains once observations that are more likely wrong than right are
//! dropped, at a price for each.

mod noise;
mod track_classifier;

pub use noise::{NoiseModel, outlier_density, working_gate};

use crate::domain::result::{ObservationResults, TrackResults};
use crate::domain::{Input, StopToken};
use crate::geometry::bundle::metric::Intrinsics;
use crate::geometry::measurement::Normalization;
use crate::geometry::observation::Observation;
use crate::geometry::robust_triangulation::Triangulator;
use crate::geometry::triangulation::batch::LANES;
use crate::geometry::{Camera, Point};
use crate::parallel::Threads;
use crate::solver::per_track::{BATCH, TRACKS_A_RUN, WORTH_A_THREAD};
use track_classifier::TrackClassifier;

/// The geometry to judge by.
pub struct Geometry<'a> {
    /// Projective camera of every view of the input, normalised; `None`: not registered.
    pub cameras: &'a [Option<Camera>],
    /// The frame of each view, and the one that each track is judged in.
    pub components: (&'a [u32], &'a [u32]),
    pub normalization: &'a Normalization,
    /// The lens of each view, whose distortion is undone before the cameras, pinholes, are asked; empty: all are
    /// pinholes.
    pub lenses: &'a [Intrinsics],
    /// Weight of each observation; see [`Observation::weight`]. Empty: all have 1.
    pub weights: &'a [f64],
    /// Whether tracks were linked from view to view, so that one wrong link joins two points: the observations that
    /// agree on one are looked for then, however few they are beside the others. The cameras must be metric, or
    /// oriented with the plane at infinity off the points. Otherwise the worst observation is dropped as long as it is
    /// too far from the point of the others.
    pub linked: bool,
    /// Share of its observations in registered views that a right track retains, see
    /// [`least_share`](crate::solver::problem::Problem::least_share).
    pub least_share: f64,
    /// Core noise, one standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Density of a wrong coordinate: one over the width of the points' distribution, normalised units.
    pub outlier_density: f64,
    /// Prior probability that a track is right.
    pub inlier_share: f64,
}

impl Geometry<'_> {
    /// Whether a track is judged by what a view saw of it.
    pub fn judges(&self, track: usize, view: usize) -> bool {
        self.cameras[view].is_some() && self.components.0[view] == self.components.1[track]
    }

    /// Observation `k` where a pinhole would see it; what a lens images nowhere stays where it is, far from any point.
    pub fn observation(&self, input: &Input, k: usize) -> Observation {
        let view = input.view_of(k);
        let xy = self.normalization.normalize(view, input.point_px(k));
        let undone = self.lenses.get(view).and_then(|lens| lens.undistort(&xy));
        let seen = Observation::new(view, input.track_of(k), undone.unwrap_or(xy));
        Observation { weight: self.weight(k), ..seen }
    }

    fn weight(&self, k: usize) -> f64 {
        self.weights.get(k).copied().unwrap_or(1.0)
    }
}

/// Every track and observation of the input, judged. Points stay homogeneous, projective and normalised.
pub struct Judged {
    pub tracks: TrackResults,
    pub observations: ObservationResults,
    /// Retained observations of each inlier track, with views of the input.
    pub retained: Vec<Vec<Observation>>,
    pub points: Vec<Option<Point>>,
    /// The other points that linked tracks join, by track.
    pub splits: Vec<SplitPoint>,
    /// The noise that everything was judged by.
    pub noise: NoiseModel,
}

/// A point beside its own that a track joins: one wrong link is enough.
pub struct SplitPoint {
    pub track: usize,
    /// From 1, as [`ObservationResults::split`] has it.
    pub number: u32,
    pub weight: f64,
    pub point: Point,
    /// The observations that show it.
    pub retained: Vec<Observation>,
}

/// Judges every track that has three observations in registered views or more; the others have weight 0 and no
/// residuals.
///
/// Twice: with a wide tail first, then with the tail that the tracks show which are right in all their observations.
/// Where there is none, a wrong observation is told from a right one nearer by: at 8 to 9 core deviations instead of 12
/// at .3 % noise.
///
/// Once `stop` fires the rest stays unjudged: nobody will look at the result. `progress` is called with how many
/// verdicts there are, up to two a track. How many threads there are changes nothing.
pub fn judge(
    input: &Input,
    ranges: &[usize],
    geometry: &Geometry,
    threads: Threads,
    stop: &StopToken,
    progress: &mut dyn FnMut(usize),
) -> Judged {
    let noise = NoiseModel::new(geometry.noise, geometry.outlier_density);
    let judged = judge_under(input, ranges, geometry, noise, threads, stop, progress);
    match noise.with_tail(&whole_tracks(input, ranges, geometry, &judged)) {
        Some(noise) => {
            let mut progress = |tracks| progress(input.track_count() + tracks);
            judge_under(input, ranges, geometry, noise, threads, stop, &mut progress)
        }
        None => judged,
    }
}

/// Weighted squared residuals, in core variances, of the tracks that are right as a whole: a track with a dropped
/// observation may be wrong in others.
fn whole_tracks(input: &Input, ranges: &[usize], geometry: &Geometry, judged: &Judged) -> Vec<f64> {
    (0..input.track_count())
        .filter(|&track| judged.tracks.inlier[track])
        .filter(|&track| judged.retained[track].len() == ranges[track + 1] - ranges[track])
        .flat_map(|track| ranges[track]..ranges[track + 1])
        .filter_map(|k| Some((geometry.weight(k), judged.observations.residual_px[input.caller_index(k)]?)))
        .map(|(weight, residual)| weight * (residual / geometry.normalization.scale_px / geometry.noise).powi(2))
        .collect()
}

fn judge_under(
    input: &Input,
    ranges: &[usize],
    geometry: &Geometry,
    noise: NoiseModel,
    threads: Threads,
    stop: &StopToken,
    progress: &mut dyn FnMut(usize),
) -> Judged {
    // Triangulation wants a slice; nothing is observed in unregistered views.
    let cameras: Vec<Camera> = geometry.cameras.iter().map(|camera| camera.unwrap_or_else(Camera::zeros)).collect();
    let triangulator = Triangulator::new(&cameras);
    let classifier = TrackClassifier { cameras: &cameras, triangulator, geometry, noise, stop };
    let mut judged = Judged::nothing(input, noise);
    let threads = threads.if_worth(input.track_count() >= WORTH_A_THREAD);
    for first in (0..input.track_count()).step_by(BATCH) {
        let last = input.track_count().min(first + BATCH);
        let side_by_side = |k: usize| match stop.is_stopped() {
            true => Vec::new(),
            false => classifier.find(input, ranges, first + k * LANES..last.min(first + (k + 1) * LANES)),
        };
        let mut progress = |batches| progress(first + batches * LANES);
        let found = threads.map((last - first).div_ceil(LANES), TRACKS_A_RUN / LANES, side_by_side, &mut progress);
        found.iter().flatten().for_each(|finding| classifier.write(&mut judged, finding));
    }
    judged
}

impl Judged {
    /// Nothing judged yet.
    fn nothing(input: &Input, noise: NoiseModel) -> Self {
        let count = input.track_count();
        Self {
            tracks: TrackResults::unjudged(count),
            observations: ObservationResults::unjudged(input.observation_count()),
            retained: vec![Vec::new(); count],
            points: vec![None; count],
            splits: Vec::new(),
            noise,
        }
    }
}
