use std::fs;

use rusqlite::params;
use tempfile::TempDir;

use super::*;
use crate::formats::{Label, mutation};

/// COLMAP's own pair number.
const MAX_IMAGES: i64 = 2_147_483_647;

/// What is used of COLMAP's schema.
const SCHEMA: &str = "
    CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER NOT NULL, width INTEGER NOT NULL,
        height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL);
    CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL);
    CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
    CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
    CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL,
        data BLOB, config INTEGER NOT NULL);";

/// A database of three images, 1 `c.jpg`, 2 `b.jpg` and 5 `a.jpg`, with three keypoints each, and the statements
/// `more`.
fn database(more: &[&'static str]) -> (TempDir, PathBuf) {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = directory.path().join("database.db");
    let floats = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let doubles = |values: &[f64]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let connection = Connection::open(&path).expect("a database");
    connection.execute_batch(SCHEMA).expect("the schema");
    for (id, prior) in [(1, 1), (2, 0)] {
        let parameters = doubles(&[700.0, 320.0, 240.0, 0.0]);
        let insert = "INSERT INTO cameras VALUES (?, 2, 640, 480, ?, ?)";
        connection.execute(insert, params![id, parameters, prior]).expect("a camera");
    }
    for (id, name, camera, columns) in [(1, "c.jpg", 1, 2), (2, "b.jpg", 2, 4), (5, "a.jpg", 1, 6)] {
        connection.execute("INSERT INTO images VALUES (?, ?, ?)", params![id, name, camera]).expect("an image");
        let rows = (0..3).flat_map(|k| {
            let mut row = vec![0.0; columns];
            (row[0], row[1]) = (10.0 * id as f32 + k as f32 + 0.5, 100.5);
            row
        });
        let rows = floats(&rows.collect::<Vec<f32>>());
        let insert = "INSERT INTO keypoints VALUES (?, 3, ?, ?)";
        connection.execute(insert, params![id, columns as i64, rows]).expect("keypoints");
    }
    for statement in more {
        connection.execute_batch(statement).expect("a valid statement");
    }
    drop(connection);
    (directory, path)
}

/// Two image ids and the matches of their keypoints.
type Pair<'a> = (i64, i64, &'a [(u32, u32)]);

/// The same with matches in a table: `(first, second, [(keypoint, keypoint)])`.
fn with_matches(table: &str, pairs: &[Pair]) -> (TempDir, PathBuf) {
    let (directory, path) = database(&[]);
    add_matches(&path, table, pairs);
    (directory, path)
}

fn add_matches(path: &Path, table: &str, pairs: &[Pair]) {
    let connection = Connection::open(path).expect("a database");
    for (first, second, found) in pairs {
        let bytes: Vec<u8> = found.iter().flat_map(|&(a, b)| [a, b]).flat_map(u32::to_le_bytes).collect();
        let insert = match table {
            "matches" => "INSERT INTO matches VALUES (?, ?, 2, ?)",
            _ => "INSERT INTO two_view_geometries VALUES (?, ?, 2, ?, 3)",
        };
        let values = params![first * MAX_IMAGES + second, found.len() as i64, bytes];
        connection.execute(insert, values).expect("matches");
    }
}

fn refusal(path: &Path, matches: Option<Matches>) -> String {
    read(path, &Limits::default(), matches).expect_err("a bad database was accepted").to_string()
}

const CHAIN: [Pair; 2] = [(1, 2, &[(0, 1), (2, 2)]), (2, 5, &[(1, 0), (2, 1)])];

#[test]
fn matches_become_tracks_of_images_by_name_in_our_pixels() {
    let (_directory, path) = with_matches("two_view_geometries", &CHAIN);
    let input = read(&path, &Limits::default(), None).expect("a valid database");
    let names: Vec<String> = input.view_labels.iter().map(Label::to_string).collect();
    let ids: Vec<u32> = input.colmap_images.iter().map(|image| image.id).collect();
    assert_eq!((names, ids), (["a.jpg", "b.jpg", "c.jpg"].map(String::from).to_vec(), vec![5, 2, 1]));
    assert_eq!(input.track_labels, [Label::Number(0), Label::Number(1)]);
    assert_eq!((&input.raw.view[..], &input.raw.track[..]), (&[0, 1, 2, 0, 1, 2][..], &[0, 0, 0, 1, 1, 1][..]));
    assert_eq!(input.raw.x, [50.0, 21.0, 10.0, 51.0, 22.0, 12.0]);
    assert_eq!(input.raw.y, [100.0; 6]);
    let groups: Vec<u32> = input.raw.views.iter().map(|view| view.camera_group).collect();
    let priors: Vec<bool> = input.raw.views.iter().map(|view| view.focal_prior.is_some()).collect();
    assert_eq!((groups, priors), (vec![1, 2, 1], vec![true, false, true]));
    let prior = input.raw.views[0].focal_prior.expect("known");
    assert_eq!((prior.focal_px, prior.sigma_log), (700.0, crate::formats::colmap::cameras::PRIOR_SIGMA_LOG));
    assert_eq!(input.raw.views[1].size.map(|size| (size.width_px, size.height_px)), Some((640, 480)));
    assert_eq!(
        input.notes,
        [
            "joined 4 verified matches of 2 image pairs into 2 tracks; cut 0 matches, which would have put two keypoints \
             of one image into one track"
        ]
    );
}

/// What is sent to a server, which joins it again.
#[test]
fn keypoints_and_matches_give_the_same_input_as_the_tracks() {
    // A match that is listed twice counts once.
    let wrong: [Pair; 3] = [CHAIN[0], (1, 5, &[(0, 0), (2, 1)]), (2, 5, &[(1, 0), (2, 1), (1, 1), (2, 1)])];
    let (_directory, path) = with_matches("matches", &wrong);
    let labelled = read(&path, &Limits::default(), None).expect("valid");
    let matches = labelled.raw_matches().expect("matches");
    assert_eq!((matches.keypoint_counts.as_slice(), matches.pairs.len()), (&[3, 3, 3][..], 7));
    let joined = matches.into_input(&Limits::default(), "match_set").expect("valid");
    assert_eq!(joined.to_raw().sha256(), labelled.raw.sha256());
    let tracks = joined.joined_tracks().expect("joined");
    assert_eq!((tracks.joining.keypoint, tracks.joining.cut_match_count), (labelled.keypoints, 1));
}

#[test]
fn verified_matches_come_first_and_a_flag_asks_for_either() {
    let (_directory, path) = with_matches("matches", &CHAIN);
    let note = |matches| read(&path, &Limits::default(), matches).expect("valid").notes[0].clone();
    assert!(note(None).contains("4 raw matches"));
    assert!(refusal(&path, Some(Matches::Verified)).contains("--matches raw"));
    add_matches(&path, "two_view_geometries", &CHAIN[..1]);
    assert!(note(None).contains("2 verified matches"));
    assert!(note(Some(Matches::Raw)).contains("4 raw matches"));
    let (_directory, path) = database(&[]);
    assert!(refusal(&path, None).contains("holds no matches"));
}

#[test]
fn a_wrong_match_is_cut_and_counted() {
    let wrong: [Pair; 3] = [CHAIN[0], (1, 5, &[(0, 0), (2, 1)]), (2, 5, &[(1, 0), (2, 1), (1, 1)])];
    let (_directory, path) = with_matches("matches", &wrong);
    let input = read(&path, &Limits::default(), None).expect("valid");
    assert_eq!(input.raw.track, [0, 0, 0, 1, 1, 1]);
    assert!(input.notes[0].starts_with("joined 7 raw matches of ") && input.notes[0].contains("; cut 1 match, "));
}

#[test]
fn what_is_wrong_is_named_by_table_and_row() {
    let wrong = |statement: &'static str| {
        let (_directory, path) = database(&[statement]);
        add_matches(&path, "matches", &CHAIN[..1]);
        // The folder is another one each time.
        refusal(&path, None).split_once("database.db").map(|(_, words)| words.to_owned()).expect("the file's name")
    };
    assert_eq!(
        wrong("UPDATE keypoints SET rows = 4000000000000 WHERE image_id = 2"),
        ": table keypoints, row 2: data: has 48 bytes, 4000000000000 x 4 numbers of 4 are announced"
    );
    assert!(wrong("UPDATE keypoints SET rows = -1").contains("table keypoints, row 1: rows: -1 is out of range"));
    assert!(wrong("UPDATE keypoints SET cols = 1, rows = 6").contains("has 1 columns, at least 2"));
    assert!(wrong("UPDATE keypoints SET data = NULL").contains("has 0 bytes"));
    assert!(wrong("UPDATE keypoints SET data = 'text'").contains("table keypoints, row 1: data: "));
    assert!(wrong("DELETE FROM keypoints WHERE image_id = 2").contains("table matches, row 2147483649: match 0"));
    assert!(wrong("UPDATE images SET camera_id = 9").contains("table images, row 1: is of camera 9"));
    assert!(wrong("UPDATE images SET name = 'a' || char(10) WHERE image_id = 1").contains("control characters"));
    assert!(wrong("UPDATE images SET name = x'ff00' WHERE image_id = 1").contains("table images, row 1: name"));
    assert!(wrong("UPDATE cameras SET width = 0").contains("table cameras, row 1: size 0 x 480"));
    assert!(
        wrong("INSERT INTO matches VALUES (1, 1, 2, x'0000000000000000')").contains("row 1: is of the images 0 and 1")
    );
    assert!(wrong("INSERT INTO matches VALUES (-7, 1, 2, x'00')").contains("pair_id: -7 is out of range"));
    // Declared types are not read, so that a damaged one does no harm.
    let (_directory, path) = with_matches("matches", &CHAIN);
    let bytes = fs::read(&path).expect("a file");
    let place = bytes.windows(12).position(|part| part == b"rows INTEGER").expect("the schema") + 6;
    let mut odd = bytes.clone();
    odd[place] = 0xFF;
    fs::write(&path, odd).expect("written");
    assert_eq!(read(&path, &Limits::default(), None).map(|input| input.raw.x.len()), Ok(6));
    assert!(wrong("DROP TABLE cameras").ends_with("is no COLMAP database: it has no table `cameras`"));
    // An endless query in the clothes of a table.
    let endless = "DROP TABLE keypoints; CREATE VIEW keypoints AS WITH RECURSIVE n(image_id, rows, cols, data) AS
        (SELECT 1, 0, 2, NULL UNION ALL SELECT 1, 0, 2, NULL FROM n) SELECT * FROM n";
    assert!(wrong(endless).ends_with("it has no table `keypoints`"));
}

#[test]
fn files_that_are_no_finished_database_say_so() {
    let (directory, path) = with_matches("matches", &CHAIN);
    for journal in ["database.db-wal", "database.db-journal"] {
        fs::write(directory.path().join(journal), "x").expect("written");
        assert!(refusal(&path, None).contains(&format!("{journal} beside it says that a change")));
        fs::remove_file(directory.path().join(journal)).expect("removed");
    }
    let other = directory.path().join("other.db");
    fs::write(&other, "no database, but long enough to be taken for the header of one, if nobody looked: ".repeat(9))
        .expect("written");
    assert!(refusal(&other, None).contains("other.db: cannot be"), "{}", refusal(&other, None));
    let half = fs::read(&path).expect("a file");
    fs::write(&other, &half[..half.len() / 2]).expect("written");
    assert!(refusal(&other, None).contains("cannot be read as a COLMAP database"), "{}", refusal(&other, None));
    assert!(refusal(&directory.path().join("none.db"), None).contains("cannot be opened"));
    let tiny = Limits { max_observations: 3, ..Limits::default() };
    let refused = read(&path, &tiny, None).expect_err("above the limits").to_string();
    assert!(refused.contains("6 observations are above the limit of 3"), "{refused}");
    let tiny = Limits { max_views: 2, ..Limits::default() };
    assert!(
        read(&path, &tiny, None).expect_err("three images").to_string().contains("more images than the limit of 2")
    );
}

#[test]
fn reading_leaves_the_file_and_its_directory_as_they_were() {
    let (directory, path) = with_matches("matches", &CHAIN);
    let before = fs::read(&path).expect("a file");
    read(&path, &Limits::default(), None).expect("valid");
    assert_eq!(fs::read(&path).expect("a file"), before);
    assert_eq!(fs::read_dir(directory.path()).expect("a directory").count(), 1);
}

#[test]
fn no_mutation_makes_the_reader_panic() {
    let (directory, path) = with_matches("two_view_geometries", &CHAIN);
    let seeds = [fs::read(&path).expect("a file")];
    let mutated = directory.path().join("mutated.db");
    let accepted = mutation::survives(&seeds, |bytes| {
        fs::write(&mutated, bytes).expect("written");
        read(&mutated, &Limits::default(), None).map(|_| ()).map_err(|error| error.to_string())
    });
    // Most of a page is empty space.
    assert!(accepted > 0, "every mutated file was refused");
}
