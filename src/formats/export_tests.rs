use std::fs;

use nalgebra::{Rotation3, Vector3};
use serde_json::Value;

use super::*;
use crate::domain::ImageSize;
use crate::formats::lens_fixture::{fisheye, lens, scene_of};
use crate::formats::{Label, fixture, result_files};

/// The model of a result in one part.
fn model_of(solution: &Solution, input: &LabelledInput) -> Model {
    Model::of_parts(solution, input).expect("metric").remove(0)
}

const ALL: [Export; 6] =
    [Export::Colmap, Export::ColmapText, Export::OpenSfm, Export::Nerfstudio, Export::Bundler, Export::Bal];

/// Every file of an export of a result in one part.
fn files(export: Export) -> &'static [&'static str] {
    match export {
        Export::Colmap => &["cameras.bin", "images.bin", "points3D.bin"],
        Export::ColmapText => &["cameras.txt", "images.txt", "points3D.txt"],
        Export::ColmapDatabase => &["database.db"],
        Export::OpenSfm => &["reconstruction.json", "tracks.csv", "camera_models.json"],
        Export::Nerfstudio => &["transforms.json", "points.ply"],
        Export::Bundler => &["bundle.out", "list.txt"],
        Export::Bal => &["problem.txt"],
    }
}

/// Writes a result and these exports of it; returns why there are none.
fn write(directory: &Path, exports: &[Export], solution: &Solution, input: &LabelledInput) -> Option<NotExported> {
    result_files::write(directory, solution, Some(input), exports).expect("written")
}

#[test]
fn a_result_that_is_not_metric_says_so_and_takes_former_files_away() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    let (input, solution) = fixture::solved();
    write(directory, &ALL, &solution, &input);
    let paths: Vec<_> = ALL
        .iter()
        .flat_map(|export| files(*export).iter().map(|file| directory.join(export.folder()).join(file)))
        .collect();
    assert_eq!(paths.len(), 14);
    assert!(paths.iter().all(|path| path.metadata().is_ok_and(|metadata| metadata.len() > 0)));
    let mine = directory.join("colmap/mine.txt");
    fs::write(&mine, "x").expect("written");
    let (input, projective) = fixture::projective_only();
    let refused = write(directory, &ALL, &projective, &input).expect("not metric");
    assert!(refused.to_string().starts_with("nothing was exported: the result is not metric"), "{refused}");
    assert!(paths.iter().all(|path| !path.exists()) && mine.exists());
}

#[test]
fn an_export_that_is_not_written_does_not_keep_the_others() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let (mut input, solution) = fixture::solved();
    let asked = [Export::ColmapDatabase, Export::OpenSfm, Export::OpenSfm];
    let refused = write(directory.path(), &asked, &solution, &input).expect("no database").to_string();
    assert_eq!(refused, "not exported: colmap-db: the input is no COLMAP database: there is none to copy");
    assert!(!directory.path().join("colmap-db").exists() && directory.path().join("opensfm").exists());
    colmap::database_fixture::dress(&mut input);
    input.path = directory.path().join("none.db");
    let refused = write(directory.path(), &asked, &solution, &input).expect("no file").to_string();
    assert!(refused.contains("colmap-db: the database cannot be copied"), "{refused}");
    assert!(!directory.path().join("colmap-db").exists());
    colmap::database_fixture::write(&input.path, &input, "");
    assert_eq!(write(directory.path(), &asked, &solution, &input), None);
    assert!(directory.path().join("colmap-db/database.db").is_file());
    // The next run takes it away, as it takes every file of a former one.
    assert_eq!(write(directory.path(), &[], &solution, &input), None);
    assert!(!directory.path().join("colmap-db").exists());
    assert_eq!(write(directory.path(), &[Export::ColmapDatabase], &fixture::projective_only().1, &input), None);
    let mut nothing = solution;
    nothing.views.iter_mut().for_each(|view| *view = Default::default());
    let refused = write(directory.path(), &[Export::ColmapDatabase], &nothing, &input).expect("nothing").to_string();
    assert_eq!(refused, "nothing was exported: no view of the result has a camera");
}

/// Where OpenSfM's formulas put every point of the file in every shot, against the observations (its `perspective`,
/// `brown`, `fisheye` and `fisheye_opencv` models, doc/source/geometry.rst).
fn worst_of_opensfm(json: &Value, input: &LabelledInput, solution: &Solution) -> f64 {
    let number = |value: &Value| value.as_f64().expect("a number");
    let three = |value: &Value| Vector3::from_fn(|axis, _| number(&value[axis]));
    let mut worst = 0.0f64;
    let mut seen = 0;
    for k in (0..input.raw.x.len()).filter(|&k| solution.observations.inlier[k]) {
        let shot = &json[0]["shots"][input.view_labels[input.raw.view[k] as usize].to_string()];
        let camera = &json[0]["cameras"][shot["camera"].as_str().expect("a name")];
        let point = &json[0]["points"][input.track_labels[input.raw.track[k] as usize].to_string()];
        let rotation = Rotation3::from_scaled_axis(three(&shot["rotation"]));
        let seen_at = rotation * three(&point["coordinates"]) + three(&shot["translation"]);
        let (x, y) = (seen_at.x / seen_at.z, seen_at.y / seen_at.z);
        let squared = x * x + y * y;
        let d = 1.0 + number(&camera["k1"]) * squared + number(&camera["k2"]) * squared * squared;
        let (u, v) = match camera["projection_type"].as_str() {
            Some("perspective") => (number(&camera["focal"]) * d * x, number(&camera["focal"]) * d * y),
            Some("brown") => {
                let d = d + number(&camera["k3"]) * squared.powi(3);
                let (p1, p2) = (number(&camera["p1"]), number(&camera["p2"]));
                let x_shift = 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x);
                let y_shift = p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y;
                (
                    number(&camera["focal_x"]) * (x * d + x_shift) + number(&camera["c_x"]),
                    number(&camera["focal_y"]) * (y * d + y_shift) + number(&camera["c_y"]),
                )
            }
            Some(kind @ ("fisheye" | "fisheye_opencv")) => {
                let radius = squared.sqrt();
                let angle = radius.atan();
                let d = 1.0 + number(&camera["k1"]) * angle.powi(2) + number(&camera["k2"]) * angle.powi(4);
                if kind == "fisheye" {
                    let scale = number(&camera["focal"]) * d * angle / radius;
                    (scale * x, scale * y)
                } else {
                    let fourth = number(&camera["k4"]) * angle.powi(8);
                    let scale = (d + number(&camera["k3"]) * angle.powi(6) + fourth) * angle / radius;
                    (
                        number(&camera["focal_x"]) * scale * x + number(&camera["c_x"]),
                        number(&camera["focal_y"]) * scale * y + number(&camera["c_y"]),
                    )
                }
            }
            other => panic!("{other:?} is not a type of ours"),
        };
        let (w, h) = (number(&camera["width"]), number(&camera["height"]));
        let px = [u * w.max(h) - 0.5 + w / 2.0, v * w.max(h) - 0.5 + h / 2.0];
        worst = worst.max((px[0] - input.raw.x[k]).hypot(px[1] - input.raw.y[k]));
        seen += 1;
    }
    assert!(seen > 50);
    worst
}

#[test]
fn opensfm_sees_the_points_where_they_were_observed() {
    let size = ImageSize { width_px: 900, height_px: 1200 };
    let middle = [449.5, 599.5];
    for (calibration, kind) in [
        (lens(1.0, [-0.05, 0.01, 0.0, 0.0, 0.0], middle), "perspective"),
        (lens(1.0, [0.0; 5], [440.0, 610.0]), "brown"),
        (lens(1.1, [-0.05, 0.01, 0.0, 0.0, 0.0], [440.0, 610.0]), "brown"),
        (lens(1.0, [-0.05, 0.01, 0.02, 0.0, 0.0], middle), "brown"),
        (lens(1.0, [0.0, 0.0, 0.0, 0.01, 0.0], middle), "brown"),
        (lens(1.0, [0.0, 0.0, 0.0, 0.0, 0.02], middle), "brown"),
        (lens(1.1, [-0.05, 0.01, 0.02, 0.01, -0.02], [440.0, 610.0]), "brown"),
        (fisheye(1.0, [0.0; 3], middle), "fisheye"),
        (fisheye(1.0, [-0.05, 0.01, 0.0], middle), "fisheye"),
        (fisheye(1.0, [-0.05, 0.01, 0.02], middle), "fisheye_opencv"),
        (fisheye(1.1, [-0.05, 0.0, 0.0], [440.0, 610.0]), "fisheye_opencv"),
    ] {
        let (input, solution) = scene_of(calibration, size);
        let json = opensfm::reconstruction::json(&[model_of(&solution, &input)]);
        let cameras = json[0]["cameras"].as_object().expect("cameras");
        let kinds: Vec<&Value> = cameras.values().map(|camera| &camera["projection_type"]).collect();
        assert_eq!(kinds, [kind]);
        assert_eq!(json[0]["points"].as_object().expect("points").len(), solution.inlier_track_count());
        let error_px = |point: &metric::Point| point.error_px;
        let model = model_of(&solution, &input);
        assert!(model.points.iter().map(error_px).fold(0.0, f64::max) < 1e-6);
        let worst = worst_of_opensfm(&json, &input, &solution);
        assert!(worst < 1e-6, "{worst} px off under {calibration:?}");
    }
}

#[test]
fn colmap_gets_the_simplest_camera_that_says_the_same_half_a_pixel_on() {
    let size = ImageSize { width_px: 900, height_px: 1200 };
    let centre = [449.5, 599.5];
    let perspectives = [
        (1.0, [0.0; 5], "SIMPLE_PINHOLE", "900 450 600"),
        (1.25, [0.0; 5], "PINHOLE", "900 1125 450 600"),
        (1.0, [0.5, 0.0, 0.0, 0.0, 0.0], "SIMPLE_RADIAL", "900 450 600 0.5"),
        (1.0, [0.5, -0.25, 0.0, 0.0, 0.0], "RADIAL", "900 450 600 0.5 -0.25"),
        (1.0, [0.0, -0.25, 0.0, 0.0, 0.0], "RADIAL", "900 450 600 0 -0.25"),
        (1.25, [0.5, 0.25, 0.0, 0.0, 0.0], "OPENCV", "900 1125 450 600 0.5 0.25 0 0"),
        (1.0, [0.5, 0.25, 0.0, 0.125, -0.0625], "OPENCV", "900 900 450 600 0.5 0.25 0.125 -0.0625"),
        (1.0, [0.0, 0.0, 0.0, 0.0, 0.125], "OPENCV", "900 900 450 600 0 0 0 0.125"),
        (1.0, [0.5, 0.25, 2.0, 0.0, 0.0], "FULL_OPENCV", "900 900 450 600 0.5 0.25 0 0 2 0 0 0"),
        (1.25, [0.0, 0.0, 2.0, 0.125, -0.5], "FULL_OPENCV", "900 1125 450 600 0 0 0.125 -0.5 2 0 0 0"),
    ];
    let fisheyes = [
        (1.0, [0.0; 3], "SIMPLE_RADIAL_FISHEYE", "900 450 600 0"),
        (1.0, [0.5, 0.0, 0.0], "SIMPLE_RADIAL_FISHEYE", "900 450 600 0.5"),
        (1.0, [0.5, -0.25, 0.0], "RADIAL_FISHEYE", "900 450 600 0.5 -0.25"),
        (1.0, [0.5, 0.25, 2.0], "OPENCV_FISHEYE", "900 900 450 600 0.5 0.25 2 0"),
        (1.25, [0.0; 3], "OPENCV_FISHEYE", "900 1125 450 600 0 0 0 0"),
    ];
    let perspectives = perspectives
        .into_iter()
        .map(|(aspect, coefficients, model, parameters)| (lens(aspect, coefficients, centre), model, parameters));
    let fisheyes = fisheyes
        .into_iter()
        .map(|(aspect, radial, model, parameters)| (fisheye(aspect, radial, centre), model, parameters));
    for (calibration, model, parameters) in perspectives.chain(fisheyes) {
        let (input, solution) = scene_of(calibration, size);
        let of_result = model_of(&solution, &input);
        let [cameras, ..] = colmap::write::text(&of_result);
        assert_eq!(cameras.lines().nth(1), Some(format!("1 {model} 900 1200 {parameters}").as_str()));
        assert_eq!(cameras.lines().count(), 2);
        // A count, the camera's id, the model's, two sides, and as many parameters as COLMAP expects of the model.
        let [cameras, ..] = colmap::write::binary(&of_result);
        let known = colmap::cameras::Model::of_name(model).expect("a model of COLMAP's");
        assert_eq!(known.parameters, parameters.split(' ').count());
        assert_eq!(cameras[12..16], (known.id as i32).to_le_bytes());
        assert_eq!(cameras.len(), 8 + 4 + 4 + 16 + 8 * known.parameters);
    }
}

#[test]
fn cameras_are_apart_where_sizes_groups_or_focal_lengths_are() {
    let (mut input, mut solution) = fixture::solved();
    let ids = |input: &LabelledInput, solution: &Solution| {
        let model = model_of(solution, input);
        model.images.iter().map(|image| model.cameras[image.camera].id).collect::<Vec<u32>>()
    };
    assert_eq!(ids(&input, &solution), [1, 1, 1, 1, 1]);
    input.raw.views[3].camera_group = 9;
    input.raw.views[4].size = Some(ImageSize { width_px: 10, height_px: 10 });
    assert_eq!(ids(&input, &solution), [1, 1, 1, 2, 3]);
    solution.views.iter_mut().enumerate().for_each(|(view, result)| result.focal_px = Some(500.0 + view as f64));
    assert_eq!(ids(&input, &solution), [1, 2, 3, 4, 5]);
    let (mut input, solution) = fixture::solved();
    input.colmap_images = (11..16).map(|id| colmap::ColmapImage { id, ..Default::default() }).collect();
    input.raw.views.iter_mut().enumerate().for_each(|(view, of)| of.camera_group = 20 + view as u32 / 3);
    assert_eq!(ids(&input, &solution), [20, 20, 20, 21, 21]);
    let (input, mut solution) = (input, solution);
    solution.views.iter_mut().enumerate().for_each(|(view, result)| result.focal_px = Some(500.0 + view as f64));
    assert_eq!(ids(&input, &solution), [20, 1, 2, 21, 3]);
}

#[test]
fn views_without_a_pose_and_points_that_one_image_sees_are_left_out() {
    let (mut input, mut solution) = fixture::solved();
    solution.views[1] = Default::default();
    let track = solution.tracks.inlier.iter().position(|&inlier| inlier).expect("an inlier");
    let of_track: Vec<usize> = (0..input.raw.x.len()).filter(|&k| input.raw.track[k] as usize == track).collect();
    of_track[..4].iter().for_each(|&k| solution.observations.inlier[k] = false);
    let model = model_of(&solution, &input);
    assert_eq!((model.images.len(), model.points.len()), (4, solution.inlier_track_count() - 1));
    for (position, point) in model.points.iter().enumerate() {
        assert_eq!(point.seen.len(), 4);
        for &(image, keypoint) in &point.seen {
            assert_eq!(model.images[image].keypoints[keypoint].point, Some(position));
        }
    }
    assert_eq!(model.points[0].id, model.points[0].label.number().expect("a number"));
    input.track_labels.iter_mut().for_each(|label| *label = Label::Name(format!("t{label}").into()));
    let named = model_of(&solution, &input);
    let ids: Vec<u64> = named.points.iter().map(|point| point.id).collect();
    assert_eq!(ids, (1..=ids.len() as u64).collect::<Vec<_>>());
    solution.views.iter_mut().for_each(|view| *view = Default::default());
    assert_eq!(Model::of_parts(&solution, &input).expect_err("no poses"), metric::Error::NoPose);
}

#[test]
fn every_part_is_exported_in_a_frame_of_its_own() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    let (input, solution) = fixture::solved_in_two_parts();
    write(directory, &ALL, &solution, &input);
    let images = |file: &str| {
        let text = fs::read_to_string(directory.join("colmap-text").join(file)).expect("a file");
        let poses = text.lines().filter(|line| !line.starts_with('#')).step_by(2);
        poses.map(|line| line.rsplit(' ').next().expect("a name").to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(images("images.txt"), ["3", "13", "23"]);
    assert_eq!(images("1/images.txt"), ["33", "43"]);
    let points = |file: &str| {
        let text = fs::read_to_string(directory.join("colmap-text").join(file)).expect("a file");
        text.lines().filter(|line| !line.starts_with('#')).count()
    };
    let inliers = solution.inlier_track_count();
    assert_eq!(points("points3D.txt") + points("1/points3D.txt"), inliers);
    assert_eq!(points("1/points3D.txt"), inliers / 2);
    assert!(directory.join("colmap/1/points3D.bin").is_file() && !directory.join("colmap/2").exists());

    let text = fs::read_to_string(directory.join("opensfm/reconstruction.json")).expect("a file");
    let list: Value = serde_json::from_str(&text).expect("JSON");
    let shots = |part: usize| list[part]["shots"].as_object().expect("shots").keys().cloned().collect::<Vec<_>>();
    assert_eq!(list.as_array().map(Vec::len), Some(2));
    assert_eq!(shots(1), ["33", "43"]);
    assert_eq!(shots(0).len(), 3);
}

#[test]
fn parts_of_a_former_result_are_taken_away() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    let (input, solution) = fixture::solved_in_two_parts();
    write(directory, &ALL, &solution, &input);
    let mine = directory.join("colmap-text/1/mine.txt");
    fs::write(&mine, "x").expect("written");
    let (input, solution) = fixture::solved();
    write(directory, &ALL, &solution, &input);
    assert!(!directory.join("colmap/1").exists());
    assert!(mine.exists() && !directory.join("colmap-text/1/cameras.txt").exists());
    assert!(directory.join("colmap/cameras.bin").is_file());
}

#[test]
fn exports_of_a_former_run_go_whatever_this_one_is_asked_for() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    let (mut input, solution) = fixture::solved_in_two_parts();
    write(directory, &ALL, &solution, &input);
    assert!(directory.join("colmap/1/points3D.bin").is_file());
    write(directory, &[Export::OpenSfm], &solution, &input);
    assert!(!directory.join("colmap").exists() && !directory.join("colmap-text").exists());
    assert!(directory.join("opensfm/reconstruction.json").is_file());
    write(directory, &[], &fixture::projective_only().1, &input);
    assert!(!directory.join("opensfm").exists());
    // What this run was given to solve stays.
    write(directory, &ALL, &solution, &input);
    input.path = directory.join("colmap");
    write(directory, &[], &solution, &input);
    assert!(directory.join("colmap/cameras.bin").is_file() && !directory.join("colmap/1").exists());
}

/// A model that another program wrote, or refined in its place, is its own; so is what belongs to it.
#[test]
fn models_of_other_programs_stay() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let directory = directory.path();
    let (input, solution) = fixture::solved();
    let folders = ALL.map(|export| directory.join(export.folder()));
    for folder in &folders {
        fs::create_dir_all(folder).expect("created");
    }
    fs::write(folders[0].join("cameras.bin"), "another program's").expect("written");
    assert!(write(directory, &[], &solution, &input).is_none());
    assert!(folders[0].join("cameras.bin").is_file());
    write(directory, &ALL, &solution, &input);
    for (export, folder) in ALL.iter().zip(&folders) {
        let file = files(*export)[0];
        let mut bytes = fs::read(folder.join(file)).expect("a file");
        *bytes.last_mut().expect("bytes") ^= 1;
        fs::write(folder.join(file), bytes).expect("written");
    }
    write(directory, &[], &solution, &input);
    for export in ALL {
        let folder = directory.join(export.folder());
        assert!(files(export).iter().all(|file| folder.join(file).is_file()), "{export:?}");
    }
}

/// A track that joins two points: both are there, each with the observations that show it.
#[test]
fn both_points_of_a_split_track_are_exported() {
    let (mut input, solution) = fixture::solved_with_a_split();
    let (track, inliers) = (solution.splits[0].track as usize, solution.inlier_track_count());
    let model = model_of(&solution, &input);
    assert_eq!(model.points.len(), inliers + 1);
    let own = model.points.iter().find(|point| point.label == input.track_labels[track]).expect("its own point");
    let other = model.points.last().expect("the other point");
    assert_eq!((own.seen.len(), other.seen.len(), other.number), (3, 2, 1));
    assert_eq!(other.id, model.points.iter().map(|point| point.id).max().expect("points"));
    let of_tracks = input.track_labels.iter().filter_map(Label::number);
    assert_eq!(Some(other.id), of_tracks.max().map(|largest| largest + 1));
    // Its keypoints lie where it is seen: it is the point of a right track.
    let typical = model.points[..inliers].iter().map(|point| point.error_px).fold(0.0, f64::max);
    assert!(other.error_px <= 2.0 * typical, "{} px beside {typical} px", other.error_px);
    let directory = tempfile::tempdir().expect("a temporary directory");
    write(directory.path(), &[Export::ColmapText], &solution, &input);
    let again = colmap::model::read(&directory.path().join("colmap-text"), &crate::domain::Limits::default());
    let again = again.expect("our own reader reads it").raw;
    let seen = |point: u32| again.track.iter().filter(|&&track| track == point).count();
    assert_eq!((again.track_count, seen(inliers as u32)), (inliers + 1, 2));
    // A track of the caller's may be called what the other point would be.
    let name = |label: &Label| format!("{label}+1");
    let free = solution.tracks.inlier.iter().rposition(|&inlier| inlier).expect("an inlier");
    input.track_labels[free] = Label::Name(name(&input.track_labels[track]).into());
    let json = opensfm::reconstruction::json(&[model_of(&solution, &input)]);
    assert_eq!(json[0]["points"].as_object().expect("points").len(), inliers + 1);
    let ids: std::collections::BTreeSet<u64> =
        model_of(&solution, &input).points.iter().map(|point| point.id).collect();
    assert_eq!(ids.len(), inliers + 1);
}
