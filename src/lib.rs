//! Self-calibrating projective structure from motion as a long-running gRPC service, and its command line.
//!
//! What is computed, and after which paper, says [`scpsfm_core`], which solves; here inputs come in as messages and
//! files, wait in a queue, are handed to workers, and leave as results, events, files and tables.
//!
//! Direction of dependence, top to bottom; nothing points upwards:
//!
//! ```text
//! cli -> http -> rpc -> engine -> { store, scpsfm_core } -> domain
//! cli -> client -> rpc
//! ```
//!
//! Beside them `evaluation` holds the methods against the truth of [`synthetic`] scenes, `formats` and `report` read and
//! write files.
//!
//! [`client`] is for programs that call the service. Only it, [`rpc`], [`http`] and the commands that show the API's
//! messages see prost and tonic, only [`store`] sees SQL (but for `formats`, which reads COLMAP's databases).

pub mod cli;
pub mod client;
pub mod config;
pub mod domain;
pub mod engine;
pub(crate) mod evaluation;
pub(crate) mod formats;
pub mod http;
pub(crate) mod report;
pub mod rpc;
pub mod store;
pub mod telemetry;

pub(crate) use scpsfm_core::{matrix_of_cameras, parallel, statistics, training};
pub use scpsfm_core::{solver, synthetic};
