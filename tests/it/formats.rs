//! Files of other programs, in and out through the command line.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

use crate::support::program::{Run, Serving, run};
use crate::support::python::{python, succeeds};

/// Side of a synthetic image.
const SIDE_PX: f64 = 1000.0;

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error} in {text}"))
}

/// Solves by geometry, which is quick; the answer is in `out`.
fn solve(input: &Path, out: &Path, more: &[&str]) -> Run {
    let fixed = ["solve", text(input), "--out", text(out), "--method", "geometry", "--json"];
    run(fixed.iter().chain(more))
}

/// A scene with 30 right tracks of 60 as OpenSfM would write it: names instead of numbers, coordinates in parts of the
/// image's side.
fn opensfm_tracks(directory: &Path) -> PathBuf {
    let scene = directory.join("scene");
    let made =
        run(["synth", "--views", "6", "--tracks", "60", "--outliers", "0.5", "--seed", "5", "--out", text(&scene)]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let table = fs::read_to_string(scene.join("observations.csv")).expect("the scene");
    let mut tracks = String::from("OPENSFM_TRACKS_VERSION_v2\n");
    for line in table.lines().skip(1) {
        let fields: Vec<f64> = line.split(',').map(|field| field.parse().expect("a number")).collect();
        let normalised = |px: f64| (px + 0.5 - SIDE_PX / 2.0) / SIDE_PX;
        let (x, y) = (normalised(fields[2]), normalised(fields[3]));
        let (view, track) = (fields[0], fields[1]);
        tracks.push_str(&format!("{view}, west.jpg\t{track}\t0\t{x}\t{y}\t0.01\t9\t9\t9\t-1\t-1\n"));
    }
    let path = directory.join("tracks.csv");
    fs::write(&path, tracks).expect("written");
    path
}

/// OpenSfM's tracks in, here and through a server; COLMAP's model out, and that model in again.
#[test]
fn opensfm_tracks_become_a_colmap_model_that_is_read_again() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let tracks = opensfm_tracks(directory.path());
    let nothing = solve(&tracks, &path("nothing"), &[]);
    assert_eq!(nothing.code, Some(65), "{nothing:?}");
    assert!(nothing.stderr.contains("--width and --height"), "{nothing:?}");

    let size = ["--width", "1000", "--height", "1000"];
    let refused = solve(&tracks, &path("refused"), &[&size[..], &["--export", "colmap,colmap-db"]].concat());
    assert_eq!(refused.code, Some(2), "{refused:?}");
    assert!(refused.stderr.contains("--export colmap-db: ") && refused.stderr.contains("no COLMAP database"));
    assert!(refused.stdout.is_empty() && !path("refused").exists(), "before it is solved: {refused:?}");
    let export = ["--export", "colmap,colmap-text", "--export", "opensfm,nerfstudio,bundler,bal"];
    let flags = [&size[..], &export[..]].concat();
    let solved = solve(&tracks, &path("local"), &flags);
    assert_eq!(solved.code, Some(0), "{solved:?}");
    assert_eq!(json(&solved.stdout)["inlier_tracks"], 30);
    assert!(!solved.stderr.contains("not exported"), "{solved:?}");
    for file in ["nerfstudio/transforms.json", "nerfstudio/points.ply", "bundler/bundle.out", "bal/problem.txt"] {
        assert!(path("local").join(file).is_file(), "{file}");
    }
    let observations = fs::read_to_string(path("local/observations.csv")).expect("observations.csv");
    assert!(observations.lines().any(|line| line.starts_with("\"0, west.jpg\",0,")), "{observations}");
    let cameras = json(&fs::read_to_string(path("local/cameras.json")).expect("cameras.json"));
    assert_eq!(cameras["views"][0]["view"], "0, west.jpg");
    let reconstruction =
        json(&fs::read_to_string(path("local/opensfm/reconstruction.json")).expect("a reconstruction"));
    assert_eq!(reconstruction[0]["points"].as_object().map(serde_json::Map::len), Some(30));

    let serving = Serving::start(&path("data"));
    let remote = solve(&tracks, &path("remote"), &[&flags[..], &["--server", &serving.grpc]].concat());
    assert_eq!(remote.code, Some(0), "{remote:?}");
    for file in ["observations.csv", "cameras.json", "opensfm/reconstruction.json", "colmap/points3D.bin"] {
        let content = |side: &str| fs::read(path(side).join(file)).expect("a file");
        assert!(content("local") == content("remote"), "{file} differs");
    }

    for model in ["colmap", "colmap-text"] {
        let again = solve(&path("local").join(model), &path("again"), &[]);
        assert_eq!(again.code, Some(0), "{again:?}");
        let result = json(&again.stdout);
        assert_eq!((&result["inlier_tracks"], &result["registered_views"]), (&30.into(), &6.into()), "{model}");
    }
}

/// COLMAP's own reader opens what is exported, and puts the points where they were observed.
#[test]
fn pycolmap_opens_the_exported_models() {
    let Some(python) = python("COLMAP's reader", "pycolmap") else { return };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let out = directory.path().join("out");
    let tracks = opensfm_tracks(directory.path());
    let flags = ["--width", "1000", "--height", "1000", "--export", "colmap,colmap-text"];
    let solved = solve(&tracks, &out, &flags);
    assert_eq!(solved.code, Some(0), "{solved:?}");
    let script = r#"
import sys, numpy, pycolmap
for path in sys.argv[1:]:
    model = pycolmap.Reconstruction(path)
    squares, told = [], []
    for point in model.points3D.values():
        errors = []
        for seen in point.track.elements:
            image = model.images[seen.image_id]
            px = image.project_point(point.xyz)
            errors.append(numpy.linalg.norm(px - image.points2D[seen.point2D_idx].xy))
        squares += [error**2 for error in errors]
        told.append(abs(point.error - numpy.mean(errors)))
    print(model.num_reg_images(), model.num_points3D(), numpy.sqrt(numpy.mean(squares)), max(told))
"#;
    let models = ["colmap", "colmap-text"].map(|name| out.join(name));
    let printed = succeeds(Command::new(python).args(["-c", script]).args(&models));
    let rms_px = json(&solved.stdout)["reprojection_rms_px"].as_f64().expect("a number");
    assert_eq!(printed.lines().count(), 2, "{printed}");
    for line in printed.lines() {
        let fields: Vec<f64> = line.split(' ').map(|field| field.parse().expect("a number")).collect();
        assert_eq!(fields[..2], [6.0, 30.0], "{printed}");
        // The residuals of result.json are those of the projective reconstruction, which fits a little better.
        assert!((0.9..1.3).contains(&(fields[2] / rms_px)), "{} px instead of {rms_px}", fields[2]);
        // Our projection is COLMAP's.
        assert!(fields[3] < 1e-6, "{printed}");
    }
}

/// A walk whose tracks end in its middle, so that its halves share none: two parts of one camera.
fn two_parts(directory: &Path) -> PathBuf {
    let walk = directory.join("walk");
    let scene =
        ["--sequence", "--views", "16", "--tracks", "700", "--noise", "0.0005", "--outliers", "0.2", "--seed", "2"];
    let made = run(["synth", "--out", text(&walk)].iter().chain(&scene));
    assert_eq!(made.code, Some(0), "{made:?}");
    let table = fs::read_to_string(walk.join("observations.csv")).expect("the walk");
    let mut halves = String::from("view,track,x,y\n");
    for line in table.lines().skip(1) {
        let mut fields: Vec<String> = line.split(',').map(str::to_owned).collect();
        if fields[0].parse::<u32>().expect("a number") >= 8 {
            fields[1] = format!("{}", 700 + fields[1].parse::<u32>().expect("a number"));
        }
        halves.push_str(&format!("{}\n", fields.join(",")));
    }
    let path = directory.join("halves.csv");
    fs::write(&path, halves).expect("written");
    path
}

/// Each part goes into files of its own, in every kind of file.
#[test]
fn parts_are_exported_apart_and_open_in_colmap() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let out = directory.path().join("out");
    let input = two_parts(directory.path());
    let size = ["--width", "1000", "--height", "1000"];
    let solved = solve(&input, &out, &[&size[..], &["--export", "colmap,colmap-text,opensfm"]].concat());
    assert_eq!(solved.code, Some(0), "{solved:?}");
    let cameras = json(&fs::read_to_string(out.join("cameras.json")).expect("cameras.json"));
    let views = |part: u64| {
        let all = cameras["views"].as_array().expect("views").iter();
        all.filter(|view| view["part"] == part).count()
    };
    let (first, second) = (views(0), views(1));
    assert!(first >= second && second >= 5 && first + second >= 14, "{first} and {second} views");
    let vertices = |name: &str| {
        let text = fs::read_to_string(out.join(name)).expect("points");
        text.lines().skip_while(|line| *line != "end_header").skip(1).count()
    };
    let rows = fs::read_to_string(out.join("tracks.csv")).expect("tracks.csv");
    let column = rows.lines().next().and_then(|header| header.split(',').position(|name| name == "part"));
    let of_part = |part: &str| {
        rows.lines().skip(1).filter(|row| row.split(',').nth(column.expect("a column")) == Some(part)).count()
    };
    let splits = json(&solved.stdout)["split_points"].as_u64().expect("a count") as usize;
    assert_eq!(vertices("points.ply") + vertices("points-part-1.ply"), of_part("0") + of_part("1") + splits);
    assert!(vertices("points.ply") >= of_part("0") && vertices("points-part-1.ply") >= of_part("1"));
    assert!(of_part("1") > 50, "{}", of_part("1"));
    let reconstructions = json(&fs::read_to_string(out.join("opensfm/reconstruction.json")).expect("a list"));
    let shots = |part: usize| reconstructions[part]["shots"].as_object().map(serde_json::Map::len);
    assert_eq!((shots(0), shots(1), &reconstructions[2]), (Some(first), Some(second), &Value::Null));

    let Some(python) = python("COLMAP's reader", "pycolmap") else { return };
    let script = "import sys, pycolmap\nfor path in sys.argv[1:]:\n    model = pycolmap.Reconstruction(path)\n    \
                  print(model.num_reg_images(), model.num_points3D() > 50)\n";
    let models = ["colmap", "colmap/1", "colmap-text", "colmap-text/1"].map(|name| out.join(name));
    let printed = succeeds(Command::new(python).args(["-c", script]).args(&models));
    let wanted = [first, second, first, second].map(|count| format!("{count} True"));
    assert_eq!(printed.lines().collect::<Vec<_>>(), wanted);
}

/// Tracks that go over to another point on their way: both points are in every export, where their observations are.
#[test]
fn both_points_of_a_split_track_are_exported() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let scene =
        ["--sequence", "--views", "12", "--tracks", "400", "--noise", "0.0005", "--outliers", "0.2", "--joined", "0.4"];
    let made = run(["synth", "--out", text(&path("walk"))].iter().chain(&scene));
    assert_eq!(made.code, Some(0), "{made:?}");
    let size = ["--width", "1000", "--height", "1000"];
    let input = path("walk/observations.csv");
    let solved = solve(&input, &path("out"), &[&size[..], &["--export", "colmap,colmap-text,opensfm"]].concat());
    assert_eq!(solved.code, Some(0), "{solved:?}");
    let result = json(&solved.stdout);
    let count = |name: &str| result[name].as_u64().expect("a count");
    let (tracks, splits) = (count("inlier_tracks"), count("split_points"));
    assert!(splits > 5, "{result}");
    let reconstruction = json(&fs::read_to_string(path("out/opensfm/reconstruction.json")).expect("a list"));
    let points = reconstruction[0]["points"].as_object().expect("points").len() as u64;
    let points3d = fs::read_to_string(path("out/colmap-text/points3D.txt")).expect("points3D.txt");
    let rows: Vec<Vec<&str>> =
        points3d.lines().filter(|line| !line.starts_with('#')).map(|line| line.split(' ').collect()).collect();
    // A point that one registered image sees is in none of them.
    assert!(
        points == rows.len() as u64 && points > tracks && points <= tracks + splits,
        "{points} of {tracks} + {splits}"
    );
    // Their ids are behind those of the tracks, which are below 400; each has the three observations that made it one.
    let others = || rows.iter().filter(|row| row[0].parse::<u64>().is_ok_and(|id| id >= 400));
    assert!(others().count() as u64 > splits / 2 && others().all(|row| row.len() >= 8 + 2 * 3), "{points3d}");

    let again = solve(&path("out/colmap"), &path("again"), &[]);
    assert_eq!(again.code, Some(0), "{again:?}");
    let right = json(&again.stdout)["inlier_tracks"].as_u64().expect("a count");
    assert!(right as f64 > 0.9 * points as f64, "{right} of {points} points stand when they are tracks");

    // The next run is asked for none of them, and what it does not make is gone.
    let last = solve(&input, &path("out"), &[&size[..], &["--export", "opensfm"]].concat());
    assert_eq!(last.code, Some(0), "{last:?}");
    assert!(!path("out/colmap").exists() && !path("out/colmap-text").exists());
    assert!(path("out/opensfm/reconstruction.json").is_file() && path("out/report.html").is_file());

    let Some(python) = python("COLMAP's reader", "pycolmap") else { return };
    let script = "import sys, pycolmap\nmodel = pycolmap.Reconstruction(sys.argv[1])\n\
                  others = [point for id, point in model.points3D.items() if id >= 400]\n\
                  print(model.num_points3D(), len(others), sum(point.error < 5 for point in others))\n";
    let exported = solve(&input, &path("out"), &[&size[..], &["--export", "colmap"]].concat());
    assert_eq!(exported.code, Some(0), "{exported:?}");
    let printed = succeeds(Command::new(python).args(["-c", script]).arg(path("out/colmap")));
    let others = others().count();
    assert_eq!(printed.trim(), format!("{points} {others} {others}"));
}

/// A database that COLMAP itself wrote: wrong matches are cut, and what is written goes by COLMAP's ids.
#[test]
fn a_database_of_colmap_is_solved_under_its_own_ids() {
    let Some(python) = python("COLMAP's database", "pycolmap") else { return };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    opensfm_tracks(directory.path());
    let script = r#"
import csv, sys, numpy, pycolmap
scene, path = sys.argv[1:]
with open(scene, newline="") as file:
    rows = [[float(row[name]) for name in ("view", "track", "x", "y")] for row in csv.DictReader(file)]
table = numpy.array(rows)
random = numpy.random.default_rng(7)
with pycolmap.Database.open(path) as database:
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.PINHOLE, 1000.0, 1000, 1000)
    camera_id = database.write_camera(camera)
    images = []
    for view in range(6):
        images.append(database.write_image(pycolmap.Image(name=f"{9 - view}.jpg", camera_id=camera_id)))
        points = table[table[:, 0] == view]
        # COLMAP's first pixel has its centre at (.5, .5).
        database.write_keypoints(images[view], (points[numpy.argsort(points[:, 1]), 2:] + 0.5).astype(numpy.float32))
    for first in range(6):
        for second in range(first + 1, 6):
            there = numpy.arange(60)
            wrong = random.random(60) < 0.1
            there[wrong] = random.permutation(there[wrong])
            matches = numpy.stack([numpy.arange(60), there], axis=1).astype(numpy.uint32)
            database.write_matches(images[first], images[second], matches)
"#;
    let scene = path("scene/observations.csv");
    succeeds(Command::new(&python).args(["-c", script]).args([&scene, &path("database.db")]));
    let solved = solve(&path("database.db"), &path("out"), &["--export", "colmap-text"]);
    assert_eq!(solved.code, Some(0), "{solved:?}");
    assert!(
        solved.stderr.contains("database.db: joined 900 raw matches of 15 image pairs into 60 tracks"),
        "{solved:?}"
    );
    assert!(!solved.stderr.contains("; cut 0 matches"), "{solved:?}");
    assert_eq!(json(&solved.stdout)["inlier_tracks"], 30);
    let images = fs::read_to_string(path("out/colmap-text/images.txt")).expect("images.txt");
    // Views are in the order of the names, images keep their ids.
    let first = images.lines().find(|line| !line.starts_with('#')).expect("an image");
    assert!(first.starts_with("6 ") && first.ends_with(" 1 4.jpg"), "{first}");
}
