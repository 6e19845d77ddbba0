//! Inputs that only an estimator which judges single observations can solve: this program, and another one beside it
//! on the same files. [`conditions`] are the inputs, [`table`] shows the rows. The photographed scenes are inputs, too;
//! [`super::photographed`] has their plan and their tables.

pub mod conditions;
mod sample;
mod solvers;
pub mod table;

use serde::{Deserialize, Serialize};

use crate::domain::{Grade, StopToken};
use crate::evaluation::real::Side;
use crate::evaluation::records;
use crate::statistics::median;
use crate::synthetic::PhotographedOptions;
use crate::synthetic::metrics::agreement;
use crate::synthetic::photographed::FocalKind;
pub use conditions::Condition;
pub use sample::Generator;
use sample::Sample;

/// First seed: above those of the other evaluations.
const FIRST_SEED: u64 = 700_000;
/// A METRIC answer is wrong where its focal length is off by more than this, relatively, and by more standard
/// deviations than this.
const WRONG_FOCAL: f64 = 0.03;
const WRONG_SIGMAS: f64 = 4.0;
/// Standard deviations that a focal length shall be within.
const COVERED_SIGMAS: f64 = 3.0;

/// The file of the records.
pub const RECORDS: &str = "observations.jsonl";

/// The records of the comparison.
pub type Records = records::Records<Run, Measured>;

/// How the cameras are declared to the solver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Declared {
    OneCamera,
    /// The camera groups are the generator's.
    Groups,
    FocalPerView,
}

impl Declared {
    /// What a user knows of the cameras of a photographed scene.
    fn of(options: &PhotographedOptions) -> Self {
        match options.focal {
            FocalKind::ConstantFocal => Declared::OneCamera,
            FocalKind::DriftingFocal => Declared::FocalPerView,
            FocalKind::TwoGroups => Declared::Groups,
        }
    }
}

/// One input given to one side.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    generator: Generator,
    declared: Declared,
    /// The other program and its first arguments; empty: this program.
    peer: Vec<String>,
}

impl Run {
    /// A photographed scene given to a peer, or to this program where the peer has no words.
    pub fn photographed(options: &PhotographedOptions, peer: &[String]) -> Self {
        Self {
            declared: Declared::of(options),
            generator: Generator::Photographed(options.clone()),
            peer: peer.to_vec(),
        }
    }

    /// Whether the input can be given to a peer, which is told of one camera and no more.
    pub fn is_for_peers(&self) -> bool {
        self.declared == Declared::OneCamera
    }
}

/// A focal length of a metric answer against the true one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FocalError {
    /// `ln(f / f_true)`
    pub log_error: f64,
    pub sigma: Option<f64>,
    /// The least that `sigma` can be, where it is known.
    pub bound: Option<f64>,
}

impl FocalError {
    pub fn is_wrong(&self) -> bool {
        self.log_error.abs() > WRONG_FOCAL.max(WRONG_SIGMAS * self.sigma.unwrap_or(0.0))
    }

    fn is_covered(&self) -> bool {
        self.log_error.abs() <= COVERED_SIGMAS * self.sigma.unwrap_or(0.0)
    }
}

/// One answer's measures.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Of the tracks.
    pub f1: f64,
    /// Share of right ones among the observations that were kept.
    pub precision: f64,
    /// Share of kept ones among the right observations of right tracks; of photographed scenes, among the verifiable
    /// ones.
    pub recall: f64,
    /// Share of the views in the largest reconstruction; of photographed scenes, of those that shall be registered.
    pub views: f64,
    /// `None` without a reconstruction. A peer that gives a focal length counts as METRIC.
    pub grade: Option<Grade>,
    /// Of a METRIC or WEAK answer: one a camera group, or one a view where each has its own.
    pub focals: Vec<FocalError>,
    /// Whether the answer warns that the metric model does not fit.
    pub mismatch: bool,
    /// Whether the answer warns of a second structure.
    pub second_structure: bool,
    /// CPU time of the solve; of a peer its whole process, without what `--help` takes.
    pub seconds: f64,
    pub failure: Option<String>,
    /// Largest Cramer-Rao bound of the log focal lengths, where it is known.
    pub bound: Option<f64>,
    /// Observations that were kept, that shall be, and views that shall be registered.
    pub kept: usize,
    pub wanted: usize,
    pub due: usize,
    /// Share of these views that right observations connect, at most.
    pub connected: f64,
    /// Observations of the input.
    pub given: usize,
    /// Absolute trajectory error of the largest reconstruction over the length of the true path, where it is metric and
    /// the truth is known.
    pub trajectory_error: Option<f64>,
    /// Largest memory of this process during the solve, with what other solves beside it hold; `None` where the system
    /// does not tell.
    pub peak_bytes: Option<u64>,
}

/// What either side says of an input.
#[derive(Debug, Clone, Default)]
struct Answer {
    tracks: Vec<bool>,
    observations: Vec<bool>,
    /// Share of the views that shall be registered that are, in the largest reconstruction.
    views: f64,
    grade: Option<Grade>,
    focals: Vec<FocalError>,
    mismatch: bool,
    second_structure: bool,
    seconds: f64,
    trajectory_error: Option<f64>,
    peak_bytes: Option<u64>,
}

impl Measured {
    fn of(sample: &Sample, answer: Answer) -> Self {
        Self {
            f1: agreement(&answer.tracks, &sample.inlier).f1,
            precision: agreement(&answer.observations, &sample.right).precision,
            recall: agreement(&answer.observations, &sample.wanted).recall,
            views: answer.views,
            grade: answer.grade,
            focals: answer.focals,
            mismatch: answer.mismatch,
            second_structure: answer.second_structure,
            seconds: answer.seconds,
            trajectory_error: answer.trajectory_error,
            peak_bytes: answer.peak_bytes,
            kept: count(&answer.observations),
            ..Self::without_answer(sample)
        }
    }

    /// What is known of an input before any answer.
    fn without_answer(sample: &Sample) -> Self {
        Self {
            bound: sample.bounds.as_ref().and_then(|bounds| bounds.iter().copied().reduce(f64::max)),
            wanted: count(&sample.wanted),
            due: count(&sample.due),
            connected: sample.connected,
            given: sample.right.len(),
            ..Self::default()
        }
    }

    pub fn is_metric(&self) -> bool {
        self.grade == Some(Grade::Metric)
    }

    fn observation_f1(&self) -> f64 {
        let sum = self.precision + self.recall;
        if sum > 0.0 { 2.0 * self.precision * self.recall / sum } else { 0.0 }
    }
}

fn count(of: &[bool]) -> usize {
    of.iter().filter(|&&is| is).count()
}

/// Some focal lengths against the true ones; relative.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Focals {
    pub median_error: Option<f64>,
    pub largest_error: Option<f64>,
    pub median_sigma: Option<f64>,
    /// Median of the standard deviation over the Cramer-Rao bound, where that is known.
    pub sigma_over_bound: Option<f64>,
    /// Share within three standard deviations.
    pub covered: Option<f64>,
}

impl Focals {
    fn of<'a>(focals: impl Iterator<Item = &'a FocalError>) -> Self {
        let focals: Vec<&FocalError> = focals.collect();
        let some = |mut values: Vec<f64>| (!values.is_empty()).then(|| median(&mut values));
        let errors: Vec<f64> = focals.iter().map(|focal| focal.log_error.abs()).collect();
        let sigmas: Vec<f64> = focals.iter().filter_map(|focal| focal.sigma).collect();
        let covered = focals.iter().filter(|focal| focal.is_covered()).count() as f64 / focals.len() as f64;
        Self {
            largest_error: errors.iter().copied().reduce(f64::max),
            median_error: some(errors),
            covered: (!sigmas.is_empty()).then_some(covered),
            median_sigma: some(sigmas),
            sigma_over_bound: some(focals.iter().filter_map(|focal| Some(focal.sigma? / focal.bound?)).collect()),
        }
    }
}

/// One condition, one side; means over the seeds unless said, an answer that keeps nothing counting as 0.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub condition: String,
    pub side: Side,
    pub seeds: usize,
    /// Of the tracks.
    pub f1: f64,
    /// Of the observations.
    pub precision: f64,
    pub recall: f64,
    pub observation_f1: f64,
    /// Share of the views in the largest reconstruction.
    pub views: f64,
    /// Answers with a calibration, METRIC or WEAK; those that are METRIC; and of these, those that warn that the metric
    /// model does not fit.
    pub calibrated: usize,
    pub metric: usize,
    pub mismatch: usize,
    /// Of the METRIC answers, and of all that have a calibration.
    pub metric_focals: Focals,
    pub calibrated_focals: Focals,
    /// METRIC ones that are off by more than 3 % and 4 standard deviations.
    pub wrong: usize,
    pub seconds: f64,
    pub failures: Vec<String>,
    /// F1 of the tracks minus the peer's on the same inputs, and the half width of its 95 % interval.
    pub f1_gain: Option<[f64; 2]>,
}

/// What to run.
#[derive(Debug, Clone)]
pub struct Plan {
    pub conditions: Vec<Condition>,
    pub seeds: u64,
    /// The other program and its first arguments; empty: none.
    pub peer: Vec<String>,
}

impl Plan {
    /// Every input, seed by seed, so that a stopped comparison has all conditions with fewer seeds.
    pub fn runs(&self) -> Vec<Run> {
        (0..self.seeds)
            .flat_map(|seed| self.conditions.iter().map(move |condition| (condition, seed)))
            .flat_map(|(condition, seed)| {
                self.sides(condition).into_iter().map(move |side| self.run(condition, seed, side))
            })
            .collect()
    }

    /// Who answers: a peer is told of one camera and no more.
    fn sides(&self, condition: &Condition) -> Vec<Side> {
        match self.peer.is_empty() || condition.declared != Declared::OneCamera {
            true => vec![Side::Scpsfm],
            false => vec![Side::Scpsfm, Side::Peer],
        }
    }

    fn run(&self, condition: &Condition, seed: u64, side: Side) -> Run {
        Run {
            generator: condition.generator.with_seed(FIRST_SEED + seed),
            declared: condition.declared,
            peer: if side == Side::Peer { self.peer.clone() } else { Vec::new() },
        }
    }

    /// The rows of what is recorded.
    pub fn rows(&self, records: &Records) -> Vec<Row> {
        let mut rows = Vec::new();
        for condition in &self.conditions {
            let of = |seed, side| records.get(&self.run(condition, seed, side));
            for side in self.sides(condition) {
                let here: Vec<&Measured> = (0..self.seeds).filter_map(|seed| of(seed, side)).collect();
                if here.is_empty() {
                    continue;
                }
                let pair = |seed| Some(of(seed, Side::Scpsfm)?.f1 - of(seed, Side::Peer)?.f1);
                let gains: Vec<f64> = (0..self.seeds).filter_map(pair).collect();
                let f1_gain = if side == Side::Scpsfm && !self.peer.is_empty() { interval(&gains) } else { None };
                rows.push(Row { f1_gain, ..Row::of(&condition.name, side, &here) });
            }
        }
        rows
    }
}

/// One run; `None` where it was stopped. A peer that fails is an answer.
///
/// # Errors
/// An input that cannot be made, or a defect of the solver, in words.
pub fn measure(run: &Run, stop: &StopToken) -> Result<Option<Measured>, String> {
    let mut sample = run.generator.generate().map_err(|error| error.to_string())?;
    if run.declared != Declared::Groups {
        sample.input.views.iter_mut().for_each(|view| view.camera_group = 0);
    }
    let answer = match run.peer.is_empty() {
        true => solvers::ours(&sample, run.declared, stop)?.map(Ok),
        false => solvers::peer(&sample, &run.peer, stop)?,
    };
    Ok(answer.map(|answer| match answer {
        Ok(answer) => Measured::of(&sample, answer),
        Err(failure) => Measured { failure: Some(failure), ..Measured::without_answer(&sample) },
    }))
}

impl Row {
    /// Of these answers of one side, of which there is one at least; nothing is compared with the other.
    pub fn of(condition: &str, side: Side, here: &[&Measured]) -> Self {
        let mean =
            |value: fn(&Measured) -> f64| here.iter().map(|measured| value(measured)).sum::<f64>() / here.len() as f64;
        let count = |wanted: &dyn Fn(&Measured) -> bool| here.iter().filter(|measured| wanted(measured)).count();
        Self {
            condition: condition.to_owned(),
            side,
            seeds: here.len(),
            f1: mean(|measured| measured.f1),
            precision: mean(|measured| measured.precision),
            recall: mean(|measured| measured.recall),
            observation_f1: mean(Measured::observation_f1),
            views: mean(|measured| measured.views),
            calibrated: count(&|measured| !measured.focals.is_empty()),
            metric: count(&Measured::is_metric),
            mismatch: count(&|measured| measured.is_metric() && measured.mismatch),
            metric_focals: Focals::of(here.iter().filter(|measured| measured.is_metric()).flat_map(|one| &one.focals)),
            calibrated_focals: Focals::of(here.iter().flat_map(|one| &one.focals)),
            wrong: count(&|measured| measured.is_metric() && measured.focals.iter().any(FocalError::is_wrong)),
            seconds: mean(|measured| measured.seconds),
            failures: here.iter().filter_map(|measured| measured.failure.clone()).collect(),
            f1_gain: None,
        }
    }
}

/// Mean and half width of its 95 % interval, normal; `None` for fewer than two.
fn interval(values: &[f64]) -> Option<[f64; 2]> {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0);
    (values.len() > 1).then(|| [mean, 1.96 * (variance / count).sqrt()])
}
