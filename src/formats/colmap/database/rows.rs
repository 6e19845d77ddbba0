//! The tables of a COLMAP database, row by row, every blob measured against what its row announces.

use futures_util::TryStreamExt;
use sqlx::Row;
use sqlx::sqlite::{SqliteConnection, SqliteRow};

use super::super::cameras::{Camera, Model};
use super::super::images::Images;
use super::super::tracks::Match;
use crate::formats::error::Problem;
use crate::formats::source::Matches;

/// COLMAP's numbering of pairs: `first * MAX_IMAGES + second`, first < second (`kMaxNumImages`, `types.h`).
const MAX_IMAGES: u64 = 2_147_483_647;
/// Keypoints in all: 2,000 images of 25,000, twice what COLMAP extracts at most by default. 8 bytes each are held.
const MAX_KEYPOINTS: usize = 50_000_000;
/// Matches in all: 2,000 images, each matched with 20 others, 800 matches a pair. Some 50 bytes each are held.
const MAX_MATCHES: usize = 32_000_000;

/// The table with the matches of a kind.
pub(super) fn table(kind: Matches) -> &'static str {
    match kind {
        Matches::Verified => "two_view_geometries",
        Matches::Raw => "matches",
    }
}

fn damaged(error: sqlx::Error) -> Problem {
    Problem::of_file(format!("cannot be read as a COLMAP database: {error}"))
}

/// Refuses a database without these tables. Views and virtual tables are none: a query of one runs its maker's program.
pub(super) async fn require_tables(connection: &mut SqliteConnection, tables: &[&str]) -> Result<(), Problem> {
    const TABLES: &str =
        "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%' AND name = ?";
    for table in tables {
        let found = sqlx::query(TABLES).bind(*table).fetch_optional(&mut *connection).await.map_err(damaged)?;
        if found.is_none() {
            return Err(Problem::of_file(format!("is no COLMAP database: it has no table `{table}`")));
        }
    }
    Ok(())
}

pub(super) async fn cameras(connection: &mut SqliteConnection, images: &mut Images) -> Result<(), Problem> {
    let query = "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY camera_id";
    let mut found = sqlx::query(query).fetch(connection);
    while let Some(row) = found.try_next().await.map_err(damaged)? {
        let id: u32 = integer(&row, "cameras", "camera_id", 0)?;
        let wrong = |what: String| Problem::of_record(format!("table cameras, camera_id {id}"), what);
        let model: i64 = integer(&row, "cameras", "model", id.into())?;
        let (width, height) =
            (integer(&row, "cameras", "width", id.into())?, integer(&row, "cameras", "height", id.into())?);
        let camera = Camera::new(Model::of_id(model), width, height).map_err(wrong)?;
        let is_known = integer::<i64>(&row, "cameras", "prior_focal_length", id.into())? != 0;
        let first = blob(&row, "cameras", "params", id.into())?.first_chunk().copied().map(f64::from_le_bytes);
        images.add_camera(id, camera.knowing(first.filter(|_| is_known))).map_err(wrong)?;
    }
    Ok(())
}

pub(super) async fn images(connection: &mut SqliteConnection, most: usize, images: &mut Images) -> Result<(), Problem> {
    let mut found = sqlx::query("SELECT image_id, camera_id, name FROM images ORDER BY image_id").fetch(connection);
    while let Some(row) = found.try_next().await.map_err(damaged)? {
        let id: u32 = integer(&row, "images", "image_id", 0)?;
        let wrong = |what: String| Problem::of_record(format!("table images, image_id {id}"), what);
        let camera = integer(&row, "images", "camera_id", id.into())?;
        let name: &str = row.try_get("name").map_err(|error| wrong(format!("name: {}", unwrapped(error))))?;
        images.add_image(id, name, camera).map_err(wrong)?;
        if images.len() > most {
            return Err(wrong(format!("more images than the limit of {most}")));
        }
    }
    Ok(())
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
    /// Position of the image that a keypoint is of.
    pub fn image_of(&self, keypoint: u32) -> u32 {
        (self.starts.partition_point(|&start| start <= keypoint) - 1) as u32
    }

    pub fn point(&self, keypoint: u32) -> [f64; 2] {
        self.points[keypoint as usize].map(f64::from)
    }

    /// Number of keypoint `index` of an image, if it has so many.
    fn number(&self, image: u32, index: u32) -> Option<u32> {
        let [start, end] = *self.starts.get(image as usize..)?.first_chunk()?;
        start.checked_add(index).filter(|&keypoint| keypoint < end)
    }
}

pub(super) async fn keypoints(connection: &mut SqliteConnection, images: &Images) -> Result<Keypoints, Problem> {
    let mut of_image: Vec<Vec<[f32; 2]>> = vec![Vec::new(); images.len()];
    let mut count = 0;
    let query = "SELECT image_id, rows, cols, data FROM keypoints ORDER BY image_id";
    let mut found = sqlx::query(query).fetch(connection);
    while let Some(row) = found.try_next().await.map_err(damaged)? {
        let id: u32 = integer(&row, "keypoints", "image_id", 0)?;
        let wrong = |what: String| Problem::of_record(format!("table keypoints, image_id {id}"), what);
        let image = images.position(id).ok_or_else(|| wrong("is not among the images".into()))?;
        let (columns, data) = matrix(&row, "keypoints", id.into(), 2)?;
        // x, y, and scale and orientation or an affine shape, which are not needed.
        let points = data.chunks_exact(4 * columns).map(|row| {
            let coordinate = |at: usize| f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]);
            [coordinate(0), coordinate(4)]
        });
        of_image[image as usize] = points.collect();
        count += of_image[image as usize].len();
        if count > MAX_KEYPOINTS {
            return Err(wrong(format!("more keypoints than {MAX_KEYPOINTS} in all")));
        }
    }
    let mut starts = vec![0];
    let mut points = Vec::with_capacity(count);
    for of_image in of_image {
        points.extend(of_image);
        starts.push(points.len() as u32);
    }
    Ok(Keypoints { starts, points })
}

/// The matches of a kind, and the number of image pairs that have some.
pub(super) async fn matches(
    connection: &mut SqliteConnection,
    kind: Matches,
    images: &Images,
    keypoints: &Keypoints,
) -> Result<(Vec<Match>, usize), Problem> {
    let query = match kind {
        Matches::Verified => {
            "SELECT pair_id, rows, cols, data FROM two_view_geometries WHERE rows <> 0 ORDER BY pair_id"
        }
        Matches::Raw => "SELECT pair_id, rows, cols, data FROM matches WHERE rows <> 0 ORDER BY pair_id",
    };
    let table = table(kind);
    let mut matches = Vec::new();
    let mut pairs = 0;
    let mut found = sqlx::query(query).fetch(connection);
    while let Some(row) = found.try_next().await.map_err(damaged)? {
        let pair: u64 = integer(&row, table, "pair_id", 0)?;
        let wrong = |what: String| Problem::of_record(format!("table {table}, pair_id {pair}"), what);
        let ids = [pair / MAX_IMAGES, pair % MAX_IMAGES];
        let position = |id: u64| u32::try_from(id).ok().and_then(|id| images.position(id));
        let (Some(first), Some(second)) = (position(ids[0]), position(ids[1])) else {
            return Err(wrong(format!(
                "is of the images {} and {}, which are not both among the images",
                ids[0], ids[1]
            )));
        };
        if first == second {
            return Err(wrong(format!("matches image {} with itself", ids[0])));
        }
        let (columns, data) = matrix(&row, table, pair, 2)?;
        let rows = data.chunks_exact(4 * columns);
        let pair_size = rows.len() as u32;
        for (k, row) in rows.enumerate() {
            let index = |at: usize| u32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]);
            let ends = [(first, index(0)), (second, index(4))].map(|(image, index)| keypoints.number(image, index));
            let [Some(a), Some(b)] = ends else {
                let what =
                    format!("match {k} joins keypoints {} and {}, of which one is not there", index(0), index(4));
                return Err(wrong(what));
            };
            matches.push(Match { a, b, pair_size });
        }
        if matches.len() > MAX_MATCHES {
            return Err(wrong(format!("more matches than {MAX_MATCHES} in all")));
        }
        pairs += 1;
    }
    Ok((matches, pairs))
}

/// An integer of a row. `id` names the row in errors.
fn integer<T: TryFrom<i64>>(row: &SqliteRow, table: &str, column: &str, id: u64) -> Result<T, Problem> {
    let wrong = |what: String| Problem::of_record(format!("table {table}, row {id}: {column}"), what);
    let value: i64 = row.try_get(column).map_err(|error| wrong(unwrapped(error)))?;
    T::try_from(value).map_err(|_| wrong(format!("{value} is out of range")))
}

/// A blob of a row; NULL is an empty one.
fn blob<'r>(row: &'r SqliteRow, table: &str, column: &str, id: u64) -> Result<&'r [u8], Problem> {
    let value: Option<&[u8]> = row
        .try_get(column)
        .map_err(|error| Problem::of_record(format!("table {table}, row {id}: {column}"), unwrapped(error)))?;
    Ok(value.unwrap_or_default())
}

/// The columns and the bytes of a matrix of four-byte numbers with at least `least` columns.
fn matrix<'r>(row: &'r SqliteRow, table: &str, id: u64, least: usize) -> Result<(usize, &'r [u8]), Problem> {
    let (rows, columns): (u64, usize) = (integer(row, table, "rows", id)?, integer(row, table, "cols", id)?);
    let data = blob(row, table, "data", id)?;
    let wrong = |what: String| Problem::of_record(format!("table {table}, row {id}: data"), what);
    if rows > 0 && columns < least {
        return Err(wrong(format!("has {columns} columns, at least {least} are needed")));
    }
    let announced = rows.checked_mul(columns as u64).and_then(|numbers| numbers.checked_mul(4));
    if announced != Some(data.len() as u64) {
        return Err(wrong(format!("has {} bytes, {rows} x {columns} numbers of 4 are announced", data.len())));
    }
    Ok((columns.max(least), data))
}

/// What went wrong with a column, without sqlx's words around it.
fn unwrapped(error: sqlx::Error) -> String {
    match error {
        sqlx::Error::ColumnDecode { source, .. } => source.to_string(),
        error => error.to_string(),
    }
}
