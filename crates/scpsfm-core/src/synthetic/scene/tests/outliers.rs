//! What is called wrong is wrong, in the way that was asked for, and nothing else is.

use nalgebra::{Matrix3x4, Vector2, Vector3};

use super::*;
use crate::geometry::observation::Observation;
use crate::geometry::triangulation;

const KINDS: [OutlierKind; 4] = [OutlierKind::Permuted, OutlierKind::Uniform, OutlierKind::Slid, OutlierKind::Repeated];

/// A scene without noise, half of whose tracks are outliers of this kind.
fn scene_of(outlier_kind: OutlierKind, wrong_views: usize, seed: u64) -> Scene {
    generate(SceneOptions { outliers: 0.5, outlier_kind, wrong_views, ..exact(seed) })
}

fn indices(flags: &[bool], wanted: bool) -> Vec<usize> {
    (0..flags.len()).filter(|&k| flags[k] == wanted).collect()
}

/// Views in which the truth calls an observation of this track wrong.
fn wrong_views(scene: &Scene, track: usize) -> Vec<usize> {
    (0..scene.options.views).filter(|&view| !scene.truth.is_right(view, track)).collect()
}

/// World to normalised camera coordinates.
fn cameras(scene: &Scene) -> Vec<Matrix3x4<f64>> {
    let camera = |view| {
        let mut pose = Matrix3x4::zeros();
        pose.fixed_columns_mut::<3>(0).copy_from(&rotation(scene, view));
        pose.set_column(3, &translation(scene, view));
        pose
    };
    (0..scene.options.views).map(camera).collect()
}

/// Root mean square reprojection error in pixels of the point that explains a track best.
fn triangulation_error_px(scene: &Scene, track: usize) -> f64 {
    let cameras = cameras(scene);
    let observation = |view| {
        let [x, y, _] = observed(scene, view, track);
        let ray = calibration(scene, view).try_inverse().expect("regular") * Vector3::new(x, y, 1.0);
        Observation::new(view, 0, Vector2::new(ray.x, ray.y))
    };
    let observations: Vec<Observation> = (0..cameras.len()).map(observation).collect();
    let start = triangulation::linear(&cameras, &observations);
    let (_, cost) = triangulation::refine(&cameras, &observations, start, 50);
    (cost / observations.len() as f64).sqrt() * scene.truth.focal_px
}

#[test]
fn an_observation_is_called_wrong_where_it_is_elsewhere() {
    for (kind, wrong_views) in KINDS.into_iter().flat_map(|kind| [0, 1, 2, 5, 9].map(|views| (kind, views))) {
        for seed in SEEDS {
            let scene = scene_of(kind, wrong_views, seed);
            for view in 0..scene.options.views {
                for track in 0..scene.options.tracks {
                    let (right, off) = (scene.truth.is_right(view, track), error_px(&scene, view, track));
                    assert_eq!(off < EXACT_PX, right, "{kind:?} {wrong_views} seed {seed} {view} {track}: {off} px");
                    assert!(right || !scene.truth.inlier[track], "{kind:?} seed {seed}: inlier {track} is wrong");
                }
            }
        }
    }
}

#[test]
fn an_outlier_is_wrong_in_as_many_views_as_asked_for() {
    for (kind, seed) in KINDS.into_iter().flat_map(|kind| SEEDS.map(move |seed| (kind, seed))) {
        for count in [0, 1, 2, 5, 9] {
            let scene = scene_of(kind, count, seed);
            let outliers = indices(&scene.truth.inlier, false);
            assert_eq!(outliers.len(), 100);
            let wrong: Vec<Vec<usize>> = outliers.iter().map(|&track| wrong_views(&scene, track)).collect();
            let expected = match (count, kind) {
                // A permutation of 100 leaves 1 of them in place on average.
                (0, OutlierKind::Permuted) => {
                    let kept = outliers.len() * 10 - wrong.iter().map(Vec::len).sum::<usize>();
                    assert!((1..30).contains(&kept), "seed {seed}: {kept} of 1000 kept");
                    continue;
                }
                (0, OutlierKind::Uniform) => 10,
                (0, OutlierKind::Slid) => 9,
                (0, OutlierKind::Repeated) => 5,
                (count, _) => count,
            };
            assert!(wrong.iter().all(|views| views.len() == expected), "{kind:?} {count} seed {seed}: {wrong:?}");
            for view in usize::from(kind == OutlierKind::Slid)..10 {
                assert!(wrong.iter().any(|views| views.contains(&view)), "{kind:?} seed {seed}: {view} never wrong");
            }
        }
    }
}

#[test]
fn a_lone_outlier_gets_a_point_of_another_track() {
    for seed in SEEDS {
        let options = SceneOptions { tracks: 2, outliers: 0.5, wrong_views: 3, ..exact(seed) };
        let scene = generate(options);
        let track = indices(&scene.truth.inlier, false)[0];
        let wrong = wrong_views(&scene, track);
        assert_eq!(wrong.len(), 3, "seed {seed}");
        for view in wrong {
            assert_eq!(observed(&scene, view, track), observed(&scene, view, 1 - track), "seed {seed}");
        }
    }
}

#[test]
fn permuted_points_are_those_of_the_same_view() {
    for (wrong_views, seed) in [0, 5].into_iter().flat_map(|views| SEEDS.map(move |seed| (views, seed))) {
        let (clean, scene) = (generate(exact(seed)), scene_of(OutlierKind::Permuted, wrong_views, seed));
        for view in 0..scene.options.views {
            let sorted = |scene: &Scene| {
                let mut all: Vec<[f64; 3]> = (0..200).map(|track| observed(scene, view, track)).collect();
                all.sort_by(|a, b| a[0].total_cmp(&b[0]));
                all
            };
            assert_eq!(sorted(&scene), sorted(&clean), "{wrong_views} wrong views, seed {seed}, view {view}");
        }
    }
}

#[test]
fn uniform_points_fill_the_image() {
    let scene = generate(SceneOptions { outliers: 1.0, outlier_kind: OutlierKind::Uniform, ..exact(0) });
    for (name, values) in [("x", &scene.input.x), ("y", &scene.input.y)] {
        assert!(values.iter().all(|value| (-0.5..999.5).contains(value)), "{name}");
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let deviation = (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt();
        // Of 2000 samples: 5 standard errors.
        assert!((mean - 499.5).abs() < 33.0 && (deviation - 288.7).abs() < 15.0, "{name}: {mean} +- {deviation}");
    }
}

#[test]
fn slid_points_keep_the_epipolar_constraint_with_view_0_and_no_point_explains_them() {
    for seed in SEEDS {
        let scene = scene_of(OutlierKind::Slid, 0, seed);
        for track in indices(&scene.truth.inlier, false) {
            for view in 1..scene.options.views {
                let relative = rotation(&scene, view) * rotation(&scene, 0).transpose();
                let shift = translation(&scene, view) - relative * translation(&scene, 0);
                let inverse = |view| calibration(&scene, view).try_inverse().expect("regular");
                let fundamental = inverse(view).transpose() * shift.cross_matrix() * relative * inverse(0);
                let ([x0, y0, _], [x, y, _]) = (observed(&scene, 0, track), observed(&scene, view, track));
                let line = fundamental * Vector3::new(x0, y0, 1.0);
                let off_px = line.dot(&Vector3::new(x, y, 1.0)).abs() / line.xy().norm();
                assert!(off_px < 1e-6, "seed {seed}, view {view}, track {track}: {off_px} px off the epipolar line");
            }
            let error = triangulation_error_px(&scene, track);
            assert!(error > 5.0, "seed {seed}, track {track}: a point explains all views within {error} px");
        }
        for track in indices(&scene.truth.inlier, true) {
            let error = triangulation_error_px(&scene, track);
            assert!(error < 1e-5, "seed {seed}, inlier {track}: {error} px");
        }
    }
}

#[test]
fn repeated_structure_shifts_all_alike() {
    for seed in SEEDS {
        let scene = scene_of(OutlierKind::Repeated, 0, seed);
        let clean = generate(exact(seed));
        let mut shifts = Vec::new();
        for track in indices(&scene.truth.inlier, false) {
            for view in wrong_views(&scene, track) {
                let ([x, y, depth], [own_x, own_y, own_depth]) =
                    (observed(&scene, view, track), observed(&clean, view, track));
                shifts.push(Vector2::new(x - own_x, y - own_y));
                assert_eq!(depth, own_depth);
            }
        }
        let size = shifts[0].norm();
        assert!((100.0..200.0).contains(&size), "seed {seed}: shifted by {size} px");
        assert!(shifts.iter().all(|shift| (shift - shifts[0]).norm() < EXACT_PX), "seed {seed}: {shifts:?}");
    }
}

/// Largest change over the views of the distance between two points in camera coordinates.
fn distance_change(scene: &Scene, track: usize, other: usize) -> f64 {
    let position = |view, track| {
        let [x, y, depth] = observed(scene, view, track);
        calibration(scene, view).try_inverse().expect("regular") * Vector3::new(x, y, 1.0) * depth
    };
    let distances: Vec<f64> =
        (0..scene.options.views).map(|view| (position(view, track) - position(view, other)).norm()).collect();
    let spread = |fold: fn(f64, f64) -> f64| distances.iter().copied().reduce(fold).expect("views");
    spread(f64::max) - spread(f64::min)
}

#[test]
fn each_body_is_rigid_and_the_two_are_not() {
    for seed in SEEDS {
        let scene = generate(SceneOptions { outliers: 0.6, second_motion: 0.3, ..exact(seed) });
        let second = indices(&scene.truth.second_body, true);
        let first = indices(&scene.truth.inlier, true);
        assert_eq!((second.len(), first.len()), (60, 80));
        assert!(second.iter().all(|&track| !scene.truth.inlier[track] && wrong_views(&scene, track).len() == 10));
        for body in [&first, &second] {
            for pair in body.windows(2) {
                let change = distance_change(&scene, pair[0], pair[1]);
                assert!(change < 1e-9, "seed {seed}: {pair:?} of one body move apart by {change}");
            }
        }
        let between: Vec<f64> = first.iter().zip(&second).map(|(&a, &b)| distance_change(&scene, a, b)).collect();
        let mean = between.iter().sum::<f64>() / between.len() as f64;
        assert!(mean > 0.2, "seed {seed}: tracks of two bodies move apart by {mean} only");
        let rest = (0..200).filter(|track| !first.contains(track) && !second.contains(track));
        assert_eq!(rest.filter(|&track| wrong_views(&scene, track).len() >= 8).count(), 60);
    }
}

#[test]
fn what_is_wrong_leaves_the_rest_as_it_is() {
    let paper = SceneOptions { outliers: 0.5, with_depths: true, ..SceneOptions::default() };
    let base = generate(paper.clone());
    let mut others: Vec<SceneOptions> = Vec::new();
    for (outlier_kind, wrong_views) in KINDS.into_iter().flat_map(|kind| [(kind, 0), (kind, 2)]) {
        others.push(SceneOptions { outlier_kind, wrong_views, ..paper.clone() });
    }
    others.push(SceneOptions { second_motion: 0.2, ..paper });
    for options in others {
        let scene = generate(options.clone());
        assert_eq!(scene.truth.inlier, base.truth.inlier, "{options:?}");
        for track in indices(&scene.truth.inlier, true) {
            for view in 0..scene.options.views {
                assert_eq!(observed(&scene, view, track), observed(&base, view, track), "{options:?}");
            }
        }
    }
}

#[test]
fn every_right_track_is_wrong_in_as_many_random_views_as_asked_for_and_the_rest_stays() {
    for (wrong_observations, seed) in [1, 3, 7].into_iter().flat_map(|count| SEEDS.map(move |seed| (count, seed))) {
        let base = SceneOptions { outliers: 0.5, ..exact(seed) };
        let (clean, scene) = (generate(base.clone()), generate(SceneOptions { wrong_observations, ..base }));
        assert_eq!(scene.truth.inlier, clean.truth.inlier);
        let mut wrong_in = [0; 10];
        for track in indices(&scene.truth.inlier, true) {
            let wrong = wrong_views(&scene, track);
            assert_eq!(wrong.len(), wrong_observations, "seed {seed}, track {track}");
            wrong.iter().for_each(|&view| wrong_in[view] += 1);
            for view in 0..10 {
                let off = error_px(&scene, view, track);
                assert_eq!(off < EXACT_PX, !wrong.contains(&view), "seed {seed}, {view}, {track}: {off} px");
                let [x, y, _] = observed(&scene, view, track);
                assert!(!wrong.contains(&view) || [x, y].iter().all(|xy| (-0.5..999.5).contains(xy)));
            }
        }
        assert!(wrong_in.iter().all(|&count| count > 0 && count < 100), "{wrong_in:?}");
        for track in indices(&scene.truth.inlier, false) {
            assert_eq!(wrong_views(&scene, track), wrong_views(&clean, track));
            assert!((0..10).all(|view| observed(&scene, view, track) == observed(&clean, view, track)));
        }
    }
}

#[test]
fn deleted_observations_are_some_of_each_track_and_the_rest_stays() {
    for seed in SEEDS {
        let base = SceneOptions { outliers: 0.3, wrong_observations: 2, ..exact(seed) };
        let complete = generate(base.clone());
        let scene = generate(SceneOptions { deleted_observations: 3, ..base });
        let (mut kept, mut wrong) = ([0; 200], 0);
        for (k, (&view, &track)) in scene.input.view.iter().zip(&scene.input.track).enumerate() {
            let (view, track) = (view as usize, track as usize);
            kept[track] += 1;
            let here = [scene.input.x[k], scene.input.y[k], scene.input.depth[k]];
            assert_eq!(here, observed(&complete, view, track), "seed {seed}");
            assert_eq!(scene.truth.observation_right[k], complete.truth.is_right(view, track), "seed {seed}");
            wrong += usize::from(!scene.truth.observation_right[k] && scene.truth.inlier[track]);
        }
        assert_eq!((kept, scene.truth.observation_right.len()), ([7; 200], 1400));
        // Of 280 wrong observations of right tracks, .7 stay: within four standard deviations.
        assert!((165..=227).contains(&wrong), "seed {seed}: {wrong}");
    }
}
