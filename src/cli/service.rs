//! The service as `serve` and `demo` run it: store, engine and gRPC server, put together from a configuration.

use std::future::Future;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::timeout;

use super::exit::Failure;
use crate::config::{self, Config};
use crate::engine::{self, Engine};
use crate::http;
use crate::rpc::convert::result::encode as encode_result;
use crate::rpc::keys::Sources;
use crate::rpc::server::{self, Server};
use crate::store::postgres::Postgres;
use crate::store::sqlite::Sqlite;
use crate::store::{QueueBounds, Store, TenantShares};

/// How long calls may outlast the engine's drain: their streams end with it, so this is for the network only.
const CALLS_BOUND: Duration = Duration::from_secs(5);

/// How long the store may take to close. What it does then, such as writing a log back, the next start does otherwise.
const CLOSE_BOUND: Duration = Duration::from_secs(5);

/// A running service.
pub struct Service {
    store: Arc<Store>,
    engine: Engine,
    server: Server,
    http: Option<http::Server>,
    drain_bound: Duration,
}

impl Service {
    /// Opens the store, takes up the jobs it holds and serves. When this returns, calls are answered. `None` where
    /// `ended` was over before the store was open and asked for its jobs, which may have its schema to bring up to date
    /// or wait for another server that does; from then on jobs have begun, and are not dropped.
    ///
    /// # Errors
    /// A data directory that cannot be used or an address that cannot be had.
    pub async fn start(config: &Config, ended: impl Future<Output = ()>) -> Result<Option<Self>, Failure> {
        let options = server_options(config);
        // Before the store is opened and its jobs begin: who cannot be let in is no reason to take them up.
        options.check_access().map_err(Failure::bad_config)?;
        let webhooks = config.webhooks.options(http::encode_job).map_err(Failure::bad_config)?;
        let engine_options = engine::Options { webhooks, ..engine_options(config) };
        let mut ended = pin!(ended);
        let store = tokio::select! {
            store = open_store(&config.store) => store?,
            () = &mut ended => return Ok(None),
        };
        let solver = engine::solver_on(config.compute.threads());
        let started = tokio::select! {
            biased;
            started = Engine::start(engine_options, store.clone(), solver, encode_result) => started,
            // It waits for the store, and for nothing once jobs begin.
            () = ended => {
                close(&*store).await;
                return Ok(None);
            }
        };
        let engine = match started {
            Ok(engine) => engine,
            Err(error) => {
                close(&*store).await;
                return Err(Failure::internal(format_args!("cannot start the engine: {error}")));
            }
        };
        match bind(options, config, engine.clone()).await {
            Ok((server, http)) => {
                let drain_bound = Duration::from_secs(config.engine.drain_seconds);
                Ok(Some(Self { store, engine, server, http, drain_bound }))
            }
            Err(failure) => {
                // Jobs that have begun by now are to lose no attempt by an address that is taken.
                give_back(&engine, &*store).await;
                Err(failure)
            }
        }
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.server.address()
    }

    /// Where the port for HTTP listens, if there is one.
    pub fn http_address(&self) -> Option<SocketAddr> {
        self.http.as_ref().map(http::Server::address)
    }

    /// Jobs that dead processes had left running, which the start took back.
    pub fn recovered_jobs(&self) -> usize {
        self.engine.recovered_jobs()
    }

    /// Jobs that wait; `None` where the store does not say.
    pub async fn queued_jobs(&self) -> Option<u64> {
        self.engine.queue_stats().await.ok().map(|stats| stats.queued)
    }

    /// API keys at the start; `None`: callers need none.
    pub fn key_count(&self) -> Option<usize> {
        self.server.key_count()
    }

    /// What can be done with the store.
    pub fn store_state(&self) -> tokio::sync::watch::Receiver<engine::StoreState> {
        self.engine.store_state()
    }

    /// Waits until a caller asks the server to drain.
    pub fn drain_asked(&self) -> impl Future<Output = ()> + use<> {
        self.engine.drain_asked()
    }

    /// Ends only when the server fails; [`abandon`](Self::abandon) is what is left to do then.
    ///
    /// # Errors
    /// Why it failed.
    pub async fn wait(&mut self) -> Result<(), Failure> {
        self.server.wait().await.map_err(Failure::internal)
    }

    /// Drains: health says NOT_SERVING, running jobs get their time and then go back to the queue, calls end, the store
    /// is closed. Once `interrupt` is over, so is the jobs' time.
    ///
    /// # Errors
    /// Why the server had failed before.
    pub async fn stop(self, interrupt: impl Future<Output = ()>) -> Result<engine::Drained, Failure> {
        self.server.set_draining().await;
        let mut drain = pin!(self.engine.drain(self.drain_bound));
        let drained = tokio::select! {
            drained = &mut drain => drained,
            () = interrupt => {
                self.engine.interrupt_running();
                drain.await
            }
        };
        let http_ended = async {
            if let Some(http) = self.http {
                http.shutdown(CALLS_BOUND).await;
            }
        };
        let (calls_ended, ()) = tokio::join!(self.server.shutdown(CALLS_BOUND), http_ended);
        close(&*self.store).await;
        calls_ended.map(|()| drained).map_err(Failure::internal)
    }

    /// Gives running jobs back at once and closes the store.
    pub async fn abandon(self) {
        give_back(&self.engine, &*self.store).await;
    }
}

/// The ports.
async fn bind(
    options: server::Options,
    config: &Config,
    engine: Engine,
) -> Result<(Server, Option<http::Server>), Failure> {
    let server = Server::bind(options, engine).await.map_err(Failure::internal)?;
    let Some(listen) = config.http.listen else { return Ok((server, None)) };
    let options = http::Options {
        listen,
        max_body_bytes: config.http.max_body_bytes,
        hosts: config.http.hosts(),
        allowed_origins: config.http.allowed_origins(),
    };
    let http = http::Server::bind(options, server.gateway()).await.map_err(Failure::internal)?;
    Ok((server, Some(http)))
}

async fn give_back(engine: &Engine, store: &Store) {
    engine.drain(Duration::ZERO).await;
    close(store).await;
}

async fn close(store: &Store) {
    if timeout(CLOSE_BOUND, store.close()).await.is_err() {
        tracing::warn!("the store does not close; nothing that was acknowledged is lost by that");
    }
}

async fn open_store(config: &config::Store) -> Result<Arc<Store>, Failure> {
    if let Some(url) = &config.url {
        let failed = |error| Failure::internal(format_args!("cannot open the store {url}: {error}"));
        return Ok(Arc::new(Postgres::open(url).await.map_err(failed)?));
    }
    let directory = config.data_dir.display();
    let failed = |error| Failure::internal(format_args!("cannot open the data directory {directory}: {error}"));
    Ok(Arc::new(Sqlite::open(&config.data_dir).map_err(failed)?))
}

/// A bound that 0 lifts.
fn bound_or_none(value: u64) -> u64 {
    if value == 0 { u64::MAX } else { value }
}

fn engine_options(config: &Config) -> engine::Options {
    engine::Options {
        workers: config.engine.worker_count(),
        queue: QueueBounds {
            max_jobs: config.engine.queue_capacity as u64,
            max_bytes: config.engine.queue_bytes,
            max_observations: config.engine.queue_observations,
            max_tenant_jobs: bound_or_none(config.engine.tenant_queue_capacity),
            max_tenant_bytes: bound_or_none(config.engine.tenant_queue_bytes),
        },
        shares: Arc::new(TenantShares {
            weights: config.engine.tenant_weights.0.clone(),
            max_running: Some(config.engine.tenant_max_running).filter(|&max| max > 0),
        }),
        uploads: engine::UploadOptions {
            bounds: engine::UploadBounds {
                max_bytes: config.upload.max_bytes,
                max_tenant_uploads: config.upload.tenant_uploads,
                max_tenant_bytes: config.upload.tenant_bytes,
            },
            abandoned_after: config.upload.abandoned_after.0,
        },
        lease: Duration::from_secs(config.engine.lease_seconds),
        max_attempts: config.engine.max_attempts,
        max_solver_bytes: config.engine.solver_bytes(),
        retention: config.store.retention.0,
        backend: config.compute.backend,
        ..engine::Options::default()
    }
}

fn server_options(config: &Config) -> server::Options {
    server::Options {
        listen: config.server.listen,
        limits: config.limits.clone(),
        max_message_bytes: config.server.max_message_bytes,
        max_inflight_bytes: config.server.max_inflight_bytes,
        max_connections: config.server.max_connections,
        auth_timeout: match config.server.auth_timeout_seconds {
            0 => None,
            seconds => Some(Duration::from_secs(seconds)),
        },
        tls: config.tls.files(),
        keys: Sources { file: config.auth.keys_file.clone(), fixed: config.auth.keys.clone() },
        rates: config.rates.options(),
        reflection: config.server.reflection,
        ..server::Options::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_start_that_is_ended_before_the_store_is_open_is_no_service() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut config = Config::default();
        config.store.data_dir = directory.path().join("data");
        config.server.listen = "127.0.0.1:0".parse().expect("an address");
        let ended = Service::start(&config, std::future::ready(())).await.expect("no failure");
        assert!(ended.is_none());
    }

    #[test]
    fn a_configuration_of_defaults_is_the_default_of_engine_and_server() {
        let config = Config::default();
        let of = |options: engine::Options| {
            let queue = (options.queue, options.shares, options.uploads, options.max_solver_bytes);
            (options.workers, queue, options.lease, options.max_attempts, options.retention, options.backend)
        };
        assert_eq!(of(engine_options(&config)), of(engine::Options::default()));
        let of = |options: server::Options| {
            let keys = options.keys.is_on();
            let connections = (options.max_connections, options.auth_timeout);
            let bounds = (options.limits, options.max_message_bytes, options.max_inflight_bytes, connections);
            (bounds, options.solve_grace, options.tls, keys, options.reflection, options.rates)
        };
        assert_eq!(of(server_options(&config)), of(server::Options::default()));
    }
}
