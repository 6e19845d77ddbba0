//! Creating jobs: what is kept, what is the same, what is refused.

use super::*;
use crate::domain::{Oversize, Quota};
use crate::store::TakenId;

pub(in crate::store) async fn a_created_job_reads_back(store: &Store) {
    let now = time(0) + Duration::from_micros(1);
    let labels = BTreeMap::from([("scene".to_owned(), "door".to_owned()), ("é \"'".to_owned(), "%_".to_owned())]);
    // More than two rows, and not a whole number of them.
    let input: Vec<u8> = (0..2 * payload::CHUNK_BYTES + 17).map(|k| (k % 251) as u8).collect();
    let new = NewRecord {
        input: input.clone().into(),
        labels: labels.clone(),
        priority: -3,
        deadline: Some(time(60)),
        trace_parent: Some("00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01".into()),
        ..record("a")
    };
    let created = store.create_job(new.clone(), &ROOM, now).await.expect("created");
    assert!(created.by_this_call);
    let expected = Job {
        name: new.name.clone(),
        state: JobState::Queued,
        attempt: 0,
        settings: new.settings,
        input: None,
        view_count: 3,
        track_count: 20,
        observation_count: 60,
        labels,
        priority: -3,
        create_time: now,
        start_time: None,
        end_time: None,
        deadline: Some(time(60)),
        progress: None,
        last_sequence: 1,
        summary: None,
        failure: None,
        cancel_requested: false,
        attached_calls: None,
        expire_time: None,
        webhook: None,
    };
    assert_eq!(created.job, expected);
    assert_eq!(store.job(&new.name).await, Ok(expected));
    for observations in [0, u32::MAX] {
        let read = store.job_payload(&new.name, observations).await.map(|payload| payload.input);
        assert_eq!(read.as_ref(), Ok(&input), "however large it is said to be");
    }
    assert_eq!(result_of(store, &new.name).await, Ok(None));
    assert_eq!(story(store, &new.name).await, told(&[(1, 0, "QUEUED")]));
    let claimed = claim(store, 1).await;
    assert_eq!(claimed.trace_parent, new.trace_parent);
    assert_eq!(claimed.queue_time, now);
}

pub(in crate::store) async fn a_request_id_stands_for_one_body_and_one_job(store: &Store) {
    let request = |byte| Some(Request { id: "r".into(), digest: [byte; 32] });
    let first = create(store, NewRecord { request: request(1), ..record("a") }, 0).await;
    claim(store, 1).await;
    // Even where nothing more is admitted, and under another generated id.
    let full = QueueBounds { max_jobs: 0, ..ROOM };
    let again = NewRecord { request: request(1), ..record("b") };
    let repeated = store.create_job(again, &full, time(2)).await.expect("known");
    assert!(!repeated.by_this_call);
    assert_eq!(repeated.job.name, first.name);
    assert_eq!(repeated.job.state, JobState::Running, "the job as it stands now");
    let asked = |byte| request(byte).expect("one");
    assert_eq!(store.requested_job("t", &asked(1)).await, Ok(Some(repeated.job)));
    assert_eq!(store.requested_job("u", &asked(1)).await, Ok(None));
    let error = store.requested_job("t", &asked(2)).await.expect_err("another body");
    assert!(matches!(error, Error::AlreadyExists(_)), "{error}");
    let other_body = NewRecord { request: request(2), ..record("c") };
    let error = store.create_job(other_body, &ROOM, time(2)).await.expect_err("another body");
    assert!(matches!(error, Error::AlreadyExists(_)), "{error}");
    let mut other_tenant = NewRecord { request: request(2), ..record("a") };
    other_tenant.name.tenant = "u".into();
    let theirs = store.create_job(other_tenant, &ROOM, time(2)).await.expect("request ids are the tenant's");
    assert!(theirs.by_this_call);
}

pub(in crate::store) async fn one_request_id_from_many_callers_is_one_job(store: &Store) {
    let call = |number: usize| {
        let request = Some(Request { id: "r".into(), digest: [1; 32] });
        store.create_job(NewRecord { request, ..record(&format!("job-{number}")) }, &ROOM, time(0))
    };
    let created = futures_util::future::join_all((0..50).map(call)).await;
    let created: Vec<_> = created.into_iter().map(|created| created.expect("created or known")).collect();
    assert_eq!(created.iter().filter(|created| created.by_this_call).count(), 1);
    assert!(created.iter().all(|other| other.job.name == created[0].job.name));
    assert_eq!(store.queue_stats().await.expect("counts").queued, 1);
}

pub(in crate::store) async fn a_taken_job_id_is_refused(store: &Store) {
    create(store, record("a"), 0).await;
    let error = store.create_job(record("a"), &ROOM, time(1)).await.expect_err("taken");
    assert_eq!(error, Error::AlreadyExists(TakenId::Job(JobName { tenant: "t".into(), job: "a".into() })));
}

pub(in crate::store) async fn admission_bounds_what_waits(store: &Store) {
    let refused = |bounds: QueueBounds| async move {
        match store.create_job(record("late"), &bounds, time(1)).await {
            Err(Error::QueueFull(bound)) => bound,
            other => panic!("{other:?}"),
        }
    };
    let empty = QueueBounds { max_bytes: 0, max_observations: 0, ..ROOM };
    store.create_job(record("a"), &empty, time(0)).await.expect("one job alone always fits");
    create(store, record("b"), 0).await;
    let stats = store.queue_stats().await.expect("counts");
    assert_eq!((stats.queued, stats.queued_bytes, stats.queued_observations), (2, 200, 120));
    assert_eq!(
        refused(QueueBounds { max_jobs: 2, ..ROOM }).await,
        Bound { quota: Quota::Jobs, taken: 2, asked: 1, max: 2 }
    );
    assert_eq!(
        refused(QueueBounds { max_bytes: 299, ..ROOM }).await,
        Bound { quota: Quota::Bytes, taken: 200, asked: 100, max: 299 }
    );
    let bound = refused(QueueBounds { max_observations: 179, ..ROOM }).await;
    assert_eq!(bound, Bound { quota: Quota::Observations, taken: 120, asked: 60, max: 179 });
    assert!(matches!(store.job(&record("late").name).await, Err(Error::NotFound(_))), "nothing was stored");
    claim(store, 2).await;
    let stats = store.queue_stats().await.expect("counts");
    assert_eq!((stats.queued, stats.queued_bytes, stats.queued_observations), (1, 100, 60));
    let exact = QueueBounds { max_jobs: 2, max_bytes: 200, max_observations: 120, ..ROOM };
    store.create_job(record("c"), &exact, time(3)).await.expect("what runs does not wait");
}

pub(in crate::store) async fn admission_bounds_each_tenant(store: &Store) {
    let of = |tenant: &str, job: &str| {
        let mut new = record(job);
        new.name.tenant = tenant.into();
        new
    };
    let bounds = QueueBounds { max_tenant_jobs: 2, max_tenant_bytes: 250, ..ROOM };
    let alone = QueueBounds { max_tenant_bytes: 0, ..bounds.clone() };
    store.create_job(of("t", "a"), &alone, time(0)).await.expect("a job that waits alone always fits");
    let larger = NewRecord { input: vec![7; 151].into(), ..of("t", "b") };
    let error = store.create_job(larger, &bounds, time(0)).await.expect_err("too many bytes");
    assert_eq!(error, Error::QueueFull(Bound { quota: Quota::TenantBytes, taken: 100, asked: 151, max: 250 }));
    store.create_job(of("t", "b"), &bounds, time(0)).await.expect("room for two");
    let error = store.create_job(of("t", "c"), &bounds, time(0)).await.expect_err("room for two");
    assert_eq!(error, Error::QueueFull(Bound { quota: Quota::TenantJobs, taken: 2, asked: 1, max: 2 }));
    let batch = vec![of("u", "a"), of("u", "b"), of("u", "c")];
    let error = store.create_jobs(batch, &bounds, time(0)).await.expect_err("a batch counts as a whole");
    assert_eq!(error, Error::BatchTooLarge(Oversize { quota: Quota::TenantJobs, asked: 3, max: 2 }));
    store.create_job(of("u", "a"), &bounds, time(0)).await.expect("another tenant has its own share");
    claim(store, 1).await;
    store.create_job(of("t", "c"), &bounds, time(2)).await.expect("what runs does not wait");
}

pub(in crate::store) async fn a_batch_is_stored_whole_or_not_at_all(store: &Store) {
    create(store, record("taken"), 0).await;
    let names = ["a", "b", "taken"];
    let batch: Vec<_> = names.map(record).to_vec();
    let error = store.create_jobs(batch.clone(), &ROOM, time(1)).await.expect_err("a taken id");
    assert_eq!(error, Error::AlreadyExists(TakenId::Job(JobName { tenant: "t".into(), job: "taken".into() })));
    let twice = vec![record("a"), record("a")];
    let error = store.create_jobs(twice, &ROOM, time(1)).await.expect_err("an id twice");
    assert_eq!(error, Error::AlreadyExists(TakenId::Job(JobName { tenant: "t".into(), job: "a".into() })));
    // One of the two has room, both have not.
    let bounds = QueueBounds { max_jobs: 2, ..ROOM };
    let error = store.create_jobs(batch[..2].to_vec(), &bounds, time(1)).await.expect_err("full");
    let bound = Bound { quota: Quota::Jobs, taken: 1, asked: 2, max: 2 };
    assert_eq!(error, Error::QueueFull(bound), "one waits, and both of the batch were asked for");
    assert_eq!(bound.to_string(), "the queue is full: jobs waiting: 1, asked for: 2, allowed: 2");
    for (bounds, quota, taken, asked, max) in [
        (QueueBounds { max_bytes: 299, ..ROOM }, Quota::Bytes, 100, 200, 299),
        (QueueBounds { max_observations: 179, ..ROOM }, Quota::Observations, 60, 120, 179),
        (QueueBounds { max_tenant_jobs: 2, ..ROOM }, Quota::TenantJobs, 1, 2, 2),
        (QueueBounds { max_tenant_bytes: 299, ..ROOM }, Quota::TenantBytes, 100, 200, 299),
    ] {
        let error = store.create_jobs(batch[..2].to_vec(), &bounds, time(1)).await.expect_err("full");
        assert_eq!(error, Error::QueueFull(Bound { quota, taken, asked, max }));
    }
    assert!(matches!(store.job(&record("a").name).await, Err(Error::NotFound(_))), "nothing was stored");
    assert_eq!(store.queue_stats().await.expect("counts").queued, 1);
    let created = store.create_jobs(batch[..2].to_vec(), &ROOM, time(1)).await.expect("created");
    let created: Vec<_> = created.iter().map(|created| (created.job.name.job.as_str(), created.by_this_call)).collect();
    assert_eq!(created, [("a", true), ("b", true)]);
    assert_eq!(store.queue_stats().await.expect("counts").queued_bytes, 300);
    assert_eq!(store.job_payload(&record("b").name, u32::MAX).await.map(|payload| payload.input), Ok(vec![7; 100]));
}

pub(in crate::store) async fn a_batch_knows_its_request_ids(store: &Store) {
    let request = |id: &str, byte| Some(Request { id: id.into(), digest: [byte; 32] });
    let batch = || {
        vec![
            NewRecord { request: request("r-1", 1), ..record("a") },
            NewRecord { request: request("r-2", 2), ..record("b") },
            NewRecord { request: request("r-1", 1), ..record("c") },
        ]
    };
    for news in [[true, true, false], [false, false, false]] {
        let created = store.create_jobs(batch(), &ROOM, time(0)).await.expect("created or known");
        assert_eq!(created.iter().map(|created| created.by_this_call).collect::<Vec<_>>(), news);
        assert_eq!(created.iter().map(|created| created.job.name.job.as_str()).collect::<Vec<_>>(), ["a", "b", "a"]);
    }
    let mut other = batch();
    other[1].request = request("r-2", 9);
    other[0] = record("new");
    let error = store.create_jobs(other, &ROOM, time(1)).await.expect_err("another body");
    assert!(matches!(error, Error::AlreadyExists(_)), "{error}");
    assert_eq!(store.queue_stats().await.expect("counts").queued, 2);
}

pub(in crate::store) async fn a_batch_that_never_fits_is_told_so(store: &Store) {
    let batch = |count: usize| (0..count).map(|k| record(&format!("job-{k}"))).collect::<Vec<_>>();
    let refused = async |new: Vec<NewRecord>, bounds: QueueBounds| match store.create_jobs(new, &bounds, time(0)).await
    {
        Err(Error::BatchTooLarge(Oversize { quota, asked, max })) => (quota, asked, max),
        other => panic!("{other:?}"),
    };
    // Each has 100 bytes and 60 observations. In an empty queue, and in one that is full besides.
    for round in 0..2 {
        assert_eq!(refused(batch(3), QueueBounds { max_jobs: 2, ..ROOM }).await, (Quota::Jobs, 3, 2));
        assert_eq!(refused(batch(3), QueueBounds { max_bytes: 299, ..ROOM }).await, (Quota::Bytes, 300, 299));
        let bounds = QueueBounds { max_observations: 179, ..ROOM };
        assert_eq!(refused(batch(3), bounds).await, (Quota::Observations, 180, 179));
        assert_eq!(refused(batch(3), QueueBounds { max_tenant_jobs: 2, ..ROOM }).await, (Quota::TenantJobs, 3, 2));
        let bounds = QueueBounds { max_tenant_bytes: 299, ..ROOM };
        assert_eq!(refused(batch(3), bounds).await, (Quota::TenantBytes, 300, 299));
        assert!(matches!(store.job(&record("job-0").name).await, Err(Error::NotFound(_))), "nothing was stored");
        create(store, record(&format!("waiting-{round}")), 0).await;
    }
    // What just fits an empty queue is worth another try.
    let exact =
        QueueBounds { max_jobs: 3, max_bytes: 300, max_observations: 180, max_tenant_jobs: 3, max_tenant_bytes: 300 };
    let error = store.create_jobs(batch(3), &exact, time(0)).await.expect_err("two wait");
    assert!(matches!(error, Error::QueueFull(_)), "{error}");
    // Jobs that an earlier call made need no room, and one that comes twice needs it once.
    let request = |k: usize| Some(Request { id: format!("r-{k}"), digest: [1; 32] });
    let known = NewRecord { request: request(0), ..record("known") };
    create(store, known.clone(), 0).await;
    let fresh = NewRecord { request: request(1), ..record("fresh") };
    let bounds = QueueBounds { max_jobs: 4, ..ROOM };
    let batch = vec![known.clone(), fresh.clone(), fresh.clone(), known.clone(), fresh];
    let created = store.create_jobs(batch, &bounds, time(1)).await.expect("one more fits");
    assert_eq!(created.iter().filter(|created| created.by_this_call).count(), 1);
}

pub(in crate::store) async fn only_a_job_that_its_call_created_depends_on_calls(store: &Store) {
    let of = |id: &str, cancel_on_disconnect| {
        let request = Some(Request { id: id.into(), digest: [1; 32] });
        NewRecord { request, cancel_on_disconnect, ..record(id) }
    };
    let calls = |job: &Job| job.attached_calls.map(|calls| (calls.attached, calls.detached));
    let detach = async |job: &Job| store.detach(&job.name, job.create_time).await.expect("exists");

    let solved = create(store, of("solved", true), 0).await;
    assert_eq!(calls(&solved), Some((1, 0)));
    let again = create(store, of("solved", true), 1).await;
    assert_eq!((&again.name, calls(&again)), (&solved.name, Some((2, 0))));
    assert_ne!(again.etag(), solved.etag());
    for expected in [(2, 1), (2, 2), (2, 2)] {
        assert_eq!(calls(&detach(&solved).await), Some(expected), "no more go than have come");
    }
    assert_eq!(calls(&create(store, of("solved", true), 2).await), Some((3, 2)));
    let unchanged = store.detach(&solved.name, time(9)).await.expect("exists");
    assert_eq!(calls(&unchanged), Some((3, 2)), "of a job that was created at another time");
    assert_eq!(calls(&create(store, of("solved", false), 3).await), None, "someone wants it without a call");
    assert_eq!(calls(&create(store, of("solved", true), 4).await), None);

    let created = create(store, of("created", false), 0).await;
    assert_eq!(calls(&created), None);
    assert_eq!(calls(&create(store, of("created", true), 1).await), None, "it was there before the call");
    assert_eq!(calls(&detach(&created).await), None);
    let nothing = store.detach(&record("none").name, time(0)).await;
    assert_eq!(nothing, Err(Error::NotFound(record("none").name)));
}
