//! How well the observations of real sequences are ranked, window by window: by pairs of views, by the network that was
//! trained beforehand, and by both together.

use std::fmt::Write;

use serde::Serialize;

use crate::domain::{Limits, StopToken};
use crate::evaluation::real::Sequence;
use crate::geometry::statistics::median;
use crate::solver::study::windows::{self, WindowRankings};
use crate::synthetic::metrics::average_precision;

/// Seed of the samples that pairs of views draw.
const SEED: u64 = 0;

/// A sequence; means over its windows that have right and wrong observations, times are medians.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WindowRow {
    pub sequence: String,
    pub windows: usize,
    /// Observations in them, and the share of right ones.
    pub observations: usize,
    pub right: f64,
    /// Average precision of the observations, by those who rank them.
    pub epipolar: f64,
    pub learned: f64,
    pub together: f64,
    pub epipolar_seconds: f64,
    pub learned_seconds: f64,
}

/// One window's measures.
struct Measured {
    observations: usize,
    right: usize,
    precisions: [f64; 3],
    seconds: [f64; 2],
}

/// Ranks every window of some sequences; `told` hears of each sequence that is done. A stopped run leaves out what was
/// not reached.
///
/// # Errors
/// A sequence that the solver would refuse, in words.
pub fn rows(sequences: &[Sequence], stop: &StopToken, told: &mut dyn FnMut()) -> Result<Vec<WindowRow>, String> {
    let mut rows = Vec::new();
    for sequence in sequences {
        let checked = sequence.input.check(&Limits::default());
        let input = checked.map_err(|error| format!("{}: {error}", sequence.name))?;
        let mut measured = Vec::new();
        for window in windows::windows(&input) {
            let truth: Vec<bool> =
                window.observations.iter().map(|&k| sequence.inlier[input.caller_index(k)]).collect();
            // Where all are right, or none is, every ranking is as good.
            if truth.iter().all(|right| *right == truth[0]) {
                continue;
            }
            measured.extend(measure(&window.rank(SEED, stop), &truth));
            if stop.is_stopped() {
                return Ok(rows);
            }
        }
        rows.extend(row(&sequence.name, &measured));
        told();
    }
    Ok(rows)
}

fn measure(rankings: &WindowRankings, truth: &[bool]) -> Option<Measured> {
    let right = truth.iter().filter(|right| **right).count();
    // Who says nothing ranks as chance does.
    let chance = right as f64 / truth.len() as f64;
    let precision = |said: &Option<Vec<f64>>| said.as_ref().map_or(Some(chance), |said| average_precision(said, truth));
    Some(Measured {
        observations: truth.len(),
        right,
        precisions: [precision(&rankings.epipolar)?, precision(&rankings.learned)?, precision(&rankings.together)?],
        seconds: rankings.seconds,
    })
}

fn row(sequence: &str, measured: &[Measured]) -> Option<WindowRow> {
    let count = measured.len() as f64;
    let mean = |k: usize| measured.iter().map(|measured| measured.precisions[k]).sum::<f64>() / count;
    let seconds = |k: usize| median(&mut measured.iter().map(|measured| measured.seconds[k]).collect::<Vec<_>>());
    let observations: usize = measured.iter().map(|measured| measured.observations).sum();
    (!measured.is_empty()).then(|| WindowRow {
        sequence: sequence.to_owned(),
        windows: measured.len(),
        observations,
        right: measured.iter().map(|measured| measured.right).sum::<usize>() as f64 / observations as f64,
        epipolar: mean(0),
        learned: mean(1),
        together: mean(2),
        epipolar_seconds: seconds(0),
        learned_seconds: seconds(1),
    })
}

/// The rows in words; the last column is what both together have above the better one of the two.
pub fn text(rows: &[WindowRow]) -> String {
    let width = rows.iter().map(|row| row.sequence.chars().count()).max().unwrap_or(0).max("sequence".len());
    let mut text = format!(
        "{:<width$}{:>9}{:>8}{:>8}{:>10}{:>10}{:>10}{:>9}{:>10}{:>10}\n",
        "sequence", "windows", "obs", "right", "epipolar", "learned", "both", "gain", "F ms", "net ms"
    );
    for row in rows {
        let _ = writeln!(
            text,
            "{:<width$}{:>9}{:>8}{:>8.3}{:>10.4}{:>10.4}{:>10.4}{:>+9.4}{:>10.1}{:>10.1}",
            row.sequence,
            row.windows,
            row.observations,
            row.right,
            row.epipolar,
            row.learned,
            row.together,
            row.together - row.epipolar.max(row.learned),
            1e3 * row.epipolar_seconds,
            1e3 * row.learned_seconds
        );
    }
    let _ = writeln!(
        text,
        "Average precision of the observations, mean over windows of {} views that have right and wrong ones.",
        windows::WINDOW_VIEWS
    );
    text
}
