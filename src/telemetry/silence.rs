//! A listener whose connections end when nothing moves on them for too long.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep};

/// Takes connections and bounds their silence.
#[derive(Debug)]
pub struct Bounded<L> {
    pub listener: L,
    /// How long nothing may move, in either direction.
    pub silence: Duration,
}

impl<L: Listener> Listener for Bounded<L> {
    type Io = Connection<L::Io>;
    type Addr = L::Addr;

    async fn accept(&mut self) -> (Connection<L::Io>, L::Addr) {
        let (io, address) = self.listener.accept().await;
        (Connection::new(io, self.silence), address)
    }

    fn local_addr(&self) -> io::Result<L::Addr> {
        self.listener.local_addr()
    }
}

/// A connection that fails when it was silent for too long.
#[derive(Debug)]
pub struct Connection<T> {
    io: T,
    silence: Duration,
    end: Pin<Box<Sleep>>,
}

impl<T> Connection<T> {
    /// Ends what is silent for so long.
    pub fn new(io: T, silence: Duration) -> Self {
        Self { io, silence, end: Box::pin(sleep(silence)) }
    }

    /// Passes on what an operation came to, unless it waits and has done so for too long.
    fn bounded<O>(&mut self, outcome: Poll<io::Result<O>>, context: &mut Context<'_>) -> Poll<io::Result<O>> {
        match outcome {
            Poll::Pending => self.end.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into())),
            moved => {
                self.end.as_mut().reset(Instant::now() + self.silence);
                moved
            }
        }
    }
}

impl<T: AsyncRead + Unpin> AsyncRead for Connection<T> {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.io).poll_read(context, buf);
        self.bounded(read, context)
    }
}

impl<T: AsyncWrite + Unpin> AsyncWrite for Connection<T> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.io).poll_write(context, buf);
        self.bounded(written, context)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(context)
    }
}
