//! A projective reconstruction grown from a consensus: view after view by resection, every track by robust
//! triangulation, both kept straight by projective bundle adjustment.
//!
//! It needs no calibration, so it reaches the views where none can be given, and it judges by observation, so a track
//! with some wrong observations takes part by the others.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::growth::{self, Growth, Trial};
use super::options::GrowthOptions;
use crate::domain::VERIFIED;
use crate::geometry::bundle;
use crate::geometry::observation::{Correspondence, Observation};
use crate::geometry::robust_triangulation::{self, RobustPoint, Triangulator};
use crate::geometry::statistics::core_noise;
use crate::geometry::{Camera, Point, resection};
use crate::solver::consensus::NoiseOptions;
use crate::solver::error::Error;
use crate::solver::per_track::each_track;
use crate::solver::problem::Problem;
use crate::solver::projective::ProjectiveReconstruction;
use crate::solver::recorder::Recorder;

/// A reconstruction while it grows, indexed as the input is.
struct Growing<'a> {
    problem: &'a Problem<'a>,
    rng: ChaCha8Rng,
    options: &'a GrowthOptions,
    cameras: Vec<Option<Camera>>,
    points: Vec<Option<Point>>,
    /// Observations that agree with the point of each track.
    support: Vec<usize>,
    /// One an observation.
    kept: Vec<bool>,
    noise: f64,
    start_noise: f64,
    /// Whether it began from static tracks.
    of_static: bool,
}

/// Grows a reconstruction to every view that can be registered, and every track that points are found for.
pub fn extend(
    problem: &Problem,
    start: ProjectiveReconstruction,
    options: &GrowthOptions,
    recorder: &mut Recorder,
) -> Result<ProjectiveReconstruction, Error> {
    let mut growing = Growing::new(problem, start.oriented(), options);
    growing.triangulate(None, recorder);
    let mut trials = vec![Trial::default(); problem.views()];
    growth::grow(problem, &mut growing, options, &mut trials, recorder)?;
    for round in 1..=options.final_rounds {
        problem.stopped()?;
        growing.adjust(options.final_iterations, recorder);
        growing.triangulate(None, recorder);
        let dropped = growing.drop_unsupported();
        // What stands without them may place them better; after the last round nothing would check them.
        if !dropped.is_empty() && round < options.final_rounds {
            dropped.iter().for_each(|&view| trials[view].count = 0);
            growth::grow(problem, &mut growing, options, &mut trials, recorder)?;
        }
    }
    problem.stopped()?;
    Ok(growing.finish())
}

impl<'a> Growing<'a> {
    fn new(problem: &'a Problem<'a>, start: ProjectiveReconstruction, options: &'a GrowthOptions) -> Self {
        let mut cameras = vec![None; problem.of_view.len()];
        start.views.iter().zip(&start.cameras).for_each(|(&view, camera)| cameras[view] = Some(*camera));
        Self {
            problem,
            rng: ChaCha8Rng::seed_from_u64(problem.settings.seed),
            options,
            cameras,
            points: vec![None; problem.tracks()],
            support: vec![0; problem.tracks()],
            kept: vec![false; problem.xy.len()],
            noise: start.noise,
            start_noise: start.noise,
            of_static: problem.is_of_static(&start.tracks),
        }
    }

    fn views(&self) -> Vec<usize> {
        (0..self.cameras.len()).filter(|&view| self.cameras[view].is_some()).collect()
    }

    fn is_verified(&self, track: usize) -> bool {
        self.support[track] >= VERIFIED
    }

    /// Whether so few verified points support a view that those of two views count too: those that it agrees with where
    /// it is registered, else those that it sees. Nothing verifies points of two views, but views that are linked by
    /// few tracks have no others.
    fn needs_two_view_points(&self, view: usize) -> bool {
        let is_registered = self.cameras[view].is_some();
        let verified = self.problem.of_view[view]
            .iter()
            .map(|&k| k as usize)
            .filter(|&k| self.is_verified(self.problem.track_of(k)) && (self.kept[k] || !is_registered));
        verified.count() < self.options.least_agreeing
    }

    /// The observations of a view whose points may support its camera: the verified ones, and where it needs
    /// them those of two views.
    fn points_for(&self, view: usize) -> impl Iterator<Item = usize> {
        let takes_all = self.needs_two_view_points(view);
        let supports = move |&k: &usize| {
            let track = self.problem.track_of(k);
            self.is_verified(track) || takes_all && self.support[track] >= 2
        };
        self.problem.of_view[view].iter().map(|&k| k as usize).filter(supports)
    }

    /// Triangulates every track anew, or those that a view sees.
    fn triangulate(&mut self, of_view: Option<usize>, recorder: &mut Recorder) {
        let problem = self.problem;
        let mut tracks: Vec<usize> = match of_view {
            Some(view) => problem.of_view[view].iter().map(|&k| problem.track_of(k as usize)).collect(),
            None => (0..problem.tracks()).collect(),
        };
        tracks.retain(|&track| problem.supports_growth(track, self.of_static));
        let cameras = robust_triangulation::or_zeros(&self.cameras);
        let triangulator = Triangulator::new(&cameras);
        let gate = problem.gate(self.noise);
        let find = |growing: &Self, track: usize| growing.point(&triangulator, gate, track);
        each_track(problem, &tracks, self, recorder, find, |growing, track, found| {
            problem.of_track(track).for_each(|k| growing.kept[k] = false);
            growing.points[track] = found.as_ref().map(|(found, _)| found.point);
            let agreeing = found.into_iter().flat_map(|(found, seen)| seen.into_iter().zip(found.agrees));
            growing.support[track] = 0;
            for (k, _) in agreeing.filter(|(_, agrees)| *agrees) {
                growing.kept[k] = true;
                growing.support[track] += 1;
            }
        });
    }

    /// The point of a track, and the observations that it was looked for among.
    fn point(&self, triangulator: &Triangulator, gate: f64, track: usize) -> Option<(RobustPoint, Vec<usize>)> {
        let problem = self.problem;
        let seen: Vec<usize> =
            problem.of_track(track).filter(|&k| self.cameras[problem.view_of(k)].is_some()).collect();
        let observations: Vec<Observation> = seen.iter().map(|&k| problem.pinhole_observation(k)).collect();
        let found = triangulator.robust(&observations, gate)?;
        let agreeing = found.agrees.iter().filter(|&&agrees| agrees).count();
        (agreeing as f64 >= problem.least_share * seen.len() as f64).then_some((found, seen))
    }

    /// The verified points.
    fn verified(&self) -> Vec<usize> {
        (0..self.points.len()).filter(|&track| self.is_verified(track)).collect()
    }

    /// The tracks that an adjustment is made by: the verified ones, and those of two views where a view needs them.
    fn adjusted_tracks(&self) -> Vec<usize> {
        let takes_all: Vec<bool> = (0..self.cameras.len()).map(|view| self.needs_two_view_points(view)).collect();
        let holds = |&track: &usize| {
            let mut seen = self.problem.of_track(track).filter(|&k| self.kept[k]);
            self.is_verified(track) || self.support[track] >= 2 && seen.any(|k| takes_all[self.problem.view_of(k)])
        };
        (0..self.points.len()).filter(holds).collect()
    }

    /// What is kept of these points: those of the longest tracks until every view has `of_view` observations.
    fn reconstruction(&self, tracks: Vec<usize>, of_view: usize) -> ProjectiveReconstruction {
        let problem = self.problem;
        let views = self.views();
        let mut place = vec![usize::MAX; self.cameras.len()];
        views.iter().enumerate().for_each(|(new, &view)| place[view] = new);
        let wanted = vec![of_view; self.cameras.len()];
        let tracks = growth::covering(problem, tracks, |track| self.support[track], &self.kept, &wanted);
        let observations = tracks.iter().enumerate().flat_map(|(point, &track)| {
            let kept = problem.of_track(track).filter(|&k| self.kept[k]);
            kept.map(|k| Observation { view: place[problem.view_of(k)], point, ..problem.pinhole_observation(k) })
                .collect::<Vec<_>>()
        });
        ProjectiveReconstruction {
            cameras: views.iter().filter_map(|&view| self.cameras[view]).collect(),
            points: tracks.iter().filter_map(|&track| self.points[track]).collect(),
            observations: observations.collect(),
            noise: self.noise,
            tried: problem.verifiable(self.of_static, |view| self.cameras[view].is_some()),
            views,
            tracks,
        }
    }

    /// Adjusts all registered views with the points that hold them best, and estimates the noise from what remains.
    fn adjust(&mut self, iterations: usize, recorder: &mut Recorder) {
        let mut reconstruction = self.reconstruction(self.adjusted_tracks(), self.options.of_view);
        if reconstruction.observations.is_empty() {
            return;
        }
        let options = self.options.adjustment(iterations, self.noise);
        let ProjectiveReconstruction { cameras, points, observations, .. } = &mut reconstruction;
        bundle::projective::adjust(cameras, points, observations, &options, self.problem.stop);
        recorder.heartbeat();
        if self.problem.stop.is_stopped() {
            return;
        }
        self.noise = self.noise_of(&reconstruction).unwrap_or(self.noise);
        let reconstruction = reconstruction.oriented();
        reconstruction
            .views
            .iter()
            .zip(&reconstruction.cameras)
            .for_each(|(&view, camera)| self.cameras[view] = Some(*camera));
    }

    /// Core noise of the residuals within bounds, see [`core_noise`].
    fn noise_of(&self, reconstruction: &ProjectiveReconstruction) -> Option<f64> {
        let norms: Vec<f64> = reconstruction.squared_residuals().into_iter().map(f64::sqrt).collect();
        let unknowns = bundle::projective::unknowns(reconstruction.views.len(), reconstruction.tracks.len());
        let noise = core_noise(norms, unknowns)?;
        let options = NoiseOptions::DEFAULT;
        Some(options.clamp(noise).min(options.clamp(self.options.noise_growth * self.start_noise)))
    }

    /// Takes back the views that too few points hold, and returns them.
    fn drop_unsupported(&mut self) -> Vec<usize> {
        let problem = self.problem;
        let mut dropped = Vec::new();
        for view in self.views() {
            let of_view = problem.of_view[view].iter().map(|&k| k as usize);
            let held = of_view.filter(|&k| self.kept[k] && self.is_verified(problem.track_of(k))).count();
            if held < self.options.least_agreeing {
                dropped.push(view);
                self.cameras[view] = None;
                for &k in &problem.of_view[view] {
                    let k = k as usize;
                    if std::mem::take(&mut self.kept[k]) {
                        self.support[problem.track_of(k)] -= 1;
                    }
                }
            }
        }
        dropped
    }

    fn finish(self) -> ProjectiveReconstruction {
        self.reconstruction(self.verified(), usize::MAX)
    }
}

impl Growth for Growing<'_> {
    fn registered(&self) -> usize {
        self.cameras.iter().flatten().count()
    }

    fn is_open(&self, view: usize) -> bool {
        self.cameras[view].is_none()
    }

    fn supporting(&self, view: usize) -> Vec<usize> {
        self.points_for(view).collect()
    }

    fn register(&mut self, view: usize, seen: &[usize], recorder: &mut Recorder) -> usize {
        let problem = self.problem;
        let datum = |&k: &usize| {
            let Observation { xy, weight, .. } = problem.pinhole_observation(k);
            Some(Correspondence { point: self.points[problem.track_of(k)]?, xy, weight })
        };
        let seen: Vec<_> = seen.iter().filter_map(datum).collect();
        let gate = problem.gate(self.noise);
        let least = self.options.least_agreeing.max((self.options.least_share * seen.len() as f64).ceil() as usize);
        let found = resection::robust(&seen, gate, least, &mut self.rng, problem.stop);
        let Some((camera, agrees)) = found else { return 0 };
        let points = seen.iter().zip(&agrees).filter(|(_, agrees)| **agrees).map(|(seen, _)| &seen.point);
        let sign: f64 = points.map(|point| ((camera.row(2) * point).x * point.w).signum()).sum();
        self.cameras[view] = Some(if sign < 0.0 { -camera } else { camera });
        if self.options.gives_points {
            self.triangulate(Some(view), recorder);
        }
        recorder.registered(self.registered());
        agrees.into_iter().filter(|agrees| *agrees).count()
    }

    fn settle(&mut self, recorder: &mut Recorder) {
        self.adjust(self.options.growing_iterations, recorder);
        self.triangulate(None, recorder);
    }
}
