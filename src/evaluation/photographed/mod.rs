//! Scenes as people photograph them, one for each seed: what an answer is worth by motion, lens, focal lengths,
//! visibility and what is wrong, beside the Cramer-Rao bound of the scene, which tells what was refused from what could
//! not be. The scenes are inputs of [`super::observations`], which solves and measures them; [`table`] shows the rows.

pub mod table;
#[cfg(test)]
mod tests;

use std::ops::Range;

use serde::Serialize;

use crate::domain::Grade;
use crate::evaluation::observations::{Measured, Records, Run};
use crate::evaluation::real::Side;
use crate::evaluation::summary::mean;
use crate::synthetic::PhotographedOptions;
use crate::synthetic::photographed::{FocalKind, LensKind, PhotographedMotion, VisibilityKind, WrongKind};

/// First seed where none is asked for: above those of the other evaluations.
pub const FIRST_SEED: u64 = 800_000;
/// Bound of the log focal length below which a scene carries a calibration: half of what METRIC allows, so that an
/// estimator that is not the best can have it, too.
const CARRIES: f64 = 0.01;
/// Standard deviations beyond which a focal length belies its sigma, and those whose share of all is .68.
const BELIED_SIGMAS: f64 = 3.0;
const ONE_SIGMA: f64 = 1.0;

/// The file of the records.
pub const RECORDS: &str = "photographed.jsonl";

/// A choice that scenes are grouped by, and the value that a scene has of it.
type Axis = (&'static str, fn(&PhotographedOptions) -> &'static str);

/// The groups of the tables, all scenes first.
const AXES: [Axis; 6] = [
    ("all", |_| "all"),
    ("motion", |options| options.motion.name()),
    ("lens", |options| options.lens.name()),
    ("wrong", |options| options.wrong.name()),
    ("focal length", |options| options.focal.name()),
    ("visibility", |options| options.visibility.name()),
];

/// The scene of each seed.
pub fn scenes(seeds: Range<u64>) -> Vec<PhotographedOptions> {
    seeds.map(PhotographedOptions::drawn).collect()
}

/// The words that names of scenes consist of, in their order.
pub fn words() -> String {
    let motions = PhotographedMotion::ALL.map(PhotographedMotion::name).join(", ");
    let lenses = LensKind::ALL.map(LensKind::name).join(", ");
    let focals = FocalKind::ALL.map(FocalKind::name).join(", ");
    let visibilities = VisibilityKind::ALL.map(VisibilityKind::name).join(", ");
    let wrong = WrongKind::ALL.map(WrongKind::name).join(", ");
    format!(
        "motion ({motions}), lens ({lenses}), focal length ({focals}), visibility ({visibilities}) and what is wrong \
         ({wrong})"
    )
}

/// What to run.
#[derive(Debug, Clone)]
pub struct Plan {
    pub scenes: Vec<PhotographedOptions>,
    /// The other program and its first arguments; empty: none.
    pub peer: Vec<String>,
}

impl Plan {
    /// Every scene for every side, scene by scene, so that a stopped evaluation has a balanced part of them.
    pub fn runs(&self) -> Vec<Run> {
        self.scenes.iter().flat_map(|options| self.sides().filter_map(|side| self.run(options, side))).collect()
    }

    fn sides(&self) -> impl Iterator<Item = Side> {
        [Side::Scpsfm].into_iter().chain((!self.peer.is_empty()).then_some(Side::Peer))
    }

    /// `None`: the scene is more than a peer can be told.
    fn run(&self, options: &PhotographedOptions, side: Side) -> Option<Run> {
        match side {
            Side::Scpsfm => Some(Run::photographed(options, &[])),
            Side::Peer => Some(Run::photographed(options, &self.peer)).filter(Run::is_for_peers),
        }
    }

    /// A table for each choice that scenes are grouped by, of what is recorded.
    pub fn tables(&self, records: &Records) -> Vec<Table> {
        AXES.iter().map(|&(by, value)| Table { by, rows: self.rows(value, records) }).collect()
    }

    fn rows(&self, value: fn(&PhotographedOptions) -> &'static str, records: &Records) -> Vec<Row> {
        let mut values: Vec<&str> = Vec::new();
        for options in &self.scenes {
            if !values.contains(&value(options)) {
                values.push(value(options));
            }
        }
        values.sort_unstable();
        let row = |(group, side): (&'static str, Side)| {
            let runs = self.scenes.iter().filter(|options| value(options) == group);
            let here: Vec<&Measured> = runs.filter_map(|options| records.get(&self.run(options, side)?)).collect();
            (!here.is_empty()).then(|| Row::of(group, side, &here))
        };
        values.into_iter().flat_map(|group| self.sides().map(move |side| (group, side))).filter_map(row).collect()
    }
}

/// The rows of one choice.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table {
    pub by: &'static str,
    pub rows: Vec<Row>,
}

/// A group of scenes, one side. Shares are of what is named; `None`: of nothing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub group: &'static str,
    pub side: Side,
    pub scenes: usize,
    /// Share of the scenes whose bound is below .01, and of these that of METRIC answers.
    pub carries: f64,
    pub metric_of_carrying: Option<f64>,
    /// METRIC answers; of these the share beyond 3 sigma, the number off by more than 3 % and 4 sigma, and the share
    /// within 1 sigma.
    pub metric: usize,
    pub metric_belied: Option<f64>,
    pub metric_wrong: usize,
    pub coverage: Option<f64>,
    /// WEAK answers, and their share beyond 3 sigma.
    pub weak: usize,
    pub weak_belied: Option<f64>,
    /// Mean over the answers that keep an observation.
    pub precision: Option<f64>,
    /// Mean over the scenes that have verifiable observations, and views with enough of them; of the latter, what right
    /// observations connect, too.
    pub recall: Option<f64>,
    pub views: Option<f64>,
    pub connected: Option<f64>,
    /// Share of the answers that tell of a second structure; a peer tells none.
    pub second_structure: Option<f64>,
    pub seconds: f64,
    pub failures: Vec<String>,
}

impl Row {
    fn of(group: &'static str, side: Side, here: &[&Measured]) -> Self {
        let of = |grade: Grade| here.iter().copied().filter(move |measured| measured.grade == Some(grade));
        let carrying = || here.iter().copied().filter(|measured| carries(measured));
        let beyond = |grade: Grade| of(grade).filter_map(deviation).map(|sigmas| f64::from(sigmas > BELIED_SIGMAS));
        let within = of(Grade::Metric).filter_map(deviation).map(|sigmas| f64::from(sigmas <= ONE_SIGMA));
        let wanted = || here.iter().copied().filter(|measured| measured.wanted > 0);
        let ours = || here.iter().filter(|_| side == Side::Scpsfm);
        let due = || here.iter().copied().filter(|measured| measured.due > 0);
        Self {
            group,
            side,
            scenes: here.len(),
            carries: carrying().count() as f64 / here.len() as f64,
            metric_of_carrying: mean(carrying().map(|measured| f64::from(measured.is_metric()))),
            metric: of(Grade::Metric).count(),
            metric_belied: mean(beyond(Grade::Metric)),
            metric_wrong: of(Grade::Metric).filter(|one| one.focals.iter().any(|focal| focal.is_wrong())).count(),
            coverage: mean(within),
            weak: of(Grade::Weak).count(),
            weak_belied: mean(beyond(Grade::Weak)),
            precision: mean(here.iter().filter(|measured| measured.kept > 0).map(|measured| measured.precision)),
            recall: mean(wanted().map(|measured| measured.recall)),
            views: mean(due().map(|measured| measured.views)),
            connected: mean(due().map(|measured| measured.connected)),
            second_structure: mean(ours().map(|measured| f64::from(measured.second_structure))),
            seconds: mean(here.iter().map(|measured| measured.seconds)).unwrap_or(0.0),
            failures: here.iter().filter_map(|measured| measured.failure.clone()).collect(),
        }
    }
}

/// Whether a scene determines its focal lengths well enough for METRIC.
fn carries(measured: &Measured) -> bool {
    measured.bound.is_some_and(|bound| bound < CARRIES)
}

/// Root mean square of the errors of an answer's log focal lengths in their standard deviations: of one, its error.
/// `None`: there are no focal lengths, or they have no standard deviation.
fn deviation(measured: &Measured) -> Option<f64> {
    let squares = measured.focals.iter().map(|focal| Some((focal.log_error / focal.sigma?).powi(2)));
    let squares: Vec<f64> = squares.collect::<Option<_>>()?;
    mean(squares).map(f64::sqrt)
}
