//! Removing ended jobs: what goes, what stays, what is refused.

use super::*;

/// A job that succeeded at that second.
async fn succeeded(store: &Store, new: NewRecord, seconds: u64) -> Job {
    create(store, new, 0).await;
    let lease = claim(store, 0).await.lease;
    store.finish(&lease, &success(vec![1, 2, 3]), time(seconds)).await.expect("finishes")
}

async fn exists(store: &Store, name: &JobName) -> bool {
    match store.job(name).await {
        Ok(_) => true,
        Err(Error::NotFound(_)) => false,
        Err(error) => panic!("{error}"),
    }
}

pub(in crate::store) async fn an_ended_job_goes_with_all_that_it_had(store: &Store) {
    let request = Some(Request { id: "r".into(), digest: [1; 32] });
    let labels = BTreeMap::from([("a".to_owned(), "b".to_owned())]);
    let new = NewRecord { request, labels: labels.clone(), ..record("a") };
    let name = succeeded(store, new.clone(), 1).await.name;
    let other = succeeded(store, record("b"), 1).await;
    store.delete_job(&name, None).await.expect("deletes");
    let missing = Error::NotFound(name.clone());
    assert_eq!(store.job(&name).await, Err(missing.clone()));
    assert_eq!(store.events_after(&name, 0, 10).await, Err(missing.clone()));
    assert_eq!(store.job_payload(&name, u32::MAX).await.map(|payload| payload.input), Err(missing.clone()));
    assert_eq!(result_of(store, &name).await, Err(missing.clone()));
    assert_eq!(store.delete_job(&name, None).await, Err(missing));
    let query = JobQuery { tenant: "t".into(), labels, ..JobQuery::default() };
    assert!(store.jobs(&query).await.expect("lists").items.is_empty());
    assert_eq!(store.job(&other.name).await, Ok(other.clone()), "others stay");
    assert_eq!(store.job_payload(&other.name, u32::MAX).await.map(|payload| payload.input), Ok(vec![7; 100]));
    assert_eq!(result_of(store, &other.name).await, Ok(Some(vec![1, 2, 3])));
    // Name and request id are free again, and the new job has nothing of the old one.
    let created = store.create_job(new, &ROOM, time(5)).await.expect("created");
    assert!(created.by_this_call);
    assert_eq!(story(store, &name).await, told(&[(1, 0, "QUEUED")]));
    assert_eq!(result_of(store, &name).await, Ok(None));
}

pub(in crate::store) async fn what_waits_or_runs_is_not_deleted(store: &Store) {
    let name = create(store, record("a"), 0).await.name;
    assert_eq!(store.delete_job(&name, None).await, Err(Error::NotEnded(name.clone(), JobState::Queued)));
    let lease = claim(store, 1).await.lease;
    assert_eq!(store.delete_job(&name, None).await, Err(Error::NotEnded(name.clone(), JobState::Running)));
    assert_eq!(store.purge(time(1_000_000), 10).await, Ok(0));
    store.finish(&lease, &success(vec![1]), time(2)).await.expect("still there");
    let other = JobName { tenant: "u".into(), ..name.clone() };
    assert_eq!(store.delete_job(&other, None).await, Err(Error::NotFound(other.clone())));
    store.delete_job(&name, None).await.expect("deletes");
    assert_eq!(store.heartbeat(&lease, time(3), LEASE).await, Err(Error::Fenced(lease)));
}

pub(in crate::store) async fn an_etag_is_honoured_and_changes_with_the_job(store: &Store) {
    let queued = create(store, record("a"), 0).await;
    let name = queued.name.clone();
    let mut seen = vec![queued.etag()];
    let lease = claim(store, 1).await.lease;
    let mismatch = Error::EtagMismatch(name.clone());
    assert_eq!(store.request_cancel(&name, Some(&seen[0]), time(2)).await, Err(mismatch.clone()));
    let running = store.job(&name).await.expect("job");
    assert!(!running.cancel_requested, "a refused cancel changes nothing");
    seen.push(running.etag());
    let flagged = store.request_cancel(&name, Some(&running.etag()), time(2)).await.expect("the same etag").job;
    assert!(flagged.cancel_requested);
    seen.push(flagged.etag());
    let ended = store.finish(&lease, &success(vec![1]), time(3)).await.expect("finishes");
    for old in &seen {
        assert_eq!(store.delete_job(&name, Some(old)).await, Err(mismatch.clone()));
    }
    store.delete_job(&name, Some(&ended.etag())).await.expect("the same etag");
    seen.push(ended.etag());
    seen.push(create(store, record("a"), 4).await.etag());
    let count = seen.len();
    seen.sort();
    seen.dedup();
    assert_eq!(seen.len(), count, "no etag twice: {seen:?}");
}

pub(in crate::store) async fn what_ended_long_ago_goes_oldest_first_and_in_portions(store: &Store) {
    let mut names = Vec::new();
    for (job, seconds) in [("third", 30), ("first", 10), ("fourth", 40), ("second", 20)] {
        names.push(succeeded(store, record(job), seconds).await.name);
    }
    let waiting = create(store, record("waiting"), 0).await.name;
    let left = || async {
        let mut left = Vec::new();
        for name in &names {
            if exists(store, name).await {
                left.push(name.job.clone());
            }
        }
        left
    };
    assert_eq!(store.purge(time(9), 10).await, Ok(0));
    assert_eq!(store.purge(time(30), 2).await, Ok(2));
    assert_eq!(left().await, ["third", "fourth"]);
    assert_eq!(store.purge(time(30), 2).await, Ok(1), "what ended at that very time goes too");
    assert_eq!(store.purge(time(30), 2).await, Ok(0));
    assert_eq!(left().await, ["fourth"]);
    assert!(exists(store, &waiting).await);
    store.reclaim().await.expect("gives back");
}
