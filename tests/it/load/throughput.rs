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
const WORKERS: usize = 2;

/// Clients that each wait for a job before they send the next: enough that workers never wait for one.
const CLIENTS: usize = 16;

/// Jobs created in one call, where one client leaves a batch.
const BATCH: usize = 50;

/// Problems of a run.
const PROBLEMS: usize = 400;

/// Runs of everything: between two of them the pace of a machine shows.
const ROUNDS: usize = 3;

/// What a solve is to take at least, in milliseconds of one thread, to be about 10: what counts is the job as much as
/// the solve.
const LEAST_MS: f64 = 9.0;

/// Tracks of a scene, of which the first that takes so long is used: how long that is, is the machine's.
const SIZES: [usize; 7] = [40, 60, 80, 120, 160, 240, 320];

/// Problems of one size, each another scene.
#[derive(Clone, Copy)]
struct Problems {
    tracks: usize,
}

impl Problems {
    fn scene(self, number: usize) -> SceneOptions {
        SceneOptions { views: 5, tracks: self.tracks, outliers: 0.0, seed: number as u64, ..SceneOptions::default() }
    }

    fn request(self, number: usize) -> proto::CreateJobRequest {
        by_geometry(scene_request(&self.scene(number)))
    }
}

/// The problems as one sequence, each a window of its own.
fn sequence(problems: Problems, count: usize) -> String {
    let mut table = "view,track,x,y\n".to_owned();
    for number in 0..count {
        let options = problems.scene(number);
        let input = Scene::generate(&options).expect("a scene").input;
        for k in 0..input.view.len() {
            let view = number * options.views + input.view[k] as usize;
            let track = number * options.tracks + input.track[k] as usize;
            writeln!(table, "{view},{track},{},{}", input.x[k], input.y[k]).expect("a string takes it");
        }
    }
    table
}

/// What a number of jobs took.
#[derive(Clone, Copy)]
struct Cost {
    wall: Duration,
    /// Of the program.
    cpu: Duration,
}

/// CPU time of a process so far (`utime` and `stime`), or of its children that have ended (`cutime` and `cstime`; man
/// page proc_pid_stat): of this one, those of tests that run beside it, too.
fn cpu_time(process: u32, of_children: bool) -> Duration {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).expect("a process");
    // The name before may hold anything; what follows it begins with the third field.
    let fields: Vec<&str> = stat.rsplit(')').next().expect("fields").split_whitespace().collect();
    let first = if of_children { 16 } else { 14 } - 3;
    let ticks: u64 = fields[first..first + 2].iter().map(|ticks| ticks.parse::<u64>().expect("ticks")).sum();
    // Linux has a hundred of them a second.
    Duration::from_millis(10 * ticks)
}

/// What the program takes to solve so many in one process.
fn in_process(directory: &Path, problems: Problems, count: usize) -> Cost {
    let path = directory.join(format!("{count}.csv"));
    std::fs::write(&path, sequence(problems, count)).expect("written");
    let window = problems.scene(0).views.to_string();
    let out = directory.join(format!("out-{count}"));
    let (path, out) = (path.to_str().expect("UTF-8"), out.to_str().expect("UTF-8"));
    let (begun, before) = (Instant::now(), cpu_time(std::process::id(), true));
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
        &WORKERS.to_string(),
    ]);
    let cost = Cost { wall: begun.elapsed(), cpu: cpu_time(std::process::id(), true) - before };
    assert_eq!(solved.code, Some(0), "{}", solved.stderr);
    cost
}

fn serving(directory: &Path, data: &str) -> Serving {
    let (workers, queue) = (WORKERS.to_string(), (PROBLEMS + 1).to_string());
    Serving::start_more(&directory.join(data), &["--workers", &workers, "--queue", &queue], &[], Stdio::null())
}

/// What the service takes for so many that clients create one by one, each watched to its end.
async fn one_by_one(directory: &Path, problems: Problems, count: usize) -> Cost {
    let server = serving(directory, "one-by-one");
    let mut shares = Vec::new();
    for client in 0..CLIENTS {
        let numbers = (client..count).step_by(CLIENTS);
        let requests: Vec<_> = numbers.map(|number| problems.request(number)).collect();
        shares.push((connected(&server).await, requests));
    }
    let (begun, before) = (Instant::now(), cpu_time(server.running.0.id(), false));
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
    Cost { wall: begun.elapsed(), cpu: cpu_time(server.running.0.id(), false) - before }
}

/// The same of so many that one client leaves in batches, from the first call to the end of the last job.
async fn in_batches(directory: &Path, problems: Problems, count: usize) -> Cost {
    let server = serving(directory, "batches");
    let mut jobs = connected(&server).await;
    let requests: Vec<_> = (0..count).map(|number| problems.request(number)).collect();
    let (begun, before) = (Instant::now(), cpu_time(server.running.0.id(), false));
    let mut names = Vec::new();
    for requests in requests.chunks(BATCH) {
        let batch = proto::BatchCreateJobsRequest { parent: DEFAULT.into(), requests: requests.to_vec() };
        let created = jobs.batch_create_jobs(batch).await.expect("room").into_inner().jobs;
        names.extend(created.into_iter().map(|job| job.name));
    }
    // They are begun in their order, so that the last to end is among the last few.
    for name in names.iter().rev().take(2 * WORKERS) {
        reaches(&mut jobs, name, &[JobState::Succeeded, JobState::Failed]).await;
    }
    let cost = Cost { wall: begun.elapsed(), cpu: cpu_time(server.running.0.id(), false) - before };
    for name in names {
        let end = reaches(&mut jobs, &name, &[JobState::Succeeded, JobState::Failed]).await;
        assert_eq!(end, JobState::Succeeded, "{name}");
    }
    cost
}

/// How many of so many one process solves a second, and the CPU time of each in milliseconds; what a start costs is no
/// part of either.
fn alone(directory: &Path, problems: Problems, count: usize) -> (f64, f64) {
    let few = count / 10;
    let start = in_process(directory, problems, few);
    let whole = in_process(directory, problems, count);
    let more = (count - few) as f64;
    (more / whole.wall.saturating_sub(start.wall).as_secs_f64(), ms(whole.cpu.saturating_sub(start.cpu)) / more)
}

fn ms(time: Duration) -> f64 {
    1_000.0 * time.as_secs_f64()
}

/// Problems that take one thread about 10 ms here.
fn ten_ms(directory: &Path) -> Problems {
    let all = SIZES.map(|tracks| Problems { tracks });
    // The first run of a program reads it from the disk.
    in_process(directory, all[0], 1);
    let takes_ten = |problems: &Problems| {
        let (rate, _) = alone(directory, *problems, PROBLEMS / 2);
        let took_ms = 1_000.0 * WORKERS as f64 / rate;
        println!("{} tracks: {took_ms:.1} ms a solve", problems.tracks);
        took_ms >= LEAST_MS
    };
    all.into_iter().find(takes_ten).expect("a machine that solves the largest in less is one for larger ones")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement, of optimised builds: cargo test --release --test it throughput -- --ignored --nocapture"]
async fn what_the_service_costs_beside_the_solve() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let problems = tokio::task::block_in_place(|| ten_ms(directory.path()));
    let alone = || tokio::task::block_in_place(|| alone(directory.path(), problems, PROBLEMS));
    let rate = |cost: Cost| PROBLEMS as f64 / cost.wall.as_secs_f64();
    let cpu = |cost: Cost| ms(cost.cpu) / PROBLEMS as f64;
    for round in 1..=ROUNDS {
        // The clients take their share of the same cores. As machines change their pace, what a rate is compared with
        // is measured on both sides of it.
        let (before, cpu_before) = alone();
        let batches = in_batches(directory.path(), problems, PROBLEMS).await;
        let (between, cpu_between) = alone();
        let single = one_by_one(directory.path(), problems, PROBLEMS).await;
        let (after, cpu_after) = alone();
        let (of_batches, of_single) = (cpu(batches), cpu(single));
        let (batches, single) = (rate(batches), rate(single));
        println!("round {round}: {before:.0}, {between:.0}, {after:.0} a second in process, on {WORKERS} threads");
        let ratio = |rate: f64, before: f64, after: f64| rate / ((before + after) / 2.0);
        println!("  {batches:.0} through the service in batches: a ratio of {:.2}", ratio(batches, before, between));
        let ratio = ratio(single, between, after);
        println!("  {single:.0} by {CLIENTS} clients one by one, each watched: a ratio of {ratio:.2}");
        println!(
            "  CPU ms a job: {cpu_before:.1}, {cpu_between:.1}, {cpu_after:.1} in process; of the server {of_batches:.1} \
             in batches, {of_single:.1} one by one"
        );
    }
}
