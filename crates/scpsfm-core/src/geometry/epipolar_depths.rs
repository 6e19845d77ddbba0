//! Projective depths from epipolar geometry (Sturm & Triggs 1996): what completes a measurement matrix of real tracks.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::fundamental::{self, Fundamental, Match};
use super::measurement::CompleteBlock;
use super::statistics::median;
use crate::domain::StopToken;

/// Tracks that a fundamental matrix is estimated from at most, evenly spread: two thousand determine its seven unknowns
/// far better than the noise of any one depth.
const MOST_MATCHES: usize = 2_000;
/// Largest depth, and inverse of the smallest, relative to the median of its view: beyond it a point is so near the
/// epipole that its depth is noise, and would outweigh the rest of its track.
const MOST_RELATIVE_DEPTH: f64 = 100.0;

/// Depths of every point of a block, `depths[track * views + view]`, up to one factor a view and one a track.
///
/// Every view is tied to one reference view by its own fundamental matrix, instead of to its predecessor: errors do not
/// add up along the views, and an observation that is wrong spoils its own depth only, unless it is the reference's.
/// First, middle and last view take their turn as the reference; the one whose matrices explain most counts. Its own
/// depths are 1; those of every other view are [`fundamental::Fundamental::depth_ratio`]s, divided by their median over
/// the matches that agree with the matrix. Matches on the wrong side of a camera, outliers as a rule, have negative
/// depths; at an epipole, where depth is undetermined, it is the median, 1.
///
/// * `noise`: standard deviation of a coordinate
/// * `seed`: of the samples drawn
///
/// Returns `None` for fewer than two views, fewer than eight tracks, a pair of views without a fundamental matrix, or
/// once `stop` fires.
///
/// # Pitfall
/// Where fewer than about half of the tracks are right the matrices are those of outliers, and so are the depths: worse
/// than depths of 1.
pub fn epipolar_depths(block: &CompleteBlock, noise: f64, seed: u64, stop: &StopToken) -> Option<Vec<f64>> {
    let views = block.views();
    if views < 2 {
        return None;
    }
    let mut references = vec![0, views / 2, views - 1];
    references.dedup();
    let stars = references.into_iter().filter_map(|reference| star(block, reference, noise, seed, stop));
    let best = stars.min_by(|a, b| a.cost.total_cmp(&b.cost)).filter(|_| !stop.is_stopped())?;
    let mut depths = vec![1.0; views * block.tracks()];
    for (view, fundamental) in &best.matrices {
        let of_view = depths_in_view(block, best.reference, *view, fundamental, noise);
        of_view.into_iter().enumerate().for_each(|(track, depth)| depths[track * views + view] = depth);
    }
    Some(depths)
}

/// Fundamental matrices from a reference view to every other one, with the sum of their costs.
struct Star {
    reference: usize,
    cost: f64,
    matrices: Vec<(usize, Fundamental)>,
}

fn star(block: &CompleteBlock, reference: usize, noise: f64, seed: u64, stop: &StopToken) -> Option<Star> {
    let mut star = Star { reference, cost: 0.0, matrices: Vec::new() };
    for view in (0..block.views()).filter(|&view| view != reference) {
        let count = block.tracks().min(MOST_MATCHES);
        let matches: Vec<Match> =
            (0..count).map(|k| match_of(block, reference, view, k * block.tracks() / count)).collect();
        // A stream of its own for every pair: what one draws does not move the others.
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream((reference * block.views() + view) as u64);
        let robust = fundamental::robust(&matches, noise, &mut rng, stop)?;
        star.cost += robust.cost;
        star.matrices.push((view, robust.model));
    }
    Some(star)
}

fn match_of(block: &CompleteBlock, from: usize, to: usize, track: usize) -> Match {
    Match { from: block.point(from, track), to: block.point(to, track) }
}

/// Depths of all tracks in one view where those in the reference view are 1: median 1 over the matches that agree.
fn depths_in_view(
    block: &CompleteBlock,
    reference: usize,
    view: usize,
    fundamental: &Fundamental,
    noise: f64,
) -> Vec<f64> {
    let gate = fundamental::squared_gate(noise);
    let seen = |track| match_of(block, reference, view, track);
    let ratios: Vec<Option<f64>> = (0..block.tracks()).map(|track| fundamental.depth_ratio(&seen(track))).collect();
    let mut agreeing: Vec<f64> = (0..block.tracks())
        .filter(|&track| fundamental.sampson_squared(&seen(track)) < gate)
        .filter_map(|track| ratios[track])
        .collect();
    // The sign of F is arbitrary; what agrees is in front of both cameras.
    let behind = agreeing.iter().filter(|ratio| **ratio < 0.0).count();
    let sign = if 2 * behind > agreeing.len() { -1.0 } else { 1.0 };
    agreeing.iter_mut().for_each(|ratio| *ratio = ratio.abs());
    let scale = median(&mut agreeing);
    let unit = if scale > f64::MIN_POSITIVE { sign / scale } else { sign };
    let bounded = |ratio: f64| {
        let relative = ratio * unit;
        relative.abs().clamp(MOST_RELATIVE_DEPTH.recip(), MOST_RELATIVE_DEPTH).copysign(relative)
    };
    ratios.into_iter().map(|ratio| ratio.map_or(1.0, bounded)).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, Vector2};

    use super::*;
    use crate::geometry::bundle::testing::{self, TestScene};
    use crate::geometry::measurement::balance;

    const NOISE: f64 = 0.001;

    fn block(scene: &TestScene, views: usize, tracks: usize) -> CompleteBlock {
        let mut points = vec![Vector2::zeros(); views * tracks];
        for seen in &scene.observations {
            points[seen.point * views + seen.view] = seen.xy;
        }
        CompleteBlock::new(views, tracks, &points, None)
    }

    /// The first half of the tracks in every view but the first exchange their points.
    fn contaminated(block: &CompleteBlock) -> CompleteBlock {
        let (views, tracks) = (block.views(), block.tracks());
        let wrong = tracks / 2;
        let point = |view: usize, track: usize| {
            let from = if view > 0 && track < wrong { (track + 3 * view) % wrong } else { track };
            block.point(view, from)
        };
        let points: Vec<_> = (0..tracks).flat_map(|track| (0..views).map(move |view| point(view, track))).collect();
        CompleteBlock::new(views, tracks, &points, None)
    }

    fn true_depth(scene: &TestScene, view: usize, track: usize) -> f64 {
        let pose = &scene.poses[view];
        (pose.rotation * scene.points[track] + pose.translation).z
    }

    /// Root mean square of `ln(found / true)` over some tracks after the best factor for every view and track.
    fn log_error(scene: &TestScene, depths: &[f64], views: usize, tracks: std::ops::Range<usize>) -> f64 {
        let mut errors = DMatrix::from_fn(views, tracks.len(), |view, k| {
            let track = tracks.start + k;
            (depths[track * views + view] / true_depth(scene, view, track)).ln()
        });
        for mut row in errors.row_iter_mut() {
            let mean = row.mean();
            row.add_scalar_mut(-mean);
        }
        for mut column in errors.column_iter_mut() {
            let mean = column.mean();
            column.add_scalar_mut(-mean);
        }
        (errors.norm_squared() / errors.len() as f64).sqrt()
    }

    /// Ratio of the fifth to the fourth singular value of a balanced matrix.
    fn beyond_rank_4(matrix: &DMatrix<f64>) -> f64 {
        let mut singular: Vec<f64> = balance(matrix).singular_values().iter().copied().collect();
        singular.sort_by(|a, b| b.total_cmp(a));
        singular[4] / singular[3]
    }

    #[test]
    fn exact_scenes_recover_depths_up_to_a_factor_a_view_and_a_track() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 6, 40, 0.0);
            let block = block(&scene, 6, 40);
            let depths = epipolar_depths(&block, NOISE, seed, &StopToken::default()).expect("depths");
            assert!(depths.iter().all(|&depth| depth > 0.0), "seed {seed}: a point behind a camera");
            let error = log_error(&scene, &depths, 6, 0..40);
            let with_depths = block.with_depths(depths);
            let (without, with) =
                (beyond_rank_4(&block.measurement_matrix()), beyond_rank_4(&with_depths.measurement_matrix()));
            println!("seed {seed}: depths off by {error:.1e}, rank {without:.1e} -> {with:.1e}");
            assert!(error < 1e-6, "seed {seed}: {error:e}");
            assert!(with < 1e-6 && without > 1e-2, "seed {seed}: {with:e} {without:e}");
        }
    }

    #[test]
    fn noise_and_outliers_leave_the_depths_of_the_others_usable() {
        for seed in 0..5 {
            let scene = testing::scene(seed, 6, 120, NOISE);
            let block = block(&scene, 6, 120);
            let ones = log_error(&scene, &vec![1.0; 6 * 120], 6, 60..120);
            let error_of = |block: &CompleteBlock| {
                let depths = epipolar_depths(block, NOISE, seed, &StopToken::default()).expect("depths");
                assert!(depths.iter().all(|depth| depth.is_finite() && depth.abs() > 0.0), "seed {seed}");
                let magnitudes: Vec<f64> = depths.iter().map(|depth| depth.abs()).collect();
                log_error(&scene, &magnitudes, 6, 60..120)
            };
            let (noisy, contaminated) = (error_of(&block), error_of(&contaminated(&block)));
            println!("seed {seed}: ones {ones:.3}, noise {noisy:.4}, half outliers {contaminated:.4}");
            assert!(noisy < 0.25 * ones, "seed {seed}: {noisy} of {ones}");
            assert!(contaminated < 0.25 * ones, "seed {seed}: {contaminated} of {ones}");
        }
    }

    #[test]
    fn one_seed_gives_one_answer() {
        let scene = testing::scene(1, 4, 60, NOISE);
        let block = contaminated(&block(&scene, 4, 60));
        let of = |seed| epipolar_depths(&block, NOISE, seed, &StopToken::default()).expect("depths");
        assert_eq!(of(3), of(3));
    }

    #[test]
    fn hostile_blocks_give_none_or_finite_depths() {
        let stop = StopToken::default();
        let of = |block: &CompleteBlock| epipolar_depths(block, NOISE, 0, &stop);
        let scene = testing::scene(1, 3, 20, 0.0);
        let whole = block(&scene, 3, 20);
        assert_eq!(of(&whole.select(&[0, 1, 2, 3, 4, 5, 6])), None, "seven tracks");
        assert_eq!(of(&CompleteBlock::new(1, 20, &[Vector2::zeros(); 20], None)), None, "one view");
        assert_eq!(of(&CompleteBlock::new(2, 0, &[], None)), None, "no tracks");
        assert_eq!(of(&CompleteBlock::new(2, 20, &[Vector2::zeros(); 40], None)), None, "one point");
        for wild in [f64::NAN, f64::INFINITY, 1e300, -1e160] {
            assert_eq!(of(&CompleteBlock::new(2, 20, &[Vector2::repeat(wild); 40], None)), None, "{wild}");
            let mut points: Vec<Vector2<f64>> = (0..20).flat_map(|j| whole.track(j).iter().map(|s| s.xy)).collect();
            points[7].x = wild;
            if let Some(depths) = of(&CompleteBlock::new(3, 20, &points, None)) {
                assert!(depths.iter().all(|depth| depth.is_finite()), "{wild}");
            }
        }
        for noise in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            epipolar_depths(&whole, noise, 0, &stop);
        }
        // A line of points has no fundamental matrix of its own; whatever comes is finite.
        let line: Vec<Vector2<f64>> = (0..60).map(|k| Vector2::new(k as f64 / 60.0, 0.2)).collect();
        if let Some(depths) = of(&CompleteBlock::new(3, 20, &line, None)) {
            assert!(depths.iter().all(|depth| depth.is_finite()));
        }
        stop.stop(crate::domain::StopReason::Cancelled);
        assert_eq!(of(&whole), None, "stopped");
    }
}
