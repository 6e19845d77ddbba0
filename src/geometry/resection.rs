//! Projective cameras from known points and their images.

use nalgebra::{DMatrix, DVector, SMatrix, SVector, SymmetricEigen, Vector2};
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use super::triangulation::reprojection;
use super::{Camera, Point};

/// Correspondences that determine a projective camera: eleven unknowns, two equations each.
pub const LEAST_POINTS: usize = 6;
/// Samples of the robust resection: with half of the images wrong, one sample in 64 is right.
const SAMPLES: usize = 300;
/// Gates within which an image agrees with a sample's camera: six noisy images make a noisier camera.
const SAMPLE_GATES: f64 = 25.0;
/// Steps of the refinement.
const REFINE_STEPS: usize = 10;
/// Damping of the refinement, relative to the trace: the scale of a camera is free.
const DAMPING: f64 = 1e-6;

/// The camera of least algebraic error (Hartley & Zisserman, section 7.1), unit Frobenius norm.
///
/// * `points`: homogeneous, at least [`LEAST_POINTS`], not all on a plane or a twisted cubic with the camera
///
/// Returns `None` for too few points or when nothing finite comes of them.
pub fn linear(points: &[Point], images: &[Vector2<f64>]) -> Option<Camera> {
    if points.len() < LEAST_POINTS || points.len() != images.len() {
        return None;
    }
    let mut normal = SMatrix::<f64, 12, 12>::zeros();
    for (point, image) in points.iter().zip(images) {
        // Unit homogeneous vectors: no point weighs more for its scale.
        let unit = point.try_normalize(f64::MIN_POSITIVE)?;
        for (axis, coordinate) in [(0, image.x), (1, image.y)] {
            let mut row = SVector::<f64, 12>::zeros();
            row.fixed_rows_mut::<4>(4 * axis).copy_from(&unit);
            row.fixed_rows_mut::<4>(8).copy_from(&(-coordinate * unit));
            normal += row * row.transpose();
        }
    }
    if normal.iter().any(|entry| !entry.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::new(normal);
    let solution = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    Some(Camera::from_fn(|row, column| solution[4 * row + column]))
}

/// The camera that most images agree with, refined on those that do.
///
/// * `gate`: squared residual below which an image agrees, in squared units of the images
///
/// Returns the camera and which images agree; `None` when fewer than `least` do.
pub fn robust(
    points: &[Point],
    images: &[Vector2<f64>],
    gate: f64,
    least: usize,
    rng: &mut ChaCha8Rng,
) -> Option<(Camera, Vec<bool>)> {
    let agrees_within = |camera: &Camera, gate: f64| -> Vec<bool> {
        let squared = |(point, image)| reprojection(camera, point, image).norm_squared();
        points.iter().zip(images).map(|pair| squared(pair) < gate).collect()
    };
    let count = |agreeing: &[bool]| agreeing.iter().filter(|&&agrees| agrees).count();
    let mut best: Option<(Camera, Vec<bool>)> = None;
    let mut offer = |camera: Camera| {
        let agreeing = agrees_within(&camera, SAMPLE_GATES * gate);
        if best.as_ref().is_none_or(|(_, most)| count(&agreeing) > count(most)) {
            best = Some((camera, agreeing));
        }
    };
    // Most images are right as a rule: all together first.
    offer(refine(linear(points, images)?, points, images, gate));
    for _ in 0..SAMPLES {
        let sample = index::sample(rng, points.len(), LEAST_POINTS);
        let (some, seen): (Vec<Point>, Vec<Vector2<f64>>) = sample.iter().map(|k| (points[k], images[k])).unzip();
        if let Some(camera) = linear(&some, &seen) {
            offer(camera);
        }
    }
    let (camera, agreeing) = best?;
    let camera = refine(camera, &chosen(points, &agreeing), &chosen(images, &agreeing), gate);
    let agreeing = agrees_within(&camera, gate);
    (count(&agreeing) >= least.max(LEAST_POINTS)).then_some((camera, agreeing))
}

fn chosen<T: Copy>(all: &[T], which: &[bool]) -> Vec<T> {
    all.iter().zip(which).filter(|(_, chosen)| **chosen).map(|(item, _)| *item).collect()
}

/// Gauss-Newton on the reprojection error with Geman-McClure weights of scale `sqrt(gate)`; never worse than the start.
fn refine(start: Camera, points: &[Point], images: &[Vector2<f64>], gate: f64) -> Camera {
    let cost = |camera: &Camera| -> f64 {
        points
            .iter()
            .zip(images)
            .map(|(point, image)| reprojection(camera, point, image).norm_squared())
            .map(|squared| squared / (squared + gate))
            .sum()
    };
    let mut camera = start;
    let mut least = cost(&camera);
    for _ in 0..REFINE_STEPS {
        let mut normal = DMatrix::<f64>::zeros(12, 12);
        let mut gradient = DVector::<f64>::zeros(12);
        for (point, image) in points.iter().zip(images) {
            let seen = camera * point;
            let residual = reprojection(&camera, point, image);
            let weight = (gate / (residual.norm_squared() + gate)).powi(2);
            let projected = residual + image;
            for axis in 0..2 {
                let mut row = DVector::<f64>::zeros(12);
                row.rows_mut(4 * axis, 4).copy_from(&(point / seen.z));
                row.rows_mut(8, 4).copy_from(&(-projected[axis] / seen.z * point));
                normal += weight * &row * row.transpose();
                gradient += weight * residual[axis] * row;
            }
        }
        let trace = normal.trace();
        for k in 0..12 {
            normal[(k, k)] += DAMPING * trace;
        }
        let Some(step) = normal.cholesky().map(|factor| factor.solve(&gradient)) else { break };
        let moved = camera - Camera::from_fn(|row, column| step[4 * row + column]);
        let moved = moved / moved.norm();
        let reached = cost(&moved);
        if reached >= least || reached.is_nan() {
            break;
        }
        (camera, least) = (moved, reached);
    }
    camera
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    use crate::geometry::bundle::testing;

    fn problem(seed: u64, wrong: usize) -> (Camera, Vec<Point>, Vec<Vector2<f64>>) {
        let scene = testing::scene(seed, 3, 40, 0.001);
        let (cameras, points) = testing::projectively_transformed(&scene, seed);
        let mut images: Vec<Vector2<f64>> =
            scene.observations.iter().filter(|seen| seen.camera == 2).map(|seen| seen.xy).collect();
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
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let gate = 13.8 * 0.001f64.powi(2);
                let (camera, agreeing) = robust(&points, &images, gate, 10, &mut rng)
                    .unwrap_or_else(|| panic!("seed {seed}, {wrong} wrong"));
                assert!(agreeing[..wrong].iter().all(|&agrees| !agrees), "seed {seed}");
                let right = agreeing[wrong..].iter().filter(|&&agrees| agrees).count();
                assert!(right + 3 >= 40 - wrong, "seed {seed}: {right} of {}", 40 - wrong);
                for point in &points {
                    let (found, expected) = (camera * point, truth * point);
                    let distance = (found.xy() / found.z - expected.xy() / expected.z).norm();
                    assert!(distance < 0.005, "seed {seed}: {distance}");
                }
            }
        }
    }

    #[test]
    fn images_of_nothing_give_none() {
        let (_, points, images) = problem(1, 40);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let scattered: Vec<Vector2<f64>> =
            (0..40).map(|k| Vector2::new((k as f64 * 1.7).sin(), (k as f64 * 2.9).cos())).collect();
        assert!(robust(&points, &scattered, 1e-5, 10, &mut rng).is_none());
        assert!(linear(&points[..5], &images[..5]).is_none());
        assert!(linear(&[Point::zeros(); 8], &images[..8]).is_none());
        let nan = vec![Point::from_element(f64::NAN); 8];
        assert!(robust(&nan, &images[..8], 1.0, 6, &mut rng).is_none());
    }
}
