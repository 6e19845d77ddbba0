//! Jobs that are begun the moment a worker is free: leased and loaded ahead, and queued until then.

use std::pin::pin;
use std::time::SystemTime;

use futures_util::FutureExt;

use super::*;
use crate::engine::{Drained, Phase, locked};
use crate::store::{Claim, Lease};

/// Every job counts as short.
const ALWAYS: Duration = Duration::from_secs(3_600);

/// One worker on a job that runs until it is released, and another job that is in its hands behind it.
async fn prefetched() -> (TestEngine, [JobName; 2]) {
    let test = TestEngine::start(Options { short_job: ALWAYS, ..workers(1) }).await;
    let both = vec![new_job(Behavior::Wait), new_job(Behavior::Succeed)];
    let created = test.engine.submit_batch(both).await.expect("admitted");
    let names = [created[0].name.clone(), created[1].name.clone()];
    handed_over(&test, &names[1]).await;
    (test, names)
}

/// Until the second of two jobs is in the hands of the worker that solves the first one.
async fn handed_over(test: &TestEngine, second: &JobName) {
    eventually(|| async { is_prefetched(test, second).then_some(()) }).await;
    // It is listed before its input is read. What follows an attempt begins with handing it over.
    eventually(|| async { (test.engine.inner.notifier.channel_count() == 2).then_some(()) }).await;
}

/// Until nothing is prefetched or running. A job's end is in the store a little before its attempt is off the list.
async fn nothing_is_left(test: &TestEngine) {
    eventually(|| async { locked(&test.engine.inner.running).is_empty().then_some(()) }).await;
}

/// Whether a job that does not run is in a worker's hands, or on its way there.
fn is_prefetched(test: &TestEngine, name: &JobName) -> bool {
    locked(&test.engine.inner.running).keys().any(|lease| lease.name == *name)
}

/// The states that a job has been in.
async fn states(test: &TestEngine, name: &JobName) -> Vec<JobState> {
    let events = test.store.events_after(name, 0, 100).await.expect("events");
    assert_contiguous(&events, 1);
    let state = |event: &JobEvent| match event.body {
        EventBody::State { state, .. } => Some(state),
        _ => None,
    };
    events.iter().filter_map(state).collect()
}

#[tokio::test]
async fn a_prefetched_job_waits_as_any_other_and_is_solved_next() {
    let (test, names) = prefetched().await;
    let waiting = test.engine.job(&names[1]).await.expect("exists");
    assert_eq!((waiting.state, waiting.attempt, waiting.last_sequence), (JobState::Queued, 0, 1), "nothing is told");
    test.solver.release();
    for name in &names {
        let job = test.ended(name).await;
        assert_eq!((job.state, job.attempt), (JobState::Succeeded, 1));
        assert_eq!(states(&test, name).await, [JobState::Queued, JobState::Running, JobState::Succeeded]);
        assert!(job.start_time >= Some(job.create_time) && job.start_time <= job.end_time);
    }
    assert_eq!(test.solver.calls.load(Ordering::SeqCst), 2);
    nothing_is_left(&test).await;
}

#[tokio::test]
async fn behind_a_job_that_turns_out_long_nothing_is_prefetched_any_more() {
    let test = TestEngine::start(Options { short_job: Duration::from_secs(10), ..workers(1) }).await;
    let both = vec![new_job(Behavior::Wait), new_job(Behavior::Succeed)];
    let created = test.engine.submit_batch(both).await.expect("admitted");
    let next = &created[1].name;
    eventually(|| async { is_prefetched(&test, next).then_some(()) }).await;
    eventually(|| async { (!is_prefetched(&test, next)).then_some(()) }).await;
    assert_eq!(test.engine.job(&created[0].name).await.expect("exists").state, JobState::Running);
    assert_eq!(test.engine.job(next).await.expect("exists").state, JobState::Queued);
    test.solver.release();
    for job in &created {
        assert_eq!(test.ended(&job.name).await.state, JobState::Succeeded);
    }
}

#[tokio::test]
async fn cancelled_before_it_is_begun_it_ends_so_whoever_has_it() {
    let (test, [solved, next]) = prefetched().await;
    assert_eq!(test.engine.cancel(&next, None).await.expect("exists").state, JobState::Cancelled);
    let third = test.submit(Behavior::Succeed).await;
    test.solver.release();
    for name in [&solved, &third] {
        assert_eq!(test.ended(name).await.state, JobState::Succeeded);
    }
    assert_eq!(states(&test, &next).await, [JobState::Queued, JobState::Cancelled]);
    nothing_is_left(&test).await;
}

/// The worker begins it, and solves it, while the claim waits behind the cancel.
#[tokio::test]
async fn cancelled_between_its_begin_and_its_lease_it_leaves_nothing() {
    let (test, [solved, next]) = prefetched().await;
    let (go, held) = test.store.hold().await;
    let mut cancelling = pin!(test.engine.cancel(&next, None));
    assert!((&mut cancelling).now_or_never().is_none());
    // Polled once, its task is in the writer's queue.
    tokio::task::yield_now().await;
    test.solver.release();
    eventually(|| async { (test.solver.calls.load(Ordering::SeqCst) == 2).then_some(()) }).await;
    drop(go);
    held.await.expect("no panic").expect("held");
    assert_eq!(cancelling.await.expect("exists").state, JobState::Cancelled);
    assert_eq!(test.ended(&solved).await.state, JobState::Succeeded);
    let third = test.submit(Behavior::Succeed).await;
    assert_eq!(test.ended(&third).await.state, JobState::Succeeded);
    assert_eq!(states(&test, &next).await, [JobState::Queued, JobState::Cancelled]);
    assert!(test.store.result(&next, u32::MAX).await.expect("answers").is_none());
    nothing_is_left(&test).await;
}

#[tokio::test]
async fn what_was_begun_and_cannot_be_leased_is_stopped_and_solved_later() {
    for _ in 0..20 {
        let test = TestEngine::start(Options { short_job: ALWAYS, ..workers(1) }).await;
        let both = vec![new_job(Behavior::Wait), new_job(Behavior::Wait)];
        let created = test.engine.submit_batch(both).await.expect("admitted");
        let [first, next] = [&created[0].name, &created[1].name];
        handed_over(&test, next).await;
        let no_claims = "CREATE TRIGGER broken BEFORE UPDATE OF state ON jobs WHEN NEW.state = 'RUNNING' \
                         BEGIN SELECT RAISE(ABORT, 'broken'); END";
        test.store.execute(no_claims).await;
        test.engine.cancel(first, None).await.expect("exists");
        // It is until its claim has failed.
        eventually(|| async { (!is_prefetched(&test, next)).then_some(()) }).await;
        if test.solver.waiting.load(Ordering::SeqCst) < 2 {
            // On a busy machine the claim may fail before the solver is called: nothing was begun.
            test.solver.release();
            continue;
        }
        assert_eq!(test.ended(first).await.state, JobState::Cancelled);
        assert_eq!(states(&test, next).await, [JobState::Queued]);
        test.store.execute("DROP TRIGGER broken").await;
        test.solver.release();
        assert_eq!(test.ended(next).await.attempt, 1);
        assert_eq!(states(&test, next).await, [JobState::Queued, JobState::Running, JobState::Succeeded]);
        assert_eq!(test.solver.calls.load(Ordering::SeqCst), 3);
        return;
    }
    panic!("in 20 tries nothing was begun before its claim failed");
}

#[tokio::test]
async fn taken_by_another_process_it_stays_with_that() {
    let (test, [solved, next]) = prefetched().await;
    let (now, lease_for) = (SystemTime::now(), Duration::from_secs(3_600));
    let claims = test.store.claim(&Claim::one("another", lease_for), now).await.expect("claims");
    assert_eq!(claims.begun.expect("a job").job.name, next, "the other process is idle");
    test.solver.release();
    assert_eq!(test.ended(&solved).await.state, JobState::Succeeded);
    let third = test.submit(Behavior::Succeed).await;
    assert_eq!(test.ended(&third).await.state, JobState::Succeeded);
    assert_eq!(states(&test, &next).await, [JobState::Queued, JobState::Running], "nothing was written of it here");
    test.store.heartbeat(&Lease { name: next, attempt: 1 }, now, lease_for).await.expect("still its lease");
}

#[tokio::test]
async fn a_drain_leaves_it_in_the_queue() {
    let (test, [solved, next]) = prefetched().await;
    let engine = test.engine.clone();
    let drain = tokio::spawn(async move { engine.drain(Duration::from_secs(120)).await });
    eventually(|| async { (test.engine.inner.phase() != Phase::Open).then_some(()) }).await;
    test.solver.release();
    assert_eq!(drain.await.expect("no panic"), Drained { finished: 1, given_back: 0 });
    assert_eq!(test.engine.job(&solved).await.expect("exists").state, JobState::Succeeded);
    assert_eq!(states(&test, &next).await, [JobState::Queued]);
    let TestEngine { engine, store, solver, directory } = test;
    drop((engine, store));
    let (engine, _store) = start(workers(1), &directory, &solver).await;
    assert_eq!(ended(&engine, &next).await.attempt, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_an_idle_worker_can_take_waits_for_no_other() {
    let test = TestEngine::start(Options { short_job: ALWAYS, ..workers(2) }).await;
    for round in 1..=20 {
        let both = vec![new_job(Behavior::Wait), new_job(Behavior::Succeed)];
        let created = test.engine.submit_batch(both).await.expect("admitted");
        assert_eq!(test.ended(&created[1].name).await.state, JobState::Succeeded, "round {round}");
        test.engine.cancel(&created[0].name, None).await.expect("exists");
        test.ended(&created[0].name).await;
    }
}
