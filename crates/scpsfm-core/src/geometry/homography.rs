//! Homographies between views, and whether they explain them: then the scene is planar or the camera only turned.

use nalgebra::{Matrix3, SMatrix, Vector2, Vector3};

use super::fundamental::Match;
use super::null_vector::{projection_equations, smallest_eigenvector};
use super::observation::Observation;
use super::statistics::median;

/// Points that a view is placed by, and that a pair of views needs in common: two more than the four that a homography
/// always fits.
pub const LEAST_COMMON: usize = 6;
/// Rounds of the reweighted direct linear transform; prototypes settle in three.
const ROUNDS: usize = 5;
/// Scale of the Cauchy weights in units of the noise of a transferred point.
pub const CAUCHY_SCALE: f64 = 3.0;
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
    // Median over the other views.
    let residual_to = |reference: usize| {
        let others = (0..views).filter(|&view| view != reference);
        let found = others.filter_map(|view| pair_residual(&seen.common(reference, view), noise));
        let mut residuals: Vec<f64> = found.collect();
        (!residuals.is_empty()).then(|| median(&mut residuals))
    };
    references
        .into_iter()
        .filter_map(residual_to)
        .try_fold(None, |largest: Option<f64>, residual| {
            (residual < limit).then(|| Some(largest.map_or(residual, |largest| largest.max(residual))))
        })
        .flatten()
}

/// Views without parallax, each placed by the points that it sees.
#[derive(Debug, Clone)]
pub struct Placed {
    /// What takes the points to the images of each view, up to scale.
    pub views: Vec<Matrix3<f64>>,
    /// In the frame of the view that was placed first, of unit length; `None` where no view sees them, and left out past
    /// the last one that is seen.
    pub points: Vec<Option<Vector3<f64>>>,
}

/// Image points by view, to find what two views have in common.
#[derive(Debug, Clone)]
pub struct Correspondences {
    /// Point and position, sorted by point and without repetition.
    by_view: Vec<Vec<(usize, Vector2<f64>)>>,
}

impl Correspondences {
    /// Places all views, one after the other, by the points that those before it have placed; next is the one that sees
    /// most of these.
    ///
    /// A view that shares few points with any one other may share enough with all of them together.
    ///
    /// * `reference`, `first`: the view that is placed first, and what takes points to its images
    /// * `place`: the same of another view, from points and where it sees them
    ///
    /// Returns `None` where a view cannot be placed.
    pub fn placed(
        &self,
        (reference, first): (usize, Matrix3<f64>),
        place: impl Fn(&[(Vector3<f64>, Vector2<f64>)]) -> Option<Matrix3<f64>>,
    ) -> Option<Placed> {
        let count = self.by_view.iter().filter_map(|seen| seen.last()).map(|(point, _)| point + 1).max()?;
        let mut points: Vec<Option<Vector3<f64>>> = vec![None; count];
        let mut views = vec![None; self.by_view.len()];
        let (mut next, mut found) = (reference, first);
        loop {
            *views.get_mut(next)? = Some(found);
            let back = found.try_inverse()?;
            for (point, xy) in &self.by_view[next] {
                points[*point].get_or_insert_with(|| (back * xy.push(1.0)).normalize());
            }
            let placed =
                |view: &usize| self.by_view[*view].iter().filter(|(point, _)| points[*point].is_some()).count();
            let open = (0..views.len()).filter(|&view| views[view].is_none());
            let Some(view) = open.max_by_key(|view| (placed(view), std::cmp::Reverse(*view))) else { break };
            let seen: Vec<_> =
                self.by_view[view].iter().filter_map(|(point, xy)| Some((points[*point]?, *xy))).collect();
            (next, found) = (view, place(&seen)?);
        }
        Some(Placed { views: views.into_iter().collect::<Option<_>>()?, points })
    }

    /// Homographies from one view to every view.
    ///
    /// * `noise`: standard deviation of a coordinate
    ///
    /// Returns `None` where the points do not tie all views together.
    pub fn homographies_from(&self, reference: usize, noise: f64) -> Option<Placed> {
        self.placed((reference, Matrix3::identity()), |seen| Some(robust(seen, noise.max(f64::EPSILON))?.0))
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
    let seen: Vec<_> = pairs.iter().map(|Match { from, to }| (from.push(1.0), *to)).collect();
    let (_, mut errors) = robust(&seen, noise)?;
    errors.sort_by(f64::total_cmp);
    let quantile = errors[((pairs.len() as f64 * QUANTILE) as usize).min(pairs.len() - 1)];
    let freedom = 1.0 - 4.0 / pairs.len() as f64;
    let residual = quantile / (RAYLEIGH_QUANTILE * noise * freedom.sqrt());
    residual.is_finite().then_some(residual)
}

/// The homography that takes points to where they are seen, by a reweighted direct linear transform, and the distance by
/// which it misses each.
///
/// Returns `None` for fewer than [`LEAST_COMMON`] points and for points that determine none.
fn robust(seen: &[(Vector3<f64>, Vector2<f64>)], noise: f64) -> Option<(Matrix3<f64>, Vec<f64>)> {
    if seen.len() < LEAST_COMMON {
        return None;
    }
    let mut homography = Matrix3::zeros();
    let mut weights = vec![1.0; seen.len()];
    let mut errors = vec![f64::INFINITY; seen.len()];
    for _ in 0..ROUNDS {
        homography = direct_linear_transform(seen, &weights)?;
        for ((error, weight), (point, xy)) in errors.iter_mut().zip(&mut weights).zip(seen) {
            let moved = homography * point;
            *error = (moved.xy() / moved.z - xy).norm();
            // The scale makes the algebraic error geometric, the rest bounds what one wrong point can do.
            let scale = moved.z * moved.z * (1.0 + (*error / (CAUCHY_SCALE * noise)).powi(2));
            *weight = if scale.is_finite() && scale > 0.0 { scale.recip() } else { 0.0 };
        }
    }
    Some((homography, errors))
}

/// The homography with the least weighted algebraic error, at unit norm.
fn direct_linear_transform(seen: &[(Vector3<f64>, Vector2<f64>)], weights: &[f64]) -> Option<Matrix3<f64>> {
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for ((point, xy), weight) in seen.iter().zip(weights) {
        for equation in projection_equations::<3, 9>(point, xy) {
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
        for (view, found) in seen.homographies_from(0, 1e-6).expect("a chain").views.iter().enumerate() {
            let found = found.normalize();
            let apart = (found - expected[view]).norm().min((found + expected[view]).norm());
            assert!(apart < 1e-6, "view {view}: {found} {}", expected[view]);
        }
        scene.observations.retain(|seen| (seen.view < 6) == (seen.point % 9 < 3));
        scene.observations.retain(|seen| seen.view < 6 || seen.point % 9 > 5);
        assert!(Correspondences::new(&scene.observations, 12).homographies_from(0, 1e-6).is_none());
    }

    /// A view shares four points with each of four others, and six with none.
    #[test]
    fn a_view_is_placed_by_what_several_others_see() {
        let mut scene = testing::scene_of(1, 5, 56, 0.0, Motion::Rotation, false);
        scene.observations.retain(|seen| match seen.view {
            4 => seen.point < 16,
            view => seen.point >= 16 || seen.point / 4 == view,
        });
        let seen = Correspondences::new(&scene.observations, 5);
        assert!((0..4).all(|view| seen.common(view, 4).len() == 4));
        let placed = seen.homographies_from(0, 1e-6).expect("enough points together");
        for seen in &scene.observations {
            let moved = placed.views[seen.view] * placed.points[seen.point].expect("observed");
            let missed = (moved.xy() / moved.z - seen.xy).norm();
            assert!(missed < 1e-6, "view {}, point {}: {missed}", seen.view, seen.point);
        }
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
