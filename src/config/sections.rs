//! The sections of the configuration, one type each, with every default and its reason; the longer ones have files of
//! their own.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::num::NonZeroU32;
use std::path::PathBuf;

use serde::de::IntoDeserializer;
use serde::{Deserialize, Deserializer, Serialize};

use super::weights::TenantWeights;
use super::{Error, Retention};
use crate::domain::Backend;
use crate::parallel::Threads;
use crate::rpc::keys::KeyRing;
use crate::store::postgres::DatabaseUrl;
use crate::telemetry::tracing::Format;
use crate::{engine, rpc};

/// The gRPC port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Server {
    /// Address and port to listen on; port 0 takes a free one.
    #[serde(deserialize_with = "address")]
    pub listen: SocketAddr,
    /// Largest message taken; at least [`Server::LEAST_MESSAGE_BYTES`].
    pub max_message_bytes: usize,
    /// Bytes that calls hold together at most, messages and inputs on their way in and results on their way out; a call
    /// that would hold more is refused. At least [`Server::max_message_bytes`]; a call that needs more than all of it
    /// is served while no other holds any.
    pub max_inflight_bytes: u64,
    /// Connections that speak at once; one more is refused. Those that say nothing yet are bounded apart.
    pub max_connections: usize,
    /// Seconds that a connection may take to its first call with a key, or to its first call where none is asked for;
    /// then it is closed. Health checks need no key and do not count where others do. 0: for ever.
    pub auth_timeout_seconds: u64,
    /// Whether callers may ask for the API's description (reflection). On, because it says what `proto/` says; with
    /// keys it asks for one, as every call but a health check does.
    pub reflection: bool,
    /// Listen on other addresses than loopback's with neither TLS nor keys: whoever reaches the port reads and cancels
    /// every job.
    pub insecure: bool,
    /// Take keys without TLS on other addresses than loopback's: whoever listens in has them. For a proxy that ends
    /// TLS.
    pub plaintext_keys: bool,
}

impl Server {
    /// Least that [`Server::max_message_bytes`] may be: uploads come in chunks of up to 1 MiB, as callers are told.
    pub const LEAST_MESSAGE_BYTES: usize = rpc::inputs::MAX_MESSAGE_BYTES;
}

impl Default for Server {
    fn default() -> Self {
        Self {
            // Loopback: whoever opens the service to a network should have meant to. 50051 is gRPC's customary port.
            listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 50051),
            max_message_bytes: rpc::server::Options::MAX_MESSAGE_BYTES,
            max_inflight_bytes: rpc::server::Options::MAX_INFLIGHT_BYTES,
            max_connections: rpc::listener::MAX_ESTABLISHED,
            auth_timeout_seconds: rpc::listener::AUTH_TIMEOUT.as_secs(),
            reflection: true,
            insecure: false,
            plaintext_keys: false,
        }
    }
}

/// Certificates of the gRPC and HTTP ports, PEM files that are read again when they change. None by default: there is no
/// certificate that would be right everywhere.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Tls {
    /// The server's certificate, followed by those that lead to its authority.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub certificate: Option<PathBuf>,
    /// Its private key.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub key: Option<PathBuf>,
    /// Certificates of authorities one of which must have signed a client's certificate (mTLS); without it, clients
    /// need none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub client_ca: Option<PathBuf>,
}

impl Tls {
    /// The files, where TLS is asked for.
    pub fn files(&self) -> Option<rpc::tls::Files> {
        let (certificate, key) = self.certificate.clone().zip(self.key.clone())?;
        Some(rpc::tls::Files { certificate, key, client_ca: self.client_ca.clone() })
    }

    pub(super) fn validate(&self) -> Result<(), Error> {
        let half = |key, missing| Err(Error::Half { key, missing });
        match (&self.certificate, &self.key, &self.client_ca) {
            (Some(_), None, _) => half("tls.certificate", "tls.key"),
            (None, Some(_), _) => half("tls.key", "tls.certificate"),
            (None, None, Some(_)) => half("tls.client_ca", "tls.certificate"),
            _ => Ok(()),
        }
    }
}

/// Who may call. Without any key, every caller is of the tenant `default`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Auth {
    /// File of keys, read again when it changes: lines `TENANT:[SCOPE:]KEY` or `TENANT:[SCOPE:]sha256:HEX`, `#` begins
    /// a comment.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keys_file: Option<PathBuf>,
    /// More keys, in the same form, separated by commas or lines; for the environment. Only their hashes are kept, and
    /// they are shown nowhere.
    #[serde(skip_serializing)]
    pub keys: Option<KeyRing>,
}

impl Auth {
    /// Whether callers need a key.
    pub fn is_on(&self) -> bool {
        self.keys_file.is_some() || self.keys.is_some()
    }
}

/// How often a key may call and a tenant create jobs, on each server. Off by default: any figure would be too low for
/// somebody, as clients that create small jobs one by one call a thousand times a second, and the bounds of the queue
/// and of memory hold without it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rates {
    /// Calls a second of a key; without keys of all callers together. 0: any. Health checks do not count.
    pub calls_per_second: u32,
    /// Calls at once after a pause; at least [`Rates::LEAST_CALLS_BURST`].
    pub calls_burst: u32,
    /// Jobs a second that a tenant creates; a batch counts its jobs. 0: any.
    pub jobs_per_second: u32,
    /// Jobs at once after a pause; at least a batch, [`Rates::LEAST_JOBS_BURST`].
    pub jobs_burst: u32,
}

impl Rates {
    /// Least that [`Rates::calls_burst`] may be: an upload over HTTP is two calls, and would never pass.
    pub const LEAST_CALLS_BURST: u32 = 2;

    /// Least that [`Rates::jobs_burst`] may be: a batch is taken whole, or would never be.
    pub const LEAST_JOBS_BURST: u32 = rpc::jobs::MAX_BATCH as u32;

    /// The rates that are on.
    pub fn options(self) -> rpc::rates::Options {
        let rate = |per_second, burst| {
            let (per_second, burst) = (NonZeroU32::new(per_second)?, NonZeroU32::new(burst)?);
            Some(rpc::rates::Rate { per_second, burst })
        };
        rpc::rates::Options {
            calls: rate(self.calls_per_second, self.calls_burst),
            jobs: rate(self.jobs_per_second, self.jobs_burst),
        }
    }
}

impl Default for Rates {
    fn default() -> Self {
        // A burst of calls is what a program with a hundred threads begins with.
        Self { calls_per_second: 0, calls_burst: 100, jobs_per_second: 0, jobs_burst: Self::LEAST_JOBS_BURST }
    }
}

/// The scrape port: `/metrics`, `/healthz`, `/readyz`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Metrics {
    /// Address and port to listen on; port 0 takes a free one.
    #[serde(deserialize_with = "address")]
    pub listen: SocketAddr,
}

impl Default for Metrics {
    fn default() -> Self {
        // Loopback for the same reason as the gRPC port; 9464 is the customary port of such an exporter.
        Self { listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 9464) }
    }
}

/// Where jobs are kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Store {
    /// Folder of the embedded database; made if it does not exist. Not used with a `url`.
    pub data_dir: PathBuf,
    /// How long ended jobs are kept, with input, events and result: `30d`, `12h`, `90m`, `45s` (1000 years at
    /// most) or `forever`.
    pub retention: Retention,
    /// PostgreSQL database that several servers may share, `postgres://USER:PASSWORD@HOST:PORT/DATABASE`. None by
    /// default: one server needs no database beside it. Wherever the configuration is shown, the password is not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub url: Option<DatabaseUrl>,
}

impl Default for Store {
    fn default() -> Self {
        // Beside the process, with a name that nobody deletes by mistake.
        Self { data_dir: PathBuf::from("scpsfm-data"), retention: Retention::default(), url: None }
    }
}

/// Queue, workers and leases.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Engine {
    /// Worker threads, one job each; 0: one a core.
    pub workers: usize,
    /// Waiting jobs at which new ones are refused.
    pub queue_capacity: usize,
    /// Bytes of waiting inputs at which new jobs are refused.
    pub queue_bytes: u64,
    /// Observations of waiting inputs at which new jobs are refused.
    pub queue_observations: u64,
    /// Waiting jobs of one tenant at which its new ones are refused; 0: the queue's own bound is enough.
    pub tenant_queue_capacity: u64,
    /// Bytes of waiting inputs of one tenant at which its new jobs are refused; 0: the queue's own bound is enough.
    pub tenant_queue_bytes: u64,
    /// Jobs of one tenant that run at once at most; 0: no bound.
    pub tenant_max_running: u32,
    /// Jobs that a tenant begins for each one of a tenant of weight 1, while both have some waiting; 1 for tenants that
    /// are not named. Entries `TENANT=WEIGHT`, separated by commas.
    pub tenant_weights: TenantWeights,
    /// Seconds without a heartbeat after which a job may be taken over.
    pub lease_seconds: u64,
    /// Seconds that running jobs get to finish once the server was told to stop; then they go back to the queue.
    pub drain_seconds: u64,
    /// Attempts at one job before it counts as poison and fails.
    pub max_attempts: u32,
    /// Bytes of memory that the jobs which run at once are estimated to take together; 0: three quarters of what the
    /// machine or container has.
    pub max_solver_bytes: u64,
}

impl Default for Engine {
    /// What [`engine::Options`] has by default, with its reasons.
    fn default() -> Self {
        use engine::Options;
        Self {
            // A job is single-threaded numerics: more workers than cores only lengthen every job.
            workers: 0,
            queue_capacity: Options::DEFAULT_MAX_JOBS as usize,
            queue_bytes: Options::DEFAULT_MAX_BYTES,
            queue_observations: Options::DEFAULT_MAX_OBSERVATIONS,
            // Without API keys there is one tenant, and nobody to keep room for.
            tenant_queue_capacity: 0,
            tenant_queue_bytes: 0,
            tenant_max_running: 0,
            tenant_weights: TenantWeights::default(),
            lease_seconds: Options::DEFAULT_LEASE.as_secs(),
            // Kubernetes kills 30 s after it asks; this leaves a third of it for the rest of the exit.
            drain_seconds: 20,
            max_attempts: Options::DEFAULT_MAX_ATTEMPTS,
            max_solver_bytes: 0,
        }
    }
}

impl Engine {
    /// Threads that one server, or one job, may be asked for: more is a slip, and the system refuses them one by one.
    pub const MOST_WORKERS: usize = 1024;

    /// Bytes of memory for jobs that run at once: as configured, or a share of what there is.
    pub fn solver_bytes(&self) -> u64 {
        match self.max_solver_bytes {
            0 => engine::Options::default_solver_bytes(),
            bytes => bytes,
        }
    }

    /// Worker threads to start: as configured, or one a core.
    pub fn worker_count(&self) -> usize {
        match self.workers {
            0 => Threads::one_a_core().count(),
            workers => workers,
        }
    }
}

/// What may be uploaded, and for how long the unfinished is kept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Upload {
    /// Bytes of one upload at most.
    pub max_bytes: u64,
    /// Uploads of one tenant that may be begun and not finished.
    pub tenant_uploads: u64,
    /// Bytes of one tenant's uploads and uploaded inputs at most, as they were sent; one that was deleted counts while
    /// a job has it. The store takes about 1.3 times as much.
    pub tenant_bytes: u64,
    /// How long an upload to which nothing comes is kept: `24h`, `90m`, `45s` (1000 years at most) or `forever`.
    pub abandoned_after: Retention,
}

impl Default for Upload {
    /// What [`engine::UploadOptions`] has by default, with its reasons.
    fn default() -> Self {
        let options = engine::UploadOptions::default();
        Self {
            max_bytes: options.bounds.max_bytes,
            tenant_uploads: options.bounds.max_tenant_uploads,
            tenant_bytes: options.bounds.max_tenant_bytes,
            abandoned_after: Retention(options.abandoned_after),
        }
    }
}

/// What the networks are and run on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Compute {
    /// Threads that one job may keep busy, its worker's among them; 0: one a core. The result is the same. Of use where
    /// fewer long sequences wait than there are cores.
    pub threads: usize,
    /// `flex` or `ndarray`; a job may ask for the other. Flex, because burn deprecates ndarray in its favour and it
    /// is the faster of the two.
    #[serde(deserialize_with = "word")]
    pub backend: Backend,
    /// A network written by `scpsfm train-prior`, asked instead of the one that the program carries. Servers that share
    /// a store should ask the same.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior: Option<PathBuf>,
}

impl Default for Compute {
    fn default() -> Self {
        // Jobs side by side keep the cores busier than threads within one, and a worker a core leaves none for these.
        Self { threads: 1, backend: Backend::default(), prior: None }
    }
}

impl Compute {
    /// Threads of one job: as configured, or one a core.
    pub fn threads(&self) -> Threads {
        match self.threads {
            0 => Threads::one_a_core(),
            threads => Threads::new(threads),
        }
    }
}

/// Log lines, on stderr.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Log {
    /// `human` or `json`. Human, because who starts the server by hand reads it; deploy/ sets json.
    #[serde(deserialize_with = "word")]
    pub format: Format,
    /// Levels by module, e.g. `info,scpsfm::engine=debug`. The audit log (`scpsfm::audit`) is written whatever it says.
    pub filter: String,
    /// Whether each call is a line (`scpsfm::access`) once it has ended.
    pub access: bool,
}

impl Default for Log {
    fn default() -> Self {
        // One line a state change of a job; debug would be one a store operation. No line a call: clients that poll
        // make many for each job, refusals are told without it, and the audit log tells what changed.
        Self { format: Format::default(), filter: "info".into(), access: false }
    }
}

fn address<'de, D: Deserializer<'de>>(deserializer: D) -> Result<SocketAddr, D::Error> {
    parse_address(&String::deserialize(deserializer)?)
}

pub(super) fn parse_address<E: serde::de::Error>(text: &str) -> Result<SocketAddr, E> {
    text.parse().map_err(|_| {
        let message = format!("`{text}` is not an IP address and port, such as 127.0.0.1:50051 or [::1]:50051");
        E::custom(message)
    })
}

/// One word of a few; the error lists them, which the `config` crate's own does not.
fn word<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<T, D::Error> {
    String::deserialize(deserializer).and_then(|text| T::deserialize(text.into_deserializer()))
}
