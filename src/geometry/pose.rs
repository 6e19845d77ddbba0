//! The pose of a calibrated camera from known points and their images.

use nalgebra::{Matrix4, Rotation3, SMatrix, SVector, Schur, Vector2, Vector3};
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use super::bundle::metric::Pose;
use super::procrustes;
use crate::domain::StopToken;

/// Correspondences that determine a pose up to four solutions.
const SAMPLE: usize = 3;
/// Samples of the robust pose at most: enough, at [`CONFIDENCE`], where one correspondence in ten is right.
const MOST_SAMPLES: usize = 5_000;
/// Probability with which one sample without outliers is to be among those drawn.
const CONFIDENCE: f64 = 0.99;
/// Gates within which an image agrees with a sample's pose: three noisy images make a noisier pose.
const SAMPLE_GATES: f64 = 4.0;
/// Steps of a refinement.
const REFINE_STEPS: usize = 10;
/// First damping of a refinement, relative to the diagonal, and its factors after a rejected and an accepted step.
const DAMPING: f64 = 1e-4;
const DAMPING_UP: f64 = 10.0;
const DAMPING_DOWN: f64 = 5.0;
/// Share of the cost below which a gain ends the refinement.
const TOLERANCE: f64 = 1e-6;
/// Imaginary part of a root, relative to the root, that rounding explains.
const REAL: f64 = 1e-4;
/// Iterations of the eigenvalue solver; four eigenvalues take a dozen.
const MOST_EIGEN_ITERATIONS: usize = 200;
/// Samples between two looks at the stop token: some milliseconds.
const STOP_EVERY: usize = 32;
/// Newton steps that polish a root.
const POLISH: usize = 2;

/// What most correspondences of a view agree on.
#[derive(Debug, Clone, PartialEq)]
pub struct Robust {
    pub pose: Pose,
    /// One a correspondence: within the gate and in front of the camera.
    pub inlier: Vec<bool>,
}

/// Poses from which three points are seen along three directions (Grunert 1841, in the form of Haralick, Lee,
/// Ottenberg & Nolle 1994): up to four.
///
/// * `points`: in the world, not on a line
/// * `seen`: their images `(u, v)` at unit depth
pub fn three_points(points: &[Vector3<f64>; SAMPLE], seen: &[Vector2<f64>; SAMPLE]) -> Vec<Pose> {
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
    let companion = Matrix4::new(
        -c3 / c4,
        -c2 / c4,
        -c1 / c4,
        -c0 / c4, //
        1.0,
        0.0,
        0.0,
        0.0, //
        0.0,
        1.0,
        0.0,
        0.0, //
        0.0,
        0.0,
        1.0,
        0.0,
    );
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

/// The pose that most correspondences agree with, refined on those that do (LO-RANSAC with truncated squared
/// distances).
///
/// * `seen`: images `(u, v)` at unit depth, distortion undone
/// * `gate`: squared distance, in the same units, within which an image agrees
///
/// Draws until [`CONFIDENCE`] is reached, [`MOST_SAMPLES`] at most; once `stop` fires, the best so far. Returns `None`
/// for fewer than three correspondences or when no sample gives a pose.
pub fn robust(
    points: &[Vector3<f64>],
    seen: &[Vector2<f64>],
    gate: f64,
    rng: &mut ChaCha8Rng,
    stop: &StopToken,
) -> Option<Robust> {
    if points.len() < SAMPLE || points.len() != seen.len() || gate.is_nan() || gate <= 0.0 {
        return None;
    }
    let wide = SAMPLE_GATES * gate;
    let mut best: Option<(Pose, f64)> = None;
    let (mut drawn, mut wanted) = (0, MOST_SAMPLES);
    while drawn < wanted && !(drawn % STOP_EVERY == 0 && stop.is_stopped()) {
        drawn += 1;
        let sample = index::sample(rng, points.len(), SAMPLE);
        let some: [Vector3<f64>; SAMPLE] = std::array::from_fn(|k| points[sample.index(k)]);
        let uv: [Vector2<f64>; SAMPLE] = std::array::from_fn(|k| seen[sample.index(k)]);
        for pose in three_points(&some, &uv) {
            let to_beat = best.map_or(f64::INFINITY, |(_, cost)| cost);
            let cost = truncated(&pose, points, seen, wide, to_beat);
            if cost < to_beat {
                // The refinement minimises another cost, and may do this one no good.
                let refined = refine(pose, points, seen, wide);
                let refined_cost = truncated(&refined, points, seen, wide, cost);
                let (better, cost) = if refined_cost < cost { (refined, refined_cost) } else { (pose, cost) };
                let share = inliers(&better, points, seen, wide).iter().filter(|&&inlier| inlier).count() as f64
                    / points.len() as f64;
                wanted = samples_wanted(share);
                best = Some((better, cost));
            }
        }
    }
    let (pose, _) = best?;
    let pose = refine(pose, points, seen, gate);
    Some(Robust { inlier: inliers(&pose, points, seen, gate), pose })
}

fn samples_wanted(share: f64) -> usize {
    let all_right = share.powi(SAMPLE as i32);
    if all_right >= 1.0 {
        return 1;
    }
    let wanted = ((1.0 - CONFIDENCE).ln() / (-all_right).ln_1p()).ceil();
    if wanted < MOST_SAMPLES as f64 { wanted as usize } else { MOST_SAMPLES }
}

/// Squared distance of an image from where the pose puts it; infinite behind the camera.
fn squared_distance(pose: &Pose, point: &Vector3<f64>, seen: &Vector2<f64>) -> f64 {
    let placed = pose.apply(point);
    if placed.z > 0.0 { (placed.xy() / placed.z - seen).norm_squared() } else { f64::INFINITY }
}

fn inliers(pose: &Pose, points: &[Vector3<f64>], seen: &[Vector2<f64>], gate: f64) -> Vec<bool> {
    points.iter().zip(seen).map(|(point, seen)| squared_distance(pose, point, seen) < gate).collect()
}

/// Sum of squared distances, each of the gate at most; given up once it reaches `to_beat`.
fn truncated(pose: &Pose, points: &[Vector3<f64>], seen: &[Vector2<f64>], gate: f64, to_beat: f64) -> f64 {
    let mut cost = 0.0;
    for (point, seen) in points.iter().zip(seen) {
        cost += squared_distance(pose, point, seen).min(gate);
        if cost >= to_beat {
            break;
        }
    }
    cost
}

/// Levenberg-Marquardt on the distances under a Geman-McClure loss of scale `sqrt(gate)`; never worse than the start.
pub fn refine(start: Pose, points: &[Vector3<f64>], seen: &[Vector2<f64>], gate: f64) -> Pose {
    let robust_cost = |pose: &Pose| -> f64 {
        let one = |squared: f64| if squared.is_finite() { squared / (squared + gate) } else { 1.0 };
        points.iter().zip(seen).map(|(point, seen)| one(squared_distance(pose, point, seen))).sum()
    };
    let mut pose = start;
    let mut cost = robust_cost(&pose);
    let mut damping = DAMPING;
    for _ in 0..REFINE_STEPS {
        let (normal, gradient) = linearised(&pose, points, seen, gate);
        let mut damped = normal;
        for k in 0..6 {
            damped[(k, k)] += damping * normal[(k, k)] + f64::MIN_POSITIVE;
        }
        let Some(step) = damped.cholesky().map(|factor| factor.solve(&gradient)) else { break };
        let moved = Pose {
            rotation: Rotation3::from_scaled_axis(-step.fixed_rows::<3>(0)) * pose.rotation,
            translation: pose.translation - step.fixed_rows::<3>(3),
        };
        let there = robust_cost(&moved);
        if there < cost {
            let gain = cost - there;
            (pose, cost) = (moved, there);
            damping /= DAMPING_DOWN;
            if gain < TOLERANCE * cost {
                break;
            }
        } else {
            damping *= DAMPING_UP;
        }
    }
    pose
}

/// Normal matrix and gradient of the weighted squares; rotation (on the left) first, then translation.
fn linearised(
    pose: &Pose,
    points: &[Vector3<f64>],
    seen: &[Vector2<f64>],
    gate: f64,
) -> (SMatrix<f64, 6, 6>, SVector<f64, 6>) {
    let mut normal = SMatrix::<f64, 6, 6>::zeros();
    let mut gradient = SVector::<f64, 6>::zeros();
    for (point, seen) in points.iter().zip(seen) {
        let turned = pose.rotation * point;
        let placed = turned + pose.translation;
        if placed.z <= 0.0 {
            continue;
        }
        let scale = placed.z.recip();
        let uv = placed.xy() * scale;
        let residual = uv - seen;
        let weight = (gate / (residual.norm_squared() + gate)).powi(2);
        let by_placed = [Vector3::new(scale, 0.0, -uv.x * scale), Vector3::new(0.0, scale, -uv.y * scale)];
        for (component, by) in by_placed.iter().enumerate() {
            let mut row = SVector::<f64, 6>::zeros();
            row.fixed_rows_mut::<3>(0).copy_from(&turned.cross(by));
            row.fixed_rows_mut::<3>(3).copy_from(by);
            normal += weight * row * row.transpose();
            gradient += weight * residual[component] * row;
        }
    }
    (normal, gradient)
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};

    use super::super::bundle::testing;
    use super::*;

    /// Points of a scene and their exact images at unit depth in one view.
    fn correspondences(scene: &testing::TestScene, view: usize) -> (Vec<Vector3<f64>>, Vec<Vector2<f64>>) {
        let seen = scene.points.iter().map(|point| {
            let placed = scene.poses[view].apply(point);
            placed.xy() / placed.z
        });
        (scene.points.clone(), seen.collect())
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
    fn degenerate_samples_give_no_pose_and_no_panic() {
        let same = Vector3::new(1.0, 2.0, 3.0);
        assert!(three_points(&[same; 3], &[Vector2::zeros(); 3]).is_empty());
        let nan = Vector3::from_element(f64::NAN);
        assert!(three_points(&[nan, same, same * 2.0], &[Vector2::zeros(); 3]).is_empty());
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let stop = StopToken::default();
        assert_eq!(robust(&[same; 2], &[Vector2::zeros(); 2], 1e-4, &mut rng, &stop), None);
        assert_eq!(robust(&[same; 9], &[Vector2::zeros(); 9], 1e-4, &mut rng, &stop), None);
        assert_eq!(robust(&[same; 9], &[Vector2::zeros(); 9], f64::NAN, &mut rng, &stop), None);
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
            let found = robust(&points, &seen, 13.8 * NOISE * NOISE, &mut rng, &StopToken::default()).expect("a pose");
            let right = found.inlier.iter().enumerate().filter(|(k, inlier)| (k % 3 == 0) == **inlier).count();
            let away = distance(&found.pose, &scene.poses[2]);
            println!("seed {seed}: {right} of 90 verdicts right, pose off by {away}");
            assert!(right >= 87 && away < 20.0 * NOISE, "seed {seed}: {right} of 90, off by {away}");
        }
    }
}
