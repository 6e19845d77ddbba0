//! Reading and writing a table of views: `view[,camera_group][,width,height][,focal_px[,focal_sigma]]`, one view a
//! line.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::path::Path;

use csv::{ErrorKind, Position, ReaderBuilder, StringRecord, Trim};

use super::colmap::cameras::PRIOR_SIGMA_LOG;
use super::error::{Error, Problem, Problems};
use super::input::{LabelledInput, display_path};
use super::label::Label;
use super::text::{self, quote};
use crate::domain::{FocalPrior, ImageSize, Limits, RawInput, View};

const COLUMNS: [&str; 6] = ["view", "camera_group", "width", "height", "focal_px", "focal_sigma"];
/// Views that a sentence names.
const MOST_NAMED: usize = 3;

/// A wrong cell: its column, and what is wrong.
type Wrong = (&'static str, String);

/// Says of the views of `labelled` what the table at `path` does. Views without observations are named in a note.
///
/// # Errors
/// A file that is no such table, by line and column; a view that it lists twice; no view of the input.
pub fn apply(path: &Path, limits: &Limits, labelled: &mut LabelledInput) -> Result<(), Error> {
    let file = display_path(path);
    let mut reader = ReaderBuilder::new().trim(Trim::All).from_reader(text::open_table(path, limits)?);
    let header = reader.headers().map_err(|error| Error::one(&file, problem(&error)))?.clone();
    check(&header).map_err(|what| Error::one(&file, Problem::at_line(1, "", what)))?;
    let positions: BTreeMap<&Label, usize> = labelled.view_labels.iter().zip(0..).collect();
    let mut lines: BTreeMap<u64, u64> = BTreeMap::new();
    let mut problems = Problems::default();
    let mut absent = Vec::new();
    for record in reader.records() {
        let record = match record {
            Ok(record) => record,
            Err(error) => {
                problems.push(problem(&error));
                continue;
            }
        };
        let line = line_of(record.position());
        let cell = |column: &str| {
            let position = header.iter().position(|name| name == column)?;
            record.get(position).filter(|text| !text.is_empty())
        };
        let number = match text::whole::<u64>(cell("view").unwrap_or_default()) {
            Ok(number) => number,
            Err(what) => {
                problems.push(Problem::at_line(line, "view", what));
                continue;
            }
        };
        if let Some(first) = lines.insert(number, line) {
            let what = format!("{number} is listed a second time (first on line {first})");
            problems.push(Problem::at_line(line, "view", what));
            continue;
        }
        let mut unobserved = View::default();
        let view = match positions.get(&Label::Number(number)) {
            Some(&position) => &mut labelled.raw.views[position],
            None => {
                absent.push(number.to_string());
                &mut unobserved
            }
        };
        put_on(view, cell).unwrap_or_else(|(column, what)| problems.push(Problem::at_line(line, column, what)));
    }
    Error::check(&file, problems)?;
    if lines.len() == absent.len() {
        return Err(Error::whole(&file, "lists no view that has an observation"));
    }
    if !absent.is_empty() {
        let more = if absent.len() > MOST_NAMED { ", ..." } else { "" };
        let named = absent[..absent.len().min(MOST_NAMED)].join(", ");
        labelled.notes.push(format!(
            "{} of the {} views of {file} have no observation: {named}{more}",
            absent.len(),
            lines.len()
        ));
    }
    Ok(())
}

/// # Errors
/// What is wrong with a header.
fn check(header: &StringRecord) -> Result<(), String> {
    let known = COLUMNS.join(",");
    if header.is_empty() {
        return Err(format!("is empty; a header with columns of `{known}` is needed"));
    }
    for (position, name) in header.iter().enumerate() {
        if !COLUMNS.contains(&name) {
            return Err(format!("{} is no column; there are `{known}`, separated by commas", quote(name)));
        }
        if header.iter().take(position).any(|earlier| earlier == name) {
            return Err(format!("the header names the column `{name}` twice"));
        }
    }
    if header.iter().all(|name| name != "view") { Err("the header has no column `view`".into()) } else { Ok(()) }
}

/// * `cell`: what a line has in a column; `None`: nothing
fn put_on<'a>(view: &mut View, cell: impl Fn(&str) -> Option<&'a str>) -> Result<(), Wrong> {
    let whole = |column, range| within(column, cell(column).map(text::whole::<u32>), range);
    let real = |column, range| within(column, cell(column).map(text::number), range);
    let side = |column: &'static str| whole(column, (1, ImageSize::MAX_SIDE_PX));
    match (side("width")?, side("height")?) {
        (Some(width_px), Some(height_px)) => view.size = Some(ImageSize { width_px, height_px }),
        (None, None) => {}
        (Some(_), None) => return Err(("height", "is empty where a width is given".into())),
        (None, Some(_)) => return Err(("width", "is empty where a height is given".into())),
    }
    let sigma_log = real("focal_sigma", FocalPrior::SIGMA_LOG_RANGE)?;
    match (real("focal_px", FocalPrior::FOCAL_RANGE_PX)?, sigma_log) {
        (Some(focal_px), sigma) => {
            view.focal_prior = Some(FocalPrior { focal_px, sigma_log: sigma.unwrap_or(PRIOR_SIGMA_LOG) });
        }
        (None, Some(_)) => return Err(("focal_px", "is empty where a focal_sigma is given".into())),
        (None, None) => {}
    }
    view.camera_group = whole("camera_group", (0, u32::MAX))?.unwrap_or(view.camera_group);
    Ok(())
}

/// The number that was read in a column, of those allowed.
fn within<T: PartialOrd + Debug>(
    column: &'static str,
    read: Option<Result<T, String>>,
    (least, most): (T, T),
) -> Result<Option<T>, Wrong> {
    match read.transpose().map_err(|what| (column, what))? {
        Some(number) if !(&least..=&most).contains(&&number) => {
            Err((column, format!("{number:?} is not within {least:?}..={most:?}")))
        }
        number => Ok(number),
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

/// What the reader of the table says.
fn problem(error: &csv::Error) -> Problem {
    let line = line_of(error.position());
    match error.kind() {
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
        let text = "\u{feff}view,width, height,camera_group,focal_px,focal_sigma\r\n\
                    9,800,600,3,,\r\n2,,,,700,0.05\r\n7,,,1,,\r\n";
        let input = with(text).expect("valid");
        let size = |width_px, height_px| Some(ImageSize { width_px, height_px });
        let prior = Some(FocalPrior { focal_px: 700.0, sigma_log: 0.05 });
        let base = View { size: size(640, 480), ..View::default() };
        let changed = View { size: size(800, 600), camera_group: 3, ..base.clone() };
        assert_eq!(input.raw.views, [View { focal_prior: prior, ..base.clone() }, base, changed]);
        assert!(input.notes[0].contains("1 of the 3 views of ") && input.notes[0].ends_with("no observation: 7"));
        let written = "view,camera_group,width,height\n0,0,640,480\n1,0,640,480\n2,3,800,600\n";
        assert_eq!(csv(&input.raw), written);
    }

    #[test]
    fn what_is_wrong_is_told_by_line_and_column() {
        for (text, words) in [
            ("", "line 1: is empty; a header"),
            ("view,camera_group\n", "lists no view that has an observation"),
            ("view,camera_group\n7,1\n", "lists no view that has an observation"),
            ("camera_group\n1\n", "line 1: the header has no column `view`"),
            ("view,camera\n2,1\n", "line 1: `camera` is no column; there are `view,camera_group,"),
            ("view;camera_group\n2;1\n", "line 1: `view;camera_group` is no column"),
            ("view,view\n2,2\n", "line 1: the header names the column `view` twice"),
            ("view,camera_group\n2,-1\n", "line 2: camera_group: `-1` is not a whole number >= 0"),
            ("view,camera_group\n2,1,4\n", "line 2: 3 fields where the header has 2"),
            ("view,camera_group\n2,1\n5,1\n2,1\n", "line 4: view: 2 is listed a second time (first on line 2)"),
            ("view,width,height\n2,800,\n", "line 2: height: is empty"),
            ("view,focal_sigma\n2,0.1\n", "line 2: focal_px: is empty"),
            ("view,focal_px\n2,NaN\n", "line 2: focal_px: NaN is not within 1e-6..=1000000000.0"),
            ("view,focal_px\n2,1e300\n", "line 2: focal_px: 1e300 is not within 1e-6..=1000000000.0"),
            ("view,focal_px,focal_sigma\n7,2,0\n", "line 2: focal_sigma: 0.0 is not within 1e-9..=1000.0"),
            ("view,width,height\n2,0,3\n", "line 2: width: 0 is not within 1..=1000000"),
            ("view,camera_group\n\u{1}\u{2},1\n,1\n", "line 2: view: `"),
            ("view,camera_group\n,1\n", "line 2: view: is empty"),
        ] {
            let refused = with(text).expect_err(text);
            assert!(refused.contains(words), "{text:?}: {refused}");
        }
    }
}
