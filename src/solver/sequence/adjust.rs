//! Bundle adjustment of a sequence: of what stands, with the calibration free.

use super::model::{Lens, Model, Scene};
use super::parts::FIRST;
use crate::geometry::bundle::metric::{IntrinsicsModel, IntrinsicsPrior, Reconstruction};
use crate::geometry::bundle::sequence::{self, Free, Run};
use crate::geometry::bundle::{Loss, Options};
use crate::geometry::observation::Observation;
use crate::geometry::statistics::median;
use crate::solver::calibration;
use crate::solver::recorder::Recorder;

/// Scale of the Cauchy loss in units of the core noise: detectors have tails that a wider one would follow.
pub const CAUCHY_SCALE: f64 = 2.0;
/// Iterations around a new view, while views are added, which start at what was adjusted before, and at the end.
const ITERATIONS_AROUND: usize = 3;
const ITERATIONS_WHILE_GROWING: usize = 6;
const ITERATIONS: usize = 20;
/// Cost gained by a step, as a share, below which an adjustment that will be repeated ends.
pub const TOLERANCE: f64 = 1e-4;
/// Observations of a view that an adjustment while growing holds.
const OF_VIEW_WHILE_GROWING: usize = 100;
/// Views that are free in the adjustment around a new one: those that share most points with it.
const VIEWS_AROUND: usize = 6;
/// Median of the norm of two independent normal coordinates (Rayleigh) in standard deviations.
const RAYLEIGH_MEDIAN: f64 = 1.177_41;
/// Least share of the observations' freedom that is left to the residuals, however few landmarks there are.
const LEAST_FREEDOM: f64 = 0.2;

/// What of a model is adjusted together.
pub struct Extract {
    /// Views and tracks of the input, in the order of the sequence's poses and points.
    pub views: Vec<usize>,
    pub tracks: Vec<usize>,
    pub sequence: Reconstruction,
    pub observations: Vec<Observation>,
}

impl Extract {
    /// These views, all registered, with the kept observations that these tracks have in them.
    pub fn new(scene: &Scene, model: &Model, views: &[usize], tracks: &[usize]) -> Self {
        let mut place = vec![usize::MAX; model.poses.len()];
        let mut extract = Self {
            views: Vec::with_capacity(views.len()),
            tracks: Vec::with_capacity(tracks.len()),
            sequence: Reconstruction {
                intrinsics: model.lenses.iter().map(|lens| lens.intrinsics).collect(),
                focals: Vec::new(),
                group_of: Vec::with_capacity(views.len()),
                poses: Vec::with_capacity(views.len()),
                points: Vec::with_capacity(tracks.len()),
            },
            observations: Vec::new(),
        };
        for &view in views {
            if let Some(pose) = model.poses[view] {
                place[view] = extract.views.len();
                extract.views.push(view);
                extract.sequence.poses.push(pose);
                extract.sequence.group_of.push(scene.camera_of[view]);
                extract.sequence.focals.extend(model.own_focals.get(view).map(|own| own.focal));
            }
        }
        for &track in tracks {
            let Some(landmark) = model.landmarks[track] else { continue };
            let point = extract.tracks.len();
            for k in scene.of_track(track).filter(|&k| model.kept[k] && place[scene.view_of(k)] != usize::MAX) {
                let view = place[scene.view_of(k)];
                extract.observations.push(Observation { view, point, ..scene.observation(k) });
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

    /// The reconstruction with the groups of its views alone, and the cameras of the scene that these are.
    pub fn block(&self) -> (Reconstruction, Vec<usize>) {
        let mut reconstruction = self.sequence.clone();
        let mut cameras = reconstruction.group_of.clone();
        cameras.sort_unstable();
        cameras.dedup();
        reconstruction.intrinsics = cameras.iter().map(|&camera| self.sequence.intrinsics[camera]).collect();
        for group in &mut reconstruction.group_of {
            *group = cameras.partition_point(|camera| camera < group);
        }
        reconstruction.average_focals();
        (reconstruction, cameras)
    }

    fn adjust(&mut self, scene: &Scene, model: &Model, free: &Free, iterations: usize, recorder: &mut Recorder) {
        let options = Options {
            max_iterations: iterations,
            relative_tolerance: TOLERANCE,
            loss: Loss::Cauchy { scale: CAUCHY_SCALE * model.noise },
            ..Options::default()
        };
        let priors: Vec<IntrinsicsPrior> =
            (0..scene.cameras).map(|camera| intrinsics_prior(scene, camera, model.noise)).collect();
        let mut told = || recorder.heartbeat();
        let run = Run { threads: scene.context.threads, stop: scene.stop(), told: &mut told };
        sequence::adjust(&mut self.sequence, &self.observations, free, &priors, &options, run);
    }

    /// Core noise of the residuals: their median, for what their freedom leaves of it.
    fn noise(&self, scene: &Scene) -> f64 {
        let norms: Vec<f64> =
            self.observations.iter().map(|seen| seen.weight.sqrt() * self.sequence.residual(seen).norm()).collect();
        let of_view = if scene.has_own_focals() { 7 } else { 6 };
        let unknowns = of_view * self.views.len() + 3 * self.tracks.len();
        core_noise(norms, unknowns)
    }
}

/// Core noise, one standard deviation of a coordinate, by the median of these norms of residuals, for what their
/// freedom leaves of it.
pub fn core_noise(mut norms: Vec<f64>, unknowns: usize) -> f64 {
    let freedom = 1.0 - unknowns as f64 / (2 * norms.len()).max(1) as f64;
    median(&mut norms) / RAYLEIGH_MEDIAN / freedom.max(LEAST_FREEDOM).sqrt()
}

/// What is known of the intrinsics of a camera before any observation.
pub fn intrinsics_prior(scene: &Scene, camera: usize, noise: f64) -> IntrinsicsPrior {
    calibration::default_intrinsics_prior(noise, scene.focal_priors[camera], scene.context.scale_px)
}

/// Adjusts the views of a part with the landmarks that hold them best, while more are to come. Lenses that the first
/// part has are the first part's: the others are held to them until all are adjusted together.
pub fn while_growing(scene: &Scene, model: &mut Model, part: u32, recorder: &mut Recorder) {
    let views = model.of_part(part);
    let tracks = covering(scene, model, &views, OF_VIEW_WHILE_GROWING);
    let mut extract = Extract::new(scene, model, &views, &tracks);
    let mut is_held = vec![false; scene.cameras];
    if part != FIRST {
        model.of_part(FIRST).into_iter().for_each(|view| is_held[scene.camera_of[view]] = true);
    }
    let held = held(scene);
    let free = |(lens, is_held): (&Lens, &bool)| if *is_held { held } else { lens.free };
    let models: Vec<IntrinsicsModel> = model.lenses.iter().zip(&is_held).map(free).collect();
    extract.adjust(scene, model, &Free::all(&models), ITERATIONS_WHILE_GROWING, recorder);
    finish(scene, model, &extract);
}

/// What is free of a camera whose lens is held: the focal lengths that are the views' own.
fn held(scene: &Scene) -> IntrinsicsModel {
    if scene.has_own_focals() { IntrinsicsModel::FOCAL_PER_VIEW } else { IntrinsicsModel::FIXED }
}

/// Adjusts a new view and those that share most landmarks with it, all others held, and the calibration too unless the
/// lens is new.
pub fn around(scene: &Scene, model: &mut Model, view: usize, is_new_lens: bool, recorder: &mut Recorder) {
    let near = neighbours(scene, model, view);
    let tracks = covering(scene, model, &near, OF_VIEW_WHILE_GROWING);
    let mut views: Vec<usize> = tracks
        .iter()
        .flat_map(|&track| scene.of_track(track))
        .filter(|&k| model.kept[k])
        .map(|k| scene.view_of(k))
        .collect();
    views.sort_unstable();
    views.dedup();
    let mut extract = Extract::new(scene, model, &views, &tracks);
    let moves: Vec<bool> = extract.views.iter().map(|view| near.contains(view)).collect();
    let mut models = vec![IntrinsicsModel::FIXED; scene.cameras];
    if is_new_lens {
        models[scene.camera_of[view]] = IntrinsicsModel::focal(scene.has_own_focals());
    }
    let free = Free { models: &models, views: Some(&moves), points: None };
    extract.adjust(scene, model, &free, ITERATIONS_AROUND, recorder);
    if !scene.stop().is_stopped() {
        extract.write_back(model);
    }
}

/// A view and those that share most kept landmarks with it.
fn neighbours(scene: &Scene, model: &Model, view: usize) -> Vec<usize> {
    let mut shared = vec![0usize; model.poses.len()];
    for &k in scene.of_view[view].iter().filter(|&&k| model.kept[k as usize]) {
        for other in scene.of_track(scene.track_of(k as usize)).filter(|&other| model.kept[other]) {
            shared[scene.view_of(other)] += 1;
        }
    }
    let mut views: Vec<usize> = (0..shared.len()).filter(|&view| shared[view] > 0).collect();
    views.sort_by_key(|&other| (other != view, std::cmp::Reverse(shared[other]), other));
    views.truncate(VIEWS_AROUND);
    views
}

/// Adjusts all registered views and verified landmarks.
pub fn all(scene: &Scene, model: &mut Model, recorder: &mut Recorder) {
    let views = model.registered();
    let tracks = verified(model);
    let mut extract = Extract::new(scene, model, &views, &tracks);
    let models: Vec<IntrinsicsModel> = model.lenses.iter().map(|lens| lens.free).collect();
    extract.adjust(scene, model, &Free::all(&models), ITERATIONS, recorder);
    finish(scene, model, &extract);
}

fn finish(scene: &Scene, model: &mut Model, extract: &Extract) {
    if scene.stop().is_stopped() || extract.observations.is_empty() {
        return;
    }
    extract.write_back(model);
    model.set_noise(scene, extract.noise(scene));
}

/// Tracks with a verified landmark, increasing.
pub fn verified(model: &Model) -> Vec<usize> {
    (0..model.landmarks.len()).filter(|&track| is_verified(model, track)).collect()
}

fn is_verified(model: &Model, track: usize) -> bool {
    model.landmarks[track].is_some_and(|landmark| landmark.is_verified())
}

/// The longest of the verified tracks until every one of these views has `of_view` observations, or all that it has.
pub fn covering(scene: &Scene, model: &Model, views: &[usize], of_view: usize) -> Vec<usize> {
    let mut wanted = vec![0usize; model.poses.len()];
    views.iter().for_each(|&view| wanted[view] = of_view);
    let seen = views.iter().flat_map(|&view| &scene.of_view[view]).map(|&k| scene.track_of(k as usize));
    let mut tracks: Vec<usize> = seen.filter(|&track| is_verified(model, track)).collect();
    let support = |track: usize| model.landmarks[track].map_or(0, |landmark| landmark.support);
    tracks.sort_unstable_by_key(|&track| (std::cmp::Reverse(support(track)), track));
    tracks.dedup();
    let mut observed = vec![0usize; model.poses.len()];
    tracks.retain(|&track| {
        let kept = || scene.of_track(track).filter(|&k| model.kept[k]).map(|k| scene.view_of(k));
        let needed = kept().any(|view| observed[view] < wanted[view]);
        if needed {
            kept().for_each(|view| observed[view] += 1);
        }
        needed
    });
    tracks.sort_unstable();
    tracks
}

/// Scales a part so that its median depth becomes 1: scale is free, and adjustments damp best near unit lengths.
pub fn rescale(scene: &Scene, model: &mut Model, part: u32) {
    let views = model.of_part(part);
    let mut depths: Vec<f64> = views
        .iter()
        .flat_map(|&view| &scene.of_view[view])
        .map(|&k| k as usize)
        .filter(|&k| model.kept[k])
        .filter_map(|k| {
            let pose = model.poses[scene.view_of(k)]?;
            let landmark = model.landmarks[scene.track_of(k)].filter(|landmark| landmark.part == part)?;
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
    let landmarks = model.landmarks.iter_mut().flatten().filter(|landmark| landmark.part == part);
    landmarks.for_each(|landmark| landmark.position *= scale);
}
