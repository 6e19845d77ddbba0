//! How cameras move and points lie shows in the images.

use nalgebra::{Matrix3, SMatrix, Vector3};

use super::*;

const MOTIONS: [Motion; 8] = [
    Motion::General,
    Motion::Orbit,
    Motion::Turntable,
    Motion::PureTranslation,
    Motion::Forward,
    Motion::Grid,
    Motion::PureRotation,
    Motion::Sphere,
];

fn scene_of(motion: Motion, shape: Shape, seed: u64) -> Scene {
    generate(SceneOptions { motion, shape, ..exact(seed) })
}

/// How far from singular the equations `x_i x H x_0 = 0` are, with coordinates in focal lengths from the principal
/// point: root mean square residual of the best homography of unit norm from view 0 to `view`.
fn homography_residual(scene: &Scene, view: usize) -> f64 {
    let ray = |view, track| {
        let [x, y, _] = observed(scene, view, track);
        calibration(scene, view).try_inverse().expect("regular") * Vector3::new(x, y, 1.0)
    };
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for track in 0..scene.options.tracks {
        let (from, to) = (ray(0, track), ray(view, track));
        let equations = to.cross_matrix().kronecker(&from.transpose());
        normal += equations.transpose() * equations;
    }
    (normal.symmetric_eigenvalues().min().max(0.0) / scene.options.tracks as f64).sqrt()
}

#[test]
fn every_motion_keeps_every_point_in_front_of_rigid_cameras() {
    for (motion, shape, seed) in combinations(&MOTIONS, &[Shape::Box, Shape::Plane]) {
        for max_rotation_rad in [0.05, 0.4, 3.1] {
            let scene = generate(SceneOptions { motion, shape, max_rotation_rad, ..exact(seed) });
            for view in 0..scene.options.views {
                let rotation = rotation(&scene, view);
                let off = (rotation * rotation.transpose() - Matrix3::identity()).norm();
                assert!(off < 1e-12 && rotation.determinant() > 0.0, "{motion:?} seed {seed}: {rotation}");
                for track in 0..scene.options.tracks {
                    let [.., depth] = observed(&scene, view, track);
                    assert!(depth > 0.5, "{motion:?} seed {seed}: depth {depth}");
                    assert!(error_px(&scene, view, track) < EXACT_PX, "{motion:?} {shape:?} seed {seed}");
                }
            }
        }
    }
}

/// Every combination with every seed.
fn combinations(motions: &[Motion], shapes: &[Shape]) -> Vec<(Motion, Shape, u64)> {
    let mut all = Vec::new();
    for &motion in motions {
        for &shape in shapes {
            all.extend(SEEDS.map(move |seed| (motion, shape, seed)));
        }
    }
    all
}

#[test]
fn a_homography_relates_the_views_of_a_plane_or_of_a_turning_camera_and_no_others() {
    for (motion, shape, seed) in combinations(&MOTIONS, &[Shape::Box, Shape::Plane]) {
        let scene = scene_of(motion, shape, seed);
        let worst = (1..scene.options.views).map(|view| homography_residual(&scene, view)).fold(0.0, f64::max);
        let expected = motion == Motion::PureRotation || shape == Shape::Plane;
        assert_eq!(worst < 1e-7, expected, "{motion:?} {shape:?} seed {seed}: {worst:e}");
        assert!(expected || worst > 1e-3, "{motion:?} {shape:?} seed {seed}: {worst:e}");
    }
}

#[test]
fn a_turning_camera_maps_its_images_by_its_calibration_and_rotation() {
    for seed in SEEDS {
        let scene = scene_of(Motion::PureRotation, Shape::Box, seed);
        for view in 1..scene.options.views {
            let turn = rotation(&scene, view) * rotation(&scene, 0).transpose();
            assert!((turn - Matrix3::identity()).norm() > 1e-3, "seed {seed}: view {view} does not turn");
            let inverse = calibration(&scene, 0).try_inverse().expect("regular");
            let homography = calibration(&scene, view) * turn * inverse;
            for track in 0..scene.options.tracks {
                let [x, y, _] = observed(&scene, 0, track);
                let mapped = homography * Vector3::new(x, y, 1.0);
                let [x, y, _] = observed(&scene, view, track);
                let off = (mapped.x / mapped.z - x).hypot(mapped.y / mapped.z - y);
                assert!(off < EXACT_PX, "seed {seed}, view {view}, track {track}: {off} px");
            }
        }
    }
}

#[test]
fn a_pure_translation_has_one_rotation_and_moves_in_all_directions() {
    for seed in SEEDS {
        let scene = scene_of(Motion::PureTranslation, Shape::Box, seed);
        let mut spread = Matrix3::zeros();
        for view in 1..scene.options.views {
            assert_eq!(scene.truth.rotations[view], scene.truth.rotations[0], "seed {seed}");
            let step = translation(&scene, view) - translation(&scene, 0);
            assert!(step.amax() < 2.0, "seed {seed}: {step}");
            spread += step * step.transpose();
        }
        assert!(spread.symmetric_eigenvalues().min() > 0.1, "seed {seed}: {spread}");
        assert_ne!(scene.truth.rotations[0], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    }
}

#[test]
fn forward_motion_moves_points_on_lines_through_the_principal_point() {
    for seed in SEEDS {
        let scene = scene_of(Motion::Forward, Shape::Box, seed);
        let [px, py] = scene.truth.principal_point_px;
        let mut moved = 0.0f64;
        for view in 1..scene.options.views {
            for track in 0..scene.options.tracks {
                let ([x0, y0, _], [x, y, _]) = (observed(&scene, 0, track), observed(&scene, view, track));
                let off_line = (x0 - px) * (y - py) - (y0 - py) * (x - px);
                assert!(off_line.abs() < 1e-6, "seed {seed}: {off_line}");
                moved = moved.max((x - x0).hypot(y - y0));
            }
        }
        assert!(moved > 100.0, "seed {seed}: moved by {moved} px at most");
    }
}

#[test]
fn orbiting_cameras_look_at_the_centre_and_a_turntable_has_one_axis() {
    let centre = Vector3::from(shape::SCENE_CENTRE);
    for (motion, seed) in SEEDS.flat_map(|seed| [(Motion::Orbit, seed), (Motion::Turntable, seed)]) {
        let scene = generate(SceneOptions { motion, max_rotation_rad: 3.1, ..exact(seed) });
        let mut behind = 0;
        for view in 0..scene.options.views {
            let (rotation, translation) = (rotation(&scene, view), translation(&scene, view));
            let seen = rotation * centre + translation;
            assert!(seen.xy().norm() < 1e-12, "{motion:?} seed {seed}: {seen}");
            let camera = -rotation.transpose() * translation;
            behind += usize::from(camera.z > centre.z);
            if motion == Motion::Turntable {
                assert!((rotation * Vector3::y() - Vector3::y()).norm() < 1e-12, "seed {seed}: {rotation}");
                assert!(camera.y.abs() < 1e-12 && ((camera - centre).norm() - 3.0).abs() < 1e-12, "seed {seed}");
            }
        }
        assert!((1..scene.options.views).contains(&behind), "{motion:?} seed {seed}: {behind} views from behind");
    }
}

#[test]
fn cameras_on_a_sphere_are_on_all_sides_of_it_and_upside_down_too() {
    let centre = Vector3::from(shape::SCENE_CENTRE);
    for seed in SEEDS {
        let scene = generate(SceneOptions { motion: Motion::Sphere, views: 40, tracks: 10, ..exact(seed) });
        let (mut directions, mut rolls) = (Vec::new(), Vec::new());
        for view in 0..40 {
            let (rotation, translation) = (rotation(&scene, view), translation(&scene, view));
            let camera = -rotation.transpose() * translation - centre;
            assert!((camera.norm() - 3.0).abs() < 1e-12, "seed {seed}: at a distance of {}", camera.norm());
            assert!((rotation * centre + translation).xy().norm() < 1e-12, "seed {seed}: looks elsewhere");
            directions.push(camera);
            rolls.push(rotation[(1, 1)]);
        }
        for axis in 0..3 {
            let (low, high) = (|x: &Vector3<f64>| x[axis] < -1.0, |x: &Vector3<f64>| x[axis] > 1.0);
            assert!(directions.iter().any(low) && directions.iter().any(high), "seed {seed}: {directions:?}");
        }
        assert!(rolls.iter().any(|&up| up < -0.3) && rolls.iter().any(|&up| up > 0.3), "seed {seed}: {rolls:?}");
    }
}

#[test]
fn a_roll_turns_each_image_about_its_centre_and_leaves_the_rest_of_the_scene() {
    for (motion, seed) in SEEDS.flat_map(|seed| MOTIONS.map(|motion| (motion, seed))) {
        let level = generate(SceneOptions { motion, outliers: 0.5, tracks: 30, ..exact(seed) });
        let rolled = generate(SceneOptions { max_roll_rad: 2.0, ..level.options.clone() });
        assert_eq!((&rolled.truth.points, &rolled.truth.inlier), (&level.truth.points, &level.truth.inlier));
        let mut largest = 0.0f64;
        for view in 0..level.options.views {
            let [px, py] = level.truth.principal_point_px;
            let turn = rotation(&rolled, view) * rotation(&level, view).transpose();
            let angle = turn[(1, 0)].atan2(turn[(0, 0)]);
            assert!((turn[(2, 2)] - 1.0).abs() < 1e-12 && angle.abs() <= 2.0, "{motion:?} seed {seed}: {turn}");
            largest = largest.max(angle.abs());
            for track in 0..30 {
                let ([x, y, depth], [u, v, same]) = (observed(&level, view, track), observed(&rolled, view, track));
                let image = turn * Vector3::new(x - px, y - py, 1.0);
                assert!((image.x - u + px).hypot(image.y - v + py) < 1e-6, "{motion:?} seed {seed}");
                assert!((depth - same).abs() < 1e-12, "{motion:?} seed {seed}");
            }
        }
        assert!(largest > 0.5, "{motion:?} seed {seed}: rolled by {largest} at most");
    }
}

#[test]
fn a_grid_is_square_and_does_not_turn() {
    let scene = generate(SceneOptions { motion: Motion::Grid, views: 9, ..exact(0) });
    for view in 0..9 {
        assert_eq!(rotation(&scene, view), Matrix3::identity());
        let centre = -translation(&scene, view);
        assert_eq!(centre, Vector3::new((view % 3) as f64 - 1.0, (view / 3) as f64 - 1.0, 0.0), "view {view}");
    }
}

#[test]
fn a_track_is_observed_by_neighbouring_views_and_the_rest_stays() {
    for seed in SEEDS {
        let base = SceneOptions { motion: Motion::Grid, views: 25, outliers: 0.3, ..exact(seed) };
        let complete = generate(base.clone());
        let scene = generate(SceneOptions { seen_views: 5, ..base });
        let mut views = vec![Vec::new(); 200];
        for (k, (&view, &track)) in scene.input.view.iter().zip(&scene.input.track).enumerate() {
            views[track as usize].push(view as usize);
            let here = [scene.input.x[k], scene.input.y[k], scene.input.depth[k]];
            assert_eq!(here, observed(&complete, view as usize, track as usize), "seed {seed}");
        }
        let apart = |a: usize, b: usize| (translation(&scene, a) - translation(&scene, b)).norm();
        for seen in &views {
            assert_eq!(seen.len(), 5);
            // Cameras half a unit apart: a middle one and its neighbours, or a block of the corner.
            assert!(seen.iter().any(|&middle| seen.iter().all(|&view| apart(middle, view) < 1.01)), "{seen:?}");
        }
        assert!((0..25).all(|view| views.iter().any(|seen| seen.contains(&view))), "seed {seed}");
    }
}
