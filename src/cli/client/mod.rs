//! The client side of the API: what every command that talks to a server shares.
//!
//! Calls that may be repeated are repeated when the connection breaks, for a bounded time: a watch goes on after its
//! last event, a result after its last byte, a creation under its request id.

pub mod access;
mod backoff;
mod batch;
mod error;
mod handshake;
pub mod upload;
mod uploaded_inputs;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use prost::Message;
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding::Gzip;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status, Streaming};

pub use error::Error;

use self::access::{AccessArgs, Bearer};
use self::backoff::Backoff;
use super::args::ServerArgs;
use crate::domain::job::{EventBody, Failure, Job, JobEvent, JobName, JobState};
use crate::domain::{InputName, RawInput, Solution, SolveSettings};
use crate::rpc::convert;
use crate::rpc::proto::{
    self, calibration_service_client as calibration, create_job_request::Input as JobInput,
    input_service_client as inputs, job_service_client as jobs,
};

/// A server that does not answer within this is not there.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// A silent connection is asked this often whether it lives, so that a watch of a long job notices a lost server.
const KEEPALIVE: Duration = Duration::from_secs(20);

/// Largest answer that is taken: interim weights of the most tracks that any server allows are below it.
const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// What a caller says of a job beside input and settings.
#[derive(Debug, Clone, Default)]
pub struct JobOptions {
    pub job_id: Option<String>,
    /// `None`: one is made, so that a broken call can be repeated.
    pub request_id: Option<String>,
    pub labels: BTreeMap<String, String>,
    pub priority: i32,
    pub time_limit: Option<Duration>,
}

/// One page of a list.
#[derive(Debug)]
pub struct Page {
    pub jobs: Vec<Job>,
    /// Empty on the last page.
    pub next_page_token: String,
}

/// A connection whose every call carries the API key, where there is one.
type Keyed = InterceptedService<Channel, Bearer>;

/// A connection to a server; reconnects by itself.
#[derive(Debug, Clone)]
pub struct Client {
    jobs: jobs::JobServiceClient<Keyed>,
    calibration: calibration::CalibrationServiceClient<Keyed>,
    inputs: inputs::InputServiceClient<Keyed>,
    server: String,
    /// Whose jobs are created and listed.
    tenant: String,
}

impl Client {
    /// Connects.
    ///
    /// # Errors
    /// [`Error::Unavailable`] where no server answers, [`Error::NotLetIn`] where one side does not trust the other,
    /// [`Error::Usage`] for what is not a URL and for files of certificates or keys that cannot be used.
    pub async fn connect(server: &str, access: &AccessArgs) -> Result<Self, Error> {
        if server.contains('@') {
            // Not repeated: what stands there may be a password.
            return Err(Error::Usage(
                "the server's address holds a user or a password (`@`), which no server asks for: an API key goes into \
                 --api-key-file or SCPSFM_API_KEY"
                    .into(),
            ));
        }
        let no_url =
            || Error::Usage(format!("{server:?} is not a URL of the form http://HOST:PORT or https://HOST:PORT"));
        if !server.starts_with("http://") && !server.starts_with("https://") {
            return Err(no_url());
        }
        let tenant = access.tenant()?;
        let endpoint = Endpoint::from_shared(server.to_owned())
            .map_err(|_| no_url())?
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(KEEPALIVE);
        let bearer = access.bearer(&endpoint)?;
        let endpoint = access.secure(endpoint)?;
        let channel = endpoint.connect().await.map_err(|error| error::not_connected(server, &error))?;
        let channel = InterceptedService::new(channel, bearer);
        let jobs = jobs::JobServiceClient::new(channel.clone());
        let calibration = calibration::CalibrationServiceClient::new(channel.clone());
        Ok(Self {
            jobs: jobs.accept_compressed(Gzip).send_compressed(Gzip).max_decoding_message_size(MAX_MESSAGE_BYTES),
            calibration: calibration
                .accept_compressed(Gzip)
                .send_compressed(Gzip)
                .max_decoding_message_size(MAX_MESSAGE_BYTES),
            // Coordinates hardly become shorter by compression.
            inputs: inputs::InputServiceClient::new(channel),
            server: server.to_owned(),
            tenant,
        })
    }

    /// The server's address, as it was given.
    pub fn server(&self) -> &str {
        &self.server
    }

    fn parent(&self) -> String {
        format!("tenants/{}", self.tenant)
    }

    fn error(&self, status: Status) -> Error {
        Error::from_status(&self.server, &status)
    }

    /// Creates a job that lives on without this client.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn create(
        &mut self,
        input: &RawInput,
        settings: &SolveSettings,
        options: JobOptions,
    ) -> Result<Job, Error> {
        self.create_of(JobInput::TrackSet(convert::input::to_wire(input)), settings, options).await
    }

    /// The same with an input that was uploaded.
    ///
    /// # Errors
    /// See [`Error`].
    pub async fn create_with(
        &mut self,
        input: &InputName,
        settings: &SolveSettings,
        options: JobOptions,
    ) -> Result<Job, Error> {
        self.create_of(JobInput::InputName(input.to_string()), settings, options).await
    }

    async fn create_of(
        &mut self,
        input: JobInput,
        settings: &SolveSettings,
        options: JobOptions,
    ) -> Result<Job, Error> {
        let request = create_request(self.parent(), input, settings, options);
        let mut backoff = Backoff::default();
        loop {
            match backoff.within(self.jobs.create_job(request.clone())).await {
                Ok(job) => return Ok(convert::job::from_wire(job.into_inner())?),
                Err(status) => self.pause(&mut backoff, status).await?,
            }
        }
    }

    /// # Errors
    /// See [`Error`].
    pub async fn get(&mut self, name: &JobName) -> Result<Job, Error> {
        let answer = self.jobs.get_job(proto::GetJobRequest { name: name.to_string() }).await;
        Ok(convert::job::from_wire(answer.map_err(|status| self.error(status))?.into_inner())?)
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
        let page = self.jobs.list_jobs(request).await.map_err(|status| self.error(status))?.into_inner();
        let jobs = page.jobs.into_iter().map(convert::job::from_wire).collect::<Result<_, _>>()?;
        Ok(Page { jobs, next_page_token: page.next_page_token })
    }

    /// # Errors
    /// See [`Error`].
    pub async fn cancel(&mut self, name: &JobName) -> Result<Job, Error> {
        let request = proto::CancelJobRequest { name: name.to_string(), etag: String::new() };
        let answer = self.jobs.cancel_job(request).await;
        Ok(convert::job::from_wire(answer.map_err(|status| self.error(status))?.into_inner())?)
    }

    /// Removes a job that has ended.
    ///
    /// # Errors
    /// See [`Error`]; [`Error::Refused`] for one that has not ended.
    pub async fn delete(&mut self, name: &JobName) -> Result<(), Error> {
        let request = proto::DeleteJobRequest { name: name.to_string(), etag: String::new() };
        self.jobs.delete_job(request).await.map(|_| ()).map_err(|status| self.error(status))
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
        let mut told = Told { last_sequence: after_sequence, on_event };
        let mut backoff = Backoff::default();
        loop {
            let request = proto::WatchJobRequest { name: name.to_string(), after_sequence: told.last_sequence };
            let outcome = match backoff.within(self.jobs.watch_job(request)).await {
                Ok(events) => told.follow(events.into_inner(), &mut backoff).await?,
                Err(status) => Err(status),
            };
            match outcome {
                Ok(last) => return Ok(last),
                Err(status) => self.pause(&mut backoff, status).await?,
            }
        }
    }

    /// Creates a job, follows it to its end and reads its result. When `stop` is cancelled, so is the job.
    ///
    /// # Errors
    /// See [`Error`]; a job that ended without a result is an error here.
    pub async fn solve(
        &mut self,
        input: &RawInput,
        settings: &SolveSettings,
        on_event: &mut (dyn FnMut(&JobEvent) + Send),
        stop: CancellationToken,
    ) -> Result<Solution, Error> {
        let mut name = None;
        let mut on_named_event = |event: &JobEvent| {
            name.get_or_insert_with(|| event.name.clone());
            on_event(event);
        };
        let mut solving = self.clone();
        let last = tokio::select! {
            last = solving.follow_solve(input, settings, &mut on_named_event) => last?,
            () = stop.cancelled() => {
                if let Some(name) = &name {
                    self.cancel(name).await?;
                }
                return Err(Error::Cancelled);
            }
        };
        ended(&last)?;
        self.read_result(&last.name).await
    }

    /// A broken call is made again under the same request id: it takes up the job within the server's grace period, and
    /// tells its events anew, of which only new ones are passed on.
    async fn follow_solve(
        &mut self,
        input: &RawInput,
        settings: &SolveSettings,
        on_event: &mut (dyn FnMut(&JobEvent) + Send),
    ) -> Result<JobEvent, Error> {
        let input = Arc::new(input.clone());
        let config = create_request(
            self.parent(),
            JobInput::TrackSet(convert::input::head_to_wire(&input)),
            settings,
            JobOptions::default(),
        );
        let mut told = Told { last_sequence: 0, on_event };
        let mut backoff = Backoff::default();
        loop {
            use proto::solve_request::Message;
            let chunks = convert::input::chunks(Arc::clone(&input)).map(Message::TrackSetChunk);
            let messages = std::iter::once(Message::Config(config.clone())).chain(chunks);
            let messages = messages.map(|message| proto::SolveRequest { message: Some(message) });
            let outcome = match self.calibration.solve(Request::new(tokio_stream::iter(messages))).await {
                Ok(events) => told.follow(events.into_inner(), &mut backoff).await?,
                Err(status) => Err(status),
            };
            match outcome {
                Ok(Some(last)) => return Ok(last),
                Ok(None) => return Err(Error::Failed("the server ended a solve without its last event".into())),
                Err(status) => self.pause(&mut backoff, status).await?,
            }
        }
    }

    /// Reads a result.
    ///
    /// # Errors
    /// See [`Error`]; [`Error::Refused`] while there is none.
    pub async fn read_result(&mut self, name: &JobName) -> Result<Solution, Error> {
        let mut bytes = Vec::new();
        let mut backoff = Backoff::default();
        while let Err(status) = self.read_on(name, &mut bytes, &mut backoff).await? {
            self.pause(&mut backoff, status).await?;
        }
        let result = proto::JobResult::decode(bytes.as_slice())
            .map_err(|error| Error::Failed(format!("the server's result cannot be decoded: {error}")))?;
        Ok(convert::result::from_wire(result)?)
    }

    /// Reads on from what is there; the inner error is worth another try.
    async fn read_on(
        &mut self,
        name: &JobName,
        bytes: &mut Vec<u8>,
        backoff: &mut Backoff,
    ) -> Result<Result<(), Status>, Error> {
        let request = proto::ReadJobResultRequest { name: name.to_string(), offset: bytes.len() as i64 };
        let mut chunks = match backoff.within(self.jobs.read_job_result(request)).await {
            Ok(chunks) => chunks.into_inner(),
            Err(status) => return Ok(Err(status)),
        };
        let mut total = 0;
        loop {
            match chunks.message().await {
                Ok(Some(chunk)) if chunk.offset == bytes.len() as i64 => {
                    total = chunk.total_size;
                    bytes.extend_from_slice(&chunk.data);
                    backoff.reset();
                }
                Ok(Some(chunk)) => {
                    let text = format!("a chunk begins at {} where {} was due", chunk.offset, bytes.len());
                    return Err(Error::Failed(text));
                }
                Ok(None) if total == bytes.len() as i64 => return Ok(Ok(())),
                Ok(None) => return Err(Error::Failed(format!("the result ended at {} of {total}", bytes.len()))),
                Err(status) => return Ok(Err(status)),
            }
        }
    }

    /// Waits before another try, or gives up: for good reason, or after too many. Says so once each trouble, on stderr:
    /// a quarter of a minute of silence looks like a hang.
    async fn pause(&self, backoff: &mut Backoff, status: Status) -> Result<(), Error> {
        let transient = error::is_transient(&status);
        let first = transient && backoff.failed(&status);
        let error = self.error(status);
        if first {
            eprintln!("waiting up to {} s: {error}", Backoff::TOTAL.as_secs());
        }
        if transient && backoff.pause().await { Ok(()) } else { Err(error) }
    }
}

/// Passes events on, each sequenced one once.
struct Told<'a> {
    last_sequence: u64,
    on_event: &'a mut (dyn FnMut(&JobEvent) + Send),
}

impl Told<'_> {
    /// Follows one stream to its end. The inner error is worth another try; `None`: it ended without a terminal state.
    async fn follow(
        &mut self,
        mut events: Streaming<proto::JobEvent>,
        backoff: &mut Backoff,
    ) -> Result<Result<Option<JobEvent>, Status>, Error> {
        loop {
            let event = match events.message().await {
                Ok(Some(event)) => convert::job::event_from_wire(event)?,
                Ok(None) => return Ok(Ok(None)),
                Err(status) => return Ok(Err(status)),
            };
            if event.sequence.is_some_and(|sequence| sequence <= self.last_sequence) {
                continue;
            }
            backoff.reset();
            self.last_sequence = event.sequence.unwrap_or(self.last_sequence);
            (self.on_event)(&event);
            if matches!(event.body, EventBody::State { state, .. } if state.is_terminal()) {
                return Ok(Ok(Some(event)));
            }
        }
    }
}

/// `Ok` when a job's last event says that its result stands.
///
/// # Errors
/// [`Error::Cancelled`], or [`Error::Failed`] with the reason.
pub fn ended(last: &JobEvent) -> Result<(), Error> {
    match &last.body {
        EventBody::State { state, failure } => ended_as(&last.name, *state, failure.as_ref()),
        _ => Err(Error::Failed(format!("{} did not succeed", last.name))),
    }
}

/// The same of a job's state.
///
/// # Errors
/// See [`ended`].
pub fn ended_as(name: &JobName, state: JobState, failure: Option<&Failure>) -> Result<(), Error> {
    match (state, failure) {
        (JobState::Succeeded, _) => Ok(()),
        (JobState::Cancelled, _) => Err(Error::Cancelled),
        (JobState::Expired, _) => {
            Err(Error::Failed(format!("{name} expired: its deadline passed before a result stood")))
        }
        (_, Some(failure)) => Err(Error::Failed(format!("{name} failed: {} ({})", failure.message, failure.reason))),
        _ => Err(Error::Failed(format!("{name} did not succeed"))),
    }
}

fn create_request(
    parent: String,
    input: JobInput,
    settings: &SolveSettings,
    options: JobOptions,
) -> proto::CreateJobRequest {
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
            ..proto::Job::default()
        }),
        input: Some(input),
    }
}

/// Runs one job on a server: what `scpsfm solve --server` and `scpsfm demo` do. See [`Client::solve`].
///
/// # Errors
/// See [`Error`].
pub async fn solve(
    server: &ServerArgs,
    input: &RawInput,
    settings: &SolveSettings,
    on_event: &mut (dyn FnMut(&JobEvent) + Send),
    stop: CancellationToken,
) -> Result<Solution, Error> {
    server.connect().await?.solve(input, settings, on_event, stop).await
}
