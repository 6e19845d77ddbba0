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

use std::time::SystemTime;

use prost_types::Timestamp;

use crate::domain::Violation;

/// The field's value, or the violation that it is not set.
pub(crate) fn required<T>(value: Option<T>, field: &str) -> Result<T, Violation> {
    value.ok_or_else(|| Violation::of(field, "is not set"))
}

/// A time from the wire.
pub(crate) fn time_from_wire(time: Timestamp, field: &str) -> Result<SystemTime, Violation> {
    SystemTime::try_from(time).map_err(|_| Violation::of(field, "is not a time that this system can represent"))
}

/// An optional time from the wire.
pub(crate) fn optional_time(time: Option<Timestamp>, field: &str) -> Result<Option<SystemTime>, Violation> {
    time.map(|time| time_from_wire(time, field)).transpose()
}
