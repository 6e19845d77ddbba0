//! One attempt at a delivery: a signed `POST` to an address that was checked, without redirects.

use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use http_body_util::Full;
use hyper::body::Bytes;
use hyper::client::conn::http1;
use hyper::{Request, StatusCode, header};
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, lookup_host};
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use url::{Host, Position, Url};

use super::Options;
use super::address::is_public;
use super::signature::signatures;
use crate::domain::Webhook;
use crate::domain::job::Job;

/// How long an attempt may take. A receiver that has more to do than to note the message does it after its answer.
pub(super) const ATTEMPT_TIMEOUT: Duration = Duration::from_secs(10);

/// How long one address of a receiver may take to connect, so that there is time for the next one.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(4);

/// Bytes that the head of an answer may have. The body is not read: only the status matters.
const MAX_HEAD_BYTES: usize = 16 << 10;

/// Who sends.
const USER_AGENT: &str = concat!("scpsfm/", env!("CARGO_PKG_VERSION"));

/// Why an attempt failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Failed {
    /// Another attempt may succeed.
    Again(String),
    /// The receiver wants no more of it (410 Gone).
    Gone(String),
}

impl From<String> for Failed {
    fn from(error: String) -> Self {
        Self::Again(error)
    }
}

/// Makes attempts.
pub(in crate::engine) struct Sender {
    pub(super) options: Options,
    tls: TlsConnector,
}

impl Sender {
    /// One that trusts the authorities that the system trusts.
    ///
    /// # Errors
    /// TLS cannot be set up: a defect of ours.
    pub(in crate::engine) fn new(options: Options) -> Result<Self, String> {
        let mut roots = RootCertStore::empty();
        let found = rustls_native_certs::load_native_certs();
        roots.add_parsable_certificates(found.certs);
        if roots.is_empty() {
            tracing::warn!(errors = ?found.errors, "the system trusts no authority: webhooks over https will fail");
        }
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .map_err(|error| format!("TLS: {error}"))?
            .with_root_certificates(roots)
            .with_no_client_auth();
        Ok(Self { options, tls: TlsConnector::from(Arc::new(config)) })
    }

    /// Sends a job that has ended to the receiver of its webhook.
    pub(super) async fn send(&self, job: &Job, webhook: &Webhook) -> Result<(), Failed> {
        let url = Webhook::parse_url(&webhook.url).map_err(|error| format!("the URL {error}"))?;
        let request = self.request(job, &url, SystemTime::now())?;
        let late = |_| format!("no answer within {} s", ATTEMPT_TIMEOUT.as_secs());
        let status = timeout(ATTEMPT_TIMEOUT, self.post(&url, request)).await.map_err(late)??;
        match status {
            status if status.is_success() => Ok(()),
            StatusCode::GONE => Err(Failed::Gone(format!("the receiver answered {status}"))),
            status if status.is_redirection() => {
                Err(Failed::Again(format!("the receiver answered {status}; redirects are not followed")))
            }
            status => Err(Failed::Again(format!("the receiver answered {status}"))),
        }
    }

    /// The request with its signature. Its id is that of the event that ended the job: the same in every
    /// attempt, and another one where a job that was retried ends again.
    fn request(&self, job: &Job, url: &Url, now: SystemTime) -> Result<Request<Full<Bytes>>, String> {
        let secrets = self.options.secrets.of(&job.name.tenant);
        if secrets.is_empty() {
            return Err(format!("webhooks.secret has none for the tenant {}", job.name.tenant));
        }
        let seconds = |time: SystemTime| time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let body = (self.options.encode)(job)?;
        let id = format!("{}-{:x}-{}", job.name, seconds(job.create_time).as_micros(), job.last_sequence);
        let timestamp = seconds(now).as_secs();
        let host = match (url.host_str().unwrap_or_default(), url.port()) {
            (host, Some(port)) => format!("{host}:{port}"),
            (host, None) => host.to_owned(),
        };
        Request::post(&url[Position::BeforePath..Position::AfterQuery])
            .header(header::HOST, host)
            .header(header::CONNECTION, "close")
            .header(header::CONTENT_TYPE, "application/json")
            .header(header::USER_AGENT, USER_AGENT)
            .header("webhook-signature", signatures(&secrets, &id, timestamp, &body))
            .header("webhook-id", id)
            .header("webhook-timestamp", timestamp)
            .body(Full::from(body))
            .map_err(|error| format!("the request cannot be made: {error}"))
    }

    /// The status of the answer.
    async fn post(&self, url: &Url, request: Request<Full<Bytes>>) -> Result<StatusCode, String> {
        let stream = self.connect(url).await?;
        if url.scheme() != "https" {
            return exchange(stream, request).await;
        }
        let name = url.host_str().unwrap_or_default().trim_matches(['[', ']']).to_owned();
        let name = ServerName::try_from(name).map_err(|error| format!("the host has no certificate: {error}"))?;
        let stream = self.tls.connect(name, stream).await.map_err(|error| format!("TLS: {error}"))?;
        exchange(stream, request).await
    }

    /// Connects to an address that was checked, and to no other: the name is resolved once, here.
    async fn connect(&self, url: &Url) -> Result<TcpStream, String> {
        let mut error = "the host has no address".to_owned();
        for address in resolve(url).await? {
            if let Err(refused) = self.options.check_address(address.ip()) {
                error = refused;
                continue;
            }
            match timeout(CONNECT_TIMEOUT, TcpStream::connect(address)).await {
                Ok(Ok(stream)) => return Ok(stream),
                Ok(Err(failed)) => error = format!("cannot connect: {failed}"),
                Err(_) => error = format!("cannot connect within {} s", CONNECT_TIMEOUT.as_secs()),
            }
        }
        Err(error)
    }
}

/// The addresses of a URL's host.
async fn resolve(url: &Url) -> Result<Vec<SocketAddr>, String> {
    let port = url.port_or_known_default().unwrap_or_default();
    match url.host() {
        Some(Host::Domain(name)) => {
            let found = lookup_host((name, port)).await.map_err(|error| format!("cannot resolve the host: {error}"))?;
            Ok(found.collect())
        }
        host => Ok(literal(host).map(|ip| SocketAddr::new(ip, port)).into_iter().collect()),
    }
}

/// The address that a host is, where it is no name.
pub(super) fn literal(host: Option<Host<&str>>) -> Option<IpAddr> {
    match host? {
        Host::Ipv4(address) => Some(address.into()),
        Host::Ipv6(address) => Some(address.into()),
        Host::Domain(_) => None,
    }
}

impl Options {
    /// Whether webhooks are sent to this address of their host.
    ///
    /// # Errors
    /// That they are not. The address is not repeated: a tenant is not to learn what the names of this network stand
    /// for.
    pub(super) fn check_address(&self, address: IpAddr) -> Result<(), String> {
        match self.allow_private_addresses || is_public(address) {
            true => Ok(()),
            false => Err("the host has no public address; webhooks.allow_private_addresses allows others".into()),
        }
    }
}

/// One request over a connection that is closed after it.
async fn exchange(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    request: Request<Full<Bytes>>,
) -> Result<StatusCode, String> {
    let failed = |error: hyper::Error| format!("no answer: {error}");
    let mut client = http1::Builder::new();
    client.max_buf_size(MAX_HEAD_BYTES);
    let (mut sender, connection) = client.handshake(TokioIo::new(stream)).await.map_err(failed)?;
    let mut response = pin!(sender.send_request(request));
    let response = tokio::select! {
        biased;
        response = &mut response => response,
        // It moves the request and the answer; where it ends first, the answer is there or never comes.
        _ = connection => response.await,
    };
    Ok(response.map_err(failed)?.status())
}
