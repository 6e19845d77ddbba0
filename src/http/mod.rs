//! JSON over HTTP: the methods of the API under the paths that their `google.api.http` rules name, in the proto's
//! canonical JSON, beside gRPC on a port of its own.
//!
//! ```text
//! connection -> listener (TLS, bounds) -> api: route -> JSON to message -> gRPC within the process
//!                                              answer <- message to JSON, or server-sent events <-
//! ```
//!
//! Every request becomes a call of gRPC that never leaves the process: keys, bounds, metrics and errors are those of
//! [`crate::rpc`], and a method that the proto adds is served without a line here.

mod answer;
mod api;
mod codec;
mod openapi;
mod route;
mod upload;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::connect_info::Connected;
use axum::extract::{ConnectInfo, Request, State};
use axum::serve::{IncomingStream, Listener};
use prost_reflect::DescriptorPool;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::rpc::listener::{self, Connection, Incoming, Introduction};
use crate::rpc::proto::FILE_DESCRIPTOR_SET;
use crate::rpc::server::Gateway;
use crate::telemetry::silence::Bounded;
use api::Api;

/// Protocol that clients over TLS are offered.
const HTTP_1: &[u8] = b"http/1.1";

/// Largest body of JSON: a number takes about twice the bytes that it has in protobuf, so that this holds an input of
/// about a million observations. Larger ones are uploaded as protobuf.
pub const MAX_BODY_BYTES: usize = 64 << 20;

/// How long nothing may move on a connection: events are told apart by a comment every 15 s.
const SILENCE: Duration = Duration::from_secs(120);

/// How the port is served.
#[derive(Debug, Clone)]
pub struct Options {
    /// Port 0 takes a free one.
    pub listen: SocketAddr,
    /// Largest body of JSON.
    pub max_body_bytes: usize,
}

impl Default for Options {
    /// A free port of the loopback interface.
    fn default() -> Self {
        Self { listen: SocketAddr::from(([127, 0, 0, 1], 0)), max_body_bytes: MAX_BODY_BYTES }
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
    task: JoinHandle<io::Result<()>>,
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
        let incoming = listener::Options { protocol: Some(HTTP_1), ..gateway.listener.clone() };
        let incoming = listener::incoming(listener, incoming);
        let api = Api::new(&pool, gateway, options.max_body_bytes).map_err(Error::Api)?;
        let router = Router::new().fallback(answer_to).with_state(Arc::new(api));
        let stop = CancellationToken::new();
        let serve = axum::serve(
            Bounded { listener: Entrance { incoming, address }, silence: SILENCE },
            router.into_make_service_with_connect_info::<Caller>(),
        );
        let task = tokio::spawn(serve.with_graceful_shutdown(stop.clone().cancelled_owned()).into_future());
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

async fn answer_to(State(api): State<Arc<Api>>, caller: ConnectInfo<Caller>, request: Request) -> answer::Answer {
    api.answer(caller.0.0, request).await
}

/// Whether anyone who may call has called over the connection: see [`Introduction`].
#[derive(Debug, Clone)]
struct Caller(Introduction);

impl Connected<IncomingStream<'_, Bounded<Entrance>>> for Caller {
    fn connect_info(stream: IncomingStream<'_, Bounded<Entrance>>) -> Self {
        Self(stream.io().inner().introduction())
    }
}

/// The connections of gRPC's listener, for axum.
struct Entrance {
    incoming: Incoming,
    address: SocketAddr,
}

impl Listener for Entrance {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        (self.incoming.next().await, self.address)
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.address)
    }
}
