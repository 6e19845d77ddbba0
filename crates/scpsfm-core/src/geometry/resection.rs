//! Projective cameras from known points and their images.

use nalgebra::{Matrix4, SMatrix, SVector, Vector2};
use rand_chacha::ChaCha8Rng;

use super::null_vector::{projection_equations, smallest_eigenvector};
use super::observation::Correspondence;
use super::ransac::{self, Estimator};
use super::triangulation::f64xn::{F64xN, Symmetric};
use super::triangulation::reprojection;
use super::{Camera, Point};
use crate::domain::StopToken;

/// Correspondences that determine a projective camera: eleven unknowns, two equations each.
const LEAST_POINTS: usize = 6;
/// Samples of the robust resection at most: enough where three images in ten are right, twelve of forty even.
const MOST_SAMPLES: usize = 20_000;

/// The camera of least algebraic error (Hartley & Zisserman, section 7.1), unit Frobenius norm.
///
/// * `seen`: at least [`LEAST_POINTS`], not all on a plane or a twisted cubic with the camera
///
/// Returns `None` for too few points or when nothing finite comes of them.
fn linear(seen: &[Correspondence<Point>]) -> Option<Camera> {
    if seen.len() < LEAST_POINTS {
        return None;
    }
    let mut normal = SMatrix::<f64, 12, 12>::zeros();
    for Correspondence { point, xy, .. } in seen {
        // Unit homogeneous vectors: no point weighs more for its scale.
        let unit = point.try_normalize(f64::MIN_POSITIVE)?;
        for equation in projection_equations::<4, 12>(&unit, xy) {
            normal += equation * equation.transpose();
        }
    }
    let solution = smallest_eigenvector(&normal)?;
    Some(Camera::from_fn(|row, column| solution[4 * row + column]))
}

/// The camera that sees six points where they are seen: the first four exactly, the others with least algebraic error.
///
/// In the basis of the first four points a camera is their images times their depths, which the two equations of
/// every other point are linear in.
///
/// Returns `None` where four of the points are on a plane, or what comes is no finite number.
fn six_points(points: &[Point; LEAST_POINTS], images: &[Vector2<f64>; LEAST_POINTS]) -> Option<Camera> {
    let into_basis = Matrix4::from_columns(&[points[0], points[1], points[2], points[3]]).try_inverse()?;
    let mut normal = Symmetric::<1>::ZERO;
    for (point, image) in points[4..].iter().zip(&images[4..]) {
        let weights = (into_basis * point).normalize();
        for axis in [0, 1] {
            let equation = [0, 1, 2, 3].map(|k| F64xN([weights[k] * (images[k][axis] - image[axis])]));
            normal.add_square(F64xN::ONE, equation);
        }
    }
    let depths = normal.null_vectors().map(|depth| depth.0[0]);
    let camera = Camera::from_fn(|row, k| depths[k] * images[k].push(1.0)[row]) * into_basis;
    camera.try_normalize(f64::MIN_POSITIVE).filter(|camera| camera.iter().all(|entry| entry.is_finite()))
}

/// The camera that most images agree with, refined on those that do.
///
/// * `gate`: squared residual below which an image of weight 1 agrees, in squared units of the images
///
/// Reliable down to three right images in ten; once `stop` fires, the best so far. Returns the camera and which images
/// agree; `None` when fewer than `least` do.
pub fn robust(
    seen: &[Correspondence<Point>],
    gate: f64,
    least: usize,
    rng: &mut ChaCha8Rng,
    stop: &StopToken,
) -> Option<(Camera, Vec<bool>)> {
    let unit = seen.iter().map(|seen| Correspondence { point: seen.point.normalize(), ..*seen });
    let unit = UnitPoints(unit.collect());
    // Most images are right as a rule: all together first.
    let found = ransac::estimate(&unit, gate, linear(seen), 0, MOST_SAMPLES, rng, stop)?;
    (found.inlier_count() >= least.max(LEAST_POINTS)).then_some((found.model, found.inlier))
}

/// Images of points of unit norm.
struct UnitPoints(Vec<Correspondence<Point>>);

impl Estimator<12> for UnitPoints {
    type Model = Camera;

    const SAMPLE: usize = LEAST_POINTS;
    const SAMPLE_GATES: f64 = 25.0;

    fn len(&self) -> usize {
        self.0.len()
    }

    fn minimal(&self, sample: &[usize]) -> impl IntoIterator<Item = Camera> {
        let sample: [Correspondence<Point>; LEAST_POINTS] = ransac::chosen(&self.0, sample);
        six_points(&sample.map(|seen| seen.point), &sample.map(|seen| seen.xy))
    }

    fn squared_residual(&self, camera: &Camera, datum: usize) -> f64 {
        let Correspondence { point, xy, weight } = &self.0[datum];
        weight * reprojection(camera, point, xy).norm_squared()
    }

    fn residual(&self, camera: &Camera, datum: usize) -> Option<(Vector2<f64>, [SVector<f64, 12>; 2], f64)> {
        let Correspondence { point, xy, weight } = &self.0[datum];
        let residual = reprojection(camera, point, xy);
        let nearer = point / (camera.row(2) * point).x;
        Some((residual, projection_equations(&nearer, &(residual + xy)), *weight))
    }

    fn moved(&self, camera: &Camera, step: &SVector<f64, 12>) -> Option<Camera> {
        (camera + Camera::from_fn(|row, column| step[4 * row + column])).try_normalize(f64::MIN_POSITIVE)
    }

    /// The scale of the homogeneous camera is free.
    fn gauge(&self, camera: &Camera) -> SVector<f64, 12> {
        SVector::from_fn(|k, _| camera[(k / 4, k % 4)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::statistics::CHI_SQUARE_OF_TWO;
    use rand::{Rng, SeedableRng};

    use crate::geometry::bundle::testing;

    const NOISE: f64 = 0.001;

    fn of(points: &[Point], images: &[Vector2<f64>], weights: &[f64]) -> Vec<Correspondence<Point>> {
        let seen = points.iter().zip(images).zip(weights);
        seen.map(|((&point, &xy), &weight)| Correspondence { point, xy, weight }).collect()
    }

    fn found(points: &[Point], images: &[Vector2<f64>], weights: &[f64], least: usize) -> Option<(Camera, Vec<bool>)> {
        let (seen, mut rng) = (of(points, images, weights), ChaCha8Rng::seed_from_u64(1));
        robust(&seen, CHI_SQUARE_OF_TWO * NOISE * NOISE, least, &mut rng, &StopToken::default())
    }

    /// Distance between the images of a point in two cameras.
    fn apart(found: &Camera, truth: &Camera, point: &Point) -> f64 {
        let expected = truth * point;
        reprojection(found, point, &(expected.xy() / expected.z)).norm()
    }

    fn problem(seed: u64, wrong: usize) -> (Camera, Vec<Point>, Vec<Vector2<f64>>) {
        let scene = testing::scene(seed, 3, 40, NOISE);
        let (cameras, points) = testing::projectively_transformed(&scene, seed);
        let mut images: Vec<Vector2<f64>> =
            scene.observations.iter().filter(|seen| seen.view == 2).map(|seen| seen.xy).collect();
        for (k, image) in images.iter_mut().take(wrong).enumerate() {
            *image += Vector2::new(0.1 + 0.01 * k as f64, -0.2);
        }
        (cameras[2], points, images)
    }

    #[test]
    fn a_camera_is_found_among_wrong_images() {
        for seed in 0..5 {
            for wrong in [0, 12, 20] {
                let (truth, points, images) = problem(seed, wrong);
                let (camera, agreeing) =
                    found(&points, &images, &[1.0; 40], 10).unwrap_or_else(|| panic!("seed {seed}, {wrong} wrong"));
                assert!(agreeing[..wrong].iter().all(|&agrees| !agrees), "seed {seed}");
                let right = agreeing[wrong..].iter().filter(|&&agrees| agrees).count();
                assert!(right + 3 >= 40 - wrong, "seed {seed}: {right} of {}", 40 - wrong);
                for point in &points {
                    let distance = apart(&camera, &truth, point);
                    assert!(distance < 0.005, "seed {seed}: {distance}");
                }
            }
        }
    }

    /// Points, of which three in ten are seen where the camera has them, give or take the noise.
    fn contaminated(seed: u64, count: usize) -> (Vec<Point>, Vec<Vector2<f64>>, Camera) {
        let scene = testing::scene(seed, 3, count, NOISE);
        let (cameras, points) = testing::projectively_transformed(&scene, seed);
        let of_last = scene.observations.iter().filter(|seen| seen.view == 2);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let images = of_last.map(|seen| match seen.point % 10 < 3 {
            true => seen.xy,
            false => Vector2::new(rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5)),
        });
        (points, images.collect(), cameras[2])
    }

    #[test]
    fn three_right_images_in_ten_are_enough() {
        let (mut successes, mut right, mut seconds) = (0, 0.0, 0.0);
        for seed in 0..20 {
            for count in [40, 100, 600] {
                let (points, images, truth) = contaminated(seed, count);
                let start = std::time::Instant::now();
                let robust = found(&points, &images, &vec![1.0; count], 9);
                seconds += start.elapsed().as_secs_f64();
                let Some((camera, agreeing)) = robust else { continue };
                successes += 1;
                let agree = (0..count).filter(|&k| agreeing[k] == (k % 10 < 3)).count();
                right += agree as f64 / count as f64;
                let missed = points.iter().map(|point| apart(&camera, &truth, point)).sum::<f64>() / count as f64;
                assert!(missed < 0.005, "seed {seed}, {count} points: {missed}");
            }
        }
        println!(
            "{successes} of 60 found, {:.4} of their verdicts right, {:.1} ms each",
            right / f64::from(successes),
            seconds / 60.0 * 1e3
        );
        assert!(successes >= 59 && right >= 0.99 * f64::from(successes), "{successes} found, {right}");
    }

    /// Half of the images are ten times as noisy as the others: where that is known, they agree, and the camera is
    /// nearer.
    #[test]
    fn images_count_by_their_weight() {
        let (mut weighted, mut plain) = (0.0, 0.0);
        for seed in 0..20 {
            let scene = testing::scene(seed, 3, 60, 0.0);
            let (cameras, points) = testing::projectively_transformed(&scene, seed);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let factor = |k: usize| if k.is_multiple_of(2) { 10.0 } else { 1.0 };
            let of_last = scene.observations.iter().filter(|seen| seen.view == 2);
            let images: Vec<Vector2<f64>> = of_last
                .map(|seen| {
                    let noise = Vector2::new(testing::normal(&mut rng), testing::normal(&mut rng));
                    seen.xy + factor(seen.point) * NOISE * noise
                })
                .collect();
            let weights: Vec<f64> = (0..images.len()).map(|k| 1.0 / (factor(k) * factor(k))).collect();
            let away = |weights: &[f64]| {
                let (camera, agreeing) = found(&points, &images, weights, 10).expect("a camera");
                let squared = |point: &Point| apart(&camera, &cameras[2], point).powi(2);
                (points.iter().map(squared).sum::<f64>(), agreeing.into_iter().filter(|agrees| *agrees).count())
            };
            let (by_weights, by_all) = (away(&weights), away(&vec![1.0; images.len()]));
            assert!(by_weights.1 >= 54 && by_all.1 < 48, "seed {seed}: {by_weights:?} {by_all:?}");
            weighted += by_weights.0;
            plain += by_all.0;
        }
        println!("squared error {weighted} with weights, {plain} without");
        assert!(weighted < plain, "squared error {weighted} with weights, {plain} without");
    }

    /// What the fit to all points cannot do, a sample may.
    #[test]
    fn a_point_without_coordinates_is_an_outlier() {
        let (_, mut points, images) = problem(1, 0);
        points[7] = Point::zeros();
        let (_, agreeing) = found(&points, &images, &[1.0; 40], 10).expect("a camera");
        assert!(!agreeing[7] && agreeing.iter().filter(|&&agrees| agrees).count() >= 37);
    }

    #[test]
    fn images_of_nothing_give_none() {
        let (_, points, images) = problem(1, 40);
        let scattered: Vec<Vector2<f64>> =
            (0..40).map(|k| Vector2::new((k as f64 * 1.7).sin(), (k as f64 * 2.9).cos())).collect();
        assert!(found(&points, &scattered, &[1.0; 40], 10).is_none());
        assert!(linear(&of(&points[..5], &images, &[1.0; 5])).is_none());
        assert!(linear(&of(&[Point::zeros(); 8], &images, &[1.0; 8])).is_none());
        let nan = vec![Point::from_element(f64::NAN); 8];
        assert!(found(&nan, &images[..8], &[1.0; 8], 6).is_none());
    }
}
