//! Multiple-view geometry: pure functions and types in f64, cameras in normalised image units.
//!
//! May depend on `domain` (for its stop token) and linear algebra; knows nothing of networks, jobs or I/O.

pub mod bundle;
pub mod daq;
pub mod homography;
pub mod metric;
