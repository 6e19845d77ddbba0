//! Translation between the wire's messages and the domain, both ways: the server reads requests and writes answers,
//! the client does the reverse.
//!
//! What cannot be read is a [`Violation`] that names its field: the server refuses the request with it, the client
//! refuses the answer.

pub mod create;
pub mod enums;
pub mod input;
pub mod job;
pub mod list;
pub mod matrix;
pub mod names;
pub mod progress;
pub mod result;
pub mod settings;
mod time;
pub mod upload;

pub(crate) use time::{optional_time, positive_duration, tellable, time_from_wire};

use crate::domain::Violation;

/// The field's value, or the violation that it is not set.
pub(crate) fn required<T>(value: Option<T>, field: &str) -> Result<T, Violation> {
    value.ok_or_else(|| Violation::of(field, "is not set"))
}
