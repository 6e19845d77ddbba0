//! Tests of whole scenes, by subject, and what they share.

mod cameras;
mod motions;
mod outliers;

use nalgebra::{Matrix3, Vector3};

use super::*;
use crate::domain::{Input, Limits};

/// Pixels by which exact observations may differ from the projections of their points: rounding.
const EXACT_PX: f64 = 1e-8;

/// Seeds of the tests that hold for every scene; each failure names its own.
const SEEDS: std::ops::Range<u64> = 0..5;

fn generate(options: SceneOptions) -> Scene {
    let scene = Scene::generate(&options).unwrap_or_else(|error| panic!("{options:?}: {error}"));
    Input::new(scene.input.clone(), &Limits::default(), "scene").expect("a valid input");
    scene
}

/// Options of a scene whose observations are all exact, with depths.
fn exact(seed: u64) -> SceneOptions {
    SceneOptions { noise: 0.0, outliers: 0.0, with_depths: true, seed, ..SceneOptions::default() }
}

/// The observation of a track in a view: x and y in pixels, and the depth.
fn observed(scene: &Scene, view: usize, track: usize) -> [f64; 3] {
    let k = view * scene.options.tracks + track;
    assert_eq!((scene.input.view[k], scene.input.track[k]), (view as u32, track as u32));
    [scene.input.x[k], scene.input.y[k], scene.input.depth[k]]
}

fn rotation(scene: &Scene, view: usize) -> Matrix3<f64> {
    Matrix3::from_fn(|row, column| scene.truth.rotations[view][row][column])
}

fn translation(scene: &Scene, view: usize) -> Vector3<f64> {
    Vector3::from(scene.truth.translations[view])
}

/// A track's own point in the coordinates of a camera.
fn seen(scene: &Scene, view: usize, track: usize) -> Vector3<f64> {
    rotation(scene, view) * Vector3::from(scene.truth.points[track]) + translation(scene, view)
}

/// The calibration matrix of a view.
fn calibration(scene: &Scene, view: usize) -> Matrix3<f64> {
    let focal = scene.truth.focals_px[view];
    let [x, y] = scene.truth.principal_point_px;
    Matrix3::new(focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0)
}

/// Distance in pixels between an observation and the projection of the track's own point by a pinhole camera.
fn error_px(scene: &Scene, view: usize, track: usize) -> f64 {
    let [x, y, _] = observed(scene, view, track);
    let image = calibration(scene, view) * seen(scene, view, track);
    (image.x / image.z - x).hypot(image.y / image.z - y)
}

#[test]
fn inliers_project_to_their_observations_and_outliers_do_not() {
    let scene = generate(SceneOptions { outliers: 0.9, ..exact(0) });
    let (views, tracks) = (scene.options.views, scene.options.tracks);
    let near = |track| (0..views).all(|view| error_px(&scene, view, track) < EXACT_PX);
    assert_eq!((0..tracks).map(near).collect::<Vec<_>>(), scene.truth.inlier);
    assert_eq!(scene.truth.inlier.iter().filter(|&&inlier| inlier).count(), 20);
}

#[test]
fn one_seed_one_scene() {
    let generate = |seed| generate(SceneOptions { seed, ..SceneOptions::default() }).input.x;
    assert_eq!(generate(3), generate(3));
    assert_ne!(generate(3), generate(4));
}

/// What is known of two of the paper's scenes from the day when there were no others: results that were measured on
/// them must stay comparable. Samples instead of a digest, since the last bits of logarithms and cosines are the
/// platform's; a random number more or less anywhere changes the last observation altogether.
#[test]
fn the_papers_scenes_stay_what_they_were() {
    type Samples = [(usize, [f64; 3]); 3];
    let cases: [(f64, u64, f64, [usize; 20], Samples); 2] = [
        (
            0.4,
            0,
            1367.2603323412495,
            [27, 36, 54, 57, 76, 77, 87, 90, 117, 125, 136, 137, 143, 146, 147, 148, 162, 166, 172, 176],
            [
                (0, [834.9983467095718, 76.34163970124023, 3.141018573699943]),
                (999, [1083.3529345645509, -521.457061984585, 1.742267426865582]),
                (1999, [144.93852777964452, 1683.2858299059606, 2.1456070689092064]),
            ],
        ),
        (
            3.1,
            7,
            926.2368776164955,
            [7, 11, 26, 40, 48, 55, 77, 91, 106, 108, 112, 116, 119, 127, 136, 144, 150, 158, 180, 192],
            [
                (0, [563.4701007273984, 855.4990541420854, 2.6284970618660295]),
                (999, [150.5433758082608, 1406.6693504229029, 1.5069751829156095]),
                (1999, [609.0715369152846, 355.496838252269, 2.880502779123632]),
            ],
        ),
    ];
    for (max_rotation_rad, seed, focal_px, inliers, samples) in cases {
        let Scene { input, truth, .. } =
            generate(SceneOptions { max_rotation_rad, seed, with_depths: true, ..SceneOptions::default() });
        let near = |found: f64, known: f64| (found - known).abs() < EXACT_PX;
        assert!(near(truth.focal_px, focal_px), "seed {seed}: {}", truth.focal_px);
        let found: Vec<usize> = (0..200).filter(|&track| truth.inlier[track]).collect();
        assert_eq!(found, inliers, "seed {seed}");
        for (k, known) in samples {
            let found = [input.x[k], input.y[k], input.depth[k]];
            assert!(found.iter().zip(known).all(|(&found, known)| near(found, known)), "seed {seed}, {k}: {found:?}");
        }
    }
}
