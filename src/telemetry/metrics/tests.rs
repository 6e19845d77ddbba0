//! What stands on the page, and that dashboard and alerts ask for nothing else.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, SystemTime};

use super::*;
use crate::domain::job::{Failure, JobName, Summary};
use crate::domain::{SolveSettings, Status};
use crate::telemetry::scrape::Page;

const DASHBOARD: &str = include_str!("../../../deploy/grafana/dashboards/scpsfm.json");
const RULES: &str = include_str!("../../../deploy/prometheus-rules.yml");

/// The page after `act`, on a recorder of its own.
pub(crate) fn page_after(act: impl FnOnce()) -> String {
    let (recorder, handle) = recorder(None).expect("recorder");
    metrics::with_local_recorder(&recorder, || {
        act();
        page(&handle)
    })
}

pub(crate) fn ended(state: JobState, grade: Option<Grade>) -> Job {
    let start = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000);
    let succeeded = state == JobState::Succeeded;
    let summary = Summary {
        status: if grade.is_some() { Status::Solved } else { Status::NoReconstruction },
        grade,
        focal_px: Some(1_000.0),
        sigma_log_focal: Some(0.01),
        inlier_tracks: 20,
        registered_views: 10,
        reprojection_rms_px: Some(0.3),
        winning_proposal: grade.map(|_| Proposal::Network),
        iterations: 120,
        seconds: 2.5,
        result_size_bytes: 1,
        warnings: Vec::new(),
    };
    Job {
        name: JobName { tenant: "default".into(), job: "a".into() },
        state,
        attempt: 1,
        settings: SolveSettings::default(),
        input: None,
        view_count: 10,
        track_count: 200,
        observation_count: 2_000,
        labels: BTreeMap::new(),
        priority: 0,
        create_time: start,
        start_time: Some(start),
        end_time: Some(start + Duration::from_millis(2_500)),
        deadline: None,
        progress: None,
        last_sequence: 1,
        summary: succeeded.then_some(summary),
        failure: (state == JobState::Failed).then(|| Failure::new("INTERNAL", "test")),
        cancel_requested: false,
        attached_calls: None,
        expire_time: None,
        webhook: None,
    }
}

#[test]
fn every_metric_is_declared_once_named_by_convention_and_on_the_page() {
    let page = page_after(|| {
        build_info("flex");
        tenant_jobs(vec![]);
        RpcCall::begin("scpsfm.v1.JobService/GetJob").finish("OK");
        drop(store_operation("claim"));
    });
    let names: BTreeSet<&str> = ALL.iter().map(|metric| metric.name).collect();
    assert_eq!(names.len(), ALL.len(), "no name twice");
    for metric in ALL {
        let kind = match metric.kind {
            Kind::Counter => "counter",
            Kind::Gauge => "gauge",
            Kind::Histogram(buckets) => {
                assert!(buckets.is_sorted_by(|a, b| a < b), "{}", metric.name);
                "histogram"
            }
        };
        assert!(page.contains(&format!("# HELP {} {}\n", metric.name, metric.help)), "{}", metric.name);
        assert!(page.contains(&format!("# TYPE {} {kind}\n", metric.name)), "{}", metric.name);
        assert_eq!(metric.name.ends_with("_total"), metric.kind == Kind::Counter, "{}", metric.name);
        for label in metric.labels {
            let series = page.lines().find(|line| line.starts_with(metric.name) && line.contains('{'));
            assert!(series.is_some_and(|line| line.contains(&format!("{label}=\""))), "{}: {label}", metric.name);
        }
    }
}

#[test]
fn what_is_known_beforehand_is_zero_before_the_first_job() {
    let page = page_after(|| {});
    let samples = Page::parse(&page);
    for series in [
        "scpsfm_queue_depth",
        "scpsfm_workers_busy",
        "scpsfm_watchers",
        "scpsfm_grpc_requests_in_flight",
        "scpsfm_jobs_created_total",
        "scpsfm_jobs_total{state=\"CANCELLED\"}",
        "scpsfm_results_total{grade=\"NONE\"}",
        "scpsfm_admission_refusals_total{reason=\"QUEUE_FULL\",bound=\"jobs\"}",
        "scpsfm_admission_refusals_total{reason=\"QUEUE_FULL\",bound=\"bytes\"}",
        "scpsfm_admission_refusals_total{reason=\"QUEUE_FULL\",bound=\"observations\"}",
        "scpsfm_admission_refusals_total{reason=\"QUEUE_FULL\",bound=\"tenant_jobs\"}",
        "scpsfm_admission_refusals_total{reason=\"BATCH_TOO_LARGE\",bound=\"tenant_bytes\"}",
        "scpsfm_upload_refusals_total{reason=\"UPLOAD_TOO_LARGE\",bound=\"upload_bytes\"}",
        "scpsfm_jobs_deleted_total{reason=\"RETENTION\"}",
        "scpsfm_http_refused_total{reason=\"HOST_REFUSED\"}",
        "scpsfm_admission_refusals_total{reason=\"DRAINING\",bound=\"NONE\"}",
        "scpsfm_admission_refusals_total{reason=\"JOB_TOO_LARGE\",bound=\"solver_bytes\"}",
        "scpsfm_solver_bytes",
        "scpsfm_admission_refusals_total{reason=\"RATE_LIMITED\",bound=\"calls\"}",
        "scpsfm_admission_refusals_total{reason=\"RATE_LIMITED\",bound=\"jobs\"}",
        "scpsfm_job_duration_seconds_count{state=\"SUCCEEDED\"}",
        "scpsfm_queue_wait_seconds_count",
    ] {
        assert_eq!(samples.value(series), 0.0, "{series}");
    }
    for never in ["scpsfm_jobs_total{state=\"QUEUED\"", "scpsfm_jobs_total{state=\"RUNNING\""] {
        assert!(!page.contains(never), "{never} is not terminal");
    }
}

#[test]
fn a_finished_job_counts_by_its_state_and_only_results_by_their_grade() {
    let page = page_after(|| {
        job_finished(&ended(JobState::Succeeded, Some(Grade::Metric)));
        job_finished(&ended(JobState::Succeeded, None));
        job_finished(&ended(JobState::Failed, None));
        job_finished(&ended(JobState::Cancelled, None));
    });
    let expected = [
        ("scpsfm_jobs_total{state=\"SUCCEEDED\"}", 2.0),
        ("scpsfm_jobs_total{state=\"FAILED\"}", 1.0),
        ("scpsfm_jobs_total{state=\"CANCELLED\"}", 1.0),
        ("scpsfm_jobs_total{state=\"DEADLINE_EXCEEDED\"}", 0.0),
        ("scpsfm_results_total{grade=\"METRIC\"}", 1.0),
        ("scpsfm_results_total{grade=\"NONE\"}", 1.0),
        ("scpsfm_winning_proposal_total{proposal=\"network\"}", 1.0),
        ("scpsfm_inlier_ratio_count", 1.0),
        ("scpsfm_inlier_ratio_sum", 0.1),
        ("scpsfm_solve_iterations_count", 2.0),
        ("scpsfm_job_duration_seconds_sum{state=\"FAILED\"}", 2.5),
    ];
    let samples = Page::parse(&page);
    for (series, wanted) in expected {
        assert_eq!(samples.value(series), wanted, "{series}");
    }
}

#[test]
fn guards_give_back_what_they_took_and_a_dropped_call_is_cancelled() {
    let (recorder, handle) = recorder(None).expect("recorder");
    let render = || Page::parse(&handle.render());
    metrics::with_local_recorder(&recorder, || {
        let (worker, watcher_guard) = (busy_worker(), watcher());
        let call = RpcCall::begin("scpsfm.v1.JobService/WatchJob");
        let during = render();
        for series in ["scpsfm_workers_busy", "scpsfm_watchers", "scpsfm_grpc_requests_in_flight"] {
            assert_eq!(during.value(series), 1.0, "{series}");
        }
        drop((worker, watcher_guard, call));
        let after = render();
        for series in ["scpsfm_workers_busy", "scpsfm_watchers", "scpsfm_grpc_requests_in_flight"] {
            assert_eq!(after.value(series), 0.0, "{series}");
        }
        let cancelled = "scpsfm_grpc_requests_total{method=\"scpsfm.v1.JobService/WatchJob\",code=\"CANCELLED\"}";
        assert_eq!(after.value(cancelled), 1.0, "{after:?}");
    });
}

#[test]
fn an_attempt_tells_its_wait_its_worker_and_its_stages() {
    let page = page_after(|| {
        let name = JobName { tenant: "default".into(), job: "a".into() };
        crate::telemetry::waited(&name, None, SystemTime::now(), SystemTime::now());
        let mut attempt = crate::telemetry::Attempt::begin(&name, 1, None);
        attempt.at_work();
        attempt.stage(Stage::Prepare);
        attempt.stage(Stage::Search);
        attempt.end(Some(JobState::Cancelled));
        crate::telemetry::waited(&name, None, SystemTime::now(), SystemTime::now());
        drop(crate::telemetry::Attempt::begin(&name, 2, None));
    });
    let expected = [
        ("scpsfm_queue_wait_seconds_count", 2.0),
        ("scpsfm_workers_busy", 0.0),
        ("scpsfm_stage_duration_seconds_count{stage=\"prepare\",state=\"CANCELLED\"}", 1.0),
        ("scpsfm_stage_duration_seconds_count{stage=\"search\",state=\"CANCELLED\"}", 1.0),
        ("scpsfm_stage_duration_seconds_count{stage=\"search\",state=\"SUCCEEDED\"}", 0.0),
    ];
    let samples = Page::parse(&page);
    for (series, wanted) in expected {
        assert_eq!(samples.value(series), wanted, "{series}");
    }
}

/// Names of our metrics in a query or a whole file.
fn names_in(text: &str) -> BTreeSet<&str> {
    let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
    words.filter(|word| word.starts_with("scpsfm_") || word.starts_with("process_")).collect()
}

fn is_exposed(name: &str) -> bool {
    ALL.iter().any(|metric| match metric.kind {
        Kind::Histogram(_) => {
            ["_bucket", "_sum", "_count"].iter().any(|suffix| name.strip_suffix(suffix) == Some(metric.name))
        }
        _ => name == metric.name,
    })
}

#[test]
fn dashboard_and_alerts_ask_only_for_what_is_exposed() {
    let dashboard: serde_json::Value = serde_json::from_str(DASHBOARD).expect("JSON");
    let panels = dashboard["panels"].as_array().expect("panels");
    let queries: Vec<&str> = panels
        .iter()
        .flat_map(|panel| panel["targets"].as_array().into_iter().flatten())
        .map(|target| target["expr"].as_str().expect("a query"))
        .collect();
    assert!(queries.len() >= panels.len(), "every panel asks something");
    assert!(RULES.matches("expr:").count() > 0, "there are alerts");
    for text in queries.into_iter().chain([RULES]) {
        let names = names_in(text);
        assert!(!names.is_empty(), "`{text}` asks for no metric of ours");
        for name in names {
            assert!(is_exposed(name), "`{name}` is not exposed");
        }
    }
}
