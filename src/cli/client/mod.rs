//! The client side of the API: what every command that talks to a server shares.
//!
//! Calls that may be repeated are repeated when the connection breaks, for a bounded time: a watch goes on after its
//! last event, a result after its last byte, a creation under its request id. Every call is repeated where a rate refused
//! it, after the time that the server tells.
//!
//! Here is the connection; its calls are in files of their own.

pub mod access;
mod admin;
mod answered;
mod backoff;
mod batch;
mod error;
mod handshake;
mod jobs;
mod outgoing;
mod solve;
pub mod upload;
mod uploaded_inputs;

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tonic::codec::CompressionEncoding::Gzip;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Response, Status};

pub use error::Error;
pub use jobs::{JobOptions, Page, ended, ended_as};
pub use outgoing::Outgoing;
pub use solve::solve;

use self::access::{AccessArgs, Bearer};
use self::answered::Answered;
use self::backoff::Backoff;
use crate::rpc::proto::admin_service_client::AdminServiceClient;
use crate::rpc::proto::calibration_service_client::CalibrationServiceClient;
use crate::rpc::proto::input_service_client::InputServiceClient;
use crate::rpc::proto::job_service_client::JobServiceClient;

/// A server that does not answer within this is not there.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// A silent connection is asked this often whether it lives, so that a watch of a long job notices a lost server.
const KEEPALIVE: Duration = Duration::from_secs(20);

/// A rate that lets the call pass sooner than this is waited for without a word: a list of many pages may meet it at
/// every page.
const SILENT_WAIT: Duration = Duration::from_secs(1);

/// Largest answer that is taken: interim weights of the most tracks that any server allows are below it.
const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// A connection whose every call carries the API key, where there is one.
type Keyed = InterceptedService<Answered<Channel>, Bearer>;

/// A connection to a server; reconnects by itself.
#[derive(Debug, Clone)]
pub struct Client {
    jobs: JobServiceClient<Keyed>,
    calibration: CalibrationServiceClient<Keyed>,
    inputs: InputServiceClient<Keyed>,
    admin: AdminServiceClient<Keyed>,
    server: String,
    /// Whether a call was ever answered.
    answered: Arc<AtomicBool>,
    /// Whose jobs are created and listed.
    tenant: String,
    /// Whether the caller said so; it is the default one otherwise.
    is_tenant_given: bool,
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
            is_tenant_given: access.tenant.is_some(),
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
        let own_words = Error::from_status(&self.server, &status, self.answered.load(Ordering::Relaxed));
        if self.is_tenant_given { own_words } else { own_words.or_no_tenant(&status) }
    }

    /// Makes a call, and makes it again where a rate of calls or jobs refused it. For any other trouble it does not wait.
    async fn call<R: Clone, T, F>(&self, request: R, send: impl Fn(Self, R) -> F) -> Result<T, Error>
    where
        F: Future<Output = Result<Response<T>, Status>>,
    {
        let mut backoff = Backoff::default();
        loop {
            match backoff.within(send(self.clone(), request.clone())).await {
                Ok(answer) => return Ok(answer.into_inner()),
                Err(status) if error::rate_limit_wait(&status).is_some() => self.pause(&mut backoff, status).await?,
                Err(status) => return Err(self.error(status)),
            }
        }
    }

    /// Waits before another try, or gives up: for good reason, or after too many. Says so once each trouble, on stderr:
    /// half a minute of silence looks like a hang.
    async fn pause(&self, backoff: &mut Backoff, status: Status) -> Result<(), Error> {
        let wait = error::rate_limit_wait(&status);
        let transient = wait.is_some() || error::is_transient(&status);
        let first = transient && backoff.failed(&status);
        if first && wait.is_none_or(|wait| (SILENT_WAIT..Backoff::TOTAL).contains(&wait)) {
            // Whether it is the right server can be asked once it has gone on for so long: one that is ended breaks
            // connections in the same way.
            let trouble = Error::from_status(&self.server, &status, true);
            tell!("waiting up to {} s: {trouble}", Backoff::TOTAL.as_secs());
        }
        let error = self.error(status);
        if transient && backoff.pause(wait.unwrap_or_default()).await {
            return Ok(());
        }
        // A rate says the same at every try, with another time.
        let before = backoff.first().filter(|_| wait.is_none()).map(|status| self.error(status.clone()));
        Err(before.map_or(error.clone(), |before| error.begun_with(&before)))
    }

    /// The same of a call that stores jobs: where it is given up, it may have been carried out all the same.
    async fn pause_to_store(&self, backoff: &mut Backoff, status: Status) -> Result<(), Error> {
        let paused = self.pause(backoff, status).await;
        paused.map_err(|error| if backoff.may_be_done() { error.or_stored() } else { error })
    }
}
