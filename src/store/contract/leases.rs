//! Leases: who may write, and where a job goes that ends, is given back or is lost.

use super::*;
use crate::store::Load;

pub(in crate::store) async fn claims_go_by_priority_then_age(store: &dyn Store) {
    for (job, priority, seconds) in [("old", 0, 0), ("new", 0, 2), ("same", 0, 2), ("low", -1, 0), ("high", 5, 9)] {
        create(store, NewRecord { priority, ..record(job) }, seconds).await;
    }
    for (expected, seconds) in ["high", "old", "new", "same", "low"].into_iter().zip(10..) {
        let claimed = claim(store, seconds).await;
        assert_eq!(claimed.job.name.job, expected);
        assert_eq!((claimed.job.state, claimed.job.attempt), (JobState::Running, 1));
        assert_eq!(claimed.job.start_time, Some(time(seconds)));
        assert_eq!(claimed.lease, Lease { name: claimed.job.name.clone(), attempt: 1 });
        assert_eq!(store.job(&claimed.job.name).await, Ok(claimed.job.clone()));
        assert_eq!(story(store, &claimed.job.name).await, told(&[(1, 0, "QUEUED"), (2, 1, "RUNNING")]));
    }
    assert_eq!(store.claim("worker", time(20), LEASE).await, Ok(None));
}

pub(in crate::store) async fn no_job_is_claimed_twice(store: &dyn Store) {
    for number in 0..30 {
        create(store, record(&format!("job-{number}")), 0).await;
    }
    let claims = futures_util::future::join_all((0..40).map(|_| store.claim("worker", time(1), LEASE))).await;
    let mut names: Vec<_> =
        claims.into_iter().filter_map(|claim| claim.expect("claims")).map(|claimed| claimed.job.name).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), 30);
}

pub(in crate::store) async fn a_foreseen_job_is_leased_unless_it_has_moved(store: &dyn Store) {
    assert_eq!(store.foresee(&[], time(1)).await, Ok(None));
    for (job, priority) in [("second", 0), ("first", 1), ("third", 0)] {
        create(store, NewRecord { priority, ..record(job) }, 0).await;
    }
    create(store, NewRecord { deadline: Some(time(2)), priority: 9, ..record("late") }, 0).await;
    let foreseen = store.foresee(&[], time(3)).await.expect("looks").expect("a job");
    assert_eq!(foreseen.lease, Lease { name: record("first").name, attempt: 1 });
    assert_eq!((foreseen.job.attempt, foreseen.queue_time, foreseen.job.create_time), (1, time(0), time(0)));
    let next = store.foresee(std::slice::from_ref(&foreseen.lease.name), time(3)).await.expect("looks");
    let second = next.expect("another").lease;
    assert_eq!(second.name, record("second").name);
    assert_eq!(story(store, &second.name).await, told(&[(1, 0, "QUEUED")]), "a look changes nothing");

    let claimed = store.claim_foreseen(&foreseen.lease, time(0), "worker", time(4), LEASE).await.expect("claims");
    let claimed = claimed.expect("is still there");
    assert_eq!((claimed.job.state, claimed.job.start_time), (JobState::Running, Some(time(4))));
    assert_eq!(claimed.lease, foreseen.lease);
    assert_eq!(store.job(&claimed.job.name).await, Ok(claimed.job.clone()));
    assert_eq!(story(store, &claimed.job.name).await, told(&[(1, 0, "QUEUED"), (2, 1, "RUNNING")]));

    let again = async |lease: &Lease| store.claim_foreseen(lease, time(0), "other", time(5), LEASE).await;
    assert_eq!(again(&foreseen.lease).await, Ok(None), "it runs");
    store.release(&foreseen.lease, time(5)).await.expect("holds");
    assert_eq!(again(&foreseen.lease).await, Ok(None), "that attempt is over");
    let late = Lease { name: record("late").name, attempt: 1 };
    assert_eq!(again(&late).await, Ok(None), "past its deadline");
    store.request_cancel(&second.name, None, time(5)).await.expect("ends");
    assert_eq!(again(&second).await, Ok(None), "it has ended");
    assert_eq!(again(&Lease { name: record("none").name, attempt: 1 }).await, Ok(None));
    store.delete_job(&second.name, None).await.expect("has ended");
    create(store, record("second"), 6).await;
    assert_eq!(again(&second).await, Ok(None), "it is another one of that name");
    let both = futures_util::future::join_all((0..2).map(|_| {
        let third = Lease { name: record("third").name, attempt: 1 };
        async move { store.claim_foreseen(&third, time(0), "worker", time(6), LEASE).await.expect("claims") }
    }));
    assert_eq!(both.await.into_iter().flatten().count(), 1);
}

pub(in crate::store) async fn a_lease_that_was_taken_over_writes_nothing(store: &dyn Store) {
    let name = create(store, record("a"), 0).await.name;
    let old = claim(store, 0).await.lease;
    store.record(&old, &progress(1), time(1)).await.expect("holds");
    let swept = store.sweep(time(29), MAX_ATTEMPTS).await.expect("sweeps");
    assert_eq!((swept.lost.len(), swept.expired.len()), (0, 0), "not yet due");
    store.heartbeat(&old, time(29), LEASE).await.expect("holds");
    assert!(store.sweep(time(58), MAX_ATTEMPTS).await.expect("sweeps").lost.is_empty(), "the heartbeat extended it");
    let swept = store.sweep(time(59), MAX_ATTEMPTS).await.expect("sweeps");
    assert_eq!(swept.lost.iter().map(|job| job.state).collect::<Vec<_>>(), [JobState::Queued]);

    let fenced = Error::Fenced(old.clone());
    for taken in [false, true] {
        if taken {
            let new = claim(store, 60).await;
            assert_eq!(new.lease.attempt, 2);
            assert_eq!(new.job.start_time, Some(time(0)), "the first attempt's");
            assert_eq!(new.queue_time, time(59));
        }
        let before = (store.job(&name).await.expect("job"), story(store, &name).await);
        assert_eq!(store.heartbeat(&old, time(61), LEASE).await, Err(fenced.clone()));
        assert_eq!(store.record(&old, &progress(2), time(61)).await, Err(fenced.clone()));
        assert_eq!(store.finish(&old, &success(vec![1]), time(61)).await, Err(fenced.clone()));
        assert_eq!(store.release(&old, time(61)).await, Err(fenced.clone()));
        assert_eq!((store.job(&name).await.expect("job"), story(store, &name).await), before);
        assert_eq!(result_of(store, &name).await, Ok(None));
    }
    let new = Lease { name: name.clone(), attempt: 2 };
    store.finish(&new, &success(vec![2]), time(62)).await.expect("the new lease holds");
    assert_eq!(result_of(store, &name).await, Ok(Some(vec![2])));
    assert_eq!(store.finish(&new, &success(vec![3]), time(63)).await, Err(Error::Fenced(new)), "ended once");
    let expected = [
        (1, 0, "QUEUED"),
        (2, 1, "RUNNING"),
        (3, 1, "progress 1"),
        (4, 1, "QUEUED"),
        (5, 2, "RUNNING"),
        (6, 2, "summary"),
        (7, 2, "SUCCEEDED"),
    ];
    assert_eq!(story(store, &name).await, told(&expected));
}

pub(in crate::store) async fn a_success_stores_its_result_then_its_state(store: &dyn Store) {
    let name = create(store, record("a"), 0).await.name;
    let lease = claim(store, 1).await.lease;
    let result: Vec<u8> = (0..3 * payload::CHUNK_BYTES).map(|k| (k % 253) as u8).collect();
    let last = progress(400);
    let outcome = success(result.clone()).outcome.clone();
    let ending = Arc::new(Ending { progress: Some(last), outcome });
    let job = store.finish(&lease, &ending, time(2)).await.expect("finishes");
    assert_eq!((job.state, job.end_time), (JobState::Succeeded, Some(time(2))));
    assert_eq!((job.summary.clone(), job.progress), (Some(summary()), Some(last)));
    assert_eq!(store.job(&name).await, Ok(job));
    assert_eq!(result_of(store, &name).await, Ok(Some(result)));
    let expected = [(1, 0, "QUEUED"), (2, 1, "RUNNING"), (3, 1, "summary"), (4, 1, "SUCCEEDED")];
    assert_eq!(story(store, &name).await, told(&expected));
}

pub(in crate::store) async fn progress_is_an_event_and_stands_in_the_job(store: &dyn Store) {
    let name = create(store, record("a"), 0).await.name;
    let lease = claim(store, 1).await.lease;
    assert_eq!(store.record(&lease, &progress(50), time(2)).await, Ok(3));
    assert_eq!(store.record(&lease, &progress(90), time(3)).await, Ok(4));
    let job = store.job(&name).await.expect("job");
    assert_eq!((job.progress, job.last_sequence), (Some(progress(90)), 4));
    let events = store.events_after(&name, 2, 10).await.expect("events");
    assert_eq!(events[0].body, EventBody::Progress(progress(50)));
    assert_eq!(events[1].time, time(3));
    store.release(&lease, time(4)).await.expect("gives back");
    let again = claim(store, 5).await;
    assert_eq!(again.job.progress, None, "a new attempt begins anew");
}

pub(in crate::store) async fn every_outcome_ends_in_its_state(store: &dyn Store) {
    let failure = Failure::new("INTERNAL", "a defect");
    let outcomes = [
        (Outcome::Failed(failure.clone()), JobState::Failed, "FAILED:INTERNAL"),
        (Outcome::Cancelled, JobState::Cancelled, "CANCELLED"),
        (Outcome::DeadlineExceeded, JobState::DeadlineExceeded, "DEADLINE_EXCEEDED"),
    ];
    for (outcome, state, event) in outcomes {
        let name = create(store, record(&state.name().to_lowercase()), 0).await.name;
        let lease = claim(store, 1).await.lease;
        assert_eq!(lease.name, name);
        let job = store.finish(&lease, &Ending { outcome, progress: None }.into(), time(2)).await.expect("finishes");
        assert_eq!((job.state, job.end_time), (state, Some(time(2))));
        assert_eq!(job.failure, (state == JobState::Failed).then(|| failure.clone()));
        assert_eq!(story(store, &name).await, told(&[(1, 0, "QUEUED"), (2, 1, "RUNNING"), (3, 1, event)]));
    }
    assert_eq!(store.load().await, Ok(Load::default()));
}

pub(in crate::store) async fn giving_back_is_free_and_vanishing_is_not(store: &dyn Store) {
    let name = create(store, record("a"), 0).await.name;
    for attempt in 1..=5 {
        let lease = claim(store, 1).await.lease;
        assert_eq!(lease.attempt, attempt);
        assert_eq!(store.release(&lease, time(1)).await.expect("gives back").state, JobState::Queued);
    }
    for lost in 1..=MAX_ATTEMPTS {
        claim(store, 2).await;
        let recovered = store.sweep(time(100), MAX_ATTEMPTS).await.expect("sweeps").lost;
        assert_eq!(recovered.len(), 1);
        assert_eq!(recovered[0].state.is_terminal(), lost == MAX_ATTEMPTS, "{lost}");
    }
    let job = store.job(&name).await.expect("job");
    assert_eq!((job.state, job.attempt), (JobState::Failed, 8));
    let failure = job.failure.expect("a reason");
    assert_eq!(failure.reason, ATTEMPTS_EXHAUSTED);
    let past = |attempt, start, end_time, end| PastAttempt {
        attempt,
        worker: "worker".into(),
        start_time: time(start),
        end_time: time(end_time),
        end,
    };
    let given_back = (1..=5).map(|attempt| past(attempt, 1, 1, AttemptEnd::GivenBack));
    let lost = (6..=8).map(|attempt| past(attempt, 2, 100, AttemptEnd::Lost));
    assert_eq!(failure.attempts, given_back.chain(lost).collect::<Vec<_>>());
    assert!(failure.message.ends_with("6 by worker, 7 by worker, 8 by worker"), "{}", failure.message);
    let last = story(store, &name).await.pop().expect("events");
    assert_eq!(last.2, "FAILED:ATTEMPTS_EXHAUSTED");
    assert_eq!(store.claim("worker", time(101), LEASE).await, Ok(None));
}

pub(in crate::store) async fn a_cancel_ends_what_waits_and_flags_what_runs(store: &dyn Store) {
    let waiting = create(store, record("waiting"), 0).await.name;
    let reply = store.request_cancel(&waiting, None, time(1)).await.expect("cancels");
    assert!(reply.ended_now);
    assert_eq!((reply.job.state, reply.job.end_time), (JobState::Cancelled, Some(time(1))));
    let again = store.request_cancel(&waiting, None, time(2)).await.expect("is idempotent");
    assert_eq!((again.ended_now, again.job), (false, reply.job));
    assert_eq!(story(store, &waiting).await, told(&[(1, 0, "QUEUED"), (2, 0, "CANCELLED")]));

    // Released, its worker vanished, or ended by its worker: a flagged job never runs again.
    for way in ["released", "vanished", "ended"] {
        let name = create(store, record(way), 0).await.name;
        let lease = claim(store, 1).await.lease;
        assert!(!store.heartbeat(&lease, time(1), LEASE).await.expect("holds").cancel_requested);
        let reply = store.request_cancel(&name, None, time(2)).await.expect("flags");
        assert!(!reply.ended_now && reply.job.cancel_requested && reply.job.state == JobState::Running);
        assert!(store.heartbeat(&lease, time(2), LEASE).await.expect("holds").cancel_requested);
        let job = match way {
            "released" => store.release(&lease, time(3)).await.expect("gives back"),
            "vanished" => store.sweep(time(99), MAX_ATTEMPTS).await.expect("sweeps").lost.remove(0),
            _ => {
                let ending = Arc::new(Ending { outcome: Outcome::Cancelled, progress: None });
                store.finish(&lease, &ending, time(3)).await.expect("ends")
            }
        };
        assert_eq!((job.state, job.cancel_requested), (JobState::Cancelled, false), "{way}");
    }
}

pub(in crate::store) async fn deadlines_end_what_waits(store: &dyn Store) {
    let due = create(store, NewRecord { deadline: Some(time(10)), priority: 9, ..record("due") }, 0).await.name;
    let later = create(store, NewRecord { deadline: Some(time(50)), ..record("later") }, 0).await.name;
    let claimed = claim(store, 10).await;
    assert_eq!(claimed.job.name, later, "what is past its deadline is not begun");
    let swept = store.sweep(time(10), MAX_ATTEMPTS).await.expect("sweeps");
    assert_eq!(swept.expired.iter().map(|job| &job.name).collect::<Vec<_>>(), [&due]);
    assert_eq!(swept.expired[0].state, JobState::DeadlineExceeded);
    assert_eq!(story(store, &due).await, told(&[(1, 0, "QUEUED"), (2, 0, "DEADLINE_EXCEEDED")]));
    assert_eq!(store.heartbeat(&claimed.lease, time(11), LEASE).await.expect("holds").deadline, Some(time(50)));
    let lost = store.sweep(time(50), MAX_ATTEMPTS).await.expect("sweeps").lost;
    assert_eq!(lost[0].state, JobState::DeadlineExceeded, "no attempt is made after the deadline");
}
