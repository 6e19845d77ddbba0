use std::io::Cursor;

use super::*;
use crate::domain::Violation;
use crate::formats::mutation;

fn parsed(text: impl AsRef<[u8]>, limits: &Limits) -> Result<LabelledInput, Error> {
    let input = parse(Cursor::new(text.as_ref()), Path::new("dir/observations.csv"), limits, None)?;
    input.check(limits)?;
    Ok(input)
}

fn good(text: &str) -> LabelledInput {
    parsed(text, &Limits::default()).expect("a valid file was refused")
}

fn labels(numbers: &[u64]) -> Vec<Label> {
    numbers.iter().copied().map(Label::Number).collect()
}

/// Every sentence about a bad file.
fn bad(text: impl AsRef<[u8]>) -> Vec<String> {
    let error = parsed(text, &Limits::default()).expect_err("a bad file was accepted");
    error.to_string().lines().map(String::from).collect()
}

const GOOD: &str = "view,track,x,y\n7,40,1.5,2\n7,3,3,4\n9,3,5,6\n9,40,7,-8e0\n";

#[test]
fn maps_any_ids_to_dense_indices_and_keeps_labels_and_lines() {
    let input = good(GOOD);
    assert_eq!((input.view_labels, input.track_labels), (labels(&[7, 9]), labels(&[3, 40])));
    assert_eq!((input.raw.view, input.raw.track), (vec![0, 0, 1, 1], vec![1, 0, 0, 1]));
    assert_eq!((input.raw.x, input.raw.y), (vec![1.5, 3.0, 5.0, 7.0], vec![2.0, 4.0, 6.0, -8.0]));
    assert_eq!(input.lines, [2, 3, 4, 5]);
    assert!(input.raw.depth.is_empty());
}

#[test]
fn takes_what_other_programs_write() {
    let plain = good(GOOD).raw;
    let variants = [
        GOOD.replace('\n', "\r\n"),
        format!("\u{feff}{GOOD}"),
        format!("\n{}\n\n", GOOD.replace('\n', "\n\n")),
        GOOD.trim_end().to_string(),
        GOOD.replace("view,track,x,y", "\"View\", \"Track\", \"X\", \"Y\"").replace(',', " , "),
        "y,name,x,track,view\n2,a,1.5,40,7\n4,,3,3,7\n6,b,5,3,9\n-8,c,7,40,9\n".to_string(),
    ];
    for text in variants {
        let input = good(&text);
        assert_eq!(input.raw.x, plain.x, "{text:?}");
        assert_eq!((&input.raw.view, &input.raw.track), (&plain.view, &plain.track), "{text:?}");
    }
    let with_blanks = good(&GOOD.replace('\n', "\n\n"));
    assert_eq!(with_blanks.lines, [3, 5, 7, 9]);
    let largest = format!("view,track,x,y\n0,{},1,2\n1,{},1,2\n", u64::MAX, u64::MAX);
    assert_eq!(good(&largest).track_labels, labels(&[u64::MAX]));
}

#[test]
fn reads_depths() {
    let text = "view,track,x,y,depth\n0,0,1,2,3.5\n1,0,1,2,-4\n";
    assert_eq!(good(text).raw.depth, [3.5, -4.0]);
}

#[test]
fn reads_and_writes_what_is_known_of_the_noise() {
    let text = "view,track,x,y,depth,sigma\n0,0,1,2,3.5,0.5\n1,0,1,2,-4,2\n";
    assert_eq!(good(text).raw.sigma, [0.5, 2.0]);
    assert_eq!(csv(&good(text).raw), text);
    let alone = "view,track,x,y,sigma\n0,0,1,2,0.5\n1,0,1,2,2\n";
    assert_eq!(csv(&good(alone).raw), alone);
    let empty = bad(alone.replace("0.5", ""));
    assert!(empty[0].contains("line 2: sigma: is empty; give every observation one"), "{empty:?}");
    for wrong in ["0", "-1", "inf", "1e9"] {
        let problems = bad(alone.replace("0.5", wrong));
        assert!(problems[0].contains("line 2: sigma: "), "{wrong}: {problems:?}");
    }
}

#[test]
fn columns_that_are_not_read_are_told() {
    assert!(good(GOOD).notes.is_empty());
    let notes = good("view,track,x,y,depht,Name\n0,0,1,2,3.5,a\n1,0,1,2,-4,b\n").notes;
    assert_eq!(notes, ["2 columns not read: `depht`, `name`; those that are: view, track, x, y, depth, sigma"]);
    let many = good("a,b,c,view,track,x,y,d,e,f\n1,1,1,0,0,1,2,3,3,3\n1,1,1,1,0,1,2,3,3,3\n").notes;
    assert!(many[0].starts_with("6 columns not read: `a`, `b`, `c`, `d`, `e`, ...; "), "{many:?}");
}

#[test]
fn puts_the_size_on_every_view() {
    let size = ImageSize { width_px: 640, height_px: 480 };
    let input = parse(Cursor::new(GOOD), Path::new("o.csv"), &Limits::default(), Some(size)).expect("valid");
    assert!(input.raw.views.len() == 2 && input.raw.views.iter().all(|view| view.size == Some(size)));
}

#[test]
fn names_the_line_of_every_bad_value() {
    let line_4 = |row: &str| bad(format!("view,track,x,y\n0,0,1,2\n1,0,1,2\n{row}\n"));
    assert_eq!(line_4("0,1,NaN,2"), ["dir/observations.csv, line 4: x: NaN is not a finite number"]);
    assert_eq!(line_4("0,1,1,-inf"), ["dir/observations.csv, line 4: y: -inf is not a finite number"]);
    assert_eq!(line_4("0,1,abc,2"), ["dir/observations.csv, line 4: x: `abc` is not a number"]);
    assert_eq!(line_4("-1,1,1,2"), ["dir/observations.csv, line 4: view: `-1` is not a whole number >= 0"]);
    assert_eq!(line_4("0,1.5,1,2"), ["dir/observations.csv, line 4: track: `1.5` is not a whole number >= 0"]);
    assert_eq!(
        line_4("0,18446744073709551616,1,2"),
        ["dir/observations.csv, line 4: track: `18446744073709551616` is too large a number"]
    );
    assert_eq!(
        line_4("0,1,,2"),
        ["dir/observations.csv, line 4: x: is empty; leave out the line of a point that was not observed"]
    );
    assert_eq!(
        line_4("0,1,1"),
        ["dir/observations.csv, line 4: 3 fields where the header has 4; the file may be truncated"]
    );
    assert_eq!(line_4("0,1,1,2,3"), ["dir/observations.csv, line 4: 5 fields where the header has 4"]);
    assert_eq!(
        line_4("0,1,1,5,2,5"),
        ["dir/observations.csv, line 4: 6 fields where the header has 4; decimals are marked by a point, not a comma"]
    );
    assert_eq!(
        line_4("0,1,1e9,2"),
        ["dir/observations.csv, line 4: x: 1e9 px is beyond 1e7 px; coordinates are in pixels"]
    );
    assert_eq!(
        line_4("1,0,5,6"),
        ["dir/observations.csv, line 4: track: track 0 is observed a second time in view 1 (first on line 3)"]
    );
}

#[test]
fn a_blank_line_does_not_shift_the_lines_of_errors() {
    let text = "view,track,x,y\r\n\r\n0,0,1,2\r\n\r\n1,0,inf,2\r\n";
    assert_eq!(bad(text), ["dir/observations.csv, line 5: x: inf is not a finite number"]);
}

#[test]
fn bad_depths_are_named_too() {
    let with = |depth: &str| bad(format!("view,track,x,y,depth\n0,0,1,2,1\n1,0,1,2,{depth}\n"));
    assert!(with("0")[0].starts_with("dir/observations.csv, line 3: depth: 0.0 is not"), "{:?}", with("0"));
    assert!(with("1e300")[0].contains(": depth: 1e300 is not"), "{:?}", with("1e300"));
    assert!(with("")[0].starts_with("dir/observations.csv, line 3: depth: is empty"), "{:?}", with(""));
}

#[test]
fn files_that_are_no_table_are_called_what_they_are() {
    let starts = |bytes: &[u8], wanted: &str| {
        let sentences = bad(bytes);
        assert_eq!(sentences.len(), 1, "{sentences:?}");
        let sentence = &sentences[0];
        assert!(sentence.starts_with(&format!("dir/observations.csv{wanted}")), "{sentence}");
    };
    starts(b"", ": is empty");
    starts(b"\n\r\n", ": is empty");
    starts(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", ": is not a text file");
    starts(b"SQLite format 3\0\x10\0\x01\x01", ": is a COLMAP (SQLite) database, not");
    starts(b"\xFF\xFEv\0i\0", ": is UTF-16 text");
    starts(b"OPENSFM_TRACKS_VERSION_v2\n", ": is an OpenSfM tracks.csv, not");
    starts(b"a.jpg\t0\t1\t0.1\t0.2\n", ", line 1: columns are separated by tabs");
    starts(b"view;track;x;y\n", ", line 1: columns are separated by semicolons");
    starts(b"0,0,1.5,2\n", ", line 1: no header");
    starts(b"view,track,u,v\n0,0,1,2\n", ", line 1: the header `view,track,u,v` has no column `x`");
    starts(b"view,track,x_px,y_px,inlier\n0,0,1,2,1\n", ", line 1: this is a table that a solve wrote");
    starts(b"view,track,x,y,x\n", ", line 1: the header names the column `x` twice");
    starts(b"view,track,x,y\n", ": has a header but no observations");
    starts(&[b'7'; text::MAX_TABLE_LINE_BYTES + 1], ", line 1: longer than");
    starts(b"view,track,x,y\n0,0,1,2\n1,0,\xFF\xFF,2\n", ", line 3: is not text");
}

#[test]
fn one_view_or_no_overlap_is_said_of_the_file() {
    assert_eq!(
        bad("view,track,x,y\n4,0,1,2\n4,1,1,2\n"),
        ["dir/observations.csv: 1 view given; a reconstruction needs at least 3"]
    );
}

#[test]
fn the_count_is_bounded_while_reading() {
    let limits = Limits { max_observations: 3, ..Limits::default() };
    let error = parsed(GOOD, &limits).expect_err("four observations");
    assert_eq!(error.to_string(), "dir/observations.csv, line 5: more observations than the limit of 3");
    let limits = Limits { max_tracks: 1, ..Limits::default() };
    let error = parsed(GOOD, &limits).expect_err("two tracks");
    assert!(error.to_string().starts_with("dir/observations.csv: 2 tracks are above"), "{error}");
}

#[test]
fn lists_a_bounded_number_of_problems() {
    let text = format!("view,track,x,y\n{}", "0,0,?,2\n".repeat(1000));
    let error = parsed(text, &Limits::default()).expect_err("a thousand bad lines");
    assert_eq!((error.problems().len(), error.unlisted()), (3, 0));
    assert!(error.to_string().ends_with("line 4: x: `?` is not a number; and 997 more like this"), "{error}");
    let text = format!("view,track,x,y\n{}0,0,1\n", "0,0,?,2\n".repeat(1000));
    let told = bad(text);
    assert!(told.len() == 4 && told[3].contains("line 1002: 3 fields where"), "{told:?}");
}

#[test]
fn foreign_bytes_do_not_reach_the_terminal() {
    let sentence = &bad("view,track,x,y\n0,0,\x1b[31mred,2\n")[0];
    assert!(!sentence.contains('\x1b'), "{sentence:?}");
    let long = bad(format!("view,track,x,y\n0,0,{},2\n", "z".repeat(5000)));
    assert!(long[0].len() < 200, "{long:?}");
}

#[test]
fn files_on_disk() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = directory.path().join("observations.csv");
    let read =
        |path: &Path, limits: &Limits| text::open_table(path, limits).and_then(|file| read(file, path, limits, None));
    let refusal = |path: &Path, limits: &Limits| read(path, limits).expect_err("refused").to_string();
    let limits = Limits::default();
    assert!(refusal(&path, &limits).starts_with(&format!("{}: cannot be read: ", path.display())));
    std::fs::write(&path, GOOD).expect("written");
    assert_eq!(read(&path, &limits).expect("valid").lines.len(), 4);
    let tiny = Limits { max_observations: 0, ..limits.clone() };
    assert!(refusal(&path, &tiny).contains("more than the limit of 0 observations"));
    assert!(refusal(directory.path(), &limits).contains("is a directory"));
}

#[test]
fn violations_that_come_back_from_a_server_are_put_into_the_files_terms() {
    let input = good(GOOD);
    let sentence = |violation: Violation| input.explain_all(&[violation], 0).to_string();
    assert_eq!(sentence(Violation::at("track_set.xs", 2, "is odd")), "dir/observations.csv, line 4: x: is odd");
    assert_eq!(sentence(Violation::at("track_set.views", 1, "is odd")), "dir/observations.csv: view 9: is odd");
    assert_eq!(sentence(Violation::of("job.settings.alpha", "is odd")), "dir/observations.csv: alpha: is odd");
    assert_eq!(sentence(Violation::at("track_set.xs", 99, "is odd")), "dir/observations.csv: track_set.xs[99]: is odd");
}

#[test]
fn no_mutation_makes_the_reader_panic() {
    let seeds = [GOOD.as_bytes().to_vec(), b"view,track,x,y,depth\n0,0,1,2,3.5\n1,0,1,2,-4\n".to_vec()];
    let accepted = mutation::survives(&seeds, |bytes| {
        parsed(bytes, &Limits::default()).map(|_| ()).map_err(|error| error.to_string())
    });
    assert!(accepted > 0, "every mutated file was refused");
}
