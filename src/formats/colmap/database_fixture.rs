//! A COLMAP database of an input, for tests: what COLMAP would hold after matching.

use std::collections::BTreeMap;
use std::path::Path;

use rusqlite::{Connection, ToSql, params};

use super::ColmapImage;
use super::database::rows::MAX_IMAGES;
use crate::formats::{Format, Label, LabelledInput};

/// What is used of the schema of COLMAP 4.
const SCHEMA: &str = "
    CREATE TABLE rigs (rig_id INTEGER PRIMARY KEY, ref_sensor_id INTEGER NOT NULL, ref_sensor_type INTEGER NOT NULL);
    CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER NOT NULL, width INTEGER NOT NULL,
        height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL);
    CREATE TABLE frames (frame_id INTEGER PRIMARY KEY, rig_id INTEGER NOT NULL);
    CREATE TABLE frame_data (frame_id INTEGER NOT NULL, data_id INTEGER NOT NULL, sensor_id INTEGER NOT NULL,
        sensor_type INTEGER NOT NULL);
    CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL);
    CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
    CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
    CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL,
        data BLOB, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);";

/// What the frames' ids are beyond those of their images, and the rigs' beyond those of their cameras.
const FRAME_OFFSET: u32 = 100;

/// Names and ids as a database has them: images descend where views ascend, every observation is a keypoint, and each
/// has another before it that nothing matches.
pub(crate) fn dress(input: &mut LabelledInput) {
    let views = input.raw.views.len();
    input.view_labels = (0..views).map(|view| Label::Name(format!("image {view}.jpg").into())).collect();
    input.raw.views.iter_mut().for_each(|view| view.camera_group = 4);
    let mut images: Vec<ColmapImage> =
        (0..views as u32).map(|view| ColmapImage { id: 2 * (views as u32 - view), ..ColmapImage::default() }).collect();
    input.keypoints.clear();
    for k in 0..input.raw.x.len() {
        let keypoints = &mut images[input.raw.view[k] as usize].keypoints;
        let at = [input.raw.x[k] as f32 + 0.5, input.raw.y[k] as f32 + 0.5];
        (input.raw.x[k], input.raw.y[k]) = (f64::from(at[0]) - 0.5, f64::from(at[1]) - 0.5);
        keypoints.push([7.25, keypoints.len() as f32]);
        input.keypoints.push(keypoints.len() as u32);
        keypoints.push(at);
    }
    input.colmap_images = images;
    input.format = Some(Format::ColmapDatabase);
}

/// Writes the database of an input that was dressed. Of every track each observation is matched with the next one.
pub(crate) fn write(path: &Path, input: &LabelledInput, more: &'static str) {
    let blob =
        |values: &[[f32; 2]]| -> Vec<u8> { values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect() };
    let connection = Connection::open(path).expect("a database");
    connection.execute_batch(SCHEMA).expect("the schema");
    let run = |query: &str, values: &[&dyn ToSql]| {
        connection.execute(query, values).expect("a row");
    };
    let size = input.raw.views[0].size.expect("a size");
    let parameters: Vec<u8> = [700.0f64, 320.0, 240.0, 0.0].iter().flat_map(|value| value.to_le_bytes()).collect();
    run("INSERT INTO cameras VALUES (4, 2, ?, ?, ?, 0)", params![size.width_px, size.height_px, parameters]);
    run("INSERT INTO rigs VALUES (?, 4, 0)", params![4 + FRAME_OFFSET]);
    for (image, label) in input.colmap_images.iter().zip(&input.view_labels) {
        let (id, frame) = (image.id, image.id + FRAME_OFFSET);
        run("INSERT INTO images VALUES (?, ?, 4)", params![id, label.to_string()]);
        run("INSERT INTO frames VALUES (?, ?)", params![frame, 4 + FRAME_OFFSET]);
        run("INSERT INTO frame_data VALUES (?, ?, 4, 0)", params![frame, id]);
        let keypoints = &image.keypoints;
        run("INSERT INTO keypoints VALUES (?, ?, 2, ?)", params![id, keypoints.len() as i64, blob(keypoints)]);
    }
    for ([first, second], matches) in matches(input) {
        let data: Vec<u8> = matches.as_flattened().iter().flat_map(|index| index.to_le_bytes()).collect();
        let pair_id = i64::from(first) * MAX_IMAGES as i64 + i64::from(second);
        run("INSERT INTO matches VALUES (?, ?, 2, ?)", params![pair_id, matches.len() as i64, data]);
    }
    connection.execute_batch(more).expect("valid statements");
}

/// By ids of the images, ascending.
fn matches(input: &LabelledInput) -> BTreeMap<[u32; 2], Vec<[u32; 2]>> {
    let mut tracks: BTreeMap<u32, Vec<(u32, u32)>> = BTreeMap::new();
    for k in 0..input.raw.x.len() {
        let id = input.colmap_images[input.raw.view[k] as usize].id;
        tracks.entry(input.raw.track[k]).or_default().push((id, input.keypoints[k]));
    }
    let mut matches: BTreeMap<[u32; 2], Vec<[u32; 2]>> = BTreeMap::new();
    for mut track in tracks.into_values() {
        track.sort_unstable();
        for pair in track.windows(2) {
            matches.entry([pair[0].0, pair[1].0]).or_default().push([pair[0].1, pair[1].1]);
        }
    }
    matches
}
