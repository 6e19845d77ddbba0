//! A copy of a COLMAP database with the two-view geometries and the cameras of a result, for COLMAP's mappers to go on
//! from. Keypoints, descriptors, images and raw matches stay as they are.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io;
use std::path::Path;

use rusqlite::types::Value;
use rusqlite::{Connection, OpenFlags, params, params_from_iter};

use super::cameras::Model;
use super::database::rows::{self, MAX_IMAGES, for_each_row};
use super::database::{distrust, refuse_unfinished};
use super::intrinsics;
use super::two_view::{self, Geometry, Pair};
use crate::domain::{Calibration, Grade, Solution};
use crate::formats::LabelledInput;
use crate::formats::error::Problem;

/// COLMAP's numbers of two-view configurations (`src/colmap/scene/two_view_geometry.h`).
const UNDEFINED: i64 = 0;
const CALIBRATED: i64 = 2;
const UNCALIBRATED: i64 = 3;
const PANORAMIC: i64 = 5;

/// Writes the copy to `target`, which is replaced.
///
/// # Errors
/// A database that cannot be copied, was changed since it was read, or has triggers, which the changes would run; in
/// words.
pub fn write(target: &Path, solution: &Solution, input: &LabelledInput) -> Result<(), String> {
    let pairs = two_view::pairs(solution, input);
    let cameras = cameras(solution, input);
    let copied = || -> io::Result<()> {
        // Not `fs::copy`, which would take over that the original is read-only.
        io::copy(&mut File::open(&input.path)?, &mut File::create(target)?).map(|_| ())
    };
    refuse_unfinished(&input.path)?;
    copied().map_err(|error| format!("the database cannot be copied: {error}"))?;
    refuse_unfinished(&input.path)?;
    change(target, &pairs, &cameras, input).map_err(|problem| match problem.column {
        place if place.is_empty() => format!("the database {}", problem.description),
        place => format!("the database: {place}: {}", problem.description),
    })
}

/// Model and parameters of each camera that has one calibration of grade METRIC or WEAK, by the database's id.
fn cameras(solution: &Solution, input: &LabelledInput) -> BTreeMap<u32, (&'static str, Vec<f64>)> {
    // `None`: its views have focal lengths of their own.
    let mut found: BTreeMap<u32, Option<(&'static str, Vec<f64>)>> = BTreeMap::new();
    for (view, result) in solution.views.iter().enumerate().filter(|(_, view)| view.rotation.is_some()) {
        let calibration = solution.calibration_of(result.camera_group);
        let (Some(of_group), Some(raw)) = (calibration, input.raw.views.get(view)) else { continue };
        if !matches!(of_group.grade.or(solution.grade), Some(Grade::Metric | Grade::Weak)) {
            continue;
        }
        let own = Calibration { focal_px: result.focal_px.unwrap_or(of_group.focal_px), ..*of_group };
        let model = input.colmap_images.get(view).and_then(|image| image.camera_model);
        let parameters = Some(intrinsics::parameters(&own, model));
        let entry = found.entry(raw.camera_group).or_insert_with(|| parameters.clone());
        if *entry != parameters {
            *entry = None;
        }
    }
    found.into_iter().filter_map(|(id, parameters)| Some((id, parameters?))).collect()
}

fn change(
    path: &Path,
    pairs: &[Pair],
    cameras: &BTreeMap<u32, (&'static str, Vec<f64>)>,
    input: &LabelledInput,
) -> Result<(), Problem> {
    let mut connection = open(path).map_err(failed)?;
    refuse_others(&connection, input)?;
    let verified = known_pairs(&connection)?;
    let insert = Insert::into(&connection)?;
    let transaction = connection.transaction().map_err(failed)?;
    for (id, (name, parameters)) in cameras {
        // Every name that `parameters` gives is one of COLMAP's.
        let Some(model) = Model::of_name(name) else { continue };
        let query = "UPDATE cameras SET model = ?, params = ?, prior_focal_length = 1 WHERE camera_id = ?";
        transaction.execute(query, params![model.id, blob(parameters), id]).map_err(failed)?;
    }
    transaction.execute("DELETE FROM two_view_geometries", []).map_err(failed)?;
    let mut left = verified;
    for pair in pairs {
        let id = pair_id(pair.images);
        left.remove(&id);
        insert.run(&transaction, id, Some(pair)).map_err(failed)?;
    }
    for id in left {
        insert.run(&transaction, id, None).map_err(failed)?;
    }
    transaction.commit().map_err(failed)?;
    connection.close().map_err(|(_, error)| failed(error))
}

/// Opens the copy: alone with the file, which has no name yet and is synced as a whole when it is done.
fn open(path: &Path) -> rusqlite::Result<Connection> {
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = Connection::open_with_flags(path, flags)?;
    distrust(&connection)?;
    for (name, value) in
        [("locking_mode", "EXCLUSIVE"), ("journal_mode", "DELETE"), ("synchronous", "OFF"), ("foreign_keys", "OFF")]
    {
        connection.pragma_update(None, name, value)?;
    }
    Ok(connection)
}

fn failed(error: rusqlite::Error) -> Problem {
    Problem::of_file(format!("cannot be changed: {}", rows::cause(error)))
}

/// COLMAP's number of a pair.
fn pair_id([first, second]: [u32; 2]) -> i64 {
    i64::from(first) * MAX_IMAGES as i64 + i64::from(second)
}

/// Refuses a database that is not the one that was read, and one whose triggers would run at every change.
fn refuse_others(connection: &Connection, input: &LabelledInput) -> Result<(), Problem> {
    let tables = rows::tables(connection)?;
    if !["cameras", "images", "keypoints", "two_view_geometries"].iter().all(|table| tables.contains(*table)) {
        return Err(Problem::of_file("has no table `two_view_geometries`, or has another in its place"));
    }
    let mut triggers = 0;
    let query = "SELECT COUNT(*) AS count FROM sqlite_master WHERE type = 'trigger'";
    for_each_row(connection, query, |row| {
        triggers = rows::integer(row, "sqlite_master", "count", 0)?;
        Ok(())
    })?;
    if triggers > 0u64 {
        return Err(Problem::of_file("has triggers, which COLMAP's have not: it is not changed"));
    }
    let mut counts: BTreeMap<u32, u64> = BTreeMap::new();
    let query = "SELECT image_id, rows FROM keypoints";
    for_each_row(connection, query, |row| {
        let id = rows::integer(row, "keypoints", "image_id", 0)?;
        counts.insert(id, rows::integer(row, "keypoints", "rows", id.into())?);
        Ok(())
    })?;
    let is_same = |count: u64, id: u32| counts.get(&id).copied().unwrap_or(0) == count;
    if !input.colmap_images.iter().all(|image| is_same(image.keypoints.len() as u64, image.id)) {
        return Err(Problem::of_file("was changed since it was read"));
    }
    Ok(())
}

/// Numbers of the pairs that were verified or matched: those without a match that is kept get an empty geometry, as
/// COLMAP gives them, so that it does not verify them again.
fn known_pairs(connection: &Connection) -> Result<BTreeSet<i64>, Problem> {
    let mut pairs = BTreeSet::new();
    let tables = rows::tables(connection)?;
    for table in ["two_view_geometries", "matches"] {
        if tables.contains(table) {
            for_each_row(connection, &format!("SELECT pair_id FROM {table}"), |row| {
                pairs.insert(rows::integer(row, table, "pair_id", 0)?);
                Ok(())
            })?;
        }
    }
    Ok(pairs)
}

/// How geometries are inserted; databases of older versions have fewer columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Insert {
    Matches,
    Matrices,
    Poses,
}

impl Insert {
    fn into(connection: &Connection) -> Result<Self, Problem> {
        let columns = rows::names(connection, "SELECT name FROM pragma_table_info('two_view_geometries')")?;
        let has = |names: &[&str]| names.iter().all(|name| columns.contains(*name));
        Ok(match () {
            () if has(&["F", "E", "H", "qvec", "tvec"]) => Insert::Poses,
            () if has(&["F", "E", "H"]) => Insert::Matrices,
            () => Insert::Matches,
        })
    }

    fn statement(self) -> &'static str {
        match self {
            Insert::Matches => {
                "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config) VALUES (?, ?, 2, ?, ?)"
            }
            Insert::Matrices => {
                "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config, F, E, H)
                 VALUES (?, ?, 2, ?, ?, ?, ?, ?)"
            }
            Insert::Poses => {
                "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config, F, E, H, qvec, tvec)
                 VALUES (?, ?, 2, ?, ?, ?, ?, ?, ?, ?)"
            }
        }
    }

    /// Inserts a pair, an empty one where there is no geometry.
    fn run(self, connection: &Connection, id: i64, pair: Option<&Pair>) -> rusqlite::Result<()> {
        let matches = pair.map(|pair| pair.matches.as_slice()).unwrap_or_default();
        let data: Vec<u8> = matches.as_flattened().iter().flat_map(|keypoint| keypoint.to_le_bytes()).collect();
        let Columns { config, matrices, rotation, translation } = Columns::of(pair.map(|pair| &pair.geometry));
        let mut values: Vec<Value> = vec![id.into(), (matches.len() as i64).into(), data.into(), config.into()];
        if self != Insert::Matches {
            values.extend(matrices.map(Value::from));
        }
        if self == Insert::Poses {
            values.extend([rotation, translation].map(Value::from));
        }
        connection.prepare_cached(self.statement())?.execute(params_from_iter(values)).map(drop)
    }
}

/// What a geometry is in a row; NULL where it says nothing.
#[derive(Debug, Default)]
struct Columns {
    config: i64,
    /// F, E and H, row by row.
    matrices: [Option<Vec<u8>>; 3],
    /// `w x y z`
    rotation: Option<Vec<u8>>,
    translation: Option<Vec<u8>>,
}

impl Columns {
    fn of(geometry: Option<&Geometry>) -> Self {
        // nalgebra's own order is column by column.
        let matrix = |matrix: &nalgebra::Matrix3<f64>| Some(blob(matrix.transpose().as_slice()));
        let quaternion = |q: &nalgebra::UnitQuaternion<f64>| Some(blob(&[q.w, q.i, q.j, q.k]));
        match geometry {
            None => Self { config: UNDEFINED, ..Self::default() },
            Some(Geometry::Calibrated { fundamental, essential, rotation, translation }) => Self {
                config: CALIBRATED,
                matrices: [matrix(fundamental), matrix(essential), None],
                rotation: quaternion(rotation),
                translation: Some(blob(translation.as_slice())),
            },
            Some(Geometry::Panoramic { homography, rotation }) => Self {
                config: PANORAMIC,
                matrices: [None, None, matrix(homography)],
                rotation: rotation.as_ref().and_then(quaternion),
                translation: rotation.as_ref().map(|_| blob(&[0.0; 3])),
            },
            Some(Geometry::Uncalibrated { fundamental }) => {
                Self { config: UNCALIBRATED, matrices: [matrix(fundamental), None, None], ..Self::default() }
            }
        }
    }
}

fn blob(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

#[cfg(test)]
#[path = "write_database_tests.rs"]
mod tests;
