//! Results as a body: `GET /v1/tenants/{tenant}/jobs/{job}/result` for who accepts protobuf, of any size.

use axum::body::Body;
use axum::http::header::{self, HeaderName};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::IntoResponse;
use futures_util::{StreamExt, stream};
use tonic::{Code, Status};

use super::answer::{self, Answer};
use super::api::{Api, call, essence, failed};
use super::upload::PROTOBUF;
use crate::domain::Sha256Digest;
use crate::rpc::convert::size_to_wire;
use crate::rpc::inflight::HeldBody;
use crate::rpc::listener::ConnectionInfo;
use crate::rpc::proto::job_service_client::JobServiceClient;
use crate::rpc::{proto, status};

/// The job whose result is asked for as protobuf; `None` for another request.
pub fn job(path: &str, headers: &HeaderMap) -> Option<String> {
    let job = path.strip_prefix("/v1/")?.strip_suffix("/result")?;
    let is_job = matches!(*job.split('/').collect::<Vec<_>>(), ["tenants", _, "jobs", _]);
    (is_job && accepts_protobuf(headers)).then(|| job.to_owned())
}

fn accepts_protobuf(headers: &HeaderMap) -> bool {
    let accepted = headers.get_all(header::ACCEPT).iter().filter_map(|kinds| kinds.to_str().ok());
    accepted.flat_map(|kinds| kinds.split(',')).any(|kind| essence(kind) == PROTOBUF)
}

/// Passes on what `JobService.ReadJobResult` reads: the bytes of the result as they are stored, without being held.
pub async fn answer(
    api: &Api,
    connection_info: ConnectionInfo,
    name: String,
    headers: &HeaderMap,
) -> Result<Answer, Box<Answer>> {
    api.check_key(headers, &connection_info)?;
    let permit = api.gateway.permit();
    let from = resumed_at(headers);
    let request = proto::ReadJobResultRequest { name, offset: size_to_wire(from.unwrap_or(0)) };
    let asked = call(headers, connection_info, permit.clone(), request);
    let mut client = JobServiceClient::new(api.gateway.service.clone());
    let mut chunks = client.read_job_result(asked).await.map_err(failed)?.into_inner();
    let first = chunks.message().await.map_err(failed)?;
    let first = first.ok_or_else(|| failed(Status::internal("a result without a chunk")))?;
    let (begin, size) = (first.offset, first.size_bytes);
    let digest = <[u8; 32]>::try_from(first.sha256.as_ref()).map(Sha256Digest);
    let digest = digest.map_err(|_| failed(Status::internal("a result without a SHA-256")))?;
    if from.is_some() && begin == size {
        return Err(unsatisfiable(size));
    }
    let mut fields: Vec<(HeaderName, String)> = vec![
        (header::CONTENT_TYPE, PROTOBUF.to_owned()),
        (header::CONTENT_LENGTH, (size - begin).to_string()),
        (header::ACCEPT_RANGES, "bytes".to_owned()),
        (header::ETAG, format!("\"{digest}\"")),
    ];
    if from.is_some() {
        fields.push((header::CONTENT_RANGE, format!("bytes {begin}-{}/{size}", size - 1)));
    }
    let data = stream::iter([Ok(first)]).chain(chunks).map(|chunk| chunk.map(|chunk| chunk.data));
    let body = Body::new(HeldBody { body: Body::from_stream(data), permit });
    let code = if from.is_some() { StatusCode::PARTIAL_CONTENT } else { StatusCode::OK };
    let mut answer = (code, body).into_response();
    for (name, value) in fields {
        let value = HeaderValue::try_from(value).expect("visible ASCII");
        answer.headers_mut().insert(name, value);
    }
    Ok(answer::secured(answer))
}

/// The refusal of what begins at the end: whoever asks has it all.
fn unsatisfiable(size: i64) -> Box<Answer> {
    let text = format!("the result has {size} bytes, and all of them are there");
    let status = status::refused(Code::OutOfRange, "RANGE_NOT_SATISFIABLE", text);
    let refused = answer::refused(StatusCode::RANGE_NOT_SATISFIABLE, &status);
    Box::new(([(header::CONTENT_RANGE, format!("bytes */{size}"))], refused).into_response())
}

/// Where a download goes on: `Range: bytes=N-` (RFC 9110, section 14.2). Other ranges are not looked at, as the server
/// may choose, nor is one under a condition.
fn resumed_at(headers: &HeaderMap) -> Option<u64> {
    if headers.contains_key(header::IF_RANGE) {
        return None;
    }
    let range = headers.get(header::RANGE)?.to_str().ok()?;
    range.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok()
}
