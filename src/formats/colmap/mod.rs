//! COLMAP's files: a database of keypoints and matches or a sparse model in, either of them out.
//!
//! COLMAP's pixels begin at the corner of the image: the centre of its top-left pixel is (.5, .5), where ours is (0,
//! 0).

pub mod cameras;
pub mod database;
#[cfg(test)]
pub(crate) mod database_fixture;
mod images;
mod intrinsics;
pub mod model;
mod two_view;
pub mod write;
pub mod write_database;
pub mod write_frames;

pub use images::{ColmapImage, Frame};

/// COLMAP's coordinate of the centre of the first pixel, which is 0 for us.
pub(super) const FIRST_PIXEL: f64 = 0.5;
