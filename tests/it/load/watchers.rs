//! A long queue and many who watch it, some of whom do not read.

use std::process::Stdio;
use std::time::{Duration, SystemTime};

use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tonic::Streaming;
use tonic::transport::Channel;

use crate::support::live::{connected, tiny};
use crate::support::memory::peak_mb;
use crate::support::program::Serving;
use crate::support::scrape::Page;
use crate::support::server::soon;
use crate::support::uploads::DEFAULT;
use crate::support::wire::{create_tracks, state_of};

/// What the server may take, in megabytes, with all of them there.
const MOST_MB: u64 = 600;

/// Jobs created in one call.
const BATCH: usize = 50;

/// Watchers that share a connection: a server takes some hundred.
const WATCHERS_A_CONNECTION: usize = 100;

/// Of so many watchers one is slow.
const SLOW_EVERY: usize = 20;

/// So many watchers, each of a job of its own, and so many jobs in all.
struct WatcherLoad {
    watchers: usize,
    jobs: usize,
    /// Makes the request of this number.
    request: fn(u64) -> proto::CreateJobRequest,
    /// Between two events that a slow watcher reads; `None`: it reads nothing until the others are through.
    slow_pause: Option<Duration>,
}

/// Creates jobs in batches and returns their names, in order.
async fn create(
    jobs: &mut JobServiceClient<Channel>,
    request: fn(u64) -> proto::CreateJobRequest,
    count: usize,
) -> Vec<String> {
    let mut names = Vec::new();
    while names.len() < count {
        let requests = (names.len()..count.min(names.len() + BATCH)).map(|number| request(number as u64)).collect();
        let batch = proto::BatchCreateJobsRequest { parent: DEFAULT.into(), requests };
        let created = jobs.batch_create_jobs(batch).await.expect("no bound is reached").into_inner().jobs;
        names.extend(created.into_iter().map(|job| job.name));
    }
    names
}

/// One who watches a job to its end.
struct Watcher {
    name: String,
    events: Streaming<proto::JobEvent>,
    pause: Option<Duration>,
}

impl Watcher {
    /// Asserts that it saw each event once and one end. Returns how long the events that happened meanwhile were on
    /// their way.
    async fn drained(mut self) -> Vec<Duration> {
        let (mut last, mut delays, mut end) = (0, Vec::new(), None);
        let begun = SystemTime::now();
        while let Some(event) = self.events.message().await.unwrap_or_else(|error| panic!("{}: {error}", self.name)) {
            let now = SystemTime::now();
            let time = event.time.and_then(|time| SystemTime::try_from(time).ok()).expect("a time");
            if time > begun {
                delays.push(now.duration_since(time).unwrap_or_default());
            }
            if event.sequence > 0 {
                assert_eq!(event.sequence, last + 1, "{}", self.name);
                last = event.sequence;
            }
            end = state_of(&event).or(end);
            if let Some(pause) = self.pause {
                tokio::time::sleep(pause).await;
            }
        }
        assert_eq!(end, Some(JobState::Succeeded), "{}", self.name);
        delays
    }
}

/// Opens a watch of each job.
async fn watch_all(server: &Serving, names: &[String], slow_pause: Option<Duration>) -> (Vec<Watcher>, Vec<Watcher>) {
    let (mut fast, mut slow) = (Vec::new(), Vec::new());
    for names in names.chunks(WATCHERS_A_CONNECTION) {
        let mut jobs = connected(server).await;
        for (number, name) in names.iter().enumerate() {
            let request = proto::WatchJobRequest { name: name.clone(), after_sequence: 0 };
            let events = jobs.watch_job(request).await.expect("a watch").into_inner();
            let is_slow = number % SLOW_EVERY == 0;
            let pause = slow_pause.filter(|_| is_slow);
            let watcher = Watcher { name: name.clone(), events, pause };
            if is_slow { slow.push(watcher) } else { fast.push(watcher) }
        }
    }
    (fast, slow)
}

impl WatcherLoad {
    /// Runs until every watcher is through; the rest of the queue is left to the end of the server.
    async fn run(self) {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let data_dir = directory.path().join("data");
        let queue = (self.jobs + 1).to_string();
        let arguments = ["--workers", "2", "--queue", &queue];
        let server = Serving::start_more(&data_dir, &arguments, &[], Stdio::null());
        let mut jobs = connected(&server).await;
        let names = create(&mut jobs, self.request, self.jobs).await;
        let begun = SystemTime::now();
        let idle_mb = peak_mb(server.running.0.id());
        let page = Page::parse(&server.page("/metrics"));
        let waiting = page.value("scpsfm_queue_depth");
        // The next in the queue: their events come while it is long.
        let ahead = self.jobs - waiting as usize;
        let watched = &names[ahead.min(self.jobs - self.watchers)..][..self.watchers];
        let (fast, slow) = watch_all(&server, watched, self.slow_pause).await;
        let through = watch::Sender::new(false);
        let mut delays: JoinSet<Vec<Duration>> = fast.into_iter().map(Watcher::drained).collect();
        let reads_late = self.slow_pause.is_none();
        let mut late: JoinSet<Vec<Duration>> = JoinSet::new();
        for watcher in slow {
            let mut all_through = through.subscribe();
            late.spawn(async move {
                if reads_late {
                    all_through.wait_for(|&through| through).await.expect("the test goes on");
                }
                watcher.drained().await
            });
        }
        let mut on_their_way: Vec<Duration> = Vec::new();
        while let Some(ended) = soon(delays.join_next()).await {
            on_their_way.extend(ended.expect("no panic"));
        }
        through.send_replace(true);
        soon(late.join_all()).await;
        let peak = peak_mb(server.running.0.id());
        let seconds = begun.elapsed().unwrap_or_default().as_secs_f64();
        on_their_way.sort();
        let at = |share: f64| match on_their_way.len() {
            0 => 0,
            count => on_their_way[((count - 1) as f64 * share) as usize].as_millis(),
        };
        println!(
            "{} jobs ({waiting} waiting when the watches began), {} watchers, {seconds:.1} s: {} events on their way \
             for {} ms (median), {} ms (99 %), {} ms (most); {idle_mb} MB with the queue, {peak} MB at most",
            self.jobs,
            self.watchers,
            on_their_way.len(),
            at(0.5),
            at(0.99),
            at(1.0),
        );
        assert!(peak < MOST_MB, "{peak} MB");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hundred_watchers_of_a_long_queue_see_everything_though_some_do_not_read() {
    WatcherLoad { watchers: 100, jobs: 500, request: |_| create_tracks(), slow_pause: None }.run().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes minutes, and needs an optimised SCPSFM_PROGRAM: cargo test --test it watchers -- --ignored"]
async fn a_thousand_watchers_of_ten_thousand_jobs_see_everything_though_some_are_slow() {
    let slow_pause = Some(Duration::from_secs(1));
    WatcherLoad { watchers: 1_000, jobs: 10_000, request: tiny, slow_pause }.run().await;
}
