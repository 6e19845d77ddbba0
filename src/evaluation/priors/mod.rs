//! What the search starts from, compared: every prior that ranks image points, alone and at several lengths of the
//! search, and AUTO with and without the network that was trained beforehand. [`scenes`] are the scenes, [`table`]
//! shows the rows; [`windows`] does so for the windows of real sequences.

pub mod scenes;
pub mod table;
pub mod windows;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

use serde::Serialize;

use crate::domain::{Input, Limits, Prior, Silent, SolveSettings, Status, StopToken};
use crate::geometry::statistics::median;
use crate::solver::{self, study::Study};
use crate::synthetic::Scene;
use crate::synthetic::metrics::{agreement, average_precision};
pub use scenes::Condition;

/// Priors that rank image points by themselves.
pub const PRIORS: [Prior; 4] = [Prior::Uniform, Prior::Consistency, Prior::Irls, Prior::Learned];
/// Samples of the searches.
pub const SAMPLES: [usize; 3] = [600, 6_000, 60_000];
/// First seed: above those of the sweeps, so that nothing was chosen on these scenes.
const FIRST_SEED: u64 = 500_000;

/// A prior under one condition; means over the seeds, times are medians.
#[derive(Debug, Clone, Serialize)]
pub struct PriorRow {
    pub condition: &'static str,
    pub prior: Prior,
    pub seeds: usize,
    /// `None`: no scene has a right track.
    pub average_precision: Option<f64>,
    /// Of the tracks that the prior gives a weight above one half; for one whose weights are probabilities.
    pub f1_of_ranking: Option<f64>,
    pub ranking_seconds: f64,
    /// In the order of [`SAMPLES`].
    pub f1: Vec<f64>,
    pub seconds: Vec<f64>,
}

/// AUTO under one condition, with the learned prior or without.
#[derive(Debug, Clone, Serialize)]
pub struct AutoRow {
    pub condition: &'static str,
    pub learned: bool,
    pub seeds: usize,
    /// Of the answer: its inliers, or where nothing was verified the tracks that the ranking gives more than one half.
    pub f1: f64,
    pub least_f1: f64,
    /// Of the ranking that came in place of an answer, over the seeds that have one.
    pub average_precision_of_ranking: Option<f64>,
    /// Answers that geometry verified, rankings, and neither.
    pub verified: usize,
    pub ranked: usize,
    pub none: usize,
    pub median_seconds: f64,
}

/// All rows.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Rows {
    pub priors: Vec<PriorRow>,
    pub auto: Vec<AutoRow>,
}

/// What to run.
#[derive(Debug, Clone)]
pub struct Plan {
    pub conditions: Vec<Condition>,
    pub seeds: u64,
    /// Whether every prior is searched from, too, or only AUTO is run.
    pub each_prior: bool,
}

/// One scene's measures.
struct Measured {
    job: usize,
    place: usize,
    priors: Vec<Alone>,
    /// With the learned prior, and without.
    auto: [Answer; 2],
}

/// One prior on one scene.
struct Alone {
    prior: Prior,
    average_precision: Option<f64>,
    f1_of_ranking: f64,
    ranking_seconds: f64,
    f1: Vec<f64>,
    seconds: Vec<f64>,
}

/// AUTO's answer on one scene.
struct Answer {
    f1: f64,
    solved: bool,
    ranked: bool,
    average_precision: Option<f64>,
    seconds: f64,
}

impl Plan {
    /// Scenes in all.
    pub fn size(&self) -> usize {
        self.conditions.len() * self.seeds as usize
    }

    /// Runs every scene on so many threads; a stopped run leaves out what was not reached.
    ///
    /// # Errors
    /// A scene that cannot be made, or a defect of the solver, in words.
    pub fn run(&self, threads: usize, stop: &StopToken, told: &mut dyn FnMut()) -> Result<Rows, String> {
        let next = AtomicUsize::new(0);
        let (sender, receiver) = mpsc::channel();
        let mut measured = std::thread::scope(|scope| {
            for _ in 0..threads.clamp(1, self.size().max(1)) {
                let (sender, next) = (sender.clone(), &next);
                scope.spawn(move || {
                    while !stop.is_stopped() {
                        let job = next.fetch_add(1, Ordering::Relaxed);
                        if job >= self.size() || sender.send(self.measure(job, stop)).is_err() {
                            break;
                        }
                    }
                });
            }
            drop(sender);
            let mut all = Vec::new();
            for measured in receiver {
                all.extend(measured?);
                told();
            }
            Ok::<_, String>(all)
        })?;
        // Sums in one order, whichever thread was first.
        measured.sort_by_key(|measured: &Measured| measured.job);
        Ok(self.rows(&measured))
    }

    /// One scene; `None` where it was stopped.
    fn measure(&self, job: usize, stop: &StopToken) -> Result<Option<Measured>, String> {
        let seeds = self.seeds as usize;
        let (place, seed) = (job / seeds, FIRST_SEED + (job % seeds) as u64);
        let condition = &self.conditions[place];
        let failed = |error: &dyn std::fmt::Display| format!("{}, seed {seed}: {error}", condition.name);
        let scene = Scene::generate(&condition.scene(seed)).map_err(|error| failed(&error))?;
        let truth = &scene.truth.inlier;
        let input = Input::new(scene.input.clone(), &Limits::default(), "scene").map_err(|error| failed(&error))?;
        let priors = if self.each_prior { alone(&Study::new(&input, stop), truth, seed, stop) } else { Vec::new() };
        let mut auto = Vec::with_capacity(2);
        for excluded in [Vec::new(), vec![Prior::Learned]] {
            let settings = SolveSettings { excluded_priors: excluded, ..SolveSettings::default() };
            match solver::solve(&input, &settings, &mut Silent, stop) {
                Ok(solution) => auto.push(answer(&solution, truth)),
                Err(solver::Error::Stopped(_)) => return Ok(None),
                Err(error) => return Err(failed(&error)),
            }
        }
        let auto = auto.try_into().map_err(|_| failed(&"two answers were asked for"))?;
        Ok(Some(Measured { job, place, priors, auto }))
    }

    fn rows(&self, measured: &[Measured]) -> Rows {
        let mut rows = Rows::default();
        for (place, condition) in self.conditions.iter().enumerate() {
            let here: Vec<&Measured> = measured.iter().filter(|measured| measured.place == place).collect();
            if here.is_empty() {
                continue;
            }
            for prior in PRIORS {
                let alone: Vec<&Alone> =
                    here.iter().flat_map(|measured| &measured.priors).filter(|alone| alone.prior == prior).collect();
                if !alone.is_empty() {
                    rows.priors.push(prior_row(condition.name, prior, &alone));
                }
            }
            for (k, learned) in [true, false].into_iter().enumerate() {
                let answers: Vec<&Answer> = here.iter().map(|measured| &measured.auto[k]).collect();
                rows.auto.push(auto_row(condition.name, learned, &answers));
            }
        }
        rows
    }
}

/// Every prior by itself.
fn alone(study: &Study, truth: &[bool], seed: u64, stop: &StopToken) -> Vec<Alone> {
    let mut all = Vec::new();
    for prior in PRIORS {
        let Some(ranking) = study.rank(prior).filter(|_| !stop.is_stopped()) else { continue };
        let likely: Vec<bool> = ranking.weights.iter().map(|&weight| weight > 0.5).collect();
        let found: Vec<_> = SAMPLES.iter().map(|&samples| study.search(&ranking, samples, seed)).collect();
        all.push(Alone {
            prior,
            average_precision: average_precision(&ranking.weights, truth),
            f1_of_ranking: agreement(&likely, truth).f1,
            ranking_seconds: ranking.seconds,
            f1: found.iter().map(|found| agreement(&found.inlier, truth).f1).collect(),
            seconds: found.iter().map(|found| found.seconds).collect(),
        });
    }
    all
}

fn answer(solution: &crate::domain::Solution, truth: &[bool]) -> Answer {
    let weights: Vec<f64> = solution.tracks.weight.iter().map(|&weight| f64::from(weight)).collect();
    let solved = solution.status == Status::Solved;
    let ranked = !solved && weights.iter().any(|&weight| weight > 0.0);
    let likely: Vec<bool> = weights.iter().map(|&weight| weight > 0.5).collect();
    Answer {
        f1: agreement(if solved { &solution.tracks.inlier } else { &likely }, truth).f1,
        solved,
        ranked,
        average_precision: ranked.then(|| average_precision(&weights, truth)).flatten(),
        seconds: solution.seconds,
    }
}

fn prior_row(condition: &'static str, prior: Prior, alone: &[&Alone]) -> PriorRow {
    let of_samples = |value: fn(&Alone) -> &Vec<f64>| {
        move |k: usize| -> Vec<f64> { alone.iter().map(|alone| value(alone)[k]).collect() }
    };
    let (f1, seconds) = (of_samples(|alone| &alone.f1), of_samples(|alone| &alone.seconds));
    let ranking: Vec<f64> = alone.iter().map(|alone| alone.f1_of_ranking).collect();
    PriorRow {
        condition,
        prior,
        seeds: alone.len(),
        average_precision: mean(&alone.iter().filter_map(|alone| alone.average_precision).collect::<Vec<_>>()),
        f1_of_ranking: (prior == Prior::Learned).then(|| mean(&ranking)).flatten(),
        ranking_seconds: median(&mut alone.iter().map(|alone| alone.ranking_seconds).collect::<Vec<_>>()),
        f1: (0..SAMPLES.len()).filter_map(|k| mean(&f1(k))).collect(),
        seconds: (0..SAMPLES.len()).map(|k| median(&mut seconds(k))).collect(),
    }
}

fn auto_row(condition: &'static str, learned: bool, answers: &[&Answer]) -> AutoRow {
    let f1: Vec<f64> = answers.iter().map(|answer| answer.f1).collect();
    let count = |wanted: fn(&Answer) -> bool| answers.iter().filter(|answer| wanted(answer)).count();
    AutoRow {
        condition,
        learned,
        seeds: answers.len(),
        f1: mean(&f1).unwrap_or(0.0),
        least_f1: f1.iter().copied().fold(f64::INFINITY, f64::min),
        average_precision_of_ranking: mean(
            &answers.iter().filter_map(|answer| answer.average_precision).collect::<Vec<_>>(),
        ),
        verified: count(|answer| answer.solved),
        ranked: count(|answer| answer.ranked),
        none: count(|answer| !answer.solved && !answer.ranked),
        median_seconds: median(&mut answers.iter().map(|answer| answer.seconds).collect::<Vec<_>>()),
    }
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
