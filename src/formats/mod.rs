//! Files in and out: observations as CSV, and the result files, whose fields are a contract.
//!
//! May depend on `domain`, and on `report` for the page among the result files; knows nothing of transport.

pub mod error;
pub mod input;
pub mod observations;
pub mod ply;
pub mod result_files;
pub mod result_json;

#[cfg(test)]
pub(crate) mod fixture;

pub use error::Error;
pub use input::LabelledInput;
pub use observations::read;
