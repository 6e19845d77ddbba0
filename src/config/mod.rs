//! The server's configuration: typed and checked, from defaults < file < environment < flags.
//!
//! Every key may stand in a TOML file (`[engine] workers = 4`), in the environment (`SCPSFM_ENGINE__WORKERS=4`) or,
//! for some, in a flag. An unknown key is an error: a misspelt limit must not silently be no limit.

mod endpoint;
mod exposure;
mod file;
mod http;
mod otlp;
mod retention;
mod sections;
mod webhooks;
mod weights;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::domain::Limits;
use crate::store::postgres::DatabaseUrl;
pub use endpoint::Endpoint;
pub use http::Http;
pub use otlp::Otlp;
pub use retention::Retention;
pub use sections::{Auth, Compute, Engine, Log, Metrics, Rates, Server, Store, Tls, Upload};
pub use webhooks::Webhooks;
pub use weights::TenantWeights;

/// Everything that the server can be told.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    pub server: Server,
    pub http: Http,
    pub tls: Tls,
    pub auth: Auth,
    pub rates: Rates,
    pub metrics: Metrics,
    pub store: Store,
    pub engine: Engine,
    pub upload: Upload,
    pub compute: Compute,
    pub limits: Limits,
    pub log: Log,
    pub otlp: Otlp,
    pub webhooks: Webhooks,
}

/// What is wrong with a configuration.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A source that cannot be read, an unknown key or a value of the wrong type; the message names key and source.
    #[error("configuration: {0}")]
    Source(config::ConfigError),
    /// A file that is no TOML; without the line itself, which may hold a password.
    #[error("configuration: {}: {what}", .file.display())]
    File { file: PathBuf, what: String },
    /// A value of the right type that cannot work.
    #[error("configuration: {key}: {found} is wrong; right would be {right}")]
    Value { key: &'static str, found: String, right: &'static str },
    /// A file without the one that belongs to it.
    #[error("configuration: {key} is set, and {missing} is not: both or neither")]
    Half { key: &'static str, missing: &'static str },
    /// A port that would be open to a network without what keeps unauthenticated callers out.
    #[error("configuration: {0}")]
    Exposed(#[from] exposure::Exposed),
    /// A variable of the environment that looks like a key and is none.
    #[error("configuration: {found} in the environment is no key; right would be {right} (two underscores)")]
    Variable { found: String, right: String },
}

impl From<config::ConfigError> for Error {
    fn from(error: config::ConfigError) -> Self {
        match error {
            config::ConfigError::FileParse { uri, cause } => {
                Error::File { file: uri.unwrap_or_default().into(), what: without_quotation(&cause.to_string()) }
            }
            error => Error::Source(error),
        }
    }
}

/// What a parser says, without the lines in which it repeats the text (`2 | url = ...`).
fn without_quotation(said: &str) -> String {
    let repeats = |line: &&str| {
        line.split_once('|').is_some_and(|(margin, _)| margin.trim().chars().all(|sign| sign.is_ascii_digit()))
    };
    let kept: Vec<&str> = said.lines().filter(|line| !repeats(line)).collect();
    kept.join(": ")
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
            sources = sources.add_source(file::TomlFile::new(path));
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

    /// The configuration as a TOML file that would give it, but for its secrets: of each that is left out a comment
    /// says so, and a file in which a password is missing is refused rather than misunderstood.
    ///
    /// # Errors
    /// When a value has no form in TOML, such as a path that is not Unicode.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        let mut text = String::new();
        if self.store.url.as_ref().is_some_and(DatabaseUrl::has_password) {
            text.push_str(
                "# The password in store.url is not shown, and this file is refused without it: put it in the place of ***,\n\
                 # or the whole address into SCPSFM_STORE__URL, which wins over the file.\n\n",
            );
        }
        if self.otlp.endpoint.as_ref().is_some_and(Endpoint::has_password) {
            text.push_str(
                "# The password in otlp.endpoint is not shown, and this file is refused without it: put it in the place of\n\
                 # ***, or the whole address into SCPSFM_OTLP__ENDPOINT, which wins over the file.\n\n",
            );
        }
        if self.auth.keys.is_some() {
            text.push_str("# auth.keys are set and not shown: this file needs SCPSFM_AUTH__KEYS beside it.\n\n");
        }
        if self.webhooks.secret.is_some() {
            text.push_str(
                "# webhooks.secret is set and not shown: this file needs SCPSFM_WEBHOOKS__SECRET beside it.\n\n",
            );
        }
        text.push_str(&toml::to_string(self)?);
        Ok(text)
    }

    fn validate(&self) -> Result<(), Error> {
        let at_least_one = |key: &'static str, value: u64| match value {
            0 => Err(Error::Value { key, found: "0".into(), right: "a number from 1 on" }),
            _ => Ok(()),
        };
        if self.server.max_message_bytes < Server::LEAST_MESSAGE_BYTES {
            let found = self.server.max_message_bytes.to_string();
            return Err(Error::Value {
                key: "server.max_message_bytes",
                found,
                right: "a number from 1049600 on (a chunk of an upload)",
            });
        }
        if self.server.max_inflight_bytes < self.server.max_message_bytes as u64 {
            return Err(Error::Value {
                key: "server.max_inflight_bytes",
                found: self.server.max_inflight_bytes.to_string(),
                right: "a number from server.max_message_bytes on",
            });
        }
        at_least_one("http.max_body_bytes", self.http.max_body_bytes as u64)?;
        at_least_one("server.max_connections", self.server.max_connections as u64)?;
        at_least_one("engine.queue_capacity", self.engine.queue_capacity as u64)?;
        at_least_one("engine.queue_bytes", self.engine.queue_bytes)?;
        at_least_one("engine.queue_observations", self.engine.queue_observations)?;
        at_least_one("engine.lease_seconds", self.engine.lease_seconds)?;
        at_least_one("engine.max_attempts", u64::from(self.engine.max_attempts))?;
        at_least_one("upload.max_bytes", self.upload.max_bytes)?;
        at_least_one("upload.tenant_uploads", self.upload.tenant_uploads)?;
        at_least_one("upload.tenant_bytes", self.upload.tenant_bytes)?;
        if self.rates.calls_burst < Rates::LEAST_CALLS_BURST {
            let found = self.rates.calls_burst.to_string();
            let right = "a number from 2 on (an upload over HTTP is two calls)";
            return Err(Error::Value { key: "rates.calls_burst", found, right });
        }
        if self.rates.jobs_burst < Rates::LEAST_JOBS_BURST {
            let found = self.rates.jobs_burst.to_string();
            return Err(Error::Value { key: "rates.jobs_burst", found, right: "a number from 1000 on (a batch)" });
        }
        if self.engine.workers > Engine::MOST_WORKERS {
            let found = self.engine.workers.to_string();
            return Err(Error::Value { key: "engine.workers", found, right: "a number up to 1024" });
        }
        if self.compute.threads > Engine::MOST_WORKERS {
            let found = self.compute.threads.to_string();
            return Err(Error::Value { key: "compute.threads", found, right: "a number up to 1024" });
        }
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
        at_least_one("otlp.metrics_interval_seconds", self.otlp.metrics_interval_seconds)?;
        self.http.validate()?;
        self.tls.validate()?;
        self.otlp.validate()?;
        Ok(exposure::check(&self.server, &self.http, &self.tls, &self.auth)?)
    }
}

/// The variables that name a key, i.e. have a section: `SCPSFM_ENGINE__WORKERS`. Others of our prefix, such as those
/// that switch tests, are none of ours here; but `SCPSFM_ENGINE_WORKERS` is a slip that would go unseen.
fn keys_among(variables: Vec<(String, String)>) -> Result<Vec<(String, String)>, Error> {
    const SECTIONS: [&str; 14] = [
        "SERVER", "HTTP", "TLS", "AUTH", "RATES", "METRICS", "STORE", "ENGINE", "UPLOAD", "COMPUTE", "LIMITS", "LOG",
        "OTLP", "WEBHOOKS",
    ];
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

#[cfg(test)]
mod tests;
