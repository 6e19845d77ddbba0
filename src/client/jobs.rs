//! Calls of the job API.

use std::collections::BTreeMap;
use std::time::Duration;

use prost::Message;
use prost::bytes::Bytes;
use sha2::{Digest, Sha256};
use tonic::{Status, Streaming};

use super::backoff::Backoff;
use super::{Client, EncodedInput, Error, JobInput, OWN_TENANT};
use crate::domain::job::{EventBody, Failure, Job, JobEvent, JobName, JobState};
use crate::domain::{InputName, Solution, SolveSettings};
use crate::rpc::convert;
use crate::rpc::proto::{self, create_job_request::Source};

/// Largest message that any server takes, see `server.max_message_bytes`.
const LEAST_MAX_MESSAGE_BYTES: usize = 1 << 20;

/// What a request takes at most beside its input and what its caller says: the fields around them, or the name of an
/// uploaded input.
pub(super) const BESIDE_BYTES: usize = 256;

/// What a caller says of a job beside input and settings.
#[derive(Debug, Clone, Default)]
pub struct JobOptions {
    /// Last part of the job's name; `None`: the server chooses one.
    pub job_id: Option<String>,
    /// The same id and job give the same job; `None`: one is made, so that a broken call can be repeated. An input that
    /// is sent and the same one uploaded are not the same job, whose id is refused then.
    pub request_id: Option<String>,
    /// Marks to find the job by.
    pub labels: BTreeMap<String, String>,
    /// Larger is sooner, among the jobs of the tenant.
    pub priority: i32,
    /// Time after which a job without a result ends.
    pub time_limit: Option<Duration>,
    /// Where the server sends the job's end.
    pub webhook_url: Option<String>,
}

/// One page of a list.
#[derive(Debug)]
pub struct Page {
    /// The newest first.
    pub jobs: Vec<Job>,
    /// Empty on the last page.
    pub next_page_token: String,
}

impl Client {
    /// Creates a job that lives on without this client. An input that is larger than the server's messages is
    /// [uploaded](Self::upload) first, and stays with the server as one that was uploaded by itself.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn create(
        &mut self,
        input: impl Into<JobInput>,
        settings: &SolveSettings,
        options: JobOptions,
    ) -> Result<Job, Error> {
        let (input, mut request) = (input.into(), create_request(self.parent(), settings, options));
        let beside = request.encoded_len() + BESIDE_BYTES;
        let mut room = self.room_for_inputs(beside, input.encoded_len()).await?;
        request.source = Some(self.source(input, &mut room).await?);
        let mut backoff = Backoff::default();
        loop {
            match backoff.within(self.jobs.create_job(request.clone())).await {
                Ok(job) => return Ok(convert::job::from_wire(job.into_inner())?),
                Err(status) => self.pause_to_store(&mut backoff, status).await?,
            }
        }
    }

    /// Bytes that a message has for inputs, which take `wanted`, beside the rest of its requests.
    pub(super) async fn room_for_inputs(&mut self, beside: usize, wanted: usize) -> Result<usize, Error> {
        let mut most = LEAST_MAX_MESSAGE_BYTES;
        if beside + wanted > most {
            let send = |mut client: Self, request| async move { client.calibration.get_capabilities(request).await };
            let limits = self.call(proto::GetCapabilitiesRequest {}, send).await?.input_limits;
            most = limits.and_then(|limits| usize::try_from(limits.max_message_bytes).ok()).unwrap_or(most);
        }
        Ok(most.saturating_sub(beside))
    }

    /// An input as a request has it: in the message where there is `room` for it, which it takes; uploaded elsewhere.
    pub(super) async fn source(&mut self, input: JobInput, room: &mut usize) -> Result<Source, Error> {
        let name = match input {
            JobInput::Data(data) => {
                if let Some(left) = room.checked_sub(data.encoded_len()) {
                    *room = left;
                    return Ok(data.into_source());
                }
                let on_upload = self.on_upload.clone();
                let input = EncodedInput::new(data);
                let on_progress = &mut |bytes| on_upload.iter().for_each(|on_upload| on_upload(bytes, input.len()));
                self.upload(&input, on_progress).await?
            }
            JobInput::Uploaded(name) => name,
        };
        Ok(Source::Input(name.to_string()))
    }

    /// A job as it stands.
    ///
    /// # Errors
    /// See [`Error`]; [`ErrorKind::Refused`](super::ErrorKind::Refused) where there is none of this name.
    pub async fn get(&mut self, name: &JobName) -> Result<Job, Error> {
        let request = proto::GetJobRequest { name: name.to_string() };
        let job = self.call(request, |mut client, request| async move { client.jobs.get_job(request).await });
        Ok(convert::job::from_wire(job.await?)?)
    }

    /// One page of the jobs that `filter` lets through, the newest first.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn list(&mut self, filter: &str, page_size: u16, page_token: &str) -> Result<Page, Error> {
        let request = proto::ListJobsRequest {
            parent: self.parent(),
            page_size: page_size.into(),
            page_token: page_token.to_owned(),
            filter: filter.to_owned(),
            order_by: String::new(),
        };
        let page =
            self.call(request, |mut client, request| async move { client.jobs.list_jobs(request).await }).await?;
        let jobs = page.jobs.into_iter().map(convert::job::from_wire).collect::<Result<_, _>>()?;
        Ok(Page { jobs, next_page_token: page.next_page_token })
    }

    /// The tenant of the calls. Where only the key knows it, it is read from the name of a job or an input; `None` where
    /// the tenant has neither.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn own_tenant(&mut self) -> Result<Option<String>, Error> {
        if self.tenant != OWN_TENANT {
            return Ok(Some(self.tenant.clone()));
        }
        if let Some(job) = self.list("", 1, "").await?.jobs.into_iter().next() {
            return Ok(Some(job.name.tenant));
        }
        let input = self.list_inputs(1, "").await?.inputs.into_iter().next();
        Ok(input.and_then(|input| InputName::parse(&input.name)).map(|name| name.tenant))
    }

    /// Cancels a job: one that waits at once, one that runs soon; one that has ended stays as it is. Returns it as it
    /// stands then.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn cancel(&mut self, name: &JobName) -> Result<Job, Error> {
        let request = proto::CancelJobRequest { name: name.to_string(), etag: String::new() };
        let job = self.call(request, |mut client, request| async move { client.jobs.cancel_job(request).await });
        Ok(convert::job::from_wire(job.await?)?)
    }

    /// Puts a job that ended without a result into the queue again.
    ///
    /// # Errors
    /// See [`Error`]; [`ErrorKind::Refused`](super::ErrorKind::Refused) for one that has succeeded.
    pub async fn retry(&mut self, name: &JobName) -> Result<Job, Error> {
        let request = proto::RetryJobRequest { name: name.to_string(), etag: String::new() };
        let job = self.call(request, |mut client, request| async move { client.jobs.retry_job(request).await });
        Ok(convert::job::from_wire(job.await?)?)
    }

    /// Changes the priority of a job that waits.
    ///
    /// # Errors
    /// See [`Error`]; [`ErrorKind::Refused`](super::ErrorKind::Refused) for one that does not wait.
    pub async fn set_priority(&mut self, name: &JobName, priority: i32) -> Result<Job, Error> {
        let request =
            proto::SetJobPriorityRequest { name: name.to_string(), priority: Some(priority), etag: String::new() };
        let job = self.call(request, |mut client, request| async move { client.jobs.set_job_priority(request).await });
        Ok(convert::job::from_wire(job.await?)?)
    }

    /// Removes a job that has ended.
    ///
    /// # Errors
    /// See [`Error`]; [`ErrorKind::Refused`](super::ErrorKind::Refused) for one that has not ended.
    pub async fn delete(&mut self, name: &JobName) -> Result<(), Error> {
        let request = proto::DeleteJobRequest { name: name.to_string(), etag: String::new() };
        self.call(request, |mut client, request| async move { client.jobs.delete_job(request).await }).await
    }

    /// Tells a job's events after a sequence number until its end, over broken connections and restarts of the server.
    ///
    /// How the job ended is in the event that is returned, its last; `None` where the job has ended and nothing came
    /// after that number.
    ///
    /// # Errors
    /// What went wrong with the watch.
    pub async fn watch(
        &mut self,
        name: &JobName,
        after_sequence: u64,
        on_event: &mut (dyn FnMut(&JobEvent) + Send),
    ) -> Result<Option<JobEvent>, Error> {
        let mut follower = EventFollower { last_sequence: after_sequence, on_event };
        let mut backoff = Backoff::default();
        loop {
            let request = proto::WatchJobRequest { name: name.to_string(), after_sequence: follower.last_sequence };
            let outcome = match backoff.within(self.jobs.watch_job(request)).await {
                Ok(events) => follower.follow(events.into_inner(), &mut backoff).await?,
                Err(status) => Err(status),
            };
            match outcome {
                Ok(last) => return Ok(last),
                Err(status) => self.pause(&mut backoff, status).await?,
            }
        }
    }

    /// Reads a result.
    ///
    /// # Errors
    /// See [`Error`]; [`ErrorKind::Refused`](super::ErrorKind::Refused) while there is none.
    pub async fn read_result(&mut self, name: &JobName) -> Result<Solution, Error> {
        let mut bytes = Vec::new();
        let mut backoff = Backoff::default();
        let sha256 = loop {
            match self.read_on(name, &mut bytes, &mut backoff).await? {
                Ok(sha256) => break sha256,
                Err(status) => self.pause(&mut backoff, status).await?,
            }
        };
        if Sha256::digest(&bytes)[..] != sha256[..] {
            return Err(Error::failed("the result is not what the server stored: read it again"));
        }
        let result = proto::JobResult::decode(bytes.as_slice())
            .map_err(|error| Error::failed(format!("the server's result cannot be decoded: {error}")))?;
        Ok(convert::result::from_wire(result)?)
    }

    /// Reads on from what is there to the end, and returns the digest of the whole; the inner error is worth another try.
    async fn read_on(
        &mut self,
        name: &JobName,
        bytes: &mut Vec<u8>,
        backoff: &mut Backoff,
    ) -> Result<Result<Bytes, Status>, Error> {
        let request = proto::ReadJobResultRequest { name: name.to_string(), offset: bytes.len() as i64 };
        let mut chunks = match backoff.within(self.jobs.read_job_result(request)).await {
            Ok(chunks) => chunks.into_inner(),
            Err(status) => return Ok(Err(status)),
        };
        let (mut total, mut sha256) = (0, Bytes::new());
        loop {
            match chunks.message().await {
                Ok(Some(chunk)) if chunk.offset == bytes.len() as i64 => {
                    (total, sha256) = (chunk.size_bytes, chunk.sha256);
                    bytes.extend_from_slice(&chunk.data);
                    backoff.reset();
                }
                Ok(Some(chunk)) => {
                    let text = format!("a chunk begins at {} where {} was due", chunk.offset, bytes.len());
                    return Err(Error::failed(text));
                }
                Ok(None) if total == bytes.len() as i64 => return Ok(Ok(sha256)),
                Ok(None) => return Err(Error::failed(format!("the result ended at {} of {total}", bytes.len()))),
                Err(status) => return Ok(Err(status)),
            }
        }
    }
}

/// Passes events on, each sequenced one once.
pub(super) struct EventFollower<'a> {
    pub(super) last_sequence: u64,
    pub(super) on_event: &'a mut (dyn FnMut(&JobEvent) + Send),
}

impl EventFollower<'_> {
    /// The event where it is a new one of a kind that this version knows.
    fn take(&mut self, event: proto::JobEvent, backoff: &mut Backoff) -> Result<Option<JobEvent>, Error> {
        if (1..=self.last_sequence).contains(&event.sequence) {
            return Ok(None);
        }
        backoff.reset();
        self.last_sequence = self.last_sequence.max(event.sequence);
        Ok(convert::job::event_from_wire(event)?)
    }

    /// Follows one stream, which the server has just taken, to its end. The inner error is worth another try; `None`:
    /// it ended without a terminal state.
    pub(super) async fn follow(
        &mut self,
        mut events: Streaming<proto::JobEvent>,
        backoff: &mut Backoff,
    ) -> Result<Result<Option<JobEvent>, Status>, Error> {
        backoff.accepted();
        // The end of the job, unless more comes: it may have been retried since.
        let mut end = None;
        loop {
            let event = match events.message().await {
                Ok(Some(event)) => event,
                Ok(None) => return Ok(Ok(end)),
                Err(status) => return Ok(end.map(Some).ok_or(status)),
            };
            // An unknown event takes no end back: a retried job tells first that it is queued.
            let Some(event) = self.take(event, backoff)? else { continue };
            (self.on_event)(&event);
            let is_end = matches!(event.body, EventBody::State { state, .. } if state.is_terminal());
            end = is_end.then_some(event);
        }
    }
}

/// `Ok` when a job's last event says that its result stands.
///
/// # Errors
/// [`ErrorKind::Cancelled`](super::ErrorKind::Cancelled), or [`ErrorKind::Failed`](super::ErrorKind::Failed) with the
/// reason.
pub fn ended(last: &JobEvent) -> Result<(), Error> {
    match &last.body {
        EventBody::State { state, failure } => ended_as(&last.job, *state, failure.as_ref()),
        _ => Err(Error::failed(format!("{} did not succeed", last.job))),
    }
}

/// The same of a job's state.
///
/// # Errors
/// See [`ended`].
pub fn ended_as(name: &JobName, state: JobState, failure: Option<&Failure>) -> Result<(), Error> {
    match (state, failure) {
        (JobState::Succeeded, _) => Ok(()),
        (JobState::Cancelled, _) => Err(Error::cancelled()),
        (JobState::DeadlineExceeded, _) => {
            Err(Error::failed(format!("{name} exceeded its deadline before a result stood")))
        }
        (_, Some(failure)) => Err(Error::failed(format!("{name} failed: {} ({})", failure.message, failure.reason))),
        _ => Err(Error::failed(format!("{name} did not succeed"))),
    }
}

/// A request without its input, with a request id, so that it can be made again where the answer is lost.
pub(super) fn create_request(parent: String, settings: &SolveSettings, options: JobOptions) -> proto::CreateJobRequest {
    // What the wire cannot say is far above what a server takes: it says so.
    let time_limit = options.time_limit.map(|limit| prost_types::Duration {
        seconds: i64::try_from(limit.as_secs()).unwrap_or(i64::MAX),
        nanos: limit.subsec_nanos() as i32,
    });
    proto::CreateJobRequest {
        parent,
        job_id: options.job_id.unwrap_or_default(),
        request_id: options.request_id.unwrap_or_else(|| uuid::Uuid::now_v7().to_string()),
        job: Some(proto::Job {
            settings: Some(convert::settings::to_wire(settings)),
            labels: options.labels,
            priority: options.priority,
            deadline: time_limit.map(proto::job::Deadline::TimeLimit),
            webhook: options.webhook_url.map(|url| proto::Webhook { url, ..proto::Webhook::default() }),
            ..proto::Job::default()
        }),
        source: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_taken_once_and_unknown_ones_are_passed_over() {
        let mut backoff = Backoff::default();
        let mut follower = EventFollower { last_sequence: 4, on_event: &mut |_| () };
        let mut take = |sequence, body| {
            let event = proto::JobEvent {
                job: "tenants/default/jobs/a".into(),
                sequence,
                time: Some(Default::default()),
                body,
                ..Default::default()
            };
            let taken = follower.take(event, &mut backoff).expect("well formed");
            (taken.and_then(|event| event.sequence), follower.last_sequence)
        };
        let queued = Some(proto::job_event::Body::StateChange(proto::StateChange { state: 1, error: None }));
        assert_eq!(take(4, queued.clone()), (None, 4));
        assert_eq!(take(5, queued.clone()), (Some(5), 5));
        assert_eq!(take(6, None), (None, 6));
        assert_eq!(take(6, queued.clone()), (None, 6));
        assert_eq!(take(7, queued), (Some(7), 7));
        let weights = proto::InterimWeights { iteration: 1, weights: vec![0.5] };
        assert_eq!(take(0, Some(proto::job_event::Body::Weights(weights))), (None, 7), "unsequenced");
    }
}
