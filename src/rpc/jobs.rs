//! `JobService`.

use std::pin::Pin;

use prost::bytes::{Buf, BufMut, Bytes};
use prost::encoding::{DecodeContext, WireType, skip_field};
use prost::{DecodeError, Message};
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status};
use tracing::Instrument;

use super::caller::Caller;
use super::convert::{self, create, job, list, names};
use super::inflight::{Permit, WORKING_COPIES};
use super::submission::{self, Submission};
use super::{proto, status};
use crate::domain::Limits;
use crate::domain::job::JobName;
use crate::engine::{EncodedResult, Engine, NewJob};
use crate::telemetry;

/// Bytes of a result in one message: large enough that a hundred megabytes are some hundred messages, small enough for
/// every client's default limit of 4 MiB.
const RESULT_CHUNK_BYTES: usize = 256 * 1024;

/// Requests of a batch, as the API says.
pub const MAX_BATCH: usize = 1_000;

/// The service.
#[derive(Clone)]
pub struct Jobs {
    engine: Engine,
    limits: Limits,
    /// Of a message of another caller's, and so of a result that is told in one.
    max_message_bytes: u64,
}

impl Jobs {
    pub fn new(engine: Engine, limits: Limits, max_message_bytes: u64) -> Self {
        Self { engine, limits, max_message_bytes }
    }

    /// Checks every request of a batch before anything is stored.
    async fn read_batch(
        &self,
        caller: &Caller,
        parent: &str,
        requests: Vec<proto::CreateJobRequest>,
        trace_parent: Option<String>,
        permit: &Permit,
    ) -> Result<Vec<NewJob>, Status> {
        let tenant = caller.parent(parent)?;
        if requests.is_empty() || requests.len() > MAX_BATCH {
            let text = format!("{} requests are not 1 to {MAX_BATCH}", requests.len());
            return Err(status::violation("requests", text));
        }
        let mut news = Vec::new();
        for (index, request) in requests.into_iter().enumerate() {
            let read = async {
                let of = names::tenant(&request.parent, &tenant);
                if of.as_ref().is_ok_and(|of| *of != tenant) {
                    let text = format!("is neither left out nor the batch's tenants/{tenant}");
                    return Err(status::violation("parent", text));
                }
                // In full: what is left out would be the caller's own tenant, and an administrator's may be another.
                let parent = of.map_or(request.parent, |of| format!("tenants/{of}"));
                let request = proto::CreateJobRequest { parent, ..request };
                Submission::open(caller, request, &self.limits, permit)?.close(trace_parent.clone()).await
            };
            news.push(read.await.map_err(|found| status::of_request(index, &found))?);
        }
        Ok(news)
    }

    /// The encoded result of a job, charged to the permit.
    ///
    /// * `largest`: a result of more bytes is refused
    async fn read_result(&self, name: JobName, permit: Permit, largest: u64) -> Result<EncodedResult, Status> {
        let engine = self.engine.clone();
        // In a task of its own: what is read is held to its end, also when the call is dropped.
        let reading = async move {
            let job = engine.job(&name).await?;
            let bytes = job.summary.as_ref().map_or(0, |summary| summary.result_size_bytes);
            if bytes > largest {
                return Err(status::result_too_large(&name, bytes, largest));
            }
            permit.hold(WORKING_COPIES.saturating_mul(bytes))?;
            Ok(engine.result(&job).await?)
        };
        let read = tokio::spawn(reading.in_current_span()).await;
        read.map_err(|error| status::internal(&error))?
    }
}

/// A `JobResult` as it is stored: sent byte by byte, so that a server drops nothing that a later version put in. In
/// `build.rs` it stands for that message in the traits of servers.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EncodedJobResult(Vec<u8>);

impl Message for EncodedJobResult {
    fn encode_raw(&self, buf: &mut impl BufMut) {
        buf.put_slice(&self.0);
    }

    /// Servers are sent no results; what prost needs of a message is here.
    fn merge_field(
        &mut self,
        tag: u32,
        wire_type: WireType,
        buf: &mut impl Buf,
        ctx: DecodeContext,
    ) -> Result<(), DecodeError> {
        skip_field(wire_type, tag, buf, ctx)
    }

    fn encoded_len(&self) -> usize {
        self.0.len()
    }

    fn clear(&mut self) {
        self.0.clear();
    }
}

type Messages<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl proto::job_service_server::JobService for Jobs {
    async fn create_job(&self, request: Request<proto::CreateJobRequest>) -> Result<Response<proto::Job>, Status> {
        let caller = Caller::of(&request)?;
        caller.count_jobs(1)?;
        let span = telemetry::tracing::submit_span("CreateJob", caller.trace_parent());
        let created = async {
            let permit = Permit::of(&request)?;
            let submission = Submission::open(&caller, request.into_inner(), &self.limits, &permit)?;
            let trace_parent = telemetry::tracing::traceparent_to_store(&span, caller.trace_parent());
            let new = submission.close(trace_parent).await?;
            let created = submission::store_one(&caller, "CreateJob", &self.engine, new, permit, |job| job).await?;
            telemetry::tracing::record_job(&span, &created.name);
            Ok(Response::new(job::to_wire(&created)))
        };
        created.instrument(span.clone()).await
    }

    async fn batch_create_jobs(
        &self,
        request: Request<proto::BatchCreateJobsRequest>,
    ) -> Result<Response<proto::BatchCreateJobsResponse>, Status> {
        let caller = Caller::of(&request)?;
        // A batch that is longer than it may be is refused below, whatever the rate.
        caller.count_jobs(request.get_ref().requests.len().min(MAX_BATCH))?;
        let span = telemetry::tracing::submit_span("BatchCreateJobs", caller.trace_parent());
        let created = async {
            let permit = Permit::of(&request)?;
            let proto::BatchCreateJobsRequest { parent, requests } = request.into_inner();
            let trace_parent = telemetry::tracing::traceparent_to_store(&span, caller.trace_parent());
            let news = self.read_batch(&caller, &parent, requests, trace_parent, &permit).await?;
            let refusal = status::of_batch;
            let all = std::convert::identity;
            let created =
                submission::store(&caller, "BatchCreateJobs", &self.engine, news, permit, refusal, all).await?;
            Ok(Response::new(proto::BatchCreateJobsResponse { jobs: created.iter().map(job::to_wire).collect() }))
        };
        created.instrument(span.clone()).await
    }

    async fn get_job(&self, request: Request<proto::GetJobRequest>) -> Result<Response<proto::Job>, Status> {
        let name = Caller::of(&request)?.job(&request.get_ref().name)?;
        let found = self.engine.job(&name).await?;
        Ok(Response::new(job::to_wire(&found)))
    }

    async fn list_jobs(
        &self,
        request: Request<proto::ListJobsRequest>,
    ) -> Result<Response<proto::ListJobsResponse>, Status> {
        let tenant = Caller::of(&request)?.parent(&request.get_ref().parent)?;
        let query = list::from_wire(tenant, request.into_inner()).map_err(status::invalid)?;
        let Some(query) = query else {
            return Ok(Response::new(proto::ListJobsResponse::default()));
        };
        let page = self.engine.list(&query).await?;
        Ok(Response::new(proto::ListJobsResponse {
            jobs: page.items.iter().map(job::to_wire).collect(),
            next_page_token: page.next_page_token.unwrap_or_default(),
        }))
    }

    type WatchJobStream = Messages<proto::JobEvent>;

    async fn watch_job(
        &self,
        request: Request<proto::WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let name = Caller::of(&request)?.job(&request.get_ref().name)?;
        let after_sequence = request.get_ref().after_sequence;
        let watch = self.engine.watch(&name, after_sequence).await?;
        let watching = telemetry::metrics::watcher();
        let events = watch.into_stream().map(move |event| {
            // Counted for as long as the stream lives.
            let _ = &watching;
            event.map(job::event_to_wire).map_err(Status::from)
        });
        Ok(Response::new(Box::pin(events)))
    }

    async fn cancel_job(&self, request: Request<proto::CancelJobRequest>) -> Result<Response<proto::Job>, Status> {
        let caller = Caller::of(&request)?;
        let name = caller.job(&request.get_ref().name)?;
        let etag = convert::given(request.into_inner().etag);
        let (engine, resource) = (self.engine.clone(), name.clone());
        let cancel = async move { engine.cancel(&name, etag).await };
        let cancelled = caller.audited("CancelJob", resource, cancel).await?;
        Ok(Response::new(job::to_wire(&cancelled)))
    }

    async fn delete_job(&self, request: Request<proto::DeleteJobRequest>) -> Result<Response<()>, Status> {
        let caller = Caller::of(&request)?;
        let name = caller.job(&request.get_ref().name)?;
        let etag = convert::given(request.into_inner().etag);
        let (engine, resource) = (self.engine.clone(), name.clone());
        let delete = async move { engine.delete(&name, etag.as_deref()).await };
        caller.audited("DeleteJob", resource, delete).await.map(Response::new)
    }

    async fn retry_job(&self, request: Request<proto::RetryJobRequest>) -> Result<Response<proto::Job>, Status> {
        let caller = Caller::of(&request)?;
        let name = caller.job(&request.get_ref().name)?;
        let etag = convert::given(request.into_inner().etag);
        let (engine, resource) = (self.engine.clone(), name.clone());
        let counted = caller.count_jobs(1);
        let retry = async move {
            counted?;
            Ok::<_, Status>(engine.retry(&name, etag).await?)
        };
        let retried = caller.audited("RetryJob", resource, retry).await?;
        Ok(Response::new(job::to_wire(&retried)))
    }

    async fn set_job_priority(
        &self,
        request: Request<proto::SetJobPriorityRequest>,
    ) -> Result<Response<proto::Job>, Status> {
        let caller = Caller::of(&request)?;
        let name = caller.job(&request.get_ref().name)?;
        let proto::SetJobPriorityRequest { priority, etag, .. } = request.into_inner();
        let checked = convert::required(priority, "priority")
            .and_then(|priority| create::check_priority(priority, "priority").map(|()| priority));
        let priority = checked.map_err(status::invalid)?;
        let etag = convert::given(etag);
        let (engine, resource) = (self.engine.clone(), name.clone());
        let change = async move { engine.set_priority(&name, etag.as_deref(), priority).await };
        let changed = caller.audited("SetJobPriority", resource, change).await?;
        Ok(Response::new(job::to_wire(&changed)))
    }

    async fn get_job_result(
        &self,
        request: Request<proto::GetJobResultRequest>,
    ) -> Result<Response<EncodedJobResult>, Status> {
        let name = Caller::of(&request)?.job(&request.get_ref().name)?;
        let permit = Permit::of(&request)?;
        let result = self.read_result(name, permit, self.max_message_bytes).await?;
        Ok(Response::new(EncodedJobResult(result.bytes)))
    }

    type ReadJobResultStream = Messages<proto::ResultChunk>;

    async fn read_job_result(
        &self,
        request: Request<proto::ReadJobResultRequest>,
    ) -> Result<Response<Self::ReadJobResultStream>, Status> {
        let name = Caller::of(&request)?.job(&request.get_ref().name)?;
        let offset = request.get_ref().offset;
        let permit = Permit::of(&request)?;
        let EncodedResult { bytes, sha256 } = self.read_result(name, permit.clone(), u64::MAX).await?;
        permit.hold(bytes.len() as u64)?;
        let (encoded, sha256) = (Bytes::from(bytes), Bytes::copy_from_slice(&sha256));
        let Some(from) = usize::try_from(offset).ok().filter(|&from| from <= encoded.len()) else {
            let text = format!("{offset} is not within the {} bytes of the result", encoded.len());
            return Err(status::violation("offset", text));
        };
        let chunks = result_chunks(encoded, sha256, from).map(move |chunk| {
            // Held for as long as the stream lives.
            let _ = &permit;
            Ok(chunk)
        });
        Ok(Response::new(Box::pin(tokio_stream::iter(chunks))))
    }
}

/// Cuts a result into messages without copying it. One message at least, so that every read learns the size.
fn result_chunks(encoded: Bytes, sha256: Bytes, from: usize) -> impl Iterator<Item = proto::ResultChunk> + Send {
    let total = encoded.len();
    let mut at = Some(from);
    std::iter::from_fn(move || {
        let begin = at?;
        let end = total.min(begin + RESULT_CHUNK_BYTES);
        at = (end < total).then_some(end);
        let data = encoded.slice(begin..end);
        Some(proto::ResultChunk { data, offset: begin as i64, size_bytes: total as i64, sha256: sha256.clone() })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_cover_a_result_from_any_offset() {
        let total = 2 * RESULT_CHUNK_BYTES + 10;
        let encoded = Bytes::from((0..total).map(|k| (k % 251) as u8).collect::<Vec<_>>());
        let sha256 = Bytes::from_static(b"digest");
        for (from, count) in [(0, 3), (1, 3), (RESULT_CHUNK_BYTES, 2), (total - 10, 1), (total, 1)] {
            let chunks: Vec<_> = result_chunks(encoded.clone(), sha256.clone(), from).collect();
            assert_eq!(chunks.len(), count, "from {from}");
            let mut at = from;
            for chunk in &chunks {
                assert_eq!((chunk.offset, chunk.size_bytes, &chunk.sha256), (at as i64, total as i64, &sha256));
                assert_eq!(chunk.data, encoded.slice(at..at + chunk.data.len()));
                at += chunk.data.len();
            }
            assert_eq!(at, total);
        }
    }
}
