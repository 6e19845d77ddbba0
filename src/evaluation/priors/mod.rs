//! What the search starts from, compared: every prior that ranks image points, alone and at several lengths of the
//! search ([`alone`]), and AUTO with and without the network that was trained beforehand. [`scenes`] are the scenes,
//! [`table`] shows the rows; [`sweep`] is where a constant of the search comes from.

pub mod scenes;
pub mod sweep;
pub mod table;

use serde::{Deserialize, Serialize};

use scpsfm_core::evaluation::proposal::Study;

use crate::domain::{Input, Limits, Proposal, Silent, SolveSettings, Status, StopToken};
use crate::evaluation::records;
use crate::evaluation::summary::mean;
use crate::solver;
use crate::statistics::median;
use crate::synthetic::metrics::{agreement, average_precision};
use crate::synthetic::{Scene, SceneOptions};
pub use scenes::Condition;

/// Priors that rank image points by themselves.
pub const PRIORS: [Proposal; 4] = [Proposal::Uniform, Proposal::Consistency, Proposal::Irls, Proposal::Learned];
/// Samples of the searches.
pub const SAMPLES: [usize; 3] = [600, 6_000, 60_000];
/// First seed: above those of the sweeps, so that nothing was chosen on these scenes.
const FIRST_SEED: u64 = 500_000;

/// A prior under one condition; means over the seeds, times are medians.
#[derive(Debug, Clone, Serialize)]
pub struct PriorRow {
    pub condition: &'static str,
    pub prior: Proposal,
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
    /// The mean says what many solves take, the median what the usual one takes: without the trained network a few
    /// searches take most of the time.
    pub mean_seconds: f64,
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

/// The file of the records.
pub const RECORDS: &str = "priors.jsonl";

/// The records of the comparison.
pub type Records = records::Records<Run, Measured>;

/// One scene, given to AUTO with and without the learned prior, and to every prior alone if that is asked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    scene: SceneOptions,
    each_prior: bool,
}

/// One scene's measures.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Measured {
    priors: Vec<Alone>,
    /// With the learned prior, and without.
    auto: [Answer; 2],
}

/// One prior on one scene.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Alone {
    prior: Proposal,
    average_precision: Option<f64>,
    f1_of_ranking: f64,
    ranking_seconds: f64,
    f1: Vec<f64>,
    seconds: Vec<f64>,
}

/// AUTO's answer on one scene.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Answer {
    f1: f64,
    solved: bool,
    ranked: bool,
    average_precision: Option<f64>,
    seconds: f64,
}

impl Plan {
    /// Every scene, seed by seed, so that a stopped comparison has all conditions with fewer seeds.
    pub fn runs(&self) -> Vec<Run> {
        (0..self.seeds)
            .flat_map(|seed| self.conditions.iter().map(move |condition| self.run(condition, seed)))
            .collect()
    }

    fn run(&self, condition: &Condition, seed: u64) -> Run {
        Run { scene: condition.scene(FIRST_SEED + seed), each_prior: self.each_prior }
    }

    /// The rows of what is recorded.
    pub fn rows(&self, records: &Records) -> Rows {
        let mut rows = Rows::default();
        for condition in &self.conditions {
            let here: Vec<&Measured> =
                (0..self.seeds).filter_map(|seed| records.get(&self.run(condition, seed))).collect();
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

/// One scene; `None` where it was stopped.
///
/// # Errors
/// A scene that cannot be made, or a defect of the solver, in words.
pub fn measure(run: &Run, stop: &StopToken) -> Result<Option<Measured>, String> {
    let scene = Scene::generate(&run.scene).map_err(|error| error.to_string())?;
    let truth = &scene.truth.inlier;
    let input = Input::new(scene.input.clone(), &Limits::default(), "scene").map_err(|error| error.to_string())?;
    let answer = |excluded_proposals: Vec<Proposal>| {
        let settings = SolveSettings { excluded_proposals, ..SolveSettings::default() };
        match solver::solve(&input, &settings, &mut Silent, stop) {
            Ok(solution) => Ok(Some(answer(&solution, truth))),
            Err(solver::Error::Stopped(_)) => Ok(None),
            Err(error) => Err(error.to_string()),
        }
    };
    let priors = match run.each_prior {
        true => alone(&Study::new(&input, stop), truth, run.scene.seed, stop),
        false => Vec::new(),
    };
    let Some(with) = answer(Vec::new())? else { return Ok(None) };
    let Some(without) = answer(vec![Proposal::Learned])? else { return Ok(None) };
    Ok(Some(Measured { priors, auto: [with, without] }))
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

fn prior_row(condition: &'static str, prior: Proposal, alone: &[&Alone]) -> PriorRow {
    let of_samples = |value: fn(&Alone) -> &Vec<f64>| {
        move |k: usize| -> Vec<f64> { alone.iter().map(|alone| value(alone)[k]).collect() }
    };
    let (f1, seconds) = (of_samples(|alone| &alone.f1), of_samples(|alone| &alone.seconds));
    let ranking: Vec<f64> = alone.iter().map(|alone| alone.f1_of_ranking).collect();
    PriorRow {
        condition,
        prior,
        seeds: alone.len(),
        average_precision: mean(alone.iter().filter_map(|alone| alone.average_precision)),
        f1_of_ranking: (prior == Proposal::Learned).then(|| mean(ranking)).flatten(),
        ranking_seconds: median(&mut alone.iter().map(|alone| alone.ranking_seconds).collect::<Vec<_>>()),
        f1: (0..SAMPLES.len()).filter_map(|k| mean(f1(k))).collect(),
        seconds: (0..SAMPLES.len()).map(|k| median(&mut seconds(k))).collect(),
    }
}

fn auto_row(condition: &'static str, learned: bool, answers: &[&Answer]) -> AutoRow {
    let f1: Vec<f64> = answers.iter().map(|answer| answer.f1).collect();
    let mut seconds: Vec<f64> = answers.iter().map(|answer| answer.seconds).collect();
    let count = |wanted: fn(&Answer) -> bool| answers.iter().filter(|answer| wanted(answer)).count();
    AutoRow {
        condition,
        learned,
        seeds: answers.len(),
        f1: mean(f1.iter().copied()).unwrap_or(0.0),
        least_f1: f1.iter().copied().fold(f64::INFINITY, f64::min),
        average_precision_of_ranking: mean(answers.iter().filter_map(|answer| answer.average_precision)),
        verified: count(|answer| answer.solved),
        ranked: count(|answer| answer.ranked),
        none: count(|answer| !answer.solved && !answer.ranked),
        mean_seconds: mean(seconds.iter().copied()).unwrap_or(0.0),
        median_seconds: median(&mut seconds),
    }
}
