//! Writing a problem of BAL, Bundle Adjustment in the Large.

use std::fmt::Write;

use super::{Error, cameras};
use crate::formats::metric::Model;

/// `problem.txt`: the numbers of cameras, points and observations, `camera point x y` of each observation, then a
/// number a line: of each camera rotation (angle times axis), translation, focal length, k1 and k2, of each point its
/// position.
///
/// # Errors
/// A camera that the file cannot say.
pub fn problem(model: &Model) -> Result<String, Error> {
    let cameras = cameras(model)?;
    let observations: usize = model.points.iter().map(|point| point.seen.len()).sum();
    // Writing to a String cannot fail.
    let mut text = format!("{} {} {observations}\n", cameras.len(), model.points.len());
    for (place, point) in model.points.iter().enumerate() {
        for &(image, keypoint) in &point.seen {
            let seen = &model.images[image].keypoints[keypoint];
            let [x, y] = cameras[image].coordinates(seen.x, seen.y);
            let _ = writeln!(text, "{image} {place} {x} {y}");
        }
    }
    for camera in &cameras {
        let (rotation, translation) = (camera.rotation.scaled_axis(), camera.translation);
        let numbers = rotation.iter().chain(translation.iter()).chain([&camera.focal_px]).chain(&camera.radial);
        numbers.for_each(|number| _ = writeln!(text, "{number}"));
    }
    for point in &model.points {
        point.position.iter().for_each(|number| _ = writeln!(text, "{number}"));
    }
    Ok(text)
}
