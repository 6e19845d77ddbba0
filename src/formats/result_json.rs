//! What `result.json` holds. Field names and spellings are a contract: add, never rename.

use serde::Serialize;

use crate::domain::result::ProposalTime;
use crate::domain::second_structure::SecondStructureKind;
use crate::domain::{Calibration, Grade, Method, Solution, Status, Warning, WarningCode};

use super::intrinsics_json::IntrinsicsJson;
use super::track_counts::TrackCounts;
use super::{Label, LabelledInput, second_structures, warnings};

/// The summary of a result.
///
/// Infinity is not JSON: where the focal length is unobservable, `sigma_log_focal` is null and `focal_unobservable` is
/// true. That is so of every `PROJECTIVE_ONLY` result: it has no `focal_px`, no `principal_point_px`, no `aspect`, no
/// distortion and no `plane_at_infinity` either. Where nothing was calibrated for another reason,
/// `focal_unobservable` is null too.
#[derive(Debug, Clone, Serialize)]
pub struct ResultJson {
    pub status: Status,
    pub grade: Option<Grade>,
    /// Of the first camera group with registered views; see `cameras` where there are several.
    #[serde(flatten)]
    pub intrinsics: IntrinsicsJson,
    /// One entry a camera group, ascending.
    pub cameras: Vec<CameraGroupJson>,
    /// `(n, 1)` in pixels, in the frame `P1 = [I|0]` of the first registered view.
    pub plane_at_infinity: Option<[f64; 3]>,
    /// Counts.
    pub inlier_tracks: usize,
    pub inlier_observations: usize,
    /// Points beside its own that a track joins: each is one of its own in the exports.
    pub split_points: usize,
    /// Tracks that two registered views of one part see and that are consistent with these.
    pub two_view_tracks: usize,
    /// Tracks that too few registered views see for a verdict, and those that are wrong. Null: the
    /// file was written without the input, or there is no reconstruction.
    pub unclassified_tracks: Option<usize>,
    pub rejected_tracks: Option<usize>,
    /// The rigid motions that `SECOND_STRUCTURE` reports, by number.
    pub second_structures: Vec<SecondStructureCounts>,
    pub registered_views: usize,
    pub reprojection_rms_px: Option<f64>,
    pub reprojection_mean_px: Option<f64>,
    pub noise_px: Option<f64>,
    pub warnings: Vec<Warning>,
    pub method: Method,
    pub winning_proposal: Option<&'static str>,
    /// SHA-256 of the trained network that AUTO had at hand.
    pub trained_network_sha256: Option<String>,
    pub iterations: u32,
    pub seed: u64,
    pub seconds: f64,
    pub stages: Vec<StageJson>,
    pub proposal_times: Vec<ProposalTimeJson>,
    /// Version of the program that wrote the file.
    pub version: &'static str,
}

/// Intrinsics of one camera group. They are null where the group has no metric reconstruction: the result has none, or
/// no view of the group is registered.
#[derive(Debug, Clone, Serialize)]
pub struct CameraGroupJson {
    /// The input's number of the group.
    pub camera_group: u32,
    /// Views of the input, and how many of them are registered.
    pub views: usize,
    pub registered_views: usize,
    #[serde(flatten)]
    pub intrinsics: IntrinsicsJson,
    /// The group's own; that of the result is the worst of its groups that have enough views.
    pub grade: Option<Grade>,
    /// Codes of the warnings that are of this group, each once.
    pub warnings: Vec<WarningCode>,
}

/// A second structure; `second-structures.json` holds its poses and points.
#[derive(Debug, Clone, Serialize)]
pub struct SecondStructureCounts {
    /// As the column `second_structure` of `tracks.csv` has it.
    pub number: u32,
    /// Null: fewer than three views have poses, or it is a kind that this version does not know.
    pub kind: Option<SecondStructureKind>,
    /// Counts: its tracks, the views that have a pose against it, and its points.
    pub tracks: usize,
    pub views: usize,
    pub points: usize,
}

/// Seconds spent in a stage.
#[derive(Debug, Clone, Serialize)]
pub struct StageJson {
    pub name: &'static str,
    pub seconds: f64,
}

/// When a proposal, verified alone, would have sufficed.
#[derive(Debug, Clone, Serialize)]
pub struct ProposalTimeJson {
    pub proposal: &'static str,
    /// Null: it never did within the search.
    pub seconds: Option<f64>,
    pub steps: u32,
}

/// The camera groups of a result, ascending.
pub fn camera_groups(solution: &Solution) -> Vec<CameraGroupJson> {
    let without = || IntrinsicsJson {
        focal_unobservable: solution.is_focal_unobservable().then_some(true),
        ..IntrinsicsJson::default()
    };
    let entry = |(camera_group, calibration): (u32, Option<&Calibration>)| {
        let views = || solution.views.iter().filter(move |view| view.camera_group == camera_group);
        let registered_views = views().filter(|view| view.projection.is_some()).count();
        let mut codes: Vec<WarningCode> = Vec::new();
        for warning in solution.warnings.iter().filter(|warning| warning.camera_group == Some(camera_group)) {
            if !codes.contains(&warning.code) {
                codes.push(warning.code);
            }
        }
        CameraGroupJson {
            camera_group,
            views: views().count(),
            registered_views,
            intrinsics: calibration.map_or_else(without, IntrinsicsJson::from),
            grade: calibration.map_or(solution.grade.filter(|_| !solution.is_metric()), |of| of.grade),
            warnings: codes,
        }
    };
    solution.cameras().into_iter().map(entry).collect()
}

impl From<&ProposalTime> for ProposalTimeJson {
    fn from(time: &ProposalTime) -> Self {
        Self { proposal: time.proposal.name(), seconds: time.seconds, steps: time.steps }
    }
}

impl ResultJson {
    /// The summary of a solution; without the input, warnings name views by their numbers.
    pub fn new(solution: &Solution, input: Option<&LabelledInput>) -> Self {
        let cameras = camera_groups(solution);
        let first = cameras.iter().map(|camera| camera.intrinsics).find(|of| of.focal_px.is_some());
        let tracks = TrackCounts::new(solution, input);
        Self {
            status: solution.status,
            grade: solution.grade,
            intrinsics: IntrinsicsJson {
                focal_unobservable: (solution.is_metric() || solution.is_focal_unobservable())
                    .then(|| solution.is_focal_unobservable()),
                ..first.unwrap_or_default()
            },
            plane_at_infinity: solution.plane_at_infinity,
            inlier_tracks: tracks.inlier,
            inlier_observations: solution.inlier_observation_count(),
            split_points: solution.splits.len(),
            two_view_tracks: tracks.two_view,
            unclassified_tracks: tracks.unclassified,
            rejected_tracks: tracks.rejected,
            second_structures: second_structures::counts(solution),
            registered_views: solution.registered_views().len(),
            reprojection_rms_px: solution.reprojection_rms_px,
            reprojection_mean_px: solution.reprojection_mean_px,
            noise_px: solution.noise_px,
            warnings: warnings::named(solution, input),
            method: solution.method,
            winning_proposal: solution.winning_proposal.map(|proposal| proposal.name()),
            trained_network_sha256: solution.trained_network_sha256.map(|digest| digest.to_string()),
            iterations: solution.iterations,
            seed: solution.seed,
            seconds: solution.seconds,
            stages: solution
                .stages
                .iter()
                .map(|time| StageJson { name: time.stage.name(), seconds: time.seconds })
                .collect(),
            proposal_times: solution.proposal_times.iter().map(ProposalTimeJson::from).collect(),
            version: env!("CARGO_PKG_VERSION"),
            cameras,
        }
    }
}

/// The caller's id of view `index`; where the input is not at hand, the name that came with it, or the index.
pub fn view_label(solution: &Solution, input: Option<&LabelledInput>, index: usize) -> Label {
    let of_file = || input?.view_labels.get(index).cloned();
    let of_result = || solution.views.get(index)?.name.clone().map(Label::Name);
    of_file().or_else(of_result).unwrap_or(Label::Number(index as u64))
}

/// The caller's id of track `index`, or the index where the input is not at hand.
pub fn track_label(input: Option<&LabelledInput>, index: usize) -> Label {
    input.and_then(|input| input.track_labels.get(index).cloned()).unwrap_or(Label::Number(index as u64))
}
