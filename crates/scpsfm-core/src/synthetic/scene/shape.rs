//! Where the points lie.

use nalgebra::{Rotation3, Unit, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::SceneOptions;
use super::stream::Stream;

/// Centre of the cloud in front of the first camera.
pub const SCENE_CENTRE: [f64; 3] = [0.0, 0.0, 3.0];
/// Tilt of the plane against the image plane of an unturned camera: below the range all depths would be about the same,
/// above it turned cameras would see the plane edge-on.
const TILT_RANGE_RAD: (f64, f64) = (0.2, 0.8);

/// How the points of a scene lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Shape {
    /// Uniform in `[-1, 1] x [-1, 1] x [2, 4]` (paper, section 5.1).
    #[default]
    Box,
    /// Uniform in a square of side 2 about the centre of the box, tilted in a random direction: a homography relates
    /// any two views, and no projective reconstruction is unique.
    Plane,
}

/// Draws the points, one a track.
pub fn draw_points(options: &SceneOptions, rng: &mut ChaCha8Rng) -> Vec<Vector3<f64>> {
    let boxed = (0..options.tracks)
        .map(|_| Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(2.0..4.0)));
    match options.shape {
        Shape::Box => boxed.collect(),
        Shape::Plane => {
            let tilt = draw_tilt(&mut Stream::Shape.of(options.seed));
            let centre = Vector3::from(SCENE_CENTRE);
            boxed.map(|point| centre + tilt * Vector3::new(point.x, point.y, 0.0)).collect()
        }
    }
}

/// A rotation about a random axis within the image plane.
fn draw_tilt(rng: &mut ChaCha8Rng) -> Rotation3<f64> {
    let direction = rng.random_range(0.0..std::f64::consts::TAU);
    let axis = Unit::new_normalize(Vector3::new(direction.cos(), direction.sin(), 0.0));
    Rotation3::from_axis_angle(&axis, rng.random_range(TILT_RANGE_RAD.0..TILT_RANGE_RAD.1))
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3xX;

    use super::*;

    /// Root mean square spread along the principal axes, smallest first, and the axis of the smallest.
    fn spread(options: &SceneOptions) -> ([f64; 3], Vector3<f64>) {
        let points = draw_points(options, &mut Stream::Paper.of(options.seed));
        let points = Matrix3xX::from_columns(&points);
        let mean = points.column_mean();
        let centred = Matrix3xX::from_fn(points.ncols(), |row, column| points[(row, column)] - mean[row]);
        let eigen = (&centred * centred.transpose() / points.ncols() as f64).symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        let axis = eigen.eigenvectors.column(order[0]).into_owned();
        (order.map(|k| eigen.eigenvalues[k].max(0.0).sqrt()), axis)
    }

    #[test]
    fn a_plane_is_flat_wide_and_tilted_and_a_box_is_not_flat() {
        for seed in 0..20 {
            let plane = SceneOptions { shape: Shape::Plane, seed, ..SceneOptions::default() };
            let ([across, wide, wider], normal) = spread(&plane);
            assert!(across < 1e-7 && wide > 0.4 && wider > 0.4, "seed {seed}: {across} {wide} {wider}");
            let tilt = normal.z.abs().acos();
            assert!((TILT_RANGE_RAD.0..=TILT_RANGE_RAD.1).contains(&tilt), "seed {seed}: tilted by {tilt}");
            let ([across, ..], _) = spread(&SceneOptions { seed, ..SceneOptions::default() });
            assert!(across > 0.4, "seed {seed}: {across}");
        }
    }
}
