//! What is seen from outside: metrics, their scrape port, logs and traces.
//!
//! May depend on `domain` only. Everything above the solver may call it, without conditions: where nothing is
//! installed, nothing happens. The solver itself stays silent.

pub mod attempt;
pub mod metrics;
pub mod server;
pub mod silence;
pub mod throttle;
pub mod tracing;

pub use attempt::{Attempt, waited};
pub use server::Readiness;
