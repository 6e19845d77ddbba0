//! The rows in words.

use std::fmt::Write;

use super::{Rows, SAMPLES};

/// Two tables: every prior, and AUTO.
pub fn text(rows: &Rows) -> String {
    let mut text = String::new();
    if !rows.priors.is_empty() {
        let _ = write!(text, "{:<18}{:<13}{:>5}{:>7}{:>8}{:>9}", "scenes", "prior", "n", "AP", "F1 > .5", "rank ms");
        for samples in SAMPLES {
            let _ = write!(text, "{:>10}{:>8}", format!("F1 {samples}"), "s");
        }
        text.push('\n');
    }
    let shown = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.3}"));
    for row in &rows.priors {
        let _ = write!(
            text,
            "{:<18}{:<13}{:>5}{:>7}{:>8}{:>9.1}",
            row.condition,
            row.prior.name(),
            row.seeds,
            shown(row.average_precision),
            shown(row.f1_of_ranking),
            1e3 * row.ranking_seconds
        );
        for (f1, seconds) in row.f1.iter().zip(&row.seconds) {
            let _ = write!(text, "{f1:>10.3}{seconds:>8.2}");
        }
        text.push('\n');
    }
    let _ = writeln!(
        text,
        "{}{:<18}{:<17}{:>5}{:>8}{:>8}{:>10}{:>8}{:>6}{:>9}{:>10}{:>11}",
        if rows.priors.is_empty() { "" } else { "\n" },
        "scenes",
        "auto",
        "n",
        "F1",
        "min F1",
        "verified",
        "ranked",
        "none",
        "AP rank",
        "mean ms",
        "median ms"
    );
    for row in &rows.auto {
        let _ = writeln!(
            text,
            "{:<18}{:<17}{:>5}{:>8.3}{:>8.3}{:>10}{:>8}{:>6}{:>9}{:>10.2}{:>11.2}",
            row.condition,
            if row.learned { "with learned" } else { "without learned" },
            row.seeds,
            row.f1,
            row.least_f1,
            row.verified,
            row.ranked,
            row.none,
            shown(row.average_precision_of_ranking),
            1e3 * row.mean_seconds,
            1e3 * row.median_seconds
        );
    }
    text.push_str(
        "F1 of auto: inliers of verified answers; where none is verified, the tracks that the ranking gives more than one half.\n",
    );
    text
}
