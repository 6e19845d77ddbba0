//! What the spans and lines of one job look like outside.

use std::io::Write;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use tracing::subscriber::with_default;

use super::{
    Error, Format, Options, build, parent_context, record_job, submit_span, traceparent, traceparent_to_store,
};
use crate::domain::Stage;
use crate::domain::job::{JobName, JobState};
use crate::telemetry::collector::{Collector, attribute, hex, only};
use crate::telemetry::{Attempt, otlp, waited};

const TRACE_ID: &str = "0af7651916cd43dd8448eb211c80319c";
const CALLER_SPAN: &str = "b7ad6b7169203331";

fn caller() -> String {
    format!("00-{TRACE_ID}-{CALLER_SPAN}-01")
}

fn job() -> JobName {
    JobName { tenant: "default".into(), job: "a-1".into() }
}

fn options(format: Format, filter: &str) -> Options<'_> {
    Options { format, filter, access: false, export: None }
}

#[derive(Clone, Default)]
struct Lines(Arc<Mutex<Vec<u8>>>);

impl Lines {
    fn text(&self) -> String {
        String::from_utf8(self.0.lock().expect("lock").clone()).expect("UTF-8")
    }
}

impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().expect("lock").write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

fn write_lines_inside_a_job(format: Format, filter: &str) -> String {
    let lines = Lines::default();
    let writer = lines.clone();
    let subscriber = build(options(format, filter), move || writer.clone(), false).expect("subscriber");
    with_default(subscriber, || {
        let attempt = Attempt::begin(&job(), 2, None);
        attempt.span().in_scope(|| {
            tracing::info!("an info line");
            tracing::warn!(inliers = 20, "a warning");
        });
        attempt.end(Some(JobState::Succeeded));
    });
    lines.text()
}

#[test]
fn every_line_carries_the_jobs_name_whatever_the_filter_lets_through() {
    let json = write_lines_inside_a_job(Format::Json, "warn");
    let lines: Vec<&str> = json.lines().collect();
    assert_eq!(lines.len(), 1, "{json}");
    let line: serde_json::Value = serde_json::from_str(lines[0]).expect("JSON");
    assert_eq!(line["message"], "a warning");
    assert_eq!(line["inliers"], 20);
    assert_eq!(line["span"]["job"], "tenants/default/jobs/a-1");
    assert_eq!(line["span"]["attempt"], 2);

    let human = write_lines_inside_a_job(Format::Human, "info");
    assert_eq!(human.lines().count(), 2, "{human}");
    for line in human.lines() {
        assert!(line.contains("job=tenants/default/jobs/a-1"), "{line}");
    }
}

#[test]
fn a_bad_filter_is_an_error() {
    assert!(matches!(build(options(Format::Json, "scpsfm=loud"), std::io::sink, false), Err(Error::Filter(_))));
}

#[test]
fn a_traceparent_round_trips_and_a_malformed_one_is_none() {
    let unsampled = format!("00-{TRACE_ID}-{CALLER_SPAN}-00");
    for valid in [caller(), unsampled] {
        assert_eq!(traceparent(&parent_context(Some(&valid))), Some(valid));
    }
    let zero = format!("00-{}-{CALLER_SPAN}-01", "0".repeat(32));
    for malformed in [None, Some(""), Some("00-xyz"), Some(&caller()[..40]), Some(zero.as_str())] {
        assert_eq!(traceparent(&parent_context(malformed)), None, "{malformed:?}");
    }
}

#[test]
fn without_export_the_callers_own_traceparent_is_kept() {
    let span = submit_span("CreateJob", Some(&caller()));
    assert_eq!(traceparent_to_store(&span, Some(&caller())), Some(caller()));
    assert_eq!(traceparent_to_store(&span, Some("nonsense")), None);
}

/// The life of a job whose first attempt is given back at a restart: only the stored string connects the two.
fn run_a_job() -> SystemTime {
    let submit = submit_span("CreateJob", Some(&caller()));
    record_job(&submit, &job());
    let stored = traceparent_to_store(&submit, Some(&caller())).expect("traceparent");
    drop(submit);
    let enqueued_at = SystemTime::now() - Duration::from_secs(7);
    waited(&job(), Some(&stored), enqueued_at, SystemTime::now());
    let mut first = Attempt::begin(&job(), 1, Some(&stored));
    first.stage(Stage::Prepare);
    drop(first);
    waited(&job(), Some(&stored), SystemTime::now(), SystemTime::now());
    let mut second = Attempt::begin(&job(), 2, Some(&stored));
    second.stage(Stage::Search);
    second.stage(Stage::Refine);
    second.end(Some(JobState::Failed));
    enqueued_at
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collector_sees_one_trace_under_the_callers_traceparent() {
    let (collector, address) = Collector::start().await;
    let endpoint = format!("http://{address}");
    let to_collector = otlp::Options { endpoint: &endpoint, service_name: "scpsfm", metrics_interval: None };
    let export = otlp::Export::begin(to_collector).expect("export");
    let options = Options { export: Some(&export), ..options(Format::Json, "off") };
    let subscriber = build(options, std::io::sink, false).expect("subscriber");
    let enqueued_at = with_default(subscriber, run_a_job);
    tokio::task::spawn_blocking(move || drop(export)).await.expect("flush");

    // The export sends everything before it is gone: nothing is waited for.
    let mut spans = collector.spans();
    // Queue spans go through the process-wide provider: other tests' may be among them.
    spans.retain(|span| hex(&span.trace_id) == TRACE_ID);
    let submit = only(&spans, "submit");
    assert_eq!(hex(&submit.parent_span_id), CALLER_SPAN);
    assert_eq!(attribute(submit, "job").as_deref(), Some("tenants/default/jobs/a-1"));
    let queues: Vec<_> = spans.iter().filter(|span| span.name == "queue").collect();
    let attempts: Vec<_> = spans.iter().filter(|span| span.name == "attempt").collect();
    assert_eq!((queues.len(), attempts.len(), spans.len()), (2, 2, 8));
    for span in queues.iter().chain(&attempts) {
        assert_eq!(span.parent_span_id, submit.span_id, "{} hangs under submit", span.name);
        assert_eq!(attribute(span, "job").as_deref(), Some("tenants/default/jobs/a-1"), "{}", span.name);
    }
    let enqueued_nanos = enqueued_at.duration_since(SystemTime::UNIX_EPOCH).expect("after 1970").as_nanos();
    let first_queue = queues.iter().find(|queue| u128::from(queue.start_time_unix_nano) == enqueued_nanos);
    let first_queue = first_queue.expect("a queue span from the entry into the queue");
    assert!(first_queue.end_time_unix_nano - first_queue.start_time_unix_nano >= 7_000_000_000);

    let attempt = |number: &str| {
        *attempts.iter().find(|span| attribute(span, "attempt").as_deref() == Some(number)).expect("attempt")
    };
    assert_eq!(only(&spans, "prepare").parent_span_id, attempt("1").span_id);
    assert_eq!(attribute(attempt("1"), "outcome"), None, "it was dropped, not ended");
    let second = attempt("2");
    assert_eq!(attribute(second, "outcome").as_deref(), Some("FAILED"));
    assert_eq!(second.status.as_ref().map(|status| status.code), Some(2), "an error");
    let (search, refine) = (only(&spans, "search"), only(&spans, "refine"));
    assert_eq!((&search.parent_span_id, &refine.parent_span_id), (&second.span_id, &second.span_id));
    assert!(search.end_time_unix_nano <= refine.start_time_unix_nano, "one stage after the other");
}

#[test]
fn the_audit_log_is_always_written_and_the_access_log_where_it_is_asked_for() {
    for (access, count) in [(false, 1), (true, 2)] {
        let lines = Lines::default();
        let writer = lines.clone();
        let options = Options { access, ..options(Format::Json, "off") };
        let subscriber = build(options, move || writer.clone(), false).expect("subscriber");
        with_default(subscriber, || {
            tracing::info!(target: super::ACCESS, "call");
            tracing::info!(target: super::AUDIT, "audit");
            tracing::error!("filtered");
        });
        let text = lines.text();
        assert_eq!(text.lines().count(), count, "{text}");
        assert!(text.contains("scpsfm::audit") && text.contains("scpsfm::access") == access, "{text}");
    }
}
