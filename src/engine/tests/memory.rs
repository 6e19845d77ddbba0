//! Memory of the solver: one budget for all jobs that run at once.

use super::*;
use crate::domain::{Oversize, Quota};
use crate::engine::{Deadline, Drained, Error};

/// What one of these tests' jobs is estimated to take.
fn estimated() -> u64 {
    let input = input();
    let count = |number: usize| u32::try_from(number).expect("a small input");
    let [views, tracks, observations] = [input.view_count(), input.track_count(), input.observation_count()].map(count);
    solver::estimated_bytes(views, tracks, observations)
}

/// Two workers, and memory for one job.
fn scarce() -> Options {
    Options { max_solver_bytes: estimated() * 3 / 2, ..workers(2) }
}

/// Until the store has a job as running, whether it is solved yet or not.
async fn runs(test: &TestEngine, name: &JobName) {
    let running = || async {
        let job = test.engine.job(name).await.expect("exists");
        (job.state == JobState::Running).then_some(())
    };
    eventually(running).await;
}

#[tokio::test]
async fn a_job_that_takes_more_alone_is_refused() {
    let max = estimated() - 1;
    let test = TestEngine::start(Options { max_solver_bytes: max, ..workers(1) }).await;
    let oversize = Oversize { quota: Quota::SolverBytes, asked: estimated(), max };
    let refused = test.engine.submit(new_job(Behavior::Succeed)).await;
    assert_eq!(refused, Err(Error::JobTooLarge { index: 0, oversize }));
    let message = refused.expect_err("refused").to_string();
    assert!(message.contains(&estimated().to_string()), "{message}");
    assert!(message.contains(&format!("engine.max_solver_bytes is {max}")), "{message}");
    assert_eq!(test.engine.queue_stats().await.expect("counts").queued, 0);
}

#[tokio::test]
async fn a_repeated_request_gets_its_job_under_a_smaller_bound_too() {
    let test = TestEngine::start(workers(1)).await;
    let request = |id: &str| described(JobDescription { request_id: Some(id.into()), ..behaving(Behavior::Succeed) });
    let first = test.engine.submit(request("first")).await.expect("admitted").name;
    test.ended(&first).await;
    let options = Options { max_solver_bytes: estimated() - 1, ..workers(1) };
    let solver = test.solver.solver_fn();
    let restarted = Engine::start(options, test.store.clone(), solver, encode).await.expect("starts");
    assert_eq!(restarted.submit(request("first")).await.expect("it is there").name, first);
    let batch = restarted.submit_batch(vec![request("first"), request("second")]).await;
    assert!(matches!(batch, Err(Error::JobTooLarge { index: 1, .. })), "{batch:?}");
    assert_eq!(restarted.queue_stats().await.expect("counts").queued, 0);
}

#[tokio::test]
async fn while_a_job_waits_for_memory_no_other_one_is_claimed() {
    let test = TestEngine::start(Options { workers: 3, ..scarce() }).await;
    let first = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let second = test.submit(Behavior::Wait).await;
    // Nobody gets memory once the second waits for it.
    eventually(|| async { test.engine.inner.limits.try_acquire_memory(1).is_none().then_some(()) }).await;
    let third = test.submit(Behavior::Succeed).await;
    // The third worker would claim it at once.
    tokio::time::sleep(Duration::from_millis(100)).await;
    let job = test.engine.job(&third).await.expect("exists");
    assert_eq!((job.state, job.attempt), (JobState::Queued, 0));
    test.engine.cancel(&second, None).await.expect("exists");
    runs(&test, &third).await;
    test.engine.cancel(&first, None).await.expect("exists");
    assert_eq!(test.ended(&third).await.state, JobState::Succeeded);
}

#[tokio::test]
async fn a_job_that_does_not_fit_now_waits_and_heeds_cancel_and_deadline() {
    let test = TestEngine::start(scarce()).await;
    let first = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let cancelled = test.submit(Behavior::Wait).await;
    runs(&test, &cancelled).await;
    test.engine.cancel(&cancelled, None).await.expect("exists");
    assert_eq!(test.ended(&cancelled).await.state, JobState::Cancelled);
    let soon = Some(Deadline::After(Duration::from_millis(300)));
    let due = test
        .engine
        .submit(described(JobDescription { deadline: soon, ..behaving(Behavior::Wait) }))
        .await
        .expect("admitted")
        .name;
    assert_eq!(test.ended(&due).await.state, JobState::DeadlineExceeded);
    let last = test.submit(Behavior::Succeed).await;
    runs(&test, &last).await;
    assert_eq!(test.solver.calls.load(Ordering::SeqCst), 1, "none of them was solved beside the first");
    test.engine.cancel(&first, None).await.expect("exists");
    let job = test.ended(&last).await;
    assert_eq!((job.state, job.attempt), (JobState::Succeeded, 1));
    assert_eq!(call_of(&test.engine, &last).await, 2);
}

#[tokio::test]
async fn a_job_that_waits_for_memory_is_given_back_by_a_drain() {
    let test = TestEngine::start(scarce()).await;
    let first = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let second = test.submit(Behavior::Wait).await;
    runs(&test, &second).await;
    assert_eq!(test.engine.drain(Duration::ZERO).await, Drained { finished: 0, given_back: 2 });
    for name in [&first, &second] {
        assert_eq!(test.engine.job(name).await.expect("exists").state, JobState::Queued);
    }
}

#[tokio::test]
async fn a_drain_gives_a_job_that_waits_for_memory_back_at_once() {
    let test = TestEngine::start(scarce()).await;
    let first = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let second = test.submit(Behavior::Wait).await;
    runs(&test, &second).await;
    let release = async {
        let is_queued = async || test.engine.job(&second).await.expect("exists").state == JobState::Queued;
        eventually(|| async { is_queued().await.then_some(()) }).await;
        test.engine.cancel(&first, None).await.expect("exists");
    };
    let (drained, ()) = tokio::join!(test.engine.drain(Duration::from_secs(600)), release);
    assert_eq!(drained, Drained { finished: 1, given_back: 1 });
}

#[tokio::test]
async fn short_jobs_that_would_be_prefetched_are_all_solved_one_after_the_other() {
    let test = TestEngine::start(Options { short_job: Duration::from_secs(3_600), ..scarce() }).await;
    let jobs = (0..12).map(|_| new_job(Behavior::Succeed)).collect();
    for job in test.engine.submit_batch(jobs).await.expect("admitted") {
        let job = test.ended(&job.name).await;
        assert_eq!((job.state, job.attempt), (JobState::Succeeded, 1));
    }
}
