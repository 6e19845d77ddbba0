//! Files in and out: tables of observations, OpenSfM's and COLMAP's files, and the result files, whose fields are a
//! contract.
//!
//! May depend on `domain` and `geometry`, and on `report` for the page among the result files; knows nothing of
//! transport.

pub mod bundler;
pub mod cameras_json;
pub mod colmap;
pub mod error;
pub mod export;
mod focal_priors;
pub mod input;
pub mod intrinsics_json;
pub mod json;
pub mod label;
pub mod manifest;
pub mod metric;
pub mod nerfstudio;
pub mod observations;
pub mod opensfm;
pub mod ply;
pub mod publish;
pub mod result_files;
pub mod result_json;
pub mod second_structures;
pub mod source;
mod text;
pub mod track_counts;
pub mod view_table;
pub mod warnings;
pub mod windows;

#[cfg(test)]
pub(crate) mod fixture;
#[cfg(test)]
pub(crate) mod lens_fixture;
#[cfg(test)]
pub(crate) mod mutation;

pub use error::Error;
pub use export::Export;
pub use input::LabelledInput;
pub use label::Label;
pub use source::{Format, Matches, Reading, STANDARD_INPUT, read};
