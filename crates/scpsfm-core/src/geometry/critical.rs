//! Fits special motions and scenes: a plane, a camera that only turns, one that only moves.
//!
//! Each fit is a maximum-likelihood one with its number of unknowns, so that it can be tested against projective
//! cameras, of which it is a special case.

use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};

use super::bundle::critical::{HOMOGRAPHIES_GAUGE, Homographies, TRANSLATING_GAUGE, Translating, minimise};
use super::bundle::metric::{Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Pose};
use super::bundle::sequence;
use super::bundle::{Loss, Options};
use super::daq::scan_focal;
use super::fundamental::{Fundamental, Match};
use super::homography::{CAUCHY_SCALE, Correspondences, LEAST_COMMON};
use super::null_vector::smallest_eigenvector;
use super::observation::{Observation, observed_points};
use super::procrustes::nearest_rotation;
use super::statistics::median;
use crate::domain::StopToken;

/// Focal lengths from which a rotation is looked for; neighbours are a fifth apart.
const FOCALS: usize = 16;
/// Rounds of reweighting by which a view is turned to what others have placed: as many as of homographies.
const TURNING_ROUNDS: usize = 5;
/// What an observation counts for at most where focal lengths are compared: it cannot be farther off than the image is
/// long.
const MOST_MISSED: f64 = 1.0;
/// Rounds of alternation for the depths of a translation's start; the adjustment does the rest.
const DEPTH_ROUNDS: usize = 10;
/// Iterations of each adjustment: they start near the minimum, or the model is wrong and its cost only has to show it.
pub const ADJUSTMENT_ITERATIONS: usize = 30;

/// A model at its minimum.
#[derive(Debug, Clone)]
pub struct CriticalFit<M> {
    pub model: M,
    /// Sum of the squared residuals, normalised units.
    pub cost: f64,
    /// Unknowns that the observations could determine, the gauge taken off.
    pub unknowns: usize,
}

/// Homographies from a reference view, and where it sees each point, the origin for points without a finite position:
/// what fits without parallax start from.
///
/// Returns `None` where common points do not tie all views together.
pub fn reference_homographies(
    observations: &[Observation],
    views: usize,
    points: usize,
    noise: f64,
) -> Option<Homographies> {
    let seen = Correspondences::new(observations, views);
    let reference = seen.most_observed()?;
    let placed = seen.homographies_from(reference, noise)?;
    let position = |point: &Option<Vector3<f64>>| {
        let position = point.map(|point| point.xy() / point.z)?;
        position.iter().all(|value| value.is_finite()).then_some(position)
    };
    let mut positions: Vec<Vector2<f64>> =
        placed.points.iter().map(|point| position(point).unwrap_or_default()).collect();
    positions.resize(points, Vector2::zeros());
    Some(Homographies { views: placed.views, points: positions })
}

/// Squared residuals of the observations, weighted, of homographies that are adjusted under a loss that bounds what a
/// minority of them can do.
///
/// * `start`: see [`reference_homographies`]
/// * `noise`: one standard deviation of a coordinate, normalised units
pub fn squared_residuals(start: &Homographies, observations: &[Observation], noise: f64, stop: &StopToken) -> Vec<f64> {
    let mut adjusted = start.clone();
    let loss = Loss::Cauchy { scale: CAUCHY_SCALE * noise };
    minimise(&mut adjusted, observations, &Options { loss, ..Options::squared(ADJUSTMENT_ITERATIONS) }, stop);
    let squared = |seen: &Observation| {
        let moved = adjusted.views.get(seen.view)? * adjusted.points.get(seen.point)?.push(1.0);
        Some(seen.weight * (moved.xy() / moved.z - seen.xy).norm_squared())
    };
    observations.iter().map(|seen| squared(seen).unwrap_or(f64::INFINITY)).collect()
}

/// Fits a camera that only turns, first with its focal length alone free, then with this model.
///
/// * `start`: see [`rotation_start`]
/// * `group_of`: camera group of each view
/// * `priors`: of the intrinsics of each group
///
/// Returns `None` where a view has no group or a group no prior.
pub fn fit_rotation(
    start: &MetricReconstruction,
    observations: &[Observation],
    group_of: &[usize],
    model: IntrinsicsModel,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
) -> Option<CriticalFit<MetricReconstruction>> {
    if group_of.len() != start.poses.len() || group_of.iter().any(|&group| group >= priors.len()) {
        return None;
    }
    let mut rotation = start.clone();
    rotation.group_of = group_of.to_vec();
    rotation.intrinsics.resize(priors.len(), rotation.intrinsics[0]);
    if model.is_per_view() {
        rotation = rotation.with_own_focals();
    }
    let simplest = IntrinsicsModel::focal(model.is_per_view());
    let options = Options::squared(ADJUSTMENT_ITERATIONS);
    sequence::adjust_all(&mut rotation, observations, simplest, priors, &options, stop);
    let report = sequence::adjust_all(&mut rotation, observations, model, priors, &options, stop);
    let cost = report.cost - IntrinsicsPrior::cost_of(priors, model, &rotation.intrinsics);
    let unknowns = rotation
        .unknowns(observed_points(observations, rotation.points.len()), model.parameters().len() * priors.len());
    Some(CriticalFit { model: rotation, cost, unknowns })
}

/// What a camera that only turns sees, by homographies from the plane across the mean of its directions; `None` where a
/// direction does not meet that.
pub fn homographies_of(rotation: &MetricReconstruction) -> Option<Homographies> {
    let mean: Vector3<f64> = rotation.points.iter().filter_map(|point| point.try_normalize(f64::MIN_POSITIVE)).sum();
    let frame = Rotation3::rotation_between(&mean, &Vector3::z())?.into_inner();
    let view = |(view, pose): (usize, &Pose)| rotation.intrinsics_of(view).matrix() * pose.rotation * frame.transpose();
    let point = |direction: &Vector3<f64>| {
        let seen = frame * direction;
        (seen.z > 0.0).then(|| seen.xy() / seen.z)
    };
    Some(Homographies {
        views: rotation.poses.iter().enumerate().map(view).collect(),
        points: rotation.points.iter().map(point).collect::<Option<_>>()?,
    })
}

/// Fits homographies from here.
pub fn fit_homographies(
    mut model: Homographies,
    observations: &[Observation],
    iterations: usize,
    stop: &StopToken,
) -> CriticalFit<Homographies> {
    let unknowns = unknowns_of_homographies(model.views.len(), observed_points(observations, model.points.len()));
    let report = minimise(&mut model, observations, &Options::squared(iterations), stop);
    CriticalFit { model, cost: report.cost, unknowns }
}

/// Unknowns of homographies of so many views, and so many points that have an observation, the gauge taken off.
pub fn unknowns_of_homographies(views: usize, points: usize) -> usize {
    (8 * views + 2 * points).saturating_sub(HOMOGRAPHIES_GAUGE)
}

/// A camera that only turned, its principal point in the centre, from the focal length that explains the views best:
/// what [`fit_rotation`] starts from. A rotation holds farther from the points that it is found by than a homography.
///
/// Returns `None` where common points do not tie all views together.
pub fn rotation_start(
    observations: &[Observation],
    views: usize,
    points: usize,
    noise: f64,
) -> Option<MetricReconstruction> {
    let seen = Correspondences::new(observations, views);
    let reference = seen.most_observed()?;
    let of_focal = |k: usize| {
        let intrinsics = Intrinsics::from_focal(scan_focal(k, FOCALS));
        let matrix = intrinsics.matrix();
        let placed = seen.placed((reference, matrix), |seen| Some(matrix * rotation_of(seen, &intrinsics, noise)?))?;
        let distance = |seen: &Observation| {
            let moved = placed.views.get(seen.view)? * (*placed.points.get(seen.point)?)?;
            Some((moved.xy() / moved.z - seen.xy).norm().min(MOST_MISSED))
        };
        let missed: f64 = observations.iter().filter_map(distance).sum();
        Some((missed, intrinsics, placed))
    };
    let (_, intrinsics, placed) = (0..FOCALS).filter_map(of_focal).min_by(|a, b| a.0.total_cmp(&b.0))?;
    let back = intrinsics.matrix().try_inverse()?;
    let pose = |view: &Matrix3<f64>| Pose { rotation: back * view, translation: Vector3::zeros() };
    let mut directions: Vec<Vector3<f64>> =
        placed.points.into_iter().map(|point| point.unwrap_or_else(Vector3::z)).collect();
    directions.resize(points, Vector3::z());
    let start = MetricReconstruction::new(intrinsics, placed.views.iter().map(pose).collect(), directions);
    Some(MetricReconstruction { has_common_centre: true, ..start })
}

/// The rotation that takes directions to where a camera sees them, by least absolute deviations (Weiszfeld 1937): some
/// of the points may be wrong, and the focal length is.
fn rotation_of(seen: &[(Vector3<f64>, Vector2<f64>)], intrinsics: &Intrinsics, noise: f64) -> Option<Matrix3<f64>> {
    if seen.len() < LEAST_COMMON {
        return None;
    }
    let mut weights = vec![1.0; seen.len()];
    let mut rotation = Matrix3::identity();
    for _ in 0..TURNING_ROUNDS {
        let mut moment = Matrix3::zeros();
        for ((direction, xy), weight) in seen.iter().zip(&weights) {
            moment += (xy / intrinsics.focal).push(1.0).normalize() * direction.transpose() * *weight;
        }
        rotation = nearest_rotation(&moment)?;
        for ((direction, xy), weight) in seen.iter().zip(&mut weights) {
            let missed = (rotation * direction - (xy / intrinsics.focal).push(1.0).normalize()).norm();
            *weight = (missed * intrinsics.focal).max(noise.max(f64::EPSILON)).recip();
        }
    }
    Some(rotation)
}

/// Where the reference view sees each point: as observed there, else as by its first observation elsewhere.
fn positions(observations: &[Observation], views: usize, points: usize, reference: usize) -> Vec<Option<Vector2<f64>>> {
    let mut positions = vec![None; points];
    for seen in observations.iter().filter(|seen| seen.view < views && seen.point < points) {
        let slot = &mut positions[seen.point];
        if slot.is_none() || seen.view == reference {
            *slot = Some(seen.xy).filter(|position| position.iter().all(|value| value.is_finite())).or(*slot);
        }
    }
    positions
}

/// Fits a camera that moves without turning.
///
/// Without rotation the fundamental matrix of two views is `[e]x`, of their epipole (Hartley & Zisserman, section
/// 9.3.1). Where these miss by a median of more than `limit` standard deviations, no adjustment is spent on the model.
///
/// Returns `None` then, and when no view has enough points in common with every other.
pub fn fit_translation(
    observations: &[Observation],
    views: usize,
    points: usize,
    noise: f64,
    limit: f64,
    stop: &StopToken,
) -> Option<CriticalFit<Translating>> {
    let seen = Correspondences::new(observations, views);
    let reference = seen.most_observed()?;
    let mut epipoles = vec![Vector3::zeros(); views];
    let mut residuals = Vec::with_capacity(views);
    for view in (0..views).filter(|&view| view != reference) {
        let pairs = seen.common(reference, view);
        epipoles[view] = epipole(&pairs)?;
        let fundamental = Fundamental::of_translation(epipoles[view]);
        let mut distances: Vec<f64> = pairs.iter().map(|seen| fundamental.sampson_squared(seen).sqrt()).collect();
        residuals.push(median(&mut distances));
    }
    if median(&mut residuals) > limit * noise {
        return None;
    }
    let positions = positions(observations, views, points, reference);
    let observed = positions.iter().flatten().count();
    let at_unit_depth = positions.into_iter().map(|position| position.unwrap_or_default().push(1.0));
    let mut model = Translating { translations: epipoles, points: at_unit_depth.collect() };
    alternate(&mut model, observations, reference);
    let unknowns = (3 * (views + observed)).saturating_sub(TRANSLATING_GAUGE);
    let report = minimise(&mut model, observations, &Options::squared(ADJUSTMENT_ITERATIONS), stop);
    Some(CriticalFit { model, cost: report.cost, unknowns })
}

/// The common epipole of two views that are not turned to each other: it lies on the line through each point's images.
fn epipole(pairs: &[Match]) -> Option<Vector3<f64>> {
    let mut normal = Matrix3::zeros();
    for Match { from, to } in pairs {
        let line = from.push(1.0).cross(&to.push(1.0));
        normal += line * line.transpose();
    }
    if pairs.len() < LEAST_COMMON { None } else { smallest_eigenvector(&normal) }
}

/// Lengths of the translations and inverse depths that go with the epipoles, by alternating least squares on
/// `x_i ~ x_0 + w_j s_i e_i`.
fn alternate(model: &mut Translating, observations: &[Observation], reference: usize) {
    let in_range = |seen: &&Observation| {
        seen.view < model.translations.len() && seen.point < model.points.len() && seen.view != reference
    };
    // For each observation: view, point, w_j s_i and how well it is known.
    let products: Vec<(usize, usize, f64, f64)> = observations
        .iter()
        .filter(in_range)
        .filter_map(|seen| {
            let here = seen.xy.push(1.0);
            let along = here.cross(&model.translations[seen.view]);
            let weight = along.norm_squared();
            let product = -here.cross(&model.points[seen.point].xy().push(1.0)).dot(&along) / weight;
            product.is_finite().then_some((seen.view, seen.point, product, weight))
        })
        .collect();
    let mut lengths = vec![0.0; model.translations.len()];
    let mut depths = vec![1.0; model.points.len()];
    for _ in 0..DEPTH_ROUNDS {
        let mut sums = vec![(0.0, 0.0); lengths.len()];
        for &(view, point, product, weight) in &products {
            sums[view].0 += weight * product * depths[point];
            sums[view].1 += weight * depths[point] * depths[point];
        }
        lengths.iter_mut().zip(&sums).for_each(|(length, (above, below))| *length = ratio(*above, *below, 0.0));
        let mut sums = vec![(0.0, 0.0); depths.len()];
        for &(view, point, product, weight) in &products {
            sums[point].0 += weight * product * lengths[view];
            sums[point].1 += weight * lengths[view] * lengths[view];
        }
        depths.iter_mut().zip(&sums).for_each(|(depth, (above, below))| *depth = ratio(*above, *below, 1.0));
    }
    model.translations.iter_mut().zip(&lengths).for_each(|(translation, length)| *translation *= *length);
    model.points.iter_mut().zip(&depths).for_each(|(point, depth)| point.z = *depth);
}

fn ratio(above: f64, below: f64, otherwise: f64) -> f64 {
    let ratio = above / below;
    if ratio.is_finite() { ratio } else { otherwise }
}

#[cfg(test)]
mod tests {
    use super::super::bundle::testing::{self, Motion, NOISE, TestScene};
    use super::*;

    const PRIORS: [IntrinsicsPrior; 1] = [IntrinsicsPrior::NONE];
    const FULL: IntrinsicsModel = IntrinsicsModel::FULL;

    /// Chi-square over degrees of freedom of each model: homographies, rotation, translation.
    fn ratios(scene: &TestScene, noise: f64) -> [f64; 3] {
        let (views, points) = (scene.poses.len(), scene.points.len());
        let stop = StopToken::default();
        let reduced =
            |cost: f64, unknowns: usize| cost / (noise * noise * (2 * scene.observations.len() - unknowns) as f64);
        let start = reference_homographies(&scene.observations, views, points, noise).expect("complete tracks");
        let plane = fit_homographies(start, &scene.observations, ADJUSTMENT_ITERATIONS, &stop);
        let turning = rotation_start(&scene.observations, views, points, noise).expect("complete tracks");
        let turning =
            fit_rotation(&turning, &scene.observations, &vec![0; views], FULL, &PRIORS, &stop).expect("turns");
        let moving = fit_translation(&scene.observations, views, points, noise, f64::INFINITY, &stop);
        let moving = moving.expect("complete tracks");
        [
            reduced(plane.cost, plane.unknowns),
            reduced(turning.cost, turning.unknowns),
            reduced(moving.cost, moving.unknowns),
        ]
    }

    #[test]
    fn each_model_fits_its_own_motion_to_the_noise_and_no_other() {
        let fits = |ratio: f64| (0.6..1.4).contains(&ratio);
        for seed in 0..10 {
            for tracks in [20, 60] {
                let of = |motion, planar| ratios(&testing::scene_of(seed, 10, tracks, NOISE, motion, planar), NOISE);
                let plane = of(Motion::General, true);
                let rotation = of(Motion::Rotation, false);
                let translation = of(Motion::Translation, false);
                let forward = of(Motion::Forward, false);
                let general = of(Motion::General, false);
                println!("seed {seed}, {tracks} tracks: plane {plane:.2?} rotation {rotation:.2?}");
                println!("  translation {translation:.2?} forward {forward:.2?} general {general:.2?}");
                assert!(fits(plane[0]) && plane[1] > 3.0 && plane[2] > 3.0, "seed {seed}: {plane:?}");
                assert!(fits(rotation[0]) && fits(rotation[1]) && rotation[2] > 3.0, "seed {seed}: {rotation:?}");
                assert!(fits(translation[2]) && translation[0] > 3.0, "seed {seed}: {translation:?}");
                assert!(fits(forward[2]) && forward[0] > 2.0, "seed {seed}: {forward:?}");
                assert!(general.iter().all(|&ratio| ratio > 3.0), "seed {seed}: {general:?}");
            }
        }
    }

    #[test]
    fn missing_observations_are_carried_and_hostile_ones_give_none() {
        let mut scene = testing::scene_of(3, 8, 40, NOISE, Motion::Translation, false);
        scene.observations.retain(|seen| (seen.view + 3 * seen.point) % 4 != 0);
        let fit = fit_translation(&scene.observations, 8, 40, NOISE, 5.0, &StopToken::default()).expect("a fit");
        let ratio = fit.cost / (NOISE * NOISE * (2 * scene.observations.len() - fit.unknowns) as f64);
        assert!((0.6..1.4).contains(&ratio), "{ratio}");
        let stop = StopToken::default();
        assert!(fit_translation(&[], 0, 0, NOISE, 5.0, &stop).is_none());
        assert!(reference_homographies(&[], 3, 0, NOISE).is_none());
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::new(f64::NAN, 1e200));
        assert!(fit_translation(&scene.observations, 8, 40, NOISE, 5.0, &stop).is_none());
        assert!(reference_homographies(&scene.observations, 8, 40, NOISE).is_none());
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::new(0.25, 0.5));
        fit_translation(&scene.observations, 8, 40, NOISE, 5.0, &stop);
        if let Some(start) = reference_homographies(&scene.observations, 8, 40, NOISE) {
            fit_homographies(start, &scene.observations, ADJUSTMENT_ITERATIONS, &stop);
        }
        if let Some(start) = rotation_start(&scene.observations, 8, 40, NOISE) {
            fit_rotation(&start, &scene.observations, &[0; 8], FULL, &PRIORS, &stop);
            assert!(fit_rotation(&start, &scene.observations, &[1; 8], FULL, &PRIORS, &stop).is_none());
        }
    }
}
