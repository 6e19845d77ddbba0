//! The rows in words.

use std::fmt::Write;

use super::{Focals, Row};

const LEGEND: &str = "\
F1: of tracks. obs P, R: precision over the observations that were kept (0 where none was), recall over the right ones
of right tracks. views: share in the largest reconstruction. calib: answers with a focal length; mism: METRIC ones that
warn that the metric model does not fit. Of the focal lengths of METRIC answers, and again of all answers that have any:
f %, most %: median and largest error; sig %: median sigma; in 3sg: share within 3 sigma; / CRB: median of sigma over
the Cramer-Rao bound, where every view has its own camera. wrong: METRIC and off by more than 3 % and 4 sigma.
CPU s: mean; a peer's without what its start takes. gain: F1 of the tracks minus the peer's, with its 95 % interval.
";

/// A line a row.
pub fn text(rows: &[Row]) -> String {
    let width = rows.iter().map(|row| row.condition.chars().count()).max().unwrap_or(0).max("input".len());
    let focals = format!("{:>7}{:>7}{:>7}{:>7}{:>7}", "f %", "most %", "sig %", "in 3sg", "/ CRB");
    let mut text = format!(
        "{:<width$} {:<6}{:>4}{:>7}{:>7}{:>7}{:>8}{:>7}{:>7}{:>8}{:>6}{focals}{:>7}{focals}{:>8}{:>17}\n",
        "input",
        "side",
        "n",
        "F1",
        "obs P",
        "obs R",
        "obs F1",
        "views",
        "calib",
        "METRIC",
        "mism",
        "wrong",
        "CPU s",
        "gain"
    );
    for row in rows {
        let gain = row.f1_gain.map_or_else(String::new, |[mean, half]| format!("{mean:+.3} +- {half:.3}"));
        let _ = writeln!(
            text,
            "{:<width$} {:<6}{:>4}{:>7.3}{:>7.3}{:>7.3}{:>8.3}{:>7.3}{:>7}{:>8}{:>6}{}{:>7}{}{:>8.2}{gain:>17}",
            row.condition,
            row.side.name(),
            row.seeds,
            row.f1,
            row.precision,
            row.recall,
            row.observation_f1,
            row.views,
            row.calibrated,
            row.metric,
            row.mismatch,
            cells(&row.metric_focals),
            row.wrong,
            cells(&row.calibrated_focals),
            row.seconds
        );
    }
    for row in rows.iter().filter(|row| !row.failures.is_empty()) {
        let count = row.failures.len();
        let _ =
            writeln!(text, "{}, {}: {count} failed, the first: {}", row.condition, row.side.name(), row.failures[0]);
    }
    text + LEGEND
}

fn cells(focals: &Focals) -> String {
    let shown = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.2}"));
    let percent = |value: Option<f64>| shown(value.map(|value| 100.0 * value));
    format!(
        "{:>7}{:>7}{:>7}{:>7}{:>7}",
        percent(focals.median_error),
        percent(focals.largest_error),
        percent(focals.median_sigma),
        shown(focals.covered),
        shown(focals.sigma_over_bound)
    )
}
