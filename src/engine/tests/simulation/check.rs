//! What must hold, whatever happens.

use std::collections::{BTreeMap, BTreeSet};

use tokio::runtime::Builder;

use super::client::{Clients, Known, request};
use super::server::{JobBehavior, Solving};
use super::{MAX_ATTEMPTS, MAX_JOBS, beginning};
use crate::domain::job::{EventBody, Job, JobEvent, JobName, JobState};
use crate::store::tests::simulated::Cluster;
use crate::store::{ATTEMPTS_EXHAUSTED, Error, Store};

macro_rules! ensure {
    ($holds:expr, $($what:tt)+) => {
        if !$holds {
            return Err(format!($($what)+));
        }
    };
}

/// The bound on what waits, which holds at all times, and where `max_running` is given, that on what runs of one
/// tenant.
pub(super) fn at_each_step(cluster: &Cluster, solving: &Solving, max_running: Option<u32>) -> Result<(), String> {
    let new = cluster.numbers("SELECT COUNT(*) AS number FROM jobs WHERE state = 'QUEUED' AND attempt = 0")[0];
    ensure!(new <= MAX_JOBS as i64, "{new} new jobs wait, {MAX_JOBS} may");
    let Some(max_running) = max_running else { return Ok(()) };
    let select = "SELECT CAST(substr(job, 5) AS INTEGER) AS number FROM jobs WHERE state = 'RUNNING'";
    let running = cluster.numbers(select);
    let mut of_tenant = BTreeMap::<String, BTreeSet<i64>>::new();
    for name in solving.jobs() {
        let number = name.job.trim_start_matches("job-").parse().map_err(|_| "a foreign job".to_owned())?;
        // One that was cancelled may be stopped a little later than another begins in its place.
        if running.contains(&number) {
            of_tenant.entry(name.tenant).or_default().insert(number);
        }
    }
    for (tenant, jobs) in of_tenant {
        ensure!(jobs.len() <= max_running as usize, "{tenant} runs the jobs {jobs:?}, {max_running} may");
    }
    Ok(())
}

/// Jobs that have not ended.
pub(super) fn open_jobs(cluster: &Cluster) -> i64 {
    cluster.numbers("SELECT COUNT(*) AS number FROM jobs WHERE state IN ('QUEUED', 'RUNNING')")[0]
}

/// Whether the queue is paused.
pub(super) fn is_paused(cluster: &Cluster) -> bool {
    cluster.numbers("SELECT COUNT(*) AS number FROM queue WHERE pause_time IS NOT NULL")[0] > 0
}

/// What is stored once everything has come to rest. `is_disturbed`: whether servers had more to bear than their jobs.
pub(super) fn at_the_end(cluster: &Cluster, clients: &Clients, is_disturbed: bool) -> Result<(), String> {
    let store = cluster.connect::<true>(0, beginning());
    let runtime = Builder::new_current_thread().enable_time().start_paused(true).build().expect("a runtime");
    runtime.block_on(async {
        let (jobs, sent) = clients.known();
        for (name, known) in &jobs {
            let job = match store.job(name).await {
                Err(Error::NotFound(_)) if known.deleted => continue,
                // It was deleted and made anew: none of those who call knows it.
                Ok(_) if known.deleted => continue,
                job => job.map_err(|error| format!("{name} was acknowledged: {error}"))?,
            };
            let events = store.events_after(name, 0, u32::MAX).await.map_err(|error| error.to_string())?;
            told_once(&job, &events, known).map_err(|what| format!("{name}: {what}"))?;
            came_right(&store, &job, is_disturbed).await.map_err(|what| format!("{name}: {what}"))?;
        }
        // Of requests without an answer there may be jobs, one each.
        let jobs = cluster.numbers("SELECT COUNT(*) AS number FROM jobs")[0];
        ensure!(jobs <= sent as i64, "{jobs} jobs of {sent} requests");
        let open = open_jobs(cluster);
        ensure!(open == 0, "{open} jobs have not ended");
        let left = "SELECT COUNT(*) AS number FROM attempts WHERE ending IS NULL";
        let left = cluster.numbers(left)[0];
        ensure!(left == 0, "{left} attempts have no end");
        Ok(())
    })
}

/// Events without gap or repeat, one end but for retries, and nothing of an attempt once another has begun.
fn told_once(job: &Job, events: &[JobEvent], known: &Known) -> Result<(), String> {
    let sequences: Vec<u64> = events.iter().filter_map(|event| event.sequence).collect();
    ensure!(sequences.iter().copied().eq(1..=job.last_sequence), "events {sequences:?} of {}", job.last_sequence);
    let ends = events.iter().filter_map(terminal).collect::<Vec<_>>();
    ensure!(ends.last() == Some(&job.state), "{} after the ends {ends:?}", job.state.name());
    ensure!(ends.len() <= 1 + known.retries, "the ends {ends:?} of {} retries", known.retries);
    ensure!(events.last().and_then(terminal) == Some(job.state), "something follows the end");
    ensure!(events.is_sorted_by_key(|event| event.attempt), "an attempt writes after the next has begun");
    let began = |event: &&JobEvent| matches!(event.body, EventBody::State { state: JobState::Running, .. });
    let begun: Vec<u32> = events.iter().filter(began).map(|event| event.attempt).collect();
    ensure!(begun.iter().copied().eq(1..=job.attempt), "attempts {begun:?} of {}", job.attempt);
    // A retry that was on its way for long may have come after the last look.
    let is_seen = if known.retries == 0 { known.end == Some(job.state) } else { known.end.is_some() };
    ensure!(is_seen, "it is {}, seen was {:?}", job.state.name(), known.end);
    Ok(())
}

fn terminal(event: &JobEvent) -> Option<JobState> {
    match event.body {
        EventBody::State { state, .. } => Some(state).filter(|state| state.is_terminal()),
        _ => None,
    }
}

/// The end is one that the job can come to, and a result is its own.
async fn came_right(store: &Store, job: &Job, is_disturbed: bool) -> Result<(), String> {
    let number = job.name.job.trim_start_matches("job-").parse().map_err(|_| "a foreign job".to_owned())?;
    let behavior = JobBehavior::of(request(number).description.settings.seed);
    let reason = job.failure.as_ref().map(|failure| failure.reason.as_str());
    match job.state {
        JobState::Succeeded => {
            ensure!(behavior == JobBehavior::Succeed, "a job that cannot succeed has");
            let result = store.result(&job.name, u32::MAX).await.map_err(|error| error.to_string())?;
            let result = result.ok_or("no result")?;
            ensure!(result.is_intact() && result.bytes == result_of(&job.name), "another job's result");
        }
        JobState::Failed if reason == Some(ATTEMPTS_EXHAUSTED) => {
            let lost = job.failure.as_ref().map_or(0, |failure| failure.attempts.len());
            ensure!(lost >= MAX_ATTEMPTS as usize, "given up after {lost} attempts");
            ensure!(is_disturbed || behavior == JobBehavior::Kill, "it failed by what its neighbours did");
        }
        JobState::Failed => ensure!(behavior == JobBehavior::Fail, "it failed by {reason:?}"),
        JobState::Cancelled => {}
        state => return Err(format!("it is {}", state.name())),
    }
    Ok(())
}

/// The encoded result of a job.
pub(super) fn result_of(name: &JobName) -> Vec<u8> {
    name.to_string().into_bytes()
}
