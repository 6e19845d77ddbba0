//! Writing `bundle.out`, version 0.3, and the list of its images.

use std::fmt::Write;

use super::{Error, cameras};
use crate::formats::metric::Model;

const HEADER: &str = "# Bundle file v0.3\n";

/// `bundle.out`: for each camera `f k1 k2`, rotation and translation, for each point its position, its colour and
/// `camera keypoint x y` of the images that see it.
///
/// # Errors
/// A camera that the file cannot say.
pub fn out(model: &Model) -> Result<String, Error> {
    let cameras = cameras(model)?;
    // Writing to a String cannot fail.
    let mut text = format!("{HEADER}{} {}\n", cameras.len(), model.points.len());
    for camera in &cameras {
        let [k1, k2] = camera.radial;
        let _ = writeln!(text, "{} {k1} {k2}", camera.focal_px);
        for row in camera.rotation.matrix().row_iter() {
            let _ = writeln!(text, "{} {} {}", row[0], row[1], row[2]);
        }
        let t = camera.translation;
        let _ = writeln!(text, "{} {} {}", t.x, t.y, t.z);
    }
    for point in &model.points {
        let ([x, y, z], [red, green, blue]) = (point.position, point.colour);
        let _ = write!(text, "{x} {y} {z}\n{red} {green} {blue}\n{}", point.seen.len());
        for &(image, keypoint) in &point.seen {
            let seen = &model.images[image].keypoints[keypoint];
            let [x, y] = cameras[image].coordinates(seen.x, seen.y);
            let _ = write!(text, " {image} {keypoint} {x} {y}");
        }
        text.push('\n');
    }
    Ok(text)
}

/// The names of the images, one a line, in the order of the cameras.
pub fn list(model: &Model) -> String {
    model.images.iter().map(|image| format!("{}\n", image.name)).collect()
}
