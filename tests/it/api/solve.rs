//! `CalibrationService.Solve`: one call from input to result.

use std::sync::Arc;
use std::time::Duration;

use scpsfm::domain::job::Job;
use scpsfm::engine::Engine;
use scpsfm::rpc::convert;
use scpsfm::rpc::convert::input_message::InputMessage;
use scpsfm::rpc::convert::result::encode as encode_result;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::proto::{self, JobState, create_job_request::Source, job_event::Body, solve_request::Message};
use scpsfm::rpc::server::{Options, Server};
use scpsfm::store::postgres::{DatabaseUrl, Postgres};
use tonic::Streaming;

use crate::support::postgres;
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick};
use crate::support::wire::{all, create, create_tracks, matrix, raw, solve_request, state_of};

async fn solve(server: &TestServer, messages: Vec<Message>) -> Streaming<proto::JobEvent> {
    let requests: Vec<_> = messages.into_iter().map(solve_request).collect();
    server.calibration().await.solve(tokio_stream::iter(requests)).await.expect("a solve").into_inner()
}

/// The states of a job from its beginning to its end.
async fn states(server: &TestServer, name: &str) -> Vec<JobState> {
    let request = proto::WatchJobRequest { name: name.into(), after_sequence: 0 };
    let watch = server.jobs().await.watch_job(request).await.expect("a watch").into_inner();
    let (events, end) = soon(all(watch)).await;
    end.expect("the watch ends with the job");
    events.iter().filter_map(state_of).collect()
}

#[tokio::test]
async fn events_name_the_job_first_and_end_with_its_state() {
    let (solver, hold) = held();
    let server = TestServer::start(solver).await;
    let whole = raw(3, 50);
    let head = Message::Config(create(Source::TrackSet(convert::input::to_wire(whole.clone()).head())));
    let chunk = |range: std::ops::Range<usize>| {
        Message::TrackSetChunk(proto::TrackSetChunk {
            view_indices: whole.view[range.clone()].to_vec(),
            track_indices: whole.track[range.clone()].to_vec(),
            xs: whole.x[range.clone()].to_vec(),
            ys: whole.y[range].to_vec(),
            ..Default::default()
        })
    };
    let mut stream = solve(&server, vec![head, chunk(0..100), chunk(100..150)]).await;
    let mut events = Vec::new();
    while let Some(event) = soon(stream.message()).await.expect("a solve ends well") {
        if let Some(Body::Progress(progress)) = &event.body {
            assert_eq!((progress.iteration_count, progress.focal_px), (10, Some(1000.0)));
            hold.let_go();
        }
        events.push(event);
    }
    let first = &events[0];
    assert!(first.job.starts_with("tenants/default/jobs/"), "{}", first.job);
    assert_eq!((first.sequence, state_of(first)), (1, Some(JobState::Queued)));
    assert!(events.iter().all(|event| event.job == first.job));
    let result = events.iter().position(|event| matches!(event.body, Some(Body::Summary(_)))).expect("a result");
    assert!(result < events.len() - 1, "the final state follows the result");
    assert_eq!(state_of(events.last().expect("events")), Some(JobState::Succeeded));
    let job = server.engine.job(&convert::names::job(&first.job, "default").expect("a name")).await.expect("a job");
    assert_eq!((job.view_count, job.track_count, job.observation_count), (3, 50, 150));
}

#[tokio::test]
async fn a_matrix_may_come_in_chunks_too() {
    let server = TestServer::start(quick()).await;
    let mut whole = matrix();
    let rest = whole.values.split_off(5);
    let config = Message::Config(create(Source::MeasurementMatrix(whole)));
    let chunk = Message::MeasurementMatrixChunk(proto::MeasurementMatrixChunk { values: rest, ..Default::default() });
    let (events, end) = soon(all(solve(&server, vec![config, chunk]).await)).await;
    end.expect("a solve ends well");
    assert_eq!(state_of(events.last().expect("events")), Some(JobState::Succeeded));
}

#[tokio::test]
async fn dropping_the_call_cancels_the_job_after_the_grace_period() {
    let (solver, _hold) = held();
    let options = Options { solve_grace: Duration::from_millis(1), ..Options::default() };
    let server = TestServer::start_with(solver, options, one_worker()).await;
    let mut stream = solve(&server, vec![Message::Config(create_tracks())]).await;
    let name = soon(stream.message()).await.expect("an event").expect("the first event").job;
    drop(stream);
    assert_eq!(states(&server, &name).await.last(), Some(&JobState::Cancelled));
}

#[tokio::test]
async fn two_calls_with_one_request_id_follow_one_job() {
    let (solver, hold) = held();
    let options = Options { solve_grace: Duration::ZERO, ..Options::default() };
    let server = TestServer::start_with(solver, options, one_worker()).await;
    let config = || Message::Config(proto::CreateJobRequest { request_id: "again".into(), ..create_tracks() });
    let mut first = solve(&server, vec![config()]).await;
    let name = soon(first.message()).await.expect("an event").expect("the first event").job;
    let second = solve(&server, vec![config()]).await;
    drop(first);
    hold.let_go();
    let (events, end) = soon(all(second)).await;
    end.expect("a solve ends well");
    assert!(events.iter().all(|event| event.job == name));
    assert_eq!(state_of(events.last().expect("events")), Some(JobState::Succeeded));
}

#[tokio::test]
async fn only_a_job_that_solve_created_is_cancelled_by_a_disconnect() {
    let (solver, hold) = held();
    let options = Options { solve_grace: Duration::ZERO, ..Options::default() };
    let server = TestServer::start_with(solver, options, one_worker()).await;
    let request = |id: &str| proto::CreateJobRequest { request_id: id.into(), ..create_tracks() };
    let (mut jobs, mut calibration) = (server.jobs().await, server.calibration().await);
    // One that CreateJob made and two that Solve made, one of which CreateJob has answered with since.
    let created = jobs.create_job(request("created")).await.expect("a job").into_inner().name;
    let mut streams = Vec::new();
    for id in ["created", "kept", "solved"] {
        let messages = tokio_stream::once(solve_request(Message::Config(request(id))));
        let mut stream = calibration.solve(messages).await.expect("a solve").into_inner();
        let name = soon(stream.message()).await.expect("an event").expect("the first event").job;
        streams.push((name, stream));
    }
    assert_eq!(jobs.create_job(request("kept")).await.expect("a job").into_inner().name, streams[1].0);
    let names: Vec<String> = streams.into_iter().map(|(name, _)| name).collect();
    assert_eq!(names[0], created);
    // The disconnect of the last one is noticed last.
    assert_eq!(states(&server, &names[2]).await.last(), Some(&JobState::Cancelled));
    hold.let_go();
    for name in &names[..2] {
        assert_eq!(states(&server, name).await.last(), Some(&JobState::Succeeded), "{name}");
    }
}

#[tokio::test]
async fn two_calls_on_two_servers_of_one_database_are_attached_to_one_job() {
    let Some(cluster) = postgres::shared("a Solve that comes back to another server") else { return };
    let url: DatabaseUrl = cluster.database().await.parse().expect("an address");
    let (solver, _hold) = held();
    let options = Options { solve_grace: Duration::ZERO, ..Options::default() };
    let mut servers = Vec::new();
    for _ in 0..2 {
        let store = Arc::new(Postgres::open(&url).await.expect("a store"));
        let engine = Engine::start(one_worker(), store, Arc::clone(&solver), encode_result).await.expect("an engine");
        let server = Server::bind(options.clone(), engine.clone()).await.expect("a server");
        servers.push((server, engine));
    }
    let attach = async |server: &Server| {
        let url = format!("http://{}", server.address());
        let mut client = CalibrationServiceClient::connect(url).await.expect("a connection");
        let config = proto::CreateJobRequest { request_id: "again".into(), ..create_tracks() };
        let messages = tokio_stream::once(solve_request(Message::Config(config)));
        let mut stream = client.solve(messages).await.expect("a solve").into_inner();
        let name = soon(stream.message()).await.expect("an event").expect("the first event").job;
        (convert::names::job(&name, "default").expect("a name"), stream)
    };
    let (name, first) = attach(&servers[0].0).await;
    let (same, second) = attach(&servers[1].0).await;
    assert_eq!(name, same);
    let engine = &servers[1].1;
    let until = async |holds: fn(&Job) -> bool| {
        soon(async {
            loop {
                let job = engine.job(&name).await.expect("a job");
                if holds(&job) {
                    break job;
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        })
        .await
    };
    drop(first);
    let job = until(|job| job.attached_calls.is_some_and(|calls| calls.detached == 1)).await;
    assert!(!job.state.is_terminal() && !job.cancel_requested, "{job:?}");
    drop(second);
    let job = until(|job| job.state.is_terminal()).await;
    assert_eq!(job.state, scpsfm::domain::job::JobState::Cancelled);
    assert_eq!(job.attached_calls.map(|calls| (calls.attached, calls.detached)), Some((2, 2)));
}

#[tokio::test]
async fn a_solve_that_ended_is_not_cancelled_by_the_end_of_its_call() {
    let options = Options { solve_grace: Duration::ZERO, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let (events, end) = soon(all(solve(&server, vec![Message::Config(create_tracks())]).await)).await;
    end.expect("a solve ends well");
    assert_eq!(states(&server, &events[0].job).await.last(), Some(&JobState::Succeeded));
}
