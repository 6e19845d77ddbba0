//! The cameras of a scene: focal lengths, lens and principal point of each view.

use super::motion::Path;
use super::{FocalKind, IMAGE_SIZE, LensKind, PhotographedOptions};
use crate::synthetic::scene::{Camera, Lens, Pose};

/// Centre of the image in pixels; that of the top-left pixel is (0, 0).
pub fn centre_px() -> [f64; 2] {
    [f64::from(IMAGE_SIZE.width_px), f64::from(IMAGE_SIZE.height_px)].map(|side| (side - 1.0) / 2.0)
}

/// Camera group of each view.
pub fn camera_groups(options: &PhotographedOptions) -> Vec<u32> {
    let second = |view: usize| u32::from(options.focal == FocalKind::TwoGroups && view % 2 == 1);
    (0..options.views).map(second).collect()
}

/// The cameras on a path, one a view.
pub fn cameras(options: &PhotographedOptions, path: &Path) -> Vec<Camera> {
    path.poses.iter().enumerate().map(|(view, pose)| camera(options, *pose, focal_px(options, view))).collect()
}

/// Focal length of a view.
fn focal_px(options: &PhotographedOptions, view: usize) -> f64 {
    let share = match options.focal {
        FocalKind::ConstantFocal => 0.0,
        // By equal factors, with the middle of the logarithms in the middle of the views.
        FocalKind::DriftingFocal => view as f64 / (options.views - 1) as f64 - 0.5,
        FocalKind::TwoGroups => (view % 2) as f64,
    };
    options.focal_px * options.focal_ratio.powf(share)
}

fn camera(options: &PhotographedOptions, pose: Pose, focal_px: f64) -> Camera {
    let [x, y] = centre_px();
    let [right, down] = options.principal_point.map(|shift| shift * f64::from(IMAGE_SIZE.width_px));
    let lens = match options.lens {
        LensKind::Fisheye => Lens::Equidistant,
        _ => Lens::Radial(options.radial),
    };
    Camera { pose, focal_px, aspect: options.aspect, principal_point_px: [x + right, y + down], lens }
}

/// Whether every pixel of every view is the image of one direction in front of the camera.
pub fn images_all(options: &PhotographedOptions) -> bool {
    let [width, height] = [IMAGE_SIZE.width_px, IMAGE_SIZE.height_px].map(f64::from);
    let corners = [[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]];
    // The shortest focal length has the widest view.
    let shortest = (0..options.views).map(|view| focal_px(options, view)).fold(f64::INFINITY, f64::min);
    let camera = camera(options, Pose::IDENTITY, shortest);
    corners.iter().all(|corner| camera.ray(*corner).is_some())
}
