//! Reading a COLMAP sparse model: a directory with `cameras` and `images`, both `.bin` or both `.txt`.
//!
//! The images list their keypoints and the point in space that each belongs to, so the tracks are there whole;
//! `points3D`, rigs and frames are not read. Poses, points and calibration are left alone: what is solved is the
//! tracks.

mod binary;
mod text;

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use super::images::{Images, Observation};
use crate::domain::{Limits, counted};
use crate::formats::error::{Error, Problem};
use crate::formats::input::{LabelledInput, display_path};

/// COLMAP's id of no point in space, in binary files.
const NO_POINT: u64 = u64::MAX;

/// Whether a directory holds a model.
pub fn is_model(directory: &Path) -> bool {
    extension(directory).is_some()
}

/// Whether a file of this name, in lower case, is a part of a model.
pub fn is_part(name: &str) -> bool {
    name.rsplit_once('.').is_some_and(|(stem, extension)| {
        ["cameras", "images", "points3d", "rigs", "frames"].contains(&stem) && ["bin", "txt"].contains(&extension)
    })
}

/// The kind of files of a model; like COLMAP, binary before text.
fn extension(directory: &Path) -> Option<&'static str> {
    let holds = |name: &str| directory.join(name).is_file();
    ["bin", "txt"].into_iter().find(|kind| holds(&format!("cameras.{kind}")) && holds(&format!("images.{kind}")))
}

/// Reads the tracks of a model; a track's id is that of its point in space, a view's name that of its image.
///
/// # Errors
/// What is wrong with a file, by line or by byte; a model above `limits`.
pub fn read(directory: &Path, limits: &Limits) -> Result<LabelledInput, Error> {
    let kind = extension(directory).ok_or_else(|| {
        Error::whole(&display_path(directory), "is no COLMAP model: cameras and images, .bin or .txt, are needed")
    })?;
    let mut images = Images::default();
    let paths = ["cameras", "images"].map(|table| directory.join(format!("{table}.{kind}")));
    let [cameras_name, images_name] = [&paths[0], &paths[1]].map(|path| display_path(path));
    let observations = if kind == "bin" {
        let (cameras, length) = open(&paths[0])?;
        binary::cameras(cameras, &cameras_name, Some(length), &mut images)?;
        let (reader, length) = open(&paths[1])?;
        binary::images(reader, &images_name, Some(length), limits, &mut images)?
    } else {
        text::cameras(open(&paths[0])?.0, &cameras_name, &mut images)?;
        text::images(open(&paths[1])?.0, &images_name, limits, &mut images)?
    };
    into_labelled(images, observations, &paths[1], limits)
}

fn into_labelled(
    images: Images,
    observations: Vec<Observation>,
    path: &Path,
    limits: &Limits,
) -> Result<LabelledInput, Error> {
    if observations.is_empty() {
        let what = format!("has {}, and no keypoint of a point in space", counted(images.len(), "image"));
        return Err(Error::whole(&display_path(path), what));
    }
    // Lines are those of the images.
    let labelled = images.into_labelled(observations, path, Vec::new());
    labelled.check(limits)?;
    Ok(labelled)
}

/// Opens a file of a model; returns its length too.
fn open(path: &Path) -> Result<(BufReader<File>, u64), Error> {
    let opened = File::open(path).and_then(|file| Ok((file.metadata()?.len(), file)));
    let (length, file) = opened.map_err(|error| Error::one(&display_path(path), Problem::unreadable(error)))?;
    Ok((BufReader::new(file), length))
}

/// Bounds while reading what a file announces.
struct ReadBounds {
    most_views: usize,
    most_observations: usize,
}

impl ReadBounds {
    fn new(limits: &Limits) -> Self {
        Self { most_views: limits.max_views, most_observations: limits.max_observations }
    }

    fn check(&self, images: &Images, observations: &[Observation]) -> Result<(), String> {
        if images.len() > self.most_views {
            Err(format!("more images than the limit of {}", self.most_views))
        } else if observations.len() > self.most_observations {
            Err(format!("more observations than the limit of {}", self.most_observations))
        } else {
            Ok(())
        }
    }
}

#[cfg(test)]
#[path = "model_tests.rs"]
mod tests;
