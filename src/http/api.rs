//! From a request to its answer: finds the route, makes a message of the JSON, calls the method within the process.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use axum::extract::Request;
use axum::http::uri::Authority;
use axum::http::{HeaderMap, Method, header};
use axum::response::IntoResponse;
use futures_util::StreamExt;
use http_body::Body as _;
use prost::Message;
use prost::bytes::Bytes;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor, ReflectMessage};
use tonic::Status;
use tonic::client::Grpc;
use tonic::metadata::MetadataMap;

use super::answer::{self, Answer};
use super::codec::Encoded;
use super::origin::{self, Origin};
use super::route::{self, Found, Route};
use super::unique_keys::UniqueKeys;
use super::{Options, console, download, grpc_web, openapi, upload};
use crate::domain::error::quoted;
use crate::domain::job::JobState;
use crate::rpc::convert::enums::Twin;
use crate::rpc::convert::names;
use crate::rpc::inflight::Permit;
use crate::rpc::keys::Grant;
use crate::rpc::listener::ConnectionInfo;
use crate::rpc::proto::job_service_client::JobServiceClient;
use crate::rpc::server::Gateway;
use crate::rpc::{proto, status};
use crate::telemetry::metrics::HttpRefusal;

/// Where the description of the API is.
const OPENAPI_PATH: &str = "/openapi.json";

/// Bytes that a byte of JSON takes in memory at most, beside [`OBJECT_BYTES`]: of `0,` it is a value of 56 bytes in an
/// array that has grown to twice its length.
const JSON_COPIES: u64 = 60;

/// Bytes that an object of JSON takes in memory at most, however short it is: `{},` of an array becomes a value and a
/// tree of fields as it is read. Counting the objects as the body comes is simpler than to stop a decoder at every
/// limit, and charges the bodies of real inputs, which are numbers, next to nothing. Twice the largest message is more than
/// both, which a test holds.
const OBJECT_BYTES: u64 = 2 * size_of::<proto::CreateJobRequest>() as u64;

/// How long a body may not move: as long as a `Solve`.
const BODY_PATIENCE: Duration = Duration::from_secs(60);

/// Longest description of what is wrong with a body: a parser repeats what it was given.
const MAX_DESCRIPTION: usize = 300;

/// How long JSON may be that is read on a thread that serves others: a millisecond's work.
const SMALL_BODY_BYTES: usize = 64 << 10;

/// Headers that a call takes along.
const PASSED_ON: [&str; 3] = ["authorization", "traceparent", "tracestate"];

/// Where a browser goes on with events that broke off, and the field that it sets.
const LAST_EVENT_ID: (&str, &str) = ("last-event-id", "after_sequence");

/// The API over HTTP.
pub struct Api {
    routes: Vec<Route>,
    openapi: Bytes,
    pub(super) gateway: Gateway,
    options: Options,
    /// What an upload holds, and what it becomes.
    pub(super) input_data: MessageDescriptor,
    pub(super) input: MessageDescriptor,
}

impl Api {
    /// # Errors
    /// A defect of the proto.
    pub fn new(pool: &DescriptorPool, gateway: Gateway, options: Options) -> Result<Self, String> {
        let routes = route::routes(pool)?;
        let openapi = openapi::document(&routes).to_string().into();
        let message = |name: &str| pool.get_message_by_name(name).ok_or_else(|| format!("the proto lacks {name}"));
        let (input_data, input) = (message("scpsfm.v1.InputData")?, message("scpsfm.v1.Input")?);
        Ok(Self { routes, openapi, gateway, options, input_data, input })
    }

    /// The answer to a request; `connection_info` is that of its connection. That to HEAD is that to GET: hyper leaves
    /// out the body.
    pub async fn answer(self: &Arc<Self>, connection_info: ConnectionInfo, request: Request) -> Answer {
        let origin = Origin::of(request.headers(), &self.options.allowed_origins);
        let answer = self.answer_or_refuse(&origin, connection_info, request).await;
        let mut answer = answer.unwrap_or_else(|refused| *refused);
        if let Origin::Allowed(origin) = origin {
            origin::admit(&mut answer, origin);
        }
        answer
    }

    async fn answer_or_refuse(
        self: &Arc<Self>,
        origin: &Origin,
        connection_info: ConnectionInfo,
        request: Request,
    ) -> Result<Answer, Box<Answer>> {
        if *origin == Origin::Other {
            let text = "a page of another site may not call this API: http.allowed_origins names those that may";
            return Err(self.forbid(HttpRefusal::Origin, text, &connection_info));
        }
        if !self.gateway.asks_for_keys() && !self.is_own_host(request.headers()) {
            let text = "the request is for a host that this server does not know: http.hosts names those that it has";
            return Err(self.forbid(HttpRefusal::Host, text, &connection_info));
        }
        if *origin != Origin::Own && request.method() == Method::OPTIONS {
            return Ok(origin::preflight(&self.routes));
        }
        let path = route::decode(request.uri().path()).map_err(|text| invalid("path", text))?;
        if grpc_web::is_call(request.headers()) {
            if request.method() != Method::POST {
                return Err(other_method(&path, &[Method::POST]));
            }
            return Ok(grpc_web::answer(&self.gateway, connection_info, request).await);
        }
        if let Some(encoding) = content_encoding(request.headers()).filter(|_| !request.body().is_end_stream()) {
            let text = format!("the body is encoded as {}; it is sent without content-encoding", quoted(&encoding));
            let refused = answer::refuse(HttpRefusal::MediaType, text);
            // RFC 9110, section 15.5.16.
            return Err(Box::new(([(header::ACCEPT_ENCODING, "identity")], *refused).into_response()));
        }
        let verb = if request.method() == Method::HEAD { Method::GET } else { request.method().clone() };
        let mut allowed = Vec::new();
        if path == OPENAPI_PATH && self.gateway.describes {
            if verb == Method::GET {
                self.check_key(request.headers(), &connection_info)?;
                return Ok(answer::json(self.openapi.to_vec(), self.gateway.permit()));
            }
            allowed.push(Method::GET);
        }
        if let Some(file) = console::file(&path) {
            if verb == Method::GET {
                return Ok(file);
            }
            allowed.push(Method::GET);
        }
        if let Some(parent) = upload::parent(&path) {
            if verb == Method::POST {
                return upload::answer(self, connection_info, parent, request).await;
            }
            allowed.push(Method::POST);
        }
        match route::find(&self.routes, &verb, &path) {
            Found::Route(route, fields) if download::is_of(route) && download::is_accepted(request.headers()) => {
                let (head, _) = request.into_parts();
                let name = fields.into_iter().map(|(_, name)| name).next().unwrap_or_default();
                return download::answer(self, connection_info, name, &head).await;
            }
            Found::Route(route, fields) => return self.call(route, fields, connection_info, request).await,
            Found::OtherVerbs(verbs) => allowed.extend(verbs),
            Found::Nothing => {}
        }
        if allowed.is_empty() {
            let text = format!("there is nothing at {path}; {OPENAPI_PATH} describes what there is");
            return Err(answer::refuse(HttpRefusal::Path, text));
        }
        if allowed.contains(&Method::GET) {
            allowed.push(Method::HEAD);
        }
        Err(other_method(&path, &allowed))
    }

    /// What the request's key stands for, where one is asked for.
    pub(super) fn check_key(
        &self,
        headers: &HeaderMap,
        connection_info: &ConnectionInfo,
    ) -> Result<Grant, Box<Answer>> {
        let checked = self.gateway.check_key(headers, connection_info);
        checked.map_err(|status| answer::uncalled(HttpRefusal::Unauthenticated, &status))
    }

    async fn call(
        self: &Arc<Self>,
        route: &Route,
        fields: Vec<(&str, String)>,
        connection_info: ConnectionInfo,
        request: Request,
    ) -> Result<Answer, Box<Answer>> {
        let (head, body) = request.into_parts();
        let grant = self.check_key(&head.headers, &connection_info)?;
        let permit = self.gateway.permit();
        let descriptor = route.method.input();
        let query = head.uri.query().unwrap_or_default();
        let (mut message, length) = if route.has_body {
            if let Some((name, _)) = form_urlencoded::parse(query.as_bytes()).next() {
                return Err(invalid(&name, "is in the query; this call takes everything in its body"));
            }
            self.read(&head.headers, body, descriptor, &permit).await?
        } else {
            let mut message = DynamicMessage::new(descriptor);
            for (name, value) in form_urlencoded::parse(query.as_bytes()) {
                let set = match route.template.holds(&name) {
                    true => Err("is in the path".to_owned()),
                    false => route::set_field(&mut message, &name, &value),
                };
                set.map_err(|text| invalid(&name, text))?;
            }
            (message, 0)
        };
        let (last_id, after) = LAST_EVENT_ID;
        if let Some(last_id) = head.headers.get(last_id).and_then(|id| id.to_str().ok())
            && message.descriptor().get_field_by_name(after).is_some()
        {
            route::set_field(&mut message, after, last_id).map_err(|text| invalid(after, text))?;
        }
        for (name, value) in fields {
            let in_body = message.get_field_by_name(name).and_then(|field| field.as_str().map(str::to_owned));
            if let Some(in_body) = in_body.filter(|text| !text.is_empty())
                && names::resolved(&in_body, &grant.tenant) != names::resolved(&value, &grant.tenant)
            {
                return Err(invalid(name, format!("{} is not the path's {value}", quoted(&in_body))));
            }
            route::set_field(&mut message, name, &value).map_err(|text| invalid(name, text))?;
        }
        if let Some(after) = message.get_field_by_name(after).and_then(|number| number.as_u64()).filter(|&n| n > 0)
            && let Some(name) = message.get_field_by_name("name").and_then(|name| name.as_str().map(str::to_owned))
        {
            let asked = call(&head.headers, connection_info.clone(), permit.clone(), proto::GetJobRequest { name });
            let job = JobServiceClient::new(self.gateway.service.clone()).get_job(asked).await.map_err(failed)?;
            if is_complete(job.get_ref(), after) {
                return Ok(answer::nothing_more());
            }
        }
        let encode = move || Ok(Bytes::from(message.encode_to_vec()));
        let encoded = in_background(length, encode).await.map_err(failed)?;
        // From here on it is the call's message, which is charged as it is read and decoded.
        permit.hold(encoded.len() as u64).map_err(failed)?;
        let call = call(&head.headers, connection_info, permit.clone(), encoded);
        let mut grpc = Grpc::new(self.gateway.service.clone()).max_decoding_message_size(usize::MAX);
        // Never fails: the services are always ready.
        let _ = grpc.ready().await;
        let (path, output) = (route.grpc_path.clone(), route.method.output());
        if route.method.is_server_streaming() {
            let events = grpc.server_streaming(call, path, Encoded).await.map_err(failed)?.into_inner();
            return Ok(answer::events(output, events));
        }
        let bytes = grpc.unary(call, path, Encoded).await.map_err(failed)?.into_inner();
        permit.hold(JSON_COPIES * bytes.len() as u64).map_err(failed)?;
        let json = in_background(bytes.len(), move || answer::message(&output, &bytes)).await.map_err(failed)?;
        Ok(answer::json(json, permit))
    }

    /// Refuses a request for where it comes from or goes to, and writes that down.
    fn forbid(&self, refusal: HttpRefusal, text: &str, connection_info: &ConnectionInfo) -> Box<Answer> {
        let status = answer::status_of(refusal, text);
        self.gateway.log_refused(&status, connection_info);
        answer::uncalled(refusal, &status)
    }

    /// Whether a request is for an address of this machine, or one of the names that it is known under.
    fn is_own_host(&self, headers: &HeaderMap) -> bool {
        let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
        let name = host.parse::<Authority>().map(|authority| authority.host().trim_matches(['[', ']']).to_owned());
        let Ok(name) = name else { return false };
        name.parse::<IpAddr>().is_ok()
            || name.eq_ignore_ascii_case("localhost")
            || self.options.hosts.iter().any(|known| known.eq_ignore_ascii_case(&name))
    }

    /// The message of a body, and the length of the body.
    pub(super) async fn read(
        &self,
        headers: &HeaderMap,
        body: Body,
        descriptor: MessageDescriptor,
        permit: &Permit,
    ) -> Result<(DynamicMessage, usize), Box<Answer>> {
        let text = self.collect(body, permit).await?;
        let length = text.len();
        if text.is_empty() {
            return Ok((DynamicMessage::new(descriptor), 0));
        }
        let kind = media_type(headers);
        if kind != "application/json" {
            let text = format!("the body is {kind:?}, not application/json");
            return Err(answer::refuse(HttpRefusal::MediaType, text));
        }
        let parse = move || {
            let message = serde_json::from_slice::<UniqueKeys>(&text).and_then(|_| {
                let mut json = serde_json::Deserializer::from_slice(&text);
                let message = DynamicMessage::deserialize(descriptor, &mut json)?;
                json.end().map(|()| message)
            });
            Ok(message.map_err(|error| error.to_string().chars().take(MAX_DESCRIPTION).collect::<String>()))
        };
        let message = in_background(length, parse).await.map_err(failed)?;
        let message = message.map_err(|description| invalid("body", description))?;
        Ok((message, length))
    }

    /// The bytes of a body, charged as the JSON that they are; more where strings hold a `{`.
    async fn collect(&self, body: Body, permit: &Permit) -> Result<Vec<u8>, Box<Answer>> {
        let (mut text, mut objects) = (Vec::new(), 0);
        let mut frames = body.into_data_stream();
        while let Some(frame) = next_frame(&mut frames).await? {
            let length = text.len() + frame.len();
            if length > self.options.max_body_bytes {
                let text = format!(
                    "the body is larger than {} bytes; a larger input is uploaded as protobuf, or sent over gRPC",
                    self.options.max_body_bytes
                );
                return Err(answer::refuse(HttpRefusal::TooLarge, text));
            }
            objects += frame.iter().filter(|&&byte| byte == b'{').count() as u64;
            let bytes = JSON_COPIES * length as u64 + OBJECT_BYTES * objects;
            if !permit.could_hold(bytes) {
                let text = format!(
                    "the first {length} bytes of the body, with {objects} objects, may take {bytes} bytes in memory, \
                     which is more than server.max_inflight_bytes; a larger input is uploaded as protobuf, or sent over \
                     gRPC"
                );
                return Err(answer::refuse(HttpRefusal::TooLarge, text));
            }
            permit.hold(bytes).map_err(failed)?;
            text.extend_from_slice(&frame);
        }
        Ok(text)
    }
}

/// The next bytes of a body; `None` at its end.
pub(super) async fn next_frame(frames: &mut BodyDataStream) -> Result<Option<Bytes>, Box<Answer>> {
    let frame = tokio::time::timeout(BODY_PATIENCE, frames.next()).await;
    let frame = frame.map_err(|_| answer::uncalled(HttpRefusal::Stalled, &status::input_stalled(BODY_PATIENCE)))?;
    // The client has gone away; nobody reads the answer.
    frame.transpose().map_err(|error| failed(Status::cancelled(error.to_string())))
}

/// A call with what the request says of its caller.
pub(super) fn call<T>(
    headers: &HeaderMap,
    connection_info: ConnectionInfo,
    permit: Permit,
    message: T,
) -> tonic::Request<T> {
    let mut passed = HeaderMap::new();
    for name in PASSED_ON {
        for value in headers.get_all(name) {
            passed.append(name, value.clone());
        }
    }
    let mut call = tonic::Request::new(message);
    *call.metadata_mut() = MetadataMap::from_headers(passed);
    call.extensions_mut().insert(connection_info);
    call.extensions_mut().insert(permit);
    call
}

/// How a body is encoded, where it is (RFC 9110, section 8.4).
fn content_encoding(headers: &HeaderMap) -> Option<String> {
    let values = headers.get_all(header::CONTENT_ENCODING).iter();
    let values: Vec<_> = values.map(|value| String::from_utf8_lossy(value.as_bytes())).collect();
    let encodings = values.iter().flat_map(|value| value.split(',')).map(str::trim);
    let mut encodings = encodings.filter(|encoding| !encoding.is_empty());
    encodings.find(|encoding| !encoding.eq_ignore_ascii_case("identity")).map(str::to_owned)
}

/// The media type of a body (RFC 9110, section 8.3.1).
pub(super) fn media_type(headers: &HeaderMap) -> String {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok()).unwrap_or_default();
    essence(kind)
}

/// A media type in lowercase, without parameters.
pub(super) fn essence(kind: &str) -> String {
    kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase()
}

/// The refusal of a method, which names those that the path has.
fn other_method(path: &str, allowed: &[Method]) -> Box<Answer> {
    let allowed = allowed.iter().map(Method::as_str).collect::<Vec<_>>().join(", ");
    let refused = answer::refuse(HttpRefusal::Method, format!("{path} is for {allowed}"));
    Box::new(([(header::ALLOW, allowed)], *refused).into_response())
}

pub(super) fn failed(status: Status) -> Box<Answer> {
    Box::new(answer::error(&status))
}

/// What is wrong with a request that is no call yet.
pub(super) fn invalid(field: &str, description: impl Into<String>) -> Box<Answer> {
    answer::uncalled(HttpRefusal::Invalid, &status::violation(field, description))
}

/// Whether a job has ended and had its last event by then. A browser's `EventSource` asks again whenever its stream
/// ends, until it is told that there is nothing more.
fn is_complete(job: &proto::Job, after_sequence: u64) -> bool {
    JobState::known(job.state).is_some_and(JobState::is_terminal) && job.last_sequence <= after_sequence
}

/// Does what takes long for so many bytes on a thread that serves nobody else.
pub(super) async fn in_background<T: Send + 'static>(
    bytes: usize,
    work: impl FnOnce() -> Result<T, Status> + Send + 'static,
) -> Result<T, Status> {
    if bytes <= SMALL_BODY_BYTES {
        return work();
    }
    tokio::task::spawn_blocking(work).await.map_err(|error| status::internal(&error))?
}

#[cfg(test)]
mod tests {
    use prost_reflect::Value;

    use super::*;

    #[test]
    fn what_json_is_charged_is_no_less_than_it_takes() {
        let value = size_of::<Value>() as u64;
        assert!(JSON_COPIES * 2 >= 2 * value, "`0,` in an array that has just grown");
        // A leaf of a BTreeMap has 11 entries, here of a number and a value with its kind, and 16 bytes beside them.
        let leaf = 11 * (8 + 8 + value) + 16;
        assert!(OBJECT_BYTES + JSON_COPIES * 3 >= 2 * value + leaf, "an object with a field, in such an array");
    }
}
