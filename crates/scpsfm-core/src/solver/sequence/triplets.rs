//! Seeds of three views that share tracks in pairs, by the fundamental matrices of these: where tracks are scattered,
//! no three views may share enough for a block.

use std::collections::BTreeMap;
use std::f64::consts::SQRT_2;

use nalgebra::Vector2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::options::{GrowthOptions, TripletOptions};
use crate::domain::Stage;
use crate::geometry::bundle;
use crate::geometry::fundamental::{self, Fundamental, Match};
use crate::geometry::observation::Observation;
use crate::geometry::robust_triangulation::Triangulator;
use crate::geometry::statistics::ln_choose;
use crate::geometry::{Camera, three_views, triangulation};
use crate::solver::a_contrario::FalseAlarmOptions;
use crate::solver::attempt::{self, Attempt};
use crate::solver::error::Error;
use crate::solver::portfolio::Effort;
use crate::solver::problem::Problem;
use crate::solver::projective::ProjectiveReconstruction;
use crate::solver::recorder::Recorder;
use crate::solver::view_selection::{SeedViews, evenly};

const OPTIONS: TripletOptions = TripletOptions::DEFAULT;

/// The epipolar geometry of pairs of views, each looked for once.
pub struct Pairs<'a> {
    problem: &'a Problem<'a>,
    known: BTreeMap<(usize, usize), Option<Pair>>,
}

/// The epipolar geometry of two views.
#[derive(Clone)]
struct Pair {
    fundamental: Fundamental,
    /// Tracks that agree with it, increasing.
    tracks: Vec<usize>,
    /// Natural logarithm of the number of such pairs to be expected in data without structure.
    ln_false_alarms: f64,
}

impl<'a> Pairs<'a> {
    pub fn new(problem: &'a Problem<'a>) -> Self {
        Self { problem, known: BTreeMap::new() }
    }

    /// What is found of these views.
    ///
    /// * `effort`: that a block is searched with
    pub fn search(&mut self, views: &SeedViews, effort: Effort, recorder: &mut Recorder) -> Result<Attempt, Error> {
        match views {
            SeedViews::Block(views) => attempt::search_block(self.problem, self.problem.block(views), effort, recorder),
            SeedViews::Triplet(views) => self.attempt(views, recorder),
        }
    }

    /// What is found of a triplet.
    pub fn attempt(&mut self, views: &[usize; 3], recorder: &mut Recorder) -> Result<Attempt, Error> {
        recorder.enter(Stage::Search);
        let found = self.reconstruction(views);
        self.problem.stopped()?;
        Ok(Attempt::of_projective(self.problem.block(views), found))
    }

    /// The reconstruction of three views by the tracks that two or three of them see; `None` where the pairs have no
    /// epipolar geometry that more tracks agree with than by chance, or no three cameras see most of these tracks.
    ///
    /// * `views`: increasing
    fn reconstruction(&mut self, views: &[usize; 3]) -> Option<ProjectiveReconstruction> {
        let [first, second, third] = *views;
        let pairs = [self.pair(first, second)?, self.pair(first, third)?, self.pair(second, third)?];
        let ln_false_alarms: f64 = pairs.iter().map(|pair| pair.ln_false_alarms).sum();
        if ln_false_alarms >= FalseAlarmOptions::DEFAULT.ln_acceptable {
            return None;
        }
        let agrees = |track: &usize| pairs.iter().all(|pair| pair.tracks.binary_search(track).is_ok());
        let common: Vec<[Vector2<f64>; 3]> = pairs[0]
            .tracks
            .iter()
            .filter(|track| agrees(track))
            .filter_map(|&track| {
                let [a, b, c] = views.map(|view| seen_by(self.problem, track, view));
                Some([a?.xy, b?.xy, c?.xy])
            })
            .collect();
        let cameras = three_views::cameras(pairs.each_ref().map(|pair| &pair.fundamental), &common)?;
        let mut tracks: Vec<usize> = pairs.iter().flat_map(|pair| pair.tracks.iter().copied()).collect();
        tracks.sort_unstable();
        tracks.dedup();
        let adjusted = self.adjusted(views, cameras.to_vec(), tracks);
        let tried = adjusted.tracks.len() as f64;
        let found = self.agreeing(adjusted);
        (found.tracks.len() as f64 >= OPTIONS.least_share * tried).then_some(found)
    }

    /// The cameras adjusted to these tracks. What is linear in matrices of a dozen matches each is too far off to be
    /// gated at their noise.
    fn adjusted(&self, views: &[usize; 3], mut cameras: Vec<Camera>, tracks: Vec<usize>) -> ProjectiveReconstruction {
        let problem = self.problem;
        let (mut points, mut observations) = (Vec::new(), Vec::new());
        for (point, &track) in tracks.iter().enumerate() {
            let seen = |view: usize| Some(Observation { view, point, ..seen_by(problem, track, views[view])? });
            let seen: Vec<Observation> = (0..views.len()).filter_map(seen).collect();
            points.push(triangulation::linear(&cameras, &seen));
            observations.extend(seen);
        }
        let noise = problem.initial_noise;
        let options = GrowthOptions::PROJECTIVE.adjustment(OPTIONS.iterations, noise);
        bundle::projective::adjust(&mut cameras, &mut points, &observations, &options, problem.stop);
        let (views, tried) = (views.to_vec(), tracks.len());
        ProjectiveReconstruction { views, cameras, tracks, points, observations, noise, tried }.oriented()
    }

    /// The points that the cameras agree on, with the observations that they agree by.
    fn agreeing(&self, adjusted: ProjectiveReconstruction) -> ProjectiveReconstruction {
        let gate = self.problem.gate(adjusted.noise);
        let triangulator = Triangulator::new(&adjusted.cameras);
        let (mut tracks, mut points, mut observations) = (Vec::new(), Vec::new(), Vec::new());
        for seen in adjusted.observations.chunk_by(|a, b| a.point == b.point) {
            let Some(found) = triangulator.robust(seen, gate) else { continue };
            let agreeing = seen.iter().zip(&found.agrees).filter(|(_, agrees)| **agrees);
            observations.extend(agreeing.map(|(seen, _)| Observation { point: points.len(), ..*seen }));
            tracks.push(adjusted.tracks[seen[0].point]);
            points.push(found.point);
        }
        ProjectiveReconstruction { tracks, points, observations, ..adjusted }
    }

    /// * `from`, `to`: increasing
    fn pair(&mut self, from: usize, to: usize) -> Option<Pair> {
        let problem = self.problem;
        self.known.entry((from, to)).or_insert_with(|| pair(problem, from, to)).clone()
    }
}

/// The epipolar geometry of two views that is least likely by chance, of all noise levels, all observations alike;
/// `None` where one such is to be expected.
fn pair(problem: &Problem, from: usize, to: usize) -> Option<Pair> {
    let shared = |&k: &usize| {
        let track = problem.track_of(k);
        problem.supports_growth(track, false) && problem.seen_in(track, to).is_some()
    };
    let shared: Vec<usize> = problem.of_view[from].iter().map(|&k| k as usize).filter(shared).collect();
    let match_of = |k: usize| {
        let track = problem.track_of(k);
        let to = seen_by(problem, track, to)?;
        Some((track, Match { from: problem.pinhole_observation(k).xy, to: to.xy }))
    };
    let matched = evenly(&shared, OPTIONS.most_tracks).into_iter().filter_map(match_of);
    let (tracks, matches): (Vec<usize>, Vec<Match>) = matched.unzip();
    let of_noise = |level: &f64| {
        let noise = level * problem.initial_noise;
        let mut rng = ChaCha8Rng::seed_from_u64(problem.settings.seed);
        rng.set_stream((from * problem.views() + to) as u64);
        let found = fundamental::robust(&matches, noise, &mut rng, problem.stop)?;
        let ln_false_alarms = ln_false_alarms(matches.len(), found.inlier_count(), noise, problem.outlier_density);
        let agreeing = tracks.iter().zip(&found.inlier).filter(|(_, inlier)| **inlier).map(|(track, _)| *track);
        Some(Pair { fundamental: found.model, tracks: agreeing.collect(), ln_false_alarms })
    };
    let found = OPTIONS.noise_levels.iter().filter_map(of_noise);
    let best = found.min_by(|a, b| a.ln_false_alarms.total_cmp(&b.ln_false_alarms));
    best.filter(|best| best.ln_false_alarms < 0.0)
}

/// Natural logarithm of the number of such fundamental matrices to be expected among matches without structure:
/// a-contrario as by Moisan & Stival (2004, section 3), `C(m, k) C(k, 8) a^(k - 8)` at each noise, where `a` is the
/// probability that a point anywhere in the image is as near an epipolar line, a diagonal at the longest.
fn ln_false_alarms(matches: usize, inliers: usize, noise: f64, outlier_density: f64) -> f64 {
    let determine = fundamental::LEAST_MATCHES;
    if inliers <= determine {
        return f64::INFINITY;
    }
    // The point that is nearer its line is √2 Sampson distances from it at most, to either side.
    let width = 2.0 * SQRT_2 * fundamental::squared_gate(noise).sqrt();
    let ln_by_chance = (SQRT_2 * width * outlier_density).min(1.0).ln();
    let levels = OPTIONS.noise_levels.len() as f64;
    levels.ln()
        + ln_choose(matches, inliers)
        + ln_choose(inliers, determine)
        + (inliers - determine) as f64 * ln_by_chance
}

/// The observation of a track in a view, where a pinhole would have made it.
fn seen_by(problem: &Problem, track: usize, view: usize) -> Option<Observation> {
    problem.seen_in(track, view).map(|k| problem.pinhole_observation(k))
}
