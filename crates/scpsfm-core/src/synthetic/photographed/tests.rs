//! What the generator promises: the truth projects to the right observations, as much is wrong as asked, and every seed
//! has a scene.

use std::collections::{HashMap, HashSet};

use nalgebra::{Matrix3, Vector3};

use super::*;
use crate::domain::{Input, Limits};

/// First seed of the drawn scenes.
const FIRST: u64 = 1_000;

fn generate(options: &PhotographedOptions) -> Photographed {
    Photographed::generate(options).unwrap_or_else(|error| panic!("seed {}: {error}", options.seed))
}

/// Small scenes of every seed, for what does not depend on their size.
fn small(seed: u64) -> PhotographedOptions {
    let mut options = PhotographedOptions::drawn(seed);
    options.views = options.views.min(20);
    options.tracks = 120;
    options.lifetime = (2, options.lifetime.1.min(options.views));
    options
}

/// Image of a track's point by the truth, written down independently of the generator's camera.
fn project(scene: &Photographed, view: usize, track: usize) -> [f64; 2] {
    let (truth, options) = (&scene.truth, &scene.options);
    let rotation = Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
    let seen = rotation * Vector3::from(truth.points[track]) + Vector3::from(truth.translations[view]);
    let (u, v) = (seen.x / seen.z, seen.y / seen.z);
    let radius = u.hypot(v);
    let [k1, k2] = options.radial;
    let scale = match options.lens {
        LensKind::Fisheye => radius.atan() / radius,
        _ => 1.0 + k1 * radius.powi(2) + k2 * radius.powi(4),
    };
    let focal_px = truth.focals_px[view];
    let [x, y] = truth.principal_point_px;
    [focal_px * scale * u + x, options.aspect * focal_px * scale * v + y]
}

/// Distance of an observation from the image of its track's point, in pixels.
fn off_px(scene: &Photographed, k: usize) -> f64 {
    let Photographed { input, .. } = scene;
    let [x, y] = project(scene, input.view[k] as usize, input.track[k] as usize);
    (input.x[k] - x).hypot(input.y[k] - y)
}

#[test]
fn every_seed_has_a_scene_whose_observations_are_inside_the_images() {
    for seed in FIRST..FIRST + 300 {
        let options = small(seed);
        let scene = generate(&options);
        let Photographed { input, truth, .. } = &scene;
        assert_eq!(input.track_count, options.tracks, "seed {seed}");
        let mut lengths = vec![0; options.tracks];
        for k in 0..input.x.len() {
            lengths[input.track[k] as usize] += 1;
            assert!(points::is_within([input.x[k], input.y[k]], 0.0), "seed {seed}, observation {k} is outside");
        }
        assert!(lengths.iter().all(|&length| length >= 2), "seed {seed}: {}", options.name());
        assert_eq!(truth.observation_right.len(), input.x.len());
        Input::new(input.clone(), &Limits::default(), "scene").unwrap_or_else(|error| panic!("seed {seed}: {error}"));
    }
}

#[test]
fn drawn_scenes_are_within_their_ranges_and_the_same_again() {
    for seed in FIRST..FIRST + 20 {
        let options = PhotographedOptions::drawn(seed);
        assert!((6..=60).contains(&options.views) && (300..=1500).contains(&options.tracks), "{options:?}");
        let text = serde_json::to_string(&options).expect("plain data");
        let read: PhotographedOptions = serde_json::from_str(&text).expect("JSON");
        assert_eq!(read, options);
        let (scene, again) = (generate(&options), generate(&read));
        assert_eq!((scene.input.x, scene.truth), (again.input.x, again.truth), "seed {seed}");
    }
}

#[test]
fn right_observations_are_the_images_of_their_points_with_the_noise_asked_for() {
    for seed in FIRST..FIRST + 100 {
        let scene = generate(&small(seed));
        let right = |k: &usize| scene.truth.observation_right[*k];
        let squares: Vec<f64> =
            (0..scene.input.x.len()).filter(right).map(|k| off_px(&scene, k).powi(2) / 2.0).collect();
        if squares.is_empty() {
            continue;
        }
        // 5 % of three times the core's standard deviation.
        let expected = scene.options.noise_px * 1.4f64.sqrt();
        let found = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        let tolerance = 6.0 / (squares.len() as f64).sqrt();
        let name = scene.options.name();
        assert!((found / expected - 1.0).abs() < tolerance, "seed {seed}, {name}: {found} px for {expected}");
        let far = squares.iter().filter(|square| square.sqrt() > 12.0 * scene.options.noise_px).count();
        assert_eq!(far, 0, "seed {seed}, {name}");
    }
}

#[test]
fn as_many_tracks_are_wrong_as_asked_and_what_is_wrong_is_off() {
    let of_motion = |motion| (FIRST..).map(small).find(move |options| options.motion == motion);
    for base in PhotographedMotion::ALL.into_iter().filter_map(of_motion) {
        for wrong in WrongKind::ALL {
            let scene = generate(&PhotographedOptions { wrong, wrong_share: 0.4, ..base.clone() });
            let (options, truth, input) = (&scene.options, &scene.truth, &scene.input);
            let name = options.name();
            let off: Vec<usize> = (0..input.x.len()).filter(|&k| !truth.observation_right[k]).collect();
            let tracks: HashSet<u32> = off.iter().map(|&k| input.track[k]).collect();
            let asked = if wrong == WrongKind::Clean { 0 } else { 48 };
            assert_eq!(tracks.len(), asked, "{name}");
            // Points of the second body are in its own frame.
            let of_scene = |k: &&usize| !truth.second_body[input.track[**k] as usize];
            let all: Vec<&usize> = off.iter().filter(of_scene).collect();
            let far = all.iter().filter(|&&&k| off_px(&scene, k) > 3.0 * options.noise_px).count();
            assert!(far as f64 >= 0.95 * all.len() as f64, "{name}: {far} of {} are off", all.len());
            let second = truth.second_body.iter().filter(|&&second| second).count();
            assert!(if wrong == WrongKind::SecondBody { second > 40 } else { second == 0 }, "{name}: {second}");
            let goes_over = truth.observation_of_other.contains(&true);
            assert_eq!(goes_over, wrong == WrongKind::WrongLink, "{name}");
        }
    }
}

#[test]
fn every_choice_occurs_about_equally_often() {
    for first in [0, 700_000, 12_345] {
        let mut counts: HashMap<(&str, &str), usize> = HashMap::new();
        for seed in first..first + 300 {
            let options = PhotographedOptions::drawn(seed);
            let values = [
                ("motion", options.motion.name()),
                ("lens", options.lens.name()),
                ("focal", options.focal.name()),
                ("visibility", options.visibility.name()),
                ("wrong", options.wrong.name()),
            ];
            values.into_iter().for_each(|value| *counts.entry(value).or_default() += 1);
        }
        let of = [("motion", 10), ("lens", 8), ("focal", 3), ("visibility", 2), ("wrong", 9)];
        for (choice, values) in of {
            let found: Vec<usize> = counts.iter().filter(|((of, _), _)| *of == choice).map(|(_, n)| *n).collect();
            assert_eq!(found.len(), values, "{choice} from seed {first}");
            let fair = 300 / values;
            assert!(found.iter().all(|count| count.abs_diff(fair) <= 2), "{choice} from seed {first}: {found:?}");
        }
    }
}

#[test]
fn motions_are_what_they_are_called() {
    for seed in FIRST..FIRST + 100 {
        let scene = generate(&small(seed));
        let truth = &scene.truth;
        let rotation = |view: usize| Matrix3::from_fn(|row, column| truth.rotations[view][row][column]);
        let centre = |view: usize| -(rotation(view).transpose() * Vector3::from(truth.translations[view]));
        let views = scene.options.views;
        let moved = (1..views).map(|view| (centre(view) - centre(0)).norm()).fold(0.0, f64::max);
        let turned = (1..views).map(|view| (rotation(view) - rotation(0)).norm()).fold(0.0, f64::max);
        let name = scene.options.name();
        match scene.options.motion {
            PhotographedMotion::PureRotation => assert!(moved < 1e-12 && turned > 0.05, "{name}: {moved}, {turned}"),
            PhotographedMotion::NearRotation => assert!(moved > 0.0 && moved < 0.9, "{name}: {moved}"),
            PhotographedMotion::Translation => assert!(moved > 0.3 && turned < 1e-12, "{name}: {moved}, {turned}"),
            PhotographedMotion::PlanarScene => {
                let inlier = (0..scene.options.tracks).filter(|&track| truth.inlier[track]);
                let off = inlier.map(|track| truth.points[track][2].abs()).fold(0.0, f64::max);
                assert!(off < 1e-9, "{name}: {off} off the plane");
            }
            _ => assert!(moved > 0.5 && turned > 0.02, "{name}: {moved}, {turned}"),
        }
    }
}

#[test]
fn every_option_out_of_range_is_named() {
    let base = || small(FIRST);
    let cases = [
        ("views", PhotographedOptions { views: 1, ..base() }),
        ("tracks", PhotographedOptions { tracks: 0, ..base() }),
        ("turn_rad", PhotographedOptions { turn_rad: -0.1, ..base() }),
        ("baseline", PhotographedOptions { baseline: 0.6, ..base() }),
        ("focal_px", PhotographedOptions { focal_px: f64::NAN, ..base() }),
        ("focal_ratio", PhotographedOptions { focal_ratio: 0.0, ..base() }),
        ("principal_point", PhotographedOptions { principal_point: [0.0, 0.4], ..base() }),
        ("aspect", PhotographedOptions { aspect: 3.0, ..base() }),
        ("noise_px", PhotographedOptions { noise_px: -1.0, ..base() }),
        ("seen_share", PhotographedOptions { seen_share: 0.0, ..base() }),
        ("lifetime", PhotographedOptions { lifetime: (4, 3), ..base() }),
        ("wrong_share", PhotographedOptions { wrong_share: 1.1, ..base() }),
        ("radial", PhotographedOptions { lens: LensKind::Barrel, radial: [-1.0, 0.0], ..base() }),
    ];
    for (name, options) in cases {
        let error = Photographed::generate(&options).expect_err(name);
        assert_eq!(error.violations().len(), 1, "{error}");
        assert_eq!(error.violations()[0].field, name, "{error}");
    }
}
