//! Talking to the real program over gRPC.

use scpsfm::rpc::convert;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState, create_job_request::Source};
use scpsfm::synthetic::{Scene, SceneOptions};
use tonic::transport::Channel;

use super::program::Serving;
use super::server::soon;
use super::wire::{create, state_of};

/// The client of a running server.
pub async fn connected(server: &Serving) -> JobServiceClient<Channel> {
    JobServiceClient::connect(server.grpc.clone()).await.expect("a connection")
}

/// A new client gets an answer.
pub async fn is_served(url: &str) {
    let call = async {
        let mut client = CalibrationServiceClient::connect(url.to_owned()).await.expect("a connection");
        client.get_capabilities(proto::GetCapabilitiesRequest {}).await.expect("an answer");
    };
    soon(call).await;
}

/// A request for that scene.
pub fn scene_request(options: &SceneOptions) -> proto::CreateJobRequest {
    let scene = Scene::generate(options).expect("a scene");
    create(Source::TrackSet(convert::input::to_wire(scene.input.clone())))
}

/// A scene that is quickly solved.
pub fn easy(seed: u64) -> proto::CreateJobRequest {
    scene_request(&SceneOptions { views: 6, tracks: 60, outliers: 0.3, seed, ..SceneOptions::default() })
}

/// A job that optimises the network for so many iterations, a few milliseconds each.
pub fn lasting(iterations: u32) -> proto::CreateJobRequest {
    let mut request = scene_request(&SceneOptions { tracks: 400, ..SceneOptions::default() });
    let settings = proto::SolveSettings {
        method: proto::Method::Paper as i32,
        iterations: Some(iterations),
        ..Default::default()
    };
    request.job = Some(proto::Job { settings: Some(settings), ..Default::default() });
    request
}

/// A scene that is solved at once, by geometry alone.
pub fn small(seed: u64) -> proto::CreateJobRequest {
    by_geometry(easy(seed))
}

/// A scene that is solved within some ten milliseconds by an optimised build: what counts is the job, not the solve.
pub fn tiny_options(seed: u64) -> SceneOptions {
    SceneOptions { views: 3, tracks: 16, outliers: 0.0, seed, ..SceneOptions::default() }
}

/// A request for that scene.
pub fn tiny(seed: u64) -> proto::CreateJobRequest {
    by_geometry(scene_request(&tiny_options(seed)))
}

/// The same, solved without the network.
pub fn by_geometry(mut request: proto::CreateJobRequest) -> proto::CreateJobRequest {
    let settings = proto::SolveSettings { method: proto::Method::Geometry as i32, ..Default::default() };
    request.job = Some(proto::Job { settings: Some(settings), ..Default::default() });
    request
}

/// Creates a job and returns its name.
pub async fn created(jobs: &mut JobServiceClient<Channel>, request: proto::CreateJobRequest) -> String {
    jobs.create_job(request).await.expect("a job").into_inner().name
}

/// Follows a job from its first event until it enters one of these states, and returns which.
pub async fn reaches(jobs: &mut JobServiceClient<Channel>, name: &str, states: &[JobState]) -> JobState {
    let request = proto::WatchJobRequest { name: name.into(), after_sequence: 0 };
    let mut watch = jobs.watch_job(request).await.expect("a watch").into_inner();
    while let Some(event) = soon(watch.message()).await.expect("an event") {
        if let Some(state) = state_of(&event).filter(|state| states.contains(state)) {
            return state;
        }
    }
    panic!("{name} ended in none of {states:?}");
}
