//! What the service costs beside the solve: the same small problems through it and without it, on the same cores.

use std::fmt::Write;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use scpsfm::rpc::proto::JobState;
use scpsfm::synthetic::Scene;
use tokio::task::JoinSet;

use crate::support::live::{connected, created, reaches, tiny, tiny_options};
use crate::support::program::{Serving, run};

/// Threads that solve, either way.
const WORKERS: &str = "2";

/// Clients that each wait for a job before they send the next: enough that workers never wait for one.
const CLIENTS: usize = 16;

/// Problems of a run.
const PROBLEMS: usize = 400;

/// The problems as one sequence, each a window of its own.
fn sequence(problems: usize) -> String {
    let mut table = "view,track,x,y\n".to_owned();
    for number in 0..problems {
        let options = tiny_options(number as u64);
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
    let window = tiny_options(0).views.to_string();
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

/// How long the service takes for so many, each created, stored, solved, watched to its end.
async fn through_the_service(directory: &Path, problems: usize) -> Duration {
    let server = Serving::start_more(&directory.join("data"), &["--workers", WORKERS], &[], Stdio::null());
    let begun = Instant::now();
    let mut clients = JoinSet::new();
    for client in 0..CLIENTS {
        let mut jobs = connected(&server).await;
        clients.spawn(async move {
            for number in (client..problems).step_by(CLIENTS) {
                let name = created(&mut jobs, tiny(number as u64)).await;
                let end = reaches(&mut jobs, &name, &[JobState::Succeeded, JobState::Failed]).await;
                assert_eq!(end, JobState::Succeeded, "{name}");
            }
        });
    }
    clients.join_all().await;
    begun.elapsed()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement, for an optimised SCPSFM_PROGRAM: cargo test --test it throughput -- --ignored --nocapture"]
async fn what_the_service_costs_beside_the_solve() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    // What a start costs is no part of the rate.
    let few = PROBLEMS / 10;
    let start = tokio::task::block_in_place(|| in_process(directory.path(), few));
    let whole = tokio::task::block_in_place(|| in_process(directory.path(), PROBLEMS));
    let alone = (PROBLEMS - few) as f64 / whole.saturating_sub(start).as_secs_f64();
    let served = PROBLEMS as f64 / through_the_service(directory.path(), PROBLEMS).await.as_secs_f64();
    println!(
        "{alone:.0} a second in process ({:.1} ms each on {WORKERS} threads), {served:.0} through the service: a ratio of {:.2}",
        2e3 / alone,
        served / alone
    );
}
