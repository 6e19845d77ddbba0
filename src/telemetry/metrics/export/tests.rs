//! What a collector gets is what stands on the page.

use std::time::Duration;

use opentelemetry_proto::tonic::metrics::v1::{Metric as Exported, metric};

use super::*;
use crate::domain::job::JobState;
use crate::domain::{Grade, Stage};
use crate::telemetry::collector::{Collector, samples, text};
use crate::telemetry::metrics::tests::ended;
use crate::telemetry::metrics::{
    RpcCall, build_info, busy_worker, job_created, job_finished, page, queue_depth, queue_wait, recorder,
    stage_finished, store_operation, tenant_jobs, watcher,
};
use crate::telemetry::otlp::{self, Export};
use crate::telemetry::scrape::Page;

/// Metrics that other tests, or the process itself, change between page and export.
fn changes_meanwhile(series: &str) -> bool {
    series.starts_with("process_") || series.starts_with(TENANT_JOBS.name)
}

/// A metric's kind, and its buckets.
fn kind(exported: &Exported) -> Kind {
    match exported.data.as_ref().expect("data") {
        metric::Data::Sum(_) => Kind::Counter,
        metric::Data::Gauge(_) => Kind::Gauge,
        metric::Data::Histogram(histogram) => {
            Kind::Histogram(Vec::leak(histogram.data_points[0].explicit_bounds.clone()))
        }
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collector_gets_the_series_of_the_page() {
    let (collector, address) = Collector::start().await;
    let endpoint = format!("http://{address}");
    // Longer than the test: all is sent at the end.
    let interval = Duration::from_secs(3_600);
    let options = otlp::Options { endpoint: &endpoint, service_name: "scpsfm", metrics_interval: Some(interval) };
    let export = Export::begin(options).expect("export");
    let (recorder, handle) = recorder(export.meter().as_ref()).expect("recorder");
    let page = metrics::with_local_recorder(&recorder, || {
        build_info("flex");
        tenant_jobs(vec![]);
        for _ in 0..3 {
            job_created();
        }
        queue_depth(7);
        queue_wait(Duration::from_millis(250));
        queue_wait(Duration::from_secs(1_000));
        job_finished(&ended(JobState::Succeeded, Some(Grade::Metric)));
        job_finished(&ended(JobState::Failed, None));
        stage_finished(Stage::Search, None, Duration::from_secs(2));
        RpcCall::begin("scpsfm.v1.JobService/GetJob").finish("OK");
        drop(store_operation("claim"));
        drop(watcher());
        std::mem::forget(busy_worker());
        for metric in ALL.iter().filter(|metric| matches!(metric.kind, Kind::Histogram(_))) {
            metrics::histogram!(metric.name).record(0.5);
        }
        page(&handle)
    });
    tokio::task::spawn_blocking(move || drop(export)).await.expect("flush");

    let exports = collector.metrics();
    assert_eq!(exports.len(), 1, "one export, at the end");
    let resource = &exports[0].resource.as_ref().expect("a resource").attributes;
    assert_eq!(text(resource, "service.name").as_deref(), Some("scpsfm"));
    let (expected, exported) = (Page::parse(&page).samples, samples(&exports[0]));
    assert_eq!(exported.get("scpsfm_jobs_created_total"), Some(&3.0));
    assert_eq!(exported.get("scpsfm_queue_wait_seconds_bucket{le=\"0.25\"}"), Some(&1.0));
    assert_eq!(exported.get("scpsfm_queue_wait_seconds_count"), Some(&3.0));
    assert_eq!(exported.get("scpsfm_workers_busy"), Some(&1.0));
    for (series, value) in exported.iter().filter(|(series, _)| !changes_meanwhile(series)) {
        assert_eq!(expected.get(series), Some(value), "{series}");
    }
    // The SDK has no series of a histogram before its first sample.
    let of_histogram = |series: &str| ["_bucket", "_sum", "_count"].iter().any(|part| series.contains(part));
    for (series, value) in expected.iter().filter(|(series, _)| !changes_meanwhile(series)) {
        assert!(exported.contains_key(series) || *value == 0.0 && of_histogram(series), "{series} is not exported");
    }
    assert!(exported["process_resident_memory_bytes"] > 1e6 && exported["process_open_fds"] > 0.0);

    let exported: Vec<&Exported> = exports[0].scope_metrics.iter().flat_map(|scope| &scope.metrics).collect();
    for metric in &exported {
        let declared = ALL.iter().find(|declared| declared.name == metric.name).expect("in the catalogue");
        assert_eq!((metric.description.as_str(), metric.unit.as_str()), (declared.help, ""), "{}", metric.name);
        assert_eq!(kind(metric), declared.kind, "{}", metric.name);
    }
    for metric in ALL {
        assert!(exported.iter().any(|of| of.name == metric.name), "{} is not exported", metric.name);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_interval_exports_the_totals_up_to_then() {
    let (collector, address) = Collector::start().await;
    let endpoint = format!("http://{address}");
    let interval = Duration::from_millis(20);
    let options = otlp::Options { endpoint: &endpoint, service_name: "scpsfm", metrics_interval: Some(interval) };
    let export = Export::begin(options).expect("export");
    let (recorder, _) = recorder(export.meter().as_ref()).expect("recorder");
    let latest =
        || collector.metrics().last().and_then(|export| samples(export).get("scpsfm_jobs_created_total").copied());
    for total in [1.0, 2.0] {
        metrics::with_local_recorder(&recorder, job_created);
        let exported = async {
            while latest() != Some(total) {
                tokio::time::sleep(interval).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(60), exported).await.expect("an export with the total");
    }
    tokio::task::spawn_blocking(move || drop(export)).await.expect("flush");
}
