//! Several servers on one PostgreSQL: killed, stopped and woken, cut off from it.

use std::process::Stdio;
use std::time::Duration;

use rustix::process::Signal;
use scpsfm::rpc::proto::job_event::Body;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use tonic::Code;
use tonic::transport::Channel;
use tonic_types::StatusExt;

use crate::support::live::{connected, created, lasting, reaches, small};
use crate::support::postgres::{self, Cluster, PASSWORD};
use crate::support::program::{Serving, run};
use crate::support::scrape::Page;
use crate::support::server::{PATIENCE, soon};
use crate::support::wire::{all, state_of};

/// A short lease, so that what was left lying is soon taken up.
const SHORT_LEASE: [(&str, &str); 1] = [("SCPSFM_ENGINE__LEASE_SECONDS", "2")];

/// Iterations that leave seconds between the first progress and the end, whatever the machine.
const ITERATIONS: u32 = 600;

fn replicas(url: &str, count: usize) -> Vec<Serving> {
    (0..count).map(|_| Serving::on_database(url, &SHORT_LEASE, Stdio::null())).collect()
}

fn scraped(server: &Serving) -> Page {
    tokio::task::block_in_place(|| Page::parse(&server.page("/metrics")))
}

/// Asks until it is so.
async fn eventually(mut holds: impl AsyncFnMut() -> bool) {
    let asking = async {
        while !holds().await {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(2 * PATIENCE, asking).await.expect("this should have been so long ago");
}

/// Every event of a job, up to its end.
async fn story(jobs: &mut JobServiceClient<Channel>, name: &str) -> Vec<proto::JobEvent> {
    let request = proto::WatchJobRequest { name: name.into(), after_sequence: 0 };
    let watching = async { all(jobs.watch_job(request).await.expect("a watch").into_inner()).await };
    let (events, end) = tokio::time::timeout(2 * PATIENCE, watching).await.expect("an end");
    end.expect("the watch ends with the job");
    events.into_iter().filter(|event| event.sequence > 0).collect()
}

/// Asserts that a job succeeded once, with one result, and that its events are numbered without gap or repeat.
fn assert_ended_once(events: &[proto::JobEvent]) {
    let sequences: Vec<u64> = events.iter().map(|event| event.sequence).collect();
    assert_eq!(sequences, (1..=sequences.len() as u64).collect::<Vec<_>>());
    let terminal = |state: &JobState| !matches!(state, JobState::Queued | JobState::Running);
    let ends: Vec<JobState> = events.iter().filter_map(state_of).filter(terminal).collect();
    assert_eq!(ends, [JobState::Succeeded]);
    let results = events.iter().filter(|event| matches!(event.body, Some(Body::Summary(_)))).count();
    assert_eq!(results, 1);
    assert!(
        events.iter().map(|event| event.attempt).is_sorted(),
        "nothing of an attempt after the one that replaced it"
    );
}

/// Stops a server where none of its transactions is open: one in which it stopped would be ended by the database, and
/// the server, awake again, would know from that alone.
async fn stop_between_transactions(cluster: &Cluster, url: &str, server: &Serving) {
    eventually(async || {
        server.running.signal(Signal::STOP);
        // Longer than a transaction of those that go on.
        tokio::time::sleep(Duration::from_millis(300)).await;
        let caught = cluster.waits_for_a_client(url).await;
        if caught {
            server.running.signal(Signal::CONT);
        }
        !caught
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_three_servers_one_is_killed_and_one_sleeps_through_its_lease() {
    let Some(cluster) = postgres::shared("three servers on one database") else { return };
    let url = cluster.database().await;
    let mut servers = replicas(&url, 3);
    let mut jobs = connected(&servers[2]).await;
    let mut names = Vec::new();
    for _ in 0..3 {
        names.push(created(&mut jobs, lasting(ITERATIONS)).await);
    }
    eventually(async || servers.iter().all(|server| scraped(server).value("scpsfm_workers_busy") == 1.0)).await;
    for seed in 0..6 {
        names.push(created(&mut jobs, small(seed)).await);
    }
    stop_between_transactions(&cluster, &url, &servers[1]).await;
    drop(servers.remove(0));

    let mut stories = Vec::new();
    for name in &names {
        let events = story(&mut jobs, name).await;
        assert_ended_once(&events);
        stories.push(events);
    }
    let last_attempts: Vec<u32> = stories.iter().take(3).filter_map(|story| Some(story.last()?.attempt)).collect();
    assert_eq!(last_attempts.iter().filter(|&&attempt| attempt > 1).count(), 2, "taken over: {last_attempts:?}");

    // Awake again, it believes that it holds the job, and writes; unless its own clock tells it first that the lease is
    // over. Either way the attempt is lost.
    servers[0].running.signal(Signal::CONT);
    eventually(async || scraped(&servers[0]).value("scpsfm_attempts_lost_total{reason=\"FENCED\"}") == 1.0).await;
    eventually(async || scraped(&servers[0]).value("scpsfm_workers_busy") == 0.0).await;
    let mut woken = connected(&servers[0]).await;
    for (name, before) in names.iter().zip(stories) {
        assert_eq!(story(&mut woken, name).await, before, "nothing was added, and every server tells the same");
    }
    assert_eq!(scraped(&servers[1]).sum("scpsfm_fenced_writes_total"), 0.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_request_id_on_every_server_at_once_is_one_job() {
    let Some(cluster) = postgres::shared("one request on three servers") else { return };
    let url = cluster.database().await;
    let servers = replicas(&url, 3);
    let mut clients = Vec::new();
    for server in &servers {
        clients.push(connected(server).await);
    }
    let request = proto::CreateJobRequest { request_id: "one".into(), ..small(1) };
    let calls = (0..50).map(|number| {
        let (mut jobs, request) = (clients[number % 3].clone(), request.clone());
        // On a busy machine the store's bounds of time end some of fifty calls: callers come again, as they are told.
        soon(async move {
            loop {
                match jobs.create_job(request.clone()).await {
                    Ok(job) => return job.into_inner().name,
                    Err(status) => assert_eq!(status.code(), Code::Unavailable, "{status}"),
                }
            }
        })
    });
    let mut names = futures_util::future::join_all(calls).await;
    names.dedup();
    assert_eq!(names.len(), 1, "{names:?}");
    let list = proto::ListJobsRequest { parent: "tenants/default".into(), ..Default::default() };
    assert_eq!(clients[1].list_jobs(list).await.expect("a page").into_inner().jobs.len(), 1);
    assert_ended_once(&story(&mut clients[2], &names[0]).await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_watched_and_cancelled_through_a_server_that_does_not_run_it() {
    let Some(cluster) = postgres::shared("a job of another server") else { return };
    let url = cluster.database().await;
    // So long a lease that no heartbeat of this test carries the cancel.
    let lease = [("SCPSFM_ENGINE__LEASE_SECONDS", "3600")];
    let servers: Vec<_> = (0..2).map(|_| Serving::on_database(&url, &lease, Stdio::null())).collect();
    let mut jobs = connected(&servers[0]).await;
    let name = created(&mut jobs, lasting(10_000)).await;
    eventually(async || servers.iter().any(|server| scraped(server).value("scpsfm_workers_busy") == 1.0)).await;
    let runs_on_first = scraped(&servers[0]).value("scpsfm_workers_busy") == 1.0;
    let mut elsewhere = connected(&servers[usize::from(runs_on_first)]).await;
    let request = proto::WatchJobRequest { name: name.clone(), after_sequence: 0 };
    let mut watch = elsewhere.watch_job(request).await.expect("a watch").into_inner();
    loop {
        let event = soon(watch.message()).await.expect("an event").expect("the job has not ended");
        if matches!(&event.body, Some(Body::Progress(progress)) if progress.iteration_count > 0) {
            break;
        }
    }
    elsewhere.cancel_job(proto::CancelJobRequest { name: name.clone(), ..Default::default() }).await.expect("a cancel");
    assert_eq!(reaches(&mut elsewhere, &name, &[JobState::Cancelled]).await, JobState::Cancelled);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_that_goes_away_under_load_is_waited_for_and_the_work_goes_on() {
    let Some(cluster) = Cluster::start("a database that goes away") else { return };
    let url = cluster.database().await;
    let log = tempfile::NamedTempFile::new().expect("a file");
    let servers: Vec<_> =
        (0..2).map(|_| Serving::on_database(&url, &SHORT_LEASE, log.reopen().expect("the log"))).collect();
    let mut jobs = connected(&servers[0]).await;
    let mut names = vec![created(&mut jobs, lasting(ITERATIONS)).await, created(&mut jobs, lasting(ITERATIONS)).await];
    eventually(async || servers.iter().all(|server| scraped(server).value("scpsfm_workers_busy") == 1.0)).await;
    for seed in 0..10 {
        names.push(created(&mut jobs, small(seed)).await);
    }
    tokio::task::block_in_place(|| cluster.stop());

    let status = soon(jobs.create_job(small(99))).await.expect_err("nothing can be stored");
    assert_eq!(status.code(), Code::Unavailable, "{status}");
    assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, "STORE_UNAVAILABLE");
    assert!(status.get_details_retry_info().is_some());
    // Whoever cannot keep a lease must not go on with the work.
    eventually(async || servers.iter().all(|server| scraped(server).value("scpsfm_workers_busy") == 0.0)).await;

    tokio::task::block_in_place(|| cluster.restart());
    eventually(async || jobs.create_job(small(100)).await.map(|job| names.push(job.into_inner().name)).is_ok()).await;
    for name in &names {
        assert_ended_once(&story(&mut jobs, name).await);
    }
    let logged = std::fs::read_to_string(log.path()).expect("the log");
    assert!(logged.contains("store"), "{logged}");
    assert!(!logged.contains(PASSWORD), "{logged}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_takes_every_server_down_fails_and_tells_its_history() {
    let Some(cluster) = postgres::shared("a job that kills its server") else { return };
    let url = cluster.database().await;
    let variables = [SHORT_LEASE[0], ("SCPSFM_ENGINE__MAX_ATTEMPTS", "2")];
    let start = || Serving::on_database(&url, &variables, Stdio::null());
    let server = start();
    let name = created(&mut connected(&server).await, lasting(10_000)).await;
    let mut workers = Vec::new();
    for mut server in [server, start()] {
        workers.push(format!("-{}", server.running.0.id()));
        eventually(async || scraped(&server).value("scpsfm_workers_busy") == 1.0).await;
        server.running.0.kill().expect("killed");
    }
    let server = start();
    let mut jobs = connected(&server).await;
    assert_eq!(reaches(&mut jobs, &name, &[JobState::Failed]).await, JobState::Failed);
    let job = jobs.get_job(proto::GetJobRequest { name }).await.expect("the job").into_inner();
    let error = job.error.expect("a reason");
    assert_eq!(error.reason, "ATTEMPTS_EXHAUSTED");
    assert_eq!(error.attempts.len(), 2, "{error:?}");
    for (past, worker) in error.attempts.iter().zip(&workers) {
        assert!(past.server.ends_with(worker), "{} by {worker}", past.server);
        assert_eq!(past.end(), proto::AttemptEnd::Lost);
        let (start, end) = (past.start_time.expect("a start"), past.end_time.expect("an end"));
        assert!((start.seconds, start.nanos) < (end.seconds, end.nanos));
    }
}

/// The status code of `/readyz` and its words.
fn readiness(server: &Serving) -> (bool, String) {
    let (head, body) = tokio::task::block_in_place(|| server.answer("/readyz"));
    (head.starts_with("HTTP/1.1 200"), body)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_without_its_database_is_not_ready_until_it_is_back() {
    use tonic_health::pb::HealthCheckRequest;
    use tonic_health::pb::health_check_response::ServingStatus;
    use tonic_health::pb::health_client::HealthClient;

    let Some(cluster) = Cluster::start("a server without its database") else { return };
    let url = cluster.database().await;
    let server = Serving::on_database(&url, &[], Stdio::null());
    let channel = Channel::from_shared(server.grpc.clone()).expect("a URL").connect().await.expect("a connection");
    let mut health = HealthClient::new(channel);
    let mut serving = async |service: &str| {
        let answer = health.check(HealthCheckRequest { service: service.into() }).await.expect("known");
        answer.into_inner().status() == ServingStatus::Serving
    };
    for _ in 0..2 {
        assert_eq!(readiness(&server), (true, "ready\n".into()));
        assert_eq!(scraped(&server).value("scpsfm_store_reachable"), 1.0);
        assert!(serving("").await && serving("scpsfm.v1.JobService").await);

        tokio::task::block_in_place(|| cluster.stop());
        eventually(async || !readiness(&server).0).await;
        assert_eq!(readiness(&server).1, "not ready: the store is out of reach\n");
        eventually(async || !serving("").await).await;
        assert!(!serving("scpsfm.v1.JobService").await);
        assert_eq!(scraped(&server).value("scpsfm_store_reachable"), 0.0);
        assert!(tokio::task::block_in_place(|| server.answer("/healthz")).0.starts_with("HTTP/1.1 200"), "it lives");

        tokio::task::block_in_place(|| cluster.restart());
        eventually(async || readiness(&server).0).await;
        eventually(async || serving("").await).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_command_says_how_long_it_waits_for_a_store_that_is_away_and_ends() {
    let Some(cluster) = Cluster::start("a command without a store") else { return };
    let url = cluster.database().await;
    let server = Serving::on_database(&url, &[], Stdio::null());
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, small(1)).await;
    reaches(&mut jobs, &name, &[JobState::Succeeded]).await;
    tokio::task::block_in_place(|| cluster.stop());
    let watched = tokio::task::block_in_place(|| run(["watch", &name, "--server", &server.grpc]));
    assert_eq!(watched.code, Some(69), "{watched:?}");
    assert!(watched.stderr.starts_with("waiting up to 30 s: "), "{watched:?}");
}
