//! OpenSfM's files: tracks in, tracks and reconstructions out.
//!
//! Coordinates are normalised there: the origin in the middle of the image, its larger side 1 (mapillary/OpenSfM,
//! `doc/source/geometry.rst` and `opensfm/features.py`).

pub mod reconstruction;
mod sizes;
pub mod tracks;
pub mod write_tracks;

use std::collections::BTreeSet;

use super::metric::Model;
use crate::domain::ImageSize;

/// Position of the middle of the image, and the length that is 1, in our pixels, where the centre of the top-left pixel
/// is (0, 0), as it is in OpenSfM's own: `x_normalised = (x_px - middle) / side`, `middle = (width - 1) / 2`.
fn frame(size: ImageSize) -> ([f64; 2], f64) {
    let sides = [size.width_px, size.height_px].map(f64::from);
    (sides.map(|side| (side - 1.0) / 2.0), sides[0].max(sides[1]))
}

/// The names of the images of each model as OpenSfM has them: it keeps all images in one folder, so that a name has no
/// folders, unless two images would have one name then.
fn shot_names(models: &[Model]) -> Vec<Vec<String>> {
    let all = |name: &dyn Fn(String) -> String| -> Vec<Vec<String>> {
        let of_model = |model: &Model| model.images.iter().map(|image| name(image.name.to_string())).collect();
        models.iter().map(of_model).collect()
    };
    let without_folders = all(&|name| name.rsplit('/').next().unwrap_or_default().to_owned());
    let different: BTreeSet<&String> = without_folders.iter().flatten().collect();
    let count = without_folders.iter().flatten().count();
    if different.len() == count { without_folders } else { all(&|name| name) }
}
