//! Fundamental matrices of scenes whose cameras are known.

use rand::{Rng, SeedableRng};

use super::*;
use crate::geometry::bundle::testing::{self, TestScene};

const NOISE: f64 = 0.001;

fn matches_of(scene: &TestScene) -> Vec<Match> {
    let point = |view: usize, track: usize| {
        scene.observations.iter().find(|seen| (seen.view, seen.point) == (view, track)).expect("complete").xy
    };
    (0..scene.points.len()).map(|track| Match { from: point(0, track), to: point(1, track) }).collect()
}

/// `[e]ₓ K R K⁻¹` and e, both at unit norm, from the true poses.
fn truth(scene: &TestScene) -> (Matrix3<f64>, Vector3<f64>) {
    let k = Matrix3::from_diagonal(&Vector3::new(scene.intrinsics.focal, scene.intrinsics.focal, 1.0));
    let [from, to] = [0, 1].map(|view| &scene.poses[view]);
    let rotation = to.rotation * from.rotation.transpose();
    let epipole = (k * (to.translation - rotation * from.translation)).normalize();
    let inverse = k.try_inverse().expect("a focal length");
    ((epipole.cross_matrix() * k * rotation * inverse).normalize(), epipole)
}

fn depth(scene: &TestScene, view: usize, track: usize) -> f64 {
    let pose = &scene.poses[view];
    (pose.rotation * scene.points[track] + pose.translation).z
}

/// Distance up to the sign.
fn apart(difference: f64, sum: f64) -> f64 {
    difference.min(sum)
}

#[test]
fn exact_matches_give_the_matrix_and_the_epipole_of_the_poses() {
    for seed in 0..10 {
        let scene = testing::scene(seed, 2, 30, 0.0);
        let matches = matches_of(&scene);
        let found = eight_point(&matches, &[1.0; 30]).expect("general position");
        let (matrix, epipole) = truth(&scene);
        let error = apart((found.matrix - matrix).norm(), (found.matrix + matrix).norm());
        assert!(error < 1e-7, "seed {seed}: {error:e}");
        let error = apart((found.epipole - epipole).norm(), (found.epipole + epipole).norm());
        assert!(error < 1e-6, "seed {seed}: epipole off by {error:e}");
        assert!(found.matrix.tr_mul(&found.epipole).norm() < 1e-12, "seed {seed}: eᵀ F is not 0");
        assert!(found.matrix.determinant().abs() < 1e-12, "seed {seed}: rank 3");
        assert!(matches.iter().all(|seen| found.sampson_squared(seen) < 1e-16), "seed {seed}");
    }
}

/// With F and e of the true poses, where no factor is free, the ratio of depths is the true one, its sign included.
#[test]
fn the_depth_ratio_has_the_sign_and_the_value_of_the_equation() {
    for seed in 0..5 {
        let scene = testing::scene(seed, 2, 20, 0.0);
        let k = Matrix3::from_diagonal(&Vector3::new(scene.intrinsics.focal, scene.intrinsics.focal, 1.0));
        let [from, to] = [0, 1].map(|view| &scene.poses[view]);
        let rotation = to.rotation * from.rotation.transpose();
        let (_, epipole) = truth(&scene);
        let matrix = epipole.cross_matrix() * k * rotation * k.try_inverse().expect("a focal length");
        let exact = Fundamental { matrix, epipole };
        for (track, seen) in matches_of(&scene).iter().enumerate() {
            let expected = depth(&scene, 1, track) / depth(&scene, 0, track);
            let found = exact.depth_ratio(seen).expect("not at the epipole");
            assert!((found / expected - 1.0).abs() < 1e-8, "seed {seed}, track {track}: {found} is not {expected}");
            let flipped = Fundamental { matrix: -matrix, epipole }.depth_ratio(seen).expect("not at the epipole");
            assert_eq!(flipped, -found);
        }
    }
}

#[test]
fn a_sampson_distance_is_the_noise_of_a_match() {
    let scene = testing::scene(3, 2, 2000, NOISE);
    let (matrix, epipole) = truth(&scene);
    let fundamental = Fundamental { matrix, epipole };
    let matches = matches_of(&scene);
    let mean = matches.iter().map(|seen| fundamental.sampson_squared(seen)).sum::<f64>() / matches.len() as f64;
    assert!((mean.sqrt() / NOISE - 1.0).abs() < 0.05, "{}", mean.sqrt());
    let within = matches.iter().filter(|seen| fundamental.sampson_squared(seen) < squared_gate(NOISE)).count();
    let inside = within as f64 / matches.len() as f64;
    assert!((inside - 0.95).abs() < 0.02, "{inside}");
}

#[test]
fn half_of_the_matches_may_be_wrong() {
    let mut all = 0;
    for seed in 0..10 {
        let scene = testing::scene(seed, 2, 100, NOISE);
        let mut matches = matches_of(&scene);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for seen in &mut matches[50..] {
            seen.to = Vector2::from_fn(|_, _| rng.random_range(-0.5..0.5));
        }
        let found = robust(&matches, NOISE, &mut rng, &StopToken::default()).expect("a matrix");
        let kept = found.inlier[..50].iter().filter(|&&inlier| inlier).count();
        let wrong = found.inlier[50..].iter().filter(|&&inlier| inlier).count();
        println!("seed {seed}: {kept} of 50 right, {wrong} of 50 wrong, cost {:.3}", found.cost);
        assert!(kept >= 38 && wrong <= 8, "seed {seed}: {kept} and {wrong}");
        all += kept;
    }
    // At most 47.5 a seed: the gate is the .95 quantile.
    assert!(all >= 440, "{all} of 500");
}

#[test]
fn hostile_matches_give_none() {
    let matches = matches_of(&testing::scene(1, 2, 9, 0.0));
    assert!(eight_point(&matches[..7], &[1.0; 7]).is_none());
    assert!(eight_point(&matches, &[1.0; 8]).is_none(), "a weight too few");
    assert!(eight_point(&matches, &[0.0; 9]).is_none(), "no weight at all");
    for wild in [f64::NAN, f64::INFINITY, 1e200] {
        let mut matches = matches.clone();
        matches[4].to.y = wild;
        assert!(eight_point(&matches, &[1.0; 9]).is_none_or(|found| found.matrix.iter().all(|x| x.is_finite())));
        assert!(eight_point(&matches, &[wild; 9]).is_none_or(|found| found.matrix.iter().all(|x| x.is_finite())));
    }
    let seen = Match { from: Vector2::zeros(), to: Vector2::zeros() };
    assert!(eight_point(&[seen; 9], &[1.0; 9]).is_none(), "one place");
    let at_epipole = Fundamental { matrix: Matrix3::zeros(), epipole: Vector3::z() };
    assert_eq!(at_epipole.depth_ratio(&seen), None);
    assert_eq!(at_epipole.sampson_squared(&seen), f64::INFINITY);
}

#[test]
fn the_matrix_of_two_cameras_is_zero_on_images_of_one_point() {
    let scene = testing::scene(7, 3, 20, 0.0);
    let (cameras, points) = testing::projectively_transformed(&scene, 7);
    let image = |view: usize, point: usize| {
        let seen = cameras[view] * points[point];
        seen.xy() / seen.z
    };
    let matrix = matrix_of_cameras(&cameras[0], &cameras[2]);
    for point in 0..points.len() {
        let (error, gradient_squared) = algebraic(&matrix, &Match { from: image(0, point), to: image(2, point) });
        assert!(error * error < 1e-16 * gradient_squared, "point {point}: {error}");
        let moved = Match { from: image(0, point), to: image(2, (point + 1) % points.len()) };
        let (error, gradient_squared) = algebraic(&matrix, &moved);
        assert!(error * error > 1e-8 * gradient_squared, "point {point}: {error}");
    }
    assert_eq!(matrix_of_cameras(&cameras[1], &cameras[1]), nalgebra::Matrix3::zeros());
}
