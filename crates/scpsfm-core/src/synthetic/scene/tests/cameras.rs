//! Calibrations other than the paper's show in the images as they are documented.

use super::*;

/// The distance from the centre that a lens with this coefficient maps to `distorted`: Newton's method on
/// `r + k1 r^3`.
fn undistorted_radius(k1: f64, distorted: f64) -> f64 {
    (0..50).fold(distorted.min(1.0), |r, _| r - (r + k1 * r.powi(3) - distorted) / (1.0 + 3.0 * k1 * r * r))
}

#[test]
fn undistorted_observations_are_the_pinholes_and_distorted_ones_are_not() {
    for (radial_k1, seed) in [-0.1, -0.05, 0.1].into_iter().flat_map(|k1| SEEDS.map(move |seed| (k1, seed))) {
        let scene = generate(SceneOptions { radial_k1, ..exact(seed) });
        let focal = scene.truth.focal_px;
        let [px, py] = scene.truth.principal_point_px;
        let mut moved = 0.0f64;
        for (view, track) in (0..10).flat_map(|view| (0..200).map(move |track| (view, track))) {
            let [x, y, depth] = observed(&scene, view, track);
            let seen = seen(&scene, view, track);
            assert_eq!(depth, seen.z);
            let distorted = (x - px).hypot(y - py) / focal;
            let shrink = undistorted_radius(radial_k1, distorted) / distorted;
            let (u, v) = (px + (x - px) * shrink, py + (y - py) * shrink);
            let off = (px + focal * seen.x / seen.z - u).hypot(py + focal * seen.y / seen.z - v);
            assert!(off < 1e-6, "k1 {radial_k1}, seed {seed}, view {view}, track {track}: {off} px");
            moved = moved.max((x - u).hypot(y - v));
        }
        assert!(moved > 10.0, "k1 {radial_k1}, seed {seed}: distorted by {moved} px at most");
    }
}

#[test]
fn farther_points_stay_farther_however_strong_the_distortion() {
    for seed in SEEDS {
        let scene = generate(SceneOptions { radial_k1: -0.1, ..exact(seed) });
        for view in 0..scene.options.views {
            let [px, py] = scene.truth.principal_point_px;
            let mut radii: Vec<(f64, f64)> = (0..scene.options.tracks)
                .map(|track| {
                    let ([x, y, _], seen) = (observed(&scene, view, track), seen(&scene, view, track));
                    (seen.x.hypot(seen.y) / seen.z, (x - px).hypot(y - py))
                })
                .collect();
            radii.sort_by(|a, b| a.0.total_cmp(&b.0));
            assert!(radii.windows(2).all(|pair| pair[0].1 < pair[1].1), "seed {seed}, view {view}");
        }
    }
}

#[test]
fn a_displaced_principal_point_shifts_every_observation() {
    for seed in SEEDS {
        let scene = generate(SceneOptions { principal_point: [0.05, -0.1], ..exact(seed) });
        let clean = generate(exact(seed));
        assert_eq!(scene.truth.principal_point_px, [549.5, 399.5]);
        for (x, clean_x) in scene.input.x.iter().zip(&clean.input.x) {
            assert!((x - clean_x - 50.0).abs() < EXACT_PX, "seed {seed}");
        }
        for (y, clean_y) in scene.input.y.iter().zip(&clean.input.y) {
            assert!((y - clean_y + 100.0).abs() < EXACT_PX, "seed {seed}");
        }
    }
}

#[test]
fn a_zoom_gives_each_view_a_focal_length_of_its_own() {
    for seed in SEEDS {
        let scene = generate(SceneOptions { zoom: 0.3, ..exact(seed) });
        let ratios: Vec<f64> = scene.truth.focals_px.iter().map(|focal| focal / scene.truth.focal_px).collect();
        assert_eq!(ratios.len(), scene.options.views);
        assert!(ratios.iter().all(|ratio| (0.7..1.3).contains(ratio)), "seed {seed}: {ratios:?}");
        let spread = |fold: fn(f64, f64) -> f64| ratios.iter().copied().reduce(fold).expect("views");
        assert!(spread(f64::max) - spread(f64::min) > 0.2, "seed {seed}: {ratios:?}");
        for (view, track) in (0..10).flat_map(|view| (0..200).map(move |track| (view, track))) {
            assert!(error_px(&scene, view, track) < EXACT_PX, "seed {seed}, view {view}, track {track}");
        }
        let constant = generate(exact(seed));
        assert_eq!(constant.truth.focals_px, vec![constant.truth.focal_px; 10]);
        assert_eq!(constant.truth.points, scene.truth.points);
    }
}

#[test]
fn noise_of_every_kind_has_its_size_in_pixels_and_in_depths() {
    let sizes = [
        (NoiseKind::Gaussian, 1.0),
        (NoiseKind::Laplace, 1.0),
        (NoiseKind::Heavy, 1.8f64.sqrt()),
        (NoiseKind::Uniform, 1.0),
    ];
    for (noise_kind, size) in sizes {
        let clean = generate(exact(1));
        let scene = generate(SceneOptions { noise: 0.01, noise_kind, ..exact(1) });
        let of = |noisy: &[f64], clean: &[f64], relative: bool| {
            let squares = noisy.iter().zip(clean).map(|(a, b)| ((a - b) / if relative { *b } else { 1.0 }).powi(2));
            (squares.sum::<f64>() / noisy.len() as f64).sqrt()
        };
        // Of 2000 samples each: 5 standard errors of the heaviest tails.
        let near = |found: f64, expected: f64| (found / expected - 1.0).abs() < 0.15;
        let found = [
            of(&scene.input.x, &clean.input.x, false) / 10.0,
            of(&scene.input.y, &clean.input.y, false) / 10.0,
            of(&scene.input.depth, &clean.input.depth, true) / 0.01,
        ];
        assert!(found.iter().all(|&found| near(found, size)), "{noise_kind:?}: {found:?} instead of {size}");
    }
}

#[test]
fn own_cameras_project_by_what_the_truth_says_of_each_view() {
    for seed in SEEDS {
        let options =
            SceneOptions { own_cameras: true, focal_range_px: (600.0, 650.0), radial_k1: -0.2, ..exact(seed) };
        let scene = generate(options);
        let truth = &scene.truth;
        for (view, track) in (0..10).flat_map(|view| (0..200).map(move |track| (view, track))) {
            let ([x, y, _], uv) = (observed(&scene, view, track), seen(&scene, view, track));
            let uv = uv.xy() / uv.z;
            let scaled = truth.focals_px[view] * (1.0 + truth.radial_k1[view] * uv.norm_squared()) * uv;
            let [px, py] = truth.principal_points_px[view];
            assert!((scaled.x + px - x).hypot(scaled.y + py - y) < EXACT_PX, "seed {seed}, view {view}");
        }
        let groups: Vec<u32> = scene.input.views.iter().map(|view| view.camera_group).collect();
        assert_eq!(groups, (0..10).collect::<Vec<u32>>());
        assert!(truth.focals_px.windows(2).all(|pair| pair[0] != pair[1] && (600.0..650.0).contains(&pair[0])));
        let points = truth.principal_points_px.iter().flatten();
        assert!(points.into_iter().all(|xy| (xy - 499.5).abs() <= 20.0), "seed {seed}");
        assert!(truth.radial_k1.iter().all(|k1| (k1 + 0.2).abs() <= 0.0101), "seed {seed}");
    }
}
