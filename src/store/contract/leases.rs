//! Leases: who may write, and where a job goes that ends, is given back or is lost.

use super::*;
use crate::store::{Claims, Prefetch, QueueStats};

pub(in crate::store) async fn claims_go_by_priority_then_age(store: &Store) {
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
    assert_eq!(store.claim(&Claim::one("worker", LEASE), time(20)).await, Ok(Claims::default()));
}

pub(in crate::store) async fn no_job_is_claimed_twice(store: &Store) {
    for number in 0..30 {
        create(store, record(&format!("job-{number}")), 0).await;
    }
    let claim = Claim::one("worker", LEASE);
    let claims = futures_util::future::join_all((0..40).map(|_| store.claim(&claim, time(1)))).await;
    let mut names: Vec<_> =
        claims.into_iter().filter_map(|claims| claims.expect("claims").begun).map(|claimed| claimed.job.name).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), 30);
}

/// How long a prefetched job is kept for its worker.
const KEPT: Duration = Duration::from_secs(5);

/// Claims the next job, or begins with one that was prefetched, and prefetches the one after it.
async fn prefetching(store: &Store, begin: Option<&Claimed>, seconds: u64) -> Claims {
    let begin = begin.map(|prefetched| (prefetched.lease.clone(), prefetched.job.create_time));
    let prefetch = Some(Prefetch { lease_for: KEPT, max_observations: record("").observation_count });
    // Of a worker among others, to which nothing is a suspect.
    let claim = Claim { begin, prefetch, suspect_after: Some(u32::MAX), ..Claim::one("worker", LEASE) };
    store.claim(&claim, time(seconds)).await.expect("claims")
}

pub(in crate::store) async fn a_prefetched_job_waits_until_it_is_begun(store: &Store) {
    assert_eq!(prefetching(store, None, 0).await, Claims::default());
    for (job, priority) in [("second", 0), ("first", 1), ("third", 0)] {
        create(store, NewRecord { priority, ..record(job) }, 0).await;
    }
    let claims = prefetching(store, None, 1).await;
    let [first, second] = [claims.begun, claims.prefetched].map(|claimed| claimed.expect("a job"));
    assert_eq!((first.lease.name, first.job.state), (record("first").name, JobState::Running));
    assert_eq!(second.lease, Lease { name: record("second").name, attempt: 1 });
    assert_eq!((second.job.state, second.job.attempt, second.queue_time), (JobState::Queued, 0, time(0)));
    assert_eq!(store.job(&second.job.name).await, Ok(second.job.clone()));
    assert_eq!(story(store, &second.job.name).await, told(&[(1, 0, "QUEUED")]), "it is told to nobody");
    let unbegun = Error::Fenced(second.lease.clone());
    assert_eq!(store.heartbeat(&second.lease, time(1), LEASE).await, Err(unbegun.clone()));
    assert_eq!(store.finish(&second.lease, &success(vec![1]), time(1)).await, Err(unbegun));

    let claims = prefetching(store, Some(&second), 2).await;
    let [begun, third] = [claims.begun, claims.prefetched].map(|claimed| claimed.expect("a job"));
    assert_eq!(
        (&begun.lease, begun.job.state, begun.job.start_time),
        (&second.lease, JobState::Running, Some(time(2)))
    );
    assert_eq!(story(store, &second.job.name).await, told(&[(1, 0, "QUEUED"), (2, 1, "RUNNING")]));
    assert_eq!(third.lease.name, record("third").name);
    assert_eq!(prefetching(store, Some(&second), 2).await, Claims::default(), "it runs");
    let swept = store.sweep(time(1 + LEASE.as_secs()), MAX_ATTEMPTS).await.expect("sweeps").lost;
    assert_eq!(swept.len(), 1, "{swept:?}");
    assert_eq!((&*swept[0].name.job, swept[0].attempt), ("first", 1));
    assert_eq!(store.job(&third.job.name).await, Ok(third.job), "no attempt was made");
}

pub(in crate::store) async fn a_prefetched_job_is_begun_by_whoever_comes_first(store: &Store) {
    for job in ["first", "second", "third"] {
        create(store, record(job), 0).await;
    }
    let second = prefetching(store, None, 1).await.prefetched.expect("a job");
    assert_eq!(second.lease.name, record("second").name);
    assert_eq!(claim(store, 1).await.lease.name, record("third").name, "others pass over it");
    assert_eq!(claim(store, 1).await.lease, second.lease, "but for one that finds no other job");
    assert_eq!(prefetching(store, Some(&second), 1).await, Claims::default(), "it is another's");

    // What is kept too long for its worker is in its place in the queue again.
    for job in ["fourth", "fifth", "sixth"] {
        create(store, record(job), 2).await;
    }
    let fifth = prefetching(store, None, 3).await.prefetched.expect("a job");
    assert_eq!(claim(store, 3 + KEPT.as_secs()).await.lease, fifth.lease);
    assert_eq!(prefetching(store, Some(&fifth), 3 + KEPT.as_secs()).await, Claims::default());

    // Ended, and another job of that name: both are none that a worker has.
    let sixth = prefetching(store, None, 20).await.begun.expect("a job");
    assert_eq!(sixth.lease.name, record("sixth").name);
    create(store, record("seventh"), 21).await;
    create(store, record("eighth"), 22).await;
    let eighth = prefetching(store, None, 23).await.prefetched.expect("a job");
    let reply = store.request_cancel(&eighth.job.name, None, time(23)).await.expect("ends");
    assert!(reply.by_this_call, "it is queued");
    assert_eq!(prefetching(store, Some(&eighth), 23).await, Claims::default());
    store.delete_job(&eighth.job.name, None).await.expect("has ended");
    create(store, record("seventh-again"), 24).await;
    create(store, record("eighth"), 24).await;
    let again = prefetching(store, None, 24).await.prefetched.expect("a job");
    assert_eq!(again.lease, eighth.lease);
    assert_eq!(prefetching(store, Some(&eighth), 24).await, Claims::default());
    assert!(prefetching(store, Some(&again), 24).await.begun.is_some());
}

pub(in crate::store) async fn large_jobs_and_late_ones_are_not_prefetched(store: &Store) {
    create(store, record("first"), 0).await;
    let large = NewRecord { observation_count: record("").observation_count + 1, ..record("large") };
    create(store, large, 1).await;
    create(store, record("small"), 2).await;
    assert_eq!(prefetching(store, None, 3).await.prefetched, None, "nor is one prefetched in its place");
    assert_eq!(claim(store, 3).await.job.name.job, "large");
    create(store, NewRecord { deadline: Some(time(4)), priority: 1, ..record("late") }, 3).await;
    create(store, record("last"), 3).await;
    let claims = prefetching(store, None, 4).await;
    assert_eq!(claims.begun.expect("a job").job.name.job, "small");
    let last = claims.prefetched.expect("a job");
    assert_eq!(last.job.name.job, "last");
    let begun = prefetching(store, Some(&last), 4 + KEPT.as_secs()).await.begun;
    assert_eq!(begun.map(|claimed| claimed.lease), Some(last.lease), "kept long, and still there");
}

pub(in crate::store) async fn a_suspect_is_begun_only_where_nothing_else_runs(store: &Store) {
    let busy = Claim { suspect_after: Some(2), ..Claim::one("worker", LEASE) };
    let name = create(store, record("suspect"), 0).await.name;
    for seconds in [100, 200] {
        assert!(store.claim(&busy, time(seconds)).await.expect("claims").begun.is_some(), "no suspect yet");
        store.sweep(time(seconds + LEASE.as_secs()), MAX_ATTEMPTS).await.expect("sweeps");
    }
    let told_before = story(store, &name).await;
    create(store, NewRecord { priority: 1, ..record("first") }, 300).await;
    create(store, record("last"), 300).await;
    let prefetch = Some(Prefetch { lease_for: KEPT, max_observations: u32::MAX });
    let claims = store.claim(&Claim { prefetch, ..busy.clone() }, time(300)).await.expect("claims");
    assert_eq!(claims.begun.map(|begun| begun.lease.name), Some(record("first").name));
    assert_eq!(claims.prefetched, None, "a suspect is not prefetched");

    // It is leased, and stays so as long as it is asked for.
    let claims = store.claim(&busy, time(300)).await.expect("claims");
    let suspect = claims.suspect.expect("it is next");
    assert_eq!((claims.begun, claims.prefetched, suspect.job.state), (None, None, JobState::Queued));
    assert_eq!(suspect.lease, Lease { name: name.clone(), attempt: 3 });
    let other = Claim { worker: "other".into(), ..busy.clone() };
    let last = store.claim(&other, time(301)).await.expect("claims").begun.expect("a job");
    assert_eq!(last.lease.name, record("last").name, "others pass over it");
    let begin = Some((suspect.lease.clone(), suspect.job.create_time));
    let renewal = Claim { begin, ..busy };
    let renewed = Claims { suspect: Some(suspect.clone()), ..Claims::default() };
    assert_eq!(store.claim(&renewal, time(320)).await, Ok(renewed.clone()));
    assert_eq!(store.claim(&other, time(349)).await, Ok(Claims::default()), "also one that finds no other job");

    // Where its holder is gone, or gave it back, it is another's.
    assert_eq!(store.claim(&other, time(350)).await, Ok(renewed.clone()));
    let begin = Some((suspect.lease.clone(), suspect.job.create_time));
    let give_back = Claim { begin, lease_for: Duration::ZERO, ..other.clone() };
    assert_eq!(store.claim(&give_back, time(350)).await, Ok(renewed.clone()));
    assert_eq!(store.claim(&other, time(350)).await, Ok(renewed));
    assert_eq!(store.claim(&renewal, time(351)).await, Ok(Claims::default()));
    assert_eq!(story(store, &name).await, told_before, "nothing is told of all that");
    let alone = Claim { worker: "other".into(), suspect_after: None, ..renewal };
    let begun = store.claim(&alone, time(352)).await.expect("claims").begun.expect("it is its lease");
    assert_eq!((&begun.lease, begun.job.state), (&suspect.lease, JobState::Running));
    let again = store.claim(&alone, time(352)).await.expect("claims").begun;
    assert_eq!(again, Some(begun), "where the first answer was lost");
    let late = Claim { worker: "worker".into(), ..alone };
    assert_eq!(store.claim(&late, time(352)).await, Ok(Claims::default()), "another's attempt");
    let lost = store.sweep(time(352 + LEASE.as_secs()), MAX_ATTEMPTS).await.expect("sweeps").lost;
    let states: Vec<_> = lost.iter().map(|job| (&*job.name.job, job.state)).collect();
    let expected = [("suspect", JobState::Failed), ("first", JobState::Queued), ("last", JobState::Queued)];
    assert_eq!(states, expected);
}

pub(in crate::store) async fn a_lease_that_was_taken_over_writes_nothing(store: &Store) {
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

pub(in crate::store) async fn a_success_stores_its_result_then_its_state(store: &Store) {
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

pub(in crate::store) async fn progress_is_an_event_and_stands_in_the_job(store: &Store) {
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

pub(in crate::store) async fn every_outcome_ends_in_its_state(store: &Store) {
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
    assert_eq!(store.queue_stats().await, Ok(QueueStats::default()));
    assert_eq!(store.stats().await.expect("counts").tenants, []);
}

pub(in crate::store) async fn giving_back_is_free_and_vanishing_is_not(store: &Store) {
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
        server: "worker".into(),
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
    assert_eq!(store.claim(&Claim::one("worker", LEASE), time(101)).await, Ok(Claims::default()));
}

pub(in crate::store) async fn a_cancel_ends_what_waits_and_flags_what_runs(store: &Store) {
    let waiting = create(store, record("waiting"), 0).await.name;
    let reply = store.request_cancel(&waiting, None, time(1)).await.expect("cancels");
    assert!(reply.by_this_call);
    assert_eq!((reply.job.state, reply.job.end_time), (JobState::Cancelled, Some(time(1))));
    let again = store.request_cancel(&waiting, None, time(2)).await.expect("is idempotent");
    assert_eq!((again.by_this_call, again.job), (false, reply.job));
    assert_eq!(story(store, &waiting).await, told(&[(1, 0, "QUEUED"), (2, 0, "CANCELLED")]));

    // Released, its worker vanished, or ended by its worker: a flagged job never runs again.
    for way in ["released", "vanished", "ended"] {
        let name = create(store, record(way), 0).await.name;
        let lease = claim(store, 1).await.lease;
        assert!(!store.heartbeat(&lease, time(1), LEASE).await.expect("holds").cancel_requested);
        let reply = store.request_cancel(&name, None, time(2)).await.expect("flags");
        assert!(!reply.by_this_call && reply.job.cancel_requested && reply.job.state == JobState::Running);
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

pub(in crate::store) async fn deadlines_end_what_waits(store: &Store) {
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
