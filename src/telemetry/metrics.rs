//! The only code that changes the metrics of the [`catalogue`].
//!
//! The rest of the program says what happened through the typed functions below. Before [`install`] (and in a
//! command that has no scrape port) they do nothing.

mod catalogue;
mod export;
mod guards;
mod labels;
mod process;
mod tenants;

use std::sync::OnceLock;
use std::time::{Duration, SystemTime};

use metrics::{Recorder, counter, gauge, histogram};
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle};
use metrics_util::layers::FanoutBuilder;
use opentelemetry::metrics::Meter;

use crate::domain::job::{Job, JobState};
use crate::domain::{Grade, Proposal, Stage};

pub use catalogue::*;
pub use guards::{Held, RpcCall, StoreTimer};
pub use labels::{
    AttemptLost, Deletion, GivenUp, HttpRefusal, RateBound, Refusal, Reloaded, UploadRefusal, WebhookAttempt,
};
use labels::{NONE, grade_name};
pub use tenants::tenant_jobs;

/// Installs the process-wide recorder, once; later calls return the same handle and do not use their meter.
///
/// With a `meter`, which [`Export`](super::otlp::Export) has, everything is recorded for it too.
///
/// Everything whose labels are known beforehand exists at 0 from here on, so that the first scrape shows it and the
/// first event is an increase; but for histograms that are exported, which begin with their first sample.
///
/// # Errors
/// When another recorder was installed by someone else.
pub fn install(meter: Option<Meter>) -> Result<PrometheusHandle, InstallError> {
    static HANDLE: OnceLock<Result<PrometheusHandle, InstallError>> = OnceLock::new();
    HANDLE
        .get_or_init(|| {
            let (recorder, handle) = recorder(meter.as_ref()).map_err(|error| InstallError(error.to_string()))?;
            metrics::set_global_recorder(recorder).map_err(|error| InstallError(error.to_string()))?;
            Ok(handle)
        })
        .clone()
}

/// The page that is scraped, as of now.
pub fn page(recorder: &PrometheusHandle) -> String {
    if let Some(usage) = process::Usage::latest() {
        gauge!(PROCESS_MEMORY.name).set(usage.memory_bytes as f64);
        counter!(PROCESS_CPU.name).absolute(usage.cpu_seconds);
        gauge!(PROCESS_FILES.name).set(usage.open_files as f64);
    }
    let mut page = recorder.render();
    page.push_str(&tenants::page());
    page
}

/// The recorder could not be installed.
#[derive(Debug, Clone, thiserror::Error)]
#[error("metrics recorder: {0}")]
pub struct InstallError(String);

/// A recorder that knows every metric, for the page and, where there is a meter, for the export.
fn recorder(meter: Option<&Meter>) -> Result<(Box<dyn Recorder + Sync>, PrometheusHandle), BuildError> {
    let mut builder = PrometheusBuilder::new();
    for metric in ALL {
        if let Kind::Histogram(buckets) = metric.kind {
            builder = builder.set_buckets_for_metric(Matcher::Full(metric.name.into()), buckets)?;
        }
    }
    let recorder = builder.build_recorder();
    let handle = recorder.handle();
    let recorder: Box<dyn Recorder + Sync> = match meter {
        Some(meter) => {
            let exported = export::OtlpRecorder::new(meter);
            Box::new(FanoutBuilder::default().add_recorder(recorder).add_recorder(exported).build())
        }
        None => Box::new(recorder),
    };
    metrics::with_local_recorder(&recorder, || {
        for metric in ALL {
            describe(metric);
        }
        create_known_series();
    });
    Ok((recorder, handle))
}

fn describe(metric: &Metric) {
    match metric.kind {
        Kind::Counter => metrics::describe_counter!(metric.name, metric.help),
        Kind::Gauge => metrics::describe_gauge!(metric.name, metric.help),
        Kind::Histogram(_) => metrics::describe_histogram!(metric.name, metric.help),
    }
}

/// Creates at 0 every series whose labels are known before anything happens. Calls and store operations appear with
/// their first sample.
fn create_known_series() {
    for metric in ALL.iter().filter(|metric| metric.labels.is_empty()) {
        match metric.kind {
            Kind::Counter => counter!(metric.name).absolute(0),
            Kind::Gauge => gauge!(metric.name).set(0.0),
            Kind::Histogram(_) => drop(histogram!(metric.name)),
        }
    }
    for state in JobState::ALL.into_iter().filter(|state| state.is_terminal()) {
        counter!(JOBS.name, "state" => state.name()).absolute(0);
        drop(histogram!(JOB_DURATION.name, "state" => state.name()));
    }
    for stage in Stage::ALL {
        drop(histogram!(STAGE_DURATION.name, "stage" => stage.name(), "state" => JobState::Succeeded.name()));
    }
    for grade in [None, Some(Grade::Metric), Some(Grade::Weak), Some(Grade::ProjectiveOnly)] {
        counter!(GRADES.name, "grade" => grade_name(grade)).absolute(0);
    }
    for proposal in Proposal::ALL {
        counter!(WINNING_PROPOSAL.name, "proposal" => proposal.name()).absolute(0);
    }
    for refusal in Refusal::all() {
        counter!(REFUSALS.name, "reason" => refusal.reason(), "bound" => refusal.bound()).absolute(0);
    }
    for reason in Deletion::ALL {
        counter!(JOBS_DELETED.name, "reason" => reason.name()).absolute(0);
    }
    for operation in FENCED_OPERATIONS {
        counter!(FENCED_WRITES.name, "operation" => operation).absolute(0);
    }
    for reason in GivenUp::ALL {
        counter!(UPLOADS_GIVEN_UP.name, "reason" => reason.name()).absolute(0);
    }
    for refusal in UploadRefusal::ALL {
        counter!(UPLOAD_REFUSALS.name, "reason" => refusal.reason(), "bound" => refusal.bound()).absolute(0);
    }
    for refusal in HttpRefusal::ALL {
        counter!(HTTP_REFUSED.name, "reason" => refusal.name()).absolute(0);
    }
    for files in Reloaded::ALL {
        gauge!(RELOAD_FAILED.name, "files" => files.name()).set(0.0);
    }
    for outcome in WebhookAttempt::ALL {
        counter!(WEBHOOK_ATTEMPTS.name, "outcome" => outcome.name()).absolute(0);
    }
    for reason in AttemptLost::ALL {
        counter!(ATTEMPTS_LOST.name, "reason" => reason.name()).absolute(0);
    }
}

/// Tells the version of this build and the backend that the server computes with.
pub fn build_info(backend: &'static str) {
    gauge!(BUILD_INFO.name, "version" => env!("CARGO_PKG_VERSION"), "backend" => backend).set(1.0);
}

/// Tells how many jobs wait. Call it from one task only, after reading the store: the last call wins.
pub fn queue_depth(jobs: u64) {
    gauge!(QUEUE_DEPTH.name).set(jobs as f64);
}

/// Tells whether the queue is paused.
pub fn queue_paused(paused: bool) {
    gauge!(QUEUE_PAUSED.name).set(f64::from(u8::from(paused)));
}

/// Tells how many jobs may wait, how many threads work, and how many bytes their jobs may take together; once, at the
/// start of the engine.
pub fn engine_size(queue_capacity: u64, workers: usize, solver_bytes: u64) {
    gauge!(QUEUE_CAPACITY.name).set(queue_capacity as f64);
    gauge!(WORKERS.name).set(workers as f64);
    gauge!(SOLVER_CAPACITY.name).set(solver_bytes as f64);
}

/// Tells whether the store answers.
pub fn store_reachable(reachable: bool) {
    gauge!(STORE_REACHABLE.name).set(f64::from(u8::from(reachable)));
}

/// Tells whether the embedded store has no room left to begin anything.
pub fn store_full(full: bool) {
    gauge!(STORE_FULL.name).set(f64::from(u8::from(full)));
}

/// A worker claimed a job that had waited this long.
pub fn queue_wait(waited: Duration) {
    histogram!(QUEUE_WAIT.name).record(waited.as_secs_f64());
}

/// A job was admitted and stored. An idempotent repetition of a request creates nothing and is not counted.
pub fn job_created() {
    counter!(JOBS_CREATED.name).increment(1);
}

/// Ended jobs were removed.
pub fn jobs_deleted(reason: Deletion, count: u32) {
    counter!(JOBS_DELETED.name, "reason" => reason.name()).increment(u64::from(count));
}

/// A job was refused, or, for want of memory or by its rate, a call of any kind.
pub fn refused(refusal: Refusal) {
    counter!(REFUSALS.name, "reason" => refusal.reason(), "bound" => refusal.bound()).increment(1);
}

/// Bytes of an upload were stored.
pub fn uploaded(bytes: u64) {
    counter!(UPLOADED_BYTES.name).increment(bytes);
}

/// An upload became an input.
pub fn input_created() {
    counter!(INPUTS_CREATED.name).increment(1);
}

/// Uploads were given up.
pub fn uploads_given_up(reason: GivenUp, count: u32) {
    counter!(UPLOADS_GIVEN_UP.name, "reason" => reason.name()).increment(u64::from(count));
}

/// An upload was refused.
pub fn upload_refused(refusal: UploadRefusal) {
    counter!(UPLOAD_REFUSALS.name, "reason" => refusal.reason(), "bound" => refusal.bound()).increment(1);
}

/// A request over HTTP was refused before it became a call.
pub fn http_refused(refusal: HttpRefusal) {
    counter!(HTTP_REFUSED.name, "reason" => refusal.name()).increment(1);
}

/// Tells how many webhooks are to be delivered. As [`queue_depth`].
pub fn webhooks_pending(webhooks: u64) {
    gauge!(WEBHOOKS_PENDING.name).set(webhooks as f64);
}

/// An attempt at a webhook ended.
pub fn webhook_attempt(outcome: WebhookAttempt) {
    counter!(WEBHOOK_ATTEMPTS.name, "outcome" => outcome.name()).increment(1);
}

/// A job reached a terminal state, `job.state`; once a job, by whoever committed it.
pub fn job_finished(job: &Job) {
    let state = job.state.name();
    counter!(JOBS.name, "state" => state).increment(1);
    if let (Some(start), Some(end)) = (job.start_time, job.end_time) {
        let seconds = end.duration_since(start).unwrap_or_default().as_secs_f64();
        histogram!(JOB_DURATION.name, "state" => state).record(seconds);
    }
    let Some(summary) = job.summary.as_ref().filter(|_| job.state == JobState::Succeeded) else { return };
    counter!(GRADES.name, "grade" => grade_name(summary.grade)).increment(1);
    histogram!(SOLVE_ITERATIONS.name).record(f64::from(summary.iterations));
    if summary.status == crate::domain::Status::Solved {
        histogram!(INLIER_RATIO.name).record(f64::from(summary.inlier_tracks) / f64::from(job.track_count.max(1)));
    }
    if let Some(proposal) = summary.winning_proposal {
        counter!(WINNING_PROPOSAL.name, "proposal" => proposal.name()).increment(1);
    }
}

/// An attempt spent this long in a stage. `outcome` is the terminal state that the attempt led to, `None` where it
/// ended without ending the job.
pub fn stage_finished(stage: Stage, outcome: Option<JobState>, spent: Duration) {
    let state = outcome.map_or(NONE, JobState::name);
    histogram!(STAGE_DURATION.name, "stage" => stage.name(), "state" => state).record(spent.as_secs_f64());
}

/// An attempt ended without ending its job.
pub fn attempt_lost(reason: AttemptLost) {
    counter!(ATTEMPTS_LOST.name, "reason" => reason.name()).increment(1);
}

/// A worker is busy until the guard is dropped.
pub fn busy_worker() -> Held {
    Held::new(gauge!(WORKERS_BUSY.name))
}

/// A job takes so many bytes until the guard is dropped.
pub fn solver_bytes(bytes: u64) -> Held {
    Held::by(gauge!(SOLVER_BYTES.name), bytes as f64)
}

/// A stream follows a job until the guard is dropped.
pub fn watcher() -> Held {
    Held::new(gauge!(WATCHERS.name))
}

/// A connection speaks until the guard is dropped.
pub fn connection() -> Held {
    Held::new(gauge!(CONNECTIONS.name))
}

/// A connection was refused for want of room.
pub fn connection_refused() {
    counter!(CONNECTIONS_REFUSED.name).increment(1);
}

/// A connection was closed because nobody who may call had called over it in time.
pub fn unauthenticated_closed() {
    counter!(UNAUTHENTICATED_CLOSED.name).increment(1);
}

/// Tells how many bytes calls hold.
pub fn inflight_bytes(bytes: u64) {
    gauge!(INFLIGHT_BYTES.name).set(bytes as f64);
}

/// Tells how many bytes calls may hold together; once, at the start of the server.
pub fn inflight_capacity(bytes: u64) {
    gauge!(INFLIGHT_CAPACITY.name).set(bytes as f64);
}

/// Tells how long the oldest waiting job has waited.
pub fn queue_oldest(age: Duration) {
    gauge!(QUEUE_OLDEST.name).set(age.as_secs_f64());
}

/// Tells how many bytes the store takes.
pub fn store_bytes(bytes: u64) {
    gauge!(STORE_BYTES.name).set(bytes as f64);
}

/// Tells when the server's certificate expires.
pub fn certificate_end(end: SystemTime) {
    gauge!(CERTIFICATE_END.name).set(end.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs_f64());
}

/// Tells whether files that changed cannot be used.
pub fn reload_failed(files: Reloaded, failed: bool) {
    gauge!(RELOAD_FAILED.name, "files" => files.name()).set(f64::from(u8::from(failed)));
}

/// Tells whether calls need a key and there is none.
pub fn locked_out(locked_out: bool) {
    gauge!(LOCKED_OUT.name).set(f64::from(u8::from(locked_out)));
}

/// Method label of a call to something that this server does not offer.
pub const UNKNOWN_METHOD: &str = "unknown";

/// What a worker writes, under the lease on its job.
const FENCED_OPERATIONS: [&str; 4] = ["heartbeat", "record", "finish", "release"];

/// The store refused a write of a worker whose lease was gone; `operation` is its name in the metrics.
pub fn write_fenced(operation: &'static str) {
    counter!(FENCED_WRITES.name, "operation" => operation).increment(1);
}

/// A store operation begins; `operation` is its name in the metrics.
pub fn store_operation(operation: &'static str) -> StoreTimer {
    StoreTimer::begin(operation)
}

/// So many operations were committed together.
pub fn store_commit(operations: usize) {
    histogram!(STORE_COMMIT_OPERATIONS.name).record(operations as f64);
}

#[cfg(test)]
pub(crate) mod tests;
