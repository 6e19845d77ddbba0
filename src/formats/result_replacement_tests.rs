use std::fs;

use super::tests::contents;
use super::*;
use crate::formats::fixture;
use crate::formats::manifest::Manifest;
use crate::formats::windows::{self, Table};

#[test]
fn a_second_result_replaces_the_first_and_leaves_no_temporary_files() {
    let (input, mut solution) = fixture::solved();
    let directory = tempfile::tempdir().expect("a temporary directory");
    write(directory.path(), &solution, Some(&input), &[]).expect("written");
    solution.iterations = 12_345;
    write(directory.path(), &solution, Some(&input), &[]).expect("written");
    let files = contents(directory.path());
    assert_eq!(files.len(), 6);
    assert!(files[RESULT].contains("12345"));
}

#[test]
fn what_cannot_be_written_is_named() {
    let (input, solution) = fixture::solved();
    let directory = tempfile::tempdir().expect("a temporary directory");
    let file = directory.path().join("file");
    fs::write(&file, "x").expect("written");
    let error = write(&file, &solution, Some(&input), &[]).expect_err("a file stands there");
    assert!(error.to_string().contains("cannot create the directory"), "{error}");
    fs::create_dir_all(directory.path().join(TRACKS)).expect("created");
    let error = write(directory.path(), &solution, Some(&input), &[]).expect_err("a directory stands there");
    assert!(error.to_string().contains(TRACKS), "{error}");
}

#[test]
fn what_a_former_run_alone_made_goes_and_what_is_the_callers_stays() {
    let (input, solution) = fixture::solved();
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    let names = || contents(directory).into_keys().collect::<Vec<_>>();
    write(directory, &solution, Some(&input), &[]).expect("written");
    // The same without the input has no table of the observations.
    write(directory, &solution, None, &[]).expect("written");
    assert_eq!(names(), [CAMERAS, POINTS, REPORT, RESULT, TRACKS]);
    // Windows have other files, and a result replaces those.
    let windows = || {
        let mut draft = Draft::new(directory, None).expect("created");
        let table = Table::new(5, 5, 5, Vec::new());
        draft.add(windows::CSV, table.csv().as_bytes()).expect("written");
        draft.publish(windows::JSON, pretty(&table).expect("JSON").as_bytes()).expect("written");
    };
    windows();
    assert_eq!(names(), [windows::CSV, windows::JSON]);
    write(directory, &solution, Some(&input), &[]).expect("written");
    assert_eq!(names(), [CAMERAS, OBSERVATIONS, POINTS, REPORT, RESULT, TRACKS]);
    // The same names with other contents are a caller's.
    for name in names() {
        fs::write(directory.join(name), "view,track,x,y\n").expect("written");
    }
    windows();
    assert_eq!(names().len(), 8);
}

#[test]
fn a_run_that_cannot_end_leaves_the_former_one_whole() {
    let (input, solution) = fixture::solved();
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    write(directory, &solution, Some(&input), &[]).expect("written");
    let before = contents(directory);
    fs::create_dir_all(directory.join("opensfm/reconstruction.json")).expect("created");
    write(directory, &solution, None, &[]).expect("this one writes nothing there");
    write(directory, &solution, Some(&input), &[]).expect("written");
    let error = write(directory, &solution, Some(&input), &[Export::OpenSfm]).expect_err("a directory stands there");
    assert!(error.to_string().contains("reconstruction.json"), "{error}");
    fs::remove_dir_all(directory.join("opensfm")).expect("removed");
    assert_eq!(contents(directory), before);
    let hidden =
        |entry: io::Result<fs::DirEntry>| entry.expect("an entry").file_name().to_string_lossy().starts_with('.');
    assert!(!fs::read_dir(directory).expect("a directory").any(hidden), "temporary files are left");
}

/// What a killed run leaves is listed, and the next one takes it away.
#[test]
fn what_a_broken_run_left_goes_with_the_next() {
    let (input, solution) = fixture::solved_in_two_parts();
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    // Killed before the last name: everything else is there.
    write(directory, &solution, Some(&input), &[Export::Colmap]).expect("written");
    fs::remove_file(directory.join(RESULT)).expect("removed");
    assert!(directory.join("points-part-1.ply").is_file() && directory.join("colmap/1/cameras.bin").is_file());
    write(directory, &fixture::solved().1, Some(&input), &[]).expect("written");
    assert_eq!(
        contents(directory).into_keys().collect::<Vec<_>>(),
        [CAMERAS, OBSERVATIONS, POINTS, REPORT, RESULT, TRACKS]
    );
    let listed = Manifest::read(directory);
    assert_eq!((listed.files.len(), listed.last.as_str()), (6, RESULT));
    assert!(listed.files.iter().all(|file| file.stands(directory)));
}

#[test]
fn the_input_is_not_replaced() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let (inside, beside) = (directory.path().join(OBSERVATIONS), directory.path().join("tracks-of-mine.csv"));
    fs::write(&inside, "view,track,x,y\n").expect("written");
    fs::write(&beside, "view,track,x,y\n").expect("written");
    fs::create_dir(directory.path().join("colmap")).expect("created");
    let model = directory.path().join("colmap");
    assert_eq!(replaced(directory.path(), &[], &inside), Some(inside.clone()));
    assert_eq!(replaced(directory.path(), &Export::ALL, &beside), None);
    assert_eq!(replaced(directory.path(), &[], &model), None);
    assert_eq!(replaced(directory.path(), &[Export::Colmap], &model), Some(model.clone()));
    assert_eq!(replaced(&directory.path().join("new"), &Export::ALL, &inside), None);
    let database = directory.path().join("colmap-db/database.db");
    fs::create_dir_all(directory.path().join("colmap-db")).expect("created");
    fs::write(&database, "x").expect("written");
    assert_eq!(replaced(directory.path(), &Export::ALL, &database), Some(database.clone()));
    assert_eq!(replaced(directory.path(), &[Export::Colmap], &database), None);
}
