//! One job from submission to its end, whatever that is.

use std::time::{Duration, SystemTime};

use super::*;
use crate::engine::{Deadline, Error};

#[tokio::test]
async fn a_job_runs_to_its_result() {
    let test = TestEngine::start(workers(1)).await;
    let new =
        described(JobDescription { labels: [("a".to_owned(), "b".to_owned())].into(), ..behaving(Behavior::Succeed) });
    let job = test.engine.submit(new).await.expect("admitted");
    assert_eq!((job.state, job.attempt, job.observation_count), (JobState::Queued, 0, 4));
    let mut watch = test.engine.watch(&job.name, 0).await.expect("exists");
    let events = rest(&mut watch).await;
    assert_contiguous(&events, 1);
    let bodies: Vec<_> = events.iter().map(|event| &event.body).collect();
    let entered = |state| EventBody::State { state, failure: None };
    assert_eq!(*bodies[0], entered(JobState::Queued));
    assert_eq!(*bodies[1], entered(JobState::Running));
    assert!(matches!(bodies[bodies.len() - 2], EventBody::Summary(summary) if summary.iterations == 1), "{bodies:?}");
    assert_eq!(**bodies.last().expect("events"), entered(JobState::Succeeded));
    let ended = test.engine.job(&job.name).await.expect("exists");
    assert_eq!((ended.state, ended.attempt), (JobState::Succeeded, 1));
    assert_eq!(ended.last_sequence, events.len() as u64);
    assert_eq!(ended.progress.map(|progress| progress.iteration), Some(1), "stored, however short the job");
    assert_eq!(call_of(&test.engine, &job.name).await, 1);
}

#[tokio::test]
async fn a_defect_fails_its_job_and_the_worker_goes_on() {
    let test = TestEngine::start(workers(1)).await;
    for (behavior, message) in
        [(Behavior::Fail, "told to fail"), (Behavior::Panic, "the solver panicked: told to panic")]
    {
        let name = test.submit(behavior).await;
        let job = test.ended(&name).await;
        let failure = job.failure.as_ref().expect("a reason");
        assert_eq!((job.state, failure.reason.as_str()), (JobState::Failed, "INTERNAL"));
        assert_eq!(failure.message, message);
        assert_eq!(test.engine.result(&job).await, Err(Error::NotReady(JobState::Failed)));
    }
    let name = test.submit(Behavior::Succeed).await;
    assert_eq!(test.ended(&name).await.state, JobState::Succeeded);
}

#[tokio::test]
async fn an_input_that_cannot_be_read_fails_its_job() {
    let test = TestEngine::start(workers(1)).await;
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
    let room = &test.engine.inner.options.queue;
    test.store.create_job(broken, room, SystemTime::now()).await.expect("created");
    // Nobody told the engine: it finds the job by itself.
    let job = test.ended(&name).await;
    assert_eq!(job.state, JobState::Failed);
    assert_eq!(test.solver.calls.load(Ordering::SeqCst), 0);
}

#[tokio::test]
async fn a_cancel_reaches_a_queued_a_running_and_no_ended_job() {
    let test = TestEngine::start(workers(1)).await;
    let running = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let queued = test.submit(Behavior::Wait).await;

    let mut watch = test.engine.watch(&queued, 1).await.expect("exists");
    assert_eq!(test.engine.cancel(&queued, None).await.expect("exists").state, JobState::Cancelled);
    let events = rest(&mut watch).await;
    assert_eq!(events.iter().map(terminal).collect::<Vec<_>>(), [Some(JobState::Cancelled)]);

    let job = test.engine.job(&running).await.expect("exists");
    assert_eq!(test.engine.result(&job).await, Err(Error::NotReady(JobState::Running)));
    let flagged = test.engine.cancel(&running, None).await.expect("exists");
    assert!(flagged.state == JobState::Running && flagged.cancel_requested, "{flagged:?}");
    let job = test.ended(&running).await;
    assert_eq!((job.state, job.cancel_requested), (JobState::Cancelled, false));
    assert_eq!(test.engine.cancel(&running, None).await, Ok(job));
    assert_eq!(test.solver.calls.load(Ordering::SeqCst), 1, "the queued job was never begun");
}

#[tokio::test]
async fn a_cancel_that_another_process_stored_arrives_with_a_heartbeat() {
    let options = Options { lease: Duration::from_millis(300), max_attempts: u32::MAX, ..workers(1) };
    let test = TestEngine::start(options).await;
    let name = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    test.store.request_cancel(&name, None, SystemTime::now()).await.expect("flags");
    assert_eq!(test.ended(&name).await.state, JobState::Cancelled);
}

#[tokio::test]
async fn a_deadline_ends_a_running_and_a_queued_job() {
    let test = TestEngine::start(workers(1)).await;
    let soon = Some(Deadline::After(Duration::from_millis(200)));
    let running = test
        .engine
        .submit(described(JobDescription { deadline: soon, ..behaving(Behavior::Wait) }))
        .await
        .expect("admitted");
    let long_ago = Some(Deadline::At(SystemTime::UNIX_EPOCH));
    let queued = test
        .engine
        .submit(described(JobDescription { deadline: long_ago, ..behaving(Behavior::Wait) }))
        .await
        .expect("admitted");
    for job in [running, queued] {
        let mut watch = test.engine.watch(&job.name, 0).await.expect("exists");
        let events = rest(&mut watch).await;
        assert_eq!(events.last().and_then(terminal), Some(JobState::DeadlineExceeded));
        assert_contiguous(&events, 1);
    }
}

#[tokio::test]
async fn priority_goes_before_age() {
    // What is prefetched while one job is there goes first also where a more important one comes a moment later.
    let test = TestEngine::start(Options { short_job: Duration::ZERO, ..workers(1) }).await;
    let first = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let mut names = vec![first];
    for priority in [0, 7] {
        let new = described(JobDescription { priority, ..behaving(Behavior::Succeed) });
        names.push(test.engine.submit(new).await.expect("admitted").name);
    }
    test.solver.release();
    let mut calls = Vec::new();
    for name in &names {
        test.ended(name).await;
        calls.push(call_of(&test.engine, name).await);
    }
    assert_eq!(calls, [1, 3, 2]);
}
