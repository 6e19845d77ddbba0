//! Motions and scenes that carry no calibration.

use nalgebra::Vector2;

use super::*;

#[test]
fn critical_motions_and_scenes_are_refused() {
    let translation: &[&str] = &["PURE_TRANSLATION", "UNOBSERVABLE_FOCAL"];
    for (name, motion, planar, expected) in [
        ("translation", Motion::Translation, false, translation),
        ("forward", Motion::Forward, false, translation),
        ("rotation", Motion::Rotation, false, &["PURE_ROTATION"]),
        ("plane", Motion::General, true, &["PLANAR_SCENE"]),
        ("translation before a plane", Motion::Translation, true, &["PLANAR_SCENE"]),
    ] {
        for (tracks, seeds) in [(20, 20), (60, 5)] {
            for seed in 0..seeds {
                let scene = testing::scene_of(seed, 10, tracks, NOISE, motion, planar);
                let outcome = calibrated(&scene, seed, NOISE);
                println!("{name}, {tracks} tracks, seed {seed}: {:?}, {:?}", outcome.grade, outcome.warnings);
                assert_eq!(outcome.grade, Grade::ProjectiveOnly, "{name}, seed {seed}");
                assert_eq!(codes(&outcome), expected, "{name}, {tracks} tracks, seed {seed}: {:?}", outcome.warnings);
                let on_the_axis = outcome.warnings[0].detail.contains("optical axis");
                assert_eq!(on_the_axis, motion == Motion::Forward, "{name}, seed {seed}: {:?}", outcome.warnings);
            }
        }
    }
}

#[test]
fn a_rotation_is_told_from_a_plane_with_an_unknown_principal_point_too() {
    for seed in 0..10 {
        let mut scene = testing::scene_of(seed, 6, 30, 0.0, Motion::Rotation, false);
        scene.intrinsics.principal_point = Vector2::new(0.04, -0.03);
        scene.observe(0.001, &mut rand::SeedableRng::seed_from_u64(seed));
        assert_eq!(codes(&calibrated(&scene, seed, 0.001)), ["PURE_ROTATION"], "seed {seed}");
    }
}

#[test]
fn a_camera_that_stands_still_may_do_anything() {
    for seed in 0..5 {
        let mut scene = testing::scene_of(seed, 6, 30, 0.0, Motion::Rotation, false);
        scene.poses = vec![scene.poses[0]; 6];
        scene.observe(NOISE, &mut rand::SeedableRng::seed_from_u64(seed));
        let outcome = calibrated(&scene, seed, NOISE);
        assert_eq!(codes(&outcome), ["PLANAR_OR_ROTATION"], "seed {seed}: {:?}", outcome.warnings);
    }
}
