//! What a solve returns. An unsolvable scene is a result with its reason, not an error.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::digest::Sha256Digest;
use super::joined_tracks::JoinedTracks;
use super::left_out::{self, LeftOut};
use super::progress::{Progress, Stage};
use super::second_structure::SecondStructure;
use super::settings::{Method, Proposal};
use super::warning::{Warning, WarningCode};

/// Observations from which on a track may be verified: two make a point, and one more verifies it.
pub const VERIFIED: usize = 3;

/// Views that a reconstruction needs: fewer carry no calibration, and nothing verifies their tracks.
pub const LEAST_VIEWS: usize = 3;

/// Whether a reconstruction stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Status {
    Solved,
    /// No consensus that geometry can verify; the reason is among the warnings.
    NoReconstruction,
}

named! {
    /// How far a calibration can be relied on, from the standard deviation of the log of the focal length.
    pub enum Grade {
        /// sigma < .02
        Metric = "METRIC",
        /// .02 <= sigma <= .1
        Weak = "WEAK",
        /// sigma > .1, or a motion or scene that carries no calibration: only the projective part is to be used.
        ProjectiveOnly = "PROJECTIVE_ONLY",
    }
}

impl Grade {
    /// The one of the two that promises less.
    pub fn worse(self, other: Self) -> Self {
        match (self, other) {
            (Grade::ProjectiveOnly, _) | (_, Grade::ProjectiveOnly) => Grade::ProjectiveOnly,
            (Grade::Weak, _) | (_, Grade::Weak) => Grade::Weak,
            _ => Grade::Metric,
        }
    }

    /// Whether it promises no less.
    pub fn is_no_worse_than(self, other: Self) -> bool {
        self.worse(other) == other
    }
}

/// How a lens images the angle from its optical axis, before distortion.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum LensProjection {
    /// By its tangent.
    #[default]
    Perspective,
    /// By the angle itself.
    Fisheye,
}

/// Intrinsics of one camera group, with their uncertainty.
///
/// A point at `(u, v, 1)` in camera coordinates, with `r^2 = u^2 + v^2` and `s = 1 + k1 r^2 + k2 r^4 + k3 r^6`, is
/// imaged at `x = f (u s + 2 p1 u v + p2 (r^2 + 2 u^2)) + px`, `y = aspect f (v s + p1 (r^2 + 2 v^2) + 2 p2 u v) + py`:
/// Brown's model (1971) under OpenCV's names. Behind a fisheye `s = t (1 + k1 t^2 + k2 t^4 + k3 t^6) / r` with the
/// angle `t = atan r` from the optical axis, and p1, p2 are 0: Kannala and Brandt's model (2006), OpenCV's fisheye. A
/// coefficient is 0 (all: a pinhole, or an equidistant fisheye) unless the data asked for more.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// The group, by the input's number.
    pub camera_group: u32,
    /// Horizontal focal length; the geometric mean where every view has its own, see [`ViewResult::focal_px`].
    pub focal_px: f64,
    /// One standard deviation of the natural logarithm of the focal length; `None`: unobservable (infinite). Where
    /// every view has its own, the root mean square over the views that have one.
    pub sigma_log_focal: Option<f64>,
    pub principal_point_px: [f64; 2],
    /// Vertical over horizontal focal length; 1 (square pixels) unless the data asked for more.
    pub aspect: f64,
    pub lens_projection: LensProjection,
    /// Radial distortion: the first coefficient, `k1`.
    pub radial_k1: f64,
    /// The second coefficient, `k2`.
    pub radial_k2: f64,
    /// The third coefficient, `k3`.
    pub radial_k3: f64,
    /// Tangential distortion: the first coefficient, `p1`.
    pub tangential_p1: f64,
    /// The second coefficient, `p2`.
    pub tangential_p2: f64,
    /// How far the group's own calibration can be relied on; that of the result is the worst of its groups. `None`: it
    /// has too few views of its own.
    pub grade: Option<Grade>,
    /// Of the intrinsics beside the focal length.
    pub sigmas: Sigmas,
}

/// One standard deviation of each intrinsic that was estimated beside the focal length, in the unit of the intrinsic.
///
/// They come of the covariance that [`Calibration::sigma_log_focal`] comes of, the doubt about the model included, and
/// what raises that one (a model that does not fit, a contradicted prior, views that disagree) raises them in the same
/// proportion. `None`: it was not estimated, see [`Calibration`] for the value that it was taken to have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Sigmas {
    pub principal_point_px: Option<[f64; 2]>,
    pub aspect: Option<f64>,
    pub radial_k1: Option<f64>,
    pub radial_k2: Option<f64>,
    pub radial_k3: Option<f64>,
    pub tangential_p1: Option<f64>,
    pub tangential_p2: Option<f64>,
}

impl Calibration {
    /// Of group 0, with square pixels, no distortion and no uncertainty.
    pub fn pinhole(focal_px: f64, principal_point_px: [f64; 2]) -> Self {
        Self {
            camera_group: 0,
            focal_px,
            sigma_log_focal: None,
            principal_point_px,
            aspect: 1.0,
            lens_projection: LensProjection::Perspective,
            radial_k1: 0.0,
            radial_k2: 0.0,
            radial_k3: 0.0,
            tangential_p1: 0.0,
            tangential_p2: 0.0,
            grade: None,
            sigmas: Sigmas::default(),
        }
    }

    /// Where the lens puts a point at `(u, v, 1)` in camera coordinates: the distorted point at unit depth, which focal
    /// length, aspect and principal point then take to pixels.
    pub fn distort(&self, u: f64, v: f64) -> [f64; 2] {
        let squared = u * u + v * v;
        let polynomial =
            |squared: f64| 1.0 + squared * (self.radial_k1 + squared * (self.radial_k2 + squared * self.radial_k3));
        let s = match self.lens_projection {
            LensProjection::Fisheye if squared > 0.0 => {
                let (radius, angle) = (squared.sqrt(), squared.sqrt().atan());
                angle / radius * polynomial(angle * angle)
            }
            LensProjection::Perspective | LensProjection::Fisheye => polynomial(squared),
        };
        let (p1, p2) = match self.lens_projection {
            LensProjection::Perspective => (self.tangential_p1, self.tangential_p2),
            LensProjection::Fisheye => (0.0, 0.0),
        };
        [
            u * s + 2.0 * p1 * u * v + p2 * (squared + 2.0 * u * u),
            v * s + p1 * (squared + 2.0 * v * v) + 2.0 * p2 * u * v,
        ]
    }
}

/// One view of the result.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewResult {
    /// The view's name in the input.
    pub name: Option<Box<str>>,
    /// 3x4 projective camera in pixels, row by row, in the frame `P1 = [I|0]` of the first registered view of
    /// its part. `None`: the view is not registered.
    pub projection: Option<[[f64; 4]; 3]>,
    /// Metric pose: `x ~ K (R X + t)`; row by row. `None` where there is no metric reconstruction, and for a view that
    /// should have a focal length of its own and whose observations do not determine it.
    pub rotation: Option<[[f64; 3]; 3]>,
    pub translation: Option<[f64; 3]>,
    /// The view's own focal length; `None` where that of the calibration is every view's, and where there is no pose.
    pub focal_px: Option<f64>,
    /// Which reconstruction the view belongs to, the largest first: views that share no tracks have frames and scales
    /// of their own. 0 where there is one, and for views that are not registered.
    pub part: u32,
    /// The view's camera group, by the input's number.
    pub camera_group: u32,
    /// Why the view is not registered; `None` where it is, and where nothing was reconstructed.
    pub left_out: Option<LeftOut>,
}

/// What the geometry says of every track of the input (parallel arrays, one entry a track).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrackResults {
    /// AUTO, GEOMETRY: probability that the track is an inlier, under `UNVERIFIED_RANKING` by the trained
    /// network alone; PAPER, SCPSFM: the network's own weight; PSFM: closeness to the subspace. 0 for tracks that were
    /// not judged.
    pub weight: Vec<f32>,
    /// Whether the track is right. By PAPER, SCPSFM and PSFM the method's own decision, given also where nothing is
    /// reconstructed; it is unverified then.
    pub inlier: Vec<bool>,
    /// What a network says of each track by itself (AUTO: the one trained beforehand, PAPER, SCPSFM: the paper's), 0
    /// for tracks that it was not shown; empty where none ran.
    pub network_weight: Vec<f32>,
    /// Point of each track: metric where the result is metric, else in the projective frame (dehomogenised).
    /// `None` for tracks that are not inliers.
    pub point: Vec<Option<[f64; 3]>>,
    /// Reconstruction in whose frame each track's point is, see [`ViewResult::part`]; empty: all are in that of part 0.
    pub part: Vec<u32>,
    /// Which of the rigid motions that `SECOND_STRUCTURE` reports each track, rejected, agrees with: from 1, 0 for
    /// none; empty where none is reported.
    pub second_structure: Vec<u32>,
}

impl TrackResults {
    /// Nothing judged of this many tracks.
    pub fn unjudged(count: usize) -> Self {
        Self { weight: vec![0.0; count], inlier: vec![false; count], point: vec![None; count], ..Self::default() }
    }

    /// The reconstruction that a track has a point in; `None` where it has none.
    pub fn part_of(&self, track: usize) -> Option<u32> {
        self.point.get(track)?.as_ref()?;
        Some(self.part.get(track).copied().unwrap_or(0))
    }
}

/// What the geometry says of every observation (parallel arrays in the caller's order).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ObservationResults {
    pub inlier: Vec<bool>,
    /// Reprojection error in pixels of the image, to first order where the lens distorts; `None` where the observation
    /// was not judged.
    pub residual_px: Vec<Option<f64>>,
    /// Probability that the observation shows its track's point, if the track is right: times the track's weight, that
    /// it is right. 0 where it was not judged.
    pub weight: Vec<f32>,
    /// 0, or which of the other points that its track joins the observation shows: see [`TrackSplit::number`]. Such an
    /// observation is no inlier of its track.
    pub split: Vec<u32>,
}

impl ObservationResults {
    /// Nothing judged of this many observations.
    pub fn unjudged(count: usize) -> Self {
        Self {
            inlier: vec![false; count],
            residual_px: vec![None; count],
            weight: vec![0.0; count],
            split: vec![0; count],
        }
    }
}

/// A point beside its own that a track shows, where a wrong link joined two: at least three of its observations agree
/// on it and on nothing else.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TrackSplit {
    /// Index of the track.
    pub track: u32,
    /// From 1 within a track.
    pub number: u32,
    /// Probability that the point is right.
    pub weight: f32,
    /// In the frame of [`TrackResults::point`]; `None`: at infinity.
    pub point: Option<[f64; 3]>,
}

/// A track that two registered views of one part see, and whose observations agree on a point, in front of both cameras
/// where these are metric: consistent, not verified. It is no inlier.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TwoViewTrack {
    /// Index of the track.
    pub track: u32,
    /// Probability that it is right by its residuals and by the share of right tracks among those that more views see:
    /// more than one half.
    pub weight: f32,
    /// Reconstruction whose views see it, see [`ViewResult::part`].
    pub part: u32,
    /// In the frame of [`TrackResults::point`]; `None`: at infinity.
    pub point: Option<[f64; 3]>,
}

/// Seconds spent in a stage.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StageTime {
    pub stage: Stage,
    pub seconds: f64,
}

/// How long a proposal, verified alone, took to a consensus as good as the accepted one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ProposalTime {
    pub proposal: Proposal,
    /// Seconds of that proposal's own work, proposing and verifying; `None`: it never did within the search.
    pub seconds: Option<f64>,
    /// Steps of its own that it had taken by then: iterations of the network, hypotheses of the others.
    pub steps: u32,
}

/// Result of a solve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Solution {
    pub status: Status,
    /// `None` without a reconstruction.
    pub grade: Option<Grade>,
    pub method: Method,
    /// Proposal whose sample led to the accepted consensus; `None` where nothing was accepted, or was found otherwise.
    pub winning_proposal: Option<Proposal>,
    /// Network iterations spent.
    pub iterations: u32,
    pub seed: u64,
    /// One entry a camera group with registered views, ascending; empty without a metric reconstruction: see
    /// [`Solution::is_metric`].
    pub calibrations: Vec<Calibration>,
    /// Plane at infinity `(n, 1)` in pixels and in the frame `P1 = [I|0]` of the first registered view.
    pub plane_at_infinity: Option<[f64; 3]>,
    /// One entry a view of the input.
    pub views: Vec<ViewResult>,
    pub tracks: TrackResults,
    pub observations: ObservationResults,
    /// The other points of tracks that join several, by track and number.
    pub splits: Vec<TrackSplit>,
    /// Tracks that two registered views of one part see and that are consistent with these, by track.
    pub two_view_tracks: Vec<TwoViewTrack>,
    /// The rigid motions that `SECOND_STRUCTURE` reports, by number.
    pub second_structures: Vec<SecondStructure>,
    /// Estimated observation noise, one standard deviation of a coordinate, in pixels.
    pub noise_px: Option<f64>,
    /// Root mean square and mean of the reprojection errors (distances) over the inlier observations, in pixels.
    pub reprojection_rms_px: Option<f64>,
    pub reprojection_mean_px: Option<f64>,
    pub warnings: Vec<Warning>,
    pub seconds: f64,
    pub stages: Vec<StageTime>,
    /// Debug output: what each proposal alone would have needed.
    pub proposal_times: Vec<ProposalTime>,
    /// Curves for the report: progress records thinned to at most [`Solution::MAX_HISTORY`].
    pub history: Vec<Progress>,
    /// Of the trained network that AUTO had at hand; `None` where it was not to be asked.
    pub trained_network_sha256: Option<Sha256Digest>,
    /// [`RawInput::sha256`](super::RawInput::sha256) of the input; `None` before it was hashed.
    pub input_content_sha256: Option<Sha256Digest>,
    /// Which keypoint each observation is, of an input that was joined from matches; `None` for others.
    pub joined_tracks: Option<JoinedTracks>,
}

impl Solution {
    /// The least and the largest focal length where every view has its own; `None` where none is told.
    pub fn view_focals_px(&self) -> Option<(f64, f64)> {
        let mut own = self.views.iter().filter_map(|view| view.focal_px).filter(|px| px.is_finite());
        let first = own.next()?;
        Some(own.fold((first, first), |(low, high), px| (low.min(px), high.max(px))))
    }

    /// Whether it is metric and shows no depth: the camera only turned, and the tracks have no points.
    pub fn is_without_depth(&self) -> bool {
        let turned = self.warnings.iter().any(|warning| warning.code == WarningCode::PureRotation);
        turned && self.is_metric() && self.tracks.point.iter().all(Option::is_none)
    }

    /// Whether there is a metric reconstruction. Without one (above all under [`Grade::ProjectiveOnly`]) no calibration
    /// and no pose is given, and the points are in the frame of the projective cameras.
    pub fn is_metric(&self) -> bool {
        !self.calibrations.is_empty()
    }

    /// Whether the scene was solved and yet says nothing of the focal length: its standard deviation is infinite.
    pub fn is_focal_unobservable(&self) -> bool {
        match self.calibrations.as_slice() {
            [] => self.grade == Some(Grade::ProjectiveOnly),
            calibrations => calibrations.iter().all(|calibration| calibration.sigma_log_focal.is_none()),
        }
    }

    /// Points of the curves in a report; more than a plot has pixels for is waste.
    pub const MAX_HISTORY: usize = 500;

    /// The camera groups of the views, ascending, each with its calibration.
    pub fn cameras(&self) -> Vec<(u32, Option<&Calibration>)> {
        let groups: BTreeSet<u32> = self.views.iter().map(|view| view.camera_group).collect();
        groups.into_iter().map(|group| (group, self.calibration_of(group))).collect()
    }

    /// The calibration of a camera group; `None`: no view of it is registered, or nothing is metric.
    pub fn calibration_of(&self, camera_group: u32) -> Option<&Calibration> {
        self.calibrations.iter().find(|calibration| calibration.camera_group == camera_group)
    }

    /// How many reconstructions there are, each with a frame of its own.
    pub fn part_count(&self) -> u32 {
        self.registered_views().into_iter().map(|view| self.views[view].part + 1).max().unwrap_or(0)
    }

    /// Indices of the registered views.
    pub fn registered_views(&self) -> Vec<usize> {
        (0..self.views.len()).filter(|&i| self.views[i].projection.is_some()).collect()
    }

    /// What to say of the views that take no part, see [`left_out::warnings`]; `name` names a view by its index.
    pub fn left_out_warnings(&self, name: impl Fn(usize) -> String) -> Vec<Warning> {
        let reasons: Vec<Option<LeftOut>> = self.views.iter().map(|view| view.left_out).collect();
        left_out::warnings(&reasons, name)
    }

    pub fn inlier_track_count(&self) -> usize {
        self.tracks.inlier.iter().filter(|&&inlier| inlier).count()
    }

    pub fn inlier_observation_count(&self) -> usize {
        self.observations.inlier.iter().filter(|&&inlier| inlier).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_files() {
        for grade in [Grade::Metric, Grade::Weak, Grade::ProjectiveOnly] {
            assert_eq!(serde_json::to_value(grade).expect("serialisable"), grade.name());
        }
    }

    #[test]
    fn the_lens_is_browns() {
        let pinhole = Calibration::pinhole(900.0, [450.0, 600.0]);
        assert_eq!(pinhole.distort(0.5, -0.25), [0.5, -0.25]);
        let lens = Calibration {
            radial_k1: 0.5,
            radial_k2: -0.25,
            radial_k3: 2.0,
            tangential_p1: 0.125,
            tangential_p2: -0.0625,
            ..pinhole
        };
        // r^2 = 2 and s = 1 + 1 - 1 + 16 = 17. With v = 1 the shifts are .25 - .25 and .5 - .125, with v = -1 they are
        // -.25 - .25 and .5 + .125.
        assert_eq!(lens.distort(1.0, 1.0), [17.0, 17.375]);
        assert_eq!(lens.distort(1.0, -1.0), [16.5, -16.375]);
        // r^2 = 1 and s = 3.25: the shift along the axis is 3 p2, the one across it p1.
        assert_eq!(lens.distort(1.0, 0.0), [3.0625, 0.125]);
    }
}
