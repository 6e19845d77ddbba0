//! JSON over HTTP: the methods of the API under the paths that their `google.api.http` rules name, in the proto's
//! canonical JSON, beside gRPC on a port of its own.
//!
//! ```text
//! connection -> listener (TLS, bounds) -> api: route -> JSON to message -> gRPC within the process
//!                                              answer <- message to JSON, or server-sent events <-
//! ```
//!
//! Beside them the same methods as gRPC-Web, and a console for people ([`console`]). Pages of other sites are refused,
//! unless their origins are configured.
//!
//! Every request becomes a call of gRPC that never leaves the process: keys, bounds, metrics and errors are those of
//! [`crate::rpc`], and a method that the proto adds is served without a line here.

mod answer;
mod api;
mod codec;
mod console;
mod download;
mod grpc_web;
mod openapi;
mod origin;
mod route;
mod unique_keys;
mod upload;

use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use axum::body::Body;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use prost::Message as _;
use prost_reflect::{DescriptorPool, MessageDescriptor};
use tokio::net::TcpListener;
use tokio::task::{JoinHandle, JoinSet};
use tokio_util::sync::CancellationToken;

use crate::domain::job::Job;
use crate::rpc::convert;
use crate::rpc::listener::{self, Listener};
use crate::rpc::proto::FILE_DESCRIPTOR_SET;
use crate::rpc::server::Gateway;
use crate::telemetry::silence;
use api::Api;

/// Protocol that clients over TLS are offered.
const HTTP_1: &[u8] = b"http/1.1";

/// Largest body of JSON: an input of some 300,000 observations. At 60 bytes a byte, which the worst JSON takes in
/// memory, it leaves room for some 20,000 objects in what all calls may hold by default. Larger inputs are uploaded as
/// protobuf.
pub const MAX_BODY_BYTES: usize = 16 << 20;

/// How long a request's head may take, and a connection may wait for the next one.
const HEAD_TIMEOUT: Duration = Duration::from_secs(30);

/// How long nothing may move on a connection: events are told apart by a comment every 15 s.
const SILENCE: Duration = Duration::from_secs(120);

/// A job as `GET /v1/{name}` answers it: what webhooks are sent.
///
/// # Errors
/// A defect of ours.
pub fn encode_job(job: &Job) -> Result<Vec<u8>, String> {
    static DESCRIPTOR: LazyLock<Result<MessageDescriptor, String>> = LazyLock::new(|| {
        let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).map_err(|error| error.to_string())?;
        pool.get_message_by_name("scpsfm.v1.Job").ok_or_else(|| "the proto lacks Job".into())
    });
    let bytes = convert::job::to_wire(job).encode_to_vec();
    answer::message(DESCRIPTOR.as_ref().map_err(Clone::clone)?, &bytes).map_err(|status| status.message().to_owned())
}

/// How the port is served.
#[derive(Debug, Clone)]
pub struct Options {
    /// Port 0 takes a free one.
    pub listen: SocketAddr,
    /// Largest body of JSON.
    pub max_body_bytes: usize,
    /// Names under which the port is reached; without keys no others are answered but addresses and localhost.
    pub hosts: Vec<String>,
    /// Origins of pages of other sites that may call.
    pub allowed_origins: Vec<String>,
}

impl Default for Options {
    /// A free port of the loopback interface.
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            max_body_bytes: MAX_BODY_BYTES,
            hosts: Vec::new(),
            allowed_origins: Vec::new(),
        }
    }
}

/// Why the port is not served.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("cannot listen on {address} for HTTP: {source}")]
    Listen { address: SocketAddr, source: io::Error },
    #[error("cannot serve the API over HTTP: {0}")]
    Api(String),
}

/// The running port.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Server {
    /// Listens and serves. When this returns, requests are answered.
    ///
    /// # Errors
    /// [`Error::Listen`] where the address cannot be had.
    pub async fn bind(options: Options, gateway: Gateway) -> Result<Self, Error> {
        let listen_error = |source| Error::Listen { address: options.listen, source };
        let listener = TcpListener::bind(options.listen).await.map_err(listen_error)?;
        let address = listener.local_addr().map_err(listen_error)?;
        let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).map_err(|error| Error::Api(error.to_string()))?;
        let listening = listener::Options { protocol: Some(HTTP_1), ..gateway.listener.clone() };
        let listener = Listener::new(listener, listening);
        let api = Api::new(&pool, gateway, options).map_err(Error::Api)?;
        let stop = CancellationToken::new();
        let task = tokio::spawn(serve(listener, Arc::new(api), stop.clone()));
        Ok(Self { address, stop, task })
    }

    /// Where the port listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Takes no more connections, lets requests end for up to `bound`, then cuts them off.
    pub async fn shutdown(mut self, bound: Duration) {
        self.stop.cancel();
        if tokio::time::timeout(bound, &mut self.task).await.is_err() {
            tracing::warn!(bound_seconds = bound.as_secs_f64(), "cutting off HTTP requests that outlast the drain");
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Serves connections until it is told to stop, and then until their requests have been answered. Dropped, it cuts them
/// off.
async fn serve(mut listener: Listener, api: Arc<Api>, stop: CancellationToken) {
    let graceful = GracefulShutdown::new();
    let mut connections = JoinSet::new();
    loop {
        let connection = tokio::select! {
            connection = listener.next() => connection,
            Some(_) = connections.join_next() => continue,
            () = stop.cancelled() => break,
        };
        let (connection_info, api) = (connection.connection_info(), api.clone());
        let answer = service_fn(move |request: hyper::Request<hyper::body::Incoming>| {
            let (connection_info, api) = (connection_info.clone(), api.clone());
            async move { Ok::<_, Infallible>(api.answer(connection_info, request.map(Body::new)).await) }
        });
        let io = TokioIo::new(silence::Connection::new(connection, SILENCE));
        let served = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEAD_TIMEOUT)
            .serve_connection(io, answer);
        let served = graceful.watch(served);
        connections.spawn(async move {
            if let Err(error) = served.await {
                tracing::debug!(%error, "an HTTP connection ended");
            }
        });
    }
    graceful.shutdown().await;
}
