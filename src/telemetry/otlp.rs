//! Export of traces and metrics over OTLP (gRPC): what both need to reach the collector, and how the export ends.

use std::thread;
use std::time::Duration;

use opentelemetry::metrics::{Meter, MeterProvider};
use opentelemetry::{Key, KeyValue};
use opentelemetry_otlp::tonic_types::transport::ClientTlsConfig;
use opentelemetry_otlp::{MetricExporter, SpanExporter, WithExportConfig, WithTonicConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::metrics::{PeriodicReader, SdkMeterProvider, Temporality};
use opentelemetry_sdk::trace::SdkTracerProvider;
use uuid::Uuid;

/// Tells the replicas of a service apart, whose series a collector would take for one another's.
const INSTANCE: Key = Key::from_static_str("service.instance.id");

/// Name of the instrumentation scope, and target of every span of ours. Only this target is exported: spans of the
/// transport would feed the exporter its own calls.
pub(super) const SCOPE: &str = "scpsfm";

/// Where to export, and what.
#[derive(Debug, Clone, Copy)]
pub struct Options<'a> {
    /// Collector (gRPC), e.g. `http://127.0.0.1:4317`, or `https://`, trusted by the system's authorities.
    pub endpoint: &'a str,
    /// `service.name` of what is exported.
    pub service_name: &'static str,
    /// Time between two exports of the metrics; `None` exports traces alone.
    pub metrics_interval: Option<Duration>,
}

/// Why the export could not begin.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("the export to otlp.endpoint: {0}")]
    Exporter(#[from] opentelemetry_otlp::ExporterBuildError),
    #[error("otlp.endpoint: export needs a tokio runtime, and none runs here")]
    NoRuntime,
}

/// The running export. Dropping it sends what is left and ends it, which may block for 5 s, the SDK's bound. Drop it
/// while the runtime, of more than one thread, still runs: the connections to the collector live there.
#[must_use = "the export ends when this is dropped"]
#[derive(Debug)]
pub struct Export {
    traces: SdkTracerProvider,
    metrics: Option<SdkMeterProvider>,
}

impl Export {
    /// Begins the export.
    ///
    /// # Errors
    /// See [`Error`]. It must be called inside a tokio runtime, which carries the export. A collector that cannot be
    /// reached is no error: the spans of a failed export are lost, metrics are in the next one, and the SDK logs it.
    pub fn begin(options: Options<'_>) -> Result<Self, Error> {
        if tokio::runtime::Handle::try_current().is_err() {
            return Err(Error::NoRuntime);
        }
        let resource = resource(options.service_name);
        let exporter = with_collector(SpanExporter::builder().with_tonic(), options.endpoint).build()?;
        let traces = SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource.clone()).build();
        let metrics = match options.metrics_interval {
            Some(interval) => {
                let exporter = with_collector(MetricExporter::builder().with_tonic(), options.endpoint)
                    .with_temporality(Temporality::Cumulative)
                    .build()?;
                let reader = PeriodicReader::builder(exporter).with_interval(interval).build();
                Some(SdkMeterProvider::builder().with_reader(reader).with_resource(resource).build())
            }
            None => None,
        };
        Ok(Self { traces, metrics })
    }

    pub(super) fn traces(&self) -> &SdkTracerProvider {
        &self.traces
    }

    /// What [`install`](super::metrics::install) takes; `None` where metrics are not exported.
    pub fn meter(&self) -> Option<Meter> {
        self.metrics.as_ref().map(|provider| provider.meter(SCOPE))
    }
}

impl Drop for Export {
    fn drop(&mut self) {
        let warn = |result: OTelSdkResult, what: &str| {
            if let Err(error) = result {
                tracing::warn!(%error, "the last {what} were not exported");
            }
        };
        // Side by side: where the collector does not answer, each waits until the SDK gives up.
        thread::scope(|scope| {
            if let Some(metrics) = self.metrics.take() {
                // Without another thread the provider is dropped, which ends it too.
                let _ = thread::Builder::new().spawn_scoped(scope, move || warn(metrics.shutdown(), "metrics"));
            }
            warn(self.traces.shutdown(), "traces");
        });
    }
}

/// What is exported, as the environment (`OTEL_RESOURCE_ATTRIBUTES`) and this build have it.
fn resource(service_name: &'static str) -> Resource {
    let builder = || {
        Resource::builder()
            .with_service_name(service_name)
            .with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")))
    };
    let given = builder().build();
    match given.get(&INSTANCE) {
        Some(_) => given,
        None => builder().with_attribute(KeyValue::new(INSTANCE, Uuid::now_v7().to_string())).build(),
    }
}

/// An exporter that sends to `endpoint`.
fn with_collector<B: WithExportConfig + WithTonicConfig>(exporter: B, endpoint: &str) -> B {
    let exporter = exporter.with_endpoint(endpoint);
    match endpoint.starts_with("https:") {
        true => exporter.with_tls_config(ClientTlsConfig::new().with_native_roots()),
        false => exporter,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(metrics_interval: Option<Duration>) -> Options<'static> {
        Options { endpoint: "http://127.0.0.1:1", service_name: "scpsfm", metrics_interval }
    }

    #[test]
    fn a_missing_runtime_is_an_error() {
        assert!(matches!(Export::begin(options(None)), Err(Error::NoRuntime)));
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn metrics_are_exported_only_where_they_are_asked_for() {
        assert!(Export::begin(options(None)).expect("traces").meter().is_none());
        assert!(Export::begin(options(Some(Duration::from_secs(60)))).expect("both").meter().is_some());
    }

    #[test]
    fn every_process_is_an_instance_of_its_own() {
        let [one, other] = [resource("scpsfm"), resource("scpsfm")].map(|resource| resource.get(&INSTANCE));
        assert!(one.is_some() && one != other, "{one:?} {other:?}");
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn the_end_without_a_collector_is_no_panic() {
        let export = Export::begin(options(Some(Duration::from_secs(3_600)))).expect("no error");
        export.meter().expect("metrics").u64_counter("count").build().add(1, &[]);
        tokio::task::spawn_blocking(move || drop(export)).await.expect("ended without a panic");
    }
}
