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
use super::listener::ConnectionInfo;
use super::methods::method_of;
use crate::telemetry::metrics::{RpcCall, UNKNOWN_METHOD};
use crate::telemetry::throttle::Throttle;
use crate::telemetry::tracing::{ACCESS, REFUSED};

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

/// Codes of calls that are refused for what the caller is or does, or for the size of a message.
const REFUSALS: [Code; 4] = [Code::Unauthenticated, Code::PermissionDenied, Code::ResourceExhausted, Code::OutOfRange];

/// Writes refusals down, those of each code apart: callers without a key hide none of a full queue.
#[derive(Debug, Clone, Default)]
pub struct RefusalLog([Throttle; REFUSALS.len()]);

impl RefusalLog {
    /// Writes it down where it is a refusal, and there is room for one more line.
    pub fn log(&self, status: &Status, method: &'static str, record: &CallRecord) {
        let Some(kind) = REFUSALS.into_iter().position(|code| code == status.code()) else { return };
        let code = code_name(status.code());
        if self.0[kind]
            .allows(move |count| tracing::warn!(target: REFUSED, code, count, "more refusals were left out of the log"))
        {
            let info = status.get_details_error_info();
            let reason = info.as_ref().map(|info| info.reason.as_str());
            let bound = info.as_ref().and_then(|info| info.metadata.get("bound")).map(String::as_str);
            let (tenant, key, peer) = (record.tenant(), record.key(), record.peer());
            tracing::warn!(target: REFUSED, code, reason, bound, method, tenant, key, peer, "refused");
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
