//! A projective reconstruction grown from a consensus: view after view by resection, every track by robust
//! triangulation, both kept straight by projective bundle adjustment.
//!
//! It needs no calibration, so it reaches the views where none can be given, and it judges by observation, so a track
//! with some wrong observations takes part by the others.

use nalgebra::{Matrix4, Vector2, Vector4};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::adjust;
use super::model::Scene;
use super::options::ProjectiveOptions;
use crate::domain::StopToken;
use crate::geometry::bundle::{self, Loss};
use crate::geometry::observation::Observation;
use crate::geometry::robust_triangulation::{Robust, Triangulator};
use crate::geometry::triangulation::weighted_squared;
use crate::geometry::{Camera, Point, resection};
use crate::solver::block::Block;
use crate::solver::classification;
use crate::solver::grow::Consensus;
use crate::solver::per_track::{BATCH, TRACKS_A_RUN, WORTH_A_THREAD};
use crate::solver::recorder::Recorder;
use crate::solver::{Error, grow};

/// Unknowns of a projective camera, and of the frame that none of them tells.
const CAMERA_UNKNOWNS: usize = 11;
const GAUGE_UNKNOWNS: usize = 15;

/// Cameras and points up to a common projective transform, with the observations that agree with them.
#[derive(Debug, Clone)]
pub struct Projective {
    /// Registered views of the input, increasing.
    pub views: Vec<usize>,
    /// One a registered view.
    pub cameras: Vec<Camera>,
    /// Tracks of the input that have a point, increasing.
    pub tracks: Vec<usize>,
    pub points: Vec<Point>,
    /// Indices into `views` and `tracks`.
    pub observations: Vec<Observation>,
    /// One standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Tracks that a point was looked for of.
    pub tried: usize,
}

impl Projective {
    /// The inliers of a consensus, with all their observations.
    pub fn of_block(block: &Block, consensus: &Consensus) -> Self {
        let inliers = consensus.inliers();
        Self {
            views: block.views.clone(),
            cameras: consensus.cameras.clone(),
            tracks: inliers.iter().map(|&track| block.tracks[track]).collect(),
            points: inliers.iter().map(|&track| consensus.points[track]).collect(),
            observations: grow::observations_of(&block.complete, &inliers),
            noise: consensus.noise,
            tried: block.tracks.len(),
        }
    }

    /// The tracks with most observations, evenly among equals: a calibration takes no more than these.
    pub fn most_observed(&self, most: usize) -> Self {
        let mut support = vec![0usize; self.tracks.len()];
        self.observations.iter().for_each(|seen| support[seen.point] += 1);
        let mut chosen: Vec<usize> = (0..self.tracks.len()).collect();
        if chosen.len() <= most {
            return self.clone();
        }
        // Evenly among equals, so that no end of the input is left out.
        chosen.sort_by_key(|&k| std::cmp::Reverse(support[k]));
        let last = support[chosen[most - 1]];
        let sure: Vec<usize> = chosen.iter().copied().filter(|&k| support[k] > last).collect();
        let equal: Vec<usize> = chosen.iter().copied().filter(|&k| support[k] == last).collect();
        let mut chosen = [crate::solver::extend::evenly(&equal, most - sure.len()), sure].concat();
        chosen.sort_unstable();
        self.select(&chosen)
    }

    /// These of its tracks, increasing.
    fn select(&self, chosen: &[usize]) -> Self {
        let mut place = vec![usize::MAX; self.tracks.len()];
        chosen.iter().enumerate().for_each(|(new, &old)| place[old] = new);
        let kept = self.observations.iter().filter(|seen| place[seen.point] != usize::MAX);
        Self {
            views: self.views.clone(),
            cameras: self.cameras.clone(),
            tracks: chosen.iter().map(|&k| self.tracks[k]).collect(),
            points: chosen.iter().map(|&k| self.points[k]).collect(),
            observations: kept.map(|seen| Observation { point: place[seen.point], ..*seen }).collect(),
            noise: self.noise,
            tried: self.tried,
        }
    }

    /// How much better the observations fit than points anywhere in the image would, see [`evidence`].
    pub fn evidence(&self, outlier_density: f64) -> f64 {
        let unknowns = CAMERA_UNKNOWNS * self.views.len() + 3 * self.tracks.len() - GAUGE_UNKNOWNS;
        evidence(self.observations.len(), unknowns, self.noise, outlier_density)
    }

    /// The same reconstruction in a frame in which "in front of the camera" means what it says: every camera and point
    /// at the sign at which depths are positive, and the mean principal plane at infinity, so that no point is there
    /// (Hartley & Zisserman, chapter 21: a quasi-affine frame).
    pub fn oriented(mut self) -> Self {
        let depth = |camera: &Camera, point: &Point| (camera.row(2) * point).x;
        let mut of_point = vec![0.0f64; self.points.len()];
        let mut of_camera = vec![0.0f64; self.cameras.len()];
        let signs: Vec<f64> = self
            .observations
            .iter()
            .map(|seen| depth(&self.cameras[seen.view], &self.points[seen.point]).signum())
            .collect();
        // The first camera decides; signs spread over what they share points with.
        if let Some(first) = of_camera.first_mut() {
            *first = 1.0;
        }
        for _ in 0..ORIENTATION_ROUNDS {
            vote(
                &mut of_point,
                self.observations.iter().zip(&signs).map(|(seen, sign)| (seen.point, sign * of_camera[seen.view])),
            );
            vote(
                &mut of_camera,
                self.observations.iter().zip(&signs).map(|(seen, sign)| (seen.view, sign * of_point[seen.point])),
            );
        }
        let sign = |sign: f64| if sign < 0.0 { -1.0 } else { 1.0 };
        self.cameras.iter_mut().zip(&of_camera).for_each(|(camera, own)| *camera *= sign(*own));
        self.points.iter_mut().zip(&of_point).for_each(|(point, own)| *point *= sign(*own));
        let plane: Vector4<f64> =
            self.cameras.iter().filter_map(|camera| camera.row(2).transpose().try_normalize(f64::MIN_POSITIVE)).sum();
        if let Some(frame) = frame_with_plane_at_infinity(&plane) {
            // The frame is orthogonal: its inverse is its transpose.
            self.cameras.iter_mut().for_each(|camera| *camera *= frame.transpose());
            self.points.iter_mut().for_each(|point| *point = frame * *point);
        }
        self
    }
}

/// Logarithm of how much better this many observations fit than points anywhere in the image would, summed over the
/// constraints that the unknowns leave: what one reconstruction of an input is preferred to another by.
///
/// * `noise`: one standard deviation of a coordinate
/// * `outlier_density`: see [`classification::Geometry::outlier_density`]
pub fn evidence(observations: usize, unknowns: usize, noise: f64, outlier_density: f64) -> f64 {
    let constraints = (2 * observations) as f64 - unknowns as f64;
    -constraints * (outlier_density * noise * (std::f64::consts::TAU * std::f64::consts::E).sqrt()).ln()
}

/// Rounds after which every camera and point that observations join to the first has a sign.
const ORIENTATION_ROUNDS: usize = 6;

/// Sets each entry to the sign of the sum of its votes; without any it stays.
fn vote(signs: &mut [f64], votes: impl Iterator<Item = (usize, f64)>) {
    let mut sums = vec![0.0; signs.len()];
    votes.for_each(|(place, vote)| sums[place] += vote);
    for (sign, sum) in signs.iter_mut().zip(sums) {
        if sum != 0.0 {
            *sign = f64::signum(sum);
        }
    }
}

/// The orthogonal transform of points whose last coordinate is their distance from a plane; `None` of no plane.
fn frame_with_plane_at_infinity(plane: &Vector4<f64>) -> Option<Matrix4<f64>> {
    let plane = plane.try_normalize(f64::MIN_POSITIVE)?;
    // The reflection that takes the plane to the last axis (Householder).
    let last = Vector4::w();
    Some(match (plane - last).try_normalize(1e-12) {
        Some(normal) => Matrix4::identity() - 2.0 * normal * normal.transpose(),
        None => Matrix4::identity(),
    })
}

/// A reconstruction while it grows, indexed as the input is.
struct Growing<'a> {
    scene: &'a Scene<'a>,
    options: &'a ProjectiveOptions,
    cameras: Vec<Option<Camera>>,
    points: Vec<Option<Point>>,
    /// Observations that agree with the point of each track.
    support: Vec<usize>,
    /// One an observation.
    kept: Vec<bool>,
    noise: f64,
    start_noise: f64,
}

/// Grows a reconstruction to every view that can be registered, and every track that points are found for.
///
/// # Errors
/// [`Error::Stopped`].
pub fn extend(
    scene: &Scene,
    start: Projective,
    options: &ProjectiveOptions,
    recorder: &mut Recorder,
) -> Result<Projective, Error> {
    let mut growing = Growing::new(scene, options, start.oriented());
    growing.triangulate(None, recorder);
    let mut rng = ChaCha8Rng::seed_from_u64(scene.context.settings.seed);
    let mut failed = vec![0usize; scene.of_view.len()];
    let mut adjusted_at = growing.views().len();
    loop {
        scene.context.stopped()?;
        let registered = growing.views().len();
        if registered as f64 >= options.adjust_growth * adjusted_at as f64 {
            growing.adjust(options.growing_iterations, recorder);
            growing.triangulate(None, recorder);
            adjusted_at = registered;
        }
        let Some((view, seen)) = growing.next(&failed).filter(|_| registered < options.most_views) else {
            if registered == adjusted_at {
                break;
            }
            growing.adjust(options.growing_iterations, recorder);
            growing.triangulate(None, recorder);
            adjusted_at = registered;
            continue;
        };
        if growing.register(view, &seen, &mut rng) {
            growing.triangulate(Some(view), recorder);
            recorder.registered(growing.views().len());
            recorder.heartbeat();
        } else {
            failed[view] = seen.len();
        }
    }
    for _ in 0..options.final_rounds {
        scene.context.stopped()?;
        growing.adjust(options.final_iterations, recorder);
        growing.triangulate(None, recorder);
        growing.drop_unsupported();
    }
    scene.context.stopped()?;
    Ok(growing.finish())
}

impl<'a> Growing<'a> {
    fn new(scene: &'a Scene<'a>, options: &'a ProjectiveOptions, start: Projective) -> Self {
        let mut cameras = vec![None; scene.of_view.len()];
        start.views.iter().zip(&start.cameras).for_each(|(&view, camera)| cameras[view] = Some(*camera));
        Self {
            scene,
            options,
            cameras,
            points: vec![None; scene.tracks()],
            support: vec![0; scene.tracks()],
            kept: vec![false; scene.xy.len()],
            noise: start.noise,
            start_noise: start.noise,
        }
    }

    fn views(&self) -> Vec<usize> {
        (0..self.cameras.len()).filter(|&view| self.cameras[view].is_some()).collect()
    }

    /// Tracks that enough registered views see.
    fn tried(&self) -> usize {
        let seen = |track: &usize| {
            self.scene.of_track(*track).filter(|&k| self.cameras[self.scene.view_of(k)].is_some()).count()
        };
        (0..self.scene.tracks()).filter(|track| seen(track) >= self.options.least_support).count()
    }

    fn is_verified(&self, track: usize) -> bool {
        self.support[track] >= self.options.least_support
    }

    /// Triangulates every track anew, or those that a view sees.
    fn triangulate(&mut self, of_view: Option<usize>, recorder: &mut Recorder) {
        let scene = self.scene;
        let tracks: Vec<usize> = match of_view {
            Some(view) => scene.of_view[view].iter().map(|&k| scene.track_of(k as usize)).collect(),
            None => (0..scene.tracks()).collect(),
        };
        let cameras: Vec<Camera> = self.cameras.iter().map(|camera| camera.unwrap_or_else(Camera::zeros)).collect();
        let triangulator = Triangulator::new(&cameras);
        let gate = classification::working_gate(self.noise, scene.outlier_density);
        let threads = scene.context.threads.if_worth(tracks.len() >= WORTH_A_THREAD);
        for batch in tracks.chunks(BATCH) {
            let standing = &*self;
            let point = |place: usize| standing.point(&triangulator, gate, batch[place], scene.stop());
            let found = threads.map(batch.len(), TRACKS_A_RUN, point, &mut |_| recorder.heartbeat());
            if scene.stop().is_stopped() {
                return;
            }
            for (&track, found) in batch.iter().zip(found) {
                scene.of_track(track).for_each(|k| self.kept[k] = false);
                self.points[track] = found.as_ref().map(|(found, _)| found.point);
                self.support[track] = 0;
                if let Some((found, seen)) = found {
                    for (k, _) in seen.into_iter().zip(found.agrees).filter(|(_, agrees)| *agrees) {
                        self.kept[k] = true;
                        self.support[track] += 1;
                    }
                }
            }
        }
    }

    /// The point of a track, and the observations that it was looked for among.
    fn point(
        &self,
        triangulator: &Triangulator,
        gate: f64,
        track: usize,
        stop: &StopToken,
    ) -> Option<(Robust, Vec<usize>)> {
        if stop.is_stopped() {
            return None;
        }
        let scene = self.scene;
        let seen: Vec<usize> = scene.of_track(track).filter(|&k| self.cameras[scene.view_of(k)].is_some()).collect();
        let observations: Vec<Observation> = seen.iter().map(|&k| scene.observation(k)).collect();
        triangulator.robust(&observations, gate).map(|found| (found, seen))
    }

    /// The view to try next, the one that sees most verified points, with its observations of these; a view that failed
    /// is tried again once it sees more.
    fn next(&self, failed: &[usize]) -> Option<(usize, Vec<usize>)> {
        let scene = self.scene;
        let seen = |view: usize| -> Vec<usize> {
            let of_view = scene.of_view[view].iter().map(|&k| k as usize);
            of_view.filter(|&k| self.is_verified(scene.track_of(k))).collect()
        };
        let open = (0..self.cameras.len()).filter(|&view| self.cameras[view].is_none());
        let candidates = open.map(|view| (view, seen(view))).filter(|(view, seen)| {
            let again = failed[*view] == 0 || seen.len() as f64 >= self.options.retry_growth * failed[*view] as f64;
            seen.len() >= self.options.least_agreeing && again
        });
        // The first of equals, so that one input has one answer.
        candidates.max_by(|a, b| a.1.len().cmp(&b.1.len()).then(b.0.cmp(&a.0)))
    }

    /// Registers a view by these observations of verified points; whether enough of them agree.
    fn register(&mut self, view: usize, seen: &[usize], rng: &mut ChaCha8Rng) -> bool {
        let scene = self.scene;
        let step = seen.len().div_ceil(self.options.most_resected).max(1);
        let seen: Vec<usize> = seen.iter().copied().step_by(step).collect();
        let (points, images): (Vec<Point>, Vec<Vector2<f64>>) =
            seen.iter().filter_map(|&k| Some((self.points[scene.track_of(k)]?, scene.xy[k]))).unzip();
        let gate = classification::working_gate(self.noise, scene.outlier_density);
        let least = self.options.least_agreeing.max((self.options.least_share * points.len() as f64).ceil() as usize);
        let Some((camera, agrees)) = resection::robust(&points, &images, gate, least, rng, scene.stop()) else {
            return false;
        };
        let depths = points.iter().zip(&agrees).filter(|(_, agrees)| **agrees);
        let sign: f64 = depths.map(|(point, _)| ((camera.row(2) * point).x * point.w).signum()).sum();
        self.cameras[view] = Some(if sign < 0.0 { -camera } else { camera });
        true
    }

    /// What is kept: the verified points of the longest tracks until every view has `of_view` observations.
    fn standing(&self, of_view: usize) -> Projective {
        let scene = self.scene;
        let views = self.views();
        let mut place = vec![usize::MAX; self.cameras.len()];
        views.iter().enumerate().for_each(|(new, &view)| place[view] = new);
        let mut tracks: Vec<usize> = (0..self.points.len()).filter(|&track| self.is_verified(track)).collect();
        tracks.sort_by_key(|&track| (std::cmp::Reverse(self.support[track]), track));
        let mut observed = vec![0usize; views.len()];
        tracks.retain(|&track| {
            let kept = || scene.of_track(track).filter(|&k| self.kept[k]).map(|k| place[scene.view_of(k)]);
            let needed = kept().any(|view| observed[view] < of_view);
            if needed {
                kept().for_each(|view| observed[view] += 1);
            }
            needed
        });
        tracks.sort_unstable();
        let observations = tracks.iter().enumerate().flat_map(|(point, &track)| {
            let kept = scene.of_track(track).filter(|&k| self.kept[k]);
            kept.map(|k| Observation { view: place[scene.view_of(k)], point, ..scene.observation(k) })
                .collect::<Vec<_>>()
        });
        Projective {
            cameras: views.iter().filter_map(|&view| self.cameras[view]).collect(),
            points: tracks.iter().filter_map(|&track| self.points[track]).collect(),
            observations: observations.collect(),
            noise: self.noise,
            tried: self.tried(),
            views,
            tracks,
        }
    }

    /// Adjusts all registered views with the points that hold them best, and estimates the noise from what remains.
    fn adjust(&mut self, iterations: usize, recorder: &mut Recorder) {
        let mut standing = self.standing(self.options.of_view);
        if standing.observations.is_empty() {
            return;
        }
        let options = bundle::Options {
            max_iterations: iterations,
            relative_tolerance: self.options.tolerance,
            loss: Loss::Cauchy { scale: self.options.cauchy_scale * self.noise },
            ..Default::default()
        };
        let Projective { cameras, points, observations, .. } = &mut standing;
        bundle::projective::adjust(cameras, points, observations, &options, self.scene.stop());
        recorder.heartbeat();
        if self.scene.stop().is_stopped() {
            return;
        }
        self.noise = self.noise_of(&standing);
        let standing = standing.oriented();
        standing.views.iter().zip(&standing.cameras).for_each(|(&view, camera)| self.cameras[view] = Some(*camera));
    }

    /// Core noise of the residuals: their median, for what their freedom leaves of it.
    fn noise_of(&self, standing: &Projective) -> f64 {
        let residual = |seen: &Observation| {
            weighted_squared(&standing.cameras[seen.view], &standing.points[seen.point], seen).sqrt()
        };
        let norms: Vec<f64> = standing.observations.iter().map(residual).collect();
        let unknowns = CAMERA_UNKNOWNS * standing.views.len() + 3 * standing.tracks.len();
        let noise = adjust::core_noise(norms, unknowns);
        let (least, most) = grow::NOISE_BOUNDS;
        noise.clamp(least, (self.options.noise_growth * self.start_noise).min(most))
    }

    /// Takes back the views that too few points hold.
    fn drop_unsupported(&mut self) {
        let scene = self.scene;
        for view in self.views() {
            let of_view = scene.of_view[view].iter().map(|&k| k as usize);
            let held = of_view.filter(|&k| self.kept[k] && self.is_verified(scene.track_of(k))).count();
            if held < self.options.least_agreeing {
                self.cameras[view] = None;
                for &k in &scene.of_view[view] {
                    let k = k as usize;
                    if std::mem::take(&mut self.kept[k]) {
                        self.support[scene.track_of(k)] -= 1;
                    }
                }
            }
        }
    }

    fn finish(self) -> Projective {
        self.standing(usize::MAX)
    }
}
