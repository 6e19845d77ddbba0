//! The server: services, health, reflection, compression and limits, put together in one place.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use governor::clock::DefaultClock;
use tokio::net::TcpListener;
use tokio::task::JoinError;
use tokio_rustls::rustls::ServerConfig;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::Status;
use tonic::codec::CompressionEncoding::Gzip;
use tonic::codegen::http::HeaderMap;
use tonic::service::Routes;
use tonic::transport::server::Router;
use tower::Layer;
use tower::layer::util::{Identity, Stack};

use super::access_log::RefusalLog;
use super::admin::Admin;
use super::auth::Authenticate;
use super::calibration::Calibration;
use super::call::{CallLayer, CallService};
use super::health::Health;
use super::inflight::{Budget, Permit};
use super::inputs::Inputs;
use super::jobs::Jobs;
use super::keys::{self, Grant, KeyRing};
use super::listener::{self, ConnectionInfo, Listener};
use super::proto::FILE_DESCRIPTOR_SET;
use super::proto::admin_service_server::AdminServiceServer;
use super::proto::calibration_service_server::CalibrationServiceServer;
use super::proto::input_service_server::InputServiceServer;
use super::proto::job_service_server::JobServiceServer;
use super::rates::{self, Rates};
use super::reload::{self, Current};
use super::tls;
use crate::domain::Limits;
use crate::engine::Engine;
use crate::telemetry::metrics::{Reloaded, locked_out};

/// Calls open at once on one connection: some hundred watchers and room for the rest. More wait on the client's side.
const MAX_STREAMS_PER_CONNECTION: u32 = 1_024;

/// Requests at work at once on one connection, each of which may hold a whole message in memory.
const MAX_REQUESTS_PER_CONNECTION: usize = 64;

/// A connection that is silent for this long is asked whether it lives, so that a `Solve` whose caller lost its power
/// is noticed.
const KEEPALIVE: Duration = Duration::from_secs(30);

/// How long the answer to that may take.
const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);

/// What a server needs to know.
#[derive(Debug, Clone)]
pub struct Options {
    /// Port 0 takes a free one.
    pub listen: SocketAddr,
    /// What one input may hold.
    pub limits: Limits,
    /// Largest message that is taken.
    pub max_message_bytes: usize,
    /// What calls may hold together, in bytes: see [`super::inflight`].
    pub max_inflight_bytes: u64,
    /// How long after every `Solve` that is attached to a job was disconnected the job is cancelled.
    pub solve_grace: Duration,
    /// `None`: connections are not encrypted.
    pub tls: Option<tls::Files>,
    /// Where none are, nobody needs one.
    pub keys: keys::Sources,
    /// How often a key may call and a tenant create jobs.
    pub rates: rates::Options,
    /// How often the files of certificates and keys are looked at.
    pub look_every: Duration,
    /// How long a connection may take to shake hands and to say its first words.
    pub handshake_timeout: Duration,
    /// Connections that have not come to their first words yet, at most; one more ends the oldest of them.
    pub max_silent_connections: usize,
    /// Connections that speak, at most; one more is refused.
    pub max_connections: usize,
    /// How long a connection may take until someone calls over it who may: with a key, where keys are asked for.
    /// `None`: for ever.
    pub auth_timeout: Option<Duration>,
    /// How long a connection may be silent before it is asked whether it lives.
    pub keepalive: Duration,
    /// How long the answer to that may take.
    pub keepalive_timeout: Duration,
    /// Whether callers may ask for the API's description.
    pub reflection: bool,
}

impl Options {
    /// What the API promises: long enough for a client to come back over a flaky network, short enough to free a
    /// worker soon.
    pub const SOLVE_GRACE: Duration = Duration::from_secs(5);

    /// Two million observations of at most 33 bytes; a larger input goes in chunks.
    pub const MAX_MESSAGE_BYTES: usize = 64 << 20;

    /// Twice the largest input by the default limits on its way into the store (4,000,000 observations of 40 bytes,
    /// three times), or a thousand small ones, on a machine with a few gigabytes.
    pub const MAX_INFLIGHT_BYTES: u64 = 1 << 30;

    /// Whether the files of certificates and keys can be used, as they are now.
    ///
    /// # Errors
    /// [`Error::Certificates`], [`Error::Keys`].
    pub fn check_access(&self) -> Result<(), Error> {
        self.tls.iter().try_for_each(|files| files.load().map(drop)).map_err(Error::Certificates)?;
        self.keys.load_some().map(drop).map_err(Error::Keys)
    }
}

impl Default for Options {
    /// A free port of the loopback interface.
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            limits: Limits::default(),
            max_message_bytes: Self::MAX_MESSAGE_BYTES,
            max_inflight_bytes: Self::MAX_INFLIGHT_BYTES,
            solve_grace: Self::SOLVE_GRACE,
            tls: None,
            keys: keys::Sources::default(),
            rates: rates::Options::default(),
            look_every: reload::LOOK_EVERY,
            handshake_timeout: listener::HANDSHAKE_TIMEOUT,
            max_silent_connections: listener::MAX_HANDSHAKING,
            max_connections: listener::MAX_ESTABLISHED,
            auth_timeout: Some(listener::AUTH_TIMEOUT),
            keepalive: KEEPALIVE,
            keepalive_timeout: KEEPALIVE_TIMEOUT,
            reflection: true,
        }
    }
}

/// Why a server did not come up, or went down.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("cannot listen on {address}: {source}")]
    Listen { address: SocketAddr, source: std::io::Error },
    #[error("cannot use the certificates: {0}")]
    Certificates(String),
    #[error("cannot use the keys: {0}")]
    Keys(String),
    #[error("cannot serve reflection: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    #[error("the server's task ended: {0}")]
    Task(#[from] JoinError),
}

/// A running server. Dropping it stops it at once.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    key_count: Option<usize>,
    gateway: Gateway,
    health: Arc<Health>,
    /// Has health follow the store.
    _store_task: AbortOnDropHandle<()>,
    stop: CancellationToken,
    task: AbortOnDropHandle<Result<(), tonic::transport::Error>>,
}

impl Server {
    /// Listens and serves. When this returns, connections are taken and health says SERVING.
    ///
    /// # Errors
    /// [`Error::Listen`] where the address cannot be had, [`Error::Certificates`], [`Error::Keys`].
    pub async fn bind(options: Options, engine: Engine) -> Result<Self, Error> {
        // First: an address that is bound takes connections.
        let certificates = certificates(&options).await?;
        let keys = keys(&options).await?;
        let key_count = keys.as_ref().map(|keys| keys.borrow().len());
        let rates = Arc::new(Rates::new(options.rates, DefaultClock::default()));
        let calls = CallLayer {
            authenticate: Authenticate::new(keys, rates),
            budget: Budget::new(options.max_inflight_bytes),
            max_message_bytes: options.max_message_bytes,
            refusals: RefusalLog::default(),
        };
        let listen_error = |source| Error::Listen { address: options.listen, source };
        let listener = TcpListener::bind(options.listen).await.map_err(listen_error)?;
        let address = listener.local_addr().map_err(listen_error)?;
        let (reporter, health_service) = tonic_health::server::health_reporter();
        let health = Arc::new(Health::new(reporter));
        let mut store = engine.store_state();
        let state = *store.borrow_and_update();
        health.set_store(state).await;
        let services = services(&options, engine)?;
        let listener_options = listener::Options {
            certificates,
            timeout: options.handshake_timeout,
            max_handshaking: options.max_silent_connections,
            max_established: options.max_connections,
            auth_timeout: options.auth_timeout,
            protocol: None,
        };
        let gateway = Gateway {
            service: calls.layer(services.clone()),
            listener: listener_options.clone(),
            describes: options.reflection,
            calls: calls.clone(),
        };
        let router = router(&options, services, calls).add_service(health_service);
        let stop = CancellationToken::new();
        let stopped = stop.clone().cancelled_owned();
        let incoming = Listener::new(listener, listener_options).into_stream();
        let task = tokio::spawn(router.serve_with_incoming_shutdown(incoming, stopped));
        let followed = Arc::clone(&health);
        let store_task = tokio::spawn(async move { followed.follow(store).await });
        Ok(Self {
            address,
            key_count,
            gateway,
            health,
            _store_task: AbortOnDropHandle::new(store_task),
            stop,
            task: AbortOnDropHandle::new(task),
        })
    }

    /// Where the server listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// How many keys there were at the start; `None`: nobody needs one.
    pub fn key_count(&self) -> Option<usize> {
        self.key_count
    }

    /// The API for another port of the same process.
    pub fn gateway(&self) -> Gateway {
        self.gateway.clone()
    }

    /// First phase of a drain: tells health checks NOT_SERVING, so that no new callers are sent here. Calls go on.
    pub async fn set_draining(&self) {
        self.health.drain().await;
    }

    /// Ends only when the server fails.
    ///
    /// # Errors
    /// Why it failed.
    pub async fn wait(&mut self) -> Result<(), Error> {
        Ok((&mut self.task).await??)
    }

    /// Second phase of a drain, after the engine's: takes no more connections, lets calls end for up to `bound`, then
    /// cuts them off.
    ///
    /// # Errors
    /// Why the server failed before.
    pub async fn shutdown(mut self, bound: Duration) -> Result<(), Error> {
        self.set_draining().await;
        self.stop.cancel();
        match tokio::time::timeout(bound, &mut self.task).await {
            Ok(ended) => Ok(ended??),
            Err(_) => {
                tracing::warn!(bound_seconds = bound.as_secs_f64(), "cutting off calls that outlast the drain");
                Ok(())
            }
        }
    }
}

/// The certificates, followed as their files change.
async fn certificates(options: &Options) -> Result<Option<Current<ServerConfig>>, Error> {
    let Some(files) = options.tls.clone() else { return Ok(None) };
    let load = move || {
        let config = files.load()?;
        if let Some(certificate) = files.certificate() {
            certificate.report();
        }
        Ok(config)
    };
    let paths = options.tls.iter().flat_map(tls::Files::paths).collect();
    let kept = reload::keep(Reloaded::Certificates, paths, options.look_every, load).await;
    kept.map(Some).map_err(Error::Certificates)
}

/// The keys, followed as their file changes.
async fn keys(options: &Options) -> Result<Option<Current<KeyRing>>, Error> {
    let sources = options.keys.clone();
    if !sources.is_on() {
        return Ok(None);
    }
    sources.load_some().map_err(Error::Keys)?;
    let paths = sources.file.iter().cloned().collect();
    let load = move || {
        let ring = sources.load()?;
        locked_out(ring.is_empty());
        if ring.is_empty() {
            tracing::error!("the last API key is gone: every call is refused until auth.keys_file has a key again");
        }
        Ok(ring)
    };
    let kept = reload::keep(Reloaded::Keys, paths, options.look_every, load).await;
    kept.map(Some).map_err(Error::Keys)
}

/// The API as another port of the same process serves it: the same services behind the same layer, and what it needs
/// to treat its callers in the same way.
#[derive(Debug, Clone)]
pub struct Gateway {
    /// Calls that never leave the process.
    pub service: CallService<Routes>,
    /// How gRPC's own connections are let in.
    pub listener: listener::Options,
    /// Whether callers may ask for the API's description.
    pub describes: bool,
    calls: CallLayer,
}

impl Gateway {
    /// What the key that the headers hold stands for, where one is asked for: before a request is read that only a call
    /// will refuse. Its connection may stay then.
    ///
    /// # Errors
    /// `UNAUTHENTICATED`.
    pub fn check_key(&self, headers: &HeaderMap, connection_info: &ConnectionInfo) -> Result<Grant, Status> {
        let checked = self.calls.authenticate.check(headers);
        let grant = checked.inspect_err(|status| self.log_refused(status, connection_info))?;
        connection_info.set_authenticated();
        Ok(grant)
    }

    /// Writes down that a request was refused before it became a call.
    pub fn log_refused(&self, status: &Status, connection_info: &ConnectionInfo) {
        self.calls.refusals.log_early(status, connection_info);
    }

    /// Whether callers need keys.
    pub fn asks_for_keys(&self) -> bool {
        self.calls.authenticate.is_on()
    }

    /// A permit for what a request holds beside its call.
    pub fn permit(&self) -> Permit {
        Permit::new(Arc::clone(&self.calls.budget))
    }
}

/// Every service but health.
fn services(options: &Options, engine: Engine) -> Result<Routes, Error> {
    let limits = options.limits.clone();
    let max_bytes = options.max_message_bytes;
    let calibration = Calibration::new(engine.clone(), options);
    let inputs = Inputs::new(engine.clone(), limits.clone());
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    macro_rules! with_limits {
        ($service:expr) => {
            $service.accept_compressed(Gzip).send_compressed(Gzip).max_decoding_message_size(max_bytes)
        };
    }
    let services = Routes::new(with_limits!(CalibrationServiceServer::new(calibration)))
        .add_service(with_limits!(AdminServiceServer::new(Admin::new(engine.clone()))))
        .add_service(with_limits!(JobServiceServer::new(Jobs::new(engine, limits, max_bytes as u64))))
        .add_service(with_limits!(InputServiceServer::new(inputs)));
    if !options.reflection {
        return Ok(services);
    }
    // Older clients, grpcurl and Python's among them, still ask for v1alpha.
    Ok(services.add_service(reflection().build_v1()?).add_service(reflection().build_v1alpha()?))
}

/// The services behind the layer of calls, as connections reach them.
fn router(options: &Options, services: Routes, calls: CallLayer) -> Router<Stack<CallLayer, Identity>> {
    tonic::transport::Server::builder()
        .layer(calls)
        .concurrency_limit_per_connection(MAX_REQUESTS_PER_CONNECTION)
        .max_concurrent_streams(MAX_STREAMS_PER_CONNECTION)
        .http2_keepalive_interval(Some(options.keepalive))
        .http2_keepalive_timeout(Some(options.keepalive_timeout))
        .add_routes(services)
}
