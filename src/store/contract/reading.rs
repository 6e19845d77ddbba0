//! Listing jobs and reading their events.

use super::*;

pub(in crate::store) async fn listings_page_and_filter(store: &Store) {
    for number in 0..7 {
        let mut labels = BTreeMap::from([("parity".to_owned(), (number % 2).to_string())]);
        labels.insert("all".into(), "x".into());
        // Some of one moment: pages must not lose or repeat among them.
        create(store, NewRecord { labels, ..record(&format!("job-{number}")) }, number / 3).await;
    }
    let mut foreign = record("job-0");
    foreign.name.tenant = "u".into();
    create(store, foreign, 0).await;
    claim(store, 10).await;

    let base = JobQuery { tenant: "t".into(), ..JobQuery::default() };
    let names = |jobs: &[Job]| jobs.iter().map(|job| job.name.job.clone()).collect::<Vec<_>>();
    for order in [Order::CreateTimeDescending, Order::CreateTimeAscending] {
        let mut query = JobQuery { page_size: 2, order, ..base.clone() };
        let mut listed = Vec::new();
        loop {
            let page = store.jobs(&query).await.expect("lists");
            assert!(page.items.len() <= 2);
            listed.extend(names(&page.items));
            query.page_token = page.next_page_token;
            if query.page_token.is_none() {
                break;
            }
        }
        let mut expected: Vec<_> = (0..7).map(|number| format!("job-{number}")).collect();
        if order == Order::CreateTimeDescending {
            expected.reverse();
        }
        assert_eq!(listed, expected);
    }
    let listed = |query: JobQuery| async move { names(&store.jobs(&query).await.expect("lists").items) };
    let running = JobQuery { states: vec![JobState::Running, JobState::Failed], ..base.clone() };
    assert_eq!(listed(running).await, ["job-0"]);
    let labels = BTreeMap::from([("parity".to_owned(), "1".to_owned()), ("all".to_owned(), "x".to_owned())]);
    let odd = JobQuery { labels, order: Order::CreateTimeAscending, ..base.clone() };
    assert_eq!(listed(odd).await, ["job-1", "job-3", "job-5"]);
    let both = JobQuery { labels: BTreeMap::from([("parity".to_owned(), "x".to_owned())]), ..base.clone() };
    assert!(listed(both).await.is_empty());
    let foreign = JobQuery { tenant: "u".into(), ..base.clone() };
    assert_eq!(listed(foreign).await, ["job-0"]);
    let bad = JobQuery { page_token: Some("no".into()), ..base };
    assert_eq!(store.jobs(&bad).await, Err(Error::PageToken));
}

pub(in crate::store) async fn events_come_in_order_and_in_portions(store: &Store) {
    let name = create(store, record("a"), 0).await.name;
    create(store, record("b"), 0).await;
    let lease = claim(store, 1).await.lease;
    for iteration in 0..10 {
        store.record(&lease, &progress(iteration), time(2)).await.expect("holds");
    }
    let mut sequences = Vec::new();
    loop {
        let after = sequences.last().copied().unwrap_or(0);
        let events = store.events_after(&name, after, 5).await.expect("events");
        assert!(events.len() <= 5);
        if events.is_empty() {
            break;
        }
        sequences.extend(events.iter().filter_map(|event| event.sequence));
    }
    assert_eq!(sequences, (1..=12).collect::<Vec<_>>());
}

pub(in crate::store) async fn what_does_not_exist_is_not_found(store: &Store) {
    create(store, record("a"), 0).await;
    let name = JobName { tenant: "u".into(), job: "a".into() };
    let missing = Error::NotFound(name.clone());
    assert_eq!(store.job(&name).await, Err(missing.clone()));
    assert_eq!(store.job_payload(&name, u32::MAX).await.map(|payload| payload.input), Err(missing.clone()));
    assert_eq!(result_of(store, &name).await, Err(missing.clone()));
    assert_eq!(store.events_after(&name, 0, 1).await, Err(missing.clone()));
    assert_eq!(store.request_cancel(&name, None, time(0)).await, Err(missing));
    let lease = Lease { name, attempt: 1 };
    assert_eq!(store.heartbeat(&lease, time(0), LEASE).await, Err(Error::Fenced(lease)));
}

pub(crate) async fn operators_see_tenants_the_oldest_job_and_bytes(store: &Store) {
    let empty = store.stats().await.expect("counts");
    assert_eq!((empty.oldest_queue_time, empty.tenants.len()), (None, 0));
    assert!(empty.bytes > 0, "a schema takes room");
    let of =
        |tenant: &str, job: &str| NewRecord { name: JobName { tenant: tenant.into(), job: job.into() }, ..record(job) };
    create(store, of("north", "a"), 0).await;
    create(store, of("north", "b"), 1).await;
    create(store, of("south", "c"), 2).await;
    let first = claim(store, 3).await;
    let mut stats = store.stats().await.expect("counts");
    stats.tenants.sort_by(|a, b| a.tenant.cmp(&b.tenant));
    let tenants: Vec<_> = stats.tenants.iter().map(|of| (of.tenant.as_str(), of.queued, of.running)).collect();
    assert_eq!(first.job.name.job, "a");
    assert_eq!(tenants, [("north", 1, 1), ("south", 1, 0)]);
    assert_eq!(stats.oldest_queue_time, Some(time(1)), "what runs does not wait");
}
