//! Reading and writing `observations.csv`: `view,track,x,y[,depth][,sigma]`, one observation a line.

use std::fmt::Write;
use std::io::BufRead;
use std::path::Path;

use super::error::{Error, Problem, Problems};
use super::input::{LabelledInput, display_path};
use super::label::{Label, dense};
use super::source::{OPENSFM_TRACKS, SQLITE_MAGIC};
use super::text::{self, Lines, number, quote, whole};
use crate::domain::{ImageSize, Limits, RawInput, View, counted};

/// Columns that must be there, in the order in which they are looked for.
const REQUIRED: [&str; 4] = ["view", "track", "x", "y"];
const DEPTH: &str = "depth";
const SIGMA: &str = "sigma";
/// Columns of the table of observations that a solve writes, and of no input.
const OF_ANSWERS: [&str; 2] = ["inlier", "x_px"];
/// Unknown columns that a note names.
const MOST_NAMED: usize = 5;

/// Reads the observations of a file and checks what only the file can tell: syntax, ids, duplicates.
///
/// `size` is put on every view; `path` is for sentences. What depends on values is checked by [`LabelledInput::check`],
/// which this calls, so that an `Ok` is an input the solver takes.
///
/// # Errors
/// A file that is no such table, is above `limits` or has wrong values; by line.
pub fn read(
    reader: impl BufRead,
    path: &Path,
    limits: &Limits,
    size: Option<ImageSize>,
) -> Result<LabelledInput, Error> {
    let labelled = parse(reader, path, limits, size)?;
    labelled.check(limits)?;
    Ok(labelled)
}

/// Positions of the columns.
struct Columns {
    names: Vec<String>,
    required: [usize; 4],
    depth: Option<usize>,
    sigma: Option<usize>,
}

/// What one line says.
struct Row {
    view: u64,
    track: u64,
    x: f64,
    y: f64,
    depth: Option<f64>,
    sigma: Option<f64>,
}

/// Observations as they are read, ids not yet dense.
#[derive(Default)]
struct Table {
    view: Vec<u64>,
    track: Vec<u64>,
    x: Vec<f64>,
    y: Vec<f64>,
    depth: Vec<f64>,
    sigma: Vec<f64>,
    lines: Vec<u64>,
}

fn parse(reader: impl BufRead, path: &Path, limits: &Limits, size: Option<ImageSize>) -> Result<LabelledInput, Error> {
    let file = display_path(path);
    let one = |problem: Problem| Error::one(&file, problem);
    let mut lines = Lines::new(reader, text::MAX_TABLE_LINE_BYTES);
    let mut columns = None;
    let mut table = Table::default();
    let mut problems = Problems::default();
    while lines.advance().map_err(one)? {
        let number = lines.number();
        let Some(columns) = &columns else {
            refuse_foreign_bytes(lines.bytes()).map_err(|what| Error::whole(&file, what))?;
            let text = lines.expect_text().map_err(one)?.trim();
            if !text.is_empty() {
                columns = Some(header(text).map_err(|what| one(Problem::at_line(number, "", what)))?);
            }
            continue;
        };
        let Some(text) = lines.text() else {
            problems.push(Problem::not_text(number));
            continue;
        };
        if text.trim().is_empty() {
            continue;
        }
        if table.lines.len() == limits.max_observations {
            return Err(one(Problem::too_many_observations(number, limits.max_observations)));
        }
        match columns.row(text) {
            Ok(row) => table.push(row, number),
            Err((column, what)) => problems.push(Problem::at_line(number, column, what)),
        }
    }
    if columns.is_none() {
        return Err(Error::whole(&file, "is empty; a header `view,track,x,y` is needed"));
    }
    Error::check(&file, problems)?;
    if table.lines.is_empty() {
        return Err(Error::whole(&file, "has a header but no observations"));
    }
    let mut labelled = table.into_labelled(path, size);
    labelled.notes.extend(columns.and_then(|columns| columns.unread()));
    labelled.refuse_duplicates()?;
    Ok(labelled)
}

/// Says so where `--format` calls a file a table that is known to be something else.
fn refuse_foreign_bytes(line: &[u8]) -> Result<(), String> {
    let kind = if line.starts_with(SQLITE_MAGIC) {
        "a COLMAP (SQLite) database"
    } else if line.starts_with(OPENSFM_TRACKS) {
        "an OpenSfM tracks.csv"
    } else {
        return Ok(());
    };
    Err(format!("is {kind}, not a table view,track,x,y; leave out --format"))
}

/// Finds the columns in the header line.
fn header(text: &str) -> Result<Columns, String> {
    if text.contains('\t') && !text.contains(',') {
        return Err("columns are separated by tabs; commas are needed: view,track,x,y".into());
    }
    if text.contains(';') && !text.contains(',') {
        return Err("columns are separated by semicolons; commas are needed: view,track,x,y".into());
    }
    let names: Vec<String> = text.split(',').map(|name| unquote(name).to_lowercase()).collect();
    let find = |wanted: &str| -> Result<Option<usize>, String> {
        let mut found = (0..names.len()).filter(|&k| names[k] == wanted);
        match (found.next(), found.next()) {
            (_, Some(_)) => Err(format!("the header names the column `{wanted}` twice")),
            (first, None) => Ok(first),
        }
    };
    let mut required = [0; REQUIRED.len()];
    for (place, wanted) in required.iter_mut().zip(REQUIRED) {
        *place = find(wanted)?.ok_or_else(|| {
            let quoted = quote(text);
            if OF_ANSWERS.iter().all(|of_answers| names.iter().any(|name| name == of_answers)) {
                "this is a table that a solve wrote, an answer and no input: give the file that was solved".into()
            } else if names.iter().all(|name| name.parse::<f64>().is_ok()) {
                format!("no header; the first line must be `view,track,x,y[,depth][,sigma]`, not {quoted}")
            } else {
                format!("the header {quoted} has no column `{wanted}`; `view,track,x,y[,depth][,sigma]` is needed")
            }
        })?;
    }
    Ok(Columns { required, depth: find(DEPTH)?, sigma: find(SIGMA)?, names })
}

impl Columns {
    /// Says which columns are not read; one of them may be misspelt.
    fn unread(&self) -> Option<String> {
        let known = REQUIRED.into_iter().chain([DEPTH, SIGMA]).collect::<Vec<_>>();
        let unread: Vec<String> =
            self.names.iter().filter(|name| !known.contains(&name.as_str())).map(|name| quote(name)).collect();
        let more = if unread.len() > MOST_NAMED { ", ..." } else { "" };
        let named = unread[..unread.len().min(MOST_NAMED)].join(", ");
        (!unread.is_empty()).then(|| {
            format!("{} not read: {named}{more}; those that are: {}", counted(unread.len(), "column"), known.join(", "))
        })
    }

    /// Parses one line; an error names the column and says what is wrong.
    fn row(&self, text: &str) -> Result<Row, (&'static str, String)> {
        let fields: Vec<&str> = text.split(',').map(unquote).collect();
        if fields.len() != self.names.len() {
            let hint = match fields.len() {
                count if count < self.names.len() => "; the file may be truncated",
                // One more for each coordinate, a depth and a standard deviation.
                count if count == self.names.len() + 2 + self.depth.iter().chain(&self.sigma).count() => {
                    "; decimals are marked by a point, not a comma"
                }
                _ => "",
            };
            return Err(("", format!("{} fields where the header has {}{hint}", fields.len(), self.names.len())));
        }
        let [view, track, x, y] = self.required.map(|place| fields[place]);
        Ok(Row {
            view: whole(view).map_err(|what| ("view", what))?,
            track: whole(track).map_err(|what| ("track", what))?,
            x: number(x).map_err(|what| ("x", what))?,
            y: number(y).map_err(|what| ("y", what))?,
            depth: self.depth.map(|place| number(fields[place])).transpose().map_err(|what| (DEPTH, what))?,
            sigma: self.sigma.map(|place| sigma(fields[place])).transpose().map_err(|what| (SIGMA, what))?,
        })
    }
}

/// The observation is there, whatever is known of its noise.
fn sigma(field: &str) -> Result<f64, String> {
    match field {
        "" => Err("is empty; give every observation one, where it is not known that of most others, or leave out the \
                   column"
            .into()),
        _ => number(field),
    }
}

fn unquote(field: &str) -> &str {
    let field = field.trim();
    field.strip_prefix('"').and_then(|inner| inner.strip_suffix('"')).unwrap_or(field).trim()
}

impl Table {
    fn push(&mut self, row: Row, line: u64) {
        self.view.push(row.view);
        self.track.push(row.track);
        self.x.push(row.x);
        self.y.push(row.y);
        self.depth.extend(row.depth);
        self.sigma.extend(row.sigma);
        self.lines.push(line);
    }

    fn into_labelled(self, path: &Path, size: Option<ImageSize>) -> LabelledInput {
        let (view_labels, view) = dense(&self.view);
        let (track_labels, track) = dense(&self.track);
        let views = vec![View { size, ..View::default() }; view_labels.len()];
        LabelledInput {
            raw: RawInput {
                views,
                track_count: track_labels.len(),
                view,
                track,
                x: self.x,
                y: self.y,
                depth: self.depth,
                sigma: self.sigma,
            },
            view_labels: view_labels.into_iter().map(Label::Number).collect(),
            track_labels: track_labels.into_iter().map(Label::Number).collect(),
            lines: self.lines,
            path: path.into(),
            ..LabelledInput::default()
        }
    }
}

/// `view,track,x,y[,depth][,sigma]`; every number as short as it reads back exactly.
pub fn csv(input: &RawInput) -> String {
    let more: Vec<(&str, &[f64])> = [(DEPTH, input.depth.as_slice()), (SIGMA, input.sigma.as_slice())]
        .into_iter()
        .filter(|(_, values)| !values.is_empty())
        .collect();
    let mut text = REQUIRED.join(",");
    more.iter().for_each(|(name, _)| text.extend([",", name]));
    text.push('\n');
    for k in 0..input.x.len() {
        // Writing to a String cannot fail.
        let _ = write!(text, "{},{},{},{}", input.view[k], input.track[k], input.x[k], input.y[k]);
        for (_, values) in &more {
            let _ = write!(text, ",{}", values[k]);
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
#[path = "observations_tests.rs"]
mod tests;
