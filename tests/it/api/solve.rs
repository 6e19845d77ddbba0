//! `CalibrationService.Solve`: one call from input to result.

use std::time::Duration;

use scpsfm::rpc::convert;
use scpsfm::rpc::follow::Followers;
use scpsfm::rpc::proto::{self, JobState, create_job_request::Input, job_event::Body, solve_request::Message};
use scpsfm::rpc::server::Options;
use tonic::Streaming;

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
    let head = Message::Config(create(Input::TrackSet(convert::input::head_to_wire(&whole))));
    let chunk = |range: std::ops::Range<usize>| {
        Message::TrackSetChunk(proto::TrackSetChunk {
            view: whole.view[range.clone()].to_vec(),
            track: whole.track[range.clone()].to_vec(),
            x: whole.x[range.clone()].to_vec(),
            y: whole.y[range].to_vec(),
            ..Default::default()
        })
    };
    let mut stream = solve(&server, vec![head, chunk(0..100), chunk(100..150)]).await;
    let mut events = Vec::new();
    while let Some(event) = soon(stream.message()).await.expect("a solve ends well") {
        if let Some(Body::Progress(progress)) = &event.body {
            assert_eq!((progress.iteration, progress.focal_px), (10, Some(1000.0)));
            hold.let_go();
        }
        events.push(event);
    }
    let first = &events[0];
    assert!(first.name.starts_with("tenants/default/jobs/"), "{}", first.name);
    assert_eq!((first.sequence, state_of(first)), (1, Some(JobState::Queued)));
    assert!(events.iter().all(|event| event.name == first.name));
    let result = events.iter().position(|event| matches!(event.body, Some(Body::Result(_)))).expect("a result");
    assert!(result < events.len() - 1, "the final state follows the result");
    assert_eq!(state_of(events.last().expect("events")), Some(JobState::Succeeded));
    let job = server.engine.job(&convert::names::job(&first.name).expect("a name")).await.expect("a job");
    assert_eq!((job.view_count, job.track_count, job.observation_count), (3, 50, 150));
}

#[tokio::test]
async fn a_matrix_may_come_in_chunks_too() {
    let server = TestServer::start(quick()).await;
    let mut whole = matrix();
    let rest = whole.values.split_off(5);
    let config = Message::Config(create(Input::MeasurementMatrix(whole)));
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
    let name = soon(stream.message()).await.expect("an event").expect("the first event").name;
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
    let name = soon(first.message()).await.expect("an event").expect("the first event").name;
    let second = solve(&server, vec![config()]).await;
    drop(first);
    hold.let_go();
    let (events, end) = soon(all(second)).await;
    end.expect("a solve ends well");
    assert!(events.iter().all(|event| event.name == name));
    assert_eq!(state_of(events.last().expect("events")), Some(JobState::Succeeded));
}

#[tokio::test]
async fn a_job_that_is_followed_again_within_the_grace_period_goes_on() {
    const GRACE: Duration = Duration::from_millis(100);
    let (solver, _hold) = held();
    let server = TestServer::start(solver).await;
    let created = server.jobs().await.create_job(create_tracks()).await.expect("a job").into_inner();
    let name = convert::names::job(&created.name).expect("a name");
    let followers = Followers::new(server.engine.clone(), GRACE);
    drop(followers.follow(name.clone()));
    let follower = followers.follow(name.clone());
    tokio::time::sleep(3 * GRACE).await;
    let job = server.engine.job(&name).await.expect("a job");
    assert!(!job.state.is_terminal() && !job.cancel_requested, "{job:?}");
    drop(follower);
    assert_eq!(states(&server, &created.name).await.last(), Some(&JobState::Cancelled));
}

#[tokio::test]
async fn a_solve_that_ended_is_not_cancelled_by_the_end_of_its_call() {
    let options = Options { solve_grace: Duration::ZERO, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let (events, end) = soon(all(solve(&server, vec![Message::Config(create_tracks())]).await)).await;
    end.expect("a solve ends well");
    assert_eq!(states(&server, &events[0].name).await.last(), Some(&JobState::Succeeded));
}
