//! Translation between the wire's messages and the domain, both ways: the server reads requests and writes answers,
//! the client does the reverse.
//!
//! What cannot be read is a [`Violation`] that names its field: the server refuses the request with it, the client
//! refuses the answer. Stages, proposals, warnings, reasons for views and kinds of events may be unknown in an answer.

pub mod create;
pub mod enums;
pub mod input;
pub mod input_message;
pub mod job;
pub mod list;
pub mod matches;
pub mod matrix;
pub mod names;
pub mod progress;
pub mod result;
mod second_structures;
pub mod settings;
mod time;
mod tracks;
pub mod upload;

pub(crate) use time::{optional_time, positive_duration, tellable, time_from_wire};

use crate::domain::Violation;

/// A length in bytes; nothing that is stored comes near the largest, and a bound above it is none.
pub fn size_to_wire(bytes: u64) -> i64 {
    i64::try_from(bytes).unwrap_or(i64::MAX)
}

/// # Errors
/// A violation of the field where it is negative.
fn size_from_wire(bytes: i64, field: &str) -> Result<u64, Violation> {
    bytes.try_into().map_err(|_| Violation::of(field, format!("{bytes} is negative")))
}

/// A count. None above 32 bits can be asked for, and a bound above them is none.
pub fn count_to_wire(count: u64) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

/// A text that may be left out, which on the wire is an empty one.
pub fn given(text: String) -> Option<String> {
    (!text.is_empty()).then_some(text)
}

/// The field's value, or the violation that it is not set.
pub(crate) fn required<T>(value: Option<T>, field: &str) -> Result<T, Violation> {
    value.ok_or_else(|| Violation::of(field, "is not set"))
}
