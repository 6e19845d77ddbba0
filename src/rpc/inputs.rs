//! `InputService`.

use std::sync::Arc;

use tokio::sync::Semaphore;
use tonic::{Request, Response, Status, Streaming};
use tracing::Instrument;

use super::caller::Caller;
use super::convert::result::digest_from_wire;
use super::convert::{self, input, size_to_wire};
use super::inflight::{Permit, WORKING_COPIES};
use super::upload_reader::{self, UploadReader};
use super::{proto, status, submission};
use crate::domain::{InputName, Limits};
use crate::engine::{self, Begun, Engine, GivenUp, InputQuery, NewUpload, Upload};
use proto::upload_input_request::Message;

/// Data of one chunk, in bytes: below the message limit of every client and proxy.
pub const MAX_CHUNK_BYTES: usize = 1 << 20;

/// Largest message of an upload: a chunk and its few other bytes.
pub const MAX_MESSAGE_BYTES: usize = MAX_CHUNK_BYTES + 1024;

/// What is gathered before it is stored: smaller chunks would be a commit each.
const WRITE_BYTES: usize = MAX_CHUNK_BYTES;

/// Uploads that are decoded at a time, so that others are not kept waiting for the processor; more wait for their turn.
const DECODED_AT_ONCE: usize = 2;

/// What an upload holds while it comes in: what is gathered, a chunk on top, and what is being stored.
const RECEPTION_BYTES: u64 = (2 * WRITE_BYTES + MAX_CHUNK_BYTES) as u64;

/// The service.
#[derive(Debug, Clone)]
pub struct Inputs {
    engine: Engine,
    limits: Limits,
    decoders: Arc<Semaphore>,
}

impl Inputs {
    pub fn new(engine: Engine, limits: Limits) -> Self {
        Self { engine, limits, decoders: Arc::new(Semaphore::new(DECODED_AT_ONCE)) }
    }

    /// The whole of an upload, from its first message on.
    async fn receive(
        &self,
        caller: &Caller,
        permit: &Permit,
        mut messages: Streaming<proto::UploadInputRequest>,
    ) -> Result<proto::Input, Status> {
        let Some(Message::Start(start)) = next(&mut messages, permit).await? else {
            return Err(status::violation("start", "is not the first message"));
        };
        let new = Self::read_start(caller, start)?;
        let name = new.name.clone();
        let received = self.receive_upload(new, permit, messages).await;
        caller.audit("UploadInput", &name, &received);
        received
    }

    /// What follows the first message.
    async fn receive_upload(
        &self,
        new: NewUpload,
        permit: &Permit,
        mut messages: Streaming<proto::UploadInputRequest>,
    ) -> Result<proto::Input, Status> {
        permit.hold(RECEPTION_BYTES)?;
        let upload = match self.engine.begin_upload(new).await? {
            Begun::Finished(input) => return Ok(input::uploaded_to_wire(&input)),
            Begun::Open(upload) => upload,
        };
        let mut reception = Reception { upload, gathered: Vec::new() };
        let finish = reception.until_finish(&mut messages, permit).await;
        // Whatever ended the stream: what came before is kept.
        let kept = reception.store().await;
        let sha256 = finish?;
        kept?;
        self.finish(reception.upload, sha256, permit).await
    }

    fn read_start(caller: &Caller, start: proto::UploadStart) -> Result<NewUpload, Status> {
        let name = name(caller, &start.parent, &start.upload_id, "start.upload_id")?;
        let bytes = match u64::try_from(start.size_bytes) {
            Ok(bytes) if bytes > 0 => bytes,
            _ => {
                let text = format!("{} is not a length in bytes, from 1 on", start.size_bytes);
                return Err(status::violation("start.size_bytes", text));
            }
        };
        let sha256 = digest_from_wire(&start.sha256, "start.sha256").map_err(status::invalid)?;
        Ok(NewUpload { name, bytes, sha256: sha256.map(|digest| digest.0) })
    }

    /// Makes an input of the bytes that are stored, if they are one.
    async fn finish(&self, upload: Upload, sha256: [u8; 32], permit: &Permit) -> Result<proto::Input, Status> {
        let _turn = self.decoders.acquire().await.map_err(|error| status::internal(&error))?;
        let largest = self.limits.max_observations as u64 * input::OBSERVATION_BYTES;
        permit.hold(WORKING_COPIES * upload.bytes.min(largest))?;
        let length = usize::try_from(upload.bytes).map_err(|error| status::internal(&error))?;
        let (sender, reader) = UploadReader::new(length);
        let limits = self.limits.clone();
        let decode = super::blocking(move || {
            let mut reader = reader.begun();
            let draft = convert::upload::read(&mut reader, &limits);
            let found = reader.into_hash()?;
            // Of bytes that are not those that were meant, nothing else is worth telling.
            Ok::<_, engine::Error>((found, (found == sha256).then_some(draft)))
        });
        let (outcome, ()) = tokio::join!(decode, upload_reader::feed(&upload, sender));
        let (found, draft) = outcome??;
        let Some(draft) = draft else {
            upload.give_up(GivenUp::WrongHash).await?;
            return Err(status::hash_mismatch(sha256, found));
        };
        let input = match draft {
            Ok(draft) => {
                // Matches take more while they are joined than their bytes told.
                permit.hold(WORKING_COPIES * draft.bytes().max(upload.bytes.min(largest)))?;
                super::blocking(move || draft.finish()).await?
            }
            Err(invalid) => Err(invalid),
        };
        match input {
            Err(invalid) => {
                upload.give_up(GivenUp::Invalid).await?;
                Err(status::invalid(invalid))
            }
            Ok(input) => {
                let stored = upload.finish(input, found).await?;
                Ok(input::uploaded_to_wire(&stored))
            }
        }
    }
}

/// A stream on its way into an upload.
struct Reception {
    upload: Upload,
    /// Checked, and not stored yet.
    gathered: Vec<u8>,
}

impl Reception {
    /// Takes chunks until the last message; returns the SHA-256 that it names.
    async fn until_finish(
        &mut self,
        messages: &mut Streaming<proto::UploadInputRequest>,
        permit: &Permit,
    ) -> Result<[u8; 32], Status> {
        loop {
            match next(messages, permit).await? {
                Some(Message::Chunk(chunk)) => self.take(chunk).await?,
                Some(Message::Finish(finish)) => return self.check_finish(&finish),
                Some(Message::Start(_)) => {
                    return Err(status::violation("start", "comes once, in the first message"));
                }
                None => {
                    let text = format!("is missing: the stream ended at {}", self.progress());
                    return Err(status::violation("finish", text));
                }
            }
        }
    }

    fn received(&self) -> u64 {
        self.upload.committed + self.gathered.len() as u64
    }

    fn progress(&self) -> String {
        format!("{} of {} bytes, which are kept", self.received(), self.upload.bytes)
    }

    async fn take(&mut self, chunk: proto::UploadChunk) -> Result<(), Status> {
        let invalid = |field: &str, text: String| Err(status::violation(field, text));
        let received = self.received();
        let length = chunk.data.len();
        if u64::try_from(chunk.offset) != Ok(received) {
            let what = if chunk.offset < received as i64 { "overlaps" } else { "leaves a gap" };
            return invalid("chunk.offset", format!("{} {what}: {received} is next", chunk.offset));
        }
        if length == 0 || length > MAX_CHUNK_BYTES {
            return invalid(
                "chunk.data",
                format!("{length} bytes at offset {received} are not 1 to {MAX_CHUNK_BYTES}"),
            );
        }
        if received + length as u64 > self.upload.bytes {
            let declared = self.upload.bytes;
            return invalid(
                "chunk.data",
                format!("{length} bytes at offset {received} go beyond the {declared} declared"),
            );
        }
        let found = crc32c::crc32c(&chunk.data);
        if found != chunk.crc32c {
            return Err(status::chunk_corrupted(received, chunk.crc32c, found));
        }
        self.gathered.extend_from_slice(&chunk.data);
        if self.gathered.len() >= WRITE_BYTES { self.store().await } else { Ok(()) }
    }

    fn check_finish(&self, finish: &proto::UploadFinish) -> Result<[u8; 32], Status> {
        let invalid = |field: &str, text: String| Err(status::violation(field, text));
        let sha256 = digest(&finish.sha256, "finish.sha256")?;
        if self.received() != self.upload.bytes {
            return invalid("finish", format!("comes too early, at {}", self.progress()));
        }
        match self.upload.sha256 {
            Some(declared) if declared != sha256 => invalid("finish.sha256", "is not that of the start".into()),
            _ => Ok(sha256),
        }
    }

    async fn store(&mut self) -> Result<(), Status> {
        let gathered = std::mem::take(&mut self.gathered);
        if gathered.is_empty() {
            return Ok(());
        }
        Ok(self.upload.append(&gathered).await?)
    }
}

async fn next(messages: &mut Streaming<proto::UploadInputRequest>, permit: &Permit) -> Result<Option<Message>, Status> {
    match submission::next(messages, permit).await? {
        None => Ok(None),
        Some(proto::UploadInputRequest { message: Some(message) }) => Ok(Some(message)),
        Some(_) => Err(status::violation("message", "is not set")),
    }
}

/// The input that an upload becomes: its id is the upload's, in the one form that UUIDs have here.
fn name(caller: &Caller, parent: &str, upload_id: &str, field: &str) -> Result<InputName, Status> {
    let tenant = caller.parent(parent)?;
    match uuid::Uuid::try_parse(upload_id) {
        Ok(id) => Ok(InputName { tenant, input: id.hyphenated().to_string() }),
        Err(_) => Err(status::violation(field, "is not a UUID, such as 123e4567-e89b-42d3-a456-426614174000")),
    }
}

fn digest(bytes: &[u8], field: &str) -> Result<[u8; 32], Status> {
    bytes.try_into().map_err(|_| status::violation(field, format!("{} bytes are not the 32 of a SHA-256", bytes.len())))
}

#[tonic::async_trait]
impl proto::input_service_server::InputService for Inputs {
    async fn upload_input(
        &self,
        request: Request<Streaming<proto::UploadInputRequest>>,
    ) -> Result<Response<proto::Input>, Status> {
        let caller = Caller::of(&request)?;
        let permit = Permit::of(&request)?;
        let (inputs, messages) = (self.clone(), request.into_inner());
        // In a task of its own: if this call is dropped with its connection, what has come is stored all the same.
        let receiving = async move { inputs.receive(&caller, &permit, messages).await };
        let outcome = tokio::spawn(receiving.in_current_span()).await;
        outcome.map_err(|error| status::internal(&error))?.map(Response::new)
    }

    async fn get_upload_status(
        &self,
        request: Request<proto::GetUploadStatusRequest>,
    ) -> Result<Response<proto::UploadStatus>, Status> {
        let caller = Caller::of(&request)?;
        let request = request.into_inner();
        let name = name(&caller, &request.parent, &request.upload_id, "upload_id")?;
        let found = self.engine.upload_status(&name).await?;
        Ok(Response::new(proto::UploadStatus {
            committed_bytes: size_to_wire(found.committed),
            input: found.input.as_ref().map(input::uploaded_to_wire),
            size_bytes: size_to_wire(found.bytes),
        }))
    }

    async fn list_inputs(
        &self,
        request: Request<proto::ListInputsRequest>,
    ) -> Result<Response<proto::ListInputsResponse>, Status> {
        let tenant = Caller::of(&request)?.parent(&request.get_ref().parent)?;
        let proto::ListInputsRequest { page_size, page_token, .. } = request.into_inner();
        let Ok(page_size) = u32::try_from(page_size) else {
            return Err(status::violation("page_size", format!("{page_size} is negative")));
        };
        let query = InputQuery { tenant, page_size, page_token: Some(page_token) };
        let page = self.engine.list_inputs(&query).await?;
        Ok(Response::new(proto::ListInputsResponse {
            inputs: page.items.iter().map(input::uploaded_to_wire).collect(),
            next_page_token: page.next_page_token.unwrap_or_default(),
        }))
    }

    async fn delete_input(&self, request: Request<proto::DeleteInputRequest>) -> Result<Response<()>, Status> {
        let caller = Caller::of(&request)?;
        let name = caller.input(&request.get_ref().name, "name")?;
        let (engine, resource) = (self.engine.clone(), name.clone());
        let delete = async move { engine.delete_input(&name).await };
        caller.audited("DeleteInput", resource, delete).await.map(Response::new)
    }
}
