use std::io::Cursor;

use super::*;
use crate::formats::mutation;

const SIZE: ImageSize = ImageSize { width_px: 640, height_px: 480 };
const VERSION_0: &str =
    "b.jpg\t10\t5\t0.25\t-0.125\t1\t2\t3\na.jpg\t10\t6\t0\t0\t1\t2\t3\na.jpg\t9\t7\t-0.5\t0.375\t1\t2\t3\n";

fn parsed(text: impl AsRef<[u8]>) -> Result<LabelledInput, Error> {
    read(Cursor::new(text.as_ref()), Path::new("dir/tracks.csv"), &Limits::default(), Some(SIZE))
}

fn bad(text: impl AsRef<[u8]>) -> String {
    parsed(text).expect_err("a bad file was accepted").to_string()
}

/// The same tracks as a later version writes them.
fn as_version(version: usize) -> String {
    let insert = |line: &str| {
        let mut fields: Vec<&str> = line.split('\t').collect();
        fields.insert(5, "0.004");
        if version == 2 {
            fields.extend(["-1", "7"]);
        }
        fields.join("\t")
    };
    let lines: Vec<String> = VERSION_0.lines().map(insert).collect();
    format!("OPENSFM_TRACKS_VERSION_v{version}\n{}\n", lines.join("\n"))
}

#[test]
fn every_version_gives_the_same_pixels_under_names_and_ids_in_order() {
    let variants = [VERSION_0.to_owned(), as_version(1), as_version(2), as_version(2).replace('\n', "\r\n")];
    for (number, text) in variants.into_iter().enumerate() {
        let input = parsed(text).expect("a valid file was refused");
        let names: Vec<String> = input.view_labels.iter().map(Label::to_string).collect();
        assert_eq!(names, ["a.jpg", "b.jpg"]);
        assert_eq!(input.track_labels, [Label::Number(9), Label::Number(10)]);
        assert_eq!((&input.raw.view[..], &input.raw.track[..]), (&[1, 0, 0][..], &[1, 1, 0][..]));
        // x = .25 * 640 - .5 + 320, y = -.125 * 640 - .5 + 240 (OpenSfM's denormalized_image_coordinates).
        assert_eq!(input.raw.x, [479.5, 319.5, -0.5], "version {number}");
        assert_eq!(input.raw.y, [159.5, 239.5, 479.5]);
        assert!(input.raw.views.iter().all(|view| view.size == Some(SIZE)));
        let header = u64::from(number > 0);
        assert_eq!(input.lines, [1 + header, 2 + header, 3 + header]);
        assert_eq!(input.keypoints, [5, 6, 7]);
    }
}

#[test]
fn ids_that_are_no_numbers_are_names() {
    let input = parsed(VERSION_0.replace("\t10\t", "\t0x\t")).expect("valid");
    assert_eq!(input.track_labels, [Label::Number(9), Label::Name("0x".into())]);
    let without_features = parsed(VERSION_0.replace("\t5\t", "\t-1\t")).expect("valid");
    assert!(without_features.keypoints.is_empty());
}

#[test]
fn what_is_wrong_is_named_by_line() {
    let second = |row: &str| bad(format!("a\t1\t0\t0\t0\t1\t2\t3\n{row}\nb\t1\t0\t0\t0\t1\t2\t3\n"));
    assert_eq!(second("b\t2\t0\tabc\t0\t1\t2\t3"), "dir/tracks.csv, line 2: x: `abc` is not a number");
    assert_eq!(second("b\t2\t0\tnan\t0\t1\t2\t3"), "dir/tracks.csv, line 2: x: NaN is not a finite number");
    assert_eq!(second("\t2\t0\t0\t0\t1\t2\t3"), "dir/tracks.csv, line 2: image: has no name");
    assert!(second("b\x1b[31m\t2\t0\t0\t0\t1\t2\t3").starts_with("dir/tracks.csv, line 2: image: the name \"b\\u{1b}"));
    assert!(
        second("b\t2\t0").ends_with("3 fields where this version has 8, separated by tabs; the file may be truncated")
    );
    let twice = second("a\t1\t9\t0.1\t0\t1\t2\t3");
    assert_eq!(twice, "dir/tracks.csv, line 2: track: track 1 is observed a second time in view a (first on line 1)");
    assert!(
        bad("OPENSFM_TRACKS_VERSION_v3\n").starts_with("dir/tracks.csv, line 1: `OPENSFM_TRACKS_VERSION_v3` is not")
    );
    assert_eq!(bad("OPENSFM_TRACKS_VERSION_v2\n"), "dir/tracks.csv: has no observations");
    assert_eq!(bad(b"\x89PNG\n"), "dir/tracks.csv: is not a text file");
    assert!(bad(b"a\t1\t0\t0\t0\t1\t2\t3\n\xff\n").contains("line 2: is not text"));
    // Three columns of version 2 are not the eight of version 0.
    assert!(bad(as_version(2).replace("_v2", "_v0")).contains("line 2: 11 fields"));
}

#[test]
fn no_mutation_makes_the_reader_panic() {
    let seeds = [VERSION_0.as_bytes().to_vec(), as_version(1).into_bytes(), as_version(2).into_bytes()];
    let limits = Limits { max_observations: 100, ..Limits::default() };
    let accepted = mutation::survives(&seeds, |bytes| {
        read(Cursor::new(bytes), Path::new("tracks.csv"), &limits, Some(SIZE))
            .map(|_| ())
            .map_err(|error| error.to_string())
    });
    // Many a digit may be another: were all refused, the mutations would test nothing but the first check.
    assert!(accepted > 0, "every mutated file was refused");
}

#[test]
fn every_image_has_the_size_and_the_camera_that_the_data_set_gives_it() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = directory.path().join("tracks.csv");
    std::fs::write(&path, VERSION_0).expect("written");
    let limits = Limits::default();
    let read = |size| read(text::open_table(&path, &limits)?, &path, &limits, size);
    let refused = read(None).expect_err("no size").to_string();
    assert!(
        refused.starts_with(&format!("{}, line 1: image: no size is known of `b.jpg`", path.display())),
        "{refused}"
    );
    assert_eq!(refused.lines().count(), 2, "once an image: {refused}");
    std::fs::create_dir(directory.path().join("exif")).expect("created");
    let exif = r#"{"width": 200, "height": 100, "camera": "wide"}"#;
    std::fs::write(directory.path().join("exif/b.jpg.exif"), exif).expect("written");
    let refused = read(None).expect_err("no size of a.jpg").to_string();
    assert!(
        refused.starts_with(&format!("{}, line 2: image: no size is known of `a.jpg`", path.display())),
        "{refused}"
    );
    let input = read(Some(SIZE)).expect("every size is known");
    let views: Vec<_> =
        input.raw.views.iter().map(|view| (view.size.map(|size| size.width_px), view.camera_group)).collect();
    assert_eq!(views, [(Some(640), 0), (Some(200), 1)]);
    // x = .25 * 200 - .5 + 100 in b.jpg; the others as before.
    assert_eq!(input.raw.x, [149.5, 319.5, -0.5]);
    assert!(input.notes[0].starts_with("1 of 2 image sizes were read from exif/; 640 x 480 px"), "{:?}", input.notes);
}
