//! Reading `observations.csv`: `view,track,x,y[,depth]`, one observation a line.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use super::error::{Error, Problem, Problems};
use super::input::{LabelledInput, display_name};
use crate::domain::{ImageSize, Limits, RawInput, View};

/// Longest line in bytes, extra columns included. No table of numbers comes near; a binary file passes it soon.
const MAX_LINE_BYTES: usize = 64 * 1024;
/// Bytes that one observation may take on average before the file cannot be within the limits: five columns of at
/// most 25 digits, and as much again for extra columns.
const MAX_BYTES_AN_OBSERVATION: u64 = 256;
/// Bytes of a foreign value that an error message quotes.
const QUOTED_CHARS: usize = 40;
/// How SQLite files, and so COLMAP databases, begin.
const SQLITE_MAGIC: &[u8] = b"SQLite format 3\0";
const UTF8_BOM: &[u8] = b"\xEF\xBB\xBF";
const UTF16_BOMS: [&[u8]; 2] = [b"\xFF\xFE", b"\xFE\xFF"];

/// Columns that must be there, in the order in which they are looked for.
const REQUIRED: [&str; 4] = ["view", "track", "x", "y"];
const DEPTH: &str = "depth";

/// Reads the observations of a file and checks what only the file can tell: syntax, ids, duplicates.
///
/// `size` is put on every view. What depends on values is checked by [`LabelledInput::check`], which this calls, so
/// that an `Ok` is an input the solver takes.
///
/// # Errors
/// A file that cannot be opened, is no such table, is above `limits` or has wrong values; by line.
pub fn read(path: &Path, limits: &Limits, size: Option<ImageSize>) -> Result<LabelledInput, Error> {
    let name = display_name(path);
    let whole = |description: String| Error::one(&name, Problem::of_file(description));
    let cannot_read = |error: std::io::Error| whole(format!("cannot be read: {error}"));
    let metadata = std::fs::metadata(path).map_err(cannot_read)?;
    refuse_foreign_formats(path, metadata.is_dir()).map_err(whole)?;
    let most = MAX_BYTES_AN_OBSERVATION.saturating_mul(limits.max_observations as u64);
    if metadata.len() > most {
        return Err(whole(format!(
            "has {} bytes, more than the limit of {} observations can take",
            metadata.len(),
            limits.max_observations
        )));
    }
    let file = File::open(path).map_err(cannot_read)?;
    // A pipe has no size beforehand; the count of lines kept and the length of each are bounded while it is read.
    let labelled = parse(BufReader::new(file), path, limits, size)?;
    labelled.check(limits)?;
    Ok(labelled)
}

/// Says so where the file is known to be of a kind that is not read yet.
fn refuse_foreign_formats(path: &Path, is_directory: bool) -> Result<(), String> {
    let colmap = "COLMAP input is not a supported format yet; give an observations.csv (view,track,x,y)";
    if is_directory {
        let holds = |name: &str| path.join(name).exists();
        return Err(if ["cameras.bin", "cameras.txt", "database.db"].into_iter().any(holds) {
            colmap.into()
        } else {
            "is a directory; give an observations.csv (view,track,x,y)".into()
        });
    }
    let name = display_name(path).to_lowercase();
    let is_model = ["cameras", "images", "points3d"]
        .iter()
        .any(|part| [".bin", ".txt"].iter().any(|extension| name == format!("{part}{extension}")));
    if is_model || name.ends_with(".db") { Err(colmap.into()) } else { Ok(()) }
}

/// Positions of the columns.
struct Columns {
    names: Vec<String>,
    required: [usize; 4],
    depth: Option<usize>,
}

/// What one line says.
struct Row {
    view: u64,
    track: u64,
    x: f64,
    y: f64,
    depth: Option<f64>,
}

/// Observations as they are read, ids not yet dense.
#[derive(Default)]
struct Table {
    view: Vec<u64>,
    track: Vec<u64>,
    x: Vec<f64>,
    y: Vec<f64>,
    depth: Vec<f64>,
    lines: Vec<u64>,
}

fn parse(
    mut reader: impl BufRead,
    path: &Path,
    limits: &Limits,
    size: Option<ImageSize>,
) -> Result<LabelledInput, Error> {
    let file = display_name(path);
    let mut line = Vec::new();
    let mut number = 0u64;
    let mut columns = None;
    let mut table = Table::default();
    let mut problems = Problems::default();
    while read_line(&mut reader, &mut line).map_err(|problem| Error::one(&file, problem.on_line(number + 1)))? {
        number += 1;
        let text = std::str::from_utf8(&line).ok().filter(|text| !text.contains('\0'));
        let Some(columns) = &columns else {
            if number == 1 {
                refuse_foreign_bytes(&line).map_err(|what| Error::one(&file, Problem::of_file(what)))?;
            }
            let text = text.ok_or_else(|| Error::one(&file, Problem::of_file("is not a text file")))?;
            let text = text.trim_start_matches('\u{feff}').trim();
            if !text.is_empty() {
                columns = Some(header(text).map_err(|what| Error::one(&file, Problem::at_line(number, "", what)))?);
            }
            continue;
        };
        let Some(text) = text else {
            problems.push(Problem::at_line(number, "", "is not text; the file may be damaged"));
            continue;
        };
        if text.trim().is_empty() {
            continue;
        }
        if table.lines.len() == limits.max_observations {
            let what = format!("more observations than the limit of {}", limits.max_observations);
            return Err(Error::one(&file, Problem::at_line(number, "", what)));
        }
        match columns.row(text.trim_end_matches(['\r', '\n'])) {
            Ok(row) => table.push(row, number),
            Err((column, what)) => problems.push(Problem::at_line(number, column, what)),
        }
    }
    if columns.is_none() {
        return Err(Error::one(&file, Problem::of_file("is empty; a header `view,track,x,y` is needed")));
    }
    problems.into_result(&file)?;
    if table.lines.is_empty() {
        return Err(Error::one(&file, Problem::of_file("has a header but no observations")));
    }
    table.refuse_duplicates(&file)?;
    Ok(table.into_labelled(path, size))
}

/// Why a line could not be read at all.
enum Unreadable {
    TooLong,
    Io(std::io::Error),
}

impl Unreadable {
    fn on_line(self, number: u64) -> Problem {
        match self {
            Unreadable::TooLong => {
                Problem::at_line(number, "", format!("longer than {MAX_LINE_BYTES} bytes; not a table of observations"))
            }
            Unreadable::Io(error) => Problem::at_line(number, "", format!("cannot be read: {error}")),
        }
    }
}

/// Reads one line, whatever its bytes, holding at most [`MAX_LINE_BYTES`]. `false` at the end.
fn read_line(reader: &mut impl BufRead, line: &mut Vec<u8>) -> Result<bool, Unreadable> {
    line.clear();
    let read = reader.by_ref().take(MAX_LINE_BYTES as u64 + 1).read_until(b'\n', line).map_err(Unreadable::Io)?;
    if read > MAX_LINE_BYTES { Err(Unreadable::TooLong) } else { Ok(read > 0) }
}

fn refuse_foreign_bytes(first_line: &[u8]) -> Result<(), String> {
    if first_line.starts_with(SQLITE_MAGIC) {
        return Err("a COLMAP (SQLite) database is not a supported format yet; give an observations.csv".into());
    }
    if UTF16_BOMS.iter().any(|bom| first_line.starts_with(bom)) {
        return Err("is UTF-16 text; save it as UTF-8".into());
    }
    if first_line.strip_prefix(UTF8_BOM).unwrap_or(first_line).starts_with(b"OPENSFM_TRACKS_VERSION") {
        return Err("OpenSfM tracks are not a supported format yet; give an observations.csv (view,track,x,y)".into());
    }
    Ok(())
}

/// Finds the columns in the header line.
fn header(text: &str) -> Result<Columns, String> {
    if text.contains('\t') && !text.contains(',') {
        return Err("columns are separated by tabs, as in OpenSfM's tracks.csv, which is not a supported format yet; \
                    commas are needed: view,track,x,y"
            .into());
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
            if names.iter().all(|name| name.parse::<f64>().is_ok()) {
                format!("no header; the first line must be `view,track,x,y[,depth]`, not {quoted}")
            } else {
                format!("the header {quoted} has no column `{wanted}`; `view,track,x,y[,depth]` is needed")
            }
        })?;
    }
    let depth = find(DEPTH)?;
    Ok(Columns { required, depth, names })
}

impl Columns {
    /// Parses one line; an error names the column and says what is wrong.
    fn row(&self, text: &str) -> Result<Row, (&'static str, String)> {
        let fields: Vec<&str> = text.split(',').map(unquote).collect();
        if fields.len() != self.names.len() {
            return Err((
                "",
                format!("{} fields where the header has {}{}", fields.len(), self.names.len(), {
                    if fields.len() < self.names.len() { "; the file may be truncated" } else { "" }
                }),
            ));
        }
        let [view, track, x, y] = self.required.map(|place| fields[place]);
        Ok(Row {
            view: id(view).map_err(|what| ("view", what))?,
            track: id(track).map_err(|what| ("track", what))?,
            x: number(x).map_err(|what| ("x", what))?,
            y: number(y).map_err(|what| ("y", what))?,
            depth: self.depth.map(|place| number(fields[place])).transpose().map_err(|what| (DEPTH, what))?,
        })
    }
}

fn unquote(field: &str) -> &str {
    let field = field.trim();
    field.strip_prefix('"').and_then(|inner| inner.strip_suffix('"')).unwrap_or(field).trim()
}

/// A foreign value as it may stand in a message: short, control characters escaped.
fn quote(value: &str) -> String {
    let shown: String = value.chars().take(QUOTED_CHARS).flat_map(char::escape_debug).collect();
    let dots = if value.chars().nth(QUOTED_CHARS).is_some() { "..." } else { "" };
    format!("`{shown}{dots}`")
}

fn id(field: &str) -> Result<u64, String> {
    field.parse().map_err(|_| match field {
        "" => "is empty".into(),
        _ => format!("{} is not a whole number >= 0", quote(field)),
    })
}

/// NaN and infinities parse; [`LabelledInput::check`] refuses them in its own words.
fn number(field: &str) -> Result<f64, String> {
    field.parse().map_err(|_| match field {
        "" => "is empty; leave out the line of a point that was not observed".into(),
        _ => format!("{} is not a number", quote(field)),
    })
}

impl Table {
    fn push(&mut self, row: Row, line: u64) {
        self.view.push(row.view);
        self.track.push(row.track);
        self.x.push(row.x);
        self.y.push(row.y);
        self.depth.extend(row.depth);
        self.lines.push(line);
    }

    /// The domain refuses duplicates too, but by index; here both lines can be named.
    fn refuse_duplicates(&self, file: &str) -> Result<(), Error> {
        let mut order: Vec<usize> = (0..self.lines.len()).collect();
        order.sort_unstable_by_key(|&k| (self.track[k], self.view[k], k));
        let mut duplicates: Vec<(usize, usize)> = order
            .windows(2)
            .map(|pair| (pair[1], pair[0]))
            .filter(|&(later, first)| (self.track[later], self.view[later]) == (self.track[first], self.view[first]))
            .collect();
        duplicates.sort_unstable();
        let mut problems = Problems::default();
        for (later, first) in duplicates {
            let what = format!(
                "track {} is observed a second time in view {} (first on line {})",
                self.track[later], self.view[later], self.lines[first]
            );
            problems.push(Problem::at_line(self.lines[later], "track", what));
        }
        problems.into_result(file)
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
            },
            view_labels,
            track_labels,
            lines: self.lines,
            path: path.into(),
        }
    }
}

/// The distinct ids, ascending, and the position of each entry's id among them.
fn dense(ids: &[u64]) -> (Vec<u64>, Vec<u32>) {
    let labels: Vec<u64> = ids.iter().copied().collect::<BTreeSet<u64>>().into_iter().collect();
    let position: BTreeMap<u64, u32> = labels.iter().zip(0u32..).map(|(&label, position)| (label, position)).collect();
    let indices = ids.iter().filter_map(|id| position.get(id).copied()).collect();
    (labels, indices)
}

#[cfg(test)]
#[path = "observations_tests.rs"]
mod tests;
