//! Writing OpenSfM's tracks.csv, version 2: the observations of the points of a reconstruction.

use std::fmt::Write;

use super::reconstruction::point_names;
use super::{frame, shot_names};
use crate::formats::metric::Model;

const HEADER: &str = "OPENSFM_TRACKS_VERSION_v2";
/// Standard deviation of a coordinate where none is known, in pixels.
const DEFAULT_NOISE_PX: f64 = 1.0;
/// OpenSfM's segmentation and instance of a feature that has none.
const NONE: &str = "-1\t-1";

/// One observation a line: `image track feature x y scale r g b segmentation instance`, separated by tabs. A track is
/// named like its point in `reconstruction.json`, a colour is that of the point.
///
/// * `noise_px`: standard deviation of a coordinate; the scale, by which OpenSfM's bundle adjustment divides a residual
pub fn csv(models: &[Model], noise_px: Option<f64>) -> String {
    let noise_px = noise_px.filter(|noise| noise.is_finite() && *noise > 0.0).unwrap_or(DEFAULT_NOISE_PX);
    let mut text = format!("{HEADER}\n");
    for (model, shots) in models.iter().zip(shot_names(models)) {
        let mut lines: Vec<(usize, usize, usize)> = Vec::new();
        for (place, point) in model.points.iter().enumerate() {
            lines.extend(point.seen.iter().map(|&(image, keypoint)| (image, keypoint, place)));
        }
        lines.sort_unstable();
        let names = point_names(model);
        for (image, keypoint, place) in lines {
            let shot = &shots[image];
            let image = &model.images[image];
            let (middle_px, side_px) = frame(model.cameras[image.camera].size);
            let seen = &image.keypoints[keypoint];
            let (x, y) = ((seen.x - middle_px[0]) / side_px, (seen.y - middle_px[1]) / side_px);
            let [red, green, blue] = model.points[place].colour;
            // Writing to a String cannot fail.
            let _ = writeln!(
                text,
                "{shot}\t{}\t{}\t{x}\t{y}\t{}\t{red}\t{green}\t{blue}\t{NONE}",
                names[place],
                seen.index,
                noise_px / side_px
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{ImageSize, Limits};
    use crate::formats::lens_fixture::{lens, scene_of};
    use crate::formats::opensfm::{reconstruction, tracks};
    use crate::formats::{Label, LabelledInput, fixture};

    #[test]
    fn images_of_folders_have_names_without_them_where_these_differ() {
        let (mut input, solution) = fixture::solved();
        for (last, expected) in [("e.jpg", "e.jpg"), ("a.jpg", "right/a.jpg")] {
            let names = ["left/a.jpg", "left/b.jpg", "right/c.jpg", "d.jpg", &format!("right/{last}")];
            input.view_labels = names.iter().map(|name| Label::Name((*name).into())).collect();
            let models = Model::of_parts(&solution, &input).expect("metric");
            let shots = &reconstruction::json(&models)[0]["shots"];
            let text = csv(&models, None);
            let names: Vec<&str> = text.lines().skip(1).filter_map(|line| line.split('\t').next()).collect();
            assert!(shots.get(expected).is_some() && names.contains(&expected), "{shots}");
            assert!(names.iter().all(|name| shots.get(name).is_some()), "{names:?}");
        }
    }

    #[test]
    fn the_right_observations_come_back_under_their_names() {
        let size = ImageSize { width_px: 900, height_px: 1200 };
        let (mut input, solution) = scene_of(lens(1.0, [0.0; 5], [449.5, 599.5]), size);
        input.keypoints = (0..input.raw.x.len() as u32).map(|k| 7 * k).collect();
        let models = Model::of_parts(&solution, &input).expect("metric");
        let text = csv(&models, Some(1.5));
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("tracks.csv");
        let again = tracks::read(text.as_bytes(), &path, &Limits::default(), Some(size)).expect("we read it ourselves");
        let key = |input: &LabelledInput, k: usize| {
            let labels =
                [&input.view_labels[input.raw.view[k] as usize], &input.track_labels[input.raw.track[k] as usize]];
            labels.map(Label::to_string)
        };
        let kept: Vec<usize> = (0..input.raw.x.len()).filter(|&k| solution.observations.inlier[k]).collect();
        assert_eq!(again.raw.x.len(), kept.len());
        for k in kept {
            let back = (0..again.raw.x.len()).find(|&back| key(&again, back) == key(&input, k)).expect("the same");
            assert!((again.raw.x[back] - input.raw.x[k]).hypot(again.raw.y[back] - input.raw.y[k]) < 1e-9);
            assert_eq!(again.keypoints[back], input.keypoints[k]);
        }
        assert!(text.lines().skip(1).all(|line| line.split('\t').nth(5) == Some("0.00125")), "{text}");
        assert!(csv(&models, None).lines().nth(1).is_some_and(|line| line.ends_with("\t-1\t-1")));
    }

    #[test]
    fn a_track_is_called_what_its_point_is_in_the_reconstruction() {
        let (input, solution) = fixture::solved_with_a_split();
        let models = Model::of_parts(&solution, &input).expect("metric");
        let json = reconstruction::json(&models);
        let points = json[0]["points"].as_object().expect("points");
        let text = csv(&models, None);
        let tracks: std::collections::BTreeSet<&str> =
            text.lines().skip(1).filter_map(|line| line.split('\t').nth(1)).collect();
        assert_eq!(tracks.into_iter().collect::<Vec<_>>(), {
            let mut names: Vec<&str> = points.keys().map(String::as_str).collect();
            names.sort_unstable();
            names
        });
    }

    #[test]
    fn cameras_are_called_what_the_data_set_calls_them() {
        let (mut input, mut solution) = fixture::solved_in_two_parts();
        let names = |input: &LabelledInput, solution: &crate::domain::Solution| {
            let models = Model::of_parts(solution, input).expect("metric");
            let of_all = reconstruction::camera_models(&models);
            let json = reconstruction::json(&models);
            for part in json.as_array().expect("parts") {
                for (name, camera) in part["cameras"].as_object().expect("cameras") {
                    assert_eq!(&of_all[name], camera);
                }
                for shot in part["shots"].as_object().expect("shots").values() {
                    assert!(part["cameras"].get(shot["camera"].as_str().expect("a name")).is_some());
                }
            }
            of_all.as_object().expect("cameras").keys().cloned().collect::<Vec<_>>()
        };
        assert_eq!(names(&input, &solution), ["scpsfm camera 1"]);
        input.opensfm_cameras = vec![Some("v2 phone".into()); 5];
        assert_eq!(names(&input, &solution), ["v2 phone"]);
        solution.views[4].focal_px = Some(500.0);
        assert_eq!(names(&input, &solution), ["scpsfm camera 1", "v2 phone"]);
    }
}
