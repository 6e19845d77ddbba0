//! COLMAP's files: a database of keypoints and matches or a sparse model in, a sparse model out.
//!
//! COLMAP's pixels begin at the corner of the image: the centre of its top-left pixel is (.5, .5), where ours is (0,
//! 0).

pub mod cameras;
pub mod database;
mod images;
pub mod model;
mod tracks;
pub mod write;

/// COLMAP's coordinate of the centre of the first pixel, which is 0 for us.
const FIRST_PIXEL: f64 = 0.5;
