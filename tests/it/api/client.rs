//! The client library against a real server.

use scpsfm::client::{Client, EncodedInput, Error, ErrorKind, JobOptions, Options, Setting, ended};
use scpsfm::domain::job::{EventBody, JobEvent, JobState};
use scpsfm::domain::{Input, Limits, Method, Silent, SolveSettings, StopToken};
use scpsfm::engine::default_solver;
use scpsfm::solver;
use scpsfm::synthetic::{Scene, SceneOptions};
use tokio_util::sync::CancellationToken;

use crate::support::server::{TestServer, soon};
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
    let server = TestServer::start(default_solver()).await;
    let mut client = server.client().await;

    let uploaded = client.upload(&EncodedInput::new(&scene.input), &mut |_| ()).await.expect("uploaded");
    let job = client.create_with(&uploaded, &settings, JobOptions::default()).await.expect("a job");
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
