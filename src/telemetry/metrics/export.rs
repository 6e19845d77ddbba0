//! The recorder of the OTLP export.
//!
//! Counters and gauges are numbers that each export reads, as a scrape reads those of the page. Instruments of the SDK
//! that take each new value would export a wrong gauge where two threads change it at once and the older value comes
//! last. Histograms are instruments of the SDK, which has no others.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use metrics::{Counter, Gauge, Histogram, HistogramFn, Key, KeyName, Metadata, Recorder, SharedString, Unit};
use metrics_util::registry::{AtomicStorage, Registry};
use opentelemetry::KeyValue;
use opentelemetry::metrics::{AsyncInstrument, Meter};

use super::catalogue::{ALL, Kind, Metric, TENANT_JOBS};
use super::{process, tenants};

/// Counters and gauges, by name and labels.
type Series = Registry<Key, AtomicStorage>;

/// Records what a meter exports.
pub(super) struct OtlpRecorder {
    series: Arc<Series>,
    histograms: HashMap<&'static str, opentelemetry::metrics::Histogram<f64>>,
}

impl OtlpRecorder {
    /// A recorder of the metrics of the catalogue, with its help texts and buckets.
    pub(super) fn new(meter: &Meter) -> Self {
        let series = Arc::new(Series::atomic());
        let mut histograms = HashMap::new();
        for metric in ALL {
            let series = series.clone();
            match metric.kind {
                Kind::Counter => drop(
                    meter
                        .u64_observable_counter(metric.name)
                        .with_description(metric.help)
                        .with_callback(move |observer| observe_counter(metric, &series, observer))
                        .build(),
                ),
                Kind::Gauge => drop(
                    meter
                        .f64_observable_gauge(metric.name)
                        .with_description(metric.help)
                        .with_callback(move |observer| observe_gauge(metric, &series, observer))
                        .build(),
                ),
                Kind::Histogram(buckets) => {
                    let histogram = meter.f64_histogram(metric.name).with_description(metric.help);
                    histograms.insert(metric.name, histogram.with_boundaries(buckets.to_vec()).build());
                }
            }
        }
        Self { series, histograms }
    }
}

fn observe_counter(metric: &Metric, series: &Series, observer: &dyn AsyncInstrument<u64>) {
    if let Some(value) = process::value(metric) {
        return observer.observe(value, &[]);
    }
    series.visit_counters(|key, value| {
        if key.name() == metric.name {
            observer.observe(value.load(Ordering::Acquire), &attributes(key));
        }
    });
}

fn observe_gauge(metric: &Metric, series: &Series, observer: &dyn AsyncInstrument<f64>) {
    if metric.name == TENANT_JOBS.name {
        return tenants::for_each(|labels, jobs| {
            observer.observe(jobs as f64, &labels.map(|(name, value)| KeyValue::new(name, value.to_owned())));
        });
    }
    if let Some(value) = process::value(metric) {
        return observer.observe(value as f64, &[]);
    }
    series.visit_gauges(|key, value| {
        if key.name() == metric.name {
            observer.observe(f64::from_bits(value.load(Ordering::Acquire)), &attributes(key));
        }
    });
}

fn attributes(key: &Key) -> Vec<KeyValue> {
    key.labels().map(|label| KeyValue::new(label.key().to_owned(), label.value().to_owned())).collect()
}

impl Recorder for OtlpRecorder {
    // The instruments have the help texts already.
    fn describe_counter(&self, _: KeyName, _: Option<Unit>, _: SharedString) {}

    fn describe_gauge(&self, _: KeyName, _: Option<Unit>, _: SharedString) {}

    fn describe_histogram(&self, _: KeyName, _: Option<Unit>, _: SharedString) {}

    fn register_counter(&self, key: &Key, _: &Metadata<'_>) -> Counter {
        self.series.get_or_create_counter(key, |counter| Counter::from_arc(counter.clone()))
    }

    fn register_gauge(&self, key: &Key, _: &Metadata<'_>) -> Gauge {
        self.series.get_or_create_gauge(key, |gauge| Gauge::from_arc(gauge.clone()))
    }

    fn register_histogram(&self, key: &Key, _: &Metadata<'_>) -> Histogram {
        match self.histograms.get(key.name()) {
            Some(histogram) => Histogram::from_arc(Arc::new(HistogramSeries {
                histogram: histogram.clone(),
                attributes: attributes(key),
            })),
            // Not in the catalogue: another library's.
            None => Histogram::noop(),
        }
    }
}

/// One series of a histogram.
struct HistogramSeries {
    histogram: opentelemetry::metrics::Histogram<f64>,
    attributes: Vec<KeyValue>,
}

impl HistogramFn for HistogramSeries {
    fn record(&self, value: f64) {
        self.histogram.record(value, &self.attributes);
    }
}

#[cfg(test)]
mod tests;
