//! What every store must do, as tests that each implementation runs through [`store_contract!`].

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime};

use super::record::{Bound, NewRecord, QueueBounds, Request};
use super::{ATTEMPTS_EXHAUSTED, Claimed, Ending, Error, JobQuery, Lease, Order, Outcome, Store, payload};
use crate::domain::job::{EventBody, Failure, Job, JobName, JobState, Summary};
use crate::domain::{Progress, SolveSettings, Stage, Status};

/// Runs the contract: `$open` is an async function without arguments whose result derefs to a store that is empty.
macro_rules! store_contract {
    ($open:path) => {
        $crate::store::contract::store_contract!(@each $open;
            a_created_job_reads_back,
            a_request_id_stands_for_one_body_and_one_job,
            one_request_id_from_many_callers_is_one_job,
            a_taken_job_id_is_refused,
            admission_bounds_what_waits,
            claims_go_by_priority_then_age,
            no_job_is_claimed_twice,
            a_lease_that_was_taken_over_writes_nothing,
            a_success_stores_its_result_then_its_state,
            progress_is_an_event_and_stands_in_the_job,
            every_outcome_ends_in_its_state,
            giving_back_is_free_and_vanishing_is_not,
            a_cancel_ends_what_waits_and_flags_what_runs,
            deadlines_end_what_waits,
            listings_page_and_filter,
            events_come_in_order_and_in_portions,
            what_does_not_exist_is_not_found,
        );
    };
    (@each $open:path; $($test:ident,)*) => {
        $(
            #[tokio::test]
            async fn $test() {
                let fixture = $open().await;
                $crate::store::contract::$test(&*fixture).await;
            }
        )*
    };
}
pub(super) use store_contract;

/// Bounds that refuse nothing.
pub(super) const ROOM: QueueBounds =
    QueueBounds { max_jobs: u64::MAX, max_bytes: u64::MAX, max_observations: u64::MAX };

const LEASE: Duration = Duration::from_secs(30);
const MAX_ATTEMPTS: u32 = 3;

/// A moment some seconds after a fixed one.
pub(super) fn time(seconds: u64) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000 + seconds)
}

/// A small job of tenant `t`.
pub(super) fn record(job: &str) -> NewRecord {
    NewRecord {
        name: JobName { tenant: "t".into(), job: job.into() },
        request: None,
        input: vec![7; 100],
        view_count: 3,
        track_count: 20,
        observation_count: 60,
        settings: SolveSettings { seed: 5, noise_px: Some(0.5), ..SolveSettings::default() },
        deadline: None,
        priority: 0,
        labels: BTreeMap::new(),
        trace_parent: None,
    }
}

async fn create(store: &dyn Store, new: NewRecord, seconds: u64) -> Job {
    store.create_job(new, &ROOM, time(seconds)).await.expect("created").job
}

async fn claim(store: &dyn Store, seconds: u64) -> Claimed {
    store.claim("worker", time(seconds), LEASE).await.expect("claims").expect("a job waits")
}

fn progress(iteration: u32) -> Progress {
    Progress {
        stage: Stage::Search,
        fraction: 0.5,
        iteration,
        losses: None,
        inliers: 12,
        focal_px: Some(1234.5),
        best_score: Some(f64::INFINITY),
        elapsed_seconds: 0.25,
    }
}

fn summary() -> Summary {
    Summary {
        status: Status::NoReconstruction,
        grade: None,
        focal_px: None,
        sigma_log_focal: None,
        inlier_tracks: 0,
        registered_views: 0,
        reprojection_rms_px: None,
        winning_prior: None,
        iterations: 1,
        seconds: 0.5,
        result_bytes: 10,
    }
}

fn success(result: Vec<u8>) -> Ending {
    Ending { outcome: Outcome::Succeeded { summary: summary(), result }, progress: None }
}

/// The events of a job as `(sequence, attempt, what)`.
async fn story(store: &dyn Store, name: &JobName) -> Vec<(u64, u32, String)> {
    let events = store.events_after(name, 0, 1000).await.expect("events");
    events
        .into_iter()
        .map(|event| {
            assert_eq!(&event.name, name);
            let what = match event.body {
                EventBody::State { state, failure } => {
                    failure.map_or(state.name().into(), |failure| format!("{}:{}", state.name(), failure.reason))
                }
                EventBody::Progress(progress) => format!("progress {}", progress.iteration),
                EventBody::Result(_) => "result".into(),
                EventBody::Weights { .. } => "weights".into(),
            };
            (event.sequence.expect("stored events are numbered"), event.attempt, what)
        })
        .collect()
}

fn told(story: &[(u64, u32, &str)]) -> Vec<(u64, u32, String)> {
    story.iter().map(|&(sequence, attempt, what)| (sequence, attempt, what.to_owned())).collect()
}

pub(super) async fn a_created_job_reads_back(store: &dyn Store) {
    let now = time(0) + Duration::from_micros(1);
    let labels = BTreeMap::from([("scene".to_owned(), "door".to_owned()), ("é \"'".to_owned(), "%_".to_owned())]);
    // More than two rows, and not a whole number of them.
    let input: Vec<u8> = (0..2 * payload::CHUNK_BYTES + 17).map(|k| (k % 251) as u8).collect();
    let new = NewRecord {
        input: input.clone(),
        labels: labels.clone(),
        priority: -3,
        deadline: Some(time(60)),
        trace_parent: Some("00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01".into()),
        ..record("a")
    };
    let created = store.create_job(new.clone(), &ROOM, now).await.expect("created");
    assert!(created.new);
    let expected = Job {
        name: new.name.clone(),
        state: JobState::Queued,
        attempt: 0,
        settings: new.settings,
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
    };
    assert_eq!(created.job, expected);
    assert_eq!(store.job(&new.name).await, Ok(expected));
    assert_eq!(store.input(&new.name).await, Ok(input));
    assert_eq!(store.result(&new.name).await, Ok(None));
    assert_eq!(story(store, &new.name).await, told(&[(1, 0, "QUEUED")]));
    let claimed = claim(store, 1).await;
    assert_eq!(claimed.trace_parent, new.trace_parent);
    assert_eq!(claimed.queue_time, now);
}

pub(super) async fn a_request_id_stands_for_one_body_and_one_job(store: &dyn Store) {
    let request = |byte| Some(Request { id: "r".into(), digest: [byte; 32] });
    let first = create(store, NewRecord { request: request(1), ..record("a") }, 0).await;
    claim(store, 1).await;
    // Even where nothing more is admitted, and under another generated id.
    let full = QueueBounds { max_jobs: 0, ..ROOM };
    let again = NewRecord { request: request(1), ..record("b") };
    let repeated = store.create_job(again, &full, time(2)).await.expect("known");
    assert!(!repeated.new);
    assert_eq!(repeated.job.name, first.name);
    assert_eq!(repeated.job.state, JobState::Running, "the job as it stands now");
    let other_body = NewRecord { request: request(2), ..record("c") };
    let error = store.create_job(other_body, &ROOM, time(2)).await.expect_err("another body");
    assert!(matches!(error, Error::AlreadyExists(_)), "{error}");
    let mut other_tenant = NewRecord { request: request(2), ..record("a") };
    other_tenant.name.tenant = "u".into();
    let theirs = store.create_job(other_tenant, &ROOM, time(2)).await.expect("request ids are the tenant's");
    assert!(theirs.new);
}

pub(super) async fn one_request_id_from_many_callers_is_one_job(store: &dyn Store) {
    let call = |number: usize| {
        let request = Some(Request { id: "r".into(), digest: [1; 32] });
        store.create_job(NewRecord { request, ..record(&format!("job-{number}")) }, &ROOM, time(0))
    };
    let created = futures_util::future::join_all((0..50).map(call)).await;
    let created: Vec<_> = created.into_iter().map(|created| created.expect("created or known")).collect();
    assert_eq!(created.iter().filter(|created| created.new).count(), 1);
    assert!(created.iter().all(|other| other.job.name == created[0].job.name));
    assert_eq!(store.load().await.expect("counts").queued, 1);
}

pub(super) async fn a_taken_job_id_is_refused(store: &dyn Store) {
    create(store, record("a"), 0).await;
    let error = store.create_job(record("a"), &ROOM, time(1)).await.expect_err("taken");
    assert_eq!(error, Error::AlreadyExists("tenants/t/jobs/a already exists".into()));
}

pub(super) async fn admission_bounds_what_waits(store: &dyn Store) {
    let refused = |bounds: QueueBounds| async move {
        match store.create_job(record("late"), &bounds, time(1)).await {
            Err(Error::QueueFull(bound)) => bound,
            other => panic!("{other:?}"),
        }
    };
    let empty = QueueBounds { max_bytes: 0, max_observations: 0, ..ROOM };
    store.create_job(record("a"), &empty, time(0)).await.expect("one job alone always fits");
    create(store, record("b"), 0).await;
    let load = store.load().await.expect("counts");
    assert_eq!((load.queued, load.queued_bytes, load.queued_observations, load.running), (2, 200, 120, 0));
    assert_eq!(refused(QueueBounds { max_jobs: 2, ..ROOM }).await, Bound::Jobs { waiting: 2, max: 2 });
    assert_eq!(refused(QueueBounds { max_bytes: 299, ..ROOM }).await, Bound::Bytes { waiting: 200, max: 299 });
    let bound = refused(QueueBounds { max_observations: 179, ..ROOM }).await;
    assert_eq!(bound, Bound::Observations { waiting: 120, max: 179 });
    assert!(matches!(store.job(&record("late").name).await, Err(Error::NotFound(_))), "nothing was stored");
    claim(store, 2).await;
    let load = store.load().await.expect("counts");
    assert_eq!((load.queued, load.queued_bytes, load.queued_observations, load.running), (1, 100, 60, 1));
    let exact = QueueBounds { max_jobs: 2, max_bytes: 200, max_observations: 120 };
    store.create_job(record("c"), &exact, time(3)).await.expect("what runs does not wait");
}

pub(super) async fn claims_go_by_priority_then_age(store: &dyn Store) {
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

pub(super) async fn no_job_is_claimed_twice(store: &dyn Store) {
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

pub(super) async fn a_lease_that_was_taken_over_writes_nothing(store: &dyn Store) {
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
        assert_eq!(store.result(&name).await, Ok(None));
    }
    let new = Lease { name: name.clone(), attempt: 2 };
    store.finish(&new, &success(vec![2]), time(62)).await.expect("the new lease holds");
    assert_eq!(store.result(&name).await, Ok(Some(vec![2])));
    assert_eq!(store.finish(&new, &success(vec![3]), time(63)).await, Err(Error::Fenced(new)), "ended once");
    let expected = [
        (1, 0, "QUEUED"),
        (2, 1, "RUNNING"),
        (3, 1, "progress 1"),
        (4, 1, "QUEUED"),
        (5, 2, "RUNNING"),
        (6, 2, "result"),
        (7, 2, "SUCCEEDED"),
    ];
    assert_eq!(story(store, &name).await, told(&expected));
}

pub(super) async fn a_success_stores_its_result_then_its_state(store: &dyn Store) {
    let name = create(store, record("a"), 0).await.name;
    let lease = claim(store, 1).await.lease;
    let result: Vec<u8> = (0..3 * payload::CHUNK_BYTES).map(|k| (k % 253) as u8).collect();
    let last = progress(400);
    let ending = Ending { progress: Some(last), ..success(result.clone()) };
    let job = store.finish(&lease, &ending, time(2)).await.expect("finishes");
    assert_eq!((job.state, job.end_time), (JobState::Succeeded, Some(time(2))));
    assert_eq!((job.summary.clone(), job.progress), (Some(summary()), Some(last)));
    assert_eq!(store.job(&name).await, Ok(job));
    assert_eq!(store.result(&name).await, Ok(Some(result)));
    let expected = [(1, 0, "QUEUED"), (2, 1, "RUNNING"), (3, 1, "result"), (4, 1, "SUCCEEDED")];
    assert_eq!(story(store, &name).await, told(&expected));
}

pub(super) async fn progress_is_an_event_and_stands_in_the_job(store: &dyn Store) {
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

pub(super) async fn every_outcome_ends_in_its_state(store: &dyn Store) {
    let failure = Failure { reason: "INTERNAL".into(), message: "a defect".into() };
    let outcomes = [
        (Outcome::Failed(failure.clone()), JobState::Failed, "FAILED:INTERNAL"),
        (Outcome::Cancelled, JobState::Cancelled, "CANCELLED"),
        (Outcome::Expired, JobState::Expired, "EXPIRED"),
    ];
    for (outcome, state, event) in outcomes {
        let name = create(store, record(&state.name().to_lowercase()), 0).await.name;
        let lease = claim(store, 1).await.lease;
        assert_eq!(lease.name, name);
        let job = store.finish(&lease, &Ending { outcome, progress: None }, time(2)).await.expect("finishes");
        assert_eq!((job.state, job.end_time), (state, Some(time(2))));
        assert_eq!(job.failure, (state == JobState::Failed).then(|| failure.clone()));
        assert_eq!(story(store, &name).await, told(&[(1, 0, "QUEUED"), (2, 1, "RUNNING"), (3, 1, event)]));
    }
    assert_eq!(store.load().await, Ok(super::Load::default()));
}

pub(super) async fn giving_back_is_free_and_vanishing_is_not(store: &dyn Store) {
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
    assert_eq!(job.failure.map(|failure| failure.reason).as_deref(), Some(ATTEMPTS_EXHAUSTED));
    let last = story(store, &name).await.pop().expect("events");
    assert_eq!(last.2, "FAILED:ATTEMPTS_EXHAUSTED");
    assert_eq!(store.claim("worker", time(101), LEASE).await, Ok(None));
}

pub(super) async fn a_cancel_ends_what_waits_and_flags_what_runs(store: &dyn Store) {
    let waiting = create(store, record("waiting"), 0).await.name;
    let reply = store.request_cancel(&waiting, time(1)).await.expect("cancels");
    assert!(reply.ended_now);
    assert_eq!((reply.job.state, reply.job.end_time), (JobState::Cancelled, Some(time(1))));
    let again = store.request_cancel(&waiting, time(2)).await.expect("is idempotent");
    assert_eq!((again.ended_now, again.job), (false, reply.job));
    assert_eq!(story(store, &waiting).await, told(&[(1, 0, "QUEUED"), (2, 0, "CANCELLED")]));

    // Released, its worker vanished, or ended by its worker: a flagged job never runs again.
    for way in ["released", "vanished", "ended"] {
        let name = create(store, record(way), 0).await.name;
        let lease = claim(store, 1).await.lease;
        assert!(!store.heartbeat(&lease, time(1), LEASE).await.expect("holds").cancel_requested);
        let reply = store.request_cancel(&name, time(2)).await.expect("flags");
        assert!(!reply.ended_now && reply.job.cancel_requested && reply.job.state == JobState::Running);
        assert!(store.heartbeat(&lease, time(2), LEASE).await.expect("holds").cancel_requested);
        let job = match way {
            "released" => store.release(&lease, time(3)).await.expect("gives back"),
            "vanished" => store.sweep(time(99), MAX_ATTEMPTS).await.expect("sweeps").lost.remove(0),
            _ => {
                let ending = Ending { outcome: Outcome::Cancelled, progress: None };
                store.finish(&lease, &ending, time(3)).await.expect("ends")
            }
        };
        assert_eq!((job.state, job.cancel_requested), (JobState::Cancelled, false), "{way}");
    }
}

pub(super) async fn deadlines_end_what_waits(store: &dyn Store) {
    let due = create(store, NewRecord { deadline: Some(time(10)), priority: 9, ..record("due") }, 0).await.name;
    let later = create(store, NewRecord { deadline: Some(time(50)), ..record("later") }, 0).await.name;
    let claimed = claim(store, 10).await;
    assert_eq!(claimed.job.name, later, "what is past its deadline is not begun");
    let swept = store.sweep(time(10), MAX_ATTEMPTS).await.expect("sweeps");
    assert_eq!(swept.expired.iter().map(|job| &job.name).collect::<Vec<_>>(), [&due]);
    assert_eq!(swept.expired[0].state, JobState::Expired);
    assert_eq!(story(store, &due).await, told(&[(1, 0, "QUEUED"), (2, 0, "EXPIRED")]));
    assert_eq!(store.heartbeat(&claimed.lease, time(11), LEASE).await.expect("holds").deadline, Some(time(50)));
    let lost = store.sweep(time(50), MAX_ATTEMPTS).await.expect("sweeps").lost;
    assert_eq!(lost[0].state, JobState::Expired, "no attempt is made after the deadline");
}

pub(super) async fn listings_page_and_filter(store: &dyn Store) {
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
            assert!(page.jobs.len() <= 2);
            listed.extend(names(&page.jobs));
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
    let listed = |query: JobQuery| async move { names(&store.jobs(&query).await.expect("lists").jobs) };
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

pub(super) async fn events_come_in_order_and_in_portions(store: &dyn Store) {
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

pub(super) async fn what_does_not_exist_is_not_found(store: &dyn Store) {
    create(store, record("a"), 0).await;
    let name = JobName { tenant: "u".into(), job: "a".into() };
    let missing = Error::NotFound(name.clone());
    assert_eq!(store.job(&name).await, Err(missing.clone()));
    assert_eq!(store.input(&name).await, Err(missing.clone()));
    assert_eq!(store.result(&name).await, Err(missing.clone()));
    assert_eq!(store.events_after(&name, 0, 1).await, Err(missing.clone()));
    assert_eq!(store.request_cancel(&name, time(0)).await, Err(missing));
    let lease = Lease { name, attempt: 1 };
    assert_eq!(store.heartbeat(&lease, time(0), LEASE).await, Err(Error::Fenced(lease)));
}
