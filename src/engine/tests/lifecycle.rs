//! One job from submission to its end, whatever that is.

use std::time::{Duration, SystemTime};

use super::*;
use crate::engine::{Deadline, Error};

#[tokio::test]
async fn a_job_runs_to_its_result() {
    let bench = TestEngine::start(workers(1)).await;
    let new = NewJob { labels: [("a".to_owned(), "b".to_owned())].into(), ..new_job(Script::Succeed) };
    let job = bench.engine.submit(new).await.expect("admitted");
    assert_eq!((job.state, job.attempt, job.observation_count), (JobState::Queued, 0, 4));
    let mut watch = bench.engine.watch(&job.name, 0).await.expect("exists");
    let events = rest(&mut watch).await;
    assert_contiguous(&events, 1);
    let bodies: Vec<_> = events.iter().map(|event| &event.body).collect();
    let entered = |state| EventBody::State { state, failure: None };
    assert_eq!(*bodies[0], entered(JobState::Queued));
    assert_eq!(*bodies[1], entered(JobState::Running));
    assert!(matches!(bodies[bodies.len() - 2], EventBody::Summary(summary) if summary.iterations == 1), "{bodies:?}");
    assert_eq!(**bodies.last().expect("events"), entered(JobState::Succeeded));
    let ended = bench.engine.job(&job.name).await.expect("exists");
    assert_eq!((ended.state, ended.attempt), (JobState::Succeeded, 1));
    assert_eq!(ended.last_sequence, events.len() as u64);
    assert_eq!(ended.progress.map(|progress| progress.iteration), Some(1), "stored, however short the job");
    assert_eq!(call_of(&bench.engine, &job.name).await, 1);
}

#[tokio::test]
async fn a_defect_fails_its_job_and_the_worker_goes_on() {
    let bench = TestEngine::start(workers(1)).await;
    for (script, message) in [(Script::Fail, "told to fail"), (Script::Panic, "the solver panicked: told to panic")] {
        let name = bench.submit(script).await;
        let job = bench.ended(&name).await;
        let failure = job.failure.expect("a reason");
        assert_eq!((job.state, failure.reason.as_str()), (JobState::Failed, "INTERNAL"));
        assert_eq!(failure.message, message);
        assert_eq!(bench.engine.result(&name).await, Err(Error::NotReady(JobState::Failed)));
    }
    let name = bench.submit(Script::Succeed).await;
    assert_eq!(bench.ended(&name).await.state, JobState::Succeeded);
}

#[tokio::test]
async fn an_input_that_cannot_be_read_fails_its_job() {
    let bench = TestEngine::start(workers(1)).await;
    let broken = crate::store::NewRecord {
        name: JobName { tenant: DEFAULT_TENANT.into(), job: "broken".into() },
        request: None,
        input: b"not an input".to_vec().into(),
        view_count: 2,
        track_count: 2,
        observation_count: 4,
        settings: SolveSettings::default(),
        deadline: None,
        priority: 0,
        labels: Default::default(),
        trace_parent: None,
        cancel_on_disconnect: false,
        webhook_url: None,
    };
    let name = broken.name.clone();
    let room = &bench.engine.inner.options.queue;
    bench.store.create_job(broken, room, SystemTime::now()).await.expect("created");
    // Nobody told the engine: it finds the job by itself.
    let job = bench.ended(&name).await;
    assert_eq!(job.state, JobState::Failed);
    assert_eq!(bench.gate.calls.load(Ordering::SeqCst), 0);
}

#[tokio::test]
async fn a_cancel_reaches_a_queued_a_running_and_no_ended_job() {
    let bench = TestEngine::start(workers(1)).await;
    let running = bench.submit(Script::Wait).await;
    bench.gate.until_waiting(1).await;
    let queued = bench.submit(Script::Wait).await;

    let mut watch = bench.engine.watch(&queued, 1).await.expect("exists");
    assert_eq!(bench.engine.cancel(&queued).await.expect("exists").state, JobState::Cancelled);
    let events = rest(&mut watch).await;
    assert_eq!(events.iter().map(terminal).collect::<Vec<_>>(), [Some(JobState::Cancelled)]);

    assert_eq!(bench.engine.result(&running).await, Err(Error::NotReady(JobState::Running)));
    let flagged = bench.engine.cancel(&running).await.expect("exists");
    assert!(flagged.state == JobState::Running && flagged.cancel_requested, "{flagged:?}");
    let job = bench.ended(&running).await;
    assert_eq!((job.state, job.cancel_requested), (JobState::Cancelled, false));
    assert_eq!(bench.engine.cancel(&running).await, Ok(job));
    assert_eq!(bench.gate.calls.load(Ordering::SeqCst), 1, "the queued job was never begun");
}

#[tokio::test]
async fn a_cancel_that_another_process_stored_arrives_with_a_heartbeat() {
    let options = Options { lease: Duration::from_millis(300), max_attempts: u32::MAX, ..workers(1) };
    let bench = TestEngine::start(options).await;
    let name = bench.submit(Script::Wait).await;
    bench.gate.until_waiting(1).await;
    bench.store.request_cancel(&name, None, SystemTime::now()).await.expect("flags");
    assert_eq!(bench.ended(&name).await.state, JobState::Cancelled);
}

#[tokio::test]
async fn a_deadline_ends_a_running_and_a_queued_job() {
    let bench = TestEngine::start(workers(1)).await;
    let soon = Some(Deadline::After(Duration::from_millis(200)));
    let running = bench.engine.submit(NewJob { deadline: soon, ..new_job(Script::Wait) }).await.expect("admitted");
    let long_ago = Some(Deadline::At(SystemTime::UNIX_EPOCH));
    let queued = bench.engine.submit(NewJob { deadline: long_ago, ..new_job(Script::Wait) }).await.expect("admitted");
    for job in [running, queued] {
        let mut watch = bench.engine.watch(&job.name, 0).await.expect("exists");
        let events = rest(&mut watch).await;
        assert_eq!(events.last().and_then(terminal), Some(JobState::DeadlineExceeded));
        assert_contiguous(&events, 1);
    }
}

#[tokio::test]
async fn priority_goes_before_age() {
    // What is prefetched while one job is there goes first also where a more important one comes a moment later.
    let bench = TestEngine::start(Options { short_job: Duration::ZERO, ..workers(1) }).await;
    let first = bench.submit(Script::Wait).await;
    bench.gate.until_waiting(1).await;
    let mut names = vec![first];
    for priority in [0, 7] {
        let new = NewJob { priority, ..new_job(Script::Succeed) };
        names.push(bench.engine.submit(new).await.expect("admitted").name);
    }
    bench.gate.open();
    let mut calls = Vec::new();
    for name in &names {
        bench.ended(name).await;
        calls.push(call_of(&bench.engine, name).await);
    }
    assert_eq!(calls, [1, 3, 2]);
}
