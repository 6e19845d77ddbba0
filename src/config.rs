//! The server's configuration: typed and checked, from defaults < file < environment < flags.
//!
//! Every key may stand in a TOML file (`[engine] workers = 4`), in the environment (`SCPSFM_ENGINE__WORKERS=4`) or,
//! for some, in a flag. An unknown key is an error: a misspelt limit must not silently be no limit.

mod retention;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::num::NonZero;
use std::path::{Path, PathBuf};

use serde::de::IntoDeserializer;
use serde::{Deserialize, Deserializer, Serialize};

pub use retention::Retention;

use crate::domain::{Backend, Limits};
use crate::store::postgres::DatabaseUrl;
use crate::telemetry::tracing::Format;
use crate::{engine, rpc};

/// Everything that the server can be told.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    pub server: Server,
    pub metrics: Metrics,
    pub store: Store,
    pub engine: Engine,
    pub compute: Compute,
    pub limits: Limits,
    pub log: Log,
    pub otlp: Otlp,
}

/// The gRPC port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Server {
    /// Address and port to listen on; port 0 takes a free one.
    #[serde(deserialize_with = "address")]
    pub listen: SocketAddr,
    /// Largest message taken or sent.
    pub max_message_bytes: usize,
}

impl Default for Server {
    fn default() -> Self {
        Self {
            // Loopback: whoever opens the service to a network should have meant to. 50051 is gRPC's customary port.
            listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 50051),
            max_message_bytes: rpc::server::Options::MAX_MESSAGE_BYTES,
        }
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
    /// How long ended jobs are kept, with input, events and result: `30d`, `12h`, `90m`, `45s` or `forever`.
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
    /// Seconds without a heartbeat after which a job may be taken over.
    pub lease_seconds: u64,
    /// Seconds that running jobs get to finish once the server was told to stop; then they go back to the queue.
    pub drain_seconds: u64,
    /// Attempts at one job before it counts as poison and fails.
    pub max_attempts: u32,
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
            lease_seconds: Options::DEFAULT_LEASE.as_secs(),
            // Kubernetes kills 30 s after it asks; this leaves a third of it for the rest of the exit.
            drain_seconds: 20,
            max_attempts: Options::DEFAULT_MAX_ATTEMPTS,
        }
    }
}

impl Engine {
    /// Worker threads to start: as configured, or one a core.
    pub fn worker_count(&self) -> usize {
        match self.workers {
            0 => std::thread::available_parallelism().map_or(1, NonZero::get),
            workers => workers,
        }
    }
}

/// What the network runs on.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Compute {
    /// `flex` or `ndarray`; a job may ask for the other. Flex, because burn deprecates ndarray in its favour and it
    /// is the faster of the two.
    #[serde(deserialize_with = "word")]
    pub backend: Backend,
}

/// Log lines, on stderr.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Log {
    /// `human` or `json`. Human, because who starts the server by hand reads it; deploy/ sets json.
    #[serde(deserialize_with = "word")]
    pub format: Format,
    /// Levels by module, e.g. `info,scpsfm::engine=debug`.
    pub filter: String,
}

impl Default for Log {
    fn default() -> Self {
        // One line a state change of a job; debug would be one a store operation.
        Self { format: Format::default(), filter: "info".into() }
    }
}

/// Export of traces.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Otlp {
    /// Collector (gRPC), e.g. `http://127.0.0.1:4317`. None by default: a server sends nothing anywhere unasked.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub endpoint: Option<String>,
}

/// What is wrong with a configuration.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A source that cannot be read, an unknown key or a value of the wrong type; the message names key and source.
    #[error("configuration: {0}")]
    Source(#[from] config::ConfigError),
    /// A value of the right type that cannot work.
    #[error("configuration: {key}: {found} is wrong; right would be {right}")]
    Value { key: &'static str, found: String, right: &'static str },
    /// A variable of the environment that looks like a key and is none.
    #[error("configuration: {found} in the environment is no key; right would be {right} (two underscores)")]
    Variable { found: String, right: String },
}

/// First part of every variable of the environment that is ours.
const PREFIX: &str = "SCPSFM_";

/// Between the section and the key in a variable of the environment.
const SEPARATOR: &str = "__";

impl Config {
    /// Reads the defaults, the file (if given), the environment and the flags that were set, later ones winning.
    ///
    /// `flags` are pairs of a key (`server.listen`) and its value.
    ///
    /// # Errors
    /// See [`Error`]; each names the key and where its value came from.
    pub fn load(file: Option<&Path>, flags: &[(&str, String)]) -> Result<Self, Error> {
        Self::from_sources(file, std::env::vars().collect(), flags)
    }

    fn from_sources(
        file: Option<&Path>,
        variables: Vec<(String, String)>,
        flags: &[(&str, String)],
    ) -> Result<Self, Error> {
        let mut sources = config::Config::builder();
        if let Some(path) = file {
            sources = sources.add_source(config::File::from(path).format(config::FileFormat::Toml));
        }
        sources = sources.add_source(
            config::Environment::with_prefix(PREFIX.trim_end_matches('_'))
                .prefix_separator("_")
                .separator(SEPARATOR)
                .ignore_empty(true)
                .source(Some(keys_among(variables)?.into_iter().collect())),
        );
        for (key, value) in flags {
            sources = sources.set_override(*key, value.as_str())?;
        }
        let config: Self = sources.build()?.try_deserialize()?;
        config.validate()?;
        Ok(config)
    }

    /// The configuration as a TOML file that would give it.
    ///
    /// # Errors
    /// When a value has no form in TOML, such as a path that is not Unicode.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }

    fn validate(&self) -> Result<(), Error> {
        let at_least_one = |key: &'static str, value: u64| match value {
            0 => Err(Error::Value { key, found: "0".into(), right: "a number from 1 on" }),
            _ => Ok(()),
        };
        at_least_one("server.max_message_bytes", self.server.max_message_bytes as u64)?;
        at_least_one("engine.queue_capacity", self.engine.queue_capacity as u64)?;
        at_least_one("engine.queue_bytes", self.engine.queue_bytes)?;
        at_least_one("engine.queue_observations", self.engine.queue_observations)?;
        at_least_one("engine.lease_seconds", self.engine.lease_seconds)?;
        at_least_one("engine.max_attempts", u64::from(self.engine.max_attempts))?;
        at_least_one("limits.max_views", self.limits.max_views as u64)?;
        at_least_one("limits.max_tracks", self.limits.max_tracks as u64)?;
        at_least_one("limits.max_observations", self.limits.max_observations as u64)?;
        for (key, value) in [
            ("limits.max_views", self.limits.max_views),
            ("limits.max_tracks", self.limits.max_tracks),
            ("limits.max_observations", self.limits.max_observations),
        ] {
            // Views, tracks and observations are counted in 32 bits.
            if u32::try_from(value).is_err() {
                return Err(Error::Value { key, found: value.to_string(), right: "a number below 4294967296" });
            }
        }
        if tracing_subscriber::EnvFilter::try_new(&self.log.filter).is_err() {
            return Err(Error::Value {
                key: "log.filter",
                found: format!("`{}`", self.log.filter),
                right: "levels by module, such as `info` or `info,scpsfm::engine=debug`",
            });
        }
        match &self.otlp.endpoint {
            Some(endpoint) if !is_plain_http(endpoint) => Err(Error::Value {
                key: "otlp.endpoint",
                found: format!("`{endpoint}`"),
                right: "a collector's http:// address, such as http://127.0.0.1:4317 (TLS is not built in)",
            }),
            _ => Ok(()),
        }
    }
}

/// The variables that name a key, i.e. have a section: `SCPSFM_ENGINE__WORKERS`. Others of our prefix, such as those
/// that switch tests, are none of ours here; but `SCPSFM_ENGINE_WORKERS` is a slip that would go unseen.
fn keys_among(variables: Vec<(String, String)>) -> Result<Vec<(String, String)>, Error> {
    const SECTIONS: [&str; 8] = ["SERVER", "METRICS", "STORE", "ENGINE", "COMPUTE", "LIMITS", "LOG", "OTLP"];
    let mut keys = Vec::new();
    for (name, value) in variables {
        let Some(rest) = name.strip_prefix(PREFIX) else { continue };
        if rest.contains(SEPARATOR) {
            keys.push((name, value));
        } else if let Some((section, key)) = rest.split_once('_').filter(|(section, _)| SECTIONS.contains(section)) {
            return Err(Error::Variable { right: format!("{PREFIX}{section}{SEPARATOR}{key}"), found: name });
        }
    }
    Ok(keys)
}

fn is_plain_http(endpoint: &str) -> bool {
    let uri: Result<axum::http::Uri, _> = endpoint.parse();
    uri.is_ok_and(|uri| uri.scheme_str() == Some("http") && uri.host().is_some())
}

fn address<'de, D: Deserializer<'de>>(deserializer: D) -> Result<SocketAddr, D::Error> {
    let text = String::deserialize(deserializer)?;
    text.parse().map_err(|_| {
        let message = format!("`{text}` is not an IP address and port, such as 127.0.0.1:50051 or [::1]:50051");
        serde::de::Error::custom(message)
    })
}

/// One word of a few; the error lists them, which the `config` crate's own does not.
fn word<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<T, D::Error> {
    String::deserialize(deserializer).and_then(|text| T::deserialize(text.into_deserializer()))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::{Config, Error, Format};
    use crate::domain::Backend;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().expect("temporary file");
        file.write_all(text.as_bytes()).expect("write");
        file
    }

    fn variables(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
        pairs.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
    }

    #[test]
    fn nothing_given_is_the_default_and_the_example_file_says_the_same() {
        assert_eq!(Config::from_sources(None, vec![], &[]).expect("defaults"), Config::default());
        let example = file(include_str!("../deploy/scpsfm.toml"));
        let read = Config::from_sources(Some(example.path()), vec![], &[]).expect("example");
        assert_eq!(read, Config::default());
        // Every key that the configuration has stands in the example.
        let keys = |text: &str| -> Vec<String> {
            let keys = text.lines().filter(|line| !line.starts_with('#')).filter_map(|line| line.split_once(" = "));
            let mut keys: Vec<String> = keys.map(|(key, _)| key.to_owned()).collect();
            keys.sort();
            keys
        };
        assert_eq!(keys(include_str!("../deploy/scpsfm.toml")), keys(&Config::default().to_toml().expect("TOML")));
    }

    #[test]
    fn later_sources_win_key_by_key() {
        let file = file("[engine]\nworkers = 1\nqueue_capacity = 2\nmax_attempts = 4\n[log]\nformat = \"json\"\n");
        let environment = variables(&[
            ("SCPSFM_ENGINE__WORKERS", "5"),
            ("SCPSFM_ENGINE__QUEUE_CAPACITY", "6"),
            ("SCPSFM_COMPUTE__BACKEND", "ndarray"),
            ("SCPSFM_OTLP__ENDPOINT", ""),
            ("SCPSFM_REQUIRE_PYTHON", "1"),
            ("PATH", "/bin"),
        ]);
        let flags = [("engine.workers", "7".to_owned()), ("server.listen", "[::1]:0".to_owned())];
        let config = Config::from_sources(Some(file.path()), environment, &flags).expect("configuration");
        assert_eq!(config.engine.max_attempts, 4, "file over default");
        assert_eq!(config.engine.queue_capacity, 6, "environment over file");
        assert_eq!(config.engine.workers, 7, "flag over environment");
        assert_eq!(config.log.format, Format::Json);
        assert_eq!(config.compute.backend, Backend::Ndarray);
        assert_eq!(config.otlp.endpoint, None, "an empty variable is none");
        assert_eq!(config.server.listen, "[::1]:0".parse().expect("address"));
        assert_eq!(config.engine.lease_seconds, Config::default().engine.lease_seconds);
    }

    #[test]
    fn a_printed_configuration_reads_back() {
        let flags = [("otlp.endpoint", "http://collector:4317".to_owned()), ("engine.workers", "3".to_owned())];
        let config = Config::from_sources(None, vec![], &flags).expect("configuration");
        let printed = file(&config.to_toml().expect("TOML"));
        assert_eq!(Config::from_sources(Some(printed.path()), vec![], &[]).expect("configuration"), config);
    }

    #[test]
    fn the_password_of_the_store_is_shown_nowhere() {
        let given = "postgres://me:hunter2@db/scpsfm";
        let config = Config::from_sources(None, variables(&[("SCPSFM_STORE__URL", given)]), &[]).expect("valid");
        assert_eq!(config.store.url.as_ref().map(|url| url.reveal()), Some(given));
        for shown in [format!("{config:?}"), config.to_toml().expect("TOML")] {
            assert!(shown.contains("me:***@db") && !shown.contains("hunter2"), "{shown}");
        }
    }

    #[test]
    fn errors_name_the_key_and_what_would_be_right() {
        let from_file = |text: &str| Config::from_sources(Some(file(text).path()), vec![], &[]);
        let from_variable = |name: &str, value: &str| Config::from_sources(None, variables(&[(name, value)]), &[]);
        let cases: [(Result<Config, Error>, &[&str]); 10] = [
            (from_file("[engine]\nwrokers = 1\n"), &["wrokers", "workers"]),
            (from_file("[engine]\nqueue_capacity = 0\n"), &["engine.queue_capacity", "from 1 on"]),
            (from_file("[server]\nlisten = \"localhost\"\n"), &["server.listen", "127.0.0.1:50051"]),
            (from_file("[compute]\nbackend = \"cuda\"\n"), &["compute.backend", "flex", "ndarray"]),
            (from_file("[log]\nfilter = \"scpsfm=loud\"\n"), &["log.filter", "`info`"]),
            (from_variable("SCPSFM_STORE__URL", "mysql://me:hunter2@host/db"), &["store.url", "postgres://USER"]),
            (from_variable("SCPSFM_ENGINE__WORKERS", "many"), &["engine.workers", "many", "environment"]),
            (from_variable("SCPSFM_ENGINE_WORKERS", "4"), &["SCPSFM_ENGINE_WORKERS", "SCPSFM_ENGINE__WORKERS"]),
            (from_variable("SCPSFM_OTLP__ENDPOINT", "https://x:4317"), &["otlp.endpoint", "http://127.0.0.1:4317"]),
            (Config::from_sources(Some("no/such/file".as_ref()), vec![], &[]), &["no/such/file"]),
        ];
        for (result, parts) in cases {
            let message = result.expect_err(parts[0]).to_string();
            for part in parts {
                assert!(message.contains(part), "`{message}` does not say `{part}`");
            }
            assert!(!message.contains("hunter2"), "{message}");
        }
    }
}
