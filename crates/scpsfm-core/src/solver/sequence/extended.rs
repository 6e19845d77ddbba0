//! A block extended metrically to every view that can be registered, and what that is worth.

use super::model::{FIRST, Model};
use super::options::{ExtensionOptions, GrowthOptions};
use super::register;
use super::{adjust, calibrate, components, growth, structure};
use crate::domain::{Grade, LeftOut, Stage, Task, Warning, WarningCode};
use crate::geometry::bundle::metric::MetricReconstruction;
use crate::geometry::observation::Observation;
use crate::solver::attempt::Attempt;
use crate::solver::calibration::Outcome;
use crate::solver::classification::Geometry;
use crate::solver::consensus::{LEAST_INLIERS, LEAST_VIEWS, NoiseOptions};
use crate::solver::error::Error;
use crate::solver::noise_model::evidence;
use crate::solver::problem::Problem;
use crate::solver::reconstruction::{Reconstruction, named_warnings, share};
use crate::solver::recorder::Recorder;

const OPTIONS: ExtensionOptions = ExtensionOptions::DEFAULT;

/// A metric reconstruction that stands, with the block that it grew from.
pub struct Extended {
    pub seed: Attempt,
    pub model: Model,
    /// One a camera of the problem.
    pub calibrations: Vec<Outcome>,
    /// Views that could not be registered, with the reason.
    pub left_out: Vec<(usize, LeftOut)>,
}

/// Extends a block, which must be metric, to every view that can be registered.
pub fn extend(problem: &Problem, seed: Attempt, recorder: &mut Recorder) -> Result<Extended, Error> {
    recorder.begin_extension();
    recorder.enter(Stage::Extend);
    let mut model = components::first(problem, &seed, recorder);
    let mut trials = vec![growth::Trial::default(); problem.views()];
    register::join(problem, &mut model, FIRST, &mut trials, recorder)?;
    components::others(problem, &mut model, &mut trials, recorder)?;
    components::join_rest(problem, &mut model, &mut trials, recorder)?;
    recorder.end_components();
    let options = GrowthOptions::LAST;
    let rounds = options.final_rounds;
    for round in 0..rounds {
        problem.stopped()?;
        let within = OPTIONS.share_of_registering + (1.0 - OPTIONS.share_of_registering) * round as f64 / rounds as f64;
        recorder.step(Task::Adjust, round + 1, rounds, within);
        adjust::all(problem, &mut model, recorder);
        structure::triangulate(problem, &mut model, recorder);
        for component in model.components() {
            components::drop_unsupported(problem, &mut model, component, &options, recorder);
        }
        // After the last round nothing would check the views that join.
        if round + 1 < rounds {
            components::join_rest(problem, &mut model, &mut trials, recorder)?;
        }
        recorder.report(within);
    }
    problem.stopped()?;
    recorder.enter(Stage::Calibrate);
    let mut calibrations = calibrate::calibrate(problem, &mut model, recorder)?;
    if model.is_strained {
        let detail = format!(
            "the views together fit much worse than the block that they were registered against: more than {:.2} px",
            model.noise * problem.scale_px
        );
        calibrations.iter_mut().for_each(|outcome| refuse(outcome, detail.clone()));
    }
    for (camera, (outcome, lens)) in calibrations.iter_mut().zip(&model.lenses).enumerate() {
        problem.doubt_implausible(outcome, &lens.intrinsics, camera);
    }
    for (outcome, magnification) in calibrations.iter_mut().zip(magnifications(problem, &model)) {
        if outcome.grade != Grade::ProjectiveOnly && magnification > OPTIONS.most_magnification {
            let detail = format!(
                "the lens would move observations outwards by a factor of {magnification:.2}, which with depth in the \
                 scene is rather a camera that turned behind a barrel lens; the most that is believed is {}",
                OPTIONS.most_magnification
            );
            refuse(outcome, detail);
        }
    }
    problem.stopped()?;
    components::largest_first(&mut model);
    let left_out = register::left_out(problem, &model, &trials);
    Ok(Extended { seed, model, calibrations, left_out })
}

/// Takes back a calibration that does not describe the images, for this reason.
fn refuse(outcome: &mut Outcome, detail: String) {
    outcome.warnings.push(Warning::new(WarningCode::ModelMismatch, detail));
    outcome.grade = Grade::ProjectiveOnly;
}

/// Largest factor by which the lens of each camera moves an observation that it keeps away from the principal point, 1
/// at least, and of a camera that only turned, whose scene has no depth to take up what its lens does. Views whose focal
/// length is not determined say nothing of their lens.
fn magnifications(problem: &Problem, model: &Model) -> Vec<f64> {
    let mut largest = vec![1.0f64; problem.cameras];
    if model.has_common_centre {
        return largest;
    }
    for k in (0..model.kept.len()).filter(|&k| model.kept[k]) {
        let view = problem.view_of(k);
        let lens = model.intrinsics_of(problem, view);
        if !lens.distorts() || !model.is_determined(view) {
            continue;
        }
        let distance = |seen: &Observation| (seen.xy - lens.principal_point).norm();
        if let Some(undistorted) = model.observation(problem, k) {
            let of_camera = &mut largest[problem.camera_of[view]];
            // At the principal point it is no number, which the maximum leaves out.
            *of_camera = of_camera.max(distance(&problem.observation(k)) / distance(&undistorted));
        }
    }
    largest
}

impl Extended {
    /// The worst of the cameras that have enough registered views to be calibrated by themselves: a few photographs of
    /// another camera take nothing from the rest. Of all cameras where none has.
    pub fn grade(&self, problem: &Problem) -> Grade {
        let mut views = vec![0; problem.cameras];
        self.model.registered().into_iter().for_each(|view| views[problem.camera_of[view]] += 1);
        let worst = |least: usize| {
            let grades = self.calibrations.iter().zip(&views).filter(|(_, views)| **views >= least);
            grades.map(|(outcome, _)| outcome.grade).reduce(Grade::worse)
        };
        worst(LEAST_VIEWS).or_else(|| worst(1)).unwrap_or(Grade::ProjectiveOnly)
    }

    pub fn is_calibrated(&self, problem: &Problem) -> bool {
        self.grade(problem) != Grade::ProjectiveOnly
    }

    /// Larger is better: a calibration before none, then the number of views.
    pub fn merit(&self, problem: &Problem) -> (bool, usize) {
        (self.is_calibrated(problem), self.model.registered().len())
    }

    /// As [`evidence`].
    pub fn evidence(&self, problem: &Problem) -> f64 {
        let model = &self.model;
        let (verified, observations) = self.verified();
        let (of_view, of_point) = MetricReconstruction::unknowns_each(model.has_common_centre);
        let unknowns = of_view * model.registered().len() + of_point * verified;
        evidence(observations, unknowns, model.noise, problem.outlier_density)
    }

    /// Points that geometry verifies, and the observations that agree with them.
    fn verified(&self) -> (usize, usize) {
        let verified = adjust::verified(&self.model);
        let points = verified.iter().filter_map(|&track| self.model.landmarks[track]);
        (verified.len(), points.map(|point| point.support).sum())
    }

    /// Whether nothing says that projective cameras would fit better.
    pub fn fits(&self) -> bool {
        let mut warnings = self.calibrations.iter().flat_map(|outcome| &outcome.warnings);
        warnings.all(|warning| !warning.code.is_misfit())
    }

    /// Whether there is anything that geometry verifies: views that points hold, and enough points.
    pub fn stands(&self) -> bool {
        self.model.registered().len() >= LEAST_VIEWS
            && adjust::verified(&self.model).len() >= LEAST_INLIERS
            && self.calibrations.iter().any(|outcome| outcome.metric.is_some())
    }

    /// Whether nothing is to be gained by extending without a calibration: it holds most views and explains enough, and
    /// has a calibration, or is so precise that wrong observations are not, and fits as well as projective cameras.
    pub fn is_settled(&self, problem: &Problem) -> bool {
        let is_precise = self.model.noise <= NoiseOptions::DEFAULT.initial;
        let (_, explained) = self.verified();
        let explains_enough = explained as f64 >= OPTIONS.enough_explained * problem.input.observation_count() as f64;
        self.holds_most_views() && explains_enough && (self.is_calibrated(problem) || is_precise && self.fits())
    }

    pub fn holds_most_views(&self) -> bool {
        let registered = self.model.registered().len();
        registered as f64 >= OPTIONS.enough_registered * (registered + self.left_out.len()) as f64
    }

    /// In terms of the input's views and tracks.
    pub fn reconstruction(&self, problem: &Problem) -> Reconstruction {
        let Self { seed, model, calibrations, left_out } = self;
        let grade = self.grade(problem);
        let is_reported = |view: &usize| grade != Grade::ProjectiveOnly && model.is_determined(*view);
        let component = |track: usize| match &model.landmarks[problem.representative[track]] {
            Some(landmark) => landmark.component,
            None => structure::component_of_track(problem, model, track).unwrap_or(0),
        };
        let calibrated = calibrations.iter().enumerate().map(|(camera, outcome)| {
            let intrinsics = model.lenses[camera].intrinsics;
            (Some(intrinsics).filter(|_| grade != Grade::ProjectiveOnly), outcome.clone())
        });
        let geometry = Geometry {
            cameras: model.cameras(problem),
            lenses: (0..problem.views()).map(|view| model.intrinsics_of(problem, view)).collect(),
            is_metric: grade != Grade::ProjectiveOnly,
            component_of_view: model.component_of.clone(),
            component_of_track: (0..problem.tracks()).map(component).collect(),
            by_observation: seed.judges_observations(),
            of_static: model.of_static,
            noise: model.noise,
            inlier_share: share(
                adjust::verified(model).len(),
                problem.verifiable(model.of_static, |view| model.poses[view].is_some()),
            ),
        };
        Reconstruction {
            geometry,
            poses: (0..problem.views()).map(|view| model.poses[view].filter(|_| is_reported(&view))).collect(),
            left_out: left_out.clone(),
            canonical: None,
            grade,
            calibrated: calibrated.collect(),
            warnings: named_warnings(problem, calibrations),
        }
    }
}
