//! Following jobs: nothing missed, nothing twice, nobody held up.

use std::time::SystemTime;

use futures_util::StreamExt;

use super::*;
use crate::store::Lease;

#[tokio::test]
async fn the_first_progress_is_stored_while_the_job_runs_and_a_flood_is_thinned() {
    let test = TestEngine::start(workers(1)).await;
    let name = test.submit(Behavior::Chatter).await;
    let watch = test.engine.watch(&name, 1).await.expect("exists").into_stream();
    let first: Vec<_> = watch.take(2).map(|event| event.expect("no error").body).collect().await;
    assert!(matches!(first[1], EventBody::Progress(_)), "{first:?}");
    assert_eq!(test.engine.job(&name).await.expect("exists").state, JobState::Running);
    test.solver.until_waiting(1).await;
    test.solver.release();
    let job = test.ended(&name).await;
    assert_eq!(job.progress, Some(progress(1000)), "the last one stands in the job");
    // Two states, the result, the last state; of the thousand records one, and one more for each half second.
    let seconds = job.end_time.expect("ended").duration_since(job.start_time.expect("begun")).expect("in order");
    let most = 5 + 2 * seconds.as_secs() + 2;
    assert!(job.last_sequence <= most, "{} events in {seconds:?}", job.last_sequence);
}

#[tokio::test]
async fn a_slow_watcher_gets_the_latest_weights_only() {
    let test = TestEngine::start(workers(1)).await;
    let blocker = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let name = test.submit(Behavior::Weights).await;
    let mut watch = test.engine.watch(&name, 0).await.expect("exists");
    test.engine.cancel(&blocker, None).await.expect("exists");
    test.solver.until_waiting(2).await;
    let mut late = test.engine.watch(&name, 0).await.expect("exists");
    let mut events = up_to_weights(&mut watch).await;
    up_to_weights(&mut late).await;
    test.solver.release();
    events.extend(rest(&mut watch).await);
    assert_contiguous(&events, 1);
    assert_eq!(events.iter().filter(|event| event.sequence.is_none()).count(), 1, "each is told once");
}

/// The events up to the first interim weights, which must be the last that were told.
async fn up_to_weights(watch: &mut crate::engine::Watch) -> Vec<JobEvent> {
    let mut events = Vec::new();
    loop {
        let event = watch.next().await.expect("an event").expect("no error");
        events.push(event.clone());
        if event.sequence.is_none() {
            assert_eq!(event.body, EventBody::Weights { iteration: 50, weights: vec![50.0; 3] });
            assert_eq!(event.attempt, 1);
            return events;
        }
    }
}

#[tokio::test]
async fn a_watch_of_an_ended_job_replays_and_ends() {
    let test = TestEngine::start(workers(1)).await;
    let name = test.submit(Behavior::Succeed).await;
    let last = test.ended(&name).await.last_sequence;
    for after in 0..=last {
        let mut watch = test.engine.watch(&name, after).await.expect("exists");
        let events = rest(&mut watch).await;
        assert_eq!(events.len() as u64, last - after);
        assert_contiguous(&events, after + 1);
        assert!(watch.next().await.is_none());
    }
}

#[tokio::test]
async fn a_watch_goes_on_after_an_earlier_end_and_ends_with_the_last() {
    let test = TestEngine::start(workers(1)).await;
    let name = test.submit(Behavior::Fail).await;
    let batch = u64::from(crate::engine::watch::READ_AHEAD);
    let mut ends = vec![test.ended(&name).await.last_sequence];
    while ends[ends.len() - 1] < batch + 10 {
        assert_eq!(test.engine.retry(&name, None).await.expect("has failed").state, JobState::Queued);
        ends.push(test.ended(&name).await.last_sequence);
    }
    let last = ends[ends.len() - 1];
    // From the first, and so that each end in turn is the last event that is read at once.
    for after in ends.iter().filter_map(|end| end.checked_sub(batch)).chain([0]) {
        let mut watch = test.engine.watch(&name, after).await.expect("exists");
        let events = rest(&mut watch).await;
        assert_contiguous(&events, after + 1);
        assert_eq!(events.len() as u64, last - after);
    }
    let told = rest(&mut test.engine.watch(&name, 0).await.expect("exists")).await;
    assert_eq!(told.iter().filter(|event| terminal(event).is_some()).count(), ends.len());
    // One that was opened at the last end sees nothing of a retry that comes later.
    let mut ended = test.engine.watch(&name, last).await.expect("exists");
    test.engine.retry(&name, None).await.expect("has failed");
    assert!(ended.next().await.is_none());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn watchers_that_come_and_go_miss_and_repeat_nothing() {
    const EVENTS: u32 = 300;
    let test = TestEngine::start(workers(1)).await;
    let name = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let lease = Lease { name: name.clone(), attempt: 1 };
    let watchers: Vec<_> = (0..16_u64)
        .map(|number| {
            let (engine, name) = (test.engine.clone(), name.clone());
            tokio::spawn(async move {
                // Each hangs up and comes back after another number of events.
                let mut events: Vec<JobEvent> = Vec::new();
                loop {
                    let after = events.last().and_then(|event| event.sequence).unwrap_or(0);
                    let mut watch = engine.watch(&name, after).await.expect("exists");
                    for _ in 0..=number * 7 {
                        match watch.next().await {
                            Some(event) => events.push(event.expect("no error")),
                            None => return events,
                        }
                    }
                }
            })
        })
        .collect();
    for iteration in 0..EVENTS {
        // Through the store and the notifier, as the engine does, only faster.
        test.store.record(&lease, &progress(iteration), SystemTime::now()).await.expect("holds");
        test.engine.inner.notifier.wake(&name);
    }
    test.solver.release();
    let last = test.ended(&name).await.last_sequence;
    assert!(last > u64::from(EVENTS));
    for watcher in futures_util::future::join_all(watchers).await {
        let events = watcher.expect("no panic");
        assert_contiguous(&events, 1);
        assert_eq!(events.len() as u64, last);
        assert_eq!(events.last().and_then(terminal), Some(JobState::Succeeded));
    }
}

#[tokio::test]
async fn a_watcher_that_leaves_is_forgotten_and_cancels_nothing() {
    let test = TestEngine::start(workers(1)).await;
    let name = test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let watches = futures_util::future::join_all((0..10).map(|_| test.engine.watch(&name, 0))).await;
    assert_eq!(test.engine.inner.notifier.channel_count(), 1);
    drop(watches);
    assert_eq!(test.engine.job(&name).await.expect("exists").state, JobState::Running);
    test.solver.release();
    assert_eq!(test.ended(&name).await.state, JobState::Succeeded);
    eventually(|| async { (test.engine.inner.notifier.channel_count() == 0).then_some(()) }).await;
}
