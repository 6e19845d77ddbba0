//! Uploads as a body: `POST /v1/tenants/{tenant}/inputs`, an `InputData` in protobuf or JSON.

use std::sync::Arc;

use axum::body::{Body, BodyDataStream};
use axum::extract::Request;
use axum::http::{HeaderMap, header};
use futures_util::{Stream, StreamExt, stream};
use prost::Message as _;
use prost::bytes::{Buf, Bytes, BytesMut};
use sha2::{Digest, Sha256};
use tonic::Code;

use super::answer::{self, Answer};
use super::api::{Api, call, failed, in_background, invalid, media_type, next_frame};
use crate::rpc::convert::size_to_wire;
use crate::rpc::inputs::MAX_CHUNK_BYTES;
use crate::rpc::listener::ConnectionInfo;
use crate::rpc::proto::input_service_client::InputServiceClient;
use crate::rpc::proto::upload_input_request::Message;
use crate::rpc::proto::{self, UploadInputRequest};
use crate::telemetry::metrics::HttpRefusal;

/// The media type of protobuf.
pub const PROTOBUF: &str = "application/x-protobuf";

/// Parameter of the query that names the upload.
const UPLOAD_ID: &str = "uploadId";

/// The parent of an upload; `None` for another path.
pub fn parent(path: &str) -> Option<String> {
    let parent = path.strip_prefix("/v1/")?.strip_suffix("/inputs")?;
    let is_parent = parent.strip_prefix("tenants/").is_some_and(|tenant| !tenant.is_empty() && !tenant.contains('/'));
    is_parent.then(|| parent.to_owned())
}

/// Passes a body on to `InputService.UploadInput`. Protobuf goes as it comes, without being held; its length is told
/// beforehand.
pub async fn answer(
    api: &Arc<Api>,
    connection_info: ConnectionInfo,
    parent: String,
    request: Request,
) -> Result<Answer, Box<Answer>> {
    let (head, body) = request.into_parts();
    api.check_key(&head.headers, &connection_info)?;
    let mut upload_id = None;
    for (name, value) in form_urlencoded::parse(head.uri.query().unwrap_or_default().as_bytes()) {
        if name != UPLOAD_ID {
            return Err(invalid(&name, format!("is no parameter; there is {UPLOAD_ID}")));
        }
        upload_id = Some(value.into_owned());
    }
    let permit = api.gateway.permit();
    let (size_bytes, body) = if media_type(&head.headers) == PROTOBUF {
        (declared_length(&head.headers)?, body)
    } else {
        let (message, length) = api.read(&head.headers, body, api.input_data.clone(), &permit).await?;
        let encoded = in_background(length, move || Ok(message.encode_to_vec())).await.map_err(failed)?;
        permit.hold(encoded.len() as u64).map_err(failed)?;
        (encoded.len() as u64, Body::from(encoded))
    };
    let mut body = body.into_data_stream();
    let mut start = proto::UploadStart {
        parent,
        upload_id: upload_id.unwrap_or_else(|| uuid::Uuid::now_v7().to_string()),
        size_bytes: size_to_wire(size_bytes),
        sha256: Vec::new(),
    };
    let mut client = InputServiceClient::new(api.gateway.service.clone());
    let asked = proto::GetUploadStatusRequest { parent: start.parent.clone(), upload_id: start.upload_id.clone() };
    let asked = call(&head.headers, connection_info.clone(), permit.clone(), asked);
    // What an upload that broke off has left is kept: the body is passed over that far.
    let committed = match client.get_upload_status(asked).await.map(tonic::Response::into_inner) {
        // A finished upload is answered at its start, before any byte is compared: the start has to tell the SHA-256,
        // so that an id that comes with other bytes is refused.
        Ok(proto::UploadStatus { input: Some(_), size_bytes, .. }) if size_bytes == start.size_bytes => {
            let mut hash = Sha256::new();
            while let Some(frame) = next_frame(&mut body).await? {
                hash.update(&frame);
            }
            start.sha256 = hash.finalize().to_vec();
            0
        }
        Ok(status) => u64::try_from(status.committed_bytes).unwrap_or(0),
        Err(status) if status.code() == Code::NotFound => 0,
        Err(status) => return Err(failed(status)),
    };
    let messages = messages(start, committed, body);
    let uploaded =
        client.upload_input(call(&head.headers, connection_info, permit.clone(), messages)).await.map_err(failed)?;
    let json = answer::message(&api.input, &uploaded.into_inner().encode_to_vec()).map_err(failed)?;
    Ok(answer::json(json, permit))
}

fn declared_length(headers: &HeaderMap) -> Result<u64, Box<Answer>> {
    let length = headers.get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
    let text = "an upload says its length beforehand: Content-Length is missing";
    length.ok_or_else(|| answer::refuse(HttpRefusal::Length, text))
}

/// Where a body is on its way.
enum Stage {
    Start(proto::UploadStart),
    Data,
    Ended,
}

/// The messages of an upload: its start, its chunks as the body comes from `committed` on, and its end. A body that breaks off ends them
/// before the end, which refuses the upload and keeps what came.
fn messages(
    start: proto::UploadStart,
    committed: u64,
    body: BodyDataStream,
) -> impl Stream<Item = UploadInputRequest> + Send {
    struct State {
        stage: Stage,
        body: BodyDataStream,
        /// Came and was not passed on.
        pending: BytesMut,
        offset: u64,
        hash: Sha256,
    }
    let message = |message| UploadInputRequest { message: Some(message) };
    let state = State { stage: Stage::Start(start), body, pending: BytesMut::new(), offset: 0, hash: Sha256::new() };
    stream::unfold(state, move |mut state| async move {
        match std::mem::replace(&mut state.stage, Stage::Data) {
            Stage::Start(start) => return Some((message(Message::Start(start)), state)),
            Stage::Ended => return None,
            Stage::Data => {}
        }
        while state.pending.len() < MAX_CHUNK_BYTES {
            match state.body.next().await {
                Some(Ok(mut frame)) => {
                    state.hash.update(frame.chunk());
                    let passed = committed.saturating_sub(state.offset).min(frame.len() as u64);
                    state.offset += passed;
                    frame.advance(usize::try_from(passed).unwrap_or(usize::MAX));
                    state.pending.extend_from_slice(frame.chunk());
                }
                Some(Err(_)) => return None,
                None => break,
            }
        }
        let data: Bytes = state.pending.split_to(state.pending.len().min(MAX_CHUNK_BYTES)).freeze();
        if data.is_empty() {
            state.stage = Stage::Ended;
            let sha256 = state.hash.finalize_reset().to_vec();
            return Some((message(Message::Finish(proto::UploadFinish { sha256 })), state));
        }
        let chunk = proto::UploadChunk {
            offset: size_to_wire(state.offset),
            crc32c: crc32c::crc32c(&data),
            data: data.to_vec(),
        };
        state.offset += chunk.data.len() as u64;
        Some((message(Message::Chunk(chunk)), state))
    })
}
