//! Fits special motions and scenes: a plane, a camera that only turns, one that only moves.
//!
//! Each fit is a maximum-likelihood one with its number of unknowns, so that it can be tested against projective
//! cameras, of which it is a special case.

use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};

use super::bundle::Options;
use super::bundle::critical::{
    BundleProblem, HOMOGRAPHIES_GAUGE, Homographies, TRANSLATING_GAUGE, Translating, minimise,
};
use super::bundle::metric::{self, Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Pose};
use super::daq::scan_focal;
use super::fundamental::{Fundamental, Match};
use super::homography::{Correspondences, LEAST_COMMON};
use super::null_vector::smallest_eigenvector;
use super::observation::Observation;
use super::procrustes::nearest_rotation;
use super::statistics::{CHI_SQUARE_OF_TWO, median};
use crate::domain::StopToken;

/// Focal lengths from which a rotation is looked for; neighbours are a fifth apart.
const FOCALS: usize = 16;
/// Rounds of alternation for the depths of a translation's start; the adjustment does the rest.
const DEPTH_ROUNDS: usize = 10;
/// Iterations of each adjustment: they start near the minimum, or the model is wrong and its cost only has to show it.
const ITERATIONS: usize = 30;

/// Share of the squared residuals of a point from which one observation makes up nearly all: three times as far off as
/// all others together.
const ALONE_SHARE: f64 = 0.9;
/// Observations of a point from which one of them is compared with the others. Of three, the one in the reference view
/// has no residual, and beside a second one that hardly moved, true depth would show in the third alone.
const LEAST_COMPARED: usize = 4;
/// Share of a view's observations up to which those are a minority. Homographies explain views whose points fit but for
/// the worst quarter, see [`median_residual`](super::homography::median_residual).
const MOST_ALONE: f64 = 0.25;

/// A model at its minimum.
#[derive(Debug, Clone)]
pub struct CriticalFit<M> {
    pub model: M,
    /// Sum of the squared residuals, normalised units.
    pub cost: f64,
    /// Unknowns that the observations could determine, the gauge taken off.
    pub unknowns: usize,
}

/// Homographies from a reference view, and where it sees each point: what fits without parallax start from.
#[derive(Debug, Clone)]
pub struct ReferenceHomographies {
    views: Vec<Matrix3<f64>>,
    positions: Vec<Option<Vector2<f64>>>,
}

impl ReferenceHomographies {
    /// Returns `None` where common points do not tie all views together.
    pub fn new(observations: &[Observation], views: usize, points: usize, noise: f64) -> Option<Self> {
        let seen = Correspondences::new(observations, views);
        let reference = seen.most_observed()?;
        let homographies = seen.homographies_from(reference, noise)?;
        let inverses: Vec<Matrix3<f64>> =
            homographies.iter().map(|homography| homography.try_inverse()).collect::<Option<_>>()?;
        let positions = positions(observations, views, points, reference, |seen| {
            let back = inverses[seen.view] * seen.xy.push(1.0);
            back.xy() / back.z
        });
        Some(Self { views: homographies, positions })
    }

    /// Which observations show a depth that nothing else confirms. Never those that noise explains.
    ///
    /// Behind homographies the fourth columns of the cameras are free. That of one view fits any one track, wrong or
    /// right: all observations of a point are unsupported that alone makes up most of the squared residuals of
    /// homographies in most of its views. Scaled up, it fits every track that slid along the epipolar lines of that
    /// view, and the points need hardly any depth for it: an observation is unsupported that makes up nearly all of the
    /// squared residuals of its point, in a view where these are a minority.
    ///
    /// * `noise`: one standard deviation of a coordinate, normalised units
    ///
    /// # Pitfall
    /// Points are where the reference view sees them: what slid in that view is not found.
    pub fn unsupported(&self, observations: &[Observation], noise: f64) -> Vec<bool> {
        let is_usable = |seen: &Observation| seen.is_usable(self.views.len(), self.positions.len());
        let missed = |seen: &Observation| {
            let moved = self.views[seen.view] * self.positions[seen.point].unwrap_or_default().push(1.0);
            Some((moved.xy() / moved.z - seen.xy).norm_squared()).filter(|missed| missed.is_finite())
        };
        let missed: Vec<Option<f64>> =
            observations.iter().map(|seen| missed(seen).filter(|_| is_usable(seen))).collect();
        let found = || observations.iter().zip(&missed).filter_map(|(seen, missed)| Some((seen, (*missed)?)));
        // Of two observations, the one in the reference view and this one.
        let by_noise = 2.0 * CHI_SQUARE_OF_TWO * noise * noise;
        let (mut of_view, mut of_point) = (vec![(0.0, 0); self.views.len()], vec![(0.0, 0); self.positions.len()]);
        for (seen, missed) in found() {
            for (sum, count) in [&mut of_view[seen.view], &mut of_point[seen.point]] {
                *sum += missed;
                *count += 1;
            }
        }
        let (mut dominant, mut alone) = (vec![0; self.positions.len()], vec![0; self.views.len()]);
        let is_alone = |seen: &Observation, missed: f64| {
            let (of_point, observed) = of_point[seen.point];
            observed >= LEAST_COMPARED && missed > by_noise && missed > ALONE_SHARE * of_point
        };
        for (seen, missed) in found() {
            dominant[seen.point] += usize::from(missed > by_noise && missed > of_view[seen.view].0 / 2.0);
            alone[seen.view] += usize::from(is_alone(seen, missed));
        }
        let is_unsupported = |(seen, missed): (&Observation, &Option<f64>)| {
            is_usable(seen) && 2 * dominant[seen.point] > of_point[seen.point].1
                || missed.is_some_and(|missed| {
                    let is_minority = alone[seen.view] as f64 <= MOST_ALONE * of_view[seen.view].1 as f64;
                    is_minority && is_alone(seen, missed)
                })
        };
        observations.iter().zip(&missed).map(is_unsupported).collect()
    }

    fn observed(&self) -> usize {
        self.positions.iter().flatten().count()
    }
}

/// Fits a plane.
pub fn fit_plane(
    start: &ReferenceHomographies,
    observations: &[Observation],
    stop: &StopToken,
) -> CriticalFit<Homographies> {
    let points = start.positions.iter().map(|position| position.unwrap_or_default()).collect();
    let plane = Homographies { views: start.views.clone(), points };
    fit_homographies(plane, start.observed(), observations, ITERATIONS, stop)
}

/// Fits a camera that only turns, first with its focal length alone free, then with this model.
///
/// * `group_of`: camera group of each view
/// * `priors`: of the intrinsics of each group
///
/// Returns `None` where a view has no group or a group no prior, and where the homographies are no numbers.
pub fn fit_rotation(
    start: &ReferenceHomographies,
    observations: &[Observation],
    group_of: &[usize],
    model: IntrinsicsModel,
    priors: &[IntrinsicsPrior],
    stop: &StopToken,
) -> Option<CriticalFit<MetricReconstruction>> {
    if group_of.len() != start.views.len() || group_of.iter().any(|&group| group >= priors.len()) {
        return None;
    }
    let mut rotation = nearest_rotation_of(&start.views, observations, start.positions.len())?;
    rotation.group_of = group_of.to_vec();
    rotation.intrinsics.resize(priors.len(), rotation.intrinsics[0]);
    if model.is_per_view() {
        rotation = rotation.with_own_focals();
    }
    let simplest = IntrinsicsModel::focal(model.is_per_view());
    let options = Options::squared(ITERATIONS);
    metric::adjust(&mut rotation, observations, simplest, priors, &options, stop);
    let report = metric::adjust(&mut rotation, observations, model, priors, &options, stop);
    let cost = report.cost - IntrinsicsPrior::cost_of(priors, model, &rotation.intrinsics);
    let unknowns = rotation.unknowns(start.observed(), model.parameters().len() * priors.len());
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
    start: Homographies,
    observed: usize,
    observations: &[Observation],
    iterations: usize,
    stop: &StopToken,
) -> CriticalFit<Homographies> {
    let unknowns = 8 * start.views.len() + 2 * observed;
    adjusted(start, unknowns, HOMOGRAPHIES_GAUGE, iterations, observations, stop)
}

/// The camera that only turns which these homographies are nearest to, its principal point in the centre.
fn nearest_rotation_of(
    homographies: &[Matrix3<f64>],
    observations: &[Observation],
    points: usize,
) -> Option<MetricReconstruction> {
    let (intrinsics, rotations) = nearest_rotations(homographies)?;
    let mut directions: Vec<Option<Vector3<f64>>> = vec![None; points];
    for seen in observations.iter().filter(|seen| seen.is_usable(rotations.len(), points)) {
        directions[seen.point]
            .get_or_insert_with(|| rotations[seen.view].tr_mul(&(seen.xy / intrinsics.focal).push(1.0)).normalize());
    }
    let pose = |rotation: Matrix3<f64>| Pose { rotation, translation: Vector3::zeros() };
    let directions = directions.into_iter().map(|direction| direction.unwrap_or_else(Vector3::z)).collect();
    let rotation = MetricReconstruction::new(intrinsics, rotations.into_iter().map(pose).collect(), directions);
    Some(MetricReconstruction { has_common_centre: true, ..rotation })
}

/// Where the reference view sees each point: as observed there, else by its first observation elsewhere.
///
/// * `back`: takes an observation into the reference view
fn positions(
    observations: &[Observation],
    views: usize,
    points: usize,
    reference: usize,
    back: impl Fn(&Observation) -> Vector2<f64>,
) -> Vec<Option<Vector2<f64>>> {
    let mut positions = vec![None; points];
    for seen in observations.iter().filter(|seen| seen.view < views && seen.point < points) {
        let slot = &mut positions[seen.point];
        if slot.is_none() || seen.view == reference {
            *slot = Some(back(seen)).filter(|position| position.iter().all(|value| value.is_finite())).or(*slot);
        }
    }
    positions
}

fn adjusted<const C: usize, const P: usize, M: BundleProblem<C, P>>(
    mut model: M,
    unknowns: usize,
    gauge: usize,
    iterations: usize,
    observations: &[Observation],
    stop: &StopToken,
) -> CriticalFit<M> {
    let report = minimise(&mut model, observations, &Options::squared(iterations), stop);
    CriticalFit { model, cost: report.cost, unknowns: unknowns.saturating_sub(gauge) }
}

/// The focal length, principal point in the centre, with which the homographies are nearest to rotations, and these.
fn nearest_rotations(homographies: &[Matrix3<f64>]) -> Option<(Intrinsics, Vec<Matrix3<f64>>)> {
    let candidates = (0..FOCALS).map(|k| {
        let intrinsics = Intrinsics::from_focal(scan_focal(k, FOCALS));
        let forward = intrinsics.matrix();
        let back = Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, intrinsics.focal) / intrinsics.focal;
        let (mut rotations, mut distance) = (Vec::with_capacity(homographies.len()), 0.0);
        for homography in homographies {
            let moved = back * homography * forward;
            let moved = moved / moved.determinant().cbrt();
            let rotation = nearest_rotation(&moved).unwrap_or_else(Matrix3::identity);
            distance += (moved - rotation).norm_squared();
            rotations.push(rotation);
        }
        (if distance.is_finite() { distance } else { f64::INFINITY }, intrinsics, rotations)
    });
    let (_, intrinsics, rotations) = candidates.min_by(|a, b| a.0.total_cmp(&b.0))?;
    Some((intrinsics, rotations))
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
        residuals.push(epipolar_residual(&pairs, &epipoles[view]));
    }
    if median(&mut residuals) > limit * noise {
        return None;
    }
    let positions = positions(observations, views, points, reference, |seen| seen.xy);
    let observed = positions.iter().flatten().count();
    let at_unit_depth = positions.into_iter().map(|position| position.unwrap_or_default().push(1.0));
    let mut model = Translating { translations: epipoles, points: at_unit_depth.collect() };
    alternate(&mut model, observations, reference);
    Some(adjusted(model, 3 * views + 3 * observed, TRANSLATING_GAUGE, ITERATIONS, observations, stop))
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

/// Median Sampson distance from the epipolar constraint `to . (e x from) = 0`.
fn epipolar_residual(pairs: &[Match], epipole: &Vector3<f64>) -> f64 {
    let fundamental = Fundamental::of_translation(*epipole);
    let mut residuals: Vec<f64> = pairs.iter().map(|seen| fundamental.sampson_squared(seen).sqrt()).collect();
    median(&mut residuals)
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
        let start = ReferenceHomographies::new(&scene.observations, views, points, noise).expect("complete tracks");
        let plane = fit_plane(&start, &scene.observations, &stop);
        let turning = fit_rotation(&start, &scene.observations, &vec![0; views], FULL, &PRIORS, &stop).expect("turns");
        let moving = fit_translation(&scene.observations, views, points, noise, f64::INFINITY, &stop);
        let moving = moving.expect("complete tracks");
        [
            reduced(plane.cost, plane.unknowns),
            reduced(turning.cost, turning.unknowns),
            reduced(moving.cost, moving.unknowns),
        ]
    }

    /// Of a plane, some tracks slide along the epipolar lines of one view: projective cameras fit them all.
    #[test]
    fn what_one_view_alone_says_of_depth_is_unsupported() {
        for seed in 0..10 {
            let mut scene = testing::scene_of(seed, 6, 60, NOISE, Motion::General, true);
            let (views, points) = (scene.poses.len(), scene.points.len());
            let start = |scene: &TestScene| {
                ReferenceHomographies::new(&scene.observations, views, points, NOISE).expect("complete tracks")
            };
            let found = start(&scene).unsupported(&scene.observations, NOISE);
            let by_chance = found.iter().filter(|found| **found).count();
            assert!(by_chance <= 2, "seed {seed}: {by_chance} of a plane");
            let is_slid = |seen: &Observation| seen.view == 4 && seen.point < 9;
            for seen in scene.observations.iter_mut().filter(|seen| is_slid(seen)) {
                seen.xy += Vector2::new(0.06, 0.02) * (1.0 + 0.2 * seen.point as f64);
            }
            let found = start(&scene).unsupported(&scene.observations, NOISE);
            let told = scene.observations.iter().zip(&found).filter(|(seen, found)| is_slid(seen) == **found).count();
            assert!(told + 2 >= found.len(), "seed {seed}: {told} of {} told", found.len());
        }
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
        assert!(ReferenceHomographies::new(&[], 3, 0, NOISE).is_none());
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::new(f64::NAN, 1e200));
        assert!(fit_translation(&scene.observations, 8, 40, NOISE, 5.0, &stop).is_none());
        assert!(ReferenceHomographies::new(&scene.observations, 8, 40, NOISE).is_none());
        scene.observations.iter_mut().for_each(|seen| seen.xy = Vector2::new(0.25, 0.5));
        fit_translation(&scene.observations, 8, 40, NOISE, 5.0, &stop);
        if let Some(start) = ReferenceHomographies::new(&scene.observations, 8, 40, NOISE) {
            fit_plane(&start, &scene.observations, &stop);
            fit_rotation(&start, &scene.observations, &[0; 8], FULL, &PRIORS, &stop);
            assert!(fit_rotation(&start, &scene.observations, &[1; 8], FULL, &PRIORS, &stop).is_none());
        }
    }
}
