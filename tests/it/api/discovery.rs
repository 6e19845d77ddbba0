//! What a stranger can find out: reflection, health, capabilities, compression.

use std::time::Duration;

use prost::Message;
use scpsfm::domain::{Limits, SolveSettings};
use scpsfm::rpc::convert;
use scpsfm::rpc::proto::{self, Method};
use scpsfm::rpc::server::Options;
use scpsfm::solver;
use tonic::Code;
use tonic::codec::CompressionEncoding::Gzip;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};
use tonic_reflection::pb::{v1, v1alpha};

use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick};
use crate::support::wire::create_tracks;

#[tokio::test]
async fn reflection_lists_and_describes_the_services() {
    use v1::server_reflection_request::MessageRequest;
    use v1::server_reflection_response::MessageResponse;

    let server = TestServer::start(quick()).await;
    let mut client = v1::server_reflection_client::ServerReflectionClient::new(server.channel().await);
    let mut ask = async |question| {
        let request = v1::ServerReflectionRequest { host: String::new(), message_request: Some(question) };
        let answer = client.server_reflection_info(tokio_stream::once(request)).await.expect("an answer");
        answer.into_inner().message().await.expect("a message").expect("one").message_response.expect("set")
    };
    let MessageResponse::ListServicesResponse(list) = ask(MessageRequest::ListServices(String::new())).await else {
        panic!("not a list of services");
    };
    let names: Vec<_> = list.service.into_iter().map(|service| service.name).collect();
    for name in ["CalibrationService", "JobService", "InputService"] {
        assert!(names.contains(&format!("scpsfm.v1.{name}")), "{name} is not among {names:?}");
    }
    let symbol = MessageRequest::FileContainingSymbol("scpsfm.v1.JobService.WatchJob".into());
    let MessageResponse::FileDescriptorResponse(files) = ask(symbol).await else { panic!("not a file") };
    let file = prost_types::FileDescriptorProto::decode(files.file_descriptor_proto[0].as_slice()).expect("a file");
    assert_eq!(file.name(), "scpsfm/v1/job_service.proto");
}

#[tokio::test]
async fn older_clients_find_reflection_too() {
    let server = TestServer::start(quick()).await;
    let mut client = v1alpha::server_reflection_client::ServerReflectionClient::new(server.channel().await);
    let request = v1alpha::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(v1alpha::server_reflection_request::MessageRequest::ListServices(String::new())),
    };
    let answer = client.server_reflection_info(tokio_stream::once(request)).await.expect("an answer");
    assert!(answer.into_inner().message().await.expect("a message").is_some());
}

#[tokio::test]
async fn health_turns_with_a_drain_while_calls_go_on() {
    let server = TestServer::start(quick()).await;
    let mut health = HealthClient::new(server.channel().await);
    let mut check = async |service: &str| -> Result<HealthCheckResponse, tonic::Status> {
        Ok(health.check(HealthCheckRequest { service: service.into() }).await?.into_inner())
    };
    for service in ["", "scpsfm.v1.JobService", "scpsfm.v1.CalibrationService"] {
        assert_eq!(check(service).await.expect("known").status(), ServingStatus::Serving, "{service:?}");
    }
    assert_eq!(check("scpsfm.v1.Nothing").await.expect_err("unknown").code(), Code::NotFound);
    server.server.set_draining().await;
    for service in ["", "scpsfm.v1.JobService"] {
        assert_eq!(check(service).await.expect("known").status(), ServingStatus::NotServing, "{service:?}");
    }
    server.jobs().await.create_job(create_tracks()).await.expect("calls go on");
}

#[tokio::test]
async fn a_drained_server_turns_callers_away_and_ends() {
    let (solver, _hold) = held();
    let server = TestServer::start(solver).await;
    let mut jobs = server.jobs().await;
    let name = jobs.create_job(create_tracks()).await.expect("a job").into_inner().name;
    let request = proto::WatchJobRequest { name, after_sequence: 0 };
    let watch = jobs.watch_job(request).await.expect("a watch").into_inner();
    soon(server.engine.drain(Duration::ZERO)).await;
    let (_, end) = soon(crate::support::wire::all(watch)).await;
    assert_eq!(end.expect_err("cut off").code(), Code::Unavailable);
    let status = jobs.create_job(create_tracks()).await.expect_err("draining");
    assert_eq!(status.code(), Code::Unavailable);
    assert!(tonic_types::StatusExt::get_details_retry_info(&status).is_some());
    drop(jobs);
    soon(server.server.shutdown(Duration::from_secs(30))).await.expect("a clean end");
}

#[tokio::test]
async fn capabilities_tell_limits_and_defaults() {
    let limits = Limits { max_views: 10, max_tracks: 20, max_observations: 30 };
    let options = Options { limits, max_message_bytes: 12_345, max_connections: 77, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut calibration = server.calibration().await;
    let answer = calibration.get_capabilities(proto::GetCapabilitiesRequest {}).await.expect("capabilities");
    let capabilities = answer.into_inner();
    let limits = capabilities.input_limits.expect("limits");
    assert_eq!((limits.max_views, limits.max_tracks, limits.max_observations), (10, 20, 30));
    assert_eq!(limits.max_message_bytes, 12_345);
    assert_eq!(capabilities.max_connections, 77);
    assert_eq!(
        capabilities.methods().collect::<Vec<_>>(),
        [Method::Auto, Method::Paper, Method::Geometry, Method::Psfm, Method::Scpsfm]
    );
    assert_eq!(convert::settings::from_wire(capabilities.default_settings), Ok(SolveSettings::default()));
    assert_eq!(capabilities.server_version, env!("CARGO_PKG_VERSION"));
    assert_eq!(capabilities.trained_network_sha256, solver::trained_network_sha256().0);
}

#[tokio::test]
async fn gzip_is_spoken_both_ways() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await.send_compressed(Gzip).accept_compressed(Gzip);
    let answer = jobs.create_job(create_tracks()).await.expect("a compressed request is understood");
    let encoding = answer.metadata().get("grpc-encoding").map(|value| value.to_str().expect("ascii").to_owned());
    assert_eq!(encoding.as_deref(), Some("gzip"));
}
