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

/// Counters or gauges of one metric, by labels.
type Series = Registry<Key, AtomicStorage>;

/// The series by metric.
type AllSeries = HashMap<&'static str, Arc<Series>>;

/// Records what a meter exports.
pub(super) struct OtlpRecorder {
    series: AllSeries,
    histograms: HashMap<&'static str, opentelemetry::metrics::Histogram<f64>>,
}

impl OtlpRecorder {
    /// A recorder of the metrics of the catalogue, with its help texts and buckets.
    pub(super) fn new(meter: &Meter) -> Self {
        let (mut series, mut histograms) = (AllSeries::new(), HashMap::new());
        for metric in ALL {
            match metric.kind {
                Kind::Counter => {
                    let callback = counter_callback(metric, &mut series);
                    let counter = meter.u64_observable_counter(metric.name).with_description(metric.help);
                    counter.with_callback(callback).build();
                }
                Kind::Gauge => {
                    let callback = gauge_callback(metric, &mut series);
                    let gauge = meter.f64_observable_gauge(metric.name).with_description(metric.help);
                    gauge.with_callback(callback).build();
                }
                Kind::Histogram(buckets) => {
                    let histogram = meter.f64_histogram(metric.name).with_description(metric.help);
                    histograms.insert(metric.name, histogram.with_boundaries(buckets.to_vec()).build());
                }
            }
        }
        Self { series, histograms }
    }
}

/// The series of a metric that is recorded.
fn recorded(metric: &Metric, series: &mut AllSeries) -> Arc<Series> {
    series.entry(metric.name).or_insert_with(|| Arc::new(Series::atomic())).clone()
}

/// What an export reads of an instrument.
type Callback<T> = Box<dyn Fn(&dyn AsyncInstrument<T>) + Send + Sync>;

fn counter_callback(metric: &Metric, series: &mut AllSeries) -> Callback<u64> {
    if let Some(of) = process::reading(metric) {
        return Box::new(move |observer| observe_process(of, |value| observer.observe(value, &[])));
    }
    let series = recorded(metric, series);
    Box::new(move |observer| {
        series.visit_counters(|key, value| observer.observe(value.load(Ordering::Acquire), &attributes(key)));
    })
}

fn gauge_callback(metric: &Metric, series: &mut AllSeries) -> Callback<f64> {
    if metric.name == TENANT_JOBS.name {
        return Box::new(|observer| {
            tenants::for_each(|labels, jobs| {
                observer.observe(jobs as f64, &labels.map(|(name, value)| KeyValue::new(name, value.to_owned())));
            });
        });
    }
    if let Some(of) = process::reading(metric) {
        return Box::new(move |observer| observe_process(of, |value| observer.observe(value as f64, &[])));
    }
    let series = recorded(metric, series);
    Box::new(move |observer| {
        series.visit_gauges(|key, value| {
            observer.observe(f64::from_bits(value.load(Ordering::Acquire)), &attributes(key));
        });
    })
}

fn observe_process(of: fn(process::Usage) -> u64, observe: impl FnOnce(u64)) {
    if let Some(usage) = process::Usage::latest() {
        observe(of(usage));
    }
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
        match self.series.get(key.name()) {
            Some(series) => series.get_or_create_counter(key, |counter| Counter::from_arc(counter.clone())),
            // Read where it is, as what the process takes; or not in the catalogue: another library's.
            None => Counter::noop(),
        }
    }

    fn register_gauge(&self, key: &Key, _: &Metadata<'_>) -> Gauge {
        match self.series.get(key.name()) {
            Some(series) => series.get_or_create_gauge(key, |gauge| Gauge::from_arc(gauge.clone())),
            None => Gauge::noop(),
        }
    }

    fn register_histogram(&self, key: &Key, _: &Metadata<'_>) -> Histogram {
        match self.histograms.get(key.name()) {
            Some(histogram) => Histogram::from_arc(Arc::new(HistogramSeries {
                histogram: histogram.clone(),
                attributes: attributes(key),
            })),
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
