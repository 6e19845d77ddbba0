//! Uploads as a caller sends them, rightly or not.

use prost::Message as _;
use scpsfm::domain::RawInput;
use scpsfm::rpc::convert;
use scpsfm::rpc::proto::{self, upload_input_request::Message};
use sha2::{Digest, Sha256};
use tonic::Status;

pub const DEFAULT: &str = "tenants/default";

/// The bytes of an input as they are uploaded.
pub fn encoded(raw: &RawInput) -> Vec<u8> {
    let data = proto::input_data::Data::TrackSet(convert::input::to_wire(raw.clone()));
    proto::InputData { data: Some(data) }.encode_to_vec()
}

/// The id of an upload, one a number.
pub fn id(number: u32) -> String {
    format!("00000000-0000-4000-8000-{number:012x}")
}

pub fn start(parent: &str, id: &str, size_bytes: usize) -> proto::UploadStart {
    proto::UploadStart {
        parent: parent.into(),
        upload_id: id.into(),
        size_bytes: size_bytes as i64,
        sha256: Vec::new(),
    }
}

pub fn chunk(offset: usize, data: &[u8]) -> proto::UploadChunk {
    proto::UploadChunk { offset: offset as i64, data: data.to_vec(), crc32c: crc32c::crc32c(data) }
}

pub fn sha256(bytes: &[u8]) -> Vec<u8> {
    Sha256::digest(bytes).to_vec()
}

pub fn finish(bytes: &[u8]) -> proto::UploadFinish {
    proto::UploadFinish { sha256: sha256(bytes) }
}

pub fn request(message: Message) -> proto::UploadInputRequest {
    proto::UploadInputRequest { message: Some(message) }
}

/// The messages that send `bytes[from..to]` in chunks of that length, without a finish.
pub fn part(
    parent: &str,
    id: &str,
    bytes: &[u8],
    range: std::ops::Range<usize>,
    length: usize,
) -> Vec<proto::UploadInputRequest> {
    let chunks = range.clone().step_by(length);
    let chunks = chunks.map(|at| Message::Chunk(chunk(at, &bytes[at..range.end.min(at + length)])));
    std::iter::once(Message::Start(start(parent, id, bytes.len()))).chain(chunks).map(request).collect()
}

/// The messages of a whole upload.
pub fn whole(parent: &str, id: &str, bytes: &[u8], length: usize) -> Vec<proto::UploadInputRequest> {
    let mut messages = part(parent, id, bytes, 0..bytes.len(), length);
    messages.push(request(Message::Finish(finish(bytes))));
    messages
}

/// The reason of a refusal, for programs.
pub fn reason(status: &Status) -> String {
    use tonic_types::StatusExt;
    status.get_details_error_info().expect("an ErrorInfo").reason
}
