//! Answers: JSON, server-sent events, and errors in google.rpc's JSON form.

use std::convert::Infallible;
use std::time::Duration;

use axum::body::Body;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, Stream, StreamExt};
use http_body_util::BodyExt;
use prost::bytes::Bytes;
use prost_reflect::{DynamicMessage, MessageDescriptor};
use serde_json::{Map, Value, json};
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt;

use crate::rpc::access_log::code_name;
use crate::rpc::inflight::Permit;
use crate::rpc::status;
use crate::telemetry::metrics::{HttpRefusal, http_refused};

/// An answer to a request.
pub type Answer = Response<Body>;

/// Field of an event that numbers it, for `Last-Event-ID`.
const SEQUENCE: &str = "sequence";

/// Field group of an event that tells what it is.
const BODY: &str = "body";

/// Pause after which a comment tells that a silent stream lives: below what proxies usually wait.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// A message as JSON.
///
/// # Errors
/// `INTERNAL` for bytes that are no such message: a defect of ours.
pub fn message(descriptor: &MessageDescriptor, bytes: &[u8]) -> Result<Vec<u8>, Status> {
    let internal = |error: String| Status::internal(format!("an answer cannot be encoded as JSON: {error}"));
    let message = DynamicMessage::decode(descriptor.clone(), bytes).map_err(|error| internal(error.to_string()))?;
    serde_json::to_vec(&message).map_err(|error| internal(error.to_string()))
}

/// An answer of that JSON; the permit is held until it is read.
pub fn json(text: Vec<u8>, permit: Permit) -> Answer {
    let body = Body::new(Body::from(text).map_err(move |error| {
        // Held until the body is read: a reader that is slow holds it, too.
        let _held = &permit;
        error
    }));
    secured((StatusCode::OK, [(header::CONTENT_TYPE, "application/json")], body).into_response())
}

/// A stream of messages as server-sent events; each has its number as id, and a stream that breaks off ends with an
/// event `status`.
pub fn events(descriptor: MessageDescriptor, messages: Streaming<Bytes>) -> Answer {
    let events = stream::unfold(Some(messages), move |messages| {
        let descriptor = descriptor.clone();
        async move {
            let mut messages = messages?;
            let (event, rest) = match messages.message().await {
                Ok(None) => return None,
                Ok(Some(bytes)) => match event(&descriptor, &bytes) {
                    Ok(event) => (event, Some(messages)),
                    Err(status) => (failed(&status), None),
                },
                Err(status) => (failed(&status), None),
            };
            Some((Ok::<_, Infallible>(event), rest))
        }
    });
    sse(events)
}

fn sse(events: impl Stream<Item = Result<Event, Infallible>> + Send + 'static) -> Answer {
    let mut answer = Sse::new(events.boxed()).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)).into_response();
    // Some proxies buffer the response otherwise.
    answer.headers_mut().insert("x-accel-buffering", HeaderValue::from_static("no"));
    secured(answer)
}

fn event(descriptor: &MessageDescriptor, bytes: &[u8]) -> Result<Event, Status> {
    let internal = |error: String| Status::internal(format!("an event cannot be encoded as JSON: {error}"));
    let message = DynamicMessage::decode(descriptor.clone(), bytes).map_err(|error| internal(error.to_string()))?;
    let text = serde_json::to_string(&message).map_err(|error| internal(error.to_string()))?;
    let mut event = Event::default().data(text);
    let body = descriptor.oneofs().find(|group| group.name() == BODY);
    if let Some(kind) = body.and_then(|group| group.fields().find(|field| message.has_field(field))) {
        event = event.event(kind.json_name());
    }
    // What has no number is not told again.
    match message.get_field_by_name(SEQUENCE).and_then(|number| number.as_u64()) {
        Some(number) if number > 0 => Ok(event.id(number.to_string())),
        _ => Ok(event),
    }
}

fn failed(status: &Status) -> Event {
    Event::default().event("status").data(error_body(status, http_code(status.code())).to_string())
}

/// That there is nothing to tell and never will be: a browser's `EventSource` does not ask again.
pub fn nothing_more() -> Answer {
    secured(StatusCode::NO_CONTENT.into_response())
}

/// A refusal by a call.
pub fn error(status: &Status) -> Answer {
    refused(http_code(status.code()), status)
}

/// A refusal before any call, which is counted here: those of calls are counted with them.
pub fn uncalled(refusal: HttpRefusal, status: &Status) -> Box<Answer> {
    http_refused(refusal);
    let code = match refusal {
        HttpRefusal::Method => StatusCode::METHOD_NOT_ALLOWED,
        HttpRefusal::MediaType => StatusCode::UNSUPPORTED_MEDIA_TYPE,
        HttpRefusal::Length => StatusCode::LENGTH_REQUIRED,
        HttpRefusal::TooLarge => StatusCode::PAYLOAD_TOO_LARGE,
        _ => http_code(status.code()),
    };
    Box::new(refused(code, status))
}

/// A refusal before any call, of a kind that gRPC does not have.
pub fn refuse(refusal: HttpRefusal, text: impl Into<String>) -> Box<Answer> {
    uncalled(refusal, &status_of(refusal, text))
}

/// The status of such a refusal.
pub fn status_of(refusal: HttpRefusal, text: impl Into<String>) -> Status {
    let code = match refusal {
        HttpRefusal::Origin | HttpRefusal::Host => Code::PermissionDenied,
        HttpRefusal::Path => Code::NotFound,
        HttpRefusal::Method => Code::Unimplemented,
        HttpRefusal::TooLarge => Code::OutOfRange,
        _ => Code::InvalidArgument,
    };
    status::refused(code, refusal.name(), text)
}

/// A refusal with this code of HTTP.
pub fn refused(code: StatusCode, status: &Status) -> Answer {
    let mut answer = (code, axum::Json(error_body(status, code))).into_response();
    let headers = answer.headers_mut();
    if status.code() == Code::Unauthenticated {
        headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    }
    if let Some(delay) = status.get_details_retry_info().and_then(|retry| retry.retry_delay) {
        // Whole seconds, and never too early (RFC 9110, section 10.2.3).
        let seconds = delay.as_secs() + u64::from(delay.subsec_nanos() > 0);
        headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    }
    secured(answer)
}

/// Answers are data: no page runs or embeds them, and none is guessed to be another kind.
pub fn secured(mut answer: Answer) -> Answer {
    let headers = answer.headers_mut();
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static("default-src 'none'"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    answer
}

/// The code of HTTP that goes with one of gRPC (`google/rpc/code.proto`).
fn http_code(code: Code) -> StatusCode {
    match code {
        Code::Ok => StatusCode::OK,
        Code::InvalidArgument | Code::FailedPrecondition | Code::OutOfRange => StatusCode::BAD_REQUEST,
        Code::Unauthenticated => StatusCode::UNAUTHORIZED,
        Code::PermissionDenied => StatusCode::FORBIDDEN,
        Code::NotFound => StatusCode::NOT_FOUND,
        Code::AlreadyExists | Code::Aborted => StatusCode::CONFLICT,
        Code::ResourceExhausted => StatusCode::TOO_MANY_REQUESTS,
        Code::Unimplemented => StatusCode::NOT_IMPLEMENTED,
        Code::Unavailable => StatusCode::SERVICE_UNAVAILABLE,
        Code::DeadlineExceeded => StatusCode::GATEWAY_TIMEOUT,
        // The client has gone away; nobody reads it.
        Code::Cancelled => StatusCode::REQUEST_TIMEOUT,
        Code::Unknown | Code::Internal | Code::DataLoss => StatusCode::INTERNAL_SERVER_ERROR,
    }
}

/// `{"error": {...}}` with the code of HTTP, the message, the name of the code and the details (AIP-193).
fn error_body(status: &Status, code: StatusCode) -> Value {
    let details = status.get_error_details();
    let mut encoded = Vec::new();
    if let Some(info) = details.error_info() {
        let metadata: Map<_, _> = info.metadata.iter().map(|(key, value)| (key.clone(), json!(value))).collect();
        encoded.push(json!({
            "@type": "type.googleapis.com/google.rpc.ErrorInfo",
            "reason": info.reason, "domain": info.domain, "metadata": metadata,
        }));
    }
    if let Some(request) = details.bad_request() {
        let violation = |violation: &tonic_types::FieldViolation| json!({"field": violation.field, "description": violation.description});
        let violations: Vec<_> = request.field_violations.iter().map(violation).collect();
        encoded.push(json!({"@type": "type.googleapis.com/google.rpc.BadRequest", "fieldViolations": violations}));
    }
    if let Some(delay) = details.retry_info().and_then(|retry| retry.retry_delay) {
        let delay = format!("{}s", delay.as_secs_f64());
        encoded.push(json!({"@type": "type.googleapis.com/google.rpc.RetryInfo", "retryDelay": delay}));
    }
    if let Some(resource) = details.resource_info() {
        encoded.push(json!({
            "@type": "type.googleapis.com/google.rpc.ResourceInfo",
            "resourceType": resource.resource_type, "resourceName": resource.resource_name,
            "owner": resource.owner, "description": resource.description,
        }));
    }
    json!({"error": {
        "code": code.as_u16(),
        "message": status.message(),
        "status": code_name(status.code()),
        "details": encoded,
    }})
}
