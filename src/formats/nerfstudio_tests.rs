use nalgebra::{Matrix4, Vector4};

use super::*;
use crate::domain::{ImageSize, Solution};
use crate::formats::lens_fixture::{fisheye, lens, scene_of};
use crate::formats::{LabelledInput, fixture};

fn transforms_of(solution: &Solution, input: &LabelledInput) -> Value {
    transforms(&Model::of_parts(solution, input).expect("metric")[0]).expect("one projection")
}

/// Where OpenCV's formulas put every right point in every frame, against the observations.
fn worst_px(file: &Value, solution: &Solution, input: &LabelledInput) -> f64 {
    let frames = file["frames"].as_array().expect("frames");
    let mut worst = 0.0f64;
    for k in (0..input.raw.x.len()).filter(|&k| solution.observations.inlier[k]) {
        let name = input.view_labels[input.raw.view[k] as usize].to_string();
        let frame = frames.iter().find(|frame| frame["file_path"] == name.as_str()).expect("a frame");
        let number = |name: &str| {
            let value = frame.get(name).or_else(|| file.get(name)).unwrap_or(&Value::Null);
            value.as_f64().unwrap_or_else(|| panic!("no {name}"))
        };
        let matrix = Matrix4::from_fn(|row, column| frame["transform_matrix"][row][column].as_f64().expect("a number"));
        let point = solution.tracks.point[input.raw.track[k] as usize].expect("a point");
        let seen = matrix.try_inverse().expect("a pose") * Vector4::new(point[0], point[1], point[2], 1.0);
        // OpenGL's camera looks along -z, with y up.
        let (x, y) = (seen.x / -seen.z, -seen.y / -seen.z);
        assert!(seen.z < 0.0, "in front of the camera");
        let squared = x * x + y * y;
        let [k1, k2, k3, k4] = ["k1", "k2", "k3", "k4"].map(number);
        let polynomial = |s: f64| 1.0 + k1 * s + k2 * s.powi(2) + k3 * s.powi(3) + k4 * s.powi(4);
        let [u, v] = if file["camera_model"] == "OPENCV_FISHEYE" {
            let (radius, angle) = (squared.sqrt(), squared.sqrt().atan());
            [x, y].map(|side| side * angle / radius * polynomial(angle * angle))
        } else {
            let (p1, p2) = (number("p1"), number("p2"));
            let s = polynomial(squared);
            [
                x * s + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
                y * s + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y,
            ]
        };
        // From the corner of the image; ours are from the centre of its first pixel.
        let px = [number("fl_x") * u + number("cx") - 0.5, number("fl_y") * v + number("cy") - 0.5];
        worst = worst.max((px[0] - input.raw.x[k]).hypot(px[1] - input.raw.y[k]));
    }
    worst
}

#[test]
fn points_are_where_they_were_observed() {
    let size = ImageSize { width_px: 900, height_px: 1200 };
    for (calibration, name) in [
        (lens(1.0, [0.0; 5], [449.5, 599.5]), "OPENCV"),
        (lens(1.1, [-0.05, 0.01, 0.02, 0.01, -0.02], [440.0, 610.0]), "OPENCV"),
        (fisheye(1.1, [-0.05, 0.01, 0.02], [440.0, 610.0]), "OPENCV_FISHEYE"),
    ] {
        let (input, solution) = scene_of(calibration, size);
        let file = transforms_of(&solution, &input);
        assert_eq!((&file["camera_model"], &file["w"], &file["h"]), (&name.into(), &900.into(), &1200.into()));
        assert_eq!(file["cx"], calibration.principal_point_px[0] + 0.5);
        assert_eq!(file["frames"].as_array().map(Vec::len), Some(5));
        let worst = worst_px(&file, &solution, &input);
        assert!(worst < 1e-6, "{worst} px off under {calibration:?}");
    }
}

#[test]
fn intrinsics_stand_at_the_frames_where_they_differ() {
    let (input, mut solution) = fixture::solved();
    assert!(transforms_of(&solution, &input)["frames"][0].get("fl_x").is_none());
    solution.views.iter_mut().enumerate().for_each(|(view, of)| of.focal_px = Some(500.0 + view as f64));
    let file = transforms_of(&solution, &input);
    assert!(file.get("fl_x").is_none());
    for view in 0..5 {
        assert_eq!(file["frames"][view]["fl_x"], 500.0 + view as f64);
    }
}

#[test]
fn a_camera_that_only_turned_has_no_points_to_name() {
    let (input, mut solution) = fixture::solved();
    assert_eq!(transforms_of(&solution, &input)["ply_file_path"], POINTS);
    solution.tracks.point.fill(None);
    solution.splits.clear();
    assert_eq!(transforms_of(&solution, &input).get("ply_file_path"), None);
}

#[test]
fn two_lens_projections_are_refused() {
    let (mut input, mut solution) = fixture::solved();
    for view in 3..5 {
        (input.raw.views[view].camera_group, solution.views[view].camera_group) = (1, 1);
    }
    let lens_projection = LensProjection::Fisheye;
    let other = crate::domain::Calibration { camera_group: 1, lens_projection, ..solution.calibrations[0] };
    solution.calibrations.push(other);
    let model = Model::of_parts(&solution, &input).expect("metric").remove(0);
    assert_eq!(transforms(&model), Err(Error::TwoProjections));
}
