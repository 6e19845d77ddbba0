//! Bundler's files (Snavely, Bundler v0.4 user's manual) and those of BAL, Bundle Adjustment in the Large (Agarwal,
//! Snavely, Seitz, Szeliski 2010), which have the same camera.
//!
//! It looks along its negative z axis, y is up, and a point is imaged at `f (1 + k1 r^2 + k2 r^4) p` with
//! `p = -(X, Y) / Z`. Image coordinates are measured from the middle of the image, which stands for the principal
//! point: ours are written from the principal point that was estimated, so that the formula holds as it stands.

pub mod bal;
pub mod bundle;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::metric::{Image, Model};
use crate::domain::LensProjection;

/// Why a model cannot be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    #[error(
        "its cameras have square pixels, a perspective lens and two radial coefficients; the estimated ones have more"
    )]
    Camera,
}

/// An image's camera in the axes of these files.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Camera {
    focal_px: f64,
    radial: [f64; 2],
    rotation: Rotation3<f64>,
    translation: Vector3<f64>,
    principal_point_px: [f64; 2],
}

impl Camera {
    /// Coordinates of a keypoint: from the principal point, y up.
    fn coordinates(&self, x: f64, y: f64) -> [f64; 2] {
        let [px, py] = self.principal_point_px;
        [x - px, py - y]
    }
}

/// The cameras of the images.
fn cameras(model: &Model) -> Result<Vec<Camera>, Error> {
    // Half a turn about x takes y down and z forwards to y up and z backwards.
    let turn = Rotation3::from_matrix_unchecked(Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)));
    let camera = |image: &Image| {
        let of = &model.cameras[image.camera].intrinsics;
        let is_plain = of.lens_projection == LensProjection::Perspective && of.aspect == 1.0;
        if !is_plain || [of.radial_k3, of.tangential_p1, of.tangential_p2] != [0.0; 3] {
            return Err(Error::Camera);
        }
        Ok(Camera {
            focal_px: of.focal_px,
            radial: [of.radial_k1, of.radial_k2],
            rotation: turn * image.rotation.to_rotation_matrix(),
            translation: turn * Vector3::from(image.translation),
            principal_point_px: of.principal_point_px,
        })
    };
    model.images.iter().map(camera).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Calibration, ImageSize, Solution};
    use crate::formats::LabelledInput;
    use crate::formats::lens_fixture::{fisheye, lens, scene_of};

    const SIZE: ImageSize = ImageSize { width_px: 900, height_px: 1200 };

    fn model_of((input, solution): &(LabelledInput, Solution)) -> Model {
        Model::of_parts(solution, input).expect("metric").remove(0)
    }

    /// Where the cameras' formula puts a point.
    fn image(rotation: Rotation3<f64>, translation: Vector3<f64>, [f, k1, k2]: [f64; 3], point: [f64; 3]) -> [f64; 2] {
        let seen = rotation * Vector3::from(point) + translation;
        assert!(seen.z < 0.0, "in front of the camera");
        let p = [-seen.x / seen.z, -seen.y / seen.z];
        let squared = p[0] * p[0] + p[1] * p[1];
        p.map(|side| f * (1.0 + k1 * squared + k2 * squared * squared) * side)
    }

    fn numbers(text: &str) -> Vec<f64> {
        text.split_whitespace().map(|number| number.parse().expect("a number")).collect()
    }

    #[test]
    fn points_are_imaged_where_they_were_observed_in_both_files() {
        let scene = scene_of(lens(1.0, [-0.05, 0.01, 0.0, 0.0, 0.0], [440.0, 610.0]), SIZE);
        let model = model_of(&scene);
        let text = bundle::out(&model).expect("a plain camera");
        assert_eq!(bundle::list(&model).lines().collect::<Vec<_>>(), ["3", "13", "23", "33", "43"]);
        let body = text.strip_prefix("# Bundle file v0.3\n").expect("the header");
        let all = numbers(body);
        assert_eq!(all[..2], [5.0, model.points.len() as f64]);
        let (cameras, mut rest) = all[2..].split_at(5 * 15);
        let mut seen = 0;
        while let [x, y, z, _, _, _, count, others @ ..] = rest {
            let (observations, others) = others.split_at(4 * *count as usize);
            for of in observations.as_chunks::<4>().0 {
                let camera = &cameras[15 * of[0] as usize..][..15];
                let rows = nalgebra::Matrix3::from_row_slice(&camera[3..12]);
                let translation = Vector3::from_row_slice(&camera[12..]);
                let lens = [camera[0], camera[1], camera[2]];
                let at = image(Rotation3::from_matrix_unchecked(rows), translation, lens, [*x, *y, *z]);
                assert!((at[0] - of[2]).hypot(at[1] - of[3]) < 1e-6);
                seen += 1;
            }
            rest = others;
        }
        assert_eq!((rest.len(), seen), (0, model.points.iter().map(|point| point.seen.len()).sum()));

        let all = numbers(&bal::problem(&model).expect("a plain camera"));
        assert_eq!(all[..3], [5.0, model.points.len() as f64, seen as f64]);
        let (observations, rest) = all[3..].split_at(4 * seen);
        let (cameras, points) = rest.split_at(5 * 9);
        assert_eq!(points.len(), 3 * model.points.len());
        for of in observations.as_chunks::<4>().0 {
            let camera = &cameras[9 * of[0] as usize..][..9];
            let rotation = Rotation3::from_scaled_axis(Vector3::from_row_slice(&camera[..3]));
            let (translation, point) = (Vector3::from_row_slice(&camera[3..6]), &points[3 * of[1] as usize..][..3]);
            let at = image(rotation, translation, [camera[6], camera[7], camera[8]], [point[0], point[1], point[2]]);
            assert!((at[0] - of[2]).hypot(at[1] - of[3]) < 1e-6);
        }
    }

    #[test]
    fn cameras_with_more_than_these_files_say_are_refused() {
        let refused = |calibration: Calibration| {
            let model = model_of(&scene_of(calibration, SIZE));
            assert_eq!(bundle::out(&model), Err(Error::Camera));
            assert_eq!(bal::problem(&model), Err(Error::Camera));
        };
        refused(lens(1.1, [0.0; 5], [440.0, 610.0]));
        refused(lens(1.0, [0.0, 0.0, 0.01, 0.0, 0.0], [440.0, 610.0]));
        refused(lens(1.0, [0.0, 0.0, 0.0, 0.01, 0.0], [440.0, 610.0]));
        refused(fisheye(1.0, [0.0; 3], [440.0, 610.0]));
    }
}
