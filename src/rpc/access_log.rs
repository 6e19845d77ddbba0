//! What is written down of calls: each is counted by method and status code, has a line in the access log, and where it
//! is refused one in the log, at most ten a minute for each code.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use tonic::codegen::http::Request;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use super::auth::is_open;
use super::caller::TRACE_PARENT;
use super::keys::Scope::{self, Admin, Ordinary, ReadOnly};
use super::listener::ConnectionInfo;
use crate::telemetry::metrics::{RpcCall, UNKNOWN_METHOD};
use crate::telemetry::throttle::Throttle;
use crate::telemetry::tracing::ACCESS;

/// Every method that this server offers, with the scope that a key needs for it. The path of a request is only looked
/// up here: taken as a label, it would let a client make series without end.
const METHODS: [(&str, Scope); 23] = [
    ("scpsfm.v1.CalibrationService/Solve", Ordinary),
    ("scpsfm.v1.CalibrationService/GetCapabilities", ReadOnly),
    ("scpsfm.v1.JobService/CreateJob", Ordinary),
    ("scpsfm.v1.JobService/BatchCreateJobs", Ordinary),
    ("scpsfm.v1.JobService/GetJob", ReadOnly),
    ("scpsfm.v1.JobService/ListJobs", ReadOnly),
    ("scpsfm.v1.JobService/WatchJob", ReadOnly),
    ("scpsfm.v1.JobService/CancelJob", Ordinary),
    ("scpsfm.v1.JobService/DeleteJob", Ordinary),
    ("scpsfm.v1.JobService/RetryJob", Ordinary),
    ("scpsfm.v1.JobService/SetJobPriority", Ordinary),
    ("scpsfm.v1.JobService/GetJobResult", ReadOnly),
    ("scpsfm.v1.JobService/ReadJobResult", ReadOnly),
    ("scpsfm.v1.InputService/UploadInput", Ordinary),
    ("scpsfm.v1.InputService/GetUploadStatus", ReadOnly),
    ("scpsfm.v1.InputService/ListInputs", ReadOnly),
    ("scpsfm.v1.InputService/DeleteInput", Ordinary),
    ("scpsfm.v1.AdminService/GetQueue", Admin),
    ("scpsfm.v1.AdminService/PauseQueue", Admin),
    ("scpsfm.v1.AdminService/ResumeQueue", Admin),
    ("scpsfm.v1.AdminService/DrainServer", Admin),
    ("grpc.health.v1.Health/Check", ReadOnly),
    ("grpc.health.v1.Health/Watch", ReadOnly),
];

fn find(path: &str) -> Option<(&'static str, Scope)> {
    let name = path.strip_prefix('/').unwrap_or(path);
    METHODS.into_iter().find(|(method, _)| *method == name)
}

fn method_of(path: &str) -> &'static str {
    find(path).map_or(UNKNOWN_METHOD, |(method, _)| method)
}

/// The scope that a key needs for the method at this path. What is not listed is reflection, or is not there, which its
/// caller is told by `UNIMPLEMENTED`.
pub fn scope_of(path: &str) -> Scope {
    find(path).map_or(Scope::ReadOnly, |(_, scope)| scope)
}

/// What is known of a call while it is under way, for whoever writes of it.
#[derive(Debug, Default)]
pub struct CallRecord {
    peer: Option<SocketAddr>,
    trace: Option<String>,
    caller: OnceLock<(String, Option<String>)>,
    received_bytes: AtomicU64,
}

impl CallRecord {
    fn begin<B>(request: &Request<B>) -> Self {
        let trace_parent = request.headers().get(TRACE_PARENT).and_then(|value| value.to_str().ok());
        Self {
            peer: request.extensions().get::<ConnectionInfo>().and_then(ConnectionInfo::peer),
            trace: trace_parent.and_then(trace_id),
            ..Self::default()
        }
    }

    /// Whose call it is, once that is known; `key` is a fingerprint.
    pub fn identify(&self, tenant: &str, key: Option<String>) {
        // A call is identified once.
        let _ = self.caller.set((tenant.to_owned(), key));
    }

    /// So many bytes of the request have come.
    pub fn receive(&self, bytes: u64) {
        self.received_bytes.fetch_add(bytes, Ordering::Relaxed);
    }

    /// Fingerprint of the caller's key.
    pub fn key(&self) -> Option<&str> {
        self.caller.get()?.1.as_deref()
    }

    /// Where the call comes from.
    pub fn peer(&self) -> Option<String> {
        self.peer.map(|peer| peer.to_string())
    }

    fn tenant(&self) -> Option<&str> {
        Some(&self.caller.get()?.0)
    }
}

/// The trace's id in a W3C `traceparent`; nothing else of what a client sent goes into a log.
fn trace_id(trace_parent: &str) -> Option<String> {
    let id = trace_parent.split('-').nth(1)?;
    (id.len() == 32 && id.bytes().all(|byte| byte.is_ascii_hexdigit())).then(|| id.to_owned())
}

/// Codes of calls that are refused for what the caller is or does, not for what the call asks.
const REFUSALS: [Code; 3] = [Code::Unauthenticated, Code::PermissionDenied, Code::ResourceExhausted];

/// Writes refusals down, those of each code apart: callers without a key hide none of a full queue.
#[derive(Debug, Clone, Default)]
pub struct RefusalLog([Throttle; REFUSALS.len()]);

impl RefusalLog {
    /// Writes it down where it is a refusal, and there is room for one more line.
    pub fn log(&self, status: &Status, method: &'static str, record: &CallRecord) {
        let Some(kind) = REFUSALS.into_iter().position(|code| code == status.code()) else { return };
        let code = code_name(status.code());
        if self.0[kind].allows(move |count| tracing::warn!(code, count, "more refusals were left out of the log")) {
            let info = status.get_details_error_info();
            let reason = info.as_ref().map(|info| info.reason.as_str());
            let bound = info.as_ref().and_then(|info| info.metadata.get("bound")).map(String::as_str);
            let (tenant, key, peer) = (record.tenant(), record.key(), record.peer());
            tracing::warn!(code, reason, bound, method, tenant, key, peer, "refused");
        }
    }

    /// The same of a request that is refused before it becomes a call.
    pub fn log_early(&self, status: &Status, connection_info: &ConnectionInfo) {
        let record = CallRecord { peer: connection_info.peer(), ..CallRecord::default() };
        self.log(status, UNKNOWN_METHOD, &record);
    }
}

/// A call that has not ended. Dropped without a status it is one whose client went away.
pub struct OpenCall {
    counted: RpcCall,
    /// Health checks: they would be most of the access log.
    is_open: bool,
    pub record: Arc<CallRecord>,
    refusals: RefusalLog,
    /// Of the answer, so far.
    pub sent_bytes: u64,
}

impl OpenCall {
    pub fn begin<B>(request: &Request<B>, refusals: RefusalLog) -> Self {
        let path = request.uri().path();
        Self {
            counted: RpcCall::begin(method_of(path)),
            is_open: is_open(path),
            record: Arc::new(CallRecord::begin(request)),
            refusals,
            sent_bytes: 0,
        }
    }

    pub fn end(mut self, status: &Status) {
        self.counted.code = code_name(status.code());
        self.refusals.log(status, self.counted.method, &self.record);
    }
}

impl Drop for OpenCall {
    fn drop(&mut self) {
        if self.is_open {
            return;
        }
        let (record, RpcCall { method, code, begun, .. }) = (&self.record, &self.counted);
        tracing::info!(
            target: ACCESS,
            tenant = record.tenant(),
            key = record.key(),
            method,
            code,
            seconds = begun.elapsed().as_secs_f64(),
            received_bytes = record.received_bytes.load(Ordering::Relaxed),
            sent_bytes = self.sent_bytes,
            peer = record.peer(),
            trace = record.trace.as_deref(),
            "call"
        );
    }
}

/// The code's name in the gRPC specification.
pub fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use prost_types::method_options::IdempotencyLevel;

    use super::*;
    use crate::rpc::proto::FILE_DESCRIPTOR_SET;

    #[test]
    fn every_method_of_the_api_is_known() {
        let files = prost_types::FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("decodes");
        let mut count = 0;
        for file in files.file {
            for service in &file.service {
                for method in &service.method {
                    let name = format!("{}.{}/{}", file.package(), service.name(), method.name());
                    assert_eq!(method_of(&format!("/{name}")), name);
                    // Methods whose names begin with these words change nothing.
                    let reads = ["Get", "List", "Watch", "Read"].iter().any(|verb| method.name().starts_with(verb));
                    let level = method.options.as_ref().map_or_else(Default::default, |of| of.idempotency_level());
                    assert_eq!(level == IdempotencyLevel::NoSideEffects, reads, "{name}");
                    let expected = match (service.name(), reads) {
                        ("AdminService", _) => Scope::Admin,
                        (_, true) => Scope::ReadOnly,
                        (_, false) => Scope::Ordinary,
                    };
                    assert_eq!(scope_of(&format!("/{name}")), expected, "{name}");
                    count += 1;
                }
            }
        }
        assert_eq!((count, METHODS.len()), (21, 23), "health has two");
        assert_eq!(method_of("/scpsfm.v1.JobService/Invented"), UNKNOWN_METHOD);
    }
}
