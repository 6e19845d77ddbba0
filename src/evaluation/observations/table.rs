//! The rows in words.

use std::fmt::Write;

use super::Row;

/// A line a row.
pub fn text(rows: &[Row]) -> String {
    let width = rows.iter().map(|row| row.condition.chars().count()).max().unwrap_or(0).max("input".len());
    let mut text = format!(
        "{:<width$} {:<7}{:>4}{:>7}{:>7}{:>7}{:>8}{:>7}{:>7}{:>8}{:>9}{:>9}{:>8}{:>7}{:>8}{:>8}{:>7}{:>8}{:>16}\n",
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
        "mismatch",
        "focal %",
        "most %",
        "sig %",
        "/ bound",
        "in 3sg",
        "wrong",
        "CPU s",
        "F1 - peer's"
    );
    let percent = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{:.2}", 100.0 * value));
    for row in rows {
        let gain = row.f1_gain.map_or_else(String::new, |[mean, half]| format!("{mean:+.3} +- {half:.3}"));
        let _ = writeln!(
            text,
            "{:<width$} {:<7}{:>4}{:>7.3}{:>7.3}{:>7.3}{:>8.3}{:>7.3}{:>7}{:>8}{:>9}{:>9}{:>8}{:>7}{:>8}{:>8}{:>7}{:>8.2}{gain:>16}",
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
            percent(row.median_focal_error),
            percent(row.largest_focal_error),
            percent(row.median_sigma),
            row.sigma_over_bound.map_or_else(|| "-".to_owned(), |ratio| format!("{ratio:.2}")),
            row.covered.map_or_else(|| "-".to_owned(), |share| format!("{share:.2}")),
            row.wrong,
            row.seconds
        );
    }
    for row in rows.iter().filter(|row| !row.failures.is_empty()) {
        let _ = writeln!(
            text,
            "{}, {}: {} failed, {}",
            row.condition,
            row.side.name(),
            row.failures.len(),
            row.failures[0]
        );
    }
    text.push_str(
        "F1: of tracks. obs P, R: precision over the observations that were kept (0 where none was), recall over the right ones\n\
         of right tracks.\n\
         views: share in the largest reconstruction. calib: answers with a focal length; mismatch: METRIC ones that warn of it.\n\
         focal %, most %, sig %, in 3sg: of the METRIC ones, median and largest focal error, median sigma, share within 3 sigma;\n\
         / bound: median of sigma over the Cramer-Rao bound, where every view has its own camera.\n\
         wrong: METRIC and off by more than 3 % and 4 sigma. CPU s: mean; a peer's without what its start takes.\n",
    );
    text
}
