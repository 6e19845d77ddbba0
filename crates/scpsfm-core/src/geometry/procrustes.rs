//! Rigid motions between point sets: absolute orientation of two (Arun, Huang & Blostein 1987) and of many (Gower
//! 1975).

use nalgebra::{Matrix3, Vector3};

use super::bundle::metric::Pose;

/// The rigid motion that takes `from` to `to` with least weighted squared distance: `to ~ R from + t`.
///
/// Returns `None` for fewer than three points, weights without a positive sum, or input that is not finite. Three
/// points on a line leave a rotation about it open; which one comes out is not specified.
pub fn absolute_orientation(from: &[Vector3<f64>], to: &[Vector3<f64>], weights: &[f64]) -> Option<Pose> {
    let total: f64 = weights.iter().sum();
    if from.len() < 3 || from.len() != to.len() || from.len() != weights.len() || !(total > 0.0 && total.is_finite()) {
        return None;
    }
    let centre = |points: &[Vector3<f64>]| {
        points.iter().zip(weights).map(|(point, weight)| point * *weight).sum::<Vector3<f64>>() / total
    };
    let (centre_from, centre_to) = (centre(from), centre(to));
    let mut covariance = Matrix3::zeros();
    for ((from, to), weight) in from.iter().zip(to).zip(weights) {
        covariance += *weight * (to - centre_to) * (from - centre_from).transpose();
    }
    let rotation = nearest_rotation(&covariance)?;
    Some(Pose { rotation, translation: centre_to - rotation * centre_from })
}

/// The rotation nearest to a matrix, whatever its scale; `None` where it holds what is no number.
pub(super) fn nearest_rotation(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    if matrix.iter().any(|entry| !entry.is_finite()) {
        return None;
    }
    let decomposition = matrix.svd(true, true);
    let (left, right) = (decomposition.u?, decomposition.v_t?);
    let sign = if (left * right).determinant() < 0.0 { -1.0 } else { 1.0 };
    Some(left * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * right)
}

/// Rounds of [`generalised`]; noise of a tenth of the shape's size needs four to settle.
const ROUNDS: usize = 5;

/// One shape and its poses in several views: the generalised Procrustes problem without scales.
///
/// * `seen[i][j]`: point j in the frame of view i
/// * `weights[i][j]`: inverse variance of that point
///
/// Returns the poses (shape to view) and the shape, in a frame of their own near the first view's; `None` as
/// [`absolute_orientation`] does.
pub fn generalised(seen: &[Vec<Vector3<f64>>], weights: &[Vec<f64>]) -> Option<(Vec<Pose>, Vec<Vector3<f64>>)> {
    let mut shape = seen.first()?.clone();
    let mut poses = Vec::new();
    for _ in 0..ROUNDS {
        poses = seen
            .iter()
            .zip(weights)
            .map(|(points, weights)| absolute_orientation(&shape, points, weights))
            .collect::<Option<Vec<Pose>>>()?;
        for (j, point) in shape.iter_mut().enumerate() {
            *point = mean_position(&poses, seen.iter().map(|points| &points[j]), weights.iter().map(|row| row[j]));
        }
    }
    Some((poses, shape))
}

/// Weighted mean of a point's observations, each taken back from its view.
pub fn mean_position<'a>(
    poses: &[Pose],
    seen: impl Iterator<Item = &'a Vector3<f64>>,
    weights: impl Iterator<Item = f64>,
) -> Vector3<f64> {
    let (mut sum, mut total) = (Vector3::zeros(), 0.0);
    for ((pose, point), weight) in poses.iter().zip(seen).zip(weights) {
        sum += weight * pose.rotation.tr_mul(&(point - pose.translation));
        total += weight;
    }
    sum / total
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::bundle::testing;

    #[test]
    fn exact_views_of_one_shape_give_it_back() {
        let scene = testing::scene(4, 6, 7, 0.0);
        let seen: Vec<Vec<Vector3<f64>>> =
            scene.poses.iter().map(|pose| scene.points.iter().map(|point| pose.apply(point)).collect()).collect();
        let weights = vec![vec![1.0; 7]; 6];
        let (poses, shape) = generalised(&seen, &weights).expect("finite");
        for (pose, seen) in poses.iter().zip(&seen) {
            assert!((pose.rotation.determinant() - 1.0).abs() < 1e-9);
            for (point, seen) in shape.iter().zip(seen) {
                assert!((pose.apply(point) - seen).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn mirrored_points_are_not_mirrored_back() {
        let from = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]].map(Vector3::from);
        let to = from.map(|point| Vector3::new(-point.x, point.y, point.z));
        let pose = absolute_orientation(&from, &to, &[1.0; 4]).expect("finite");
        assert!((pose.rotation.determinant() - 1.0).abs() < 1e-9);
        let missed: f64 = from.iter().zip(&to).map(|(from, to)| (pose.apply(from) - to).norm()).sum();
        assert!(missed > 0.1, "{missed}");
    }

    #[test]
    fn hostile_points_give_none() {
        let points = [Vector3::zeros(), Vector3::x(), Vector3::y()];
        assert!(absolute_orientation(&points[..2], &points[..2], &[1.0; 2]).is_none());
        assert!(absolute_orientation(&points, &points, &[0.0; 3]).is_none());
        assert!(absolute_orientation(&points, &[Vector3::repeat(f64::NAN); 3], &[1.0; 3]).is_none());
        assert!(generalised(&[], &[]).is_none());
        // All in one place: any rotation will do.
        let same = [Vector3::x(); 3];
        assert!(absolute_orientation(&same, &same, &[1.0; 3]).is_some_and(|pose| pose.rotation.norm().is_finite()));
    }
}
