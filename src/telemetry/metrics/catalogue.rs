//! Every metric's name, help, labels and buckets.

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

/// Seconds of one stage: `prepare` and `classify` take milliseconds, `search` most of a job.
const STAGE_SECONDS: Kind =
    Kind::Histogram(&[0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 30.0, 60.0, 300.0]);

/// Seconds of a call: a point read takes about 1 ms, a watch lives as long as its job.
const RPC_SECONDS: Kind = Kind::Histogram(&[0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0]);

/// Seconds of a store operation: a synced commit takes 1 to 20 ms on ordinary disks; a second is trouble.
const STORE_SECONDS: Kind = Kind::Histogram(&[0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0]);

/// Operations of a commit: one where nothing else waits, some tens where many callers wait for a slow disk.
const COMMIT_OPERATIONS: Kind = Kind::Histogram(&[1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0]);

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
pub const QUEUE_PAUSED: Metric = Metric {
    name: "scpsfm_queue_paused",
    kind: Kind::Gauge,
    labels: &[],
    help: "1 while the queue is paused: no server of the store begins a job.",
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
pub const SOLVER_BYTES: Metric = Metric {
    name: "scpsfm_solver_bytes",
    kind: Kind::Gauge,
    labels: &[],
    help: "Bytes of memory that the jobs in this process are estimated to take: those that run and those that are to run next.",
};
pub const SOLVER_CAPACITY: Metric = Metric {
    name: "scpsfm_solver_capacity_bytes",
    kind: Kind::Gauge,
    labels: &[],
    help: "Bytes that they may take together; a job that would take more waits for others to end.",
};
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
pub const JOBS_DELETED: Metric = Metric {
    name: "scpsfm_jobs_deleted_total",
    kind: Kind::Counter,
    labels: &["reason"],
    help: "Ended jobs that were removed: asked for by their owner, or kept long enough.",
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
pub const WINNING_PROPOSAL: Metric = Metric {
    name: "scpsfm_winning_proposal_total",
    kind: Kind::Counter,
    labels: &["proposal"],
    help: "Solved jobs by the proposal whose sample led to the accepted consensus.",
};
pub const REFUSALS: Metric = Metric {
    name: "scpsfm_admission_refusals_total",
    kind: Kind::Counter,
    labels: &["reason", "bound"],
    help: "Jobs refused before anything was stored, by reason; of QUEUE_FULL, BATCH_TOO_LARGE and JOB_TOO_LARGE, by the bound that was hit. MEMORY and RATE_LIMITED count calls of every kind.",
};
pub const UPLOADED_BYTES: Metric = Metric {
    name: "scpsfm_uploaded_bytes_total",
    kind: Kind::Counter,
    labels: &[],
    help: "Bytes of uploads that were stored.",
};
pub const INPUTS_CREATED: Metric = Metric {
    name: "scpsfm_inputs_created_total",
    kind: Kind::Counter,
    labels: &[],
    help: "Uploads that became an input.",
};
pub const UPLOADS_GIVEN_UP: Metric = Metric {
    name: "scpsfm_uploads_given_up_total",
    kind: Kind::Counter,
    labels: &["reason"],
    help: "Uploads that were given up: nobody went on with them, their hash was wrong, or they were no valid input.",
};
pub const UPLOAD_REFUSALS: Metric = Metric {
    name: "scpsfm_upload_refusals_total",
    kind: Kind::Counter,
    labels: &["reason", "bound"],
    help: "Uploads refused before anything was stored, by reason and by the bound that was hit.",
};
pub const WEBHOOKS_PENDING: Metric = Metric {
    name: "scpsfm_webhooks_pending",
    kind: Kind::Gauge,
    labels: &[],
    help: "Ended jobs whose webhook was neither delivered nor given up.",
};
pub const WEBHOOK_ATTEMPTS: Metric = Metric {
    name: "scpsfm_webhook_attempts_total",
    kind: Kind::Counter,
    labels: &["outcome"],
    help: "Attempts at a webhook: delivered, failed and made again, or failed as the last one.",
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
pub const HTTP_REFUSED: Metric = Metric {
    name: "scpsfm_http_refused_total",
    kind: Kind::Counter,
    labels: &["reason"],
    help: "HTTP requests refused before they became a call, by reason; what calls refuse is counted with the calls.",
};
pub const STORE_DURATION: Metric = Metric {
    name: "scpsfm_store_operation_duration_seconds",
    kind: STORE_SECONDS,
    labels: &["operation"],
    help: "Seconds of a store operation, by operation.",
};
pub const STORE_COMMIT_OPERATIONS: Metric = Metric {
    name: "scpsfm_store_commit_operations",
    kind: COMMIT_OPERATIONS,
    labels: &[],
    help: "Operations that the embedded store committed together, one sample a commit.",
};
pub const STORE_REACHABLE: Metric = Metric {
    name: "scpsfm_store_reachable",
    kind: Kind::Gauge,
    labels: &[],
    help: "1 while the store answers; at 0 the server is not ready.",
};
pub const STORE_FULL: Metric = Metric {
    name: "scpsfm_store_full",
    kind: Kind::Gauge,
    labels: &[],
    help: "1 while the embedded store's disk is full: jobs are neither taken in nor begun.",
};
pub const FENCED_WRITES: Metric = Metric {
    name: "scpsfm_fenced_writes_total",
    kind: Kind::Counter,
    labels: &["operation"],
    help: "Writes of a worker that the store refused because its lease had been taken over, by operation.",
};
pub const WATCHERS: Metric = Metric {
    name: "scpsfm_watchers",
    kind: Kind::Gauge,
    labels: &[],
    help: "Streams that follow a job (WatchJob and Solve).",
};
pub const CONNECTIONS: Metric =
    Metric { name: "scpsfm_connections", kind: Kind::Gauge, labels: &[], help: "Connections that speak gRPC." };
pub const CONNECTIONS_REFUSED: Metric = Metric {
    name: "scpsfm_connections_refused_total",
    kind: Kind::Counter,
    labels: &[],
    help: "Connections refused because as many speak as may.",
};
pub const UNAUTHENTICATED_CLOSED: Metric = Metric {
    name: "scpsfm_unauthenticated_connections_closed_total",
    kind: Kind::Counter,
    labels: &[],
    help: "Connections closed because nobody who may call had called over them in time.",
};

pub const INFLIGHT_BYTES: Metric = Metric {
    name: "scpsfm_inflight_bytes",
    kind: Kind::Gauge,
    labels: &[],
    help: "Bytes that calls hold: messages and inputs on their way in, results on their way out.",
};
pub const INFLIGHT_CAPACITY: Metric = Metric {
    name: "scpsfm_inflight_capacity_bytes",
    kind: Kind::Gauge,
    labels: &[],
    help: "Bytes that calls may hold together; a call that would hold more is refused.",
};
pub const QUEUE_OLDEST: Metric = Metric {
    name: "scpsfm_queue_oldest_seconds",
    kind: Kind::Gauge,
    labels: &[],
    help: "Seconds that the oldest waiting job has waited; 0 where none waits.",
};
pub const TENANT_JOBS: Metric = Metric {
    name: "scpsfm_tenant_jobs",
    kind: Kind::Gauge,
    labels: &["tenant", "state"],
    help: "Jobs that wait and run, of the 20 tenants that have most; those of all others are one, OTHER.",
};
pub const STORE_BYTES: Metric = Metric {
    name: "scpsfm_store_bytes",
    kind: Kind::Gauge,
    labels: &[],
    help: "Bytes of the store: the embedded database's files, or the PostgreSQL database.",
};
pub const CERTIFICATE_END: Metric = Metric {
    name: "scpsfm_certificate_end_timestamp_seconds",
    kind: Kind::Gauge,
    labels: &[],
    help: "When the server's certificate expires, in seconds since the Unix epoch; 0 without TLS.",
};
pub const PROCESS_MEMORY: Metric = Metric {
    name: "process_resident_memory_bytes",
    kind: Kind::Gauge,
    labels: &[],
    help: "Memory that the process has in use. 0 where the system does not tell.",
};
pub const PROCESS_CPU: Metric = Metric {
    name: "process_cpu_seconds_total",
    kind: Kind::Counter,
    labels: &[],
    help: "Processor time that the process has spent, in whole seconds.",
};
pub const PROCESS_FILES: Metric = Metric {
    name: "process_open_fds",
    kind: Kind::Gauge,
    labels: &[],
    help: "Open file descriptors, connections among them.",
};
pub const RELOAD_FAILED: Metric = Metric {
    name: "scpsfm_reload_failed",
    kind: Kind::Gauge,
    labels: &["files"],
    help: "1 while changed files of certificates or keys cannot be used and the old ones stay in force.",
};
pub const LOCKED_OUT: Metric = Metric {
    name: "scpsfm_locked_out",
    kind: Kind::Gauge,
    labels: &[],
    help: "1 while calls need an API key and there is none: every call is refused.",
};

/// Every metric that this program exposes.
pub const ALL: &[Metric] = &[
    BUILD_INFO,
    QUEUE_DEPTH,
    QUEUE_CAPACITY,
    QUEUE_PAUSED,
    QUEUE_WAIT,
    WORKERS,
    WORKERS_BUSY,
    SOLVER_BYTES,
    SOLVER_CAPACITY,
    JOBS,
    JOBS_CREATED,
    JOBS_DELETED,
    JOB_DURATION,
    STAGE_DURATION,
    ATTEMPTS_LOST,
    GRADES,
    INLIER_RATIO,
    SOLVE_ITERATIONS,
    WINNING_PROPOSAL,
    REFUSALS,
    UPLOADED_BYTES,
    INPUTS_CREATED,
    UPLOADS_GIVEN_UP,
    UPLOAD_REFUSALS,
    WEBHOOKS_PENDING,
    WEBHOOK_ATTEMPTS,
    RPC_REQUESTS,
    RPC_DURATION,
    RPC_IN_FLIGHT,
    HTTP_REFUSED,
    STORE_DURATION,
    STORE_COMMIT_OPERATIONS,
    STORE_REACHABLE,
    STORE_FULL,
    FENCED_WRITES,
    WATCHERS,
    CONNECTIONS,
    CONNECTIONS_REFUSED,
    UNAUTHENTICATED_CLOSED,
    INFLIGHT_BYTES,
    INFLIGHT_CAPACITY,
    RELOAD_FAILED,
    LOCKED_OUT,
    QUEUE_OLDEST,
    TENANT_JOBS,
    STORE_BYTES,
    CERTIFICATE_END,
    PROCESS_MEMORY,
    PROCESS_CPU,
    PROCESS_FILES,
];
