//! Connections below gRPC: what they say, how many there are, when they end.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// What every client of HTTP/2 says first (RFC 9113, section 3.4), and empty settings.
pub const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";

/// Connections each of which has said that much.
pub async fn saying(address: &str, count: usize, words: &[u8]) -> Vec<TcpStream> {
    let mut connections = Vec::new();
    for _ in 0..count {
        let mut connection = TcpStream::connect(address).await.expect("a connection");
        connection.write_all(words).await.expect("written");
        connections.push(connection);
    }
    connections
}

/// The address of a proxy of this one, and how many connections came through it: a client connects again by itself,
/// and does not say so.
pub async fn counting(address: SocketAddr) -> (String, Arc<AtomicUsize>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("an address"));
    let connections = Arc::new(AtomicUsize::new(0));
    let counted = connections.clone();
    tokio::spawn(async move {
        while let Ok((mut outside, _)) = listener.accept().await {
            counted.fetch_add(1, Ordering::SeqCst);
            tokio::spawn(async move {
                let mut inside = TcpStream::connect(address).await.expect("the server listens");
                // Whichever side ends it, the test looks at what it sees.
                let _ = tokio::io::copy_bidirectional(&mut outside, &mut inside).await;
            });
        }
    });
    (url, connections)
}

/// The address of a proxy of this one that cuts the first connection off after so many bytes of the server, and how
/// many have come of it over all connections.
pub async fn cutting(address: SocketAddr, after: usize) -> (String, Arc<AtomicUsize>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("an address"));
    let received = Arc::new(AtomicUsize::new(0));
    let counted = received.clone();
    tokio::spawn(async move {
        let mut limit = after;
        while let Ok((outside, _)) = listener.accept().await {
            let (mut read_outside, mut write_outside) = outside.into_split();
            let inside = TcpStream::connect(address).await.expect("the server listens");
            let (mut read_inside, mut write_inside) = inside.into_split();
            let counted = counted.clone();
            let upstream = tokio::spawn(async move { tokio::io::copy(&mut read_outside, &mut write_inside).await });
            tokio::spawn(async move {
                let mut buffer = vec![0; 1 << 14];
                let mut passed = 0;
                while let Ok(count @ 1..) = read_inside.read(&mut buffer).await {
                    passed += count;
                    counted.fetch_add(count, Ordering::SeqCst);
                    if write_outside.write_all(&buffer[..count]).await.is_err() || passed > limit {
                        break;
                    }
                }
                upstream.abort();
            });
            limit = usize::MAX;
        }
    });
    (url, received)
}

/// Reads until the other side closes the connection.
pub async fn until_closed(mut connection: TcpStream) {
    let mut buffer = [0; 256];
    while matches!(connection.read(&mut buffer).await, Ok(1..)) {}
}
