//! The frame of the first view.

use nalgebra::{Matrix3x4, Matrix4, Vector4};

/// Ratio of the smallest to the largest singular value below which a camera has no rank 3.
const RANK_TOLERANCE: f64 = 1e-10;

/// A projective reconstruction with `P1 = [I|0]`.
#[derive(Debug, Clone)]
pub struct CanonicalFrame {
    /// `P H`; the first exactly `[I|0]`, the others with `|A|^2 = 3` and `det A >= 0` for `P = [A|a]`.
    pub cameras: Vec<Matrix3x4<f64>>,
    /// `H^-1 X`
    pub points: Vec<Vector4<f64>>,
    /// `H`
    pub homography: Matrix4<f64>,
}

/// Brings a projective reconstruction into a frame where the first camera is `[I|0]`.
///
/// Of the four-parameter family of such frames this takes the one whose homography is the pseudo-inverse of the first
/// camera beside its centre, the centre scaled so that the fourth columns have unit root mean square. The same
/// cameras give the same frame, so a plane at infinity found in it can be used with the cameras of another call.
///
/// Returns `None` without cameras or when the first has no rank 3.
pub fn to_canonical_frame(cameras: &[Matrix3x4<f64>], points: &[Vector4<f64>]) -> Option<CanonicalFrame> {
    let first = cameras.first()?;
    let norm = first.norm();
    // Before the decomposition, which would not end on what is no number.
    if !(norm > f64::MIN_POSITIVE && norm.is_finite()) {
        return None;
    }
    let first = &(first / norm);
    let singular = first.singular_values();
    if singular.min() <= RANK_TOLERANCE * singular.max() {
        return None;
    }
    let inverse = first.transpose() * (first * first.transpose()).try_inverse()?;
    let mut homography = Matrix4::zeros();
    homography.fixed_columns_mut::<3>(0).copy_from(&inverse);
    homography.set_column(3, &centre(first).normalize());
    let lengths = cameras[1..].iter().filter_map(|camera| {
        let moved = camera * homography;
        let ratio = moved.column(3).norm_squared() / moved.fixed_columns::<3>(0).norm_squared();
        ratio.is_finite().then_some(ratio)
    });
    let (count, sum) = lengths.fold((0.0, 0.0), |(count, sum), ratio| (count + 1.0, sum + ratio));
    // Cameras at one centre have no baseline to scale by.
    let scale = if sum > 0.0 { f64::sqrt(count / sum) } else { 1.0 };
    let scaled = homography.column(3) * scale;
    homography.set_column(3, &scaled);
    let back = homography.try_inverse()?;
    let mut moved: Vec<Matrix3x4<f64>> = cameras.iter().map(|camera| oriented(&(camera * homography))).collect();
    moved[0] = Matrix3x4::identity();
    Some(CanonicalFrame { cameras: moved, points: points.iter().map(|point| back * point).collect(), homography })
}

/// The camera centre, by the minors of the camera: exact where a decomposition would round.
fn centre(camera: &Matrix3x4<f64>) -> Vector4<f64> {
    Vector4::from_fn(|left_out, _| {
        let minor = camera.remove_column(left_out).determinant();
        if left_out % 2 == 0 { minor } else { -minor }
    })
}

/// The camera with its 3x3 part at norm `sqrt 3` and of determinant at least 0; left alone where it has none.
pub fn oriented(camera: &Matrix3x4<f64>) -> Matrix3x4<f64> {
    let left = camera.fixed_columns::<3>(0).into_owned();
    let scale = 3f64.sqrt() / left.norm();
    if !scale.is_finite() {
        return *camera;
    }
    camera * if left.determinant() < 0.0 { -scale } else { scale }
}

#[cfg(test)]
mod tests {
    use super::super::super::bundle::testing;
    use super::*;

    #[test]
    fn keeps_every_image_point_and_puts_the_first_camera_at_the_origin() {
        let scene = testing::scene(1, 6, 15, 0.0);
        let (cameras, points) = testing::projectively_transformed(&scene, 1);
        let frame = to_canonical_frame(&cameras, &points).expect("rank 3");
        assert_eq!(frame.cameras[0], Matrix3x4::identity());
        for seen in &scene.observations {
            let image = frame.cameras[seen.view] * frame.points[seen.point];
            assert!((image.xy() / image.z - seen.xy).norm() < 1e-9);
        }
        let squares: f64 = frame.cameras[1..].iter().map(|camera| camera.column(3).norm_squared() / 3.0).sum();
        assert!((squares / 5.0 - 1.0).abs() < 1e-9, "{squares}");
    }

    #[test]
    fn refuses_a_first_camera_without_rank() {
        let mut flat = Matrix3x4::identity();
        flat.set_row(2, &nalgebra::RowVector4::zeros());
        assert!(to_canonical_frame(&[flat], &[]).is_none());
        assert!(to_canonical_frame(&[], &[]).is_none());
    }
}
