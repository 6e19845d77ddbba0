//! The client library against a real server.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use scpsfm::client::{Client, EncodedInput, Error, ErrorKind, JobInput, JobOptions, Options, Setting, ended};
use scpsfm::domain::job::{EventBody, Job, JobEvent, JobState};
use scpsfm::domain::{Input, Limits, Method, Silent, Solution, SolveSettings, StopToken, Warning, WarningCode};
use scpsfm::engine::Solver;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::{proto, server};
use scpsfm::solver;
use scpsfm::synthetic::{Scene, SceneOptions};
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;

use crate::support::connections::cutting;
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick, solution};
use crate::support::wire::raw;

fn settings() -> SolveSettings {
    SolveSettings { seed: 11, ..SolveSettings::default() }
}

fn kind<T>(outcome: Result<T, Error>) -> Option<ErrorKind> {
    outcome.err().map(|error| error.kind)
}

/// As a program does it that uses the library, with the real solver.
#[tokio::test]
async fn an_uploaded_input_is_solved_as_it_is_in_process() {
    let options = SceneOptions { views: 6, tracks: 60, outliers: 0.3, seed: 5, ..SceneOptions::default() };
    let scene = Scene::generate(&options).expect("a scene");
    let settings = SolveSettings { method: Method::Geometry, ..SolveSettings::default() };
    let server = TestServer::start(Arc::new(solver::solve)).await;
    let mut client = server.client().await;

    let uploaded = client.upload(&EncodedInput::new(&scene.input), &mut |_| ()).await.expect("uploaded");
    let job = client.create(JobInput::Uploaded(uploaded), &settings, JobOptions::default()).await.expect("a job");
    let mut states = Vec::new();
    let mut on_event = |event: &JobEvent| {
        if let EventBody::State { state, .. } = event.body {
            states.push(state);
        }
    };
    let last = soon(client.watch(&job.name, 0, &mut on_event)).await.expect("watched").expect("an event");
    ended(&last).expect("succeeded");
    assert_eq!(states, [JobState::Queued, JobState::Running, JobState::Succeeded]);
    let found = client.read_result(&job.name).await.expect("a result");

    let input = Input::new(scene.input, &Limits::default(), "").expect("valid");
    let here = solver::solve(&input, &settings, &mut Silent, &StopToken::default()).expect("solved");
    assert_eq!((found.status, found.grade), (here.status, here.grade));
    assert_eq!(found.tracks.inlier, here.tracks.inlier);
    let focal_px = |of: &scpsfm::domain::Solution| of.calibrations.first().map(|calibration| calibration.focal_px);
    assert_eq!(focal_px(&found), focal_px(&here));
}

#[tokio::test]
async fn solve_returns_what_the_solver_found() {
    let (solver, hold) = held();
    let server = TestServer::start(solver).await;
    // Above one chunk, so that the input comes in several.
    let input = raw(2, 40_000);
    let expected = solution(&Input::new(input.clone(), &Limits::default(), "").expect("valid"), &settings());
    let mut on_event = |event: &JobEvent| {
        if matches!(event.body, EventBody::Progress(_)) {
            hold.let_go();
        }
    };
    let mut client = server.client().await;
    let found = soon(client.solve(input, &settings(), &mut on_event, CancellationToken::new())).await;
    assert_eq!(found.expect("solved"), expected);
}

#[tokio::test]
async fn stopping_a_solve_cancels_its_job() {
    let (solver, _hold) = held();
    let server = TestServer::start(solver).await;
    let mut client = server.client().await;
    let stop = CancellationToken::new();
    let (on_running, mut name) = (stop.clone(), None);
    let mut on_event = |event: &JobEvent| {
        if matches!(event.body, EventBody::State { state: JobState::Running, .. }) {
            name = Some(event.job.clone());
            on_running.cancel();
        }
    };
    let outcome = soon(client.solve(raw(3, 4), &settings(), &mut on_event, stop)).await;
    assert_eq!(kind(outcome), Some(ErrorKind::Cancelled));
    let name = name.expect("the job ran");
    let last = soon(client.watch(&name, 0, &mut |_| ())).await.expect("watched to the end").expect("an event");
    assert_eq!(kind(ended(&last)), Some(ErrorKind::Cancelled));
    let after = last.sequence.expect("a numbered event");
    let nothing = soon(client.watch(&name, after, &mut |event| panic!("{event:?}"))).await;
    assert_eq!(nothing, Ok(None), "a watch after the last event ends at once");
}

#[tokio::test]
async fn a_watch_goes_on_over_a_restart_without_gap_or_repeat() {
    let (solver, _hold) = held();
    let server = TestServer::start(solver).await;
    let mut client = server.client().await;
    let job = client.create(raw(3, 4), &settings(), JobOptions::default()).await.expect("a job");
    let (ran, runs) = tokio::sync::oneshot::channel();
    let watching = tokio::spawn(async move {
        let (mut ran, mut sequences) = (Some(ran), Vec::new());
        let mut on_event = |event: &JobEvent| {
            sequences.extend(event.sequence);
            if matches!(event.body, EventBody::State { state: JobState::Running, .. })
                && let Some(ran) = ran.take()
            {
                ran.send(()).expect("the test waits");
            }
        };
        let last = client.watch(&job.name, 0, &mut on_event).await;
        (last, sequences)
    });
    soon(runs).await.expect("the job runs");
    let server = server.restart(quick()).await;
    let (last, sequences) = soon(watching).await.expect("the watch does not panic");
    ended(&last.expect("watched to the end").expect("an event")).expect("solved after the restart");
    assert_eq!(sequences, (1..=sequences.len() as u64).collect::<Vec<_>>());
    drop(server);
}

#[tokio::test]
async fn inputs_that_are_too_large_for_a_message_are_uploaded() {
    // The least that a configuration may say.
    let options = server::Options { max_message_bytes: 1_049_600, ..server::Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut client = server.client().await;
    let large = raw(2, 40_000);
    let job = client.create(&large, &settings(), JobOptions::default()).await.expect("a job");
    ended(&soon(client.watch(&job.name, 0, &mut |_| ())).await.expect("watched").expect("an event")).expect("solved");

    // Each fits into a message, all of them do not.
    let medium = || JobInput::from(raw(2, 10_000));
    let options = JobOptions { request_id: Some("r".into()), ..JobOptions::default() };
    let jobs = client.create_batch([medium(), medium(), medium(), large.clone().into()], &settings(), &options).await;
    let jobs = jobs.expect("four jobs");
    let names = |jobs: &[Job]| jobs.iter().map(|job| job.name.clone()).collect::<Vec<_>>();
    assert_eq!(jobs.len(), 4);
    let again = client.create_batch([medium(), medium(), medium(), large.clone().into()], &settings(), &options).await;
    assert_eq!(names(&again.expect("the same")), names(&jobs));

    // Whether it was uploaded or is in the message.
    for mut bad in [large, raw(2, 10)] {
        bad.x[7] = f64::NAN;
        let refused = client.create_batch([medium(), bad.into()], &settings(), &JobOptions::default()).await;
        let refused = refused.expect_err("NaN");
        let first = &refused.violations[0];
        assert_eq!((first.field.as_str(), first.index), ("requests[1].track_set.xs", Some(7)), "{refused:?}");
        assert!(refused.message.starts_with("requests[1]: "), "{refused}");
    }
}

#[tokio::test]
async fn a_result_whose_download_is_cut_off_is_read_on_from_there() {
    let server = TestServer::start(quick()).await;
    let mut client = server.client().await;
    let job = client.create(raw(2, 100_000), &settings(), JobOptions::default()).await.expect("a job");
    soon(client.watch(&job.name, 0, &mut |_| ())).await.expect("watched");
    let (url, received) = cutting(server.server.address(), usize::MAX).await;
    let mut through = Client::connect(&url, &Options::default()).await.expect("a connection");
    let expected = soon(through.read_result(&job.name)).await.expect("a result");
    let whole = received.load(Ordering::SeqCst);
    assert!(whole > 400_000, "{whole} bytes, of several chunks");

    let (url, received) = cutting(server.server.address(), whole / 2).await;
    let mut through = Client::connect(&url, &Options::default()).await.expect("a connection");
    let found = soon(through.read_result(&job.name)).await;
    assert!(found == Ok(expected), "another result");
    let twice = received.load(Ordering::SeqCst);
    // What was cut off within a chunk comes again.
    assert!(twice < whole + whole / 4, "{twice} of {whole} bytes: read anew");
}

#[tokio::test]
async fn a_result_that_the_server_has_no_memory_for_is_waited_for() {
    let solver: Solver = Arc::new(|input, settings, _observer, _stop| {
        let warnings = vec![Warning::new(WarningCode::SecondStructure, "x".repeat(4 << 20))];
        Ok(Solution { warnings, ..solution(input, settings) })
    });
    let options = server::Options { max_inflight_bytes: 4 << 20, ..server::Options::default() };
    let server = TestServer::start_with(solver, options, one_worker()).await;
    let mut client = server.client().await;
    let job = client.create(raw(3, 4), &settings(), JobOptions::default()).await.expect("a job");
    ended(&soon(client.watch(&job.name, 0, &mut |_| ())).await.expect("watched").expect("an event")).expect("solved");
    // Another caller takes all of it, and reads on no further.
    let endpoint = Channel::from_shared(server.url()).expect("a URL").initial_stream_window_size(65_535);
    let mut other = JobServiceClient::new(endpoint.connect().await.expect("a connection"));
    let request = proto::ReadJobResultRequest { name: job.name.to_string(), offset: 0 };
    let held = other.read_job_result(request).await.expect("a stream").into_inner();
    let (told, mut waits) = tokio::sync::mpsc::unbounded_channel();
    client.on_wait(move |error| told.send(error.clone()).expect("the test listens"));
    let reading = tokio::spawn(async move { client.read_result(&job.name).await });
    let error = soon(waits.recv()).await.expect("a wait");
    assert_eq!((error.kind, error.reason.as_deref()), (ErrorKind::Unavailable, Some("MEMORY")));
    assert!(error.message.ends_with("; try again in 2 s"), "{error}");
    drop(held);
    soon(reading).await.expect("no panic").expect("a result, once there is room");
}

#[tokio::test]
async fn errors_are_sentences() {
    let server = TestServer::start(quick()).await;
    let mut client = server.client().await;
    let mut bad = raw(3, 4);
    bad.x[7] = f64::NAN;
    let error = client.create(bad, &settings(), JobOptions::default()).await.expect_err("NaN");
    assert_eq!(error.to_string(), "track_set.xs[7]: NaN is not a finite number");
    assert_eq!((error.kind, error.reason.as_deref()), (ErrorKind::Invalid, Some("INVALID_ARGUMENT")));
    assert_eq!((error.violations[0].field.as_str(), error.violations[0].index), ("track_set.xs", Some(7)));
    let name = scpsfm::domain::job::JobName::parse("tenants/default/jobs/none").expect("a name");
    assert_eq!(kind(client.get(&name).await), Some(ErrorKind::Refused));
    assert_eq!(kind(client.read_result(&name).await), Some(ErrorKind::Refused));
    assert_eq!(kind(Client::connect("localhost:1", &Options::default()).await), Some(ErrorKind::Usage));
    let url = server.url();
    drop(server);
    let error = Client::connect(&url, &Options::default()).await.expect_err("nobody listens");
    assert_eq!((error.kind, error.setting), (ErrorKind::Unavailable, Some(Setting::Server)));
    assert!(error.message.contains(&url), "{error:?}");
}
