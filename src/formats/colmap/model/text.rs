//! The text files of a model: `#` begins a comment line (COLMAP, `reconstruction_io_text.cc`).

use std::io::BufRead;

use super::super::cameras::{Camera, Model};
use super::super::images::{Images, Observation};
use super::ReadBounds;
use crate::domain::Limits;
use crate::formats::error::{Error, Problem};
use crate::formats::text::{Lines, MAX_TABLE_LINE_BYTES, number, quote, whole};

/// Longest line of keypoints in bytes: a million of them, at 64 bytes each, in one image.
const MAX_POINTS_LINE_BYTES: usize = 64 << 20;

/// Reads `cameras.txt`: `ID MODEL WIDTH HEIGHT PARAMETER...`.
pub(super) fn cameras(reader: impl BufRead, file: &str, images: &mut Images) -> Result<(), Error> {
    let one = |problem: Problem| Error::one(file, problem);
    let mut lines = Lines::new(reader, MAX_TABLE_LINE_BYTES);
    while lines.advance().map_err(one)? {
        let line = lines.expect_text().map_err(one)?;
        if is_comment(line) {
            continue;
        }
        let (column, added) = match camera(line) {
            Ok((id, camera)) => (format!("camera {id}"), images.add_camera(id, camera)),
            Err(what) => (String::new(), Err(what)),
        };
        added.map_err(|what| one(Problem::at_line(lines.number(), &column, what)))?;
    }
    Ok(())
}

fn camera(line: &str) -> Result<(u32, Camera), String> {
    let mut fields = line.split_whitespace();
    let mut next = || fields.next().ok_or("ID MODEL WIDTH HEIGHT PARAMETERS are needed; the file may be truncated");
    let (id, name, width, height) = (next()?, next()?, next()?, next()?);
    let model = Model::of_name(name).ok_or_else(|| format!("{} is not one of COLMAP's camera models", quote(name)))?;
    let parameters = fields.map(number).collect::<Result<Vec<f64>, String>>()?;
    if parameters.len() != model.parameters {
        return Err(format!(
            "{} parameters where {name} has {}; the file may be truncated",
            parameters.len(),
            model.parameters
        ));
    }
    Ok((whole(id)?, Camera::new(Some(model), whole(width)?, whole(height)?)?))
}

/// Reads `images.txt`: two lines an image, `ID QW QX QY QZ TX TY TZ CAMERA NAME` and `X Y POINT ...`, the second empty
/// where the image has no keypoints. Returns the keypoints that belong to a point.
pub(super) fn images(
    reader: impl BufRead,
    file: &str,
    limits: &Limits,
    images: &mut Images,
) -> Result<Vec<Observation>, Error> {
    let one = |problem: Problem| Error::one(file, problem);
    let bounds = ReadBounds::new(limits);
    let mut lines = Lines::new(reader, MAX_POINTS_LINE_BYTES);
    let mut observations = Vec::new();
    while lines.advance().map_err(one)? {
        let line = lines.expect_text().map_err(one)?;
        if is_comment(line) {
            continue;
        }
        let first = lines.number();
        let (id, name, camera) = image(line).map_err(|what| one(Problem::at_line(first, "", what)))?;
        let record = format!("image {id}");
        let wrong = |line: u64, what: String| one(Problem::at_line(line, &record, what));
        let image = images.add_image(id, name, camera).map_err(|what| wrong(first, what))?;
        // COLMAP ends the last image with a line too, be it an empty one.
        if !lines.advance().map_err(one)? {
            return Err(wrong(first, "has no line of keypoints; the file may be truncated".into()));
        }
        let line = lines.expect_text().map_err(one)?;
        let second = lines.number();
        keypoints(line, image, second, bounds.most_observations, images, &mut observations)
            .and_then(|()| bounds.check(images, &observations))
            .map_err(|what| wrong(second, what))?;
    }
    Ok(observations)
}

/// Id, name and camera of the first line of an image.
fn image(line: &str) -> Result<(u32, &str, u32), String> {
    let mut rest = line;
    let mut next = || {
        let trimmed = rest.trim_start();
        let (field, after) = trimmed.split_once(char::is_whitespace).unwrap_or((trimmed, ""));
        rest = after;
        field
    };
    let id = whole(next())?;
    for _ in 0..7 {
        number(next()).map_err(|what| format!("pose: {what}"))?;
    }
    let camera = whole(next()).map_err(|what| format!("camera: {what}"))?;
    Ok((id, rest.trim(), camera))
}

/// Reads a line of keypoints; at most one more than `most` are kept.
fn keypoints(
    line: &str,
    image: u32,
    line_number: u64,
    most: usize,
    images: &mut Images,
    observations: &mut Vec<Observation>,
) -> Result<(), String> {
    let mut fields = line.split_whitespace();
    let mut position = 0;
    while let Some(x) = fields.next() {
        let (Some(y), Some(track)) = (fields.next(), fields.next()) else {
            return Err(format!("keypoint {position} has no `X Y POINT`; the file may be truncated"));
        };
        let named = |what: String| format!("keypoint {position}: {what}");
        let (x, y) = (number(x).map_err(named)?, number(y).map_err(named)?);
        let keypoint = images.add_keypoint(image, x, y);
        if track != "-1" {
            let track = whole(track).map_err(named)?;
            observations.push(Observation { image, keypoint, track, x, y, line: line_number });
            if observations.len() > most {
                break;
            }
        }
        position += 1;
    }
    Ok(())
}

fn is_comment(line: &str) -> bool {
    let line = line.trim_start();
    line.is_empty() || line.starts_with('#')
}
