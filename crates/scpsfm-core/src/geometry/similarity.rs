//! The similarity between two reconstructions, by what cameras of either see of points of the other: the generalised
//! pose and scale problem (Ventura, Arth, Reitmayr & Schmalstieg 2014), both ways at once.
//!
//! Three points that one camera sees tell where it is in the other reconstruction, hence all but the scale; what any
//! other camera sees tells that.

use nalgebra::{Matrix3, Rotation3, SVector, Vector2, Vector3};
use rand::Rng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use super::bundle::metric::{Intrinsics, Pose, Projection};
use super::pose;
use super::ransac::{self, Estimator, Refinable, RobustModel};
use crate::domain::StopToken;

/// Samples at most: enough where three sightings in ten are right.
const MOST_SAMPLES: usize = 2_000;
/// Sightings of one camera that determine its pose.
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

/// What a camera sees of a point of the other reconstruction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sighting {
    /// Number of the camera among all of both reconstructions.
    pub camera: usize,
    /// Of the camera in its own reconstruction.
    pub pose: Pose,
    /// Whether that is the second one.
    pub is_second: bool,
    /// In the other reconstruction.
    pub point: Vector3<f64>,
    /// Image `(u, v)` at unit depth, distortion undone.
    pub seen: Vector2<f64>,
    /// Of the squared distance, see [`Observation::weight`](super::observation::Observation::weight).
    pub weight: f64,
}

impl Sighting {
    /// Camera and point in the first reconstruction.
    fn in_first(&self, similarity: &Similarity) -> (Pose, Vector3<f64>) {
        match self.is_second {
            true => (similarity.pose(&self.pose), self.point),
            false => (self.pose, similarity.apply(&self.point)),
        }
    }
}

/// The similarity that most sightings agree with, refined on those that do; an inlier is in front of its camera.
///
/// * `gate`: squared distance within which a sighting of weight 1 agrees, in units of depth
///
/// Returns `None` where no camera has three sightings beside another one, or no sample gives a similarity.
pub(crate) fn robust(
    sightings: &[Sighting],
    gate: f64,
    rng: &mut ChaCha8Rng,
    stop: &StopToken,
) -> Option<RobustModel<Similarity>> {
    let sightings = Sightings::new(sightings);
    if sightings.of_cameras.is_empty() {
        return None;
    }
    ransac::estimate(&sightings, gate, None, MOST_SAMPLES, rng, stop)
}

struct Sightings<'a> {
    sightings: &'a [Sighting],
    /// The sightings of each camera that may be sampled.
    of_cameras: Vec<Vec<usize>>,
}

impl<'a> Sightings<'a> {
    fn new(sightings: &'a [Sighting]) -> Self {
        let cameras = sightings.iter().map(|sighting| sighting.camera + 1).max().unwrap_or(0);
        let mut of_cameras = vec![Vec::new(); cameras];
        sightings.iter().enumerate().for_each(|(k, sighting)| of_cameras[sighting.camera].push(k));
        of_cameras.retain(|own: &Vec<usize>| own.len() >= OF_CAMERA && own.len() < sightings.len());
        Self { sightings, of_cameras }
    }

    /// The similarities that three sightings of one camera and one of another determine.
    fn of_sample(&self, own: [usize; OF_CAMERA], other: usize) -> impl Iterator<Item = Similarity> {
        let own = own.map(|datum| self.sightings[datum]);
        let other = self.sightings[other];
        let Sighting { pose, is_second, .. } = own[0];
        let found = pose::three_points(&own.map(|sighting| sighting.point), &own.map(|sighting| sighting.seen));
        found.into_iter().filter_map(move |there| {
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
            let ray = other.seen.push(1.0);
            let (across, along) = (ray.cross(&by_scale), ray.cross(&without));
            let scale = -across.dot(&along) / across.norm_squared();
            let translation = scale * scaled + fixed;
            (scale > 0.0 && scale.is_finite()).then_some(Similarity { scale, rotation, translation })
        })
    }
}

impl Estimator for Sightings<'_> {
    type Model = Similarity;

    const SAMPLE: usize = OF_CAMERA + 1;
    const SAMPLE_GATES: f64 = 4.0;

    fn len(&self) -> usize {
        self.sightings.len()
    }

    /// Three sightings of one camera, and one of another.
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
        let sighting = &self.sightings[datum];
        let (pose, point) = sighting.in_first(similarity);
        let placed = pose.apply(&point);
        let squared = (placed.xy() / placed.z - sighting.seen).norm_squared();
        if placed.z > 0.0 { sighting.weight * squared } else { f64::INFINITY }
    }

    fn refined(&self, similarity: &Similarity, gate: f64) -> Option<Similarity> {
        Some(ransac::refined(self, similarity, gate))
    }
}

impl Refinable<UNKNOWNS> for Sightings<'_> {
    fn residual(
        &self,
        similarity: &Similarity,
        datum: usize,
    ) -> Option<(Vector2<f64>, [SVector<f64, UNKNOWNS>; 2], f64)> {
        let sighting = &self.sightings[datum];
        let (pose, point) = sighting.in_first(similarity);
        let intrinsics = Intrinsics::from_focal(1.0);
        let projection = Projection::new(&intrinsics, &pose, &point);
        if projection.at.z <= 0.0 {
            return None;
        }
        let gradients = projection.gradients();
        let of = |k: usize| {
            let by_point = gradients.by_point[k];
            let [.., x, y, z] = gradients.by_pose[k];
            let (arm, sign, by_scale) = match sighting.is_second {
                true => {
                    let moved = similarity.scale * sighting.pose.translation;
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
        Some((projection.image - sighting.seen, [of(0), of(1)], sighting.weight))
    }

    fn moved(&self, similarity: &Similarity, step: &SVector<f64, UNKNOWNS>) -> Option<Similarity> {
        Some(Similarity {
            scale: similarity.scale * step[6].exp(),
            rotation: Rotation3::from_scaled_axis(Vector3::new(step[0], step[1], step[2])) * similarity.rotation,
            translation: similarity.translation + Vector3::new(step[3], step[4], step[5]),
        })
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::super::bundle::testing;
    use super::*;
    use crate::geometry::statistics::CHI_SQUARE_OF_TWO;

    const NOISE: f64 = 1e-3;

    /// What two reconstructions of a scene of six views see of each other's points, the first three views being one and
    /// the others the second in a frame of its own, and the similarity between them. Of these points, the first half is
    /// the first's; two observations of each are known to the other.
    fn sightings(seed: u64, points: usize, noise: f64) -> (Vec<Sighting>, Similarity) {
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
                found.push(Sighting {
                    camera: view,
                    pose: if is_second { own(&scene.poses[view]) } else { scene.poses[view] },
                    is_second,
                    point: if is_second { *point } else { back(point) },
                    seen: placed.xy() / placed.z + shift,
                    weight: 1.0,
                });
            }
        }
        (found, truth)
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        const STEP: f64 = 1e-6;
        let (data, truth) = sightings(1, 8, 0.01);
        let sightings = Sightings::new(&data);
        for datum in 0..data.len() {
            let (_, gradients, _) = sightings.residual(&truth, datum).expect("in front");
            for unknown in 0..UNKNOWNS {
                let at = |by: f64| {
                    let mut step = SVector::<f64, UNKNOWNS>::zeros();
                    step[unknown] = by;
                    let moved = sightings.moved(&truth, &step).expect("a similarity");
                    sightings.residual(&moved, datum).expect("in front").0
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
            let (sightings, truth) = sightings(seed, 7, NOISE);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let gate = CHI_SQUARE_OF_TWO * NOISE * NOISE;
            let found = robust(&sightings, gate, &mut rng, &StopToken::default()).expect("a similarity");
            let off = (found.model.scale / truth.scale).ln().abs();
            let turned = (found.model.rotation - truth.rotation).norm();
            println!("seed {seed}: scale off by {off:.1e}, rotation by {turned:.1e}, {}", found.inlier_count());
            assert!(off < 0.05 && turned < 0.05, "seed {seed}: scale off by {off}, rotation by {turned}");
            assert!(found.inlier_count() >= sightings.len() - 1, "seed {seed}: {:?}", found.inlier);
        }
    }

    #[test]
    fn half_of_the_points_may_be_wrong() {
        for seed in 0..20 {
            let (mut sightings, truth) = sightings(seed, 24, NOISE);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for (k, sighting) in sightings.iter_mut().enumerate() {
                if (k / 2) % 2 == 0 {
                    sighting.seen = Vector2::new(rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4));
                }
            }
            let gate = CHI_SQUARE_OF_TWO * NOISE * NOISE;
            let found = robust(&sightings, gate, &mut rng, &StopToken::default()).expect("a similarity");
            let off = (found.model.scale / truth.scale).ln().abs();
            let right = found.inlier.iter().enumerate().filter(|(k, inlier)| ((k / 2) % 2 == 1) == **inlier).count();
            assert!(off < 0.05 && right >= 45, "seed {seed}: scale off by {off}, {right} of 48 verdicts right");
        }
    }

    #[test]
    fn one_camera_does_not_tell_the_scale() {
        let (mut sightings, _) = sightings(3, 12, NOISE);
        sightings.retain(|sighting| sighting.camera == 3);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        assert_eq!(robust(&sightings, 1e-5, &mut rng, &StopToken::default()), None);
        assert_eq!(robust(&[], 1e-5, &mut rng, &StopToken::default()), None);
        let nowhere = Vector3::from_element(f64::NAN);
        let (mut broken, _) = self::sightings(3, 12, NOISE);
        broken.iter_mut().for_each(|sighting| sighting.point = nowhere);
        assert_eq!(robust(&broken, 1e-5, &mut rng, &StopToken::default()), None);
    }
}
