//! The tables in words.

use std::fmt::Write;

use super::{Row, Table};

const LEGEND: &str = "\
bound<: share of the scenes with a Cramer-Rao bound of the log focal length below .01 (true cameras, verifiable
observations, the smallest model that holds the truth, the solver's priors); METR%: share of METRIC answers among
these. METR: METRIC answers; of these >3sg %: share beyond 3 sigma; off: number off by more than 3 % and 4 sigma; in
1sg: share within 1 sigma (.68 where sigma is right). WEAK: WEAK answers and their share beyond 3 sigma. obs P:
precision over the observations that were kept, of answers that keep any. obs R: recall over the verifiable
observations, the right ones of tracks with at least three. views: registered share of those with 15 verifiable
observations or more; conn.: share that right observations connect, by the solver's own numbers of tracks. 2nd %:
share of the answers with SECOND_STRUCTURE. CPU s: mean; a peer's without what its start takes. A peer gets the scenes
of one focal length.
";

/// A line a row.
pub fn text(tables: &[Table]) -> String {
    let rows = || tables.iter().flat_map(|table| &table.rows);
    let names = rows().map(|row| row.group).chain(tables.iter().map(|table| table.by));
    let width = names.map(|name| name.chars().count()).max().unwrap_or(0);
    let mut text = String::new();
    for table in tables {
        let _ = writeln!(
            text,
            "{:<width$} {:<6}{:>5}{:>8}{:>7}{:>6}{:>8}{:>5}{:>8}{:>6}{:>8}{:>8}{:>8}{:>8}{:>7}{:>7}{:>9}",
            table.by,
            "side",
            "n",
            "bound<",
            "METR%",
            "METR",
            ">3sg %",
            "off",
            "in 1sg",
            "WEAK",
            ">3sg %",
            "obs P",
            "obs R",
            "views",
            "conn.",
            "2nd %",
            "CPU s"
        );
        table.rows.iter().for_each(|row| line(&mut text, width, row));
        text.push('\n');
    }
    // Every scene is in the first table.
    for row in tables.iter().take(1).flat_map(|table| &table.rows).filter(|row| !row.failures.is_empty()) {
        let _ = writeln!(text, "{}: {} failed, the first: {}", row.side.name(), row.failures.len(), row.failures[0]);
    }
    text + LEGEND
}

fn line(text: &mut String, width: usize, row: &Row) {
    let percent = |share: Option<f64>| share.map_or_else(|| "-".to_owned(), |share| format!("{:.1}", 100.0 * share));
    let shown = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.3}"));
    let _ = writeln!(
        text,
        "{:<width$} {:<6}{:>5}{:>8.2}{:>7}{:>6}{:>8}{:>5}{:>8}{:>6}{:>8}{:>8}{:>8}{:>8}{:>7}{:>7}{:>9.2}",
        row.group,
        row.side.name(),
        row.scenes,
        row.carries,
        percent(row.metric_of_carrying),
        row.metric,
        percent(row.metric_belied),
        row.metric_wrong,
        row.coverage.map_or_else(|| "-".to_owned(), |share| format!("{share:.2}")),
        row.weak,
        percent(row.weak_belied),
        shown(row.precision),
        shown(row.recall),
        shown(row.views),
        shown(row.connected),
        percent(row.second_structure),
        row.seconds
    );
}
