//! The outbox of webhooks: what is due, who has it, and what became of it.

use super::*;
use crate::domain::{Webhook, WebhookState};
use crate::store::{PassedOver, WebhookOutcome, WebhookQueue};

const URL: &str = "https://hooks.example/a?b=c";

fn hooked(job: &str, url: &str) -> NewRecord {
    NewRecord { webhook_url: Some(url.into()), ..record(job) }
}

/// A job with a webhook that succeeded at that second.
async fn ended(store: &Store, job: &str, url: &str, seconds: u64) -> JobName {
    let name = create(store, hooked(job, url), 0).await.name;
    let lease = claim(store, 0).await.lease;
    assert_eq!(lease.name, name, "nothing else waits");
    store.finish(&lease, &success(vec![1]), time(seconds)).await.expect("finishes");
    name
}

async fn claim_webhook(store: &Store, seconds: u64) -> Option<Job> {
    store.claim_webhook(&PassedOver::default(), time(seconds), LEASE).await.expect("claims")
}

async fn settle(store: &Store, job: &Job, outcome: WebhookOutcome, seconds: u64) -> bool {
    store.settle_webhook(job, &outcome, time(seconds)).await.expect("settles")
}

async fn webhook(store: &Store, name: &JobName) -> Webhook {
    store.job(name).await.expect("the job").webhook.expect("a webhook")
}

async fn queue(store: &Store, seconds: u64) -> WebhookQueue {
    store.webhook_queue(time(seconds)).await.expect("counts")
}

pub(in crate::store) async fn every_end_of_a_job_makes_its_webhook_due(store: &Store) {
    let none = WebhookQueue { pending: 0, is_due: false };
    // A job without a webhook has nothing to tell.
    create(store, record("plain"), 0).await;
    let plain = claim(store, 0).await.lease;
    store.finish(&plain, &success(vec![1]), time(1)).await.expect("finishes");
    let created = create(store, hooked("a", URL), 0).await;
    assert_eq!(created.webhook, Some(Webhook::pending(URL)));
    assert_eq!(store.job(&created.name).await, Ok(created.clone()));
    assert_eq!(queue(store, 1_000).await, none, "it has not ended");
    let lease = claim(store, 1).await.lease;
    store.release(&lease, time(2)).await.expect("gives it back");
    assert_eq!(queue(store, 1_000).await, none, "it is queued again");
    let succeeded = claim(store, 3).await.lease;
    let job = store.finish(&succeeded, &success(vec![1]), time(4)).await.expect("finishes");
    assert_eq!(job.webhook, created.webhook);
    assert_eq!(queue(store, 4).await, WebhookQueue { pending: 1, is_due: true });
    // Cancelled and expired while queued, failed, and lost once too often.
    let cancelled = create(store, hooked("cancelled", URL), 5).await.name;
    store.request_cancel(&cancelled, None, time(5)).await.expect("cancels");
    create(store, NewRecord { deadline: Some(time(6)), ..hooked("expired", URL) }, 5).await;
    store.sweep(time(7), MAX_ATTEMPTS).await.expect("sweeps");
    create(store, hooked("failed", URL), 8).await;
    let failed = Outcome::Failed(Failure::new("INTERNAL", "a defect"));
    let lease = claim(store, 8).await.lease;
    store.finish(&lease, &Arc::new(Ending { outcome: failed, progress: None }), time(8)).await.expect("finishes");
    create(store, hooked("lost", URL), 9).await;
    claim(store, 9).await;
    store.sweep(time(10_000), 1).await.expect("sweeps");
    assert_eq!(queue(store, 10_000).await, WebhookQueue { pending: 5, is_due: true });
    let mut sent = Vec::new();
    while let Some(job) = claim_webhook(store, 10_000).await {
        assert!(job.state.is_terminal() && job.end_time.is_some(), "{job:?}");
        sent.push((job.name.job.clone(), job.state));
    }
    let expected = [
        ("a", JobState::Succeeded),
        ("cancelled", JobState::Cancelled),
        ("expired", JobState::DeadlineExceeded),
        ("failed", JobState::Failed),
        ("lost", JobState::Failed),
    ];
    assert_eq!(sent, expected.map(|(job, state)| (job.to_owned(), state)), "in the order of the jobs");
}

pub(in crate::store) async fn an_attempt_is_leased_and_settled_once(store: &Store) {
    let name = ended(store, "a", URL, 1).await;
    let first = claim_webhook(store, 1).await.expect("due");
    assert_eq!(first.webhook, Some(Webhook { attempts: 1, ..Webhook::pending(URL) }));
    assert_eq!(store.job(&name).await, Ok(first.clone()));
    assert_eq!(claim_webhook(store, 30).await, None, "leased");
    assert_eq!(queue(store, 30).await, WebhookQueue { pending: 1, is_due: false });
    let second = claim_webhook(store, 31).await.expect("the lease has run out");
    assert_eq!(second.webhook.as_ref().map(|webhook| webhook.attempts), Some(2));
    assert!(!settle(store, &first, WebhookOutcome::GivenUp { error: "late".into() }, 32).await, "another has begun");
    assert_eq!(webhook(store, &name).await.state, WebhookState::Pending);
    assert!(settle(store, &second, WebhookOutcome::Delivered, 32).await);
    let delivered = Webhook { state: WebhookState::Delivered, attempts: 2, ..Webhook::pending(URL) };
    assert_eq!(webhook(store, &name).await, delivered);
    assert!(!settle(store, &second, WebhookOutcome::Delivered, 33).await, "settled before");
    assert_eq!(claim_webhook(store, 1_000_000).await, None);
    assert_eq!(queue(store, 1_000_000).await, WebhookQueue { pending: 0, is_due: false });
}

pub(in crate::store) async fn a_failed_attempt_is_due_again_later_and_a_last_one_never(store: &Store) {
    let name = ended(store, "a", URL, 1).await;
    let job = claim_webhook(store, 2).await.expect("due");
    let retry = WebhookOutcome::Retry { error: "away".into(), after: Duration::from_secs(100) };
    assert!(settle(store, &job, retry, 5).await);
    let failed = Webhook { attempts: 1, last_error: Some("away".into()), ..Webhook::pending(URL) };
    assert_eq!(webhook(store, &name).await, failed);
    assert_eq!(claim_webhook(store, 104).await, None, "not yet");
    assert_eq!(queue(store, 104).await, WebhookQueue { pending: 1, is_due: false });
    let job = claim_webhook(store, 105).await.expect("due again");
    assert_eq!(job.webhook, Some(Webhook { attempts: 2, ..failed }), "the last error stands meanwhile");
    assert!(settle(store, &job, WebhookOutcome::GivenUp { error: "gone".into() }, 106).await);
    let given_up =
        Webhook { url: URL.into(), state: WebhookState::GivenUp, attempts: 2, last_error: Some("gone".into()) };
    assert_eq!(webhook(store, &name).await, given_up);
    assert_eq!(claim_webhook(store, 1_000_000).await, None);
}

pub(in crate::store) async fn a_retried_job_has_another_end_to_send(store: &Store) {
    let name = create(store, hooked("a", URL), 0).await.name;
    let fail = || Arc::new(Ending { outcome: Outcome::Failed(Failure::new("INTERNAL", "a defect")), progress: None });
    let lease = claim(store, 0).await.lease;
    store.finish(&lease, &fail(), time(1)).await.expect("finishes");
    let first = claim_webhook(store, 2).await.expect("due");
    let reply = store.retry_job(&name, None, &ROOM, time(3)).await.expect("retries");
    assert_eq!(reply.job.webhook, Some(Webhook::pending(URL)));
    assert_eq!(queue(store, 1_000).await, WebhookQueue { pending: 0, is_due: false }, "it has not ended again");
    let lease = claim(store, 3).await.lease;
    store.finish(&lease, &fail(), time(4)).await.expect("finishes");
    let second = claim_webhook(store, 5).await.expect("due");
    // Both are the first attempts at their ends.
    assert_eq!(second.webhook, first.webhook);
    assert!(second.last_sequence > first.last_sequence);
    assert!(!settle(store, &first, WebhookOutcome::Delivered, 6).await, "the end of before");
    assert_eq!(webhook(store, &name).await.state, WebhookState::Pending);
    assert!(settle(store, &second, WebhookOutcome::Delivered, 6).await);
}

pub(in crate::store) async fn busy_hosts_and_tenants_are_passed_over(store: &Store) {
    for (job, url, seconds) in
        [("a", "https://slow.example/a", 1), ("b", "https://slow.example/b", 2), ("c", "http://quick.example:81/", 3)]
    {
        ended(store, job, url, seconds).await;
    }
    let busy = PassedOver { hosts: vec!["slow.example".into(), "other.example".into()], tenants: Vec::new() };
    let busy_tenant = PassedOver { hosts: Vec::new(), tenants: vec!["other".into(), "t".into()] };
    assert_eq!(store.claim_webhook(&busy_tenant, time(4), LEASE).await, Ok(None));
    let claimed = store.claim_webhook(&busy, time(4), LEASE).await.expect("claims").expect("another host's");
    assert_eq!(claimed.name.job, "c");
    assert_eq!(store.claim_webhook(&busy, time(4), LEASE).await, Ok(None));
    assert_eq!(claim_webhook(store, 4).await.map(|job| job.name.job), Some("a".into()));
}

pub(in crate::store) async fn no_delivery_is_claimed_twice(store: &Store) {
    for job in 0..10 {
        ended(store, &format!("job-{job}"), URL, 1).await;
    }
    // Of those who look at the same time some may find all that is due locked: they look again later.
    let mut names = Vec::new();
    while names.len() < 10 {
        let claimed = futures_util::future::join_all((0..4).map(|_| claim_webhook(store, 2))).await;
        let before = names.len();
        names.extend(claimed.into_iter().flatten().map(|job| job.name.job));
        assert!(names.len() > before, "one finds something while anything is due");
    }
    names.sort();
    names.dedup();
    assert_eq!(names.len(), 10);
    assert_eq!(claim_webhook(store, 2).await, None);
}

pub(in crate::store) async fn a_deleted_job_takes_its_webhook_along(store: &Store) {
    let name = ended(store, "a", URL, 1).await;
    let job = claim_webhook(store, 1).await.expect("due");
    let etag = job.etag();
    let retry = WebhookOutcome::Retry { error: "away".into(), after: Duration::from_secs(1) };
    assert!(settle(store, &job, retry, 2).await);
    store.delete_job(&name, Some(&etag)).await.expect("deliveries do not change the etag");
    assert_eq!(queue(store, 1_000).await, WebhookQueue { pending: 0, is_due: false });
    assert_eq!(claim_webhook(store, 1_000).await, None);
    assert!(!settle(store, &job, WebhookOutcome::Delivered, 3).await);
    // Another job of the same name has a webhook of its own.
    create(store, hooked("a", URL), 4).await;
    assert_eq!(webhook(store, &name).await, Webhook::pending(URL));
    assert!(!settle(store, &job, WebhookOutcome::Delivered, 5).await);
    assert_eq!(webhook(store, &name).await, Webhook::pending(URL));
}
