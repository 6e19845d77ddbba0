//! A client of the API, as a library: connects, creates jobs, watches them, reads results, uploads inputs.
//!
//! ```no_run
//! use scpsfm::client::{Client, JobOptions, Options, ended};
//! use scpsfm::domain::{RawInput, Solution, SolveSettings};
//!
//! async fn solve(input: &RawInput) -> Result<Solution, scpsfm::client::Error> {
//!     let mut client = Client::connect("http://127.0.0.1:50051", &Options::default()).await?;
//!     let job = client.create(input, &SolveSettings::default(), JobOptions::default()).await?;
//!     let last = client.watch(&job.name, 0, &mut |event| println!("{event:?}")).await?;
//!     last.as_ref().map_or(Ok(()), ended)?;
//!     client.read_result(&job.name).await
//! }
//! ```
//!
//! [`Client::solve`] does all of this in one call, and cancels the job when it is told to stop.
//!
//! # Retries
//!
//! Where the connection breaks or the server goes down, these go on for up to [`MAX_WAIT`], with pauses that grow from
//! a tenth of a second to five seconds: a creation under its request id, a watch after its last event, a result after
//! its last byte, an upload after what the server has. Other calls fail at once with [`ErrorKind::Unavailable`]. Every
//! call is repeated where a rate or the server's memory refused it, after the time that the server tells.
//! [`Client::on_wait`] hears of waits.
//!
//! # Dependence
//!
//! Depends on `domain`, and on `rpc` for the messages and their conversion; the command line is one of its users. Here is
//! the connection; its calls are in files of their own.

mod admin;
mod answered;
mod backoff;
mod batch;
mod error;
mod handshake;
mod input_data;
mod jobs;
mod options;
mod solve;
mod upload;
mod uploaded_inputs;

use std::fmt;
use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tonic::codec::CompressionEncoding::Gzip;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Response, Status};

pub use error::{Error, ErrorKind};
pub use input_data::{InputData, JobInput};
pub use jobs::{JobOptions, Page, ended, ended_as};
pub use options::{ApiKey, OWN_TENANT, Options, Setting};
pub use upload::EncodedInput;
pub use uploaded_inputs::InputPage;

use self::answered::Answered;
use self::backoff::Backoff;
use self::options::Bearer;
use crate::rpc::proto::admin_service_client::AdminServiceClient;
use crate::rpc::proto::calibration_service_client::CalibrationServiceClient;
use crate::rpc::proto::input_service_client::InputServiceClient;
use crate::rpc::proto::job_service_client::JobServiceClient;

/// A server that does not answer within this is not there.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// A silent connection is asked this often whether it lives, so that a watch of a long job notices a lost server.
const KEEPALIVE: Duration = Duration::from_secs(20);

/// How long a client goes on where a connection breaks, or a rate or the server's memory refuses a call, tries and
/// pauses together.
pub const MAX_WAIT: Duration = Backoff::TOTAL;

/// A rate that lets the call pass sooner than this is waited for without a word: a list of many pages may meet it at
/// every page.
const SILENT_WAIT: Duration = Duration::from_secs(1);

/// Largest answer that is taken: interim weights of the most tracks that any server allows are below it.
const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// A connection whose every call carries the API key, where there is one.
type Keyed = InterceptedService<Answered<Channel>, Bearer>;

/// What hears of waits.
type OnWait = Arc<dyn Fn(&Error) + Send + Sync>;

/// What hears how many bytes of how many were uploaded.
type OnUpload = Arc<dyn Fn(u64, u64) + Send + Sync>;

/// A connection to a server; reconnects by itself. A clone shares the connection.
#[derive(Clone)]
pub struct Client {
    jobs: JobServiceClient<Keyed>,
    calibration: CalibrationServiceClient<Keyed>,
    inputs: InputServiceClient<Keyed>,
    admin: AdminServiceClient<Keyed>,
    server: String,
    /// Whether a call was ever answered.
    answered: Arc<AtomicBool>,
    /// Whose jobs are created and listed, as names have it.
    tenant: String,
    on_wait: Option<OnWait>,
    on_upload: Option<OnUpload>,
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client").field("server", &self.server).field("tenant", &self.tenant).finish_non_exhaustive()
    }
}

impl Client {
    /// Connects to `http://HOST:PORT` or `https://HOST:PORT`.
    ///
    /// # Errors
    /// [`ErrorKind::Unavailable`] where no server answers, [`ErrorKind::NotLetIn`] where one side does not trust the
    /// other, [`ErrorKind::Usage`] for what is not a URL and for files of certificates or keys that cannot be used.
    pub async fn connect(server: &str, options: &Options) -> Result<Self, Error> {
        if server.contains('@') {
            // Not repeated: what stands there may be a password.
            let words = "the server's address holds a user or a password (`@`), which no server asks for: an API key \
                         goes into `api_key`";
            return Err(ErrorKind::Usage.error(words).about(Setting::ApiKey));
        }
        let no_url = || {
            let words = format!("{server:?} is not a URL of the form http://HOST:PORT or https://HOST:PORT");
            ErrorKind::Usage.error(words).about(Setting::Server)
        };
        if !server.contains("://") {
            let words =
                format!("`server` {server:?} has no scheme: put http:// in front, or https:// for a server with TLS");
            return Err(ErrorKind::Usage.error(words).about(Setting::Server));
        }
        if !server.starts_with("http://") && !server.starts_with("https://") {
            return Err(no_url());
        }
        let tenant = options.tenant()?.to_owned();
        let endpoint = Endpoint::from_shared(server.to_owned())
            .map_err(|_| no_url())?
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(KEEPALIVE);
        let bearer = options.bearer(&endpoint)?;
        let endpoint = options.secure(endpoint)?;
        let channel = endpoint.connect().await.map_err(|error| error::not_connected(server, &error))?;
        let answered = Arc::new(AtomicBool::new(false));
        let channel = InterceptedService::new(Answered::new(channel, Arc::clone(&answered)), bearer);
        let jobs = JobServiceClient::new(channel.clone());
        let calibration = CalibrationServiceClient::new(channel.clone());
        Ok(Self {
            jobs: jobs.accept_compressed(Gzip).send_compressed(Gzip).max_decoding_message_size(MAX_MESSAGE_BYTES),
            calibration: calibration
                .accept_compressed(Gzip)
                .send_compressed(Gzip)
                .max_decoding_message_size(MAX_MESSAGE_BYTES),
            // Coordinates hardly become shorter by compression.
            inputs: InputServiceClient::new(channel.clone()),
            admin: AdminServiceClient::new(channel),
            server: server.to_owned(),
            answered,
            tenant,
            on_wait: None,
            on_upload: None,
        })
    }

    /// Has `on_wait` called when a call is going to be repeated for up to [`MAX_WAIT`], with what is wrong: once each
    /// trouble, as half a minute of silence looks like a hang.
    pub fn on_wait(&mut self, on_wait: impl Fn(&Error) + Send + Sync + 'static) {
        self.on_wait = Some(Arc::new(on_wait));
    }

    /// Has `on_upload` called while a creation uploads its input, with how many bytes of how many the server has.
    pub fn on_upload(&mut self, on_upload: impl Fn(u64, u64) + Send + Sync + 'static) {
        self.on_upload = Some(Arc::new(on_upload));
    }

    /// The server's address, as it was given.
    pub fn server(&self) -> &str {
        &self.server
    }

    fn parent(&self) -> String {
        format!("tenants/{}", self.tenant)
    }

    fn error(&self, status: Status) -> Error {
        Error::from_status(&self.server, &status, self.answered.load(Ordering::Relaxed))
    }

    /// Makes a call, and makes it again where a rate or the server's memory refused it. For any other trouble it does
    /// not wait.
    async fn call<R: Clone, T, F>(&self, request: R, send: impl Fn(Self, R) -> F) -> Result<T, Error>
    where
        F: Future<Output = Result<Response<T>, Status>>,
    {
        let mut backoff = Backoff::default();
        loop {
            match backoff.within(send(self.clone(), request.clone())).await {
                Ok(answer) => return Ok(answer.into_inner()),
                Err(status) if error::retry_after(&status).is_some() => self.pause(&mut backoff, status).await?,
                Err(status) => return Err(self.error(status)),
            }
        }
    }

    /// Waits before another try, or gives up: for good reason, or after too many. Says so once each trouble.
    async fn pause(&self, backoff: &mut Backoff, status: Status) -> Result<(), Error> {
        let wait = error::retry_after(&status);
        let transient = wait.is_some() || error::is_transient(&status);
        let first = transient && backoff.failed(&status);
        if first
            && wait.is_none_or(|wait| (SILENT_WAIT..MAX_WAIT).contains(&wait))
            && let Some(on_wait) = &self.on_wait
        {
            // Whether it is the right server can be asked once it has gone on for so long: one that is ended breaks
            // connections in the same way.
            on_wait(&Error::from_status(&self.server, &status, true));
        }
        let error = self.error(status);
        if transient && backoff.pause(wait.unwrap_or_default()).await {
            return Ok(());
        }
        // A refusal says the same at every try, with another time.
        let before = backoff.first().filter(|_| wait.is_none()).map(|status| self.error(status.clone()));
        Err(before.map_or(error.clone(), |before| error.begun_with(&before)))
    }

    /// The same of a call that stores jobs: where it is given up, it may have been carried out all the same.
    async fn pause_to_store(&self, backoff: &mut Backoff, status: Status) -> Result<(), Error> {
        let paused = self.pause(backoff, status).await;
        paused.map_err(|error| if backoff.may_be_done() { error.or_stored() } else { error })
    }
}
