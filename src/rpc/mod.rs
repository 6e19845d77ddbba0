//! The gRPC side: generated messages, their translation from and to the domain, and one file a service.
//!
//! Depends on `engine`, `telemetry` and `domain`; only this module and the client side of `cli` see prost and tonic.

pub mod convert;
pub mod proto;
