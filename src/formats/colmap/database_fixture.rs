//! A COLMAP database of an input, for tests: what COLMAP would hold after matching.

use std::collections::BTreeMap;
use std::path::Path;

use sqlx::SqlitePool;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions};

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
    on(path, async |pool| {
        sqlx::raw_sql(SCHEMA).execute(pool).await.expect("the schema");
        let size = input.raw.views[0].size.expect("a size");
        let parameters: Vec<u8> = [700.0f64, 320.0, 240.0, 0.0].iter().flat_map(|value| value.to_le_bytes()).collect();
        let camera = sqlx::query("INSERT INTO cameras VALUES (4, 2, ?, ?, ?, 0)");
        let camera = camera.bind(i64::from(size.width_px)).bind(i64::from(size.height_px)).bind(parameters);
        camera.execute(pool).await.expect("a camera");
        let rig = sqlx::query("INSERT INTO rigs VALUES (?, 4, 0)").bind(i64::from(4 + FRAME_OFFSET));
        rig.execute(pool).await.expect("a rig");
        for (image, label) in input.colmap_images.iter().zip(&input.view_labels) {
            let (id, frame) = (i64::from(image.id), i64::from(image.id + FRAME_OFFSET));
            for query in [
                sqlx::query("INSERT INTO images VALUES (?, ?, 4)").bind(id).bind(label.to_string()),
                sqlx::query("INSERT INTO frames VALUES (?, ?)").bind(frame).bind(i64::from(4 + FRAME_OFFSET)),
                sqlx::query("INSERT INTO frame_data VALUES (?, ?, 4, 0)").bind(frame).bind(id),
                sqlx::query("INSERT INTO keypoints VALUES (?, ?, 2, ?)")
                    .bind(id)
                    .bind(image.keypoints.len() as i64)
                    .bind(blob(&image.keypoints)),
            ] {
                query.execute(pool).await.expect("a row");
            }
        }
        for ([first, second], matches) in matches(input) {
            let data: Vec<u8> = matches.as_flattened().iter().flat_map(|index| index.to_le_bytes()).collect();
            sqlx::query("INSERT INTO matches VALUES (?, ?, 2, ?)")
                .bind(i64::from(first) * MAX_IMAGES as i64 + i64::from(second))
                .bind(matches.len() as i64)
                .bind(data)
                .execute(pool)
                .await
                .expect("matches");
        }
        sqlx::raw_sql(more).execute(pool).await.expect("valid statements");
    });
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

/// Works on a database, which is created, and closes it.
pub(crate) fn on<T>(path: &Path, work: impl AsyncFnOnce(&SqlitePool) -> T) -> T {
    let options =
        SqliteConnectOptions::new().filename(path).create_if_missing(true).journal_mode(SqliteJournalMode::Delete);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    runtime.block_on(async {
        let pool = SqlitePoolOptions::new().max_connections(1).connect_with(options).await.expect("a database");
        let done = work(&pool).await;
        pool.close().await;
        done
    })
}
