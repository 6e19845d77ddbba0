//! Connections over which nobody calls who may: they lose their place, and those of callers keep theirs.

use std::process::Stdio;
use std::sync::atomic::Ordering;
use std::time::Duration;

use scpsfm::rpc::keys::Sources;
use scpsfm::rpc::proto;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::server::Options;
use tonic::Code;
use tonic::transport::Channel;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

use crate::support::connections::{PREFACE, counting, saying, until_closed};
use crate::support::keys::{Key, NORTH, SOUTH, keyed};
use crate::support::program::Serving;
use crate::support::scrape::Page;
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick};
use crate::support::wire::create_tracks;

const BOUND: Duration = Duration::from_millis(500);

/// A server on which nothing but the bound in question ends a connection in the time of a test.
fn options(keys: Option<&str>) -> Options {
    let fixed = keys.map(|key| format!("north:{key}").parse().expect("a key"));
    let hours = Duration::from_secs(3 * 3_600);
    Options {
        keys: Sources { file: None, fixed },
        auth_timeout: Some(BOUND),
        handshake_timeout: hours,
        keepalive: hours,
        ..Options::default()
    }
}

async fn connected(url: &str) -> Channel {
    Channel::from_shared(url.to_owned()).expect("a URL").connect().await.expect("a connection")
}

/// The answer to a call that is repeated until it gets one: on a loaded machine the first of a connection may come too
/// late, which closes it.
async fn persistent<T>(mut call: impl AsyncFnMut() -> Result<tonic::Response<T>, tonic::Status>) -> T {
    soon(async {
        loop {
            match call().await {
                Ok(answer) => return answer.into_inner(),
                Err(error) => {
                    let closed = matches!(error.code(), Code::Unavailable | Code::Cancelled | Code::Unknown);
                    assert!(closed, "{error}");
                }
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await
}

fn health() -> HealthCheckRequest {
    HealthCheckRequest { service: String::new() }
}

#[tokio::test]
async fn a_connection_without_a_callers_key_is_closed_in_time_whatever_it_does() {
    let server = TestServer::start_with(quick(), options(Some(NORTH)), one_worker()).await;
    // It says that it speaks HTTP/2, and nothing more.
    let address = server.server.address().to_string();
    soon(until_closed(saying(&address, 1, PREFACE).await.remove(0))).await;
    // It watches the server's health, which needs no key.
    let mut watch = HealthClient::new(server.channel().await).watch(health()).await.expect("a watch").into_inner();
    soon(async { while let Ok(Some(_)) = watch.message().await {} }).await;
    // It calls without a key, and with a wrong one.
    for wrong in [None, Some(SOUTH)] {
        let (url, connections) = counting(server.server.address()).await;
        let channel = connected(&url).await;
        soon(async {
            while connections.load(Ordering::SeqCst) < 2 {
                let request = proto::GetCapabilitiesRequest {};
                let called = match wrong {
                    None => CalibrationServiceClient::new(channel.clone()).get_capabilities(request).await,
                    Some(key) => CalibrationServiceClient::new(keyed(&channel, key)).get_capabilities(request).await,
                };
                // Where the connection was just being closed, the client cannot say why.
                let code = called.expect_err("nobody is let in").code();
                assert!(
                    matches!(code, Code::Unauthenticated | Code::Unavailable | Code::Cancelled | Code::Unknown),
                    "{code:?}"
                );
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        })
        .await;
    }
}

#[tokio::test]
async fn a_caller_keeps_its_connection_and_what_goes_over_it() {
    let (solver, hold) = held();
    let server = TestServer::start_with(solver, options(Some(NORTH)), one_worker()).await;
    let (url, connections) = counting(server.server.address()).await;
    let channel = connected(&url).await;
    let mut jobs = JobServiceClient::with_interceptor(channel, Key(NORTH));
    let parent = "tenants/north".into();
    let request = proto::CreateJobRequest { parent, request_id: "once".into(), ..create_tracks() };
    let name = persistent(async || jobs.create_job(request.clone()).await).await.name;
    // That call went over the latest connection.
    let before = connections.load(Ordering::SeqCst);
    let request = proto::WatchJobRequest { name: name.clone(), after_sequence: 0 };
    let mut watch = jobs.watch_job(request).await.expect("a watch").into_inner();
    tokio::time::sleep(4 * BOUND).await;
    jobs.get_job(proto::GetJobRequest { name }).await.expect("an answer");
    hold.let_go();
    soon(async { while watch.message().await.expect("unbroken").is_some() {} }).await;
    assert_eq!(connections.load(Ordering::SeqCst), before, "a caller had to connect again");
}

#[tokio::test]
async fn where_nobody_needs_a_key_any_call_is_a_callers() {
    let server = TestServer::start_with(quick(), options(None), one_worker()).await;
    let address = server.server.address().to_string();
    soon(until_closed(saying(&address, 1, PREFACE).await.remove(0))).await;
    let (url, connections) = counting(server.server.address()).await;
    let mut checker = HealthClient::new(connected(&url).await);
    persistent(async || checker.check(health()).await).await;
    let before = connections.load(Ordering::SeqCst);
    tokio::time::sleep(4 * BOUND).await;
    checker.check(health()).await.expect("an answer");
    assert_eq!(connections.load(Ordering::SeqCst), before, "it had to connect again");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn strangers_in_every_place_make_room_for_a_caller() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let keys = format!("north:{NORTH}");
    let variables = [
        ("SCPSFM_AUTH__KEYS", keys.as_str()),
        ("SCPSFM_SERVER__MAX_CONNECTIONS", "2"),
        ("SCPSFM_SERVER__AUTH_TIMEOUT_SECONDS", "1"),
    ];
    let server = Serving::start_with(directory.path(), &variables, Stdio::null());
    let page = || Page::parse(&server.page("/metrics"));
    let address = server.grpc.trim_start_matches("http://").to_owned();
    let strangers = saying(&address, 2, PREFACE).await;
    soon(async {
        loop {
            if let Ok(channel) = Channel::from_shared(server.grpc.clone()).expect("a URL").connect().await {
                let mut caller = CalibrationServiceClient::new(keyed(&channel, NORTH));
                if caller.get_capabilities(proto::GetCapabilitiesRequest {}).await.is_ok() {
                    break;
                }
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    })
    .await;
    soon(futures_util::future::join_all(strangers.into_iter().map(until_closed))).await;
    // One of the two, if the caller was in before the other.
    soon(async {
        while page().value("scpsfm_unauthenticated_connections_closed_total") < 1.0 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    })
    .await;
}
