//! What is seen from outside: metrics, their scrape port, logs and traces.
//!
//! May depend on `domain` only; everything above the solver may call it, the solver itself stays silent.

pub mod metrics;
