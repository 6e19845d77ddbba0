//! Where connections come in: each has a bound of time to shake hands and to say that it speaks HTTP/2, and those that
//! have not yet are few enough to hold up nobody. Those that speak have a bound of time to call as someone who may.

mod unauthenticated;

use std::collections::VecDeque;
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use futures_util::stream::{self, Stream};
use prost::bytes::{Buf, Bytes};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::{AbortHandle, JoinSet};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tonic::transport::server::Connected;

use self::unauthenticated::AuthDeadline;
pub use self::unauthenticated::{AUTH_TIMEOUT, ConnectionInfo};
use super::reload::Current;
use crate::telemetry::metrics;
use crate::telemetry::throttle::Throttle;

/// How long a connection may take to its first words: three round trips of the slowest link, and no reason for a caller
/// to be slower.
pub const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

/// Connections that have not come to their first words yet, at most; one more ends the oldest of them. Callers that
/// mean it need milliseconds for it, so that a thousand are a thousand new ones a round trip.
pub const MAX_HANDSHAKING: usize = 1_024;

/// Connections that speak, at most: one for each of some thousand callers who watch. Each takes some ten kilobytes
/// while it is idle, and a file descriptor.
pub const MAX_ESTABLISHED: usize = 4_096;

/// How long a connection that is refused may take to its first call, which is what is refused: a client that is told
/// before may close while that call is on its way through it, and some then never answer the call.
const REFUSED_CALL_TIMEOUT: Duration = Duration::from_millis(500);

/// How long a connection that is refused may take to hear of it.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(1);

/// Connections that are being refused, at most: as many as may be about to speak. One more is closed without a word.
const MAX_REFUSALS: usize = MAX_HANDSHAKING;

/// What every server says first: settings, here none (RFC 9113, section 6.5). Some clients wait for them before they
/// call.
const NO_SETTINGS: &[u8] = b"\0\0\0\x04\0\0\0\0\0";

/// What a connection is answered for which there is no room: GOAWAY (RFC 9113, section 6.8) after stream 0 with
/// REFUSED_STREAM. No call of it was begun, so that a client may come again: gRPC calls that UNAVAILABLE, where
/// ENHANCE_YOUR_CALM would be RESOURCE_EXHAUSTED.
const NO_ROOM: &[u8] = b"\0\0\x1c\x07\0\0\0\0\0\0\0\0\0\0\0\0\x07too many connections";

/// The same where the connection is for HTTP/1.1.
const NO_ROOM_HTTP_1: &[u8] =
    b"HTTP/1.1 503 Service Unavailable\r\nretry-after: 1\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";

/// Pause after a connection could not be taken, which is usually a lack of file descriptors: some free up meanwhile.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

/// What every client says first (RFC 9113, section 3.4).
const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Bytes before a frame's own: its length in three, type, flags, stream (RFC 9113, section 4.1).
const FRAME_HEAD: usize = 9;
/// Largest frame before a server has allowed larger ones (RFC 9113, section 4.2).
const MAX_FRAME: u32 = 16_384;
/// Type of the frame that begins a call (RFC 9113, section 6.2).
const HEADERS: u8 = 1;

/// How connections are let in.
#[derive(Debug, Clone)]
pub struct Options {
    /// `None`: they are not encrypted.
    pub certificates: Option<Current<ServerConfig>>,
    /// How long a connection may take to its first words.
    pub timeout: Duration,
    /// Connections that have not come to them yet, at most.
    pub max_handshaking: usize,
    /// Connections that have, at most; one more is refused.
    pub max_established: usize,
    /// How long one that has may take until someone calls over it who may; `None`: for ever.
    pub auth_timeout: Option<Duration>,
    /// Protocol that TLS offers in place of HTTP/2.
    pub protocol: Option<&'static [u8]>,
}

/// Takes connections, in the order in which they have shaken hands. Each handshake begins with the certificate that is
/// in force then; those that fail or stall leave nothing but a line in the log.
pub struct Listener {
    listener: TcpListener,
    options: Options,
    /// One for each connection that may speak.
    permits: Arc<Semaphore>,
    /// One for each connection that is being refused.
    refusal_permits: Arc<Semaphore>,
    refusal_log: Throttle,
    handshaking: JoinSet<Result<Established, String>>,
    oldest_first: VecDeque<AbortHandle>,
}

impl Listener {
    pub fn new(listener: TcpListener, options: Options) -> Self {
        Self {
            listener,
            permits: Arc::new(Semaphore::new(options.max_established.min(Semaphore::MAX_PERMITS))),
            refusal_permits: Arc::new(Semaphore::new(MAX_REFUSALS)),
            options,
            refusal_log: Throttle::of(1),
            handshaking: JoinSet::new(),
            oldest_first: VecDeque::new(),
        }
    }

    /// The connections as a stream, which never ends.
    pub fn into_stream(self) -> impl Stream<Item = Result<Connection, Infallible>> {
        stream::unfold(self, async |mut listener| {
            let connection = listener.next().await;
            Some((Ok(connection), listener))
        })
    }

    /// The next connection; waits for ever where none comes.
    pub async fn next(&mut self) -> Connection {
        loop {
            tokio::select! {
                accepted = self.listener.accept() => match accepted {
                    Ok((connection, _)) => self.shake_hands(connection),
                    Err(error) => {
                        tracing::warn!(%error, "a connection could not be taken");
                        tokio::time::sleep(ACCEPT_PAUSE).await;
                    }
                },
                Some(ended) = self.handshaking.join_next() => match ended {
                    Ok(Ok(established)) => match self.permits.clone().try_acquire_owned() {
                        Ok(permit) => {
                            let Established { io, early, peer } = established;
                            let auth_deadline = AuthDeadline::begin(self.options.auth_timeout, peer);
                            return Connection { io, early, auth_deadline, _held: (permit, metrics::connection()) };
                        }
                        Err(_) => self.refuse(established),
                    },
                    Ok(Err(error)) => tracing::debug!(error, "a connection came to nothing"),
                    Err(error) if error.is_cancelled() => tracing::debug!("a silent connection made room for another"),
                    Err(error) => tracing::error!(%error, "a connection's task failed"),
                },
            }
        }
    }

    fn shake_hands(&mut self, connection: TcpStream) {
        self.oldest_first.retain(|handshaking| !handshaking.is_finished());
        while self.oldest_first.len() >= self.options.max_handshaking.max(1) {
            if let Some(oldest) = self.oldest_first.pop_front() {
                oldest.abort();
            }
        }
        let acceptor = self.options.certificates.as_ref().map(|current| {
            let mut config = current.borrow().clone();
            if let Some(protocol) = self.options.protocol {
                Arc::make_mut(&mut config).alpn_protocols = vec![protocol.to_vec()];
            }
            TlsAcceptor::from(config)
        });
        let bound = self.options.timeout;
        let handshake = self.handshaking.spawn(async move {
            match tokio::time::timeout(bound, begin(connection, acceptor)).await {
                Ok(established) => established.map_err(|error| error.to_string()),
                Err(_) => Err(format!("silent for {} s", bound.as_secs_f64())),
            }
        });
        self.oldest_first.push_back(handshake);
    }

    /// Answers a connection that there is no room for it.
    fn refuse(&mut self, established: Established) {
        metrics::connection_refused();
        let max_connections = self.options.max_established;
        let log = move |count: u64| {
            tracing::warn!(count, max_connections, "connections were refused: as many speak as may");
        };
        if self.refusal_log.allows(log) {
            log(1);
        }
        let Ok(place) = self.refusal_permits.clone().try_acquire_owned() else { return };
        let is_http_1 = self.options.protocol.is_some();
        tokio::spawn(async move {
            let _place = place;
            let Established { mut io, early, .. } = established;
            if !is_http_1 {
                let called = async {
                    io.write_all(NO_SETTINGS).await?;
                    io.flush().await?;
                    if early == PREFACE[..] { first_call(&mut io).await } else { Ok(()) }
                };
                // Whoever does not call is answered all the same.
                let _ = tokio::time::timeout(REFUSED_CALL_TIMEOUT, called).await;
            }
            let answering = async {
                io.write_all(if is_http_1 { NO_ROOM_HTTP_1 } else { NO_ROOM }).await?;
                io.shutdown().await?;
                // A socket that is closed with bytes that nobody read is reset, and what it said may be lost with it.
                tokio::io::copy(&mut io, &mut tokio::io::sink()).await
            };
            // Whoever does not listen is not waited for.
            let _ = tokio::time::timeout(REFUSAL_TIMEOUT, answering).await;
        });
    }
}

/// Shakes hands, where there is TLS, and waits for the first bytes.
async fn begin(connection: TcpStream, acceptor: Option<TlsAcceptor>) -> io::Result<Established> {
    connection.set_nodelay(true)?;
    let peer = connection.peer_addr().ok();
    let mut io: Box<dyn Io> = match acceptor {
        Some(acceptor) => Box::new(acceptor.accept(connection).await?),
        None => Box::new(connection),
    };
    let mut early = Vec::with_capacity(PREFACE.len());
    // What is something else already is for the transport to refuse.
    while early.len() < PREFACE.len() && PREFACE.starts_with(&early) {
        let mut rest = [0; PREFACE.len()];
        let wanted = PREFACE.len() - early.len();
        let count = io.read(&mut rest[..wanted]).await?;
        if count == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        early.extend_from_slice(&rest[..count]);
    }
    Ok(Established { io, early: early.into(), peer })
}

/// Reads what comes after the preface until a call begins, or what no server allows.
async fn first_call(io: &mut dyn Io) -> io::Result<()> {
    loop {
        let mut head = [0; FRAME_HEAD];
        io.read_exact(&mut head).await?;
        let length = u32::from_be_bytes([0, head[0], head[1], head[2]]);
        if head[3] == HEADERS || length > MAX_FRAME {
            return Ok(());
        }
        tokio::io::copy(&mut (&mut *io).take(length.into()), &mut tokio::io::sink()).await?;
    }
}

/// A connection whose handshake is done.
struct Established {
    io: Box<dyn Io>,
    early: Bytes,
    peer: Option<SocketAddr>,
}

/// A connection, encrypted or not.
trait Io: AsyncRead + AsyncWrite + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Send + Unpin> Io for T {}

/// An established connection: what was read of it early is read again.
pub struct Connection {
    io: Box<dyn Io>,
    early: Bytes,
    auth_deadline: AuthDeadline,
    /// Its place, and its count among those that speak, for as long as it lives.
    _held: (OwnedSemaphorePermit, metrics::Held),
}

impl Connection {
    /// For [`Authenticate`](super::auth::Authenticate), which knows who may call.
    pub fn connection_info(&self) -> ConnectionInfo {
        self.auth_deadline.connection_info.clone()
    }
}

impl Connected for Connection {
    /// For [`Authenticate`](super::auth::Authenticate), which knows who may call.
    type ConnectInfo = ConnectionInfo;

    fn connect_info(&self) -> ConnectionInfo {
        self.connection_info()
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.auth_deadline.check(context)?;
        if self.early.is_empty() {
            return Pin::new(&mut self.io).poll_read(context, buf);
        }
        let count = self.early.len().min(buf.remaining());
        buf.put_slice(&self.early[..count]);
        self.early.advance(count);
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        // Also here: the transport does not read while it cannot write to one who does not read either.
        self.auth_deadline.check(context)?;
        Pin::new(&mut self.io).poll_write(context, buf)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.auth_deadline.check(context)?;
        Pin::new(&mut self.io).poll_write_vectored(context, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.auth_deadline.check(context)?;
        Pin::new(&mut self.io).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tonic::Code;

    use super::*;
    use crate::rpc::proto;
    use crate::rpc::proto::calibration_service_client::CalibrationServiceClient;

    #[tokio::test]
    async fn every_connection_without_room_hears_so() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let url = format!("http://{}", listener.local_addr().expect("an address"));
        let options = Options {
            certificates: None,
            timeout: HANDSHAKE_TIMEOUT,
            max_handshaking: MAX_HANDSHAKING,
            max_established: 0,
            auth_timeout: None,
            protocol: None,
        };
        let connections = tokio::spawn(async move { Listener::new(listener, options).next().await });
        // A reset overtakes the answer in some of so many, and a client that is told too early loses its call.
        for attempt in 0..100 {
            let mut client = CalibrationServiceClient::connect(url.clone()).await.expect("a connection");
            let call = client.get_capabilities(proto::GetCapabilitiesRequest {});
            let refused = tokio::time::timeout(HANDSHAKE_TIMEOUT, call).await.expect("an answer").expect_err("no room");
            assert_eq!(refused.code(), Code::Unavailable, "attempt {attempt}: {refused:?}");
        }
        connections.abort();
    }
}
