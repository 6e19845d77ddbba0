//! The pose of a calibrated camera from known points and their images.

use nalgebra::{Matrix4, RowVector4, SVector, Schur, Vector2, Vector3};
use rand_chacha::ChaCha8Rng;

use super::bundle::metric::{Intrinsics, Pose, Projection};
use super::observation::Correspondence;
use super::procrustes;
use super::ransac::{self, Estimator, RobustModel};
use crate::domain::StopToken;

/// Correspondences that determine a pose up to four solutions.
const SAMPLE: usize = 3;
/// Samples of the robust pose at most: enough where one correspondence in ten is right.
const MOST_SAMPLES: usize = 5_000;
/// Imaginary part of a root, relative to the root, that rounding explains.
const REAL: f64 = 1e-4;
/// Iterations of the eigenvalue solver; four eigenvalues take a dozen.
const MOST_EIGEN_ITERATIONS: usize = 200;
/// Newton steps that polish a root.
const POLISH: usize = 2;

/// Poses from which three points are seen along three directions (Grunert 1841, in the form of Haralick, Lee,
/// Ottenberg & Nolle 1994): up to four.
///
/// * `points`: in the world, not on a line
/// * `seen`: their images `(u, v)` at unit depth
pub(super) fn three_points(points: &[Vector3<f64>; SAMPLE], seen: &[Vector2<f64>; SAMPLE]) -> Vec<Pose> {
    let rays = seen.map(|uv| uv.push(1.0).normalize());
    let squared = |k: usize, l: usize| (points[k] - points[l]).norm_squared();
    let (a, b, c) = (squared(1, 2), squared(0, 2), squared(0, 1));
    let (alpha, beta, gamma) = (rays[1].dot(&rays[2]), rays[0].dot(&rays[2]), rays[0].dot(&rays[1]));
    let (q, w) = ((a - c) / b, (a + c) / b);
    // Coefficients of the quartic in v = s3 / s1, the constant first.
    let quartic = [
        (1.0 + q).powi(2) - 4.0 * a / b * gamma * gamma,
        4.0 * (-q * (1.0 + q) * beta + 2.0 * a / b * gamma * gamma * beta - (1.0 - w) * alpha * gamma),
        2.0 * (q * q - 1.0 + 2.0 * q * q * beta * beta + 2.0 * (b - c) / b * alpha * alpha
            - 4.0 * w * alpha * beta * gamma
            + 2.0 * (b - a) / b * gamma * gamma),
        4.0 * (q * (1.0 - q) * beta - (1.0 - w) * alpha * gamma + 2.0 * c / b * alpha * alpha * beta),
        (q - 1.0).powi(2) - 4.0 * c / b * alpha * alpha,
    ];
    let pose = |v: f64| {
        let u = ((q - 1.0) * v * v - 2.0 * q * beta * v + 1.0 + q) / (2.0 * (gamma - v * alpha));
        let first = (b / (1.0 + v * v - 2.0 * v * beta)).sqrt();
        let depths = [first, u * first, v * first];
        let usable = depths.iter().all(|depth| depth.is_finite() && *depth > 0.0);
        let placed: [Vector3<f64>; SAMPLE] = std::array::from_fn(|k| rays[k] * depths[k]);
        usable.then(|| procrustes::absolute_orientation(points, &placed, &[1.0; SAMPLE])).flatten()
    };
    positive_roots(&quartic).into_iter().filter_map(pose).collect()
}

/// Positive real roots of a quartic given from its constant up; none where it is no quartic or not finite.
fn positive_roots(quartic: &[f64; 5]) -> Vec<f64> {
    let [c0, c1, c2, c3, c4] = *quartic;
    let mut companion = Matrix4::zeros();
    companion.set_row(0, &RowVector4::new(-c3 / c4, -c2 / c4, -c1 / c4, -c0 / c4));
    companion.fixed_view_mut::<3, 3>(1, 0).fill_with_identity();
    if companion.iter().any(|entry| !entry.is_finite()) {
        return Vec::new();
    }
    let Some(schur) = Schur::try_new(companion, f64::EPSILON, MOST_EIGEN_ITERATIONS) else { return Vec::new() };
    let polish = |start: f64| {
        (0..POLISH).fold(start, |x, _| {
            let value = (((c4 * x + c3) * x + c2) * x + c1) * x + c0;
            let slope = ((4.0 * c4 * x + 3.0 * c3) * x + 2.0 * c2) * x + c1;
            let moved = x - value / slope;
            if moved.is_finite() { moved } else { x }
        })
    };
    let roots = schur.complex_eigenvalues();
    let real = roots.iter().filter(|root| root.im.abs() <= REAL * root.re.abs() && root.re > 0.0);
    real.map(|root| polish(root.re)).filter(|root| *root > 0.0).collect()
}

/// The pose that most correspondences agree with, refined on those that do; an inlier is in front of the camera.
///
/// * `seen`: points in the world, and their images `(u, v)` at unit depth, distortion undone
/// * `gate`: squared distance, in the same units, within which an image of weight 1 agrees
/// * `only_turns`: of a camera at the origin, which sees directions of any length: its pose has no translation
/// * `inliers_to_beat`: as of [`ransac::estimate`]
///
/// Returns `None` for fewer than three correspondences, two of a camera that only turns, or when no sample gives a
/// pose.
pub(crate) fn robust(
    seen: &[Correspondence<Vector3<f64>>],
    gate: f64,
    only_turns: bool,
    inliers_to_beat: usize,
    rng: &mut ChaCha8Rng,
    stop: &StopToken,
) -> Option<RobustModel<Pose>> {
    match only_turns {
        true => ransac::estimate(&Directions(seen), gate, None, inliers_to_beat, MOST_SAMPLES, rng, stop),
        false => ransac::estimate(&seen, gate, None, inliers_to_beat, MOST_SAMPLES, rng, stop),
    }
}

/// Points at infinity, from a camera at the origin.
struct Directions<'a>(&'a [Correspondence<Vector3<f64>>]);

impl Estimator<3> for Directions<'_> {
    type Model = Pose;

    const SAMPLE: usize = 2;

    fn len(&self) -> usize {
        self.0.len()
    }

    fn minimal(&self, sample: &[usize]) -> impl IntoIterator<Item = Pose> {
        let onto =
            |&datum: &usize| self.0[datum].xy.push(1.0).normalize() * self.0[datum].point.normalize().transpose();
        let rotation = procrustes::nearest_rotation(&sample.iter().map(onto).sum());
        rotation.map(|rotation| Pose { rotation, translation: Vector3::zeros() })
    }

    fn squared_residual(&self, pose: &Pose, datum: usize) -> f64 {
        self.0.squared_residual(pose, datum)
    }

    fn residual(&self, pose: &Pose, datum: usize) -> Option<(Vector2<f64>, [SVector<f64, 3>; 2], f64)> {
        let (residual, gradients, weight) = self.0.residual(pose, datum)?;
        Some((residual, gradients.map(|gradient| gradient.fixed_rows::<3>(0).into_owned()), weight))
    }

    fn moved(&self, pose: &Pose, step: &SVector<f64, 3>) -> Option<Pose> {
        Some(Pose { translation: Vector3::zeros(), ..pose.moved([step.x, step.y, step.z, 0.0, 0.0, 0.0]) })
    }
}

impl Estimator<6> for &[Correspondence<Vector3<f64>>] {
    type Model = Pose;

    const SAMPLE: usize = SAMPLE;

    fn len(&self) -> usize {
        <[_]>::len(self)
    }

    fn minimal(&self, sample: &[usize]) -> impl IntoIterator<Item = Pose> {
        let sample: [Correspondence<_>; SAMPLE] = ransac::chosen(self, sample);
        three_points(&sample.map(|seen| seen.point), &sample.map(|seen| seen.xy))
    }

    /// Infinite behind the camera.
    fn squared_residual(&self, pose: &Pose, datum: usize) -> f64 {
        let Correspondence { point, xy, weight } = &self[datum];
        let placed = pose.apply(point);
        let squared = (placed.xy() / placed.z - xy).norm_squared();
        if placed.z > 0.0 { weight * squared } else { f64::INFINITY }
    }

    fn residual(&self, pose: &Pose, datum: usize) -> Option<(Vector2<f64>, [SVector<f64, 6>; 2], f64)> {
        let Correspondence { point, xy, weight } = &self[datum];
        let intrinsics = Intrinsics::from_focal(1.0);
        let projection = Projection::new(&intrinsics, pose, point);
        let gradients = projection.gradients().by_pose.map(SVector::from);
        (projection.at.z > 0.0).then(|| (projection.image - xy, gradients, *weight))
    }

    fn moved(&self, pose: &Pose, step: &SVector<f64, 6>) -> Option<Pose> {
        Some(pose.moved((*step).into()))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use rand::{Rng, SeedableRng};

    use super::super::bundle::testing;
    use super::*;
    use crate::geometry::statistics::CHI_SQUARE_OF_TWO;

    /// Points of a scene and their exact images at unit depth in one view.
    fn correspondences(scene: &testing::TestScene, view: usize) -> (Vec<Vector3<f64>>, Vec<Vector2<f64>>) {
        let seen = scene.points.iter().map(|point| {
            let placed = scene.poses[view].apply(point);
            placed.xy() / placed.z
        });
        (scene.points.clone(), seen.collect())
    }

    fn of(points: &[Vector3<f64>], seen: &[Vector2<f64>], weights: &[f64]) -> Vec<Correspondence<Vector3<f64>>> {
        let seen = points.iter().zip(seen).zip(weights);
        seen.map(|((&point, &xy), &weight)| Correspondence { point, xy, weight }).collect()
    }

    fn distance(a: &Pose, b: &Pose) -> f64 {
        (a.rotation - b.rotation).norm() + (a.translation - b.translation).norm()
    }

    #[test]
    fn three_points_give_the_pose_among_at_most_four() {
        for seed in 0..20 {
            let scene = testing::scene(seed, 4, 12, 0.0);
            let (points, seen) = correspondences(&scene, 1);
            for first in 0..10 {
                let some = [points[first], points[first + 1], points[first + 2]];
                let found = three_points(&some, &[seen[first], seen[first + 1], seen[first + 2]]);
                let nearest = found.iter().map(|pose| distance(pose, &scene.poses[1])).fold(f64::INFINITY, f64::min);
                assert!(found.len() <= 4 && nearest < 1e-5, "seed {seed}, {first}: {} poses, {nearest}", found.len());
            }
        }
    }

    #[test]
    fn a_camera_that_turns_is_found_among_wrong_directions() {
        const NOISE: f64 = 1e-3;
        for seed in 0..10 {
            let scene = testing::scene(seed, 4, 60, NOISE);
            let turned = scene.poses[1].rotation;
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let directions: Vec<Vector3<f64>> =
                scene.points.iter().map(|point| turned.tr_mul(&scene.poses[1].apply(point))).collect();
            let mut seen: Vec<Vector2<f64>> = directions
                .iter()
                .map(|direction| {
                    let placed = turned * direction;
                    let noise = Vector2::new(rng.random::<f64>() - 0.5, rng.random::<f64>() - 0.5) * NOISE;
                    placed.xy() / placed.z + noise
                })
                .collect();
            seen[..36].rotate_left(7);
            let gate = CHI_SQUARE_OF_TWO * NOISE * NOISE;
            let seen = of(&directions, &seen, &[1.0; 60]);
            let found = robust(&seen, gate, true, 0, &mut rng, &StopToken::default());
            let RobustModel { model, inlier, .. } = found.expect("a rotation");
            let off = (model.rotation - turned).norm();
            println!("seed {seed}: off by {off:.1e}, {} inliers", inlier.iter().filter(|inlier| **inlier).count());
            assert!(off < 3.0 * NOISE && model.translation == Vector3::zeros(), "seed {seed}: {off}");
            assert!(inlier[36..].iter().all(|inlier| *inlier), "seed {seed}: {inlier:?}");
            let by_chance = inlier[..36].iter().filter(|inlier| **inlier).count();
            assert!(by_chance <= 2, "seed {seed}: {by_chance} wrong ones agree");
        }
        let (direction, image, mut rng) = ([Vector3::z()], [Vector2::zeros()], ChaCha8Rng::seed_from_u64(1));
        let one = of(&direction, &image, &[1.0]);
        assert_eq!(robust(&one, 1e-4, true, 0, &mut rng, &StopToken::default()), None);
    }

    #[test]
    fn degenerate_samples_give_no_pose_and_no_panic() {
        let same = Vector3::new(1.0, 2.0, 3.0);
        assert!(three_points(&[same; 3], &[Vector2::zeros(); 3]).is_empty());
        let nan = Vector3::from_element(f64::NAN);
        assert!(three_points(&[nan, same, same * 2.0], &[Vector2::zeros(); 3]).is_empty());
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let stop = StopToken::default();
        let seen = of(&[same; 9], &[Vector2::zeros(); 9], &[1.0; 9]);
        assert_eq!(robust(&seen[..2], 1e-4, false, 0, &mut rng, &stop), None);
        assert_eq!(robust(&seen, 1e-4, false, 0, &mut rng, &stop), None);
        assert_eq!(robust(&seen, f64::NAN, false, 0, &mut rng, &stop), None);
    }

    #[test]
    fn two_thirds_of_wrong_images_are_told_from_the_right_ones() {
        const NOISE: f64 = 1e-3;
        for seed in 0..10 {
            let scene = testing::scene(seed, 4, 90, 0.0);
            let (points, mut seen) = correspondences(&scene, 2);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for (k, image) in seen.iter_mut().enumerate() {
                *image += NOISE * Vector2::new(testing::normal(&mut rng), testing::normal(&mut rng));
                if k % 3 != 0 {
                    *image = Vector2::new(rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4));
                }
            }
            let (gate, weights) = (CHI_SQUARE_OF_TWO * NOISE * NOISE, vec![1.0; seen.len()]);
            let seen = of(&points, &seen, &weights);
            let found = robust(&seen, gate, false, 0, &mut rng, &StopToken::default()).expect("a pose");
            let right = found.inlier.iter().enumerate().filter(|(k, inlier)| (k % 3 == 0) == **inlier).count();
            let away = distance(&found.model, &scene.poses[2]);
            println!("seed {seed}: {right} of 90 verdicts right, pose off by {away}");
            assert!(right >= 87 && away < 20.0 * NOISE, "seed {seed}: {right} of 90, off by {away}");
        }
    }

    /// Half of the images are ten times as noisy as the others: where that is known, the pose is nearer.
    #[test]
    fn images_count_by_their_weight() {
        const NOISE: f64 = 1e-3;
        let (mut weighted, mut plain) = (0.0, 0.0);
        for seed in 0..20 {
            let scene = testing::scene(seed, 4, 60, 0.0);
            let (points, mut seen) = correspondences(&scene, 2);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let factor = |k: usize| if k.is_multiple_of(2) { 10.0 } else { 1.0 };
            for (k, image) in seen.iter_mut().enumerate() {
                *image += factor(k) * NOISE * Vector2::new(testing::normal(&mut rng), testing::normal(&mut rng));
            }
            let weights: Vec<f64> = (0..seen.len()).map(|k| 1.0 / (factor(k) * factor(k))).collect();
            let mut away = |weights: &[f64]| {
                let gate = CHI_SQUARE_OF_TWO * NOISE * NOISE;
                let seen = of(&points, &seen, weights);
                let found = robust(&seen, gate, false, 0, &mut rng, &StopToken::default()).expect("a pose");
                (distance(&found.model, &scene.poses[2]), found.inlier_count())
            };
            let (by_weights, by_all) = (away(&weights), away(&vec![1.0; seen.len()]));
            assert!(by_weights.1 >= 56 && by_all.1 < 45, "seed {seed}: {by_weights:?} {by_all:?}");
            weighted += by_weights.0;
            plain += by_all.0;
        }
        println!("off by {weighted} with weights, {plain} without");
        assert!(weighted < plain, "off by {weighted} with weights, {plain} without");
    }

    /// A tenth of the images nearly right at the gate of samples does not end the sampling: what counts is the gate.
    #[test]
    fn sampling_goes_on_until_enough_are_within_the_gate() {
        const NOISE: f64 = 1e-3;
        let gate = 4.0 * NOISE * NOISE;
        let mut right = 0;
        for seed in 0..40 {
            let scene = testing::scene(seed, 4, 100, 0.0);
            let (points, mut seen) = correspondences(&scene, 2);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            // Of the rest most agree, within twice the gate's width, with another pose.
            let other = Pose {
                rotation: Rotation3::from_scaled_axis(Vector3::new(0.05, -0.04, 0.03)) * scene.poses[2].rotation,
                translation: scene.poses[2].translation + Vector3::new(0.1, 0.05, -0.1),
            };
            for (k, image) in seen.iter_mut().enumerate() {
                if k >= 40 {
                    let placed = other.apply(&points[k]);
                    let angle = rng.random_range(0.0..std::f64::consts::TAU);
                    *image = placed.xy() / placed.z + 3.0 * NOISE * Vector2::new(angle.cos(), angle.sin());
                }
            }
            let seen = of(&points, &seen, &[1.0; 100]);
            let found = robust(&seen, gate, false, 0, &mut rng, &StopToken::default()).expect("a pose");
            let kept = found.inlier[..40].iter().filter(|&&inlier| inlier).count();
            right += usize::from(kept == 40);
        }
        println!("{right} of 40");
        assert_eq!(right, 40);
    }

    /// Where no more can agree than agreed with another pose, few samples are drawn.
    #[test]
    fn a_pose_that_beats_nothing_is_not_sought_for_long() {
        let scene = testing::scene(1, 4, 100, 0.0);
        let (points, mut seen) = correspondences(&scene, 2);
        seen[50..].reverse();
        let seen = of(&points, &seen, &[1.0; 100]);
        let drawn_for = |inliers_to_beat: usize| {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let found = robust(&seen, 1e-8, false, inliers_to_beat, &mut rng, &StopToken::default());
            (found.map_or(0, |found| found.inlier_count()), rng.get_word_pos())
        };
        let (inliers, of_all) = drawn_for(0);
        assert_eq!(inliers, 50);
        let (_, of_few) = drawn_for(99);
        assert!(4 * of_few < of_all, "{of_few} of {of_all}");
    }
}
