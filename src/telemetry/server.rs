//! The scrape port: `/metrics`, `/healthz` and `/readyz`, apart from the gRPC port so that neither needs the other's
//! exposure.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use axum::http::{StatusCode, header};
use axum::routing::get;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::metrics::page;
use super::silence::Bounded;

/// Prometheus' text format, as its exposition documentation names it.
const TEXT_FORMAT: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Between two drains of the histograms' samples: often enough that a server nobody scrapes stays small.
const UPKEEP_INTERVAL: Duration = Duration::from_secs(5);

/// Whether the service can do its work. Clones share one latch.
#[derive(Debug, Clone, Default)]
pub struct Readiness(Arc<State>);

#[derive(Debug, Default)]
struct State {
    taking_work: AtomicBool,
    store_away: AtomicBool,
    store_full: AtomicBool,
}

impl Readiness {
    /// Says whether the service takes work: not until it is up, and no more while it drains.
    pub fn set(&self, ready: bool) {
        self.0.taking_work.store(ready, Ordering::Relaxed);
    }

    /// Says whether the store is out of reach, and whether it is full.
    pub fn set_store(&self, away: bool, full: bool) {
        self.0.store_away.store(away, Ordering::Relaxed);
        self.0.store_full.store(full, Ordering::Relaxed);
    }

    /// Whether the service can do its work, and what keeps it from doing so.
    fn answer(&self) -> (StatusCode, &'static str) {
        if !self.0.taking_work.load(Ordering::Relaxed) {
            (StatusCode::SERVICE_UNAVAILABLE, "not ready\n")
        } else if self.0.store_away.load(Ordering::Relaxed) {
            (StatusCode::SERVICE_UNAVAILABLE, "not ready: the store is out of reach\n")
        } else if self.0.store_full.load(Ordering::Relaxed) {
            // Results are read and room is made through this server: nobody is to be kept away from it.
            (StatusCode::OK, "ready, but the store's disk is full: jobs are neither taken in nor begun\n")
        } else {
            (StatusCode::OK, "ready\n")
        }
    }
}

/// What the scrape port needs.
pub struct Options {
    /// Address to listen on; port 0 takes a free one.
    pub listen: SocketAddr,
    pub scrape: PrometheusHandle,
    pub ready: Readiness,
    /// How long a connection may be silent.
    pub silence: Duration,
}

impl Options {
    /// Twice the longest interval of scrapes that is common, so that a scraper's connection lasts from one to the next.
    pub const SILENCE: Duration = Duration::from_secs(120);
}

/// The running scrape port.
#[must_use = "the port closes when this is dropped"]
pub struct Server {
    address: SocketAddr,
    stop: CancellationToken,
    served: JoinHandle<()>,
}

/// Binds the port and serves it in the background.
///
/// # Errors
/// When the address cannot be bound.
pub async fn bind(options: Options) -> std::io::Result<Server> {
    let listener = TcpListener::bind(options.listen).await?;
    let address = listener.local_addr()?;
    let stop = CancellationToken::new();
    let listener = Bounded { listener, silence: options.silence };
    let router = router(options.scrape.clone(), options.ready);
    let stopped = stop.clone();
    let upkeep = stop.clone();
    let served = tokio::spawn(async move {
        let serve = axum::serve(listener, router).with_graceful_shutdown(stopped.cancelled_owned());
        let ((), served) = tokio::join!(keep_up(options.scrape, upkeep), serve);
        if let Err(error) = served {
            tracing::error!(%error, "the scrape port failed");
        }
    });
    Ok(Server { address, stop, served })
}

/// A scrape takes milliseconds; a request that was begun and never ended must not hold up the end of the process.
const SHUTDOWN_BOUND: Duration = Duration::from_secs(2);

impl Server {
    /// The bound address.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Closes the port after the scrapes under way, waiting [`SHUTDOWN_BOUND`] for them.
    pub async fn shutdown(mut self) {
        self.stop.cancel();
        match tokio::time::timeout(SHUTDOWN_BOUND, &mut self.served).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::error!(%error, "the scrape port's task failed"),
            Err(_) => self.served.abort(),
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

fn router(scrape: PrometheusHandle, ready: Readiness) -> Router {
    Router::new()
        .route("/metrics", get(move || async move { ([(header::CONTENT_TYPE, TEXT_FORMAT)], page(&scrape)) }))
        .route("/healthz", get(|| async { "ok\n" }))
        .route("/readyz", get(move || async move { ready.answer() }))
}

async fn keep_up(scrape: PrometheusHandle, stop: CancellationToken) {
    let mut ticks = tokio::time::interval(UPKEEP_INTERVAL);
    while stop.run_until_cancelled(ticks.tick()).await.is_some() {
        scrape.run_upkeep();
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    use super::{Options, Readiness, bind};
    use crate::telemetry::metrics;

    async fn get(address: std::net::SocketAddr, path: &str) -> String {
        let mut stream = TcpStream::connect(address).await.expect("connect");
        let request = format!("GET {path} HTTP/1.1\r\nhost: test\r\nconnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await.expect("send");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await.expect("receive");
        answer
    }

    #[tokio::test]
    async fn the_port_serves_metrics_and_follows_the_latch_until_it_is_shut() {
        let ready = Readiness::default();
        let scrape = metrics::install(None).expect("recorder");
        let listen = "127.0.0.1:0".parse().expect("address");
        let server =
            bind(Options { listen, scrape, ready: ready.clone(), silence: Options::SILENCE }).await.expect("bind");
        let address = server.address();

        assert!(get(address, "/healthz").await.starts_with("HTTP/1.1 200"));
        assert!(get(address, "/readyz").await.starts_with("HTTP/1.1 503"));
        ready.set(true);
        assert!(get(address, "/readyz").await.starts_with("HTTP/1.1 200"));
        ready.set_store(true, false);
        let away = get(address, "/readyz").await;
        assert!(away.starts_with("HTTP/1.1 503") && away.contains("store"), "{away}");
        ready.set_store(false, true);
        let full = get(address, "/readyz").await;
        assert!(full.starts_with("HTTP/1.1 200") && full.contains("full"), "{full}");
        ready.set_store(false, false);
        assert!(get(address, "/readyz").await.ends_with("\r\n\r\nready\n"));
        let page = get(address, "/metrics").await;
        assert!(page.contains("content-type: text/plain; version=0.0.4"), "{page}");
        assert!(page.contains("\nscpsfm_queue_depth "), "{page}");

        server.shutdown().await;
        assert!(TcpStream::connect(address).await.is_err(), "the port is closed");
    }

    #[tokio::test]
    async fn a_connection_that_says_nothing_is_ended_and_one_that_scrapes_is_not() {
        let scrape = metrics::install(None).expect("recorder");
        let listen = "127.0.0.1:0".parse().expect("address");
        let silence = std::time::Duration::from_secs(1);
        let server = bind(Options { listen, scrape, ready: Readiness::default(), silence }).await.expect("bind");
        let mut silent = TcpStream::connect(server.address()).await.expect("connect");
        let mut begun = TcpStream::connect(server.address()).await.expect("connect");
        begun.write_all(b"GET /healthz HTTP/1.1\r\nhost").await.expect("send");
        let mut scraper = TcpStream::connect(server.address()).await.expect("connect");
        let mut answer = [0; 1024];
        for _ in 0..6 {
            scraper.write_all(b"GET /healthz HTTP/1.1\r\nhost: test\r\n\r\n").await.expect("send");
            let count = scraper.read(&mut answer).await.expect("an answer");
            assert!(answer[..count].starts_with(b"HTTP/1.1 200"));
            tokio::time::sleep(silence / 3).await;
        }
        for connection in [&mut silent, &mut begun] {
            let read = tokio::time::timeout(silence * 60, connection.read(&mut answer)).await.expect("ended long ago");
            assert!(!matches!(read, Ok(1..)), "{read:?}");
        }
        server.shutdown().await;
    }
}
