//! Connections that say nothing: they end in time, and hold up nobody meanwhile.

use std::sync::atomic::Ordering;
use std::time::Duration;

use scpsfm::rpc::proto;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::server::Options;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tonic::Code;

use crate::support::connections::{PREFACE, counting, saying, until_closed};
use crate::support::live::is_served;
use crate::support::memory::resident_mb;
use crate::support::program::Serving;
use crate::support::scrape::Page;
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::quick;

#[tokio::test]
async fn hundreds_of_silent_connections_hold_up_nobody_and_are_ended() {
    let half_a_second = Duration::from_millis(500);
    let options = Options {
        handshake_timeout: half_a_second,
        keepalive: half_a_second,
        keepalive_timeout: half_a_second,
        ..Options::default()
    };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let address = server.server.address().to_string();
    // Nothing at all, half of the first words, and all of them with nothing after.
    let mut silent = Vec::new();
    for words in [&PREFACE[..0], &PREFACE[..11], PREFACE] {
        silent.extend(saying(&address, 150, words).await);
    }
    is_served(&server.url()).await;
    let (counted, connections) = counting(server.server.address()).await;
    let mut client = CalibrationServiceClient::connect(counted).await.expect("a connection");
    client.get_capabilities(proto::GetCapabilitiesRequest {}).await.expect("an answer");
    soon(futures_util::future::join_all(silent.into_iter().map(until_closed))).await;
    // One that answers when it is asked whether it lives is left alone, however little it has to say.
    tokio::time::sleep(4 * half_a_second).await;
    client.get_capabilities(proto::GetCapabilitiesRequest {}).await.expect("an answer");
    assert_eq!(connections.load(Ordering::SeqCst), 1, "a client that had to connect again was not left alone");
    is_served(&server.url()).await;
}

#[tokio::test]
async fn of_too_many_silent_connections_the_oldest_make_room() {
    let options =
        Options { handshake_timeout: Duration::from_secs(3_600), max_silent_connections: 20, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let address = server.server.address().to_string();
    let mut silent = saying(&address, 100, b"PRI").await;
    let newest = silent.split_off(80);
    soon(futures_util::future::join_all(silent.into_iter().map(until_closed))).await;
    is_served(&server.url()).await;
    // Whoever is among the latest may take its time.
    let mut last = newest.into_iter().next_back().expect("the newest");
    last.write_all(&PREFACE[3..]).await.expect("still open");
    assert!(matches!(soon(last.read(&mut [0; 9])).await, Ok(1..)), "the server's settings");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_connection_too_many_is_refused_and_there_is_room_when_one_ends() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("log");
    let stderr = std::fs::File::create(&log).expect("a file");
    let server = Serving::start_with(directory.path(), &[("SCPSFM_SERVER__MAX_CONNECTIONS", "3")], stderr);
    let count = |series: &str| Page::parse(&server.page("/metrics")).value(series);
    let mut clients = Vec::new();
    for _ in 0..3 {
        let mut client = CalibrationServiceClient::connect(server.grpc.clone()).await.expect("a connection");
        let capabilities = client.get_capabilities(proto::GetCapabilitiesRequest {}).await.expect("an answer");
        assert_eq!(capabilities.into_inner().max_connections, 3);
        clients.push(client);
    }
    assert_eq!((count("scpsfm_connections"), count("scpsfm_connections_refused_total")), (3.0, 0.0));
    // One that listens hears why; a client of gRPC may come again.
    let address = server.grpc.trim_start_matches("http://").to_owned();
    let mut heard = Vec::new();
    let mut one_more = saying(&address, 1, PREFACE).await.remove(0);
    soon(one_more.read_to_end(&mut heard)).await.expect("it is told, and closed");
    assert!(heard.ends_with(b"too many connections"), "{heard:?}");
    for attempt in 0..20 {
        let refused = async {
            let connected = CalibrationServiceClient::connect(server.grpc.clone()).await;
            let mut client = connected.map_err(|_| Code::Unavailable)?;
            client.get_capabilities(proto::GetCapabilitiesRequest {}).await.map(drop).map_err(|status| status.code())
        };
        // Cancelled by the client's own library, where the connection was gone before the call was sent.
        let code = soon(refused).await.expect_err("there is no room");
        assert!(matches!(code, Code::Unavailable | Code::Cancelled), "attempt {attempt}: {code:?}");
    }
    assert!(count("scpsfm_connections_refused_total") >= 21.0);
    // The log tells of the first at once, and of the others together.
    let log = std::fs::read_to_string(&log).expect("the log");
    let warnings = log.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).expect("a line of JSON"));
    let warnings: Vec<_> = warnings.filter(|line| line.to_string().contains("connections were refused")).collect();
    assert!((1..21).contains(&warnings.len()), "{warnings:?}");
    assert_eq!((warnings[0]["level"].as_str(), warnings[0]["count"].as_u64()), (Some("WARN"), Some(1)), "{warnings:?}");
    for client in &mut clients {
        client.get_capabilities(proto::GetCapabilitiesRequest {}).await.expect("those that are in stay in");
    }
    assert_eq!(count("scpsfm_connections"), 3.0);
    drop(clients.pop());
    soon(async {
        while count("scpsfm_connections") > 2.0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    is_served(&server.grpc).await;
}

#[tokio::test]
async fn what_is_not_http2_is_refused_at_once() {
    let options = Options { handshake_timeout: Duration::from_secs(3_600), ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let address = server.server.address().to_string();
    for words in [&b"GET / HTTP/1.1\r\nhost: x\r\n\r\n"[..], b"\x16\x03\x01\x02\0", b"PRI * HTTP/2.1\r\n\r\nSM\r\n\r\n"]
    {
        let mut connections = saying(&address, 1, words).await;
        let mut connection = connections.remove(0);
        // Enough for a transport that waits for a preface's length.
        let _ = connection.write_all(&[0; 64]).await;
        soon(until_closed(connection)).await;
    }
    is_served(&server.url()).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "ten thousand connections, half a minute"]
async fn ten_thousand_silent_connections_cost_little_and_go_away() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(directory.path());
    let address = server.grpc.trim_start_matches("http://").to_owned();
    let resident_mb = || resident_mb(server.running.0.id());
    let before = resident_mb();
    let begun = std::time::Instant::now();
    let mut silent = saying(&address, 5_000, b"").await;
    is_served(&server.grpc).await;
    silent.extend(saying(&address, 5_000, b"PRI").await);
    let one = std::time::Instant::now();
    is_served(&server.grpc).await;
    let (served, grown) = (one.elapsed(), resident_mb() - before);
    soon(futures_util::future::join_all(silent.into_iter().map(until_closed))).await;
    eprintln!(
        "10,000 connections: {grown} MB more, a call in {} ms, all gone after {:.1} s, {} MB then",
        served.as_millis(),
        begun.elapsed().as_secs_f64(),
        resident_mb() - before
    );
    assert!(grown < 50, "{grown} MB");
}
