//! Delivery of webhooks: jobs that have ended are sent to the URL that they name, until the receiver accepts them.
//!
//! The store keeps what is to be sent (`store/sql/webhooks.rs`), and leases each delivery to one server at a time; here
//! is the task that sends it. `address` says where to, `signature` how it is signed, `send` makes one attempt.

mod address;
mod send;
mod signature;

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use tokio::task::{Id, JoinSet};
use tokio::time::sleep;

pub(super) use send::Sender;
pub use signature::Secrets;

use super::{Inner, Phase, observe};
use crate::domain::job::Job;
use crate::domain::{InvalidInput, Violation, Webhook};
use crate::store::{self, PassedOver, WebhookOutcome};
use observe::WebhookAttempt;
use send::Failed;

/// How an ended job is encoded for its receiver. The engine does not know the format.
pub type JobEncoder = fn(&Job) -> Result<Vec<u8>, String>;

/// How webhooks are delivered.
#[derive(Debug, Clone)]
pub struct Options {
    pub secrets: Secrets,
    /// How long after the job's end a failed attempt is repeated; `None`: as long as the job is kept.
    pub retry_for: Option<Duration>,
    /// Whether receivers may have other addresses than those of the public internet.
    pub allow_private_addresses: bool,
    pub encode: JobEncoder,
}

impl Options {
    /// A night and a day to notice that a receiver is down, and to repair it.
    pub const DEFAULT_RETRY_FOR: Duration = Duration::from_secs(24 * 60 * 60);
}

/// How often the store is looked into unasked: for what other servers left, and for what is due again.
const POLL: Duration = Duration::from_secs(1);

/// How long a delivery is leased to a server: twice what an attempt may take, so that the store has time to note it.
const LEASE: Duration = send::ATTEMPT_TIMEOUT.saturating_mul(2);

/// Attempts under way at once in one server: at 10 s for an attempt that fails, three a second.
const MOST_ATTEMPTS: usize = 32;

/// The same at one host, so that one that is slow leaves most of them to others.
const MOST_ATTEMPTS_OF_HOST: usize = 4;

/// The same for one tenant, who may name any number of hosts.
const MOST_ATTEMPTS_OF_TENANT: usize = MOST_ATTEMPTS / 2;

/// Pause after the first attempt; each further one is twice as long.
const FIRST_PAUSE: Duration = Duration::from_secs(1);

/// Longest pause: a receiver that is back waits an hour at most.
const LONGEST_PAUSE: Duration = Duration::from_secs(60 * 60);

/// Checks the webhook of a job that is to be created; `options` are those of the server.
///
/// # Errors
/// A violation of `job.webhook` or of its URL.
pub(super) fn check(options: Option<&Options>, tenant: &str, url: &str) -> Result<(), InvalidInput> {
    let Some(options) = options.filter(|options| !options.secrets.of(tenant).is_empty()) else {
        let text = "webhooks are off: the server has no webhooks.secret for the tenant";
        return Err(Violation::of("job.webhook", text).into());
    };
    let parsed = Webhook::parse_url(url);
    let checked = parsed.and_then(|url| send::literal(url.host()).map_or(Ok(()), |ip| options.check_address(ip)));
    checked.map_err(|error| Violation::of("job.webhook.url", error).into())
}

/// Delivers what is due until the engine is closed. What is under way then is waited for.
pub(super) async fn run(inner: Arc<Inner>, sender: Arc<Sender>) {
    let mut phase = inner.phase.subscribe();
    let mut attempts = Attempts::default();
    while *phase.borrow_and_update() != Phase::Closed {
        if let Err(error) = attempts.begin_due(&inner, &sender).await {
            // Of a full disk the sweeper tells; it is looked at again every second.
            match inner.store.has_room() {
                true => tracing::warn!(%error, "cannot look for webhooks"),
                false => tracing::debug!(%error, "cannot look for webhooks"),
            }
        }
        tokio::select! {
            _ = phase.changed() => {}
            () = attempts.one_ended() => {}
            () = inner.webhook_due.notified() => {}
            () = sleep(POLL) => {}
        }
    }
    while !attempts.tasks.is_empty() {
        attempts.one_ended().await;
    }
}

/// Attempts under way; dropped, they are broken off, and made again once their leases have run out.
#[derive(Default)]
struct Attempts {
    tasks: JoinSet<()>,
    /// Host and tenant of each.
    under_way: HashMap<Id, [String; 2]>,
}

impl Attempts {
    /// Begins attempts at what is due, as many as may be under way.
    async fn begin_due(&mut self, inner: &Arc<Inner>, sender: &Arc<Sender>) -> Result<(), store::Error> {
        let queue = inner.store.webhook_queue(inner.now()).await?;
        observe::webhooks_pending(queue.pending);
        while queue.is_due && self.tasks.len() < MOST_ATTEMPTS {
            let claimed = inner.store.claim_webhook(&self.passed_over(), inner.now(), LEASE).await?;
            let Some((webhook, job)) = claimed.and_then(|job| Some((job.webhook.clone()?, job))) else { break };
            let of = [webhook.host(), job.name.tenant.clone()];
            let task = self.tasks.spawn(attempt(inner.clone(), sender.clone(), inner.dated(job), webhook));
            self.under_way.insert(task.id(), of);
        }
        Ok(())
    }

    /// Hosts and tenants that have as many attempts as they may.
    fn passed_over(&self) -> PassedOver {
        let busy = |place: usize, bound: usize| {
            let mut counts: BTreeMap<&String, usize> = BTreeMap::new();
            self.under_way.values().for_each(|of| *counts.entry(&of[place]).or_default() += 1);
            counts.into_iter().filter(|(_, count)| *count >= bound).map(|(name, _)| name.clone()).collect()
        };
        PassedOver { hosts: busy(0, MOST_ATTEMPTS_OF_HOST), tenants: busy(1, MOST_ATTEMPTS_OF_TENANT) }
    }

    /// Waits until an attempt has ended; for ever where none is under way.
    async fn one_ended(&mut self) {
        match self.tasks.join_next_with_id().await {
            Some(Ok((id, ()))) => drop(self.under_way.remove(&id)),
            // By a panic, which has been reported; its lease runs out.
            Some(Err(error)) => drop(self.under_way.remove(&error.id())),
            None => std::future::pending().await,
        }
    }
}

/// Makes an attempt and has the store note what it came to.
async fn attempt(inner: Arc<Inner>, sender: Arc<Sender>, job: Job, webhook: Webhook) {
    let sent = sender.send(&job, &webhook).await;
    let since_end = job.end_time.and_then(|end| inner.now().duration_since(end).ok()).unwrap_or_default();
    let outcome = outcome(sent, webhook.attempts, since_end, sender.options.retry_for);
    let noted = inner.store.settle_webhook(&job, &outcome, inner.now()).await;
    let (name, attempts, receiver) = (&job.name, webhook.attempts, webhook.receiver());
    match &outcome {
        WebhookOutcome::Delivered => {
            tracing::info!(job = %name, attempts, receiver, "webhook delivered");
            observe::webhook_attempt(WebhookAttempt::Delivered);
        }
        WebhookOutcome::Retry { error, after } => {
            let pause_seconds = after.as_secs_f64();
            tracing::warn!(job = %name, attempts, receiver, error, pause_seconds, "webhook not delivered");
            observe::webhook_attempt(WebhookAttempt::Failed);
        }
        WebhookOutcome::GivenUp { error } => {
            tracing::warn!(job = %name, attempts, receiver, error, "webhook given up");
            observe::webhook_attempt(WebhookAttempt::GivenUp);
        }
    }
    match noted {
        Ok(true) => {}
        Ok(false) => tracing::debug!(job = %name, "the webhook is gone, or another server's by now"),
        // It is sent again once the lease has run out.
        Err(error) => tracing::warn!(job = %name, %error, "cannot note what a webhook came to"),
    }
}

/// What is noted of an attempt, the `attempts`th, so long after the job's end.
fn outcome(
    sent: Result<(), Failed>,
    attempts: u32,
    since_end: Duration,
    retry_for: Option<Duration>,
) -> WebhookOutcome {
    match sent {
        Ok(()) => WebhookOutcome::Delivered,
        Err(Failed::Gone(error)) => WebhookOutcome::GivenUp { error },
        Err(Failed::Again(error)) => {
            let after = pause(attempts, random());
            match retry_for.is_some_and(|bound| since_end.saturating_add(after) > bound) {
                true => WebhookOutcome::GivenUp { error },
                false => WebhookOutcome::Retry { error, after },
            }
        }
    }
}

/// The pause after so many attempts, by a number of `0..1`: so that what failed together is not sent together again,
/// between half and all of what has doubled each time.
fn pause(attempts: u32, random: f64) -> Duration {
    let doubled = FIRST_PAUSE.saturating_mul(1_u32.checked_shl(attempts.saturating_sub(1)).unwrap_or(u32::MAX));
    doubled.min(LONGEST_PAUSE).mul_f64(0.5 + 0.5 * random)
}

/// A random number of `0..1`: the last 32 bits of a UUID of version 7 are random.
fn random() -> f64 {
    f64::from(uuid::Uuid::now_v7().as_u128() as u32) / (f64::from(u32::MAX) + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_an_hour_and_differ_by_half() {
        let seconds = |attempts, random| pause(attempts, random).as_secs_f64();
        assert_eq!([1, 2, 3, 11].map(|attempts| seconds(attempts, 1.0)), [1.0, 2.0, 4.0, 1_024.0]);
        assert_eq!([1, 2, 3].map(|attempts| seconds(attempts, 0.0)), [0.5, 1.0, 2.0]);
        for attempts in [13, 32, 33, 1_000, u32::MAX] {
            assert_eq!(seconds(attempts, 1.0), 3_600.0, "{attempts}");
        }
        let numbers: Vec<f64> = (0..100).map(|_| random()).collect();
        assert!(numbers.iter().all(|number| (0.0..1.0).contains(number)), "{numbers:?}");
        assert!(numbers.iter().any(|number| *number < 0.5) && numbers.iter().any(|number| *number >= 0.5));
    }

    #[test]
    fn attempts_are_made_again_until_the_bound_and_not_where_the_receiver_is_gone() {
        let failed = || Err(Failed::Again("away".into()));
        let (hour, day) = (Duration::from_secs(3_600), Duration::from_secs(86_400));
        let is_last = |sent, since_end, bound| match outcome(sent, 1, since_end, bound) {
            WebhookOutcome::GivenUp { .. } => true,
            WebhookOutcome::Retry { after, .. } => {
                assert!(after <= FIRST_PAUSE);
                false
            }
            WebhookOutcome::Delivered => panic!("it failed"),
        };
        assert!(!is_last(failed(), hour, Some(day)) && !is_last(failed(), day - FIRST_PAUSE, Some(day)));
        assert!(is_last(failed(), day, Some(day)) && !is_last(failed(), 1_000 * day, None));
        assert!(is_last(Err(Failed::Gone("410".into())), hour, None));
        assert_eq!(outcome(Ok(()), 1, 1_000 * day, Some(day)), WebhookOutcome::Delivered);
    }

    #[tokio::test]
    async fn a_host_or_tenant_with_as_many_attempts_as_it_may_have_is_passed_over_until_one_ends() {
        let mut attempts = Attempts::default();
        for number in 0..MOST_ATTEMPTS_OF_HOST {
            assert_eq!(attempts.passed_over(), PassedOver::default());
            let task = match number {
                0 => attempts.tasks.spawn(std::future::ready(())),
                _ => attempts.tasks.spawn(std::future::pending()),
            };
            attempts.under_way.insert(task.id(), ["slow.example".into(), format!("tenant-{number}")]);
        }
        let slow = PassedOver { hosts: vec!["slow.example".into()], tenants: Vec::new() };
        assert_eq!(attempts.passed_over(), slow);
        attempts.one_ended().await;
        assert_eq!(attempts.passed_over(), PassedOver::default());
        for number in 0..MOST_ATTEMPTS_OF_TENANT {
            assert_eq!(attempts.passed_over(), PassedOver::default());
            let task = attempts.tasks.spawn(std::future::pending());
            attempts.under_way.insert(task.id(), [format!("{number}.example"), "acme".into()]);
        }
        assert_eq!(attempts.passed_over(), PassedOver { hosts: Vec::new(), tenants: vec!["acme".into()] });
    }
}
