//! Results as protobuf: `GET /v1/tenants/{tenant}/jobs/{job}/result` with `accept: application/x-protobuf`, of any
//! size.

use axum::body::Body;
use axum::http::header::{self, HeaderMap};
use axum::http::{Method, StatusCode};
use axum::response::IntoResponse;
use futures_util::{StreamExt, stream};
use tonic::Status;
use tonic_types::StatusExt;

use super::answer::{self, Answer};
use super::api::{Api, call, essence, failed, invalid};
use super::route::Route;
use super::upload::PROTOBUF;
use crate::rpc::convert::result::digest_from_wire;
use crate::rpc::convert::size_to_wire;
use crate::rpc::listener::ConnectionInfo;
use crate::rpc::proto::job_service_client::JobServiceClient;
use crate::rpc::{proto, status};

/// The method whose path answers in protobuf too.
const METHOD: &str = "scpsfm.v1.JobService.GetJobResult";

/// Whether the path of a route answers in protobuf too.
pub fn is_of(route: &Route) -> bool {
    route.method.full_name() == METHOD
}

/// Whether a request accepts protobuf (RFC 9110, section 12.5.1).
pub fn is_accepted(headers: &HeaderMap) -> bool {
    let accepted = headers.get_all(header::ACCEPT).iter().filter_map(|kinds| kinds.to_str().ok());
    accepted.flat_map(|kinds| kinds.split(',')).any(|kind| {
        let weights = kind.split(';').skip(1).filter_map(|parameter| parameter.trim().strip_prefix("q="));
        essence(kind) == PROTOBUF && weights.map(str::parse::<f32>).all(|weight| weight != Ok(0.0))
    })
}

/// Passes on what `JobService.ReadJobResult` reads.
///
/// * `name`: of the job
pub async fn answer(
    api: &Api,
    connection_info: ConnectionInfo,
    name: String,
    head: &axum::http::request::Parts,
) -> Result<Answer, Box<Answer>> {
    let headers = &head.headers;
    api.check_key(headers, &connection_info)?;
    if let Some((name, _)) = form_urlencoded::parse(head.uri.query().unwrap_or_default().as_bytes()).next() {
        return Err(invalid(&name, "is no parameter of a result in protobuf; a Range header continues one"));
    }
    let mut client = JobServiceClient::new(api.gateway.service.clone());
    let mut read = async |offset: u64| {
        let request = proto::ReadJobResultRequest { name: name.clone(), offset: size_to_wire(offset) };
        let asked = call(headers, connection_info.clone(), api.gateway.permit(), request);
        let mut chunks = client.read_job_result(asked).await?.into_inner();
        let first = chunks.message().await?.ok_or_else(|| Status::internal("a result without a chunk"))?;
        let digest = digest_from_wire(&first.sha256, "sha256").ok().flatten();
        let tag = digest.map(|digest| format!("\"{digest}\""));
        Ok((first, chunks, tag.ok_or_else(|| Status::internal("a result without a SHA-256"))?))
    };
    let mut from = if head.method == Method::GET { range_begin(headers) } else { None };
    let begun = read(from.unwrap_or(0)).await;
    let (mut first, mut chunks, tag) = begun.map_err(|status: Status| match from {
        Some(_) if is_of_offset(&status) => unsatisfiable(None),
        _ => failed(status),
    })?;
    if from.is_some() && headers.get(header::IF_RANGE).is_some_and(|known| known.as_bytes() != tag.as_bytes()) {
        from = None;
        (first, chunks, _) = read(0).await.map_err(failed)?;
    }
    let (begin, size) = (first.offset, first.size_bytes);
    if from.is_some() && begin == size {
        return Err(unsatisfiable(Some(size)));
    }
    let data = stream::iter([Ok(first)]).chain(chunks).map(|chunk| chunk.map(|chunk| chunk.data));
    let fields = [
        (header::CONTENT_TYPE, PROTOBUF.to_owned()),
        (header::CONTENT_LENGTH, (size - begin).to_string()),
        (header::ACCEPT_RANGES, "bytes".to_owned()),
        (header::ETAG, tag),
    ];
    let whole = (fields, Body::from_stream(data)).into_response();
    Ok(answer::secured(match from {
        None => whole,
        Some(_) => {
            let range = [(header::CONTENT_RANGE, format!("bytes {begin}-{}/{size}", size - 1))];
            (StatusCode::PARTIAL_CONTENT, range, whole).into_response()
        }
    }))
}

/// Where the range begins that a request asks for: `bytes=N-` (RFC 9110, section 14.2). Other ranges are ignored.
fn range_begin(headers: &HeaderMap) -> Option<u64> {
    let begin = headers.get(header::RANGE)?.to_str().ok()?.strip_prefix("bytes=")?.strip_suffix('-')?;
    begin.bytes().all(|byte| byte.is_ascii_digit()).then(|| begin.parse().ok())?
}

/// Whether a refusal is for an offset beyond the end.
fn is_of_offset(status: &Status) -> bool {
    let details = status.get_details_bad_request();
    details.is_some_and(|details| details.field_violations.iter().any(|violation| violation.field == "offset"))
}

/// The refusal of a range that begins at the end or beyond it (RFC 9110, section 15.5.17).
///
/// * `size`: of the result, where it is known
fn unsatisfiable(size: Option<i64>) -> Box<Answer> {
    let text = "the range begins at the end of the result or beyond it";
    let status = status::refused(tonic::Code::OutOfRange, "RANGE_NOT_SATISFIABLE", text);
    let refused = answer::refused(StatusCode::RANGE_NOT_SATISFIABLE, &status);
    let Some(size) = size else { return Box::new(refused) };
    Box::new(([(header::CONTENT_RANGE, format!("bytes */{size}"))], refused).into_response())
}
