//! `scpsfm serve`: the server.

use std::path::PathBuf;

use clap::ValueEnum;
use tokio_util::sync::CancellationToken;

use super::args::parse_whole;
use super::exit::{Exit, Failure};
use super::interrupt::Signals;
use super::service::Service;
use super::settings_args::BackendArg;
use super::{print, prior_file};
use crate::config::Config;
use crate::engine::StoreState;
use crate::telemetry;

const HELP: &str = "\
Configuration: defaults, then the file, then the environment, then flags; later ones win. Every key of the file \
may stand in the environment as SCPSFM_<SECTION>__<KEY>, such as SCPSFM_ENGINE__WORKERS=4. --print-config shows all \
keys that have a value.

When it serves, lines on stdout say where: `grpc http://...` (or https), `metrics http://...` and `http http://...` (JSON; \
/openapi.json describes it). SIGTERM, Ctrl-C or `scpsfm admin drain` drains: \
new jobs are refused, running ones get engine.drain_seconds to finish and then go back to the queue for the next start; \
a second signal gives them back now. That is a clean end (0); a third ends at once (130), and jobs that still run lose an \
attempt, of which they have engine.max_attempts.

Without TLS and keys it listens on loopback only. A key is 32 or more random characters (`openssl rand -hex 32`) and \
stands for a tenant; the file of keys has lines TENANT:KEY or TENANT:sha256:HEX. With TENANT:read-only:KEY the key \
allows calls that change nothing, with TENANT:admin:KEY also the administration, over all tenants. Certificates and \
keys are read again when their files change, within a few seconds; connections that are open stay open.

Examples:
  scpsfm serve
  scpsfm serve --data-dir /var/lib/scpsfm --workers 4 --log-format json
  scpsfm serve --listen 0.0.0.0:50051 --tls-certificate server.pem --tls-key server.key --keys-file keys.txt
  scpsfm serve --store postgres://scpsfm@db.example/scpsfm    # several servers, one store
  scpsfm serve --print-config > scpsfm.toml";

/// Run the server
///
/// Takes jobs over gRPC (scpsfm.v1) and as JSON over HTTP, keeps them in a data directory or a shared database and solves them on worker
/// threads. A restart knows every job and takes up those that were queued or running.
#[derive(Debug, clap::Args)]
#[command(after_help = HELP)]
pub struct Args {
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,

    /// Address of the gRPC port; port 0 takes a free one [default: 127.0.0.1:50051]
    #[arg(long, value_name = "ADDRESS")]
    pub listen: Option<String>,

    /// Address of the port for JSON over HTTP; `off`: none [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDRESS")]
    pub http_listen: Option<String>,

    /// Address of /metrics, /healthz and /readyz; always open, port 0 takes a free one [default: 127.0.0.1:9464]
    #[arg(long, value_name = "ADDRESS")]
    pub metrics_listen: Option<String>,

    /// Directory of the embedded store; created [default: scpsfm-data]
    #[arg(long, value_name = "DIR")]
    pub data_dir: Option<PathBuf>,

    /// PostgreSQL database instead, which several servers may share: postgres://USER:PASSWORD@HOST:PORT/DATABASE.
    /// Other users of the machine see flags; they do not see SCPSFM_STORE__URL
    #[arg(long, value_name = "URL", conflicts_with = "data_dir")]
    pub store: Option<GivenUrl>,

    /// Worker threads, one job each; 0: one a core [default: 0]
    #[arg(long, value_name = "N", value_parser = parse_whole::<usize>)]
    pub workers: Option<usize>,

    /// Threads that one job may keep busy, its worker's among them; 0: one a core. The result is the same. Worth more
    /// than one where fewer long sequences wait than there are cores [default: 1]
    #[arg(long, value_name = "N", value_parser = parse_whole::<usize>)]
    pub threads: Option<usize>,

    /// Waiting jobs at which new ones are refused [default: 256]
    #[arg(long, value_name = "N", value_parser = parse_whole::<usize>)]
    pub queue: Option<usize>,

    /// Tensor backend of jobs that ask for none [default: flex]
    #[arg(long, value_enum)]
    pub backend: Option<BackendArg>,

    /// Trained network of jobs' searches, written by `scpsfm train-prior` [default: the one that the program carries]
    #[arg(long, value_name = "FILE")]
    pub prior: Option<PathBuf>,

    /// How log lines are written, on stderr [default: human]
    #[arg(long, value_enum)]
    pub log_format: Option<LogFormat>,

    /// Certificate of the gRPC port, followed by those that lead to its authority (PEM): connections are encrypted
    #[arg(long, value_name = "FILE")]
    pub tls_certificate: Option<PathBuf>,

    /// Private key of the certificate (PEM)
    #[arg(long, value_name = "FILE")]
    pub tls_key: Option<PathBuf>,

    /// Take only clients with a certificate that one of these authorities has signed (PEM)
    #[arg(long, value_name = "FILE")]
    pub tls_client_ca: Option<PathBuf>,

    /// API keys, one of which every call must carry; its tenant sees its own jobs only. Other keys may stand in
    /// SCPSFM_AUTH__KEYS
    #[arg(long, value_name = "FILE")]
    pub keys_file: Option<PathBuf>,

    /// Listen on other addresses than loopback's with neither TLS nor keys: whoever reaches the port reads and cancels
    /// every job
    #[arg(long)]
    pub insecure: bool,

    /// Take API keys without TLS on other addresses than loopback's: whoever listens in has them. For a proxy that ends
    /// TLS
    #[arg(long)]
    pub plaintext_keys: bool,

    /// Print the configuration that would be used, as TOML, and exit. A password in store.url and auth.keys are left
    /// out, which the file says
    #[arg(long)]
    pub print_config: bool,
}

/// An address as it was given, password included. Checked with the rest of the configuration, whose errors do not
/// repeat it, as those of the command line would.
#[derive(Clone)]
pub struct GivenUrl(String);

impl From<&str> for GivenUrl {
    fn from(text: &str) -> Self {
        Self(text.to_owned())
    }
}

impl std::fmt::Debug for GivenUrl {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("GivenUrl(***)")
    }
}

/// How log lines are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For eyes
    Human,
    /// One JSON object a line
    Json,
}

impl Args {
    /// The flags that were given, as the configuration's keys.
    fn overrides(&self) -> Vec<(&'static str, String)> {
        let word = |value: Option<clap::builder::PossibleValue>| value.map(|value| value.get_name().to_owned());
        let path = |path: &Option<PathBuf>| path.as_ref().map(|path| path.display().to_string());
        let switch = |on: bool| on.then(|| "true".to_owned());
        let given = [
            ("server.listen", self.listen.clone()),
            ("server.insecure", switch(self.insecure)),
            ("server.plaintext_keys", switch(self.plaintext_keys)),
            ("tls.certificate", path(&self.tls_certificate)),
            ("tls.key", path(&self.tls_key)),
            ("tls.client_ca", path(&self.tls_client_ca)),
            ("auth.keys_file", path(&self.keys_file)),
            ("http.listen", self.http_listen.clone()),
            ("metrics.listen", self.metrics_listen.clone()),
            ("store.data_dir", path(&self.data_dir)),
            ("store.url", self.store.as_ref().map(|url| url.0.clone())),
            ("engine.workers", self.workers.map(|count| count.to_string())),
            ("engine.queue_capacity", self.queue.map(|count| count.to_string())),
            ("compute.threads", self.threads.map(|count| count.to_string())),
            ("compute.backend", word(self.backend.and_then(|backend| backend.to_possible_value()))),
            ("compute.prior", path(&self.prior)),
            ("log.format", word(self.log_format.and_then(|format| format.to_possible_value()))),
        ];
        given.into_iter().filter_map(|(key, value)| Some((key, value?))).collect()
    }
}

/// Runs the command: until a signal asks it to drain, or the server fails.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let config = Config::load(args.config.as_deref(), &args.overrides()).map_err(Failure::bad_config)?;
    if args.print_config {
        let text = config.to_toml().map_err(Failure::bad_config)?;
        print(text.trim_end())?;
        return Ok(Exit::Done);
    }
    let collector = config.otlp.endpoint.as_ref().map(|endpoint| telemetry::otlp::Options {
        endpoint: endpoint.reveal(),
        service_name: "scpsfm",
        metrics_interval: config.otlp.metrics_interval(),
    });
    // Held to the end: it sends the last traces and metrics when dropped, inside the runtime.
    let export = collector.map(telemetry::otlp::Export::begin).transpose().map_err(Failure::bad_config)?;
    telemetry::tracing::init(telemetry::tracing::Options {
        format: config.log.format,
        filter: &config.log.filter,
        access: config.log.access,
        export: export.as_ref(),
    })
    .map_err(Failure::bad_config)?;
    if let Some(path) = &config.compute.prior {
        prior_file::install(path).map_err(|error| Failure::bad_config(format_args!("compute.prior: {error}")))?;
    }
    raise_file_limit();
    let mut signals = Signals::listen()?;
    let meter = export.as_ref().and_then(telemetry::otlp::Export::meter);
    let scrape = telemetry::metrics::install(meter).map_err(Failure::internal)?;
    let backend = if config.compute.backend == crate::domain::Backend::Flex { "flex" } else { "ndarray" };
    telemetry::metrics::build_info(backend);
    let ready = telemetry::Readiness::default();
    let metrics = telemetry::server::bind(telemetry::server::Options {
        listen: config.metrics.listen,
        scrape,
        ready: ready.clone(),
        silence: telemetry::server::Options::SILENCE,
    })
    .await
    .map_err(|error| {
        Failure::internal(format_args!("cannot listen on {} (metrics): {error}", config.metrics.listen))
    })?;
    let Some(mut service) = Service::start(&config, signals.next()).await? else {
        tracing::info!("ended before it had started");
        return Ok(Exit::Done);
    };
    follow_store(&ready, service.store_state());
    ready.set(true);
    let scheme = if config.tls.files().is_some() { "https" } else { "http" };
    let (store_kind, store) = match &config.store.url {
        Some(url) => ("postgres", url.to_string()),
        None => ("sqlite", config.store.data_dir.display().to_string()),
    };
    let certificate = config.tls.files().and_then(|files| files.certificate());
    tracing::info!(
        version = env!("CARGO_PKG_VERSION"),
        store_kind,
        store,
        grpc = %service.address(),
        scheme,
        http = service.http_address().map(|address| address.to_string()),
        metrics = %metrics.address(),
        recovered_jobs = service.recovered_jobs(),
        queued_jobs = service.queued_jobs().await,
        max_solver_bytes = config.engine.solver_bytes(),
        keys = service.key_count(),
        certificate_end = certificate.map(|certificate| prost_types::Timestamp::from(certificate.end).to_string()),
        "serving"
    );
    print(&format!("grpc {scheme}://{}", service.address()))?;
    print(&format!("metrics http://{}/metrics", metrics.address()))?;
    if let Some(address) = service.http_address() {
        print(&format!("http {scheme}://{address}"))?;
    }
    let drain_asked = service.drain_asked();
    let failed = tokio::select! {
        ended = service.wait() => {
            Some(ended.err().unwrap_or_else(|| Failure::internal("the gRPC server ended without being asked to")))
        }
        () = signals.next() => None,
        () = drain_asked => {
            tracing::info!("a caller asked this server to drain");
            None
        }
    };
    ready.set(false);
    if let Some(failure) = failed {
        // Nobody can be served: what runs goes back to the queue at once.
        let impatience = async {
            // One that was on its way, and another request.
            signals.next().await;
            signals.again().await;
        };
        tokio::select! {
            () = service.abandon() => {}
            () = impatience => tracing::warn!("ended before jobs were given back: they begin again at the next start"),
        }
        return Err(failure);
    }
    tracing::info!(
        bound_seconds = config.engine.drain_seconds,
        "draining; a second signal gives running jobs back now"
    );
    let interrupt = CancellationToken::new();
    let impatience = async {
        signals.again().await;
        tracing::info!("running jobs go back to the queue; a third signal ends at once");
        interrupt.cancel();
        signals.again().await;
    };
    let drained = tokio::select! {
        drained = service.stop(interrupt.cancelled()) => drained?,
        () = impatience => {
            return Err(Failure::interrupted_with("ended before the drain did: jobs that still ran begin again at the next start"));
        }
    };
    tracing::info!(finished = drained.finished, given_back = drained.given_back, "drained");
    metrics.shutdown().await;
    Ok(Exit::Done)
}

/// Lets the process have as many files as it may: every connection is one, and shells start programs with a thousand.
fn raise_file_limit() {
    #[cfg(unix)]
    {
        use rustix::process::{Resource, getrlimit, setrlimit};
        let limit = getrlimit(Resource::Nofile);
        // Where it is refused, the old limit stands: fewer connections at a time.
        let _ = setrlimit(Resource::Nofile, rustix::process::Rlimit { current: limit.maximum, ..limit });
    }
}

/// Keeps readiness true to the store, as long as the service lives.
fn follow_store(ready: &telemetry::Readiness, mut store: tokio::sync::watch::Receiver<StoreState>) {
    let ready = ready.clone();
    tokio::spawn(async move {
        loop {
            let state = *store.borrow_and_update();
            ready.set_store(state == StoreState::Unavailable, state == StoreState::Full);
            if store.changed().await.is_err() {
                return;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::{Cli, Command};

    fn overrides(flags: &[&str]) -> Vec<(&'static str, String)> {
        let line = ["scpsfm", "serve"].iter().chain(flags);
        match Cli::try_parse_from(line).expect("valid flags").command {
            Command::Serve(args) => args.overrides(),
            other => panic!("parsed as {other:?}"),
        }
    }

    #[test]
    fn a_shared_store_is_an_address_and_excludes_the_directory() {
        let address = "postgres://me:hunter2@db/scpsfm";
        assert_eq!(overrides(&["--store", address]), [("store.url", address.to_owned())]);
        let both = ["scpsfm", "serve", "--store", address, "--data-dir", "d"];
        let error = Cli::try_parse_from(both).expect_err("refused").to_string();
        assert!(error.contains("--data-dir") && !error.contains("hunter2"), "{error}");
        let wrong = overrides(&["--store", "mysql://me:hunter2@db/scpsfm"]);
        let error = Config::load(None, &wrong).expect_err("refused").to_string();
        assert!(error.contains("store.url") && !error.contains("hunter2"), "{error}");
    }

    #[test]
    fn flags_become_keys_that_the_configuration_knows() {
        assert_eq!(overrides(&[]), []);
        let all = overrides(&[
            "--listen",
            "127.0.0.1:0",
            "--metrics-listen",
            "127.0.0.1:1",
            "--data-dir",
            "d",
            "--workers",
            "3",
            "--queue",
            "9",
            "--threads",
            "2",
            "--backend",
            "ndarray",
            "--prior",
            "my.prior",
            "--log-format",
            "json",
            "--tls-certificate",
            "c.pem",
            "--tls-key",
            "k.pem",
            "--tls-client-ca",
            "a.pem",
            "--keys-file",
            "keys",
            "--insecure",
            "--plaintext-keys",
        ]);
        assert_eq!(all.len(), 15);
        let config = Config::load(None, &all).expect("valid");
        assert_eq!(config.engine.workers, 3);
        assert_eq!(config.engine.queue_capacity, 9);
        assert_eq!(config.store.data_dir, PathBuf::from("d"));
        assert_eq!(config.compute.threads, 2);
        assert_eq!(config.compute.backend, crate::domain::Backend::Ndarray);
        assert_eq!(config.compute.prior, Some("my.prior".into()));
        assert_eq!(config.tls.files().expect("TLS").paths().len(), 3);
        assert_eq!(config.auth.keys_file, Some(PathBuf::from("keys")));
        assert!(config.server.insecure && config.server.plaintext_keys);
        assert_eq!(config.log.format, telemetry::tracing::Format::Json);
    }
}
