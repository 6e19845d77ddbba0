//! Metrics, logs and traces of the real program: what a solved, a failed and a cancelled job change.

use std::fs::File;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_server::MetricsServiceServer;
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::TraceServiceServer;
use rustix::process::Signal;
use scpsfm::domain::Stage;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState, create_job_request::Source};
use tonic::Code;
use tonic::transport::{Channel, Identity, ServerTlsConfig};

use crate::support::certificates::Authority;
use crate::support::collector::{Collector, attribute, hex, only, samples, text};
use crate::support::http::request;
use crate::support::keys::{NORTH, SOUTH, keyed};
use crate::support::live::{connected, created, easy, lasting, reaches, small};
use crate::support::program::Serving;
use crate::support::scrape::Page;
use crate::support::server::soon;

/// Iterations that keep a worker busy for half a minute or more if they are let.
const ENDLESS: u32 = 10_000;

/// What `/metrics` shows now.
fn scrape(server: &Serving) -> Page {
    Page::parse(&server.page("/metrics"))
}

/// The first page that shows `wanted`: metrics follow the commit that a watcher sees, so they may come a moment later.
async fn scrape_until(server: &Serving, wanted: impl Fn(&Page) -> bool) -> Page {
    soon(async {
        loop {
            let page = scrape(server);
            if wanted(&page) {
                return page;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await
}

/// The one line of a log in JSON with this message.
fn logged(log: &Path, message: &str) -> serde_json::Value {
    let log = std::fs::read_to_string(log).expect("a log");
    let lines = log.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).expect("JSON"));
    let mut found: Vec<_> = lines.filter(|line| line["message"] == message).collect();
    assert_eq!(found.len(), 1, "{message} in {log}");
    found.remove(0)
}

/// Asserts by how much each of these series grew.
fn assert_growth(before: &Page, after: &Page, expected: &[(&str, f64)]) {
    for (series, growth) in expected {
        assert_eq!(after.value(series) - before.value_so_far(series), *growth, "{series}");
    }
}

/// Asserts that nothing waits, runs or is watched.
fn assert_idle(page: &Page) {
    for gauge in ["scpsfm_queue_depth", "scpsfm_workers_busy", "scpsfm_watchers", "scpsfm_grpc_requests_in_flight"] {
        assert_eq!(page.value(gauge), 0.0, "{gauge}");
    }
}

fn is_idle(page: &Page) -> bool {
    page.value("scpsfm_queue_depth") + page.value("scpsfm_watchers") + page.value("scpsfm_grpc_requests_in_flight")
        == 0.0
}

const CREATED_OK: &str = "scpsfm_grpc_requests_total{method=\"scpsfm.v1.JobService/CreateJob\",code=\"OK\"}";
const CREATED_BAD: &str =
    "scpsfm_grpc_requests_total{method=\"scpsfm.v1.JobService/CreateJob\",code=\"INVALID_ARGUMENT\"}";

/// Names of the stages that complete tracks pass: there is nothing to extend them to.
fn block_stages() -> impl Iterator<Item = &'static str> {
    Stage::ALL.into_iter().filter(|stage| *stage != Stage::Extend).map(Stage::name)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_solved_a_refused_and_a_cancelled_job_each_leave_their_marks() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(&directory.path().join("data"));
    let mut jobs = connected(&server).await;
    let before = scrape(&server);
    assert_idle(&before);
    assert_eq!(before.value("scpsfm_workers"), 1.0);
    assert_eq!(before.sum("scpsfm_build_info"), 1.0);

    let name = created(&mut jobs, easy(1)).await;
    assert_eq!(reaches(&mut jobs, &name, &[JobState::Succeeded, JobState::Failed]).await, JobState::Succeeded);
    let solved =
        scrape_until(&server, |page| page.value("scpsfm_jobs_total{state=\"SUCCEEDED\"}") > 0.0 && is_idle(page)).await;
    assert_growth(
        &before,
        &solved,
        &[
            ("scpsfm_jobs_created_total", 1.0),
            ("scpsfm_jobs_total{state=\"SUCCEEDED\"}", 1.0),
            ("scpsfm_jobs_total{state=\"FAILED\"}", 0.0),
            ("scpsfm_job_duration_seconds_count{state=\"SUCCEEDED\"}", 1.0),
            ("scpsfm_queue_wait_seconds_count", 1.0),
            ("scpsfm_solve_iterations_count", 1.0),
            ("scpsfm_inlier_ratio_count", 1.0),
            ("scpsfm_store_operation_duration_seconds_count{operation=\"create_jobs\"}", 1.0),
            ("scpsfm_store_operation_duration_seconds_count{operation=\"finish\"}", 1.0),
            (CREATED_OK, 1.0),
        ],
    );
    assert_eq!(solved.sum("scpsfm_results_total"), 1.0, "one grade");
    assert_eq!(solved.sum("scpsfm_winning_proposal_total"), 1.0, "one winner");
    for stage in block_stages() {
        let series = format!("scpsfm_stage_duration_seconds_count{{stage=\"{stage}\",state=\"SUCCEEDED\"}}");
        assert!(solved.value(&series) >= 1.0, "{series}");
    }
    assert_idle(&solved);

    let mut bad = easy(1);
    if let Some(Source::TrackSet(tracks)) = &mut bad.source {
        tracks.xs[0] = f64::NAN;
    }
    assert_eq!(jobs.create_job(bad).await.expect_err("not a number").code(), Code::InvalidArgument);
    let refused = scrape_until(&server, |page| page.value_so_far(CREATED_BAD) > 0.0).await;
    let invalid = "scpsfm_admission_refusals_total{reason=\"INVALID\",bound=\"NONE\"}";
    assert_growth(&solved, &refused, &[(invalid, 1.0), (CREATED_BAD, 1.0), ("scpsfm_jobs_created_total", 0.0)]);

    let name = created(&mut jobs, lasting(ENDLESS)).await;
    reaches(&mut jobs, &name, &[JobState::Running]).await;
    scrape_until(&server, |page| page.value("scpsfm_workers_busy") == 1.0).await;
    jobs.cancel_job(proto::CancelJobRequest { name: name.clone(), ..Default::default() }).await.expect("a cancel");
    reaches(&mut jobs, &name, &[JobState::Cancelled]).await;
    let cancelled =
        scrape_until(&server, |page| page.value("scpsfm_jobs_total{state=\"CANCELLED\"}") > 0.0 && is_idle(page)).await;
    assert_growth(
        &refused,
        &cancelled,
        &[
            ("scpsfm_jobs_created_total", 1.0),
            ("scpsfm_jobs_total{state=\"CANCELLED\"}", 1.0),
            ("scpsfm_jobs_total{state=\"SUCCEEDED\"}", 0.0),
            ("scpsfm_job_duration_seconds_count{state=\"CANCELLED\"}", 1.0),
            ("scpsfm_queue_wait_seconds_count", 1.0),
            ("scpsfm_solve_iterations_count", 0.0),
        ],
    );
    assert_eq!(cancelled.sum("scpsfm_results_total"), 1.0, "a cancelled job has no grade");
    assert_idle(&cancelled);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_takes_its_server_down_fails_and_is_counted_by_the_next() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let data_dir = directory.path().join("data");
    let once = [("SCPSFM_ENGINE__MAX_ATTEMPTS", "1")];
    let server = Serving::start_with(&data_dir, &once, Stdio::null());
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, lasting(ENDLESS)).await;
    reaches(&mut jobs, &name, &[JobState::Running]).await;
    assert_eq!(scrape(&server).value("scpsfm_jobs_total{state=\"FAILED\"}"), 0.0);
    // Killed without a warning, as by a power cut.
    drop(server);

    let log = directory.path().join("log");
    let server = Serving::start_with(&data_dir, &once, File::create(&log).expect("a log file"));
    assert_eq!(logged(&log, "serving")["recovered_jobs"], 1);
    let mut jobs = connected(&server).await;
    reaches(&mut jobs, &name, &[JobState::Failed]).await;
    // Counters begin at 0 with the process: what stands there is what this one did.
    let page =
        scrape_until(&server, |page| page.value("scpsfm_jobs_total{state=\"FAILED\"}") > 0.0 && is_idle(page)).await;
    assert_eq!(page.value("scpsfm_jobs_total{state=\"FAILED\"}"), 1.0);
    assert_eq!(page.value("scpsfm_attempts_lost_total{reason=\"LEASE_EXPIRED\"}"), 1.0);
    assert_eq!(page.value("scpsfm_job_duration_seconds_count{state=\"FAILED\"}"), 1.0);
    assert_eq!(page.sum("scpsfm_results_total"), 0.0, "a failed job has no grade");
    assert_idle(&page);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_one_trace_under_its_callers_every_line_of_it_bears_its_name_and_metrics_are_exported() {
    const TRACE_ID: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
    const CALLER_SPAN: &str = "00f067aa0ba902b7";
    let (collector, address) = Collector::start().await;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let data_dir = directory.path().join("data");
    let log = directory.path().join("log");
    let endpoint = format!("http://{address}");
    let export = [
        ("SCPSFM_OTLP__ENDPOINT", endpoint.as_str()),
        ("SCPSFM_OTLP__METRICS", "true"),
        // Longer than the test: what is exported is sent at the end.
        ("SCPSFM_OTLP__METRICS_INTERVAL_SECONDS", "3600"),
    ];
    let mut server = Serving::start_with(&data_dir, &export, File::create(&log).expect("a log file"));
    let mut jobs = connected(&server).await;
    let mut request = tonic::Request::new(easy(1));
    let traceparent = format!("00-{TRACE_ID}-{CALLER_SPAN}-01");
    request.metadata_mut().insert("traceparent", traceparent.parse().expect("ASCII"));
    let name = jobs.create_job(request).await.expect("a job").into_inner().name;
    reaches(&mut jobs, &name, &[JobState::Succeeded]).await;
    // Of what is compared below the last that a job's end records.
    let page = scrape_until(&server, |page| page.value("scpsfm_solve_iterations_count") > 0.0).await;
    // A server that drains sends what it has: nothing is waited for.
    server.running.signal(Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success());

    let mut spans = collector.spans();
    spans.retain(|span| hex(&span.trace_id) == TRACE_ID);
    let submit = only(&spans, "submit");
    assert_eq!(hex(&submit.parent_span_id), CALLER_SPAN);
    let attempt = only(&spans, "attempt");
    for span in [submit, only(&spans, "queue"), attempt] {
        assert_eq!(attribute(span, "job").as_ref(), Some(&name), "{}", span.name);
    }
    assert_eq!(only(&spans, "queue").parent_span_id, submit.span_id);
    assert_eq!(attempt.parent_span_id, submit.span_id);
    assert_eq!(attribute(attempt, "outcome").as_deref(), Some("SUCCEEDED"));
    for stage in block_stages() {
        let mut of_stage = spans.iter().filter(|span| span.name == stage).peekable();
        assert!(of_stage.peek().is_some(), "no span of {stage}");
        assert!(of_stage.all(|span| span.parent_span_id == attempt.span_id), "{stage}");
    }

    assert_exported(&collector, &page);

    let serving = logged(&log, "serving");
    assert_eq!((&serving["version"], &serving["recovered_jobs"]), (&env!("CARGO_PKG_VERSION").into(), &0.into()));
    assert_eq!((&serving["store_kind"], &serving["queued_jobs"]), (&"sqlite".into(), &0.into()));
    assert!(serving["keys"].is_null() && serving["certificate_end"].is_null(), "{serving}");
    assert_eq!(serving["store"], data_dir.display().to_string());
    assert_eq!(format!("http://{}", serving["grpc"].as_str().expect("an address")), server.grpc);
    assert_eq!(serving["metrics"], server.metrics);
    let ended = logged(&log, "job ended");
    assert!(ended["state"] == "SUCCEEDED" && ended["grade"].is_string() && ended["seconds"].is_f64(), "{ended}");
    assert_eq!((&ended["tenant"], &ended["attempt"]), (&"default".into(), &1.into()), "{ended}");
    assert!(ended["focal_px"].is_f64() || ended["grade"] == "PROJECTIVE_ONLY", "{ended}");
    let log = std::fs::read_to_string(&log).expect("a log");
    let lines = log.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).expect("JSON"));
    let of_attempt: Vec<_> = lines.filter(|line| line["target"] == "scpsfm::engine::execution").collect();
    assert!(of_attempt.len() >= 2, "an attempt's begin and end are logged:\n{log}");
    for line in of_attempt {
        assert_eq!(line["span"]["job"], name.as_str(), "{line}");
    }
}

/// Asserts that the one export is of this server and holds what `page` showed before.
fn assert_exported(collector: &Collector, page: &Page) {
    let exports = collector.metrics();
    assert_eq!(exports.len(), 1, "one export, at the end");
    let resource = &exports[0].resource.as_ref().expect("a resource").attributes;
    assert_eq!(text(resource, "service.name").as_deref(), Some("scpsfm"));
    assert_eq!(text(resource, "service.version").as_deref(), Some(env!("CARGO_PKG_VERSION")));
    let scopes: Vec<_> = exports[0].scope_metrics.iter().map(|metrics| &metrics.scope).collect();
    assert!(matches!(scopes[..], [Some(scope)] if scope.name == "scpsfm"), "{scopes:?}");
    let samples = samples(&exports[0]);
    for series in [
        "scpsfm_jobs_created_total",
        "scpsfm_jobs_total{state=\"SUCCEEDED\"}",
        "scpsfm_jobs_total{state=\"FAILED\"}",
        "scpsfm_workers",
        "scpsfm_queue_capacity",
        "scpsfm_job_duration_seconds_count{state=\"SUCCEEDED\"}",
        "scpsfm_job_duration_seconds_sum{state=\"SUCCEEDED\"}",
        "scpsfm_solve_iterations_sum",
        "scpsfm_queue_wait_seconds_count",
    ] {
        assert_eq!(samples.get(series), Some(&page.value(series)), "{series}");
    }
    assert_eq!(samples["scpsfm_jobs_total{state=\"SUCCEEDED\"}"], 1.0);
    assert_eq!(samples["scpsfm_workers_busy"], 0.0, "as it is at the end");
    assert_eq!(samples["scpsfm_tenant_jobs{state=\"QUEUED\",tenant=\"OTHER\"}"], 0.0);
    assert!(samples["process_resident_memory_bytes"] > 1e6 && samples["process_open_fds"] > 0.0);
}

/// What a log in JSON holds so far; its last line may be on its way.
fn lines_so_far(log: &Path) -> Vec<serde_json::Value> {
    let log = std::fs::read_to_string(log).expect("a log");
    log.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn operators_see_every_call_who_changed_what_and_who_was_refused() {
    const TRACE_ID: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
    const WRONG_CALLS: usize = 30;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("log");
    let keys = format!("north:{NORTH}");
    // The filter is for everything else.
    let variables =
        [("SCPSFM_AUTH__KEYS", keys.as_str()), ("SCPSFM_LOG__ACCESS", "true"), ("SCPSFM_LOG__FILTER", "warn")];
    let data_dir = directory.path().join("data");
    let server = Serving::start_with(&data_dir, &variables, File::create(&log).expect("a log file"));
    let channel = Channel::from_shared(server.grpc.clone()).expect("an address").connect().await.expect("a connection");
    let mut jobs = JobServiceClient::new(keyed(&channel, NORTH));
    let mut create = tonic::Request::new(proto::CreateJobRequest { parent: "tenants/-".into(), ..small(1) });
    let traceparent = format!("00-{TRACE_ID}-00f067aa0ba902b7-01");
    create.metadata_mut().insert("traceparent", traceparent.parse().expect("ASCII"));
    let name = jobs.create_job(create).await.expect("a job").into_inner().name;
    let get = proto::GetJobRequest { name: name.clone() };
    jobs.get_job(get).await.expect("a job");
    let bearer = format!("Bearer {NORTH}");
    let path = format!("/v1/{name}");
    let read = tokio::task::block_in_place(|| request(&server, "GET", &path, &[("authorization", &bearer)], &[]));
    assert_eq!(read.code, 200);
    jobs.cancel_job(proto::CancelJobRequest { name: name.clone(), ..Default::default() }).await.expect("a cancel");
    let none = "tenants/north/jobs/none";
    let delete = proto::DeleteJobRequest { name: none.into(), ..Default::default() };
    assert_eq!(jobs.delete_job(delete).await.expect_err("no job").code(), Code::NotFound);
    let mut wrong = JobServiceClient::new(keyed(&channel, SOUTH));
    for _ in 0..WRONG_CALLS {
        let refused = wrong.list_jobs(proto::ListJobsRequest::default()).await.expect_err("a wrong key");
        assert_eq!(refused.code(), Code::Unauthenticated);
    }
    // The HTTP port refuses it before it becomes a call; here the missing key.
    let keyless = tokio::task::block_in_place(|| request(&server, "GET", &path, &[], &[]));
    assert_eq!(keyless.code, 401);

    let of = |lines: &[serde_json::Value], target: &str, method: &str| -> Vec<serde_json::Value> {
        lines
            .iter()
            .filter(|line| {
                line["target"] == target && line["method"].as_str().is_some_and(|name| name.ends_with(method))
            })
            .cloned()
            .collect()
    };
    // A call's line comes with the last byte of its answer, which may be a moment after its client has it.
    let lines = soon(async {
        loop {
            let lines = lines_so_far(&log);
            if of(&lines, "scpsfm::access", "/ListJobs").len() == WRONG_CALLS
                && of(&lines, "scpsfm::access", "/GetJob").len() >= 2
            {
                return lines;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    let fingerprint = scpsfm::rpc::keys::Hash::of(NORTH).fingerprint();
    let is_known = |line: &serde_json::Value| {
        let peer = line["peer"].as_str().unwrap_or_default();
        line["tenant"] == "north" && line["key"] == fingerprint.as_str() && peer.starts_with("127.0.0.1:")
    };
    let created = of(&lines, "scpsfm::access", "/CreateJob");
    let [created] = &created[..] else { panic!("not one line: {created:?}") };
    assert!(is_known(created) && created["code"] == "OK" && created["trace"] == TRACE_ID, "{created}");
    assert!(created["seconds"].is_f64(), "{created}");
    assert!(created["received_bytes"].as_u64() > Some(100) && created["sent_bytes"].as_u64() > Some(10), "{created}");
    let read = of(&lines, "scpsfm::access", "/GetJob");
    assert_eq!(read.len(), 2, "one over gRPC and one over HTTP: {read:?}");
    assert!(read.iter().all(is_known), "{read:?}");

    for (method, resource, code) in
        [("CreateJob", name.as_str(), "OK"), ("CancelJob", &name, "OK"), ("DeleteJob", none, "NOT_FOUND")]
    {
        let audit = of(&lines, "scpsfm::audit", method);
        let [audit] = &audit[..] else { panic!("not one line of {method}: {audit:?}") };
        assert!(is_known(audit) && audit["resource"] == resource && audit["code"] == code, "{audit}");
    }

    let refused: Vec<_> = lines.iter().filter(|line| line["message"] == "refused").collect();
    // Ten a minute, and the test may be slow.
    assert!(refused.len() >= 10 && refused.len() < WRONG_CALLS, "{refused:?}");
    assert!(refused.iter().all(|line| line["code"] == "UNAUTHENTICATED" && line["level"] == "WARN"), "{refused:?}");
    assert!(refused.iter().any(|line| line["reason"] == "API_KEY_UNKNOWN"), "{refused:?}");
    assert!(lines.iter().all(|line| line["message"] != "serving"), "the filter lets no other line through");
    let text = std::fs::read_to_string(&log).expect("a log");
    assert!(!text.contains(NORTH) && !text.contains(SOUTH), "a key stands in the log");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_tells_of_the_process_the_store_and_each_tenants_jobs() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(&directory.path().join("data"));
    let mut jobs = connected(&server).await;
    let running = created(&mut jobs, lasting(ENDLESS)).await;
    reaches(&mut jobs, &running, &[JobState::Running]).await;
    let waiting = created(&mut jobs, lasting(ENDLESS)).await;
    let [of_running, of_waiting] =
        ["RUNNING", "QUEUED"].map(|state| format!("scpsfm_tenant_jobs{{tenant=\"default\",state=\"{state}\"}}"));
    let page = scrape_until(&server, |page| {
        page.value_so_far(&of_waiting) == 1.0 && page.value("scpsfm_queue_oldest_seconds") > 0.0
    })
    .await;
    assert_eq!(page.value(&of_running), 1.0);
    assert_eq!(page.value("scpsfm_tenant_jobs{tenant=\"OTHER\",state=\"QUEUED\"}"), 0.0);
    assert!(page.value("scpsfm_store_bytes") > 10_000.0);
    assert_eq!(page.value("scpsfm_certificate_end_timestamp_seconds"), 0.0, "no TLS");
    assert!(page.value("process_resident_memory_bytes") > 1e6 && page.value("process_open_fds") > 5.0);
    assert!(page.value("process_cpu_seconds_total") >= 0.0);
    for name in [waiting, running] {
        jobs.cancel_job(proto::CancelJobRequest { name, ..Default::default() }).await.expect("a cancel");
    }
    scrape_until(&server, |page| page.value_so_far(&of_running) + page.value_so_far(&of_waiting) == 0.0).await;
}

#[test]
fn a_certificate_that_clients_will_refuse_is_a_warning_at_the_start() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let nameless = Authority::new("ours").issue(at, "nameless", &[]);
    let log = at.join("log");
    let [certificate, key] = [&nameless.certificate, &nameless.key].map(|path| path.to_str().expect("UTF-8"));
    let arguments = ["--workers", "1", "--tls-certificate", certificate, "--tls-key", key];
    let server = Serving::start_more(&at.join("data"), &arguments, &[], File::create(&log).expect("a log file"));
    let warning = logged(&log, "clients will refuse the server's certificate (tls.certificate)");
    assert_eq!(
        (&warning["level"], &warning["problem"]),
        (&"WARN".into(), &"it has no subject alternative name".into())
    );
    assert_eq!(logged(&log, "serving")["certificate_end"], "4096-01-01T00:00:00Z");
    assert!(scrape(&server).value("scpsfm_certificate_end_timestamp_seconds") > 4e9);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn traces_and_metrics_go_to_a_collector_over_tls() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let authority = Authority::new("ours");
    let (trusted, here) = (authority.write(at, "ours.pem"), authority.issue(at, "here", &["127.0.0.1"]));
    let read = |path: &Path| std::fs::read_to_string(path).expect("a file");
    let identity = Identity::from_pem(read(&here.certificate), read(&here.key));
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("bind");
    let endpoint = format!("https://{}", listener.local_addr().expect("an address"));
    let collector = Collector::default();
    let collecting = tonic::transport::Server::builder()
        .tls_config(ServerTlsConfig::new().identity(identity))
        .expect("a certificate")
        .add_service(TraceServiceServer::new(collector.clone()))
        .add_service(MetricsServiceServer::new(collector.clone()))
        .serve_with_incoming(tokio_stream::wrappers::TcpListenerStream::new(listener));
    tokio::spawn(collecting);
    let export = [("SCPSFM_OTLP__ENDPOINT", endpoint.as_str()), ("SSL_CERT_FILE", trusted.to_str().expect("UTF-8"))];
    let mut server = Serving::start_with(&at.join("data"), &export, Stdio::null());
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, small(1)).await;
    reaches(&mut jobs, &name, &[JobState::Succeeded, JobState::Failed]).await;
    server.running.signal(Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success());
    assert_eq!(attribute(only(&collector.spans(), "submit"), "job"), Some(name));
    assert!(collector.metrics().is_empty(), "metrics are exported only with otlp.metrics");

    let export = [export[0], export[1], ("SCPSFM_OTLP__METRICS", "true")];
    let mut server = Serving::start_with(&at.join("data"), &export, Stdio::null());
    server.running.signal(Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success());
    let exports = collector.metrics();
    let sent = samples(exports.last().expect("an export at the end"));
    assert!(sent["process_resident_memory_bytes"] > 1e6 && sent["scpsfm_workers"] > 0.0, "{sent:?}");
}
