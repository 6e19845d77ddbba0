//! Do homographies explain the views? Then the scene is planar or the camera only rotated, and nothing about
//! calibration may be concluded.

use nalgebra::{Matrix3, SMatrix, SVector, Vector2};

use super::bundle::Observation;

/// Common points that a pair of views needs: two more than the four that a homography always fits.
const LEAST_COMMON: usize = 6;
/// Rounds of the reweighted direct linear transform; prototypes settle in three.
const ROUNDS: usize = 5;
/// Scale of the Cauchy weights in units of the noise of a transferred point.
const CAUCHY_SCALE: f64 = 3.0;
/// The 75 % quantile of a Rayleigh distribution with unit parameter, `sqrt(2 ln 4)`. The quantile asks three quarters
/// of the points, so that a dominant plane alone is not taken for a planar scene, nor a wrong track for depth.
const QUANTILE: f64 = 0.75;
const RAYLEIGH_QUANTILE: f64 = 1.665_109_222_315_395_5;

/// Median over the views of how far homographies to a reference view miss, in units of the noise.
///
/// First, last and most observed view take their turn as reference, and the largest median counts: along a sequence,
/// neighbours alone have too little baseline to tell. About 1.4 (the noise of two views) for a planar scene or a
/// camera that only rotates; tens where there is parallax. `noise` is the standard deviation of a coordinate.
///
/// Returns `None` when no pair of views has enough points in common.
pub fn median_residual(observations: &[Observation], views: usize, noise: f64) -> Option<f64> {
    let mut by_view: Vec<Vec<(usize, Vector2<f64>)>> = vec![Vec::new(); views];
    for seen in observations.iter().filter(|seen| seen.camera < views && seen.xy.iter().all(|x| x.is_finite())) {
        by_view[seen.camera].push((seen.point, seen.xy));
    }
    for view in &mut by_view {
        view.sort_by_key(|(point, _)| *point);
        view.dedup_by_key(|(point, _)| *point);
    }
    let most_observed = (0..views).max_by_key(|&view| (by_view[view].len(), std::cmp::Reverse(view)))?;
    let mut references = vec![0, most_observed, views - 1];
    references.sort_unstable();
    references.dedup();
    references.into_iter().filter_map(|reference| median_to(&by_view, reference, noise)).reduce(f64::max)
}

/// Median over the other views of how far homographies to this reference miss.
fn median_to(by_view: &[Vec<(usize, Vector2<f64>)>], reference: usize, noise: f64) -> Option<f64> {
    let mut residuals: Vec<f64> = (0..by_view.len())
        .filter(|&view| view != reference)
        .filter_map(|view| pair_residual(&common(&by_view[reference], &by_view[view]), noise))
        .collect();
    residuals.sort_by(f64::total_cmp);
    residuals.get(residuals.len() / 2).copied()
}

/// Image points of the points that both views see; both lists sorted by point.
fn common(first: &[(usize, Vector2<f64>)], second: &[(usize, Vector2<f64>)]) -> Vec<(Vector2<f64>, Vector2<f64>)> {
    let found = first.iter().filter_map(|(point, xy)| {
        let at = second.binary_search_by_key(point, |(point, _)| *point).ok()?;
        Some((*xy, second[at].1))
    });
    found.collect()
}

/// How far the best homography between two views misses, in units of the noise and corrected for its eight unknowns.
fn pair_residual(pairs: &[(Vector2<f64>, Vector2<f64>)], noise: f64) -> Option<f64> {
    if pairs.len() < LEAST_COMMON {
        return None;
    }
    let noise = noise.max(f64::EPSILON);
    let mut weights = vec![1.0; pairs.len()];
    let mut errors = vec![f64::INFINITY; pairs.len()];
    for _ in 0..ROUNDS {
        let homography = direct_linear_transform(pairs, &weights)?;
        for ((error, weight), (from, to)) in errors.iter_mut().zip(&mut weights).zip(pairs) {
            let moved = homography * from.push(1.0);
            *error = (moved.xy() / moved.z - to).norm();
            // The scale makes the algebraic error geometric, the rest bounds what one wrong point can do.
            let scale = moved.z * moved.z * (1.0 + (*error / (CAUCHY_SCALE * noise)).powi(2));
            *weight = if scale.is_finite() && scale > 0.0 { scale.recip() } else { 0.0 };
        }
    }
    errors.sort_by(f64::total_cmp);
    let quantile = errors[((pairs.len() as f64 * QUANTILE) as usize).min(pairs.len() - 1)];
    let freedom = 1.0 - 4.0 / pairs.len() as f64;
    let residual = quantile / (RAYLEIGH_QUANTILE * noise * freedom.sqrt());
    residual.is_finite().then_some(residual)
}

/// The homography with the least weighted algebraic error, at unit norm.
fn direct_linear_transform(pairs: &[(Vector2<f64>, Vector2<f64>)], weights: &[f64]) -> Option<Matrix3<f64>> {
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for ((from, to), weight) in pairs.iter().zip(weights) {
        let from = from.push(1.0);
        for (row, target) in [to.x, to.y].into_iter().enumerate() {
            let mut equation = SVector::<f64, 9>::zeros();
            equation.fixed_rows_mut::<3>(3 * row).copy_from(&from);
            equation.fixed_rows_mut::<3>(6).copy_from(&(-target * from));
            normal += equation * equation.transpose() * *weight;
        }
    }
    // Before the decomposition, which would not end on what is no number.
    let trace = normal.trace();
    if !(trace > 0.0 && trace.is_finite()) {
        return None;
    }
    let eigen = (normal / trace).symmetric_eigen();
    Some(Matrix3::from_row_slice(eigen.eigenvectors.column(eigen.eigenvalues.imin()).as_slice()))
}

#[cfg(test)]
mod tests {
    use super::super::bundle::testing::{self, Motion, NOISE};
    use super::*;

    #[test]
    fn planes_and_rotations_are_explained_and_parallax_is_not() {
        for seed in 0..10 {
            let residual = |motion, planar, tracks| {
                let scene = testing::scene_of(seed, 10, tracks, NOISE, motion, planar);
                median_residual(&scene.observations, 10, NOISE).expect("enough points")
            };
            for tracks in [8, 20, 60] {
                let plane = residual(Motion::General, true, tracks);
                let rotation = residual(Motion::Rotation, false, tracks);
                let general = residual(Motion::General, false, tracks);
                println!("seed {seed}, {tracks} tracks: plane {plane:.2} rotation {rotation:.2} general {general:.1}");
                assert!(plane < 2.5 && rotation < 2.5, "seed {seed}, {tracks} tracks: {plane} {rotation}");
                assert!(general > 4.0, "seed {seed}, {tracks} tracks: {general}");
            }
        }
    }

    #[test]
    fn a_wrong_track_does_not_hide_a_plane() {
        let mut scene = testing::scene_of(1, 10, 30, NOISE, Motion::General, true);
        for seen in scene.observations.iter_mut().filter(|seen| seen.point == 3) {
            seen.xy += Vector2::new(0.3, 0.1 * seen.camera as f64);
        }
        let residual = median_residual(&scene.observations, 10, NOISE).expect("enough points");
        assert!(residual < 2.5, "{residual}");
    }

    #[test]
    fn too_little_or_hostile_input_says_nothing() {
        assert_eq!(median_residual(&[], 0, NOISE), None);
        let scene = testing::scene(1, 3, 5, NOISE);
        assert_eq!(median_residual(&scene.observations, 3, NOISE), None);
        let mut scene = testing::scene(1, 3, 10, NOISE);
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::zeros());
        median_residual(&scene.observations, 3, NOISE);
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::new(f64::NAN, 1e200));
        assert_eq!(median_residual(&scene.observations, 3, NOISE), None);
    }
}
