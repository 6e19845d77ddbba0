//! The gRPC side: generated messages, their translation from and to the domain, and one file a service.
//!
//! Depends on `engine`, `telemetry` and `domain`; this module, `http`, `client` and a few commands see prost and
//! tonic.

pub mod access_log;
pub mod admin;
pub mod auth;
pub mod calibration;
pub mod call;
pub mod caller;
pub mod convert;
mod decoded_size;
pub mod disconnect;
mod health;
pub mod inflight;
pub mod inputs;
pub mod jobs;
pub mod keys;
pub mod listener;
mod message_body;
mod methods;
pub mod proto;
pub mod rates;
pub mod reload;
pub mod server;
pub mod status;
pub mod submission;
pub mod tls;
mod upload_reader;

use tonic::Status;

/// Runs what computes for long on a thread that serves no one else.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Status> {
    tokio::task::spawn_blocking(work).await.map_err(|error| status::internal(&error))
}
