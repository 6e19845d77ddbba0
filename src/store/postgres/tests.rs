//! PostgreSQL under the store's contract, and what is its own: several servers on one database.

#[path = "../../../tests/it/support/postgres.rs"]
pub(crate) mod cluster;

use std::collections::BTreeSet;
use std::ops::Deref;
use std::sync::Arc;

use super::*;
use crate::domain::job::{JobName, JobState};
use crate::store::sql::Lock;
use crate::store::{Claim, contract};
use cluster::Cluster;

/// A store in a database of its own, in a cluster that lives as long as a test needs it.
pub(super) struct Fixture {
    store: Postgres,
    url: DatabaseUrl,
    _cluster: Arc<Cluster>,
}

impl Fixture {
    pub(super) async fn open() -> Option<Self> {
        let cluster = cluster::shared("the contract of the PostgreSQL store")?;
        let url: DatabaseUrl = cluster.database().await.parse().expect("an address");
        Some(Self { store: Postgres::open(&url).await.expect("opens"), url, _cluster: cluster })
    }
}

impl Deref for Fixture {
    type Target = Postgres;

    fn deref(&self) -> &Postgres {
        &self.store
    }
}

contract::store_contract!(Fixture::open);

const LEASE: Duration = Duration::from_secs(30);

#[tokio::test]
async fn what_lives_elsewhere_is_not_taken_back_at_a_start() {
    let Some(fixture) = Fixture::open().await else { return };
    let now = contract::time(1);
    fixture.create_job(contract::record("a"), &contract::ROOM, now).await.expect("created");
    let claimed = fixture.claim(&Claim::one("w", LEASE), now).await.expect("claims").begun.expect("a job");
    let other = Postgres::open(&fixture.url).await.expect("a second server");
    assert_eq!(other.recover(contract::time(30), 3).await, Ok(Vec::new()), "the lease has a second to go");
    fixture.heartbeat(&claimed.lease, contract::time(30), LEASE).await.expect("still holds");
    let recovered = other.recover(contract::time(60), 3).await.expect("recovers");
    assert_eq!(recovered.iter().map(|job| job.state).collect::<Vec<_>>(), [JobState::Queued]);
    let late = fixture.heartbeat(&claimed.lease, contract::time(61), LEASE).await;
    assert_eq!(late, Err(Error::Fenced(claimed.lease)));
}

#[tokio::test]
async fn people_see_times_and_labels() {
    let Some(fixture) = Fixture::open().await else { return };
    fixture.create_job(contract::labelled("a"), &contract::ROOM, contract::time(0)).await.expect("created");
    let select = "SELECT to_char(create_time AT TIME ZONE 'UTC', 'YYYY-MM-DD HH24:MI:SS') || ' ' || (labels->>'site') \
                  AS line FROM job_list";
    let mut connection = fixture.pool.acquire().await.expect("a connection");
    let rows = connection.rows(Statement::new(select)).await.expect("a row");
    assert_eq!(rows[0].text("line"), Ok("2023-11-14 22:13:20 north".into()));
}

#[tokio::test]
async fn a_server_whose_clock_is_wrong_takes_and_loses_nothing_early() {
    let Some(fixture) = Fixture::open().await else { return };
    let right = Postgres::open(&fixture.url).await.expect("a second server");
    // Its clock is an hour behind the database's: its second 0 is everyone's second 3600.
    fixture.clock.pretend(Duration::from_secs(3600));
    fixture.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
    let claimed =
        fixture.claim(&Claim::one("w", LEASE), contract::time(0)).await.expect("claims").begun.expect("a job");
    assert!(right.sweep(contract::time(3629), 3).await.expect("sweeps").lost.is_empty(), "a second to go");
    fixture.heartbeat(&claimed.lease, contract::time(10), LEASE).await.expect("holds");
    assert!(right.sweep(contract::time(3639), 3).await.expect("sweeps").lost.is_empty(), "a second to go");
    assert_eq!(right.sweep(contract::time(3640), 3).await.expect("sweeps").lost.len(), 1);
    // A sweep looks at the clocks before anything else; these two are on one machine.
    fixture.sweep(contract::time(0), 3).await.expect("sweeps");
    assert_eq!(fixture.lease_clock(contract::time(0)), contract::time(0));
}

#[tokio::test]
async fn many_servers_share_one_queue_and_one_set_of_request_ids() {
    let Some(fixture) = Fixture::open().await else { return };
    let opened = (0..3).map(|_| persistent(|| Postgres::open(&fixture.url)));
    let servers: Vec<_> = futures_util::future::join_all(opened).await.into_iter().map(|s| s.expect("opens")).collect();
    // Five at a time of the same body and id, on all servers, into a queue of at most ten.
    let bounds = crate::store::QueueBounds { max_jobs: 10, ..contract::ROOM };
    let calls = (0..75).map(|number| {
        let request = Some(crate::store::Request { id: format!("r-{}", number / 5), digest: [1; 32] });
        let new = crate::store::NewRecord { request, ..contract::record(&format!("job-{number}")) };
        let (server, bounds) = (&servers[number % 3], &bounds);
        persistent(move || server.create_job(new.clone(), bounds, contract::time(0)))
    });
    let created = futures_util::future::join_all(calls).await;
    let names: BTreeSet<_> = created.iter().flatten().map(|created| created.job.name.clone()).collect();
    assert_eq!(names.len(), 10, "the bound holds over all servers");
    let refused = created.iter().filter_map(|created| created.as_ref().err());
    assert!(refused.clone().all(|error| matches!(error, Error::QueueFull(_))), "{:?}", refused.collect::<Vec<_>>());
    let requests = created.chunks(5).filter(|same| same.iter().any(Result::is_ok)).count();
    assert_eq!(requests, 10, "one request id is one job");
    assert_eq!(fixture.queue_stats().await.expect("counts").queued, 10);

    let claim = &Claim::one("w", LEASE);
    let claims = (0..30).map(|number| {
        let server = &servers[number % 3];
        persistent(move || server.claim(claim, contract::time(1)))
    });
    let claims = futures_util::future::join_all(claims).await;
    let claimed = claims.into_iter().filter_map(|claims| claims.expect("claims").begun).map(|claimed| claimed.job.name);
    told_once(claimed.collect());
    let tenants = fixture.stats().await.expect("counts").tenants;
    assert_eq!(tenants.iter().map(|of| (of.queued, of.running)).collect::<Vec<_>>(), [(0, 10)]);
    // And what they lose is taken back once, whoever sweeps.
    let sweeps = servers.iter().map(|server| persistent(move || server.sweep(contract::time(60), 3)));
    let swept = futures_util::future::join_all(sweeps).await;
    told_once(swept.into_iter().flat_map(|swept| swept.expect("sweeps").lost).map(|job| job.name).collect());
    for name in &names {
        let events = fixture.events_after(name, 0, 10).await.expect("events");
        let job = fixture.job(name).await.expect("is there");
        assert_eq!((job.state, job.attempt, events.len()), (JobState::Queued, 1, 3), "queued, running, queued");
    }
}

/// What several servers told of jobs: each at most once. Not always each: an answer that came too late is not heard,
/// though what it tells of was done.
fn told_once(mut names: Vec<JobName>) {
    let told = names.len();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), told, "{names:?}");
}

/// Does an operation, again where the database had no time for it: on a busy machine the store's own bounds of time end
/// some, and callers come again.
async fn persistent<T, F>(operation: impl Fn() -> F) -> Result<T, Error>
where
    F: Future<Output = Result<T, Error>>,
{
    // Each waits for seconds before it is told so: minutes of them are a database that is gone, which fails the test.
    const TRIES: usize = 100;
    let mut outcome = operation().await;
    for _ in 1..TRIES {
        if !matches!(outcome, Err(Error::Unavailable(_))) {
            break;
        }
        outcome = operation().await;
    }
    outcome
}

#[tokio::test]
async fn changes_are_told_to_other_servers_by_name_and_after_the_commit() {
    let Some(fixture) = Fixture::open().await else { return };
    let other = Postgres::open(&fixture.url).await.expect("a second server");
    assert_eq!(other.notification().await, Notification::Missed, "from here on it listens");
    let name = contract::record("a").name;
    fixture.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
    let notified = [other.notification().await, other.notification().await];
    assert_eq!(notified, [Notification::Events(name.clone()), Notification::Queued]);
    assert_eq!(other.job(&name).await.expect("is there").last_sequence, 1);
    fixture.claim(&Claim::one("w", LEASE), contract::time(1)).await.expect("claims").begun.expect("a job");
    assert_eq!(other.notification().await, Notification::Events(name.clone()));
    fixture.request_cancel(&name, None, contract::time(2)).await.expect("flags");
    assert_eq!(other.notification().await, Notification::Cancel(name));
}

#[tokio::test]
async fn a_server_that_stops_within_a_transaction_holds_up_nobody_for_long() {
    let Some(fixture) = Fixture::open().await else { return };
    let other = Postgres::open(&fixture.url).await.expect("a second server");
    let mut stuck = other.pool(Size::Small).begin().await.expect("a transaction");
    stuck.take_lock(Lock::Admission).await.expect("the lock");
    // Only the database itself can end this one: its bound is below what a creation may take.
    fixture.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created in the end");
    assert!(stuck.rows(Statement::new("SELECT 1")).await.is_err(), "it was ended");
}

#[tokio::test]
async fn a_database_that_is_away_is_told_soon_and_used_again_by_itself() {
    let Some(cluster) = Cluster::start("a database that goes away") else { return };
    let url: DatabaseUrl = cluster.database().await.parse().expect("an address");
    let store = Postgres::open(&url).await.expect("opens");
    store.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
    assert_eq!(store.notification().await, Notification::Missed);
    cluster.stop();
    let error = store.job(&contract::record("a").name).await.expect_err("away");
    assert!(matches!(&error, Error::Unavailable(cause) if !cause.contains(cluster::PASSWORD)), "{error}");
    cluster.restart();
    store.job(&contract::record("a").name).await.expect("back");
    assert_eq!(store.notification().await, Notification::Missed, "what was sent meanwhile is lost, which is reported");
}

#[tokio::test]
async fn a_wrong_password_is_told_without_the_right_or_the_wrong_one() {
    let Some(fixture) = Fixture::open().await else { return };
    let wrong: DatabaseUrl = fixture.url.reveal().replace(cluster::PASSWORD, "swordfish").parse().expect("an address");
    let error = Postgres::open(&wrong).await.expect_err("refused").to_string();
    assert!(error.contains("password"), "{error}");
    for shown in [error, format!("{:?}", fixture.store), format!("{wrong:?}")] {
        assert!(!shown.contains("swordfish") && !shown.contains(cluster::PASSWORD), "{shown}");
    }
}
