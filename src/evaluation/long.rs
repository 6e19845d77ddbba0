//! Long sequences: the same motion at growing lengths, so that a table shows how time, memory, trajectory error and
//! calibration go with the length. The scenes are inputs of [`super::observations`], which solves and measures them.

use std::fmt::Write;

use serde::Serialize;

use crate::evaluation::observations::{self, FocalError, Measured, Records, Run};
use crate::evaluation::real::Side;
use crate::statistics::median;
use crate::synthetic::photographed::{PhotographedMotion, PhotographedOptions};

/// Views of the sequences.
const VIEWS: [usize; 4] = [60, 120, 250, 500];
/// First seed: above those of the other evaluations.
const FIRST_SEED: u64 = 950_000;

/// The file of the records.
pub const RECORDS: &str = "long.jsonl";

/// What to run: every motion at every length, so many times.
#[derive(Debug, Clone)]
pub struct Plan {
    pub motions: Vec<PhotographedMotion>,
    pub seeds: u64,
}

impl Plan {
    /// Every sequence, the shortest first.
    pub fn runs(&self) -> Vec<Run> {
        let cells = VIEWS.into_iter().flat_map(|views| self.motions.iter().map(move |&motion| (motion, views)));
        cells.flat_map(|(motion, views)| self.of_cell(motion, views)).collect()
    }

    fn of_cell(&self, motion: PhotographedMotion, views: usize) -> impl Iterator<Item = Run> {
        let seeds = FIRST_SEED..FIRST_SEED + self.seeds;
        seeds.map(move |seed| Run::photographed(&PhotographedOptions::long(motion, views, seed), &[]))
    }

    /// The rows of what is recorded, by motion, then by length.
    pub fn rows(&self, records: &Records) -> Vec<Row> {
        let cells = self.motions.iter().flat_map(|&motion| VIEWS.map(|views| (motion, views)));
        let row = |(motion, views): (PhotographedMotion, usize)| {
            let here: Vec<&Measured> = self.of_cell(motion, views).filter_map(|run| records.get(&run)).collect();
            (!here.is_empty()).then(|| Row::of(motion.name(), views, &here))
        };
        cells.filter_map(row).collect()
    }
}

/// A motion at one length.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub motion: &'static str,
    pub views: usize,
    /// Observations, a mean over the seeds.
    pub observations: f64,
    pub answers: observations::Row,
    /// Largest error of a focal length in its standard deviations.
    pub largest_deviation: Option<f64>,
    /// Median of the absolute trajectory error over the length of the true path.
    pub trajectory_error: Option<f64>,
    /// Largest memory of the process during a solve.
    pub peak_bytes: Option<u64>,
}

impl Row {
    fn of(motion: &'static str, views: usize, here: &[&Measured]) -> Self {
        let deviation = |focal: &FocalError| Some(focal.log_error.abs() / focal.sigma?);
        let mut errors: Vec<f64> = here.iter().filter_map(|one| one.trajectory_error).collect();
        Self {
            motion,
            views,
            observations: here.iter().map(|one| one.given as f64).sum::<f64>() / here.len() as f64,
            answers: observations::Row::of(motion, Side::Scpsfm, here),
            largest_deviation: here.iter().flat_map(|one| &one.focals).filter_map(deviation).reduce(f64::max),
            trajectory_error: (!errors.is_empty()).then(|| median(&mut errors)),
            peak_bytes: here.iter().filter_map(|one| one.peak_bytes).max(),
        }
    }
}

const LEGEND: &str = "\
n: sequences; METR, WEAK: answers by grade. error %, sigma %: of the focal length, medians. max/sg: largest error in
standard deviations. /bound: median of sigma over the Cramer-Rao bound of all observations; the solver calibrates from
6,000 of them. ATE %: absolute trajectory error after the best similarity over the length of the path, median. reg.:
registered share of the views with 15 verifiable observations or more. P, R: precision and recall of the observations.
us/obs: CPU microseconds for each observation. MB: largest memory of the process during a solve.
";

/// A line a row.
pub fn text(rows: &[Row]) -> String {
    let mut text = format!(
        "{:<13}{:>6}{:>5}{:>10}{:>6}{:>6}{:>9}{:>9}{:>8}{:>8}{:>9}{:>8}{:>7}{:>7}{:>9}{:>8}{:>7}\n",
        "motion",
        "views",
        "n",
        "observ.",
        "METR",
        "WEAK",
        "error %",
        "sigma %",
        "max/sg",
        "/bound",
        "ATE %",
        "reg.",
        "P",
        "R",
        "CPU s",
        "us/obs",
        "MB"
    );
    let shown =
        |value: Option<f64>, digits: usize| value.map_or_else(|| "-".into(), |value| format!("{value:.digits$}"));
    let percent = |share: Option<f64>| shown(share.map(|share| 100.0 * share), 3);
    for row in rows {
        let Row { answers, .. } = row;
        let _ = writeln!(
            text,
            "{:<13}{:>6}{:>5}{:>10.0}{:>6}{:>6}{:>9}{:>9}{:>8}{:>8}{:>9}{:>8.3}{:>7.3}{:>7.3}{:>9.2}{:>8.1}{:>7}",
            row.motion,
            row.views,
            answers.seeds,
            row.observations,
            answers.metric,
            answers.calibrated - answers.metric,
            percent(answers.calibrated_focals.median_error),
            percent(answers.calibrated_focals.median_sigma),
            shown(row.largest_deviation, 2),
            shown(answers.calibrated_focals.sigma_over_bound, 2),
            percent(row.trajectory_error),
            answers.views,
            answers.precision,
            answers.recall,
            answers.seconds,
            1e6 * answers.seconds / row.observations,
            shown(row.peak_bytes.map(|bytes| bytes as f64 / 1e6), 0)
        );
    }
    text + "\n" + LEGEND
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Grade;
    use crate::synthetic::photographed::long::MOTIONS;

    #[test]
    fn a_row_tells_the_growth_along_a_motion() {
        let plan = Plan { motions: MOTIONS.to_vec(), seeds: 2 };
        assert_eq!(plan.runs().len(), 32);
        for (motion, views) in MOTIONS.into_iter().flat_map(|motion| VIEWS.map(|views| (motion, views))) {
            let valid = PhotographedOptions::long(motion, views, 1).validate();
            assert!(valid.is_ok(), "{} of {views} views: {valid:?}", motion.name());
        }
        let focal = |log_error: f64| FocalError { log_error, sigma: Some(0.01), bound: Some(0.005) };
        let answer = |log_error: f64, error: f64, peak: u64| Measured {
            grade: Some(Grade::Metric),
            focals: vec![focal(log_error)],
            given: 1_000,
            seconds: 2.0,
            trajectory_error: Some(error),
            peak_bytes: Some(peak),
            ..Measured::default()
        };
        let (one, other) = (answer(0.001, 0.1, 5_000_000), answer(-0.025, 0.3, 7_000_000));
        let row = Row::of("drive", 60, &[&one, &other]);
        assert_eq!((row.answers.metric, row.answers.seeds, row.observations), (2, 2, 1_000.0));
        assert_eq!((row.largest_deviation, row.answers.calibrated_focals.sigma_over_bound), (Some(2.5), Some(2.0)));
        assert!(matches!(row.trajectory_error, Some(0.1 | 0.3)) && row.peak_bytes == Some(7_000_000));
        let text = text(&[row]);
        assert!(text.lines().nth(1).is_some_and(|line| line.contains(" 2000.0 ") && line.ends_with(" 7")), "{text}");
    }
}
