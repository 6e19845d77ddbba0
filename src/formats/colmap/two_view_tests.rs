use super::*;
use crate::formats::colmap::database_fixture::dress;
use crate::formats::fixture;

fn solved() -> (LabelledInput, Solution) {
    let (mut input, solution) = fixture::solved();
    dress(&mut input);
    (input, solution)
}

/// Where a point of the metric frame is in a view, in COLMAP's pixels, the lens's distortion undone.
fn ideal(solution: &Solution, input: &LabelledInput, image: u32, point: [f64; 3]) -> Vector3<f64> {
    let view = input.colmap_images.iter().position(|of| of.id == image).expect("an image");
    let rows = solution.views[view].projection.expect("registered");
    let seen = Matrix3x4::from_fn(|row, column| rows[row][column]) * Vector3::from(point).push(1.0);
    Vector3::new(seen.x / seen.z + 0.5, seen.y / seen.z + 0.5, 1.0)
}

/// Distance of the second image of every right point from the epipolar line of the first.
fn worst_px(solution: &Solution, input: &LabelledInput, pair: &Pair, fundamental: &Matrix3<f64>) -> f64 {
    let points = solution.tracks.point.iter().flatten();
    let distance = |point: &[f64; 3]| {
        let [first, second] = pair.images.map(|image| ideal(solution, input, image, *point));
        let line = fundamental * first;
        second.dot(&line).abs() / line.xy().norm()
    };
    points.map(distance).fold(0.0, f64::max)
}

#[test]
fn every_pair_has_the_matches_of_right_observations_and_their_epipolar_geometry() {
    let (input, solution) = solved();
    let pairs = pairs(&solution, &input);
    assert_eq!(pairs.len(), 10);
    for pair in &pairs {
        assert!(pair.images[0] < pair.images[1]);
        assert_eq!(pair.matches.len(), solution.inlier_track_count());
        for keypoints in &pair.matches {
            let track = |side: usize| {
                let view = input.colmap_images.iter().position(|image| image.id == pair.images[side]).expect("a view");
                let of = |k: &usize| input.raw.view[*k] as usize == view && input.keypoints[*k] == keypoints[side];
                input.raw.track[(0..input.raw.x.len()).find(of).expect("an observation")]
            };
            assert_eq!(track(0), track(1));
            assert!(solution.tracks.inlier[track(0) as usize]);
        }
        let Geometry::Calibrated { fundamental, essential, rotation, translation } = &pair.geometry else {
            panic!("{:?}", pair.geometry);
        };
        let worst = worst_px(&solution, &input, pair, fundamental);
        assert!(worst < 1e-6, "{worst} px");
        assert!((translation.norm() - 1.0).abs() < 1e-12);
        let of_pose = translation.cross_matrix() * rotation.to_rotation_matrix().matrix();
        assert!((of_pose - essential).norm() < 1e-12);
    }
}

#[test]
fn projective_cameras_give_the_same_fundamental_matrices() {
    let (input, solution) = solved();
    let (_, projective) = fixture::projective_only();
    let metric = pairs(&solution, &input);
    for (pair, other) in metric.iter().zip(pairs(&projective, &input)) {
        let (Geometry::Calibrated { fundamental, .. }, Geometry::Uncalibrated { fundamental: found }) =
            (&pair.geometry, &other.geometry)
        else {
            panic!("{:?} and {:?}", pair.geometry, other.geometry);
        };
        assert_eq!((pair.images, &pair.matches), (other.images, &other.matches));
        let apart = (fundamental - found).norm().min((fundamental + found).norm());
        assert!(apart < 1e-9, "{apart}");
    }
}

#[test]
fn a_camera_that_only_turns_gives_homographies() {
    let (input, mut solution) = solved();
    solution.views.iter_mut().for_each(|view| view.translation = Some([0.0; 3]));
    for pair in pairs(&solution, &input) {
        let Geometry::Panoramic { homography, rotation: Some(_) } = pair.geometry else { panic!("{pair:?}") };
        assert!((homography.norm() - 1.0).abs() < 1e-12);
    }
}

#[test]
fn pairs_are_of_registered_views_of_one_part() {
    let (mut input, solution) = fixture::solved_in_two_parts();
    dress(&mut input);
    let found = pairs(&solution, &input);
    // Three pairs of three views, and one of two.
    assert_eq!(found.len(), 4);
    let (input, mut solution) = solved();
    solution.views[1] = Default::default();
    assert_eq!(pairs(&solution, &input).len(), 6);
    solution.views.iter_mut().for_each(|view| *view = Default::default());
    assert!(pairs(&solution, &input).is_empty());
    assert!(pairs(&fixture::solved().1, &fixture::solved().0).is_empty(), "no keypoints");
}

#[test]
fn long_tracks_are_matched_less_far_where_there_are_too_many() {
    let lengths = [100usize, 3, 2];
    assert_eq!(reach(lengths.into_iter(), 10_000), 100);
    let held = reach(lengths.into_iter(), 1000);
    // 100 observations with 6 behind each but the last: 594 - 15, and 3 + 1 of the short ones.
    assert_eq!(held, 6);
    assert_eq!(reach(lengths.into_iter(), 0), 1);
    assert_eq!(reach([].into_iter(), 0), 1);
}
