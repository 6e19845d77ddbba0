//! Every metric's name, help, labels and buckets, and the only functions that touch them.
//!
//! The rest of the program says what happened through the typed functions below. Before [`install`] (and in a
//! command that has no scrape port) they do nothing.

use std::sync::OnceLock;
use std::time::{Duration, Instant};

use metrics::{counter, gauge, histogram};
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle, PrometheusRecorder};

use crate::domain::job::{Job, JobState};
use crate::domain::{Grade, Prior, Stage};

/// How a metric's values are read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    /// Only grows; 0 at the start of the process.
    Counter,
    /// Goes up and down.
    Gauge,
    /// Counts below each of these upper bounds.
    Histogram(&'static [f64]),
}

/// One metric, as it stands on `/metrics`.
#[derive(Debug, Clone, Copy)]
pub struct Metric {
    /// Name in Prometheus' convention: base units, counters end in `_total`.
    pub name: &'static str,
    pub kind: Kind,
    /// Names of its labels.
    pub labels: &'static [&'static str],
    pub help: &'static str,
}

/// Seconds a job waits or runs: from 50 ms (a queue that is empty) to ten minutes (a deadline some will set).
const JOB_SECONDS: Kind =
    Kind::Histogram(&[0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 13.0, 30.0, 60.0, 120.0, 300.0, 600.0]);

/// Seconds of one stage: `prepare` and `judge` take milliseconds, `search` most of a job.
const STAGE_SECONDS: Kind =
    Kind::Histogram(&[0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 30.0, 60.0, 300.0]);

/// Seconds of a call: a point read takes about 1 ms, a watch lives as long as its job.
const RPC_SECONDS: Kind = Kind::Histogram(&[0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0]);

/// Seconds of a store operation: a synced commit takes 1 to 20 ms on ordinary disks; a second is trouble.
const STORE_SECONDS: Kind = Kind::Histogram(&[0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0]);

/// Share of the tracks that are inliers, in tenths; below a tenth the search is hard, so it is cut once more.
const RATIO: Kind = Kind::Histogram(&[0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]);

/// Network iterations: the floor of 50, the default of 400, the cap of 10,000.
const ITERATIONS: Kind = Kind::Histogram(&[0.0, 50.0, 100.0, 150.0, 200.0, 300.0, 400.0, 800.0, 2_000.0, 10_000.0]);

pub const BUILD_INFO: Metric = Metric {
    name: "scpsfm_build_info",
    kind: Kind::Gauge,
    labels: &["version", "backend"],
    help: "Always 1; the labels tell the build's version and the server's compute backend.",
};
pub const QUEUE_DEPTH: Metric = Metric {
    name: "scpsfm_queue_depth",
    kind: Kind::Gauge,
    labels: &[],
    help: "Jobs that are stored and wait for a worker.",
};
pub const QUEUE_CAPACITY: Metric = Metric {
    name: "scpsfm_queue_capacity",
    kind: Kind::Gauge,
    labels: &[],
    help: "Waiting jobs at which new ones are refused.",
};
pub const QUEUE_WAIT: Metric = Metric {
    name: "scpsfm_queue_wait_seconds",
    kind: JOB_SECONDS,
    labels: &[],
    help: "Seconds from a job's entry into the queue to the claim of a worker.",
};
pub const WORKERS: Metric =
    Metric { name: "scpsfm_workers", kind: Kind::Gauge, labels: &[], help: "Worker threads of this process." };
pub const WORKERS_BUSY: Metric =
    Metric { name: "scpsfm_workers_busy", kind: Kind::Gauge, labels: &[], help: "Worker threads that run a job." };
pub const JOBS: Metric = Metric {
    name: "scpsfm_jobs_total",
    kind: Kind::Counter,
    labels: &["state"],
    help: "Jobs that ended, by terminal state.",
};
pub const JOBS_CREATED: Metric = Metric {
    name: "scpsfm_jobs_created_total",
    kind: Kind::Counter,
    labels: &[],
    help: "Jobs that were admitted and stored.",
};
pub const JOB_DURATION: Metric = Metric {
    name: "scpsfm_job_duration_seconds",
    kind: JOB_SECONDS,
    labels: &["state"],
    help: "Seconds from the start of a job's first attempt to its end, by terminal state.",
};
pub const STAGE_DURATION: Metric = Metric {
    name: "scpsfm_stage_duration_seconds",
    kind: STAGE_SECONDS,
    labels: &["stage", "state"],
    help: "Seconds that an attempt spent in a stage of the solver, by how the attempt ended.",
};
pub const ATTEMPTS_LOST: Metric = Metric {
    name: "scpsfm_attempts_lost_total",
    kind: Kind::Counter,
    labels: &["reason"],
    help: "Attempts that ended without ending their job: given back at a drain, lease lost, or crashed.",
};
pub const GRADES: Metric = Metric {
    name: "scpsfm_results_total",
    kind: Kind::Counter,
    labels: &["grade"],
    help: "Results of succeeded jobs by grade; NONE is a result without a reconstruction.",
};
pub const INLIER_RATIO: Metric = Metric {
    name: "scpsfm_inlier_ratio",
    kind: RATIO,
    labels: &[],
    help: "Inlier tracks as a share of all tracks, one sample a solved job.",
};
pub const SOLVE_ITERATIONS: Metric = Metric {
    name: "scpsfm_solve_iterations",
    kind: ITERATIONS,
    labels: &[],
    help: "Network iterations spent, one sample a succeeded job.",
};
pub const WINNING_PRIOR: Metric = Metric {
    name: "scpsfm_winning_prior_total",
    kind: Kind::Counter,
    labels: &["prior"],
    help: "Solved jobs by the prior whose sample led to the accepted consensus.",
};
pub const REFUSALS: Metric = Metric {
    name: "scpsfm_admission_refusals_total",
    kind: Kind::Counter,
    labels: &["reason", "bound"],
    help: "Jobs refused before anything was stored, by reason; of QUEUE_FULL, by the bound that was hit.",
};
pub const RPC_REQUESTS: Metric = Metric {
    name: "scpsfm_grpc_requests_total",
    kind: Kind::Counter,
    labels: &["method", "code"],
    help: "gRPC calls that ended, by method and status code.",
};
pub const RPC_DURATION: Metric = Metric {
    name: "scpsfm_grpc_request_duration_seconds",
    kind: RPC_SECONDS,
    labels: &["method", "code"],
    help: "Seconds from a gRPC call's first byte to its status, by method and status code.",
};
pub const RPC_IN_FLIGHT: Metric = Metric {
    name: "scpsfm_grpc_requests_in_flight",
    kind: Kind::Gauge,
    labels: &[],
    help: "gRPC calls that have begun and not ended.",
};
pub const STORE_DURATION: Metric = Metric {
    name: "scpsfm_store_operation_duration_seconds",
    kind: STORE_SECONDS,
    labels: &["operation"],
    help: "Seconds of a store operation, by operation.",
};
pub const WATCHERS: Metric = Metric {
    name: "scpsfm_watchers",
    kind: Kind::Gauge,
    labels: &[],
    help: "Streams that follow a job (WatchJob and Solve).",
};

/// Every metric that this program exposes.
pub const ALL: [Metric; 21] = [
    BUILD_INFO,
    QUEUE_DEPTH,
    QUEUE_CAPACITY,
    QUEUE_WAIT,
    WORKERS,
    WORKERS_BUSY,
    JOBS,
    JOBS_CREATED,
    JOB_DURATION,
    STAGE_DURATION,
    ATTEMPTS_LOST,
    GRADES,
    INLIER_RATIO,
    SOLVE_ITERATIONS,
    WINNING_PRIOR,
    REFUSALS,
    RPC_REQUESTS,
    RPC_DURATION,
    RPC_IN_FLIGHT,
    STORE_DURATION,
    WATCHERS,
];

/// Why a job was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// The queue holds as many jobs as it may.
    QueueJobs,
    /// The queue holds as many bytes of inputs as it may.
    QueueBytes,
    /// The queue holds as many observations as it may.
    QueueObservations,
    /// Input or settings broke a rule.
    Invalid,
    /// The input is above the advertised limits.
    TooLarge,
    /// The server is draining.
    Draining,
}

impl Refusal {
    const ALL: [Refusal; 6] = [
        Refusal::QueueJobs,
        Refusal::QueueBytes,
        Refusal::QueueObservations,
        Refusal::Invalid,
        Refusal::TooLarge,
        Refusal::Draining,
    ];

    fn reason(self) -> &'static str {
        match self {
            Refusal::QueueJobs | Refusal::QueueBytes | Refusal::QueueObservations => "QUEUE_FULL",
            Refusal::Invalid => "INVALID",
            Refusal::TooLarge => "TOO_LARGE",
            Refusal::Draining => "DRAINING",
        }
    }

    /// The bound of the queue that was hit; `NONE` where it was no bound.
    pub fn bound(self) -> &'static str {
        match self {
            Refusal::QueueJobs => "jobs",
            Refusal::QueueBytes => "bytes",
            Refusal::QueueObservations => "observations",
            Refusal::Invalid | Refusal::TooLarge | Refusal::Draining => NONE,
        }
    }
}

/// How an attempt ended that did not end its job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttemptLost {
    /// Given back to the queue at a drain.
    GivenBack,
    /// Another worker took the lease over; the outcome was dropped.
    Fenced,
    /// The lease ran out without a heartbeat: the process that held it died.
    LeaseExpired,
}

impl AttemptLost {
    const ALL: [AttemptLost; 3] = [AttemptLost::GivenBack, AttemptLost::Fenced, AttemptLost::LeaseExpired];

    fn name(self) -> &'static str {
        match self {
            AttemptLost::GivenBack => "GIVEN_BACK",
            AttemptLost::Fenced => "FENCED",
            AttemptLost::LeaseExpired => "LEASE_EXPIRED",
        }
    }
}

/// Label of a succeeded job without a reconstruction, of an attempt that ended no job, and of a refusal by no bound.
const NONE: &str = "NONE";

/// Installs the process-wide recorder, once; later calls return the same handle.
///
/// Everything whose labels are known beforehand exists at 0 from here on, so that the first scrape shows it and the
/// first event is an increase.
///
/// # Errors
/// When another recorder was installed by someone else.
pub fn install() -> Result<PrometheusHandle, InstallError> {
    static HANDLE: OnceLock<Result<PrometheusHandle, InstallError>> = OnceLock::new();
    HANDLE
        .get_or_init(|| {
            let recorder = recorder().map_err(|error| InstallError(error.to_string()))?;
            let handle = recorder.handle();
            metrics::set_global_recorder(recorder).map_err(|error| InstallError(error.to_string()))?;
            Ok(handle)
        })
        .clone()
}

/// The recorder could not be installed.
#[derive(Debug, Clone, thiserror::Error)]
#[error("metrics recorder: {0}")]
pub struct InstallError(String);

/// A recorder that knows every metric.
fn recorder() -> Result<PrometheusRecorder, BuildError> {
    let mut builder = PrometheusBuilder::new();
    for metric in ALL {
        if let Kind::Histogram(buckets) = metric.kind {
            builder = builder.set_buckets_for_metric(Matcher::Full(metric.name.into()), buckets)?;
        }
    }
    let recorder = builder.build_recorder();
    metrics::with_local_recorder(&recorder, || {
        for metric in ALL {
            describe(&metric);
        }
        create_known_series();
    });
    Ok(recorder)
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
    for prior in Prior::ALL {
        counter!(WINNING_PRIOR.name, "prior" => prior.name()).absolute(0);
    }
    for refusal in Refusal::ALL {
        counter!(REFUSALS.name, "reason" => refusal.reason(), "bound" => refusal.bound()).absolute(0);
    }
    for reason in AttemptLost::ALL {
        counter!(ATTEMPTS_LOST.name, "reason" => reason.name()).absolute(0);
    }
}

fn grade_name(grade: Option<Grade>) -> &'static str {
    match grade {
        Some(Grade::Metric) => "METRIC",
        Some(Grade::Weak) => "WEAK",
        Some(Grade::ProjectiveOnly) => "PROJECTIVE_ONLY",
        None => NONE,
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

/// Tells how many jobs may wait and how many threads work; once, at the start of the engine.
pub fn engine_size(queue_capacity: u64, workers: usize) {
    gauge!(QUEUE_CAPACITY.name).set(queue_capacity as f64);
    gauge!(WORKERS.name).set(workers as f64);
}

/// A worker claimed a job that had waited this long.
pub fn queue_wait(waited: Duration) {
    histogram!(QUEUE_WAIT.name).record(waited.as_secs_f64());
}

/// A job was admitted and stored. An idempotent repetition of a request creates nothing and is not counted.
pub fn job_created() {
    counter!(JOBS_CREATED.name).increment(1);
}

/// A job was refused.
pub fn refused(refusal: Refusal) {
    counter!(REFUSALS.name, "reason" => refusal.reason(), "bound" => refusal.bound()).increment(1);
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
    if let Some(prior) = summary.winning_prior {
        counter!(WINNING_PRIOR.name, "prior" => prior.name()).increment(1);
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

/// Holds a gauge one higher for as long as it lives, whatever way its scope is left.
#[must_use = "the gauge falls when this is dropped"]
#[derive(Debug)]
pub struct Held(metrics::Gauge);

impl Held {
    fn new(gauge: metrics::Gauge) -> Self {
        gauge.increment(1.0);
        Self(gauge)
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}

/// A worker is busy until the guard is dropped.
pub fn busy_worker() -> Held {
    Held::new(gauge!(WORKERS_BUSY.name))
}

/// A stream follows a job until the guard is dropped.
pub fn watcher() -> Held {
    Held::new(gauge!(WATCHERS.name))
}

/// A gRPC call that has begun. Dropping it without a code counts it as `CANCELLED`: the client went away.
#[must_use = "the call ends when this is dropped"]
pub struct RpcCall {
    method: &'static str,
    begun: Instant,
    code: &'static str,
    _in_flight: Held,
}

impl RpcCall {
    /// A call begins. `method` is `package.Service/Method`, taken from a list that this server knows: the path that
    /// a client sent would let it create series without end.
    pub fn begin(method: &'static str) -> Self {
        Self { method, begun: Instant::now(), code: "CANCELLED", _in_flight: Held::new(gauge!(RPC_IN_FLIGHT.name)) }
    }

    /// The call ended with this status code (`OK`, `NOT_FOUND`, ...).
    pub fn finish(mut self, code: &'static str) {
        self.code = code;
    }
}

impl Drop for RpcCall {
    fn drop(&mut self) {
        let seconds = self.begun.elapsed().as_secs_f64();
        counter!(RPC_REQUESTS.name, "method" => self.method, "code" => self.code).increment(1);
        histogram!(RPC_DURATION.name, "method" => self.method, "code" => self.code).record(seconds);
    }
}

/// Method label of a call to something that this server does not offer.
pub const UNKNOWN_METHOD: &str = "unknown";

/// Times a store operation from its creation to its drop.
#[must_use = "the operation ends when this is dropped"]
pub struct StoreTimer {
    operation: &'static str,
    begun: Instant,
}

/// A store operation begins; `operation` is the name of the trait's method.
pub fn store_operation(operation: &'static str) -> StoreTimer {
    StoreTimer { operation, begun: Instant::now() }
}

impl Drop for StoreTimer {
    fn drop(&mut self) {
        histogram!(STORE_DURATION.name, "operation" => self.operation).record(self.begun.elapsed().as_secs_f64());
    }
}

#[cfg(test)]
mod tests;
