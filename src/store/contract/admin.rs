//! What operators do: retries, priorities, pauses, and a look at the whole queue.

use super::*;
use crate::domain::Quota;
use crate::domain::job::AttachedCalls;
use crate::store::{Claims, TenantQueue};

async fn retry(store: &Store, name: &JobName, seconds: u64) -> Result<Job, Error> {
    store.retry_job(name, None, &ROOM, time(seconds)).await.map(|reply| reply.job)
}

/// Claims the next job at that second and loses it.
async fn lose(store: &Store, seconds: u64) -> Job {
    claim(store, seconds).await;
    store.sweep(time(seconds + 30), MAX_ATTEMPTS).await.expect("sweeps").lost.remove(0)
}

pub(in crate::store) async fn a_retried_job_begins_anew_and_its_events_go_on(store: &Store) {
    let new = NewRecord { deadline: Some(time(1_000)), cancel_on_disconnect: true, priority: 3, ..labelled("a") };
    let created = create(store, new, 0).await;
    assert_eq!(created.attached_calls, Some(AttachedCalls { attached: 1, detached: 0 }));
    let name = created.name;
    let old = claim(store, 1).await.lease;
    store.record(&old, &progress(7), time(2)).await.expect("holds");
    store.release(&old, time(3)).await.expect("gives back");
    for attempt in 1..=u64::from(MAX_ATTEMPTS) {
        lose(store, 100 * attempt).await;
    }
    let failed = store.job(&name).await.expect("a job");
    assert_eq!((failed.state, failed.attempt, failed.last_sequence), (JobState::Failed, 4, 10));

    let reply = store.retry_job(&name, Some(&failed.etag()), &ROOM, time(500)).await.expect("retries");
    assert!(reply.by_this_call);
    let job = reply.job;
    assert_eq!((job.state, job.attempt, job.last_sequence), (JobState::Queued, 4, 11));
    assert_eq!((&job.failure, job.progress, job.start_time, job.end_time), (&None, None, None, None));
    assert_eq!((job.attached_calls, job.deadline, job.priority), (None, Some(time(1_000)), 3));
    assert_eq!((&job.labels, job.create_time), (&failed.labels, time(0)));
    assert_ne!(job.etag(), failed.etag());
    assert_eq!(store.job(&name).await, Ok(job.clone()));
    assert_eq!(
        store.job_payload(&name, u32::MAX).await.map(|payload| payload.input),
        Ok(vec![7; 100]),
        "the input was kept"
    );
    // Kept for as long as any job that waits.
    assert_eq!(store.purge(time(1_000_000), 10).await, Ok(0));
    // Once more, as after an answer that was lost.
    let again = store.retry_job(&name, None, &ROOM, time(501)).await.expect("is queued");
    assert_eq!((again.by_this_call, again.job), (false, job));

    // The fencing token goes on, and the attempts of before do not count.
    let claimed = claim(store, 502).await;
    assert_eq!((claimed.lease.attempt, claimed.queue_time, claimed.job.start_time), (5, time(500), Some(time(502))));
    assert_eq!(store.heartbeat(&old, time(502), LEASE).await, Err(Error::Fenced(old)));
    assert_eq!(
        store.retry_job(&name, None, &ROOM, time(502)).await.map(|reply| reply.by_this_call),
        Ok(false),
        "it runs"
    );
    store.sweep(time(540), MAX_ATTEMPTS).await.expect("takes it back");
    assert_eq!(lose(store, 550).await.state, JobState::Queued);
    let failed = lose(store, 600).await;
    let failure = failed.failure.expect("a reason");
    let attempts: Vec<u32> = failure.attempts.iter().map(|past| past.attempt).collect();
    assert_eq!((failure.reason.as_str(), attempts), (ATTEMPTS_EXHAUSTED, vec![5, 6, 7]));
    let told_last = story(store, &name).await.split_off(9);
    let expected = [
        (10, 4, "FAILED:ATTEMPTS_EXHAUSTED"),
        (11, 4, "QUEUED"),
        (12, 5, "RUNNING"),
        (13, 5, "QUEUED"),
        (14, 6, "RUNNING"),
        (15, 6, "QUEUED"),
        (16, 7, "RUNNING"),
        (17, 7, "FAILED:ATTEMPTS_EXHAUSTED"),
    ];
    assert_eq!(told_last, told(&expected));

    // A deadline that has passed by then is no more.
    assert_eq!(retry(store, &name, 2_000).await.expect("retries").deadline, None);
    let lease = claim(store, 2_001).await.lease;
    let ended = store.finish(&lease, &success(vec![1]), time(2_002)).await.expect("finishes");
    assert_eq!((ended.state, ended.start_time), (JobState::Succeeded, Some(time(2_001))));
    assert_eq!(result_of(store, &name).await, Ok(Some(vec![1])));
}

pub(in crate::store) async fn a_retry_is_refused_where_there_is_nothing_to_do_or_no_room(store: &Store) {
    let cancelled = create(store, record("cancelled"), 0).await;
    store.request_cancel(&cancelled.name, None, time(1)).await.expect("ends");
    let due = create(store, NewRecord { deadline: Some(time(1)), ..record("due") }, 0).await.name;
    store.sweep(time(2), MAX_ATTEMPTS).await.expect("ends it");
    let succeeded = create(store, record("succeeded"), 0).await.name;
    let lease = claim(store, 3).await.lease;
    store.finish(&lease, &success(vec![1]), time(4)).await.expect("finishes");
    assert_eq!(retry(store, &succeeded, 5).await, Err(Error::Succeeded(succeeded.clone())));
    let none = JobName { tenant: "u".into(), ..succeeded };
    assert_eq!(retry(store, &none, 5).await, Err(Error::NotFound(none.clone())));
    let old = store.retry_job(&cancelled.name, Some(&cancelled.etag()), &ROOM, time(5)).await;
    assert_eq!(old, Err(Error::EtagMismatch(cancelled.name.clone())));

    // The bounds of the queue hold, and a refusal changes nothing.
    let one = QueueBounds { max_jobs: 1, ..ROOM };
    let retried = store.retry_job(&due, None, &one, time(6)).await.expect("there is room");
    assert_eq!((retried.job.state, retried.job.deadline), (JobState::Queued, None));
    let before = store.job(&cancelled.name).await.expect("a job");
    let full = store.retry_job(&cancelled.name, None, &one, time(7)).await;
    assert_eq!(full, Err(Error::QueueFull(Bound { quota: Quota::Jobs, taken: 1, asked: 1, max: 1 })));
    let of_tenant = QueueBounds { max_tenant_jobs: 1, ..ROOM };
    let full = store.retry_job(&cancelled.name, None, &of_tenant, time(7)).await;
    assert_eq!(full, Err(Error::QueueFull(Bound { quota: Quota::TenantJobs, taken: 1, asked: 1, max: 1 })));
    assert_eq!(store.job(&cancelled.name).await, Ok(before));
    assert_eq!(retry(store, &cancelled.name, 8).await.expect("there is room").state, JobState::Queued);
}

pub(in crate::store) async fn only_waiting_jobs_get_another_priority(store: &Store) {
    let first = create(store, record("first"), 0).await;
    let second = create(store, record("second"), 1).await;
    let changed = store.set_priority(&second.name, Some(&second.etag()), 7).await.expect("waits");
    assert_eq!((changed.priority, changed.state), (7, JobState::Queued));
    assert_eq!(store.job(&second.name).await, Ok(changed.clone()));
    let old = store.set_priority(&second.name, Some(&second.etag()), 8).await;
    assert_eq!(old, Err(Error::EtagMismatch(second.name.clone())), "its etag has changed");
    let lease = claim(store, 2).await.lease;
    assert_eq!(lease.name, second.name, "it went ahead");
    let refused = Error::NotQueued(second.name.clone(), JobState::Running);
    assert_eq!(store.set_priority(&second.name, None, 1).await, Err(refused));
    store.finish(&lease, &success(vec![1]), time(3)).await.expect("finishes");
    let refused = Error::NotQueued(second.name.clone(), JobState::Succeeded);
    assert_eq!(store.set_priority(&second.name, None, 1).await, Err(refused));
    let none = JobName { tenant: "u".into(), ..first.name };
    assert_eq!(store.set_priority(&none, None, 1).await, Err(Error::NotFound(none.clone())));
}

pub(in crate::store) async fn a_paused_queue_gives_out_no_job(store: &Store) {
    create(store, record("a"), 0).await;
    create(store, record("b"), 1).await;
    let lease = claim(store, 2).await.lease;
    for seconds in [3, 4] {
        store.set_paused(true, time(seconds)).await.expect("pauses");
        assert_eq!(store.queue(1).await.expect("reports").pause_time, Some(time(3)), "since the first call");
    }
    assert!(store.queue_stats().await.expect("counts").paused);
    assert_eq!(store.claim(&Claim::one("worker", LEASE), time(5)).await, Ok(Claims::default()));
    // What runs goes on, and what is new is taken in.
    store.heartbeat(&lease, time(5), LEASE).await.expect("holds");
    store.finish(&lease, &success(vec![1]), time(6)).await.expect("finishes");
    create(store, record("c"), 6).await;
    assert_eq!(store.claim(&Claim::one("worker", LEASE), time(7)).await, Ok(Claims::default()));
    for seconds in [8, 9] {
        store.set_paused(false, time(seconds)).await.expect("resumes");
        assert_eq!(store.queue(1).await.expect("reports").pause_time, None);
    }
    assert!(!store.queue_stats().await.expect("counts").paused);
    assert_eq!(claim(store, 10).await.job.name.job, "b");
}

pub(in crate::store) async fn a_report_counts_jobs_by_state_and_tenant(store: &Store) {
    let empty = store.queue(20).await.expect("reports");
    assert!(empty.jobs.iter().all(|(_, count)| *count == 0) && empty.oldest.is_none() && empty.tenants.is_empty());
    let of = |tenant: &str, job: &str| {
        let name = JobName { tenant: tenant.into(), job: job.into() };
        NewRecord { name, ..record(job) }
    };
    for (tenant, job, seconds) in
        [("t", "a", 0), ("t", "b", 1), ("u", "c", 2), ("u", "d", 3), ("u", "e", 4), ("v", "f", 5)]
    {
        create(store, of(tenant, job), seconds).await;
    }
    // One of the first tenant's runs, one of the last's has ended.
    claim(store, 6).await;
    let last = JobName { tenant: "v".into(), job: "f".into() };
    store.request_cancel(&last, None, time(7)).await.expect("ends");
    let report = store.queue(20).await.expect("reports");
    let count = |state| report.jobs.iter().find(|(known, _)| *known == state).map(|(_, count)| *count);
    assert_eq!((count(JobState::Queued), count(JobState::Running)), (Some(4), Some(1)));
    assert_eq!((count(JobState::Cancelled), count(JobState::Succeeded)), (Some(1), Some(0)));
    let oldest = JobName { tenant: "t".into(), job: "b".into() };
    assert_eq!(report.oldest, Some((oldest, time(1))));
    let tenant = |tenant: &str, queued, running| TenantQueue { tenant: tenant.into(), queued, running };
    assert_eq!(report.tenants, [tenant("u", 3, 0), tenant("t", 1, 1)]);
    assert_eq!(store.queue(1).await.expect("reports").tenants, [tenant("u", 3, 0)]);
}
