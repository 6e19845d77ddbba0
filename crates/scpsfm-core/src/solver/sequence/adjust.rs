//! Bundle adjustment of a sequence: of what stands, with the calibration free.

use super::growth;
use super::model::{FIRST, Lens, Model};
use super::options::{AdjustmentOptions, GrowthOptions};
use crate::geometry::bundle::metric::{IntrinsicsModel, IntrinsicsPrior, MetricReconstruction};
use crate::geometry::bundle::sequence::{self, Free, Run};
use crate::geometry::observation::Observation;
use crate::geometry::statistics::{core_noise, median};
use crate::solver::problem::Problem;
use crate::solver::recorder::Recorder;

const OPTIONS: GrowthOptions = GrowthOptions::METRIC;
const ADJUSTMENT: AdjustmentOptions = AdjustmentOptions::DEFAULT;

/// What of a model is adjusted together.
pub struct Extract {
    /// Views and tracks of the input, in the order of the sequence's poses and points.
    pub views: Vec<usize>,
    pub tracks: Vec<usize>,
    pub sequence: MetricReconstruction,
    pub observations: Vec<Observation>,
}

impl Extract {
    /// These views, all registered, with the kept observations that these tracks have in them.
    pub fn new(problem: &Problem, model: &Model, views: &[usize], tracks: &[usize]) -> Self {
        let mut place = vec![usize::MAX; model.poses.len()];
        let mut extract = Self {
            views: Vec::with_capacity(views.len()),
            tracks: Vec::with_capacity(tracks.len()),
            sequence: MetricReconstruction {
                intrinsics: model.lenses.iter().map(|lens| lens.intrinsics).collect(),
                focals: Vec::new(),
                group_of: Vec::with_capacity(views.len()),
                poses: Vec::with_capacity(views.len()),
                points: Vec::with_capacity(tracks.len()),
                has_common_centre: model.has_common_centre,
            },
            observations: Vec::new(),
        };
        for &view in views {
            if let Some(pose) = model.poses[view] {
                place[view] = extract.views.len();
                extract.views.push(view);
                extract.sequence.poses.push(pose);
                extract.sequence.group_of.push(problem.camera_of[view]);
                extract.sequence.focals.extend(model.own_focals.get(view).map(|own| own.focal));
            }
        }
        for &track in tracks {
            let Some(landmark) = model.landmarks[track] else { continue };
            let point = extract.tracks.len();
            for k in problem.of_track(track).filter(|&k| model.kept[k] && place[problem.view_of(k)] != usize::MAX) {
                let view = place[problem.view_of(k)];
                extract.observations.push(Observation { view, point, ..problem.observation(k) });
            }
            extract.tracks.push(track);
            extract.sequence.points.push(landmark.position);
        }
        extract
    }

    /// Takes the reconstruction back into the model.
    pub fn write_back(&self, model: &mut Model) {
        for (lens, intrinsics) in model.lenses.iter_mut().zip(&self.sequence.intrinsics) {
            lens.intrinsics = *intrinsics;
        }
        for (&view, focal) in self.views.iter().zip(&self.sequence.focals) {
            model.own_focals[view].focal = *focal;
        }
        for (&view, pose) in self.views.iter().zip(&self.sequence.poses) {
            model.poses[view] = Some(*pose);
        }
        for (&track, position) in self.tracks.iter().zip(&self.sequence.points) {
            if let Some(landmark) = &mut model.landmarks[track] {
                landmark.position = *position;
            }
        }
    }

    /// The reconstruction with the groups of its views alone, and the cameras of the problem that these are.
    pub fn block(&self, problem: &Problem) -> (MetricReconstruction, Vec<usize>) {
        let (group_of, cameras) = problem.cameras_of(&self.views);
        let intrinsics = cameras.iter().map(|&camera| self.sequence.intrinsics[camera]).collect();
        let mut reconstruction = MetricReconstruction { intrinsics, group_of, ..self.sequence.clone() };
        reconstruction.average_focals();
        (reconstruction, cameras)
    }

    fn adjust(&mut self, problem: &Problem, model: &Model, free: &Free, iterations: usize, recorder: &mut Recorder) {
        let options = OPTIONS.adjustment(iterations, model.noise);
        let priors: Vec<IntrinsicsPrior> =
            (0..problem.cameras).map(|camera| intrinsics_prior(problem, camera, model.noise)).collect();
        let mut heartbeat = || recorder.heartbeat();
        let run = Run { threads: problem.threads, stop: problem.stop, heartbeat: &mut heartbeat };
        sequence::adjust(&mut self.sequence, &self.observations, free, &priors, &options, run);
    }

    /// Squared residuals, times the weights of the observations.
    pub fn squared_residuals(&self) -> Vec<f64> {
        let squared = |seen: &Observation| self.sequence.weighted_squared(seen);
        self.observations.iter().map(squared).collect()
    }

    /// Core noise of the residuals, see [`core_noise`].
    fn noise(&self) -> Option<f64> {
        let norms = self.squared_residuals().into_iter().map(f64::sqrt).collect();
        core_noise(norms, self.sequence.unknowns(self.tracks.len(), 0))
    }
}

/// What is known of the intrinsics of a camera before any observation.
pub fn intrinsics_prior(problem: &Problem, camera: usize, noise: f64) -> IntrinsicsPrior {
    problem.calibration_options.lenses.prior(noise, problem.focal_priors[camera], problem.scale_px)
}

/// Adjusts the views of a component with the landmarks that hold them best, while more are to come. Lenses that the
/// first component has are the first component's: the others are held to them until all are adjusted together.
pub fn while_growing(problem: &Problem, model: &mut Model, component: u32, recorder: &mut Recorder) {
    let views = model.of_component(component);
    let tracks = covering(problem, model, &views, OPTIONS.of_view);
    let mut extract = Extract::new(problem, model, &views, &tracks);
    let mut is_held = vec![false; problem.cameras];
    if component != FIRST {
        model.of_component(FIRST).into_iter().for_each(|view| is_held[problem.camera_of[view]] = true);
    }
    let held = held(problem);
    let free = |(lens, is_held): (&Lens, &bool)| if *is_held { held } else { lens.free };
    let models: Vec<IntrinsicsModel> = model.lenses.iter().zip(&is_held).map(free).collect();
    extract.adjust(problem, model, &Free::all(&models), OPTIONS.growing_iterations, recorder);
    finish(problem, model, &extract);
}

/// What is free of a camera whose lens is held: the focal lengths that are the views' own.
fn held(problem: &Problem) -> IntrinsicsModel {
    if problem.has_own_focals() { IntrinsicsModel::FOCAL_PER_VIEW } else { IntrinsicsModel::FIXED }
}

/// Adjusts a new view and those that share most landmarks with it, all others held, and the calibration too unless the
/// lens is new.
pub fn around(problem: &Problem, model: &mut Model, view: usize, is_new_lens: bool, recorder: &mut Recorder) {
    let near = neighbours(problem, model, view);
    let tracks = covering(problem, model, &near, OPTIONS.of_view);
    let mut views: Vec<usize> = tracks
        .iter()
        .flat_map(|&track| problem.of_track(track))
        .filter(|&k| model.kept[k])
        .map(|k| problem.view_of(k))
        .collect();
    views.sort_unstable();
    views.dedup();
    let mut extract = Extract::new(problem, model, &views, &tracks);
    let moves: Vec<bool> = extract.views.iter().map(|view| near.contains(view)).collect();
    let mut models = vec![IntrinsicsModel::FIXED; problem.cameras];
    if is_new_lens {
        models[problem.camera_of[view]] = IntrinsicsModel::focal(problem.has_own_focals());
    }
    let free = Free { models: &models, views: Some(&moves) };
    extract.adjust(problem, model, &free, ADJUSTMENT.iterations_around, recorder);
    if !problem.stop.is_stopped() {
        extract.write_back(model);
    }
}

/// A view and those that share most kept landmarks with it.
fn neighbours(problem: &Problem, model: &Model, view: usize) -> Vec<usize> {
    let mut shared = vec![0usize; model.poses.len()];
    for &k in problem.of_view[view].iter().filter(|&&k| model.kept[k as usize]) {
        for other in problem.of_track(problem.track_of(k as usize)).filter(|&other| model.kept[other]) {
            shared[problem.view_of(other)] += 1;
        }
    }
    let mut views: Vec<usize> = (0..shared.len()).filter(|&view| shared[view] > 0).collect();
    views.sort_by_key(|&other| (other != view, std::cmp::Reverse(shared[other]), other));
    views.truncate(ADJUSTMENT.views_around);
    views
}

/// Adjusts all registered views and verified landmarks.
pub fn all(problem: &Problem, model: &mut Model, recorder: &mut Recorder) {
    let views = model.registered();
    let tracks = verified(model);
    let mut extract = Extract::new(problem, model, &views, &tracks);
    let models: Vec<IntrinsicsModel> = model.lenses.iter().map(|lens| lens.free).collect();
    extract.adjust(problem, model, &Free::all(&models), OPTIONS.final_iterations, recorder);
    finish(problem, model, &extract);
}

fn finish(problem: &Problem, model: &mut Model, extract: &Extract) {
    if problem.stop.is_stopped() || extract.observations.is_empty() {
        return;
    }
    extract.write_back(model);
    if let Some(noise) = extract.noise() {
        model.set_noise(problem, noise);
    }
}

/// Tracks with a verified landmark, increasing.
pub fn verified(model: &Model) -> Vec<usize> {
    (0..model.landmarks.len()).filter(|&track| is_verified(model, track)).collect()
}

fn is_verified(model: &Model, track: usize) -> bool {
    model.landmarks[track].is_some_and(|landmark| landmark.is_verified())
}

/// The longest of the verified tracks until every one of these views has `of_view` observations, or all that it has.
pub fn covering(problem: &Problem, model: &Model, views: &[usize], of_view: usize) -> Vec<usize> {
    let mut wanted = vec![0usize; model.poses.len()];
    views.iter().for_each(|&view| wanted[view] = of_view);
    let seen = views.iter().flat_map(|&view| &problem.of_view[view]).map(|&k| problem.track_of(k as usize));
    let tracks = seen.filter(|&track| is_verified(model, track)).collect();
    let support = |track: usize| model.landmarks[track].map_or(0, |landmark| landmark.support);
    growth::covering(problem, tracks, support, &model.kept, &wanted)
}

/// Scales a component so that its median depth becomes 1: scale is free, and adjustments damp best near unit lengths.
///
/// Directions have no scale.
pub fn rescale(problem: &Problem, model: &mut Model, component: u32) {
    if model.has_common_centre {
        return;
    }
    let views = model.of_component(component);
    let mut depths: Vec<f64> = views
        .iter()
        .flat_map(|&view| &problem.of_view[view])
        .map(|&k| k as usize)
        .filter(|&k| model.kept[k])
        .filter_map(|k| {
            let pose = model.poses[problem.view_of(k)]?;
            let landmark = model.landmarks[problem.track_of(k)].filter(|landmark| landmark.component == component)?;
            Some(pose.apply(&landmark.position).z)
        })
        .collect();
    let scale = median(&mut depths).recip();
    if !(scale.is_finite() && scale > 0.0) {
        return;
    }
    for view in views {
        if let Some(pose) = &mut model.poses[view] {
            pose.translation *= scale;
        }
    }
    let landmarks = model.landmarks.iter_mut().flatten().filter(|landmark| landmark.component == component);
    landmarks.for_each(|landmark| landmark.position *= scale);
}
