//! Servers that are killed at random while jobs run, on either store: every job that was acknowledged ends once, and
//! every watcher sees each event once.

use std::path::PathBuf;
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use tokio::task::JoinSet;
use tonic::transport::Channel;

use crate::support::live::small;
use crate::support::postgres;
use crate::support::program::Serving;
use crate::support::wire::state_of;

/// Jobs on their way at once: enough that every server always has work.
const SUBMITTERS: usize = 8;

/// How long the whole may take; what takes longer hangs.
const PATIENCE: Duration = Duration::from_secs(1800);

/// A short lease, and no limit on attempts: the kills are nobody's fault.
const VARIABLES: [(&str, &str); 2] = [("SCPSFM_ENGINE__LEASE_SECONDS", "1"), ("SCPSFM_ENGINE__MAX_ATTEMPTS", "1000")];

/// Where the servers keep their jobs.
enum Place {
    /// One server at a time.
    Directory(PathBuf),
    Database(String),
}

impl Place {
    fn serve(&self) -> Serving {
        match self {
            Place::Directory(path) => Serving::start_with(path, &VARIABLES, Stdio::null()),
            Place::Database(url) => Serving::on_database(url, &VARIABLES, Stdio::null()),
        }
    }
}

/// Where the servers listen at the moment.
type Addresses = Arc<Mutex<Vec<String>>>;

/// A client of one of the servers, whichever answers.
async fn any_client(addresses: &Addresses, turn: &mut usize) -> JobServiceClient<Channel> {
    loop {
        *turn += 1;
        let address = {
            let addresses = addresses.lock().expect("no test panicked here");
            addresses[*turn % addresses.len()].clone()
        };
        if let Ok(client) = JobServiceClient::connect(address).await {
            return client;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// Creates a job and follows it to its end, from server to server. Returns its name and its events.
async fn follow(addresses: Addresses, number: usize) -> (String, Vec<proto::JobEvent>) {
    let mut turn = number;
    let request = proto::CreateJobRequest { request_id: format!("r-{number}"), ..small(number as u64) };
    let name = loop {
        match any_client(&addresses, &mut turn).await.create_job(request.clone()).await {
            Ok(job) => break job.into_inner().name,
            Err(status) => assert!(is_transient(&status), "{status:?}"),
        }
    };
    let mut events: Vec<proto::JobEvent> = Vec::new();
    loop {
        let after_sequence = events.last().map_or(0, |event| event.sequence);
        let request = proto::WatchJobRequest { name: name.clone(), after_sequence };
        let mut watch = match any_client(&addresses, &mut turn).await.watch_job(request).await {
            Ok(watch) => watch.into_inner(),
            Err(status) => {
                assert!(is_transient(&status), "{status:?}");
                continue;
            }
        };
        loop {
            match watch.message().await {
                Ok(Some(event)) if event.sequence > 0 => events.push(event),
                Ok(Some(_)) => {}
                Ok(None) => return (name, events),
                Err(status) => {
                    assert!(is_transient(&status), "{status:?}");
                    break;
                }
            }
        }
    }
}

/// What a server that dies, or goes down, makes of a call: nothing that says anything about the job.
fn is_transient(status: &tonic::Status) -> bool {
    use std::error::Error;
    use tonic::Code::{Cancelled, Unavailable};
    matches!(status.code(), Unavailable | Cancelled) || status.source().is_some()
}

/// Runs so many jobs on so many servers, of which one at a time is killed and replaced.
async fn survive(place: Place, servers: usize, jobs: usize, kills: usize) {
    let seed = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).expect("a clock").as_nanos() as u64;
    println!("seed {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut running: Vec<Serving> = (0..servers).map(|_| place.serve()).collect();
    let addresses: Addresses = Arc::new(Mutex::new(running.iter().map(|server| server.grpc.clone()).collect()));
    let mut following = JoinSet::new();
    let (mut submitted, mut followed, mut killed) = (0, Vec::new(), 0);
    while followed.len() < jobs {
        // Jobs are held back for the kills that are to come.
        let most = jobs * (killed + 1) / (kills + 1);
        while submitted < most && following.len() < SUBMITTERS {
            following.spawn(follow(addresses.clone(), submitted));
            submitted += 1;
        }
        let pause = Duration::from_millis(random.random_range(1..600));
        tokio::select! {
            () = tokio::time::sleep(pause), if killed < kills => {
                let victim = random.random_range(0..servers);
                tokio::task::block_in_place(|| {
                    drop(running.remove(victim));
                    running.insert(victim, place.serve());
                });
                addresses.lock().expect("no test panicked here")[victim] = running[victim].grpc.clone();
                killed += 1;
            }
            Some(ended) = following.join_next() => followed.push(ended.expect("no panic")),
        }
    }
    assert_eq!(killed, kills);
    assert_all_ended_once(&running[0], followed).await;
    println!("{jobs} jobs on {servers} servers, {killed} kills");
}

async fn assert_all_ended_once(server: &Serving, followed: Vec<(String, Vec<proto::JobEvent>)>) {
    let mut jobs = JobServiceClient::connect(server.grpc.clone()).await.expect("a connection");
    let list = proto::ListJobsRequest { parent: "tenants/default".into(), page_size: 1000, ..Default::default() };
    let listed = jobs.list_jobs(list).await.expect("a page").into_inner().jobs;
    assert_eq!(listed.len(), followed.len(), "one job a request id");
    for (name, events) in followed {
        let sequences: Vec<u64> = events.iter().map(|event| event.sequence).collect();
        assert_eq!(sequences, (1..=sequences.len() as u64).collect::<Vec<_>>(), "{name}");
        let ends = |state: &JobState| !matches!(state, JobState::Queued | JobState::Running);
        let ends: Vec<JobState> = events.iter().filter_map(state_of).filter(ends).collect();
        assert_eq!(ends, [JobState::Succeeded], "{name}");
        let job = listed.iter().find(|job| job.name == name).expect("listed");
        assert_eq!((job.state(), job.last_sequence), (JobState::Succeeded, sequences.len() as u64), "{name}");
        let read = proto::ReadJobResultRequest { name: name.clone(), offset: 0 };
        jobs.read_job_result(read).await.expect("its result");
    }
}

async fn on_sqlite(jobs: usize, kills: usize) {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let place = Place::Directory(directory.path().join("data"));
    tokio::time::timeout(PATIENCE, survive(place, 1, jobs, kills)).await.expect("an end");
}

async fn on_postgres(jobs: usize, kills: usize) {
    let Some(cluster) = postgres::shared("servers that are killed at random") else { return };
    let place = Place::Database(cluster.database().await);
    tokio::time::timeout(PATIENCE, survive(place, 3, jobs, kills)).await.expect("an end");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_few_kills_on_sqlite() {
    on_sqlite(20, 3).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_few_kills_on_postgres() {
    on_postgres(20, 3).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes minutes: cargo test --test it chaos -- --ignored"]
async fn twenty_kills_on_sqlite() {
    on_sqlite(200, 20).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes minutes: cargo test --test it chaos -- --ignored"]
async fn twenty_kills_on_postgres() {
    on_postgres(200, 20).await;
}
