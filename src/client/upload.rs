//! Uploading an input, over broken connections and restarts of the server.

use std::time::Duration;

use prost::Message as _;
use prost::bytes::Bytes;
use sha2::{Digest, Sha256};
use tokio::sync::watch;
use tonic::{Request, Status};
use tonic_types::StatusExt as _;

use super::backoff::Backoff;
use super::{Client, Error, InputData, error};
use crate::domain::InputName;
use crate::rpc::proto::{self, upload_input_request::Message};

/// Bytes of one chunk: what any server takes, and little to send again.
const CHUNK_BYTES: usize = 512 * 1024;

/// How often the caller is told how far the upload is.
const TELL_EVERY: Duration = Duration::from_millis(100);

/// An input in the form in which it is uploaded.
#[derive(Debug, Clone)]
pub struct EncodedInput {
    bytes: Bytes,
    sha256: [u8; 32],
}

impl EncodedInput {
    /// Encodes an input and takes its digest.
    pub fn new(input: impl Into<InputData>) -> Self {
        let data = input.into().into_data();
        let bytes: Bytes = proto::InputData { data: Some(data) }.encode_to_vec().into();
        let sha256 = Sha256::digest(&bytes).into();
        Self { bytes, sha256 }
    }

    /// Length in bytes.
    pub fn len(&self) -> u64 {
        self.bytes.len() as u64
    }

    /// Whether it has no bytes, as no valid input has.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// The upload's id, a UUID of version 8 (RFC 9562): of the same bytes always the same, so that a command that is
    /// given again goes on where the first one was stopped.
    fn upload_id(&self) -> String {
        let mut id = [0; 16];
        id.copy_from_slice(&self.sha256[..16]);
        uuid::Builder::from_custom_bytes(id).into_uuid().to_string()
    }

    /// Every message of a stream that goes on from there; `sent` is told how far it is.
    fn messages(
        &self,
        parent: String,
        from: usize,
        sent: watch::Sender<u64>,
    ) -> impl Iterator<Item = proto::UploadInputRequest> + Send + 'static {
        let start = proto::UploadStart {
            parent,
            upload_id: self.upload_id(),
            size_bytes: self.bytes.len() as i64,
            sha256: self.sha256.to_vec(),
        };
        let bytes = self.bytes.clone();
        let chunks = (from..bytes.len()).step_by(CHUNK_BYTES).map(move |begin| {
            let data = bytes.slice(begin..bytes.len().min(begin + CHUNK_BYTES));
            sent.send_replace(begin as u64);
            Message::Chunk(proto::UploadChunk {
                offset: begin as i64,
                crc32c: crc32c::crc32c(&data),
                data: data.to_vec(),
            })
        });
        let finish = Message::Finish(proto::UploadFinish { sha256: self.sha256.to_vec() });
        let messages = std::iter::once(Message::Start(start)).chain(chunks).chain(std::iter::once(finish));
        messages.map(|message| proto::UploadInputRequest { message: Some(message) })
    }
}

impl Client {
    /// Uploads an input, or what is missing of it; `on_progress` is told how many bytes the server has. What the server
    /// has already is answered at once.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn upload(
        &mut self,
        input: &EncodedInput,
        on_progress: &mut (dyn FnMut(u64) + Send),
    ) -> Result<InputName, Error> {
        let mut backoff = Backoff::default();
        let mut best = 0;
        loop {
            let trouble = match self.upload_on(input, &mut best, &mut backoff, on_progress).await {
                Ok(stored) => {
                    on_progress(input.len());
                    let unknown = || Error::failed(format!("the server calls the input {:?}", stored.name));
                    return InputName::parse(&stored.name).ok_or_else(unknown);
                }
                Err(status) => status,
            };
            let again = if goes_on(&trouble) { Status::unavailable(trouble.message()) } else { trouble };
            self.pause(&mut backoff, again).await?;
        }
    }

    /// One try, from where the server is.
    async fn upload_on(
        &mut self,
        input: &EncodedInput,
        best: &mut u64,
        backoff: &mut Backoff,
        on_progress: &mut (dyn FnMut(u64) + Send),
    ) -> Result<proto::Input, Status> {
        let status = proto::GetUploadStatusRequest { parent: self.parent(), upload_id: input.upload_id() };
        let from = match backoff.within(self.inputs.get_upload_status(status)).await {
            // A finished one is begun again all the same, which says that it is wanted, and sends no more of it.
            Ok(status) => u64::try_from(status.into_inner().committed_bytes).unwrap_or(0),
            Err(status) if error::reason(&status).as_deref() == Some("UPLOAD_NOT_FOUND") => 0,
            Err(status) => return Err(status),
        };
        if from > *best {
            *best = from;
            backoff.reset();
        }
        on_progress(from);
        // No more than was declared is ever stored.
        let begin = usize::try_from(from.min(input.len())).unwrap_or(0);
        let (sent, mut at) = watch::channel(from);
        let messages = tokio_stream::iter(input.messages(self.parent(), begin, sent));
        let mut calling = self.inputs.clone();
        let mut call = std::pin::pin!(calling.upload_input(Request::new(messages)));
        let mut ticks = tokio::time::interval(TELL_EVERY);
        loop {
            tokio::select! {
                answer = &mut call => return Ok(answer?.into_inner()),
                _ = ticks.tick() => on_progress(*at.borrow_and_update()),
            }
        }
    }
}

/// Whether the server's answer is about this stream and not about the input: a chunk was damaged on its way, or another
/// stream of the upload, perhaps this command's own before the connection broke, wrote after its state was asked.
fn goes_on(status: &Status) -> bool {
    let bad = status.get_details_bad_request();
    let outrun = bad.is_some_and(|bad| bad.field_violations.iter().any(|violation| violation.field == "chunk.offset"));
    outrun || matches!(error::reason(status).as_deref(), Some("CHUNK_CORRUPTED" | "UPLOAD_TAKEN_OVER"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::RawInput;

    #[test]
    fn one_input_has_one_id_and_another_has_another() {
        let raw = |x: f64| RawInput {
            views: vec![Default::default(); 2],
            track_count: 1,
            view: vec![0, 1],
            track: vec![0, 0],
            x: vec![x, 2.0],
            y: vec![1.0, 2.0],
            depth: Vec::new(),
            sigma: Vec::new(),
        };
        let id = |x| EncodedInput::new(raw(x)).upload_id();
        assert_eq!(id(1.0), id(1.0));
        assert_ne!(id(1.0), id(1.5));
        let parsed = uuid::Uuid::try_parse(&id(1.0)).expect("a UUID");
        assert_eq!(parsed.get_version_num(), 8);
    }
}
