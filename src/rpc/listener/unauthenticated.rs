//! Connections of which nobody knows yet whether anyone who may call is behind them: how long they keep their place.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::time::Sleep;

use crate::telemetry::metrics;

/// How long a connection may take to its first call by someone who may call. Clients connect in order to call; half a
/// minute is one that reads a large input in between, on a machine that is busy.
pub const AUTH_TIMEOUT: Duration = Duration::from_secs(30);

/// Whether someone who may call has called over a connection, and from where. Goes with each of its requests; clones
/// are the same one.
#[derive(Debug, Clone, Default)]
pub struct ConnectionInfo {
    authenticated: Arc<AtomicBool>,
    peer: Option<SocketAddr>,
}

impl ConnectionInfo {
    /// Someone who may call has.
    pub fn set_authenticated(&self) {
        // Nothing else is read by it.
        self.authenticated.store(true, Ordering::Relaxed);
    }

    fn is_authenticated(&self) -> bool {
        self.authenticated.load(Ordering::Relaxed)
    }

    /// The other end of the connection: the client, or the proxy before it.
    pub fn peer(&self) -> Option<SocketAddr> {
        self.peer
    }
}

/// The time that a connection has to authenticate.
pub(super) struct AuthDeadline {
    pub(super) connection_info: ConnectionInfo,
    /// `None`: it has authenticated, or may take for ever.
    end: Option<Pin<Box<Sleep>>>,
}

impl AuthDeadline {
    /// From now on; `None`: for ever.
    pub(super) fn begin(bound: Option<Duration>, peer: Option<SocketAddr>) -> Self {
        let end = bound.map(|bound| Box::pin(tokio::time::sleep(bound)));
        Self { connection_info: ConnectionInfo { peer, ..ConnectionInfo::default() }, end }
    }

    /// Lets the connection go on as long as there is time. Its task is woken when there is none any more.
    ///
    /// # Errors
    /// Once the time is over and nobody has authenticated: for the transport, the connection has broken.
    pub(super) fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        let Some(end) = &mut self.end else { return Ok(()) };
        if self.connection_info.is_authenticated() {
            self.end = None;
            return Ok(());
        }
        match end.as_mut().poll(context) {
            Poll::Pending => Ok(()),
            Poll::Ready(()) => Err(io::ErrorKind::TimedOut.into()),
        }
    }
}

impl Drop for AuthDeadline {
    fn drop(&mut self) {
        let over = self.end.as_ref().is_some_and(|end| end.is_elapsed());
        if over && !self.connection_info.is_authenticated() {
            metrics::unauthenticated_closed();
            tracing::debug!("a connection was closed: nobody who may call had called over it");
        }
    }
}
