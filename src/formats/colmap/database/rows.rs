//! The tables of a COLMAP database, row by row, every blob measured against what its row announces.

use std::collections::{BTreeSet, HashMap, HashSet};

use rusqlite::types::{Type, ValueRef};
use rusqlite::{Connection, Row};

use super::super::cameras::{Camera, Model};
use super::super::images::{Frame, Images};
use crate::domain::PairMatches;
use crate::formats::error::Problem;
use crate::formats::source::Matches;

/// COLMAP's numbering of pairs: `first * MAX_IMAGES + second`, first < second (`kMaxNumImages`, `types.h`).
pub(in super::super) const MAX_IMAGES: u64 = 2_147_483_647;
/// Keypoints in all: 2,000 images of 25,000, twice what COLMAP extracts at most by default. 8 bytes each are held.
const MAX_KEYPOINTS: usize = 50_000_000;
/// Matches in all: 2,000 images, each matched with 20 others, 800 matches a pair. Some 50 bytes each are held.
pub(in super::super) const MAX_MATCHES: usize = 32_000_000;

/// The table with the matches of a kind.
pub(super) fn table(kind: Matches) -> &'static str {
    match kind {
        Matches::Verified => "two_view_geometries",
        Matches::Raw => "matches",
    }
}

fn damaged(error: rusqlite::Error) -> Problem {
    Problem::of_file(format!("cannot be read as a COLMAP database: {}", cause(error)))
}

/// What is wrong, without the query.
pub(in super::super) fn cause(error: rusqlite::Error) -> String {
    match error {
        rusqlite::Error::SqlInputError { msg, .. } => msg,
        error => error.to_string(),
    }
}

/// Gives every row of a query to `each`.
pub(in super::super) fn for_each_row(
    connection: &Connection,
    query: &str,
    mut each: impl FnMut(&Row<'_>) -> Result<(), Problem>,
) -> Result<(), Problem> {
    let mut statement = connection.prepare(query).map_err(damaged)?;
    let mut rows = statement.query([]).map_err(damaged)?;
    while let Some(row) = rows.next().map_err(damaged)? {
        each(row)?;
    }
    Ok(())
}

/// The tables that a query may go to. Views and virtual tables are none: a query of one runs its maker's program.
pub(in super::super) fn tables(connection: &Connection) -> Result<BTreeSet<String>, Problem> {
    let query = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'";
    names(connection, query)
}

/// The names that a query selects. One that is no text is none of COLMAP's.
pub(in super::super) fn names(connection: &Connection, query: &str) -> Result<BTreeSet<String>, Problem> {
    let mut names = BTreeSet::new();
    for_each_row(connection, query, |row| {
        names.extend(row.get::<_, String>("name"));
        Ok(())
    })?;
    Ok(names)
}

pub(super) fn cameras(connection: &Connection, images: &mut Images) -> Result<(), Problem> {
    let query = "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY camera_id";
    for_each_row(connection, query, |row| {
        let id: u32 = integer(row, "cameras", "camera_id", 0)?;
        let value = |column: &str| integer::<i64>(row, "cameras", column, id.into());
        let side = |column: &str| integer::<u64>(row, "cameras", column, id.into());
        let model = Model::of_id(value("model")?);
        let (width, height, is_known) = (side("width")?, side("height")?, value("prior_focal_length")? != 0);
        let first = blob(row, "cameras", "params", id.into())?.first_chunk().copied().map(f64::from_le_bytes);
        Camera::new(model, width, height)
            .and_then(|camera| images.add_camera(id, camera.knowing(first.filter(|_| is_known))))
            .map_err(|what| Problem::of_record(format!("table cameras, row {id}"), what))
    })
}

pub(super) fn images(connection: &Connection, most: usize, images: &mut Images) -> Result<(), Problem> {
    let query = "SELECT image_id, camera_id, name FROM images ORDER BY image_id";
    for_each_row(connection, query, |row| {
        let id: u32 = integer(row, "images", "image_id", 0)?;
        let wrong = |what: String| Problem::of_record(format!("table images, row {id}"), what);
        let camera = integer(row, "images", "camera_id", id.into())?;
        let name = match cell(row, "images", "name", id.into())? {
            ValueRef::Text(text) => str::from_utf8(text).map_err(|error| wrong(format!("name: {error}")))?,
            other => return Err(other_type("images", "name", id.into(), other, Type::Text)),
        };
        images.add_image(id, name, camera).map_err(wrong)?;
        if images.len() > most { Err(wrong(format!("more images than the limit of {most}"))) } else { Ok(()) }
    })
}

/// The frame of each image, where it has one of its own; `None`: a frame has several images.
pub(super) fn frames(connection: &Connection, images: &Images) -> Result<Option<HashMap<u32, Frame>>, Problem> {
    let query = "SELECT data.data_id AS image_id, frames.frame_id AS frame_id, frames.rig_id AS rig_id
        FROM frame_data AS data JOIN frames ON frames.frame_id = data.frame_id WHERE data.sensor_type = 0
        ORDER BY data.data_id";
    let (mut frames, mut taken, mut is_trivial) = (HashMap::new(), HashSet::new(), true);
    for_each_row(connection, query, |row| {
        let id: u32 = integer(row, "frame_data", "image_id", 0)?;
        if images.position(id).is_none() {
            return Ok(());
        }
        let number = |column: &str| integer::<u32>(row, "frames", column, id.into());
        let frame = Frame { id: number("frame_id")?, rig: number("rig_id")? };
        is_trivial &= taken.insert(frame.id) && frames.insert(id, frame).is_none();
        Ok(())
    })?;
    Ok(is_trivial.then_some(frames))
}

/// Keypoints of all images, numbered image after image.
#[derive(Debug)]
pub(super) struct Keypoints {
    /// Number of the first keypoint of each image, and their number in all.
    starts: Vec<u32>,
    /// In COLMAP's pixels.
    points: Vec<[f32; 2]>,
}

impl Keypoints {
    /// The keypoints of each image, the last image first.
    pub fn into_images(mut self) -> impl Iterator<Item = (u32, Vec<[f32; 2]>)> {
        self.starts.pop();
        std::iter::from_fn(move || {
            let start = self.starts.pop()?;
            Some((self.starts.len() as u32, self.points.split_off(start as usize)))
        })
    }

    /// Number of keypoints of the image at a position.
    pub fn count(&self, image: u32) -> u32 {
        let image = image as usize;
        self.starts[image + 1] - self.starts[image]
    }

    /// Where a keypoint of an image is.
    pub fn point(&self, image: u32, keypoint: u32) -> [f64; 2] {
        self.points[(self.starts[image as usize] + keypoint) as usize].map(f64::from)
    }
}

pub(super) fn keypoints(connection: &Connection, images: &Images) -> Result<Keypoints, Problem> {
    let mut of_image: Vec<Vec<[f32; 2]>> = vec![Vec::new(); images.len()];
    let mut count = 0;
    let query = "SELECT image_id, rows, cols, data FROM keypoints ORDER BY image_id";
    for_each_row(connection, query, |row| {
        let id: u32 = integer(row, "keypoints", "image_id", 0)?;
        let wrong = |what: &str| Problem::of_record(format!("table keypoints, row {id}"), what);
        let image = images.position(id).ok_or_else(|| wrong("is of no image of the table images"))?;
        let (columns, data) = matrix(row, "keypoints", id.into())?;
        // x, y, and scale and orientation or an affine shape, which are not needed.
        let points = data.chunks_exact(4 * columns).map(|row| pair(row).map(f32::from_le_bytes));
        of_image[image as usize] = points.collect();
        count += of_image[image as usize].len();
        let fits = count <= MAX_KEYPOINTS;
        if fits { Ok(()) } else { Err(wrong(&format!("more keypoints than {MAX_KEYPOINTS} in all"))) }
    })?;
    let mut starts = vec![0];
    let mut points = Vec::with_capacity(count);
    for of_image in of_image {
        points.extend(of_image);
        starts.push(points.len() as u32);
    }
    Ok(Keypoints { starts, points })
}

/// The matches of a kind. Views are the positions of the images.
pub(super) fn matches(
    connection: &Connection,
    kind: Matches,
    images: &Images,
    keypoints: &Keypoints,
) -> Result<PairMatches, Problem> {
    let query = format!("SELECT pair_id, rows, cols, data FROM {} WHERE rows <> 0 ORDER BY pair_id", table(kind));
    let mut matches = PairMatches::default();
    for_each_row(connection, &query, |row| of_pair(row, table(kind), images, keypoints, &mut matches))?;
    Ok(matches)
}

/// Takes the matches of one image pair, each once.
fn of_pair(
    row: &Row<'_>,
    table: &str,
    images: &Images,
    keypoints: &Keypoints,
    matches: &mut PairMatches,
) -> Result<(), Problem> {
    let pair_id: u64 = integer(row, table, "pair_id", 0)?;
    let wrong = |what: String| Problem::of_record(format!("table {table}, row {pair_id}"), what);
    let [first_id, second_id] = [pair_id / MAX_IMAGES, pair_id % MAX_IMAGES];
    let position = |id: u64| u32::try_from(id).ok().and_then(|id| images.position(id));
    let (Some(first), Some(second)) = (position(first_id), position(second_id)) else {
        return Err(wrong(format!(
            "is of the images {first_id} and {second_id}, which the table images does not have"
        )));
    };
    if first == second {
        return Err(wrong(format!("matches image {first_id} with itself")));
    }
    let (columns, data) = matrix(row, table, pair_id)?;
    let counts = [first, second].map(|image| keypoints.count(image));
    let mut of_pair = Vec::with_capacity(data.len() / (4 * columns));
    for (k, row) in data.chunks_exact(4 * columns).enumerate() {
        let [in_first, in_second] = pair(row).map(u32::from_le_bytes);
        if in_first >= counts[0] || in_second >= counts[1] {
            return Err(wrong(format!("match {k} joins keypoints {in_first} and {in_second}; one is not there")));
        }
        of_pair.push([in_first, in_second]);
    }
    of_pair.sort_unstable();
    of_pair.dedup();
    matches.push([first, second], of_pair);
    if matches.len() > MAX_MATCHES { Err(wrong(format!("more matches than {MAX_MATCHES} in all"))) } else { Ok(()) }
}

/// The first two four-byte numbers of a row of a matrix, which has at least [`LEAST_COLUMNS`].
fn pair(row: &[u8]) -> [[u8; 4]; 2] {
    [[row[0], row[1], row[2], row[3]], [row[4], row[5], row[6], row[7]]]
}

/// What a row has in a column. `id` names the row in errors.
fn cell<'r>(row: &'r Row<'_>, table: &str, column: &str, id: u64) -> Result<ValueRef<'r>, Problem> {
    row.get_ref(column).map_err(|error| Problem::of_record(place(table, column, id), error.to_string()))
}

fn place(table: &str, column: &str, id: u64) -> String {
    format!("table {table}, row {id}: {column}")
}

/// A column that holds something else than it should.
fn other_type(table: &str, column: &str, id: u64, found: ValueRef<'_>, expected: Type) -> Problem {
    Problem::of_record(place(table, column, id), format!("is of the type {}, not {expected}", found.data_type()))
}

/// An integer of a row.
pub(in super::super) fn integer<T: TryFrom<i64>>(
    row: &Row<'_>,
    table: &str,
    column: &str,
    id: u64,
) -> Result<T, Problem> {
    match cell(row, table, column, id)? {
        ValueRef::Integer(value) => T::try_from(value)
            .map_err(|_| Problem::of_record(place(table, column, id), format!("{value} is out of range"))),
        other => Err(other_type(table, column, id, other, Type::Integer)),
    }
}

/// A blob of a row; NULL is an empty one.
fn blob<'r>(row: &'r Row<'_>, table: &str, column: &str, id: u64) -> Result<&'r [u8], Problem> {
    match cell(row, table, column, id)? {
        // SQLite keeps what it is given: bytes may be there as text.
        ValueRef::Blob(bytes) | ValueRef::Text(bytes) => Ok(bytes),
        ValueRef::Null => Ok(&[]),
        other => Err(other_type(table, column, id, other, Type::Blob)),
    }
}

/// Columns of keypoints (x, y) and of matches (a keypoint of either image) that there must be.
const LEAST_COLUMNS: usize = 2;

/// The columns and the bytes of a matrix of four-byte numbers.
fn matrix<'r>(row: &'r Row<'_>, table: &str, id: u64) -> Result<(usize, &'r [u8]), Problem> {
    let (rows, columns): (u64, usize) = (integer(row, table, "rows", id)?, integer(row, table, "cols", id)?);
    let data = blob(row, table, "data", id)?;
    let wrong = |what: String| Problem::of_record(format!("table {table}, row {id}: data"), what);
    if rows > 0 && columns < LEAST_COLUMNS {
        return Err(wrong(format!("has {columns} columns, at least {LEAST_COLUMNS} are needed")));
    }
    let announced = rows.checked_mul(columns as u64).and_then(|numbers| numbers.checked_mul(4));
    if announced != Some(data.len() as u64) {
        return Err(wrong(format!("has {} bytes, {rows} x {columns} numbers of 4 are announced", data.len())));
    }
    // An empty matrix may have any number of columns.
    Ok((if data.is_empty() { LEAST_COLUMNS } else { columns }, data))
}
