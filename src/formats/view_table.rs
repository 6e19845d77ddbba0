//! Reading and writing a table of views: `view[,camera_group][,width,height][,focal_px[,focal_sigma]]`, one view a line.

use std::collections::BTreeMap;
use std::path::Path;

use csv::{ErrorKind, Position, ReaderBuilder, StringRecord, Trim};
use serde::Deserialize;

use super::colmap::cameras::PRIOR_SIGMA_LOG;
use super::error::{Error, Problem, Problems};
use super::input::{LabelledInput, display_path};
use super::label::Label;
use super::text;
use crate::domain::{FocalPrior, ImageSize, Limits, RawInput, View};

/// What a line says of a view. An empty cell says nothing.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    view: u64,
    camera_group: Option<u32>,
    width: Option<u32>,
    height: Option<u32>,
    focal_px: Option<f64>,
    focal_sigma: Option<f64>,
}

/// Says of the views of `labelled` what the table at `path` does; of others that it lists there is a note. The values are
/// checked by [`LabelledInput::check`].
///
/// # Errors
/// A file that is no such table, by line and column; a view that it lists twice.
pub fn apply(path: &Path, limits: &Limits, labelled: &mut LabelledInput) -> Result<(), Error> {
    let file = display_path(path);
    let mut reader = ReaderBuilder::new().trim(Trim::All).from_reader(text::open_table(path, limits)?);
    let header = reader.headers().map_err(|error| Error::one(&file, problem(&error, &StringRecord::new())))?.clone();
    let positions: BTreeMap<&Label, usize> = labelled.view_labels.iter().zip(0..).collect();
    let mut lines: BTreeMap<u64, u64> = BTreeMap::new();
    let mut problems = Problems::default();
    let mut absent = 0;
    for record in reader.records() {
        let row = record.and_then(|record| Ok((line_of(record.position()), record.deserialize::<Row>(Some(&header))?)));
        let (line, row) = match row {
            Ok(row) => row,
            Err(error) => {
                problems.push(problem(&error, &header));
                continue;
            }
        };
        if let Some(first) = lines.insert(row.view, line) {
            let what = format!("{} is listed a second time (first on line {first})", row.view);
            problems.push(Problem::at_line(line, "view", what));
        } else if let Some(&position) = positions.get(&Label::Number(row.view)) {
            let set = row.put_on(&mut labelled.raw.views[position]);
            set.unwrap_or_else(|(column, what)| problems.push(Problem::at_line(line, column, what)));
        } else {
            absent += 1;
        }
    }
    Error::check(&file, problems)?;
    if lines.is_empty() {
        return Err(Error::whole(&file, "lists no view"));
    }
    if absent > 0 {
        labelled.notes.push(format!("{absent} of the {} views of {file} have no observation", lines.len()));
    }
    Ok(())
}

impl Row {
    /// # Errors
    /// The column that lacks another, and what it lacks.
    fn put_on(&self, view: &mut View) -> Result<(), (&'static str, String)> {
        match (self.width, self.height) {
            (Some(width_px), Some(height_px)) => view.size = Some(ImageSize { width_px, height_px }),
            (None, None) => {}
            (Some(_), None) => return Err(("height", "is empty where a width is given".into())),
            (None, Some(_)) => return Err(("width", "is empty where a height is given".into())),
        }
        match (self.focal_px, self.focal_sigma) {
            (Some(focal_px), sigma) => {
                view.focal_prior = Some(FocalPrior { focal_px, sigma_log: sigma.unwrap_or(PRIOR_SIGMA_LOG) });
            }
            (None, Some(_)) => return Err(("focal_px", "is empty where a focal_sigma is given".into())),
            (None, None) => {}
        }
        view.camera_group = self.camera_group.unwrap_or(view.camera_group);
        Ok(())
    }
}

/// `view,camera_group,width,height`, a line for each view.
pub fn csv(input: &RawInput) -> String {
    let mut text = String::from("view,camera_group,width,height\n");
    for (view, of) in input.views.iter().enumerate() {
        let sides = of.size.map_or_else(|| ",".to_owned(), |size| format!("{},{}", size.width_px, size.height_px));
        text.push_str(&format!("{view},{},{sides}\n", of.camera_group));
    }
    text
}

/// What the reader of the table says, by line and column.
fn problem(error: &csv::Error, header: &StringRecord) -> Problem {
    let line = line_of(error.position());
    match error.kind() {
        ErrorKind::Deserialize { err, .. } => {
            let column = err.field().and_then(|field| header.get(field as usize)).unwrap_or_default();
            Problem::at_line(line, column, err.kind().to_string())
        }
        ErrorKind::UnequalLengths { expected_len, len, .. } => {
            Problem::at_line(line, "", format!("{len} fields where the header has {expected_len}"))
        }
        ErrorKind::Utf8 { .. } => Problem::not_text(line),
        other => Problem::unreadable(format!("{other:?}")),
    }
}

/// The header's where nothing tells it.
fn line_of(position: Option<&Position>) -> u64 {
    position.map_or(1, Position::line)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::formats::{Reading, read};

    fn with(views: &str) -> Result<LabelledInput, String> {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let [observations, table] = ["o.csv", "views.csv"].map(|name| directory.path().join(name));
        fs::write(&observations, "view,track,x,y\n2,0,1,2\n5,0,3,4\n9,0,5,6\n").expect("written");
        fs::write(&table, views).expect("written");
        let size = Some(ImageSize { width_px: 640, height_px: 480 });
        let reading = Reading { size, view_table: Some(table), ..Reading::default() };
        read(&observations, &Limits::default(), &reading).map_err(|error| error.to_string())
    }

    #[test]
    fn views_get_what_the_table_says_and_keep_the_rest() {
        let text = "\u{feff}view,width, height,camera_group,focal_px,focal_sigma\r\n9,800,600,3,,\r\n2,,,,700,0.05\r\n7,,,1,,\r\n";
        let input = with(text).expect("valid");
        let size = |width_px, height_px| Some(ImageSize { width_px, height_px });
        let prior = Some(FocalPrior { focal_px: 700.0, sigma_log: 0.05 });
        let base = View { size: size(640, 480), ..View::default() };
        let changed = View { size: size(800, 600), camera_group: 3, ..base.clone() };
        assert_eq!(input.raw.views, [View { focal_prior: prior, ..base.clone() }, base, changed]);
        assert!(input.notes[0].contains("1 of the 3 views of ") && input.notes[0].ends_with(" have no observation"));
    }

    #[test]
    fn what_is_wrong_is_told_by_line_and_column() {
        for (text, words) in [
            ("", "lists no view"),
            ("view,camera_group\n", "lists no view"),
            ("camera_group\n1\n", "line 2: missing field `view`"),
            ("view,camera\n2,1\n", "line 2: unknown field `camera`"),
            ("view,camera_group\n2,-1\n", "line 2: camera_group: invalid digit"),
            ("view,camera_group\n2,1,4\n", "line 2: 3 fields where the header has 2"),
            ("view,camera_group\n2,1\n5,1\n2,1\n", "line 4: view: 2 is listed a second time (first on line 2)"),
            ("view,width,height\n2,800,\n", "line 2: height: is empty"),
            ("view,focal_sigma\n2,0.1\n", "line 2: focal_px: is empty"),
            ("view,focal_px\n2,NaN\n", "view 2: "),
            ("view,width,height\n2,0,3\n", "view 2: "),
            ("view,camera_group\n\u{1}\u{2},1\n", "line 2: view: invalid digit"),
        ] {
            let refused = with(text).expect_err(text);
            assert!(refused.contains(words), "{text:?}: {refused}");
        }
    }
}
