//! Export over OTLP.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Endpoint, Error};

/// Export of traces and metrics.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Otlp {
    /// Collector (gRPC), e.g. `http://127.0.0.1:4317`, or `https://`, trusted by the system's authorities. None by
    /// default: a server sends nothing anywhere unasked. A shown configuration hides its password.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub endpoint: Option<Endpoint>,
    /// Whether metrics are exported too, those of `/metrics`. Off, because a collector that takes traces alone would
    /// answer each export with an error.
    pub metrics: bool,
    /// Seconds between two exports of the metrics; at least 1.
    pub metrics_interval_seconds: u64,
}

impl Default for Otlp {
    fn default() -> Self {
        // A minute is the default of OpenTelemetry, and of the scrapes of Prometheus.
        Self { endpoint: None, metrics: false, metrics_interval_seconds: 60 }
    }
}

impl Otlp {
    /// Time between two exports of the metrics; `None` where they are not exported.
    pub fn metrics_interval(&self) -> Option<Duration> {
        self.metrics.then(|| Duration::from_secs(self.metrics_interval_seconds))
    }

    pub(super) fn validate(&self) -> Result<(), Error> {
        match self.metrics && self.endpoint.is_none() {
            true => Err(Error::Value {
                key: "otlp.metrics",
                found: "true without otlp.endpoint".into(),
                right: "a collector in otlp.endpoint, such as http://127.0.0.1:4317, or otlp.metrics = false",
            }),
            false => Ok(()),
        }
    }
}
