//! The command line's client against a real server.

use scpsfm::cli::client::access::AccessArgs;
use scpsfm::cli::client::{Client, Error, JobOptions, ended};
use scpsfm::domain::job::{EventBody, JobEvent, JobState};
use scpsfm::domain::{Input, Limits, SolveSettings};
use tokio_util::sync::CancellationToken;

use crate::support::server::{TestServer, soon};
use crate::support::solvers::{held, quick, solution};
use crate::support::wire::raw;

fn settings() -> SolveSettings {
    SolveSettings { seed: 11, ..SolveSettings::default() }
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
    let found = soon(client.solve(&input, &settings(), &mut on_event, CancellationToken::new())).await;
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
    let outcome = soon(client.solve(&raw(3, 4), &settings(), &mut on_event, stop)).await;
    assert_eq!(outcome, Err(Error::Cancelled));
    let name = name.expect("the job ran");
    let last = soon(client.watch(&name, 0, &mut |_| ())).await.expect("watched to the end").expect("an event");
    assert_eq!(ended(&last), Err(Error::Cancelled));
    let after = last.sequence.expect("a numbered event");
    let nothing = soon(client.watch(&name, after, &mut |event| panic!("{event:?}"))).await;
    assert_eq!(nothing, Ok(None), "a watch after the last event ends at once");
}

#[tokio::test]
async fn a_watch_goes_on_over_a_restart_without_gap_or_repeat() {
    let (solver, _hold) = held();
    let server = TestServer::start(solver).await;
    let mut client = server.client().await;
    let job = client.create(&raw(3, 4), &settings(), JobOptions::default()).await.expect("a job");
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
    let error = client.create(&bad, &settings(), JobOptions::default()).await.expect_err("NaN");
    assert_eq!(error.to_string(), "track_set.xs[7]: NaN is not a finite number");
    let Error::Invalid(violations, _) = error else { panic!("{error:?}") };
    assert_eq!((violations[0].field.as_str(), violations[0].index), ("track_set.xs", Some(7)));
    let name = scpsfm::domain::job::JobName::parse("tenants/default/jobs/none").expect("a name");
    assert!(matches!(client.get(&name).await, Err(Error::Refused(_))));
    assert!(matches!(client.read_result(&name).await, Err(Error::Refused(_))));
    assert!(matches!(Client::connect("localhost:1", &AccessArgs::default()).await, Err(Error::Usage(_))));
    let url = server.url();
    drop(server);
    let error = Client::connect(&url, &AccessArgs::default()).await.expect_err("nobody listens");
    assert!(matches!(&error, Error::Unavailable(message) if message.contains(&url)), "{error:?}");
}
