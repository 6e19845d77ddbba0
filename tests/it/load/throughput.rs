//! What the service costs beside the solve: the same small problems through it and without it, on the same cores.
//!
//! The client is part of what the service costs, so it has to be an optimised build, too.

use std::fmt::Write;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use scpsfm::rpc::proto::{self, JobState};
use scpsfm::synthetic::{Scene, SceneOptions};
use tokio::task::JoinSet;

use crate::support::live::{by_geometry, connected, created, reaches, scene_request};
use crate::support::program::{Serving, run};
use crate::support::uploads::DEFAULT;

/// Threads that solve, either way.
const WORKERS: &str = "2";

/// Clients that each wait for a job before they send the next: enough that workers never wait for one.
const CLIENTS: usize = 16;

/// Jobs created in one call, where one client leaves a batch.
const BATCH: usize = 50;

/// Problems of a run.
const PROBLEMS: usize = 400;

/// A scene that an optimised build solves in about 10 ms: what counts is the job as much as the solve.
fn ten_ms(seed: u64) -> SceneOptions {
    SceneOptions { views: 5, tracks: 40, outliers: 0.0, seed, ..SceneOptions::default() }
}

fn request(number: usize) -> proto::CreateJobRequest {
    by_geometry(scene_request(&ten_ms(number as u64)))
}

/// The problems as one sequence, each a window of its own.
fn sequence(problems: usize) -> String {
    let mut table = "view,track,x,y\n".to_owned();
    for number in 0..problems {
        let options = ten_ms(number as u64);
        let input = Scene::generate(&options).expect("a scene").input;
        for k in 0..input.view.len() {
            let view = number * options.views + input.view[k] as usize;
            let track = number * options.tracks + input.track[k] as usize;
            writeln!(table, "{view},{track},{},{}", input.x[k], input.y[k]).expect("a string takes it");
        }
    }
    table
}

/// How long the program takes to solve so many in one process.
fn in_process(directory: &Path, problems: usize) -> Duration {
    let path = directory.join(format!("{problems}.csv"));
    std::fs::write(&path, sequence(problems)).expect("written");
    let window = ten_ms(0).views.to_string();
    let out = directory.join(format!("out-{problems}"));
    let (path, out) = (path.to_str().expect("UTF-8"), out.to_str().expect("UTF-8"));
    let begun = Instant::now();
    let solved = run([
        "solve",
        path,
        "--out",
        out,
        "--width",
        "1000",
        "--height",
        "1000",
        "--method",
        "geometry",
        "--window",
        &window,
        "--step",
        &window,
        "--threads",
        WORKERS,
    ]);
    let took = begun.elapsed();
    assert_eq!(solved.code, Some(0), "{}", solved.stderr);
    took
}

fn serving(directory: &Path, data: &str) -> Serving {
    let queue = (PROBLEMS + 1).to_string();
    Serving::start_more(&directory.join(data), &["--workers", WORKERS, "--queue", &queue], &[], Stdio::null())
}

/// How long the service takes for so many that clients create one by one, each watched to its end.
async fn one_by_one(directory: &Path, problems: usize) -> Duration {
    let server = serving(directory, "one-by-one");
    let mut shares = Vec::new();
    for client in 0..CLIENTS {
        let requests: Vec<_> = (client..problems).step_by(CLIENTS).map(request).collect();
        shares.push((connected(&server).await, requests));
    }
    let begun = Instant::now();
    let mut clients = JoinSet::new();
    for (mut jobs, requests) in shares {
        clients.spawn(async move {
            for request in requests {
                let name = created(&mut jobs, request).await;
                let end = reaches(&mut jobs, &name, &[JobState::Succeeded, JobState::Failed]).await;
                assert_eq!(end, JobState::Succeeded, "{name}");
            }
        });
    }
    clients.join_all().await;
    begun.elapsed()
}

/// How long it takes for so many that one client leaves in batches, from the first call to the end of the last job.
async fn in_batches(directory: &Path, problems: usize) -> Duration {
    let server = serving(directory, "batches");
    let mut jobs = connected(&server).await;
    let requests: Vec<_> = (0..problems).map(request).collect();
    let begun = Instant::now();
    let mut names = Vec::new();
    for requests in requests.chunks(BATCH) {
        let batch = proto::BatchCreateJobsRequest { parent: DEFAULT.into(), requests: requests.to_vec() };
        let created = jobs.batch_create_jobs(batch).await.expect("room").into_inner().jobs;
        names.extend(created.into_iter().map(|job| job.name));
    }
    // They end in their order, but for as many as run at once.
    for name in names.iter().rev().take(BATCH) {
        let end = reaches(&mut jobs, name, &[JobState::Succeeded, JobState::Failed]).await;
        assert_eq!(end, JobState::Succeeded, "{name}");
    }
    begun.elapsed()
}

/// How many a second one process solves; what a start costs is no part of it.
fn rate_in_process(directory: &Path) -> f64 {
    let few = PROBLEMS / 10;
    let start = in_process(directory, few);
    let whole = in_process(directory, PROBLEMS);
    (PROBLEMS - few) as f64 / whole.saturating_sub(start).as_secs_f64()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement, of optimised builds: cargo test --release --test it throughput -- --ignored --nocapture"]
async fn what_the_service_costs_beside_the_solve() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let alone = || tokio::task::block_in_place(|| rate_in_process(directory.path()));
    // The clients take their share of the same cores. As machines change their pace, what a rate is compared with is
    // measured on both sides of it.
    let before = alone();
    let batches = PROBLEMS as f64 / in_batches(directory.path(), PROBLEMS).await.as_secs_f64();
    let between = alone();
    let single = PROBLEMS as f64 / one_by_one(directory.path(), PROBLEMS).await.as_secs_f64();
    let after = alone();
    println!("{before:.0}, {between:.0}, {after:.0} a second in process, on {WORKERS} threads");
    let ratio = |rate: f64, before: f64, after: f64| rate / ((before + after) / 2.0);
    println!("{batches:.0} through the service in batches: a ratio of {:.2}", ratio(batches, before, between));
    let ratio = ratio(single, between, after);
    println!("{single:.0} by {CLIENTS} clients one by one, each watched: a ratio of {ratio:.2}");
}
