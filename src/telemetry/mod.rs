//! What is seen from outside: metrics, their scrape port, logs, traces and the export of traces and metrics.
//!
//! May depend on `domain` only. Everything above the solver may call it, without conditions: where nothing is
//! installed, nothing happens. The solver itself stays silent.

pub mod attempt;
pub mod metrics;
pub mod otlp;
pub mod server;
pub mod silence;
pub mod throttle;
pub mod tracing;

pub use attempt::{Attempt, waited};
pub use server::Readiness;

#[cfg(test)]
#[path = "../../tests/it/support/collector.rs"]
mod collector;
#[cfg(test)]
#[path = "../../tests/it/support/scrape.rs"]
#[allow(dead_code, reason = "the tests of the whole use more of it")]
pub(crate) mod scrape;
