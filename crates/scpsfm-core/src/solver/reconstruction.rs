//! A reconstruction in terms of the input's views and tracks, and what it says of them.

use nalgebra::Matrix4;

use super::attempt::Attempt;
use super::baselines::Decided;
use super::calibration::Outcome;
use super::classification::{self, Geometry, Judged};
use super::depths::DepthOptions;
use super::problem::{Problem, camera_groups};
use super::recorder::Recorder;
use crate::domain::result::TrackResults;
use crate::domain::{Grade, LeftOut, Warning};
use crate::geometry::bundle::metric::{Intrinsics, MetricReconstruction, Pose};
use crate::geometry::daq::to_canonical_frame;

/// A reconstruction in terms of the input's views and tracks.
pub struct Reconstruction {
    pub geometry: Geometry,
    /// The pose of each view that has one to be reported.
    pub poses: Vec<Option<Pose>>,
    pub left_out: Vec<(usize, LeftOut)>,
    /// Homography into the canonical frame that projective cameras are reported in. `None` for metric cameras, whose
    /// plane at infinity is (0, 0, 0, 1) already.
    pub canonical: Option<Matrix4<f64>>,
    pub grade: Grade,
    /// What was found of each camera, and what it is worth; intrinsics are left out where no view of it is registered.
    pub calibrated: Vec<(Option<Intrinsics>, Outcome)>,
    /// What is to be said of the calibrations.
    pub warnings: Vec<Warning>,
}

impl Reconstruction {
    /// Of a block, metric where it is calibrated, else projective; `None` where nothing stands.
    pub fn of_attempt(problem: &Problem, attempt: &Attempt) -> Option<Self> {
        let (projective, outcome) = (attempt.projective.as_ref()?, attempt.calibration.as_ref()?);
        let metric = outcome.metric.as_ref().filter(|_| outcome.grade != Grade::ProjectiveOnly);
        let mut cameras = vec![None; problem.views()];
        let mut poses = vec![None; problem.views()];
        let mut lenses = Vec::new();
        for (i, &view) in projective.views.iter().enumerate() {
            let camera = |metric: &MetricReconstruction| metric.poses[i].camera(&metric.intrinsics_of(i));
            cameras[view] = Some(metric.map_or(projective.cameras[i], camera));
        }
        // Where the first camera has no rank 3 the frame stays as it is.
        let canonical = || {
            let frame = to_canonical_frame(&projective.cameras, &[]);
            frame.map_or_else(Matrix4::identity, |frame| frame.homography)
        };
        let (_, found) = problem.cameras_of(&projective.views);
        let mut calibrated = vec![(None, Outcome::refused(Vec::new())); problem.cameras];
        for (group, camera) in found.into_iter().enumerate() {
            calibrated[camera] = (metric.map(|metric| metric.intrinsics[group]), outcome.clone());
        }
        if let Some(metric) = metric {
            lenses = vec![metric.intrinsics[0]; problem.views()];
            for (i, &view) in projective.views.iter().enumerate() {
                lenses[view] = metric.intrinsics_of(i);
                let own = outcome.focals.as_ref().and_then(|focals| focals.get(i));
                poses[view] = Some(metric.poses[i]).filter(|_| own.is_none_or(|own| own.sigma_log.is_some()));
            }
        }
        let geometry = Geometry {
            cameras,
            lenses,
            is_metric: metric.is_some(),
            component_of_view: vec![0; problem.views()],
            component_of_track: vec![0; problem.tracks()],
            by_observation: attempt.judges_observations(),
            of_static: problem.is_of_static(&projective.tracks),
            // Estimated under projective cameras: metric ones fit worse by so much.
            noise: projective.noise * metric.map_or(1.0, |_| outcome.rms_ratio.max(1.0)),
            inlier_share: share(projective.tracks.len(), projective.tried),
        };
        Some(Self {
            geometry,
            poses,
            left_out: Vec::new(),
            canonical: metric.is_none().then(canonical),
            grade: outcome.grade,
            calibrated,
            warnings: named_warnings(problem, std::slice::from_ref(outcome)),
        })
    }

    /// The same without these views, for these reasons.
    pub fn leave_out(&mut self, views: Vec<(usize, LeftOut)>) {
        for &(view, _) in &views {
            self.geometry.cameras[view] = None;
            self.poses[view] = None;
        }
        self.left_out.extend(views);
    }

    /// Every track and observation judged by all registered views, or by what else the method goes by.
    pub fn judged(&self, problem: &Problem, seed: &Attempt, recorder: &mut Recorder) -> Judged {
        let mut progress = |verdicts| recorder.judged(verdicts, problem.tracks());
        let mut judged = classification::judge(problem, &self.geometry, &mut progress);
        // Once wrong observations are left out, the noise may be too low for depths to add anything.
        let depths_say_more = !self.geometry.by_observation || self.geometry.noise > DepthOptions::DEFAULT.strong_noise;
        if let Some(weights) = seed.weights_by_depths.as_ref().filter(|_| depths_say_more) {
            weights.judge(problem, &self.geometry, &mut judged);
        }
        if let Some(decided) = &seed.decided {
            mask(problem, &seed.block.tracks, decided, &mut judged);
        }
        judged
    }
}

/// Prior probability that a track is right, of so many that were found to be.
pub(super) fn share(right: usize, tried: usize) -> f64 {
    (right as f64 + 1.0) / (tried.max(right) as f64 + 2.0)
}

/// PAPER, SCPSFM and PSFM: the method's own weights and verdicts in place of the geometry's.
pub fn own_verdicts(block_tracks: &[usize], decided: &Decided, tracks: &mut TrackResults) {
    tracks.weight.fill(0.0);
    tracks.inlier.fill(false);
    for (j, &track) in block_tracks.iter().enumerate() {
        tracks.weight[track] = decided.weights[j] as f32;
        tracks.inlier[track] = decided.inlier[j];
    }
}

/// The same, with what follows from it: a track that the method rejects has neither observations nor a point.
fn mask(problem: &Problem, block_tracks: &[usize], decided: &Decided, judged: &mut Judged) {
    own_verdicts(block_tracks, decided, &mut judged.tracks);
    for track in 0..problem.tracks() {
        if !judged.tracks.inlier[track] {
            judged.retained[track].clear();
            judged.points[track] = None;
            for k in problem.of_track(track) {
                judged.observations.inlier[problem.input.caller_index(k)] = false;
            }
        }
    }
}

/// What is to be said of the calibrations, each group's named where there are several.
pub(super) fn named_warnings(problem: &Problem, outcomes: &[Outcome]) -> Vec<Warning> {
    let (group_of, groups) = camera_groups(problem.input);
    let id_of = |group: usize| {
        let view = group_of.iter().position(|of| *of == group).filter(|_| outcomes.len() == groups)?;
        Some(problem.input.views()[view].camera_group)
    };
    let is_common = |warning: &Warning| outcomes.iter().all(|outcome| outcome.warnings.contains(warning));
    let of_group = |(group, outcome): (usize, &Outcome)| -> Vec<Warning> {
        let named = |warning: &Warning| match id_of(group) {
            // One for all groups, or none to tell apart.
            None => warning.clone(),
            Some(_) if groups > 1 && is_common(warning) => warning.clone(),
            Some(id) if groups > 1 => {
                Warning::new(warning.code, format!("camera group {id}: {}", warning.detail)).of_group(id)
            }
            Some(id) => warning.clone().of_group(id),
        };
        // What is said of all is said once.
        let is_repeated = |warning: &&Warning| group > 0 && is_common(warning);
        outcome.warnings.iter().filter(|warning| !is_repeated(warning)).map(named).collect()
    };
    outcomes.iter().enumerate().flat_map(of_group).collect()
}
