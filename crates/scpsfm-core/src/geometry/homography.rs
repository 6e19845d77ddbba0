//! Homographies between views, and whether they explain them: then the scene is planar or the camera only turned.

use nalgebra::{Matrix3, SMatrix, Vector2};

use super::fundamental::Match;
use super::null_vector::{projection_equations, smallest_eigenvector};
use super::observation::Observation;
use super::statistics::median;

/// Common points that a pair of views needs: two more than the four that a homography always fits.
pub const LEAST_COMMON: usize = 6;
/// Rounds of the reweighted direct linear transform; prototypes settle in three.
const ROUNDS: usize = 5;
/// Scale of the Cauchy weights in units of the noise of a transferred point.
const CAUCHY_SCALE: f64 = 3.0;
/// The 75 % quantile of a Rayleigh distribution with unit parameter, `sqrt(2 ln 4)`. The quantile asks three quarters
/// of the points, so that a dominant plane alone is not taken for a planar scene, nor a wrong track for depth.
const QUANTILE: f64 = 0.75;
const RAYLEIGH_QUANTILE: f64 = 1.665_109_222_315_395_5;

/// Median over the views of how far homographies to a reference view miss, in units of the noise, where that is less
/// than `limit`.
///
/// First, last and most observed view take their turn as reference, and the largest median counts: along a sequence,
/// neighbours alone have too little baseline to tell. About 1.4 (the noise of two views) for a planar scene or a
/// camera that only rotates; tens where there is parallax. `noise` is the standard deviation of a coordinate.
///
/// Returns `None` from the first reference on that reaches the limit, and when no pair of views has enough points in
/// common.
pub fn median_residual(observations: &[Observation], views: usize, noise: f64, limit: f64) -> Option<f64> {
    let seen = Correspondences::new(observations, views);
    let mut references = vec![0, seen.most_observed()?, views - 1];
    references.sort_unstable();
    references.dedup();
    references
        .into_iter()
        .filter_map(|reference| median_to(&seen, reference, noise))
        .try_fold(None, |largest: Option<f64>, residual| {
            (residual < limit).then(|| Some(largest.map_or(residual, |largest| largest.max(residual))))
        })
        .flatten()
}

/// Median over the other views of how far homographies to this reference miss.
fn median_to(seen: &Correspondences, reference: usize, noise: f64) -> Option<f64> {
    let mut residuals: Vec<f64> = (0..seen.by_view.len())
        .filter(|&view| view != reference)
        .filter_map(|view| pair_residual(&seen.common(reference, view), noise))
        .collect();
    (!residuals.is_empty()).then(|| median(&mut residuals))
}

/// Image points by view, to find what two views have in common.
#[derive(Debug, Clone)]
pub struct Correspondences {
    /// Point and position, sorted by point and without repetition.
    by_view: Vec<Vec<(usize, Vector2<f64>)>>,
}

impl Correspondences {
    /// Homographies from one view to every view, each by way of the views that share most points.
    ///
    /// * `noise`: standard deviation of a coordinate
    ///
    /// Returns `None` where views that share enough points do not tie all views together.
    pub fn homographies_from(&self, reference: usize, noise: f64) -> Option<Vec<Matrix3<f64>>> {
        let views = self.by_view.len();
        let mut found: Vec<Option<Matrix3<f64>>> = vec![None; views];
        *found.get_mut(reference)? = Some(Matrix3::identity());
        // The view of the tree that each view outside of it shares most points with (Prim's algorithm), the reference
        // first among equals.
        let mut links: Vec<(Vec<Match>, usize)> = (0..views).map(|_| (Vec::new(), reference)).collect();
        let mut joined = reference;
        for _ in 1..views {
            let outside = || (0..views).filter(|&view| found[view].is_none());
            for view in outside() {
                let shared = self.common(joined, view);
                if shared.len() > links[view].0.len() {
                    links[view] = (shared, joined);
                }
            }
            joined = outside().max_by_key(|&view| (links[view].0.len(), std::cmp::Reverse(view)))?;
            let (shared, from) = &links[joined];
            found[joined] = Some(between(shared, noise)? * found[*from]?);
        }
        found.into_iter().collect()
    }

    /// Sorts the observations; views out of range and what is no number are left out.
    pub fn new(observations: &[Observation], views: usize) -> Self {
        let mut by_view: Vec<Vec<(usize, Vector2<f64>)>> = vec![Vec::new(); views];
        for seen in observations.iter().filter(|seen| seen.view < views && seen.xy.iter().all(|x| x.is_finite())) {
            by_view[seen.view].push((seen.point, seen.xy));
        }
        for view in &mut by_view {
            view.sort_by_key(|(point, _)| *point);
            view.dedup_by_key(|(point, _)| *point);
        }
        Self { by_view }
    }

    /// The view with the most points, the first of several; `None` without views.
    pub fn most_observed(&self) -> Option<usize> {
        (0..self.by_view.len()).max_by_key(|&view| (self.by_view[view].len(), std::cmp::Reverse(view)))
    }

    /// Positions in both views of the points that both see.
    ///
    /// # Panics
    /// When a view is out of range.
    pub fn common(&self, first: usize, second: usize) -> Vec<Match> {
        let second = &self.by_view[second];
        let found = self.by_view[first].iter().filter_map(|(point, xy)| {
            let at = second.binary_search_by_key(point, |(point, _)| *point).ok()?;
            Some(Match { from: *xy, to: second[at].1 })
        });
        found.collect()
    }
}

/// How far the best homography between two views misses, in units of the noise and corrected for its eight unknowns.
fn pair_residual(pairs: &[Match], noise: f64) -> Option<f64> {
    let noise = noise.max(f64::EPSILON);
    let (_, mut errors) = robust(pairs, noise)?;
    errors.sort_by(f64::total_cmp);
    let quantile = errors[((pairs.len() as f64 * QUANTILE) as usize).min(pairs.len() - 1)];
    let freedom = 1.0 - 4.0 / pairs.len() as f64;
    let residual = quantile / (RAYLEIGH_QUANTILE * noise * freedom.sqrt());
    residual.is_finite().then_some(residual)
}

/// The homography from the first to the second points of these pairs, by a reweighted direct linear transform.
///
/// Returns `None` for fewer than [`LEAST_COMMON`] pairs and for pairs that determine none.
fn between(pairs: &[Match], noise: f64) -> Option<Matrix3<f64>> {
    robust(pairs, noise.max(f64::EPSILON)).map(|(homography, _)| homography)
}

/// The same with the distance by which it misses each point.
fn robust(pairs: &[Match], noise: f64) -> Option<(Matrix3<f64>, Vec<f64>)> {
    if pairs.len() < LEAST_COMMON {
        return None;
    }
    let mut homography = Matrix3::zeros();
    let mut weights = vec![1.0; pairs.len()];
    let mut errors = vec![f64::INFINITY; pairs.len()];
    for _ in 0..ROUNDS {
        homography = direct_linear_transform(pairs, &weights)?;
        for ((error, weight), Match { from, to }) in errors.iter_mut().zip(&mut weights).zip(pairs) {
            let moved = homography * from.push(1.0);
            *error = (moved.xy() / moved.z - to).norm();
            // The scale makes the algebraic error geometric, the rest bounds what one wrong point can do.
            let scale = moved.z * moved.z * (1.0 + (*error / (CAUCHY_SCALE * noise)).powi(2));
            *weight = if scale.is_finite() && scale > 0.0 { scale.recip() } else { 0.0 };
        }
    }
    Some((homography, errors))
}

/// The homography with the least weighted algebraic error, at unit norm.
fn direct_linear_transform(pairs: &[Match], weights: &[f64]) -> Option<Matrix3<f64>> {
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (Match { from, to }, weight) in pairs.iter().zip(weights) {
        for equation in projection_equations::<3, 9>(&from.push(1.0), to) {
            normal += equation * equation.transpose() * *weight;
        }
    }
    let entries = smallest_eigenvector(&normal)?;
    Some(Matrix3::from_row_slice(entries.as_slice()))
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
                median_residual(&scene.observations, 10, NOISE, f64::INFINITY).expect("enough points")
            };
            for tracks in [8, 20, 60] {
                let plane = residual(Motion::General, true, tracks);
                let rotation = residual(Motion::Rotation, false, tracks);
                let general = residual(Motion::General, false, tracks);
                println!("seed {seed}, {tracks} tracks: plane {plane:.2} rotation {rotation:.2} general {general:.1}");
                assert!(plane < 2.5 && rotation < 2.5, "seed {seed}, {tracks} tracks: {plane} {rotation}");
                assert!(general > 4.0, "seed {seed}, {tracks} tracks: {general}");
                let scene = testing::scene_of(seed, 10, tracks, NOISE, Motion::General, false);
                let beyond = |limit: f64| median_residual(&scene.observations, 10, NOISE, limit).is_none();
                assert!(beyond(general) && !beyond(1.01 * general), "seed {seed}, {tracks} tracks: {general}");
            }
        }
    }

    /// By way of others where views share nothing with the reference.
    #[test]
    fn homographies_are_chained() {
        let mut scene = testing::scene_of(1, 12, 120, 0.0, Motion::Rotation, false);
        let expected = |view: usize| {
            let calibration = scene.intrinsics.matrix();
            let turned = scene.poses[view].rotation * scene.poses[0].rotation.transpose();
            (calibration * turned * calibration.try_inverse().expect("a focal length")).normalize()
        };
        let expected: Vec<Matrix3<f64>> = (0..12).map(expected).collect();
        scene.observations.retain(|seen| (seen.point % 9..seen.point % 9 + 4).contains(&seen.view));
        let seen = Correspondences::new(&scene.observations, 12);
        assert!(seen.common(0, 11).is_empty());
        for (view, found) in seen.homographies_from(0, 1e-6).expect("a chain").iter().enumerate() {
            let found = found.normalize();
            let apart = (found - expected[view]).norm().min((found + expected[view]).norm());
            assert!(apart < 1e-6, "view {view}: {found} {}", expected[view]);
        }
        scene.observations.retain(|seen| (seen.view < 6) == (seen.point % 9 < 3));
        scene.observations.retain(|seen| seen.view < 6 || seen.point % 9 > 5);
        assert!(Correspondences::new(&scene.observations, 12).homographies_from(0, 1e-6).is_none());
    }

    #[test]
    fn a_wrong_track_does_not_hide_a_plane() {
        let mut scene = testing::scene_of(1, 10, 30, NOISE, Motion::General, true);
        for seen in scene.observations.iter_mut().filter(|seen| seen.point == 3) {
            seen.xy += Vector2::new(0.3, 0.1 * seen.view as f64);
        }
        let residual = median_residual(&scene.observations, 10, NOISE, 3.0).expect("enough points");
        assert!(residual < 2.5, "{residual}");
    }

    #[test]
    fn too_little_or_hostile_input_says_nothing() {
        assert_eq!(median_residual(&[], 0, NOISE, f64::INFINITY), None);
        let scene = testing::scene(1, 3, 5, NOISE);
        assert_eq!(median_residual(&scene.observations, 3, NOISE, f64::INFINITY), None);
        let mut scene = testing::scene(1, 3, 10, NOISE);
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::zeros());
        median_residual(&scene.observations, 3, NOISE, f64::INFINITY);
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::new(f64::NAN, 1e200));
        assert_eq!(median_residual(&scene.observations, 3, NOISE, f64::INFINITY), None);
    }
}
