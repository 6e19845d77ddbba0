//! The similarity between two reconstructions, from observations of points of one by cameras of the other: the
//! generalised pose and scale problem (Ventura, Arth, Reitmayr & Schmalstieg 2014), both ways at once.
//!
//! Three points that one camera sees determine its pose in the other reconstruction, hence all but the scale. An
//! observation of a fourth point by another camera determines the scale.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix3, Rotation3, SVector, Vector2, Vector3};
use rand::Rng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use super::bundle::metric::{Intrinsics, Pose, Projection};
use super::levenberg_marquardt::Normal;
use super::pose;
use super::ransac::{self, Estimator, RobustModel};
use crate::domain::StopToken;

/// Samples at most. Where half of the observations are right, one sample in sixteen is, and seventy suffice; where a
/// quarter of a camera's are, one in 256 is, and 1,200 suffice.
const MOST_SAMPLES: usize = 2_000;
/// Observations of one camera that determine its pose.
const OF_CAMERA: usize = 3;
/// Unknowns: rotation, translation and the logarithm of the scale.
const UNKNOWNS: usize = 7;

/// Takes points of the second reconstruction to the first: `X -> s R X + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Similarity {
    pub scale: f64,
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Similarity {
    /// Where a point of the second reconstruction is in the first.
    pub fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.scale * (self.rotation * point) + self.translation
    }

    /// The pose in the first reconstruction of a camera of the second.
    pub fn pose(&self, pose: &Pose) -> Pose {
        let rotation = pose.rotation * self.rotation.transpose();
        Pose { rotation, translation: self.scale * pose.translation - rotation * self.translation }
    }
}

/// An observation of a point of one reconstruction by a camera of the other.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CrossObservation {
    pub track: usize,
    /// Number of the camera among all of both reconstructions.
    pub camera: usize,
    /// Of the camera in its own reconstruction.
    pub pose: Pose,
    /// Whether that is the second one.
    pub is_second: bool,
    /// In the other reconstruction.
    pub point: Vector3<f64>,
    /// Image `(u, v)` at unit depth, distortion undone.
    pub xy: Vector2<f64>,
    /// Of the squared distance, see [`Observation::weight`](super::observation::Observation::weight).
    pub weight: f64,
}

impl CrossObservation {
    /// Camera and point in the first reconstruction.
    fn in_first(&self, similarity: &Similarity) -> (Pose, Vector3<f64>) {
        match self.is_second {
            true => (similarity.pose(&self.pose), self.point),
            false => (self.pose, similarity.apply(&self.point)),
        }
    }
}

/// The similarity that most observations agree with, refined on those that do; an inlier is in front of its camera.
///
/// * `gate`: squared distance within which an observation of weight 1 agrees, at unit depth
///
/// Returns `None` where no camera has three observations beside those of others, or no sample gives a similarity.
pub(crate) fn robust(
    observations: &[CrossObservation],
    gate: f64,
    rng: &mut ChaCha8Rng,
    stop: &StopToken,
) -> Option<RobustModel<Similarity>> {
    let observations = CrossObservations::new(observations);
    if observations.of_cameras.is_empty() {
        return None;
    }
    ransac::estimate(&observations, gate, None, 0, MOST_SAMPLES, rng, stop)
}

struct CrossObservations<'a> {
    observations: &'a [CrossObservation],
    /// The observations of each camera that may be sampled.
    of_cameras: Vec<Vec<usize>>,
}

impl<'a> CrossObservations<'a> {
    fn new(observations: &'a [CrossObservation]) -> Self {
        let cameras = observations.iter().map(|seen| seen.camera + 1).max().unwrap_or(0);
        let mut of_cameras = vec![Vec::new(); cameras];
        observations.iter().enumerate().for_each(|(k, seen)| of_cameras[seen.camera].push(k));
        of_cameras.retain(|own: &Vec<usize>| own.len() >= OF_CAMERA && own.len() < observations.len());
        Self { observations, of_cameras }
    }

    /// The similarities that three observations of one camera and one of another determine; none where these are not of
    /// four tracks.
    fn of_sample(&self, own: [usize; OF_CAMERA], other: usize) -> impl Iterator<Item = Similarity> {
        let own = own.map(|datum| self.observations[datum]);
        let other = self.observations[other];
        let CrossObservation { pose, is_second, .. } = own[0];
        let is_new = own.iter().all(|own| own.track != other.track);
        let found = is_new.then(|| pose::three_points(&own.map(|own| own.point), &own.map(|own| own.xy)));
        found.into_iter().flatten().filter_map(move |there| {
            // Of the first and of the second reconstruction; in camera coordinates they differ by the scale alone.
            let (first, second) = if is_second { (there, pose) } else { (pose, there) };
            let rotation = first.rotation.transpose() * second.rotation;
            // The translation is this times the scale, and that.
            let (scaled, fixed) =
                (first.rotation.tr_mul(&second.translation), -first.rotation.tr_mul(&first.translation));
            // The point in camera coordinates: the one times the scale, and the other.
            let (by_scale, without) = match other.is_second {
                true => {
                    let turn = other.pose.rotation * rotation.transpose();
                    (other.pose.translation - turn * scaled, turn * (other.point - fixed))
                }
                false => (
                    other.pose.rotation * (rotation * other.point + scaled),
                    other.pose.rotation * fixed + other.pose.translation,
                ),
            };
            let ray = other.xy.push(1.0);
            let (across, along) = (ray.cross(&by_scale), ray.cross(&without));
            let scale = -across.dot(&along) / across.norm_squared();
            let translation = scale * scaled + fixed;
            (scale > 0.0 && scale.is_finite()).then_some(Similarity { scale, rotation, translation })
        })
    }
}

impl Estimator<UNKNOWNS> for CrossObservations<'_> {
    type Model = Similarity;

    const SAMPLE: usize = OF_CAMERA + 1;

    fn len(&self) -> usize {
        self.observations.len()
    }

    /// Three observations of one camera, and one of another.
    fn sample(&self, rng: &mut ChaCha8Rng) -> Vec<usize> {
        let own = &self.of_cameras[rng.random_range(0..self.of_cameras.len())];
        let mut sample: Vec<usize> = index::sample(rng, own.len(), OF_CAMERA).into_iter().map(|k| own[k]).collect();
        // One of the others: the camera's own, in rising order, are passed over.
        let other = rng.random_range(0..self.len() - own.len());
        sample.push(own.iter().fold(other, |other, &datum| other + usize::from(datum <= other)));
        sample
    }

    fn minimal(&self, sample: &[usize]) -> impl IntoIterator<Item = Similarity> {
        self.of_sample([sample[0], sample[1], sample[2]], sample[3])
    }

    /// Infinite behind the camera.
    fn squared_residual(&self, similarity: &Similarity, datum: usize) -> f64 {
        let seen = &self.observations[datum];
        let (pose, point) = seen.in_first(similarity);
        let placed = pose.apply(&point);
        let squared = (placed.xy() / placed.z - seen.xy).norm_squared();
        if placed.z > 0.0 { seen.weight * squared } else { f64::INFINITY }
    }

    fn residual(
        &self,
        similarity: &Similarity,
        datum: usize,
    ) -> Option<(Vector2<f64>, [SVector<f64, UNKNOWNS>; 2], f64)> {
        let seen = &self.observations[datum];
        let (pose, point) = seen.in_first(similarity);
        let intrinsics = Intrinsics::from_focal(1.0);
        let projection = Projection::new(&intrinsics, &pose, &point);
        if projection.at.z <= 0.0 {
            return None;
        }
        let gradients = projection.gradients();
        let of = |k: usize| {
            let by_point = gradients.by_point[k];
            let [.., x, y, z] = gradients.by_pose[k];
            let (arm, sign, by_scale) = match seen.is_second {
                true => {
                    let moved = similarity.scale * seen.pose.translation;
                    (point - similarity.translation, -1.0, Vector3::new(x, y, z).dot(&moved))
                }
                false => {
                    let arm = point - similarity.translation;
                    (arm, 1.0, arm.dot(&by_point))
                }
            };
            let (turn, shift) = (sign * arm.cross(&by_point), sign * by_point);
            SVector::from([turn.x, turn.y, turn.z, shift.x, shift.y, shift.z, by_scale])
        };
        Some((projection.image - seen.xy, [of(0), of(1)], seen.weight))
    }

    fn moved(&self, similarity: &Similarity, step: &SVector<f64, UNKNOWNS>) -> Option<Similarity> {
        Some(Similarity {
            scale: similarity.scale * step[6].exp(),
            rotation: Rotation3::from_scaled_axis(Vector3::new(step[0], step[1], step[2])) * similarity.rotation,
            translation: similarity.translation + Vector3::new(step[3], step[4], step[5]),
        })
    }
}

/// What bears a similarity out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Support {
    /// Tracks of which most observations agree, and all that there are.
    pub agreeing: usize,
    pub tracks: usize,
    /// Tracks of which observations agree beside those of the camera that has most: one camera says nothing of the scale.
    pub beside_one_camera: usize,
    /// One standard deviation of the logarithm of the scale, by the observations that agree; infinite where they do not
    /// determine the similarity.
    pub sigma_log_scale: f64,
}

impl Support {
    /// * `noise`: one standard deviation of a coordinate of an observation of weight 1
    pub fn new(observations: &[CrossObservation], found: &RobustModel<Similarity>, noise: f64) -> Self {
        let agreeing = || observations.iter().zip(&found.inlier).filter(|(_, agrees)| **agrees).map(|(seen, _)| seen);
        let tracks_of = |of_camera: &dyn Fn(usize) -> bool| -> BTreeSet<usize> {
            agreeing().filter(|seen| of_camera(seen.camera)).map(|seen| seen.track).collect()
        };
        let cameras: BTreeSet<usize> = agreeing().map(|seen| seen.camera).collect();
        let beside = cameras.iter().map(|one| tracks_of(&|camera| camera != *one).len()).min();
        let mut counts: BTreeMap<usize, (usize, usize)> = BTreeMap::new();
        for (seen, agrees) in observations.iter().zip(&found.inlier) {
            let (agreeing, all) = counts.entry(seen.track).or_default();
            *agreeing += usize::from(*agrees);
            *all += 1;
        }
        let mut normal = Normal::<UNKNOWNS>::zeros();
        let data = CrossObservations { observations, of_cameras: Vec::new() };
        for datum in (0..observations.len()).filter(|&datum| found.inlier[datum]) {
            let Some((residual, gradients, weight)) = data.residual(&found.model, datum) else { continue };
            for (gradient, residual) in gradients.iter().zip(residual.iter()) {
                normal.add(gradient, *residual, weight);
            }
        }
        let variance = normal.matrix.cholesky().map(|factor| factor.inverse()[(UNKNOWNS - 1, UNKNOWNS - 1)]);
        Self {
            agreeing: counts.values().filter(|(agreeing, all)| 2 * agreeing > *all).count(),
            tracks: counts.len(),
            beside_one_camera: beside.unwrap_or(0),
            sigma_log_scale: variance.map_or(f64::INFINITY, |variance| noise * variance.sqrt()),
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::super::bundle::testing;
    use super::*;
    use crate::geometry::statistics::CHI_SQUARE_OF_TWO;

    const NOISE: f64 = 1e-3;

    /// Two observations of each point of a scene of six views across two reconstructions, the first three views and the
    /// others in a frame of their own, and the similarity between them. The first half of the points is of the first.
    fn observations(seed: u64, points: usize, noise: f64) -> (Vec<CrossObservation>, Similarity) {
        let scene = testing::scene(seed, 6, points, 0.0);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let truth = Similarity {
            scale: 0.3,
            rotation: Rotation3::from_scaled_axis(Vector3::new(0.4, -0.7, 0.2)).into_inner(),
            translation: Vector3::new(1.0, -2.0, 0.5),
        };
        let back = |point: &Vector3<f64>| truth.rotation.tr_mul(&(point - truth.translation)) / truth.scale;
        // The inverse of `Similarity::pose`.
        let own = |pose: &Pose| Pose {
            rotation: pose.rotation * truth.rotation,
            translation: (pose.translation + pose.rotation * truth.translation) / truth.scale,
        };
        let mut found = Vec::new();
        for (k, point) in scene.points.iter().enumerate() {
            let is_second = k < points / 2;
            for view in if is_second { [3, 4] } else { [1, 2] } {
                let placed = scene.poses[view].apply(point);
                let shift = noise * Vector2::new(testing::normal(&mut rng), testing::normal(&mut rng));
                found.push(CrossObservation {
                    track: k,
                    camera: view,
                    pose: if is_second { own(&scene.poses[view]) } else { scene.poses[view] },
                    is_second,
                    point: if is_second { *point } else { back(point) },
                    xy: placed.xy() / placed.z + shift,
                    weight: 1.0,
                });
            }
        }
        (found, truth)
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        const STEP: f64 = 1e-6;
        let (data, truth) = observations(1, 8, 0.01);
        let estimator = CrossObservations::new(&data);
        for datum in 0..data.len() {
            let (_, gradients, _) = estimator.residual(&truth, datum).expect("in front");
            for unknown in 0..UNKNOWNS {
                let at = |by: f64| {
                    let mut step = SVector::<f64, UNKNOWNS>::zeros();
                    step[unknown] = by;
                    let moved = estimator.moved(&truth, &step).expect("a similarity");
                    estimator.residual(&moved, datum).expect("in front").0
                };
                let slope = (at(STEP) - at(-STEP)) / (2.0 * STEP);
                let expected = Vector2::new(gradients[0][unknown], gradients[1][unknown]);
                assert!((slope - expected).norm() < 1e-6, "datum {datum}, unknown {unknown}: {slope} {expected}");
            }
        }
    }

    #[test]
    fn seven_points_tell_it_where_no_camera_sees_more_than_four() {
        for seed in 0..20 {
            let (data, truth) = observations(seed, 7, NOISE);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let gate = CHI_SQUARE_OF_TWO * NOISE * NOISE;
            let found = robust(&data, gate, &mut rng, &StopToken::default()).expect("a similarity");
            let off = (found.model.scale / truth.scale).ln().abs();
            let turned = (found.model.rotation - truth.rotation).norm();
            println!("seed {seed}: scale off by {off:.1e}, rotation by {turned:.1e}, {}", found.inlier_count());
            assert!(off < 0.05 && turned < 0.05, "seed {seed}: scale off by {off}, rotation by {turned}");
            assert!(found.inlier_count() >= data.len() - 1, "seed {seed}: {:?}", found.inlier);
            let support = Support::new(&data, &found, NOISE);
            assert!(support.agreeing >= 6 && support.beside_one_camera >= 6, "seed {seed}: {support:?}");
            let sigmas = off / support.sigma_log_scale;
            assert!(sigmas < 4.0 && support.sigma_log_scale < 0.02, "seed {seed}: {sigmas} of {support:?}");
        }
    }

    #[test]
    fn half_of_the_points_may_be_wrong() {
        for seed in 0..20 {
            let (mut data, truth) = observations(seed, 24, NOISE);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for (k, seen) in data.iter_mut().enumerate() {
                if (k / 2) % 2 == 0 {
                    seen.xy = Vector2::new(rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4));
                }
            }
            let gate = CHI_SQUARE_OF_TWO * NOISE * NOISE;
            let found = robust(&data, gate, &mut rng, &StopToken::default()).expect("a similarity");
            let off = (found.model.scale / truth.scale).ln().abs();
            let right = found.inlier.iter().enumerate().filter(|(k, inlier)| ((k / 2) % 2 == 1) == **inlier).count();
            assert!(off < 0.05 && right >= 45, "seed {seed}: scale off by {off}, {right} of 48 verdicts right");
        }
    }

    /// A wrong observation by any other camera agrees with some scale, and two now and then.
    #[test]
    fn one_camera_does_not_determine_the_scale() {
        let mut agreeing = 0;
        for seed in 0..20 {
            let (mut data, _) = observations(seed, 24, NOISE);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            data.retain(|seen| seen.camera == 3 || seen.camera == 2);
            for seen in data.iter_mut().filter(|seen| seen.camera == 2) {
                seen.xy = Vector2::new(rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4));
            }
            let gate = CHI_SQUARE_OF_TWO * NOISE * NOISE;
            let found = robust(&data, gate, &mut rng, &StopToken::default()).expect("a similarity");
            let support = Support::new(&data, &found, NOISE);
            agreeing += support.agreeing;
            assert!(support.beside_one_camera <= 2, "seed {seed}: {support:?}");
        }
        assert!(agreeing > 20 * 12, "{agreeing}: one camera's agree in each");
    }

    #[test]
    fn what_determines_nothing_gives_nothing() {
        let (mut data, _) = observations(3, 12, NOISE);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut broken = data.clone();
        data.retain(|seen| seen.camera == 3);
        assert_eq!(robust(&data, 1e-5, &mut rng, &StopToken::default()), None);
        assert_eq!(robust(&[], 1e-5, &mut rng, &StopToken::default()), None);
        broken.iter_mut().for_each(|seen| seen.point = Vector3::from_element(f64::NAN));
        assert_eq!(robust(&broken, 1e-5, &mut rng, &StopToken::default()), None);
    }
}
