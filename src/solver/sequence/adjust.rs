//! Bundle adjustment of a sequence: of what stands, with the calibration free.

use super::model::{Model, Scene};
use super::parts::FIRST;
use crate::geometry::bundle::metric::{self, IntrinsicsModel, IntrinsicsPrior, Reconstruction};
use crate::geometry::bundle::{Loss, Observation, Options};
use crate::geometry::statistics::median;

/// Scale of the Cauchy loss in units of the core noise: detectors have tails that a wider one would follow.
const CAUCHY_SCALE: f64 = 2.0;
/// Iterations while views are added, which start at what was adjusted before, and at the end.
const ITERATIONS_WHILE_GROWING: usize = 6;
const ITERATIONS: usize = 20;
/// Cost gained by a step, as a share, below which an adjustment that will be repeated ends.
const TOLERANCE: f64 = 1e-4;
/// Observations of a view that an adjustment while growing holds.
const OF_VIEW_WHILE_GROWING: usize = 100;
/// Median of the norm of two independent normal coordinates (Rayleigh) in standard deviations.
const RAYLEIGH_MEDIAN: f64 = 1.177_41;
/// Least share of the observations' freedom that is left to the residuals, however few landmarks there are.
const LEAST_FREEDOM: f64 = 0.2;

/// The part of a model that is adjusted together.
pub struct Part {
    pub views: Vec<usize>,
    pub tracks: Vec<usize>,
    pub reconstruction: Reconstruction,
    pub observations: Vec<Observation>,
}

impl Part {
    /// The registered views among `views` with these tracks' kept observations in them.
    pub fn new(scene: &Scene, model: &Model, views: &[usize], tracks: &[usize]) -> Self {
        let mut place = vec![usize::MAX; model.poses.len()];
        let mut poses = Vec::with_capacity(views.len());
        for (i, &view) in views.iter().enumerate() {
            if let Some(pose) = model.poses[view] {
                place[view] = i;
                poses.push(pose);
            }
        }
        let mut part = Self {
            views: views.to_vec(),
            tracks: Vec::with_capacity(tracks.len()),
            reconstruction: Reconstruction { intrinsics: model.intrinsics, poses, points: Vec::new() },
            observations: Vec::new(),
        };
        for &track in tracks {
            let Some(landmark) = model.landmarks[track] else { continue };
            let point = part.tracks.len();
            for k in scene.of_track(track).filter(|&k| model.kept[k] && place[scene.view_of(k)] != usize::MAX) {
                part.observations.push(Observation { camera: place[scene.view_of(k)], point, xy: scene.xy[k] });
            }
            part.tracks.push(track);
            part.reconstruction.points.push(landmark.position);
        }
        part
    }

    /// Takes the reconstruction back into the model.
    pub fn write_back(&self, model: &mut Model) {
        model.intrinsics = self.reconstruction.intrinsics;
        for (&view, pose) in self.views.iter().zip(&self.reconstruction.poses) {
            model.poses[view] = Some(*pose);
        }
        for (&track, position) in self.tracks.iter().zip(&self.reconstruction.points) {
            if let Some(landmark) = &mut model.landmarks[track] {
                landmark.position = *position;
            }
        }
    }

    fn adjust(&mut self, scene: &Scene, model: &Model, free: IntrinsicsModel, iterations: usize) {
        let options = Options {
            max_iterations: iterations,
            relative_tolerance: TOLERANCE,
            loss: Loss::Cauchy { scale: CAUCHY_SCALE * model.noise },
            ..Options::default()
        };
        let prior = knowledge(scene, model.noise);
        metric::adjust(&mut self.reconstruction, &self.observations, free, &prior, &options, scene.stop());
    }

    /// Core noise of the residuals: their median, for what their freedom leaves of it.
    fn noise(&self) -> f64 {
        let mut norms: Vec<f64> =
            self.observations.iter().map(|seen| self.reconstruction.residual(seen).norm()).collect();
        let unknowns = 6 * self.views.len() + 3 * self.tracks.len();
        let freedom = 1.0 - unknowns as f64 / (2 * self.observations.len()).max(1) as f64;
        median(&mut norms) / RAYLEIGH_MEDIAN / freedom.max(LEAST_FREEDOM).sqrt()
    }
}

/// What is known of the intrinsics before any observation.
pub fn knowledge(scene: &Scene, noise: f64) -> IntrinsicsPrior {
    let context = &scene.context;
    let views = context.input.views().iter();
    crate::solver::calibration::knowledge(noise, crate::solver::attempt::focal_prior(views), context.scale_px)
}

/// Adjusts the views of a part with the landmarks that hold them best, while more are to come. The calibration is the
/// first part's: the others are held to it until all are adjusted together.
pub fn while_growing(scene: &Scene, model: &mut Model, part: u32) {
    let views = model.of_part(part);
    let free = if part == FIRST { model.free } else { IntrinsicsModel::FIXED };
    let tracks = covering(scene, model, &views, OF_VIEW_WHILE_GROWING);
    let mut part = Part::new(scene, model, &views, &tracks);
    part.adjust(scene, model, free, ITERATIONS_WHILE_GROWING);
    finish(scene, model, &part);
}

/// Adjusts all registered views and verified landmarks.
pub fn all(scene: &Scene, model: &mut Model) {
    let views = model.registered();
    let tracks = verified(model);
    let mut part = Part::new(scene, model, &views, &tracks);
    part.adjust(scene, model, model.free, ITERATIONS);
    finish(scene, model, &part);
}

fn finish(scene: &Scene, model: &mut Model, part: &Part) {
    if scene.stop().is_stopped() || part.observations.is_empty() {
        return;
    }
    part.write_back(model);
    let noise = part.noise();
    if noise.is_finite() {
        model.noise = noise.max(LEAST_NOISE_PX / scene.context.scale_px);
    }
}

/// Least noise that is believed, pixels: exact input would close every gate.
const LEAST_NOISE_PX: f64 = 0.01;

/// Tracks with a verified landmark, increasing.
pub fn verified(model: &Model) -> Vec<usize> {
    let is_verified = |track: &usize| model.landmarks[*track].is_some_and(|landmark| landmark.is_verified());
    (0..model.landmarks.len()).filter(is_verified).collect()
}

/// The longest of the verified tracks until every one of these views has `of_view` observations, or all that it has.
pub fn covering(scene: &Scene, model: &Model, views: &[usize], of_view: usize) -> Vec<usize> {
    let mut wanted = vec![0usize; model.poses.len()];
    views.iter().for_each(|&view| wanted[view] = of_view);
    let mut seen: Vec<usize> =
        views.iter().flat_map(|&view| &scene.of_view[view]).map(|&k| scene.track_of(k as usize)).collect();
    seen.sort_unstable();
    seen.dedup();
    let mut tracks: Vec<usize> = seen
        .into_iter()
        .filter(|&track| model.landmarks[track].is_some_and(|landmark| landmark.is_verified()))
        .collect();
    let support = |track: usize| model.landmarks[track].map_or(0, |landmark| landmark.support);
    tracks.sort_by_key(|&track| (std::cmp::Reverse(support(track)), track));
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

/// Scales a part so that its median depth becomes 1.
///
/// Scale is free, and adjustments damp best near unit lengths.
pub fn rescale(scene: &Scene, model: &mut Model, part: u32) {
    let mut depths: Vec<f64> = (0..scene.xy.len())
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
    for view in model.of_part(part) {
        if let Some(pose) = &mut model.poses[view] {
            pose.translation *= scale;
        }
    }
    let landmarks = model.landmarks.iter_mut().flatten().filter(|landmark| landmark.part == part);
    landmarks.for_each(|landmark| landmark.position *= scale);
}
