//! A server that is killed in the middle of a job, and one that is sent away in the middle of one.

use std::path::Path;

use rustix::process::Signal;
use scpsfm::rpc::proto::job_event::Body;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use tonic::Streaming;
use tonic::transport::Channel;

use crate::support::live::{connected, created, lasting};
use crate::support::program::{Serving, run};
use crate::support::scrape::Page;
use crate::support::server::soon;
use crate::support::wire::{all, state_of};

async fn watch(jobs: &mut JobServiceClient<Channel>, name: &str, after_sequence: u64) -> Streaming<proto::JobEvent> {
    jobs.watch_job(proto::WatchJobRequest { name: name.into(), after_sequence }).await.expect("a watch").into_inner()
}

/// The events of a watch up to the first progress in the middle of an optimisation, which is on disk before it is told.
async fn until_optimising(mut events: Streaming<proto::JobEvent>) -> Vec<proto::JobEvent> {
    let mut seen = Vec::new();
    loop {
        let event = soon(events.message()).await.expect("an event").expect("the job has not ended");
        let optimising = matches!(&event.body, Some(Body::Progress(progress)) if progress.iteration_count > 0);
        seen.push(event);
        if optimising {
            return seen;
        }
    }
}

fn sequences(events: &[proto::JobEvent]) -> Vec<u64> {
    events.iter().map(|event| event.sequence).filter(|&sequence| sequence > 0).collect()
}

/// Asserts that a watcher who saw `before` and came back saw everything once, and that the job ended once.
async fn assert_exactly_once(jobs: &mut JobServiceClient<Channel>, name: &str, before: Vec<proto::JobEvent>) {
    let last = *sequences(&before).last().expect("sequenced events");
    let (after, end) = soon(all(watch(jobs, name, last).await)).await;
    end.expect("the watch ends with the job");
    let mut seen = before;
    seen.extend(after);
    let numbers = sequences(&seen);
    assert_eq!(numbers, (1..=numbers.len() as u64).collect::<Vec<_>>(), "nothing missed, nothing repeated");
    let (replayed, _) = soon(all(watch(jobs, name, 0).await)).await;
    assert_eq!(sequences(&replayed), numbers);
    let sequenced: Vec<_> = seen.into_iter().filter(|event| event.sequence > 0).collect();
    assert_eq!(replayed, sequenced, "what was seen live is what is kept");

    let ends = sequenced.iter().filter_map(state_of).filter(|&state| state == JobState::Succeeded).count();
    let results = sequenced.iter().filter(|event| matches!(event.body, Some(Body::Summary(_)))).count();
    assert_eq!((ends, results), (1, 1));
    let job = jobs.get_job(proto::GetJobRequest { name: name.into() }).await.expect("the job").into_inner();
    assert_eq!((job.state(), job.attempt_count), (JobState::Succeeded, 2));
    assert_eq!(job.last_sequence, *numbers.last().expect("events"));
    let request = proto::ReadJobResultRequest { name: name.into(), offset: 0 };
    let (chunks, end) = all(jobs.read_job_result(request).await.expect("a result").into_inner()).await;
    end.expect("a whole result");
    let bytes: usize = chunks.iter().map(|chunk| chunk.data.len()).sum();
    assert_eq!(bytes as i64, chunks[0].size_bytes);
}

/// Iterations that leave seconds between the first progress and the end, whatever the machine.
const ITERATIONS: u32 = 600;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_whose_server_was_killed_is_finished_once_by_the_next() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let data_dir = directory.path().join("data");
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, lasting(ITERATIONS)).await;
    let before = until_optimising(watch(&mut jobs, &name, 0).await).await;
    // SIGKILL, as by a power cut.
    drop(server);

    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    assert_exactly_once(&mut jobs, &name, before).await;
    assert_eq!(lost_attempts(&server), 1.0);
}

/// Attempts that this server found left behind.
fn lost_attempts(server: &Serving) -> f64 {
    let page = tokio::task::block_in_place(|| Page::parse(&server.page("/metrics")));
    page.value("scpsfm_attempts_lost_total{reason=\"LEASE_EXPIRED\"}")
}

/// A job that a server was sent away from in the middle, and what its watcher had seen by then.
async fn given_back(data_dir: &Path) -> (String, Vec<proto::JobEvent>) {
    let impatient = [("SCPSFM_ENGINE__DRAIN_SECONDS", "0")];
    let mut server = Serving::start_with(data_dir, &impatient, std::process::Stdio::null());
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, lasting(ITERATIONS)).await;
    let before = until_optimising(watch(&mut jobs, &name, 0).await).await;
    server.running.signal(Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success(), "a drain is a clean end");
    (name, before)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_sent_away_gives_its_job_back_and_the_next_finishes_it() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let data_dir = directory.path().join("data");
    let (name, before) = given_back(&data_dir).await;

    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    assert_exactly_once(&mut jobs, &name, before).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_told_twice_gives_its_job_back_at_once_and_no_attempt_is_lost() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let data_dir = directory.path().join("data");
    let patient = [("SCPSFM_ENGINE__DRAIN_SECONDS", "3600")];
    let mut server = Serving::start_with(&data_dir, &patient, std::process::Stdio::null());
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, lasting(ITERATIONS)).await;
    let before = until_optimising(watch(&mut jobs, &name, 0).await).await;
    server.running.signal(Signal::TERM);
    let drains = async {
        while tokio::task::block_in_place(|| server.answer("/readyz").0).contains("200") {
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
        // As fast as hands are.
        tokio::time::sleep(std::time::Duration::from_millis(200)).await;
    };
    soon(drains).await;
    server.running.signal(Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success(), "the end of a drain is a clean one");

    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    assert_exactly_once(&mut jobs, &name, before).await;
    assert_eq!(lost_attempts(&server), 0.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_whose_address_is_taken_ends_cleanly_and_costs_its_jobs_nothing() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let data_dir = directory.path().join("data");
    let (name, before) = given_back(&data_dir).await;

    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = taken.local_addr().expect("bound").to_string();
    let data = data_dir.display().to_string();
    let arguments = ["serve", "--listen", &address, "--metrics-listen", "127.0.0.1:0", "--data-dir", &data];
    for start in 1..=3 {
        let ended = tokio::task::block_in_place(|| run(arguments));
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert!(ended.stderr.contains(&format!("cannot listen on {address}")), "{ended:?}");
        // Its log is written back and gone where a store was closed, and left where a process was just over.
        assert!(!data_dir.join("scpsfm.db-wal").exists(), "start {start} did not close the store");
    }
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    let last = *sequences(&before).last().expect("sequenced events");
    let (_, end) = soon(all(watch(&mut jobs, &name, last).await)).await;
    end.expect("the watch ends with the job");
    // However many attempts began and were given back, none was lost.
    let job = jobs.get_job(proto::GetJobRequest { name }).await.expect("the job").into_inner();
    assert_eq!(job.state(), JobState::Succeeded);
    assert_eq!(lost_attempts(&server), 0.0);
}
