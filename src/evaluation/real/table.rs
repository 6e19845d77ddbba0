//! The rows as text: one aligned table, and a CSV.

use super::Row;
use super::measures::Scores;

/// Longest cell of a reason or of warnings in the table; the CSV has all of it.
const MOST_CHARACTERS: usize = 80;

/// One column: its heading, whether it is of words (aligned left), and a row's cell.
struct Column {
    heading: &'static str,
    is_words: bool,
    cell: fn(&Row) -> String,
}

/// A number of the answer, or a dash.
fn number(row: &Row, digits: usize, value: fn(&Scores) -> Option<f64>) -> String {
    shown(row.scores.as_ref().and_then(value), digits)
}

fn shown(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "-".into(), |value| format!("{value:.digits$}"))
}

const fn words(heading: &'static str, cell: fn(&Row) -> String) -> Column {
    Column { heading, is_words: true, cell }
}

const fn figure(heading: &'static str, cell: fn(&Row) -> String) -> Column {
    Column { heading, is_words: false, cell }
}

const COLUMNS: [Column; 19] = [
    words("sequence", |row| row.sequence.clone()),
    words("side", |row| row.side.name().into()),
    figure("views", |row| match &row.scores {
        None => "-".into(),
        Some(scores) if scores.parts > 1 => format!("{}/{} in {}", scores.registered, row.views, scores.parts),
        Some(scores) => format!("{}/{}", scores.registered, row.views),
    }),
    words("grade", |row| row.scores.as_ref().and_then(|scores| scores.grade.clone()).unwrap_or_else(|| "-".into())),
    figure("focal %", |row| number(row, 2, |scores| scores.focal_error_percent)),
    figure("sigma %", |row| number(row, 2, |scores| scores.sigma_log_focal.map(|sigma| 100.0 * sigma))),
    figure("in sigmas", |row| number(row, 1, |scores| scores.focal_error_sigmas)),
    figure("k1", |row| number(row, 4, |scores| scores.radial_k1)),
    figure("precision", |row| number(row, 3, |scores| Some(scores.precision))),
    figure("recall", |row| number(row, 3, |scores| Some(scores.recall))),
    figure("F1", |row| number(row, 3, |scores| Some(scores.f1))),
    words("by", |row| row.scores.as_ref().map_or("-", |scores| scores.verdicts.name()).into()),
    figure("mean px", |row| number(row, 2, |scores| scores.mean_px)),
    figure("rms px", |row| number(row, 2, |scores| scores.rms_px)),
    figure("centres %", |row| {
        let mark = if row.cameras_estimated { "~" } else { "" };
        match number(row, 3, |scores| scores.centre_error_percent) {
            dash if dash == "-" => dash,
            error => format!("{mark}{error}"),
        }
    }),
    figure("CPU s", |row| shown(row.usage.cpu_seconds, 2)),
    figure("wall s", |row| shown(Some(row.usage.wall_seconds), 2)),
    figure("peak MB", |row| shown(row.usage.peak_memory_mb, 0)),
    words("warnings", remarks),
];

/// Why there is no answer, or the warnings of one.
fn remarks(row: &Row) -> String {
    match (&row.failure, &row.scores) {
        (Some(reason), _) => format!("failed: {reason}"),
        (None, Some(scores)) => scores.warnings.join(" "),
        (None, None) => String::new(),
    }
}

/// Headings of the columns.
pub(super) fn headings() -> impl Iterator<Item = &'static str> {
    COLUMNS.iter().map(|column| column.heading)
}

/// The cells of a row, with whether each is of words.
pub(super) fn cells(row: &Row) -> impl Iterator<Item = (String, bool)> {
    COLUMNS.iter().map(|column| ((column.cell)(row), column.is_words))
}

/// An aligned table, without a newline at the end.
pub fn text(rows: &[Row]) -> String {
    let cut = |cell: String| match cell.char_indices().nth(MOST_CHARACTERS) {
        Some((end, _)) => format!("{}...", &cell[..end]),
        None => cell,
    };
    let mut lines: Vec<Vec<String>> = vec![headings().map(str::to_owned).collect()];
    lines.extend(rows.iter().map(|row| cells(row).map(|(cell, _)| cut(cell)).collect()));
    let width = |column: usize| lines.iter().map(|line| line[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..COLUMNS.len()).map(width).collect();
    let line = |cells: &Vec<String>| {
        let padded = cells.iter().zip(&widths).zip(&COLUMNS).map(|((cell, &width), column)| match column.is_words {
            true => format!("{cell:<width$}"),
            false => format!("{cell:>width$}"),
        });
        padded.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    lines.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// One line a row, every number in full; an empty field is one that there is not.
pub fn csv(rows: &[Row]) -> String {
    let mut text = String::from(
        "sequence,side,views,observations,registered,parts,grade,focal_px,focal_error_percent,sigma_log_focal,\
         focal_error_sigmas,radial_k1,precision,recall,f1,verdicts,mean_px,rms_px,centre_error_percent,centres,\
         cameras_estimated,cpu_seconds,wall_seconds,peak_memory_mb,warnings,failure\n",
    );
    for row in rows {
        let scores = row.scores.as_ref();
        let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
        let of = |value: fn(&Scores) -> Option<f64>| number(scores.and_then(value));
        let fields = [
            quoted(&row.sequence),
            row.side.name().into(),
            row.views.to_string(),
            row.observations.to_string(),
            scores.map_or_else(String::new, |scores| scores.registered.to_string()),
            scores.map_or_else(String::new, |scores| scores.parts.to_string()),
            scores.and_then(|scores| scores.grade.as_deref()).map_or_else(String::new, quoted),
            of(|scores| scores.focal_px),
            of(|scores| scores.focal_error_percent),
            of(|scores| scores.sigma_log_focal),
            of(|scores| scores.focal_error_sigmas),
            of(|scores| scores.radial_k1),
            of(|scores| Some(scores.precision)),
            of(|scores| Some(scores.recall)),
            of(|scores| Some(scores.f1)),
            scores.map_or_else(String::new, |scores| scores.verdicts.name().into()),
            of(|scores| scores.mean_px),
            of(|scores| scores.rms_px),
            of(|scores| scores.centre_error_percent),
            scores.map_or_else(String::new, |scores| scores.centres.to_string()),
            row.cameras_estimated.to_string(),
            number(row.usage.cpu_seconds),
            row.usage.wall_seconds.to_string(),
            number(row.usage.peak_memory_mb),
            quoted(&scores.map_or_else(String::new, |scores| scores.warnings.join(" "))),
            quoted(row.failure.as_deref().unwrap_or_default()),
        ];
        text.push_str(&fields.join(","));
        text.push('\n');
    }
    text
}

/// A field of a CSV (RFC 4180).
fn quoted(text: &str) -> String {
    match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    }
}
