//! What outlives a drain, a crash and a lost lease.

use std::time::{Duration, SystemTime};

use tokio::runtime::Runtime;

use super::*;
use crate::engine::{Drained, Error, Phase, StoreError, StoreState, locked};
use crate::store::Claim;

#[tokio::test]
async fn a_drain_lets_what_runs_finish_and_leaves_what_waits() {
    let test = TestEngine::start(workers(1)).await;
    let running = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let queued = test.submit(Behavior::Wait).await;
    let engine = test.engine.clone();
    let drain = tokio::spawn(async move { engine.drain(Duration::from_secs(120)).await });
    eventually(|| async { (test.engine.inner.phase() != Phase::Open).then_some(()) }).await;
    assert_eq!(test.engine.submit(new_job(Behavior::Wait)).await, Err(Error::Draining));
    test.solver.release();
    assert_eq!(drain.await.expect("no panic"), Drained { finished: 1, given_back: 0 });
    assert_eq!(test.engine.job(&running).await.expect("exists").state, JobState::Succeeded);
    assert_eq!(test.engine.job(&queued).await.expect("exists").state, JobState::Queued);
    assert_eq!(test.engine.drain(Duration::ZERO).await, Drained::default(), "once is enough");
}

#[tokio::test]
async fn interrupt_running_ends_the_wait_of_a_drain() {
    for before in [true, false] {
        let test = TestEngine::start(workers(1)).await;
        let name = test.submit(Behavior::Wait).await;
        test.solver.until_waiting(1).await;
        if before {
            test.engine.interrupt_running();
        }
        let engine = test.engine.clone();
        let drain = tokio::spawn(async move { engine.drain(Duration::from_secs(3600)).await });
        eventually(|| async { (test.engine.inner.phase() != Phase::Open).then_some(()) }).await;
        if !before {
            test.engine.interrupt_running();
        }
        let drained = tokio::time::timeout(Duration::from_secs(120), drain).await.expect("an end").expect("no panic");
        assert_eq!(drained, Drained { finished: 0, given_back: 1 }, "before: {before}");
        assert_eq!(test.engine.job(&name).await.expect("exists").state, JobState::Queued);
    }
    let idle = TestEngine::start(workers(1)).await;
    idle.engine.interrupt_running();
    assert_eq!(idle.engine.drain(Duration::from_secs(3600)).await, Drained::default(), "nothing runs");
}

#[tokio::test]
async fn those_who_follow_the_store_hear_of_changes_alone() {
    let test = TestEngine::start(workers(1)).await;
    let mut states = test.engine.store_state();
    let look = async || {
        for _ in 0..3 {
            test.engine.inner.sweep().await;
        }
    };
    assert_eq!(*states.borrow_and_update(), StoreState::Healthy);
    look().await;
    assert!(!states.has_changed().expect("an engine"), "nothing happened");

    // As on a full disk: a write finds no room, and where the reserve is made is none.
    let in_the_way = test.directory.path().join("scpsfm.reserve.new");
    std::fs::create_dir(&in_the_way).expect("a folder");
    test.store.find_no_room().await;
    assert!(matches!(test.engine.submit(new_job(Behavior::Succeed)).await, Err(Error::Store(StoreError::NoSpace(_)))));
    look().await;
    assert_eq!(*states.borrow_and_update(), StoreState::Full);
    look().await;
    assert!(!states.has_changed().expect("an engine"), "it is as full as before");

    std::fs::remove_dir(&in_the_way).expect("removed");
    let room = states.wait_for(|state| *state == StoreState::Healthy);
    tokio::time::timeout(Duration::from_secs(120), room).await.expect("room within two minutes").expect("an engine");
    // The next connection knows nothing of the limit.
    test.store.execute("PRAGMA max_page_count = 1073741823").await;
    let name = test.submit(Behavior::Succeed).await;
    assert_eq!(test.ended(&name).await.state, JobState::Succeeded);
}

#[tokio::test]
async fn what_is_claimed_while_a_drain_gives_back_goes_back_too() {
    // The claim is on its way to the store when the drain looks for what runs: after one of these turns, or some.
    for turns in 0..8 {
        let test = TestEngine::start(workers(1)).await;
        let name = test.submit(Behavior::Wait).await;
        for _ in 0..turns {
            tokio::task::yield_now().await;
        }
        test.engine.drain(Duration::ZERO).await;
        let job = test.engine.job(&name).await.expect("the job");
        assert_eq!(job.state, JobState::Queued, "after {turns} turns");
    }
}

#[tokio::test]
async fn a_drain_gives_back_what_does_not_finish_and_the_next_engine_takes_it_up() {
    let test = TestEngine::start(workers(2)).await;
    let names =
        [test.submit(Behavior::Wait).await, test.submit(Behavior::Wait).await, test.submit(Behavior::Wait).await];
    test.solver.until_waiting(2).await;
    let mut watch = test.engine.watch(&names[0], 0).await.expect("exists");
    assert_eq!(test.engine.drain(Duration::ZERO).await, Drained { finished: 0, given_back: 2 });
    let mut seen = Vec::new();
    let end = loop {
        match watch.next().await.expect("an event or an error") {
            Ok(event) => seen.push(event),
            Err(error) => break error,
        }
    };
    assert_eq!(end, Error::Draining);
    assert!(watch.next().await.is_none());
    let TestEngine { engine, store, solver, directory } = test;
    for name in &names {
        assert_eq!(engine.job(name).await.expect("exists").state, JobState::Queued);
    }
    drop((engine, store, watch));

    solver.release();
    let (engine, _store) = start(workers(1), &directory, &solver).await;
    for name in &names {
        assert_eq!(ended(&engine, name).await.state, JobState::Succeeded);
    }
    let after = seen.last().and_then(|event| event.sequence).expect("numbered");
    let mut watch = engine.watch(&names[0], after).await.expect("exists");
    seen.extend(rest(&mut watch).await);
    assert_contiguous(&seen, 1);
    assert_eq!(seen.iter().filter_map(terminal).collect::<Vec<_>>(), [JobState::Succeeded]);
    assert_eq!(engine.job(&names[0]).await.expect("exists").attempt, 2);
}

/// An engine and its runtime in one, to be torn down without a word.
#[test]
fn after_a_crash_every_job_is_finished_exactly_once() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let solver = Arc::new(FakeSolver::default());
    let first = Runtime::new().expect("a runtime");
    let (running, queued, mut seen) = first.block_on(async {
        let (engine, _) = start(workers(1), &directory, &solver).await;
        let running = engine.submit(new_job(Behavior::Wait)).await.expect("admitted").name;
        let mut watch = engine.watch(&running, 0).await.expect("exists");
        let mut seen = Vec::new();
        while !seen.iter().any(|event: &JobEvent| matches!(event.body, EventBody::Progress(_))) {
            seen.push(watch.next().await.expect("an event").expect("no error"));
        }
        let queued = engine.submit(new_job(Behavior::Succeed)).await.expect("admitted").name;
        (running, queued, seen)
    });
    first.shutdown_background();

    let second = Runtime::new().expect("a runtime");
    second.block_on(async {
        let (engine, _) = start(workers(1), &directory, &solver).await;
        solver.release();
        for name in [&running, &queued] {
            assert_eq!(ended(&engine, name).await.state, JobState::Succeeded);
        }
        assert_eq!(engine.job(&running).await.expect("exists").attempt, 2);
        let after = seen.last().and_then(|event| event.sequence).expect("numbered");
        seen.extend(rest(&mut engine.watch(&running, after).await.expect("exists")).await);
        assert_contiguous(&seen, 1);
        assert_eq!(seen.iter().filter_map(terminal).collect::<Vec<_>>(), [JobState::Succeeded]);
        let attempts: Vec<u32> = seen.iter().map(|event| event.attempt).collect();
        assert!(attempts.is_sorted() && attempts.ends_with(&[2]), "{attempts:?}");
    });
}

#[test]
fn a_job_that_takes_its_process_down_each_time_fails() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let solver = Arc::new(FakeSolver::default());
    let options = Options { max_attempts: 2, ..workers(1) };
    let mut name = None;
    for life in 1..=2 {
        let runtime = Runtime::new().expect("a runtime");
        runtime.block_on(async {
            let (engine, _) = start(options.clone(), &directory, &solver).await;
            if name.is_none() {
                name = Some(engine.submit(new_job(Behavior::Wait)).await.expect("admitted").name);
            }
            solver.until_waiting(life).await;
        });
        runtime.shutdown_background();
    }
    Runtime::new().expect("a runtime").block_on(async {
        let (engine, _) = start(options, &directory, &solver).await;
        let job = engine.job(&name.expect("submitted")).await.expect("exists");
        assert_eq!((job.state, job.attempt), (JobState::Failed, 2));
        assert_eq!(job.failure.expect("a reason").reason, "ATTEMPTS_EXHAUSTED");
    });
}

#[test]
fn a_job_that_takes_its_process_down_each_time_fails_and_its_neighbour_does_not() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let solver = Arc::new(FakeSolver::default());
    let mut names = Vec::new();
    // Both begin twice. The third time the older one begins alone: with a second worker either might.
    for (count, begun) in [(2, 2), (2, 4), (1, 5)] {
        let runtime = Runtime::new().expect("a runtime");
        runtime.block_on(async {
            let (engine, _) = start(workers(count), &directory, &solver).await;
            if names.is_empty() {
                for _ in 0..2 {
                    names.push(engine.submit(new_job(Behavior::Wait)).await.expect("admitted").name);
                }
            }
            solver.until_waiting(begun).await;
        });
        runtime.shutdown_background();
    }
    Runtime::new().expect("a runtime").block_on(async {
        let (engine, _) = start(workers(2), &directory, &solver).await;
        let poison = engine.job(&names[0]).await.expect("exists");
        assert_eq!((poison.state, poison.attempt), (JobState::Failed, 3));
        solver.release();
        let neighbour = ended(&engine, &names[1]).await;
        assert_eq!((neighbour.state, neighbour.attempt), (JobState::Succeeded, 3));
    });
}

#[tokio::test]
async fn a_job_that_lost_attempts_waits_until_it_is_alone_and_others_wait_for_it() {
    let test = TestEngine::start(workers(2)).await;
    let running = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    test.engine.set_paused(true).await.expect("pauses");
    let suspect = described(JobDescription { priority: 9, ..behaving(Behavior::Wait) });
    let suspect = test.engine.submit(suspect).await.expect("admitted").name;
    test.store.execute("UPDATE jobs SET lost_attempts = 2 WHERE priority = 9").await;
    let other = test.submit(Behavior::Succeed).await;
    test.engine.set_paused(false).await.expect("resumes");
    // Nobody gets a permit once the suspect waits for all of them.
    eventually(|| async { test.engine.inner.limits.try_acquire().is_none().then_some(()) }).await;
    for name in [&suspect, &other] {
        let job = test.engine.job(name).await.expect("exists");
        assert_eq!((job.state, job.attempt), (JobState::Queued, 0), "no attempt waits");
    }

    test.engine.cancel(&running, None).await.expect("exists");
    test.solver.until_waiting(2).await;
    assert_eq!(test.engine.job(&suspect).await.expect("exists").state, JobState::Running);
    assert_eq!(test.engine.job(&other).await.expect("exists").state, JobState::Queued);
    assert_eq!(locked(&test.engine.inner.running).len(), 1);
    test.solver.release();
    for (name, call) in [(&suspect, 2), (&other, 3)] {
        assert_eq!(test.ended(name).await.state, JobState::Succeeded);
        assert_eq!(call_of(&test.engine, name).await, call);
    }
}

#[tokio::test]
async fn a_suspect_that_waits_is_cancelled_and_left_by_a_drain_as_any_job_that_waits() {
    for drains in [false, true] {
        // Its lease is renewed after a third of that, which is when a cancel is noticed.
        let test = TestEngine::start(Options { lease: Duration::from_secs(3), ..workers(2) }).await;
        let running = test.submit(Behavior::Wait).await;
        test.solver.until_waiting(1).await;
        test.engine.set_paused(true).await.expect("pauses");
        let suspect = described(JobDescription { priority: 9, ..behaving(Behavior::Wait) });
        let suspect = test.engine.submit(suspect).await.expect("admitted").name;
        test.store.execute("UPDATE jobs SET lost_attempts = 2 WHERE priority = 9").await;
        test.engine.set_paused(false).await.expect("resumes");
        eventually(|| async { test.engine.inner.limits.try_acquire().is_none().then_some(()) }).await;
        if drains {
            test.engine.drain(Duration::ZERO).await;
            let job = test.engine.job(&suspect).await.expect("exists");
            assert_eq!((job.state, job.attempt), (JobState::Queued, 0));
            let claim = Claim::one("another", Duration::from_secs(3_600));
            let begun = test.store.claim(&claim, SystemTime::now()).await.expect("claims").begun;
            assert_eq!(begun.expect("a job").job.name, suspect, "it was given back");
        } else {
            test.engine.cancel(&suspect, None).await.expect("exists");
            let other = test.submit(Behavior::Succeed).await;
            assert_eq!(test.ended(&other).await.state, JobState::Succeeded, "beside the one that runs");
            assert_eq!(test.ended(&suspect).await.attempt, 0);
            assert_eq!(test.engine.job(&running).await.expect("exists").state, JobState::Running);
        }
    }
}

#[tokio::test]
async fn of_several_suspects_a_server_keeps_one_and_leaves_the_others_to_other_servers() {
    let test = TestEngine::start(Options { lease: Duration::from_secs(3_600), ..workers(3) }).await;
    test.engine.set_paused(true).await.expect("pauses");
    for _ in 0..3 {
        test.submit(Behavior::Wait).await;
    }
    test.store.execute("UPDATE jobs SET lost_attempts = 2").await;
    test.engine.set_paused(false).await.expect("resumes");
    test.solver.until_waiting(1).await;
    let claim = Claim { suspect_after: Some(2), ..Claim::one("another", Duration::from_secs(3_600)) };
    for _ in 0..2 {
        eventually(|| async { test.store.claim(&claim, SystemTime::now()).await.expect("claims").suspect }).await;
    }
    let tenants = test.store.stats().await.expect("counts").tenants;
    assert_eq!(tenants.iter().map(|of| of.running).sum::<u64>(), 1);
}

#[tokio::test]
async fn a_suspect_is_kept_while_the_store_fails_and_begun_once() {
    // Long enough that the store is back before the lease runs out.
    let test = TestEngine::start(Options { lease: Duration::from_secs(600), ..workers(1) }).await;
    test.engine.set_paused(true).await.expect("pauses");
    let suspect = test.submit(Behavior::Succeed).await;
    test.store.execute("UPDATE jobs SET lost_attempts = 2").await;
    let broken = "CREATE TRIGGER broken BEFORE UPDATE OF state ON jobs WHEN new.state = 'RUNNING' \
                  BEGIN SELECT RAISE(ABORT, 'broken'); END";
    test.store.execute(broken).await;
    test.engine.set_paused(false).await.expect("resumes");
    // Its begin fails, again and again.
    eventually(|| async { test.engine.inner.limits.try_acquire().is_none().then_some(()) }).await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    let claim = Claim { suspect_after: Some(2), ..Claim::one("another", Duration::from_secs(3_600)) };
    assert_eq!(test.store.claim(&claim, SystemTime::now()).await.expect("claims").suspect, None, "it is kept");
    test.store.execute("DROP TRIGGER broken").await;
    let job = test.ended(&suspect).await;
    assert_eq!((job.state, job.attempt), (JobState::Succeeded, 1));
}

#[tokio::test]
async fn a_worker_whose_lease_was_taken_over_changes_nothing() {
    // Heartbeats far apart: the first worker learns of its loss only when it wants to write its result.
    let options = Options { lease: Duration::from_secs(3000), ..workers(2) };
    let test = TestEngine::start(options).await;
    let name = test.submit(Behavior::Deaf).await;
    test.solver.until_waiting(1).await;
    let much_later = SystemTime::now() + Duration::from_secs(4000);
    let lost = test.store.sweep(much_later, 3).await.expect("sweeps").lost;
    assert_eq!(lost.len(), 1);
    // The second worker finds the job by itself; both wait now, and end in any order.
    test.solver.until_waiting(2).await;
    test.solver.release();
    let job = test.ended(&name).await;
    assert_eq!((job.state, job.attempt), (JobState::Succeeded, 2));
    assert_eq!(call_of(&test.engine, &name).await, 2, "the second call's");
    test.engine.drain(Duration::from_secs(120)).await;
    assert_eq!(test.engine.job(&name).await, Ok(job), "also after the first worker has ended");
    let events = test.store.events_after(&name, 0, 100).await.expect("events");
    assert_contiguous(&events, 1);
    assert_eq!(events.iter().filter_map(terminal).count(), 1);
}

#[tokio::test]
async fn a_lost_lease_stops_the_work() {
    let options = Options { lease: Duration::from_millis(300), max_attempts: u32::MAX, ..workers(1) };
    let test = TestEngine::start(options).await;
    let name = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let much_later = SystemTime::now() + Duration::from_secs(60);
    test.store.sweep(much_later, u32::MAX).await.expect("sweeps");
    // The one worker can only take the job up again after the first attempt has stopped.
    test.solver.until_waiting(2).await;
    test.solver.release();
    assert_eq!(test.ended(&name).await.state, JobState::Succeeded);
}

/// Statements after which no job can change its state, or none can be written at all, as with a full disk.
const NO_ENDS: &str = "CREATE TRIGGER broken BEFORE UPDATE OF state ON jobs BEGIN SELECT RAISE(ABORT, 'broken'); END";
const NO_WRITES: &str = "CREATE TRIGGER broken BEFORE UPDATE ON jobs BEGIN SELECT RAISE(ABORT, 'broken'); END; \
    CREATE TRIGGER broken_too BEFORE INSERT ON jobs BEGIN SELECT RAISE(ABORT, 'broken'); END";
const MENDED: &str = "DROP TRIGGER broken; DROP TRIGGER IF EXISTS broken_too";

#[tokio::test]
async fn a_result_waits_for_a_store_that_comes_back_in_time() {
    let test = TestEngine::start(workers(1)).await;
    let name = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    test.store.execute(NO_ENDS).await;
    test.solver.release();
    // Long enough to try in vain; were it not, the test would only show less.
    tokio::time::sleep(Duration::from_millis(50)).await;
    assert_eq!(test.engine.job(&name).await.expect("reads work").state, JobState::Running);
    test.store.execute(MENDED).await;
    let job = test.ended(&name).await;
    assert_eq!((job.state, job.attempt), (JobState::Succeeded, 1));
    assert_eq!(test.solver.calls.load(Ordering::SeqCst), 1);
}

#[tokio::test]
async fn without_a_store_for_a_lease_the_work_stops_and_later_goes_on_by_itself() {
    let options = Options { lease: Duration::from_millis(300), max_attempts: u32::MAX, ..workers(1) };
    let test = TestEngine::start(options).await;
    let name = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    test.store.execute(NO_WRITES).await;
    eventually(|| async { locked(&test.engine.inner.running).is_empty().then_some(()) }).await;
    assert_eq!(test.engine.job(&name).await.expect("reads work").state, JobState::Running, "as far as is known");
    assert!(matches!(test.engine.submit(new_job(Behavior::Wait)).await, Err(Error::Store(StoreError::Unavailable(_)))));
    test.store.execute(MENDED).await;
    test.solver.release();
    let job = test.ended(&name).await;
    assert_eq!(job.state, JobState::Succeeded);
    assert!(job.attempt > 1, "{}", job.attempt);
    assert_contiguous(&rest(&mut test.engine.watch(&name, 0).await.expect("exists")).await, 1);
}

#[tokio::test]
async fn a_cancel_reaches_the_attempt_that_holds_the_lease_though_another_still_runs() {
    let test = TestEngine::start(Options { lease: Duration::from_secs(3000), ..workers(2) }).await;
    let name = test.submit(Behavior::Deaf).await;
    test.solver.until_waiting(1).await;
    test.store.sweep(SystemTime::now() + Duration::from_secs(4000), 3).await.expect("sweeps");
    test.solver.until_waiting(2).await;
    test.engine.cancel(&name, None).await.expect("exists");
    let tokens: Vec<_> = locked(&test.engine.inner.running).values().map(|listed| listed.stop.is_stopped()).collect();
    assert_eq!(tokens, [true, true]);
    test.solver.release();
    test.ended(&name).await;
}
