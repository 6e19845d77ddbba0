use std::fs;
use std::path::PathBuf;

use rusqlite::types::FromSql;
use tempfile::TempDir;

use super::super::database_fixture::{self, dress};
use super::super::{database, model, write as write_model, write_frames};
use super::*;
use crate::domain::Limits;
use crate::formats::metric::Model as MetricModel;
use crate::formats::source::Matches;
use crate::formats::{Label, fixture};

/// A database of the solved scene of the fixture and what was read of it, the result in the order of that.
struct Case {
    directory: TempDir,
    input: LabelledInput,
    solution: Solution,
}

impl Case {
    fn of((mut input, mut solution): (LabelledInput, Solution), more: &'static str) -> Self {
        let directory = tempfile::tempdir().expect("a temporary directory");
        dress(&mut input);
        let path = directory.path().join("database.db");
        database_fixture::write(&path, &input, more);
        let read = database::read(&path, &Limits::default(), None).expect("a valid database");
        // Tracks and observations come in another order.
        let place = |k: usize| {
            let same = |j: &usize| input.raw.view[*j] == read.raw.view[k] && input.keypoints[*j] == read.keypoints[k];
            (0..input.raw.x.len()).find(same).expect("the same observation")
        };
        let places: Vec<usize> = (0..read.raw.x.len()).map(place).collect();
        let (observations, tracks) = (solution.observations.clone(), solution.tracks.clone());
        for (k, &from) in places.iter().enumerate() {
            let (track, of) = (read.raw.track[k] as usize, input.raw.track[from] as usize);
            solution.observations.inlier[k] = observations.inlier[from];
            solution.observations.residual_px[k] = observations.residual_px[from];
            solution.tracks.inlier[track] = tracks.inlier[of];
            solution.tracks.weight[track] = tracks.weight[of];
            solution.tracks.point[track] = tracks.point[of];
        }
        solution.views.iter_mut().for_each(|view| view.camera_group = 4);
        solution.calibrations.iter_mut().for_each(|calibration| calibration.camera_group = 4);
        Self { directory, input: LabelledInput { format: input.format, ..read }, solution }
    }

    fn copy(&self) -> PathBuf {
        self.directory.path().join("copy.db")
    }

    fn write(&self) -> Result<(), String> {
        write(&self.copy(), &self.solution, &self.input)
    }
}

/// The first column of a query's rows.
fn column<T: FromSql>(path: &Path, query: &str) -> Vec<T> {
    let connection = Connection::open(path).expect("a database");
    let mut statement = connection.prepare(query).expect("a valid query");
    statement.query_map([], |row| row.get(0)).and_then(Iterator::collect).expect("rows")
}

/// The same of bytes; NULL is none.
fn rows(path: &Path, query: &str) -> Vec<Vec<u8>> {
    column::<Option<Vec<u8>>>(path, query).into_iter().map(Option::unwrap_or_default).collect()
}

fn numbers(path: &Path, query: &str) -> Vec<i64> {
    column(path, query)
}

fn doubles(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|value| f64::from_le_bytes(*value)).collect()
}

#[test]
fn the_right_tracks_come_back_as_verified_matches_and_the_cameras_as_known() {
    let case = Case::of(fixture::solved(), "");
    let original = fs::read(&case.input.path).expect("a file");
    case.write().expect("written");
    assert_eq!(fs::read(&case.input.path).expect("a file"), original);
    assert_eq!(fs::read_dir(case.directory.path()).expect("a directory").count(), 2, "no journal");
    let again = database::read(&case.copy(), &Limits::default(), Some(Matches::Verified)).expect("valid");
    let seen = |input: &LabelledInput, keep: &dyn Fn(usize) -> bool| {
        let mut seen: Vec<(u32, u32)> =
            (0..input.raw.x.len()).filter(|&k| keep(k)).map(|k| (input.raw.view[k], input.keypoints[k])).collect();
        seen.sort_unstable();
        seen
    };
    assert_eq!(seen(&again, &|_| true), seen(&case.input, &|k| case.solution.observations.inlier[k]));
    assert_eq!(again.raw.track_count, case.solution.inlier_track_count());
    assert!(again.notes[0].contains("; cut 0 matches, "), "{:?}", again.notes);
    let focal_px = case.solution.calibrations[0].focal_px;
    assert!(again.raw.views.iter().all(|view| view.focal_prior.is_some_and(|prior| prior.focal_px == focal_px)));
    // k1 goes into the model that the camera had.
    assert_eq!(numbers(&case.copy(), "SELECT model FROM cameras"), [2]);
    let [cx, cy] = case.solution.calibrations[0].principal_point_px;
    let parameters = doubles(&rows(&case.copy(), "SELECT params FROM cameras")[0]);
    assert_eq!(parameters, [focal_px, cx + 0.5, cy + 0.5, -0.02]);
    for query in ["SELECT data FROM keypoints", "SELECT data FROM matches", "SELECT CAST(name AS BLOB) FROM images"] {
        assert_eq!(rows(&case.copy(), query), rows(&case.input.path, query), "{query}");
    }
    let configs = numbers(&case.copy(), "SELECT config FROM two_view_geometries");
    assert_eq!(configs, [CALIBRATED; 10]);
    let fundamentals = rows(&case.copy(), "SELECT F FROM two_view_geometries ORDER BY pair_id");
    let wanted = two_view::pairs(&case.solution, &case.input);
    let of_first = wanted.iter().min_by_key(|pair| pair.images).map(|pair| &pair.geometry).expect("a pair");
    let Geometry::Calibrated { fundamental, .. } = of_first else { panic!("{of_first:?}") };
    // Row by row.
    assert_eq!(doubles(&fundamentals[0])[1], fundamental[(0, 1)]);
}

#[test]
fn a_projective_result_verifies_matches_and_leaves_the_cameras() {
    let case = Case::of(fixture::projective_only(), "");
    case.write().expect("written");
    assert_eq!(numbers(&case.copy(), "SELECT config FROM two_view_geometries"), [UNCALIBRATED; 10]);
    assert_eq!(numbers(&case.copy(), "SELECT prior_focal_length FROM cameras"), [0]);
    let parameters = "SELECT params FROM cameras";
    assert_eq!(rows(&case.copy(), parameters), rows(&case.input.path, parameters));
}

#[test]
fn a_camera_whose_views_have_their_own_focal_lengths_stays_as_it_is() {
    let mut case = Case::of(fixture::solved(), "");
    case.solution.views.iter_mut().enumerate().for_each(|(view, of)| of.focal_px = Some(800.0 + view as f64));
    case.write().expect("written");
    assert_eq!(numbers(&case.copy(), "SELECT prior_focal_length FROM cameras"), [0]);
    assert_eq!(numbers(&case.copy(), "SELECT config FROM two_view_geometries"), [CALIBRATED; 10]);
}

#[test]
fn pairs_without_a_right_match_are_empty_rather_than_verified_again() {
    let mut case = Case::of(
        fixture::solved(),
        "INSERT INTO two_view_geometries VALUES (1, 0, 0, NULL, 1, NULL, NULL, NULL, NULL, NULL)",
    );
    case.solution.views[0] = fixture::left_out(crate::domain::LeftOut::NoObservations);
    for k in (0..case.input.raw.x.len()).filter(|&k| case.input.raw.view[k] == 0) {
        case.solution.observations.inlier[k] = false;
    }
    case.write().expect("written");
    // Six pairs of four images, the pair of the first image with its neighbour that was matched, and that of before.
    assert_eq!(numbers(&case.copy(), "SELECT COUNT(*) FROM two_view_geometries WHERE config = 2"), [6]);
    assert_eq!(numbers(&case.copy(), "SELECT COUNT(*) FROM two_view_geometries WHERE rows = 0 AND config = 0"), [2]);
}

#[test]
fn a_database_that_cannot_be_changed_says_why() {
    let trigger = "CREATE TRIGGER t AFTER DELETE ON two_view_geometries BEGIN DELETE FROM images; END";
    let refused = Case::of(fixture::solved(), trigger).write().expect_err("a trigger");
    assert!(refused.contains("has triggers"), "{refused}");
    let case = Case::of(fixture::solved(), "");
    let statement = "UPDATE keypoints SET rows = 1, data = x'0000000000000000' WHERE image_id = 2";
    Connection::open(&case.input.path).and_then(|database| database.execute_batch(statement)).expect("changed");
    let refused = case.write().expect_err("another database");
    assert!(refused.contains("was changed since it was read"), "{refused}");
    fs::write(&case.input.path, "none").expect("written");
    assert!(case.write().expect_err("none").starts_with("the database cannot be"), "{:?}", case.write());
    fs::remove_file(&case.input.path).expect("removed");
    assert!(case.write().expect_err("nothing").starts_with("the database cannot be copied"));
}

#[test]
fn older_schemas_and_read_only_files_are_copied_too() {
    let older = "DROP TABLE two_view_geometries; CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY,
        rows INTEGER, cols INTEGER, data BLOB, config INTEGER)";
    let case = Case::of(fixture::solved(), older);
    let mut permissions = fs::metadata(&case.input.path).expect("a file").permissions();
    permissions.set_readonly(true);
    fs::set_permissions(&case.input.path, permissions).expect("read-only");
    case.write().expect("written");
    let again = database::read(&case.copy(), &Limits::default(), Some(Matches::Verified)).expect("valid");
    assert_eq!(again.raw.track_count, case.solution.inlier_track_count());
}

#[test]
fn rigs_of_several_cameras_are_told_and_not_written() {
    let case = Case::of(fixture::solved(), "UPDATE frame_data SET frame_id = 102 WHERE frame_id = 104");
    assert_eq!(case.input.notes.len(), 2, "{:?}", case.input.notes);
    assert!(case.input.notes[1].starts_with("frames of several images"), "{:?}", case.input.notes);
    let exported = MetricModel::of_parts(&case.solution, &case.input).expect("metric").remove(0);
    assert_eq!(write_frames::text(&exported), None);
    assert_eq!(Case::of(fixture::solved(), "").input.notes.len(), 1);
}

/// The model of a database has its keypoints, under their indices, and its ids.
#[test]
fn a_model_holds_every_keypoint_of_the_database_under_its_ids() {
    let case = Case::of(fixture::solved(), "");
    let exported = MetricModel::of_parts(&case.solution, &case.input).expect("metric").remove(0);
    for (image, view) in exported.images.iter().zip(&case.input.colmap_images) {
        assert_eq!((image.id, image.keypoints.len()), (view.id, view.keypoints.len()));
        for (keypoint, at) in image.keypoints.iter().zip(&view.keypoints) {
            assert_eq!([keypoint.x + 0.5, keypoint.y + 0.5], at.map(f64::from));
        }
    }
    for (position, point) in exported.points.iter().enumerate() {
        for &(image, keypoint) in &point.seen {
            // The others were matched with nothing.
            assert_eq!(keypoint % 2, 1);
            assert_eq!(exported.images[image].keypoints[keypoint].point, Some(position));
        }
    }
    let [cameras, images, _] = write_model::text(&exported);
    assert!(cameras.lines().nth(1).is_some_and(|line| line.starts_with("4 SIMPLE_RADIAL ")), "{cameras}");
    let [rigs, frames] = write_frames::text(&exported).expect("frames of their own");
    assert_eq!(rigs.lines().nth(1), Some("104 1 CAMERA 4"));
    let first = frames.lines().nth(1).expect("a frame");
    assert!(first.starts_with("110 104 ") && first.ends_with(" 1 CAMERA 4 10"), "{first}");
    let [rigs, frames] = write_frames::binary(&exported).expect("frames of their own");
    assert_eq!((rigs.len(), frames.len()), (8 + 16, 8 + 5 * (8 + 56 + 4 + 16)));
    let directory = case.directory.path();
    fs::write(directory.join("cameras.txt"), cameras).expect("written");
    fs::write(directory.join("images.txt"), images).expect("written");
    let again = model::read(directory, &Limits::default()).expect("our own reader reads it");
    assert_eq!(again.view_labels, case.input.view_labels);
    let keypoints = |input: &LabelledInput| -> Vec<(u32, Vec<[f32; 2]>)> {
        input.colmap_images.iter().map(|image| (image.id, image.keypoints.clone())).collect()
    };
    assert_eq!(keypoints(&again), keypoints(&case.input));
    let label = |track: u32| again.track_labels[track as usize].clone();
    for k in 0..again.raw.x.len() {
        let same =
            |j: &usize| (case.input.raw.view[*j], case.input.keypoints[*j]) == (again.raw.view[k], again.keypoints[k]);
        let of = (0..case.input.raw.x.len()).find(same).expect("an observation");
        assert_eq!(label(again.raw.track[k]), Label::Number(u64::from(case.input.raw.track[of])));
    }
}
