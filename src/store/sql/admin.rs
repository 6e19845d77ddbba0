//! What an operator does to jobs and to the queue: retries, priorities, pauses, and a look at the whole.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::time::SystemTime;

use super::jobs::{self, AdmissionStats};
use super::removal::check_etag;
use super::rows::{self, Transition, locked_job, micros, number, returning_job};
use super::{Connection, Lock, Statement, webhooks};
use crate::domain::job::{Job, JobName, JobState};
use crate::store::record::{ChangeReply, QueueReport, QueueStats, TenantQueue};
use crate::store::{Error, Notification, QueueBounds};

/// Puts a job that ended without a result into the queue again; see `Store::retry_job`.
pub(super) async fn retry(
    connection: &mut dyn Connection,
    name: &JobName,
    etag: Option<&str>,
    bounds: &QueueBounds,
    now: SystemTime,
) -> Result<ChangeReply, Error> {
    // Before the job's row, as whoever creates jobs takes them: two in the other order would wait for each other.
    connection.take_lock(Lock::Admission).await?;
    let job = locked_job(connection, name).await?;
    check_etag(connection, name, etag).await?;
    match job.state {
        JobState::Queued | JobState::Running => {
            return Ok(ChangeReply { job: jobs::get(connection, name).await?, by_this_call: false });
        }
        JobState::Succeeded => return Err(Error::Succeeded(name.clone())),
        JobState::Failed | JobState::Cancelled | JobState::DeadlineExceeded => {}
    }
    let size = Statement::new("SELECT input_bytes, observation_count FROM jobs WHERE id = $1").bind(job.id);
    let size = connection.row(size).await?;
    let (queued_bytes, queued_observations) = (number(&size, "input_bytes")?, number(&size, "observation_count")?);
    let asked = QueueStats { queued: 1, queued_bytes, queued_observations, ..QueueStats::default() };
    let (whole, tenant) = AdmissionStats::default().look(connection, &name.tenant, bounds).await?;
    if let Some(bound) = bounds.refuses(&whole, &tenant, &asked) {
        return Err(Error::QueueFull(bound));
    }
    // The number of its attempt goes on: it is the fencing token.
    connection.execute(Statement::new("DELETE FROM attempts WHERE job_id = $1").bind(job.id)).await?;
    let anew = Statement::new(
        "UPDATE jobs SET lost_attempts = 0, start_time = NULL, progress = NULL, attached_calls = NULL, \
         detached_calls = 0, deadline = CASE WHEN deadline > $1 THEN deadline END WHERE id = $2",
    );
    connection.execute(anew.bind(micros(now)).bind(job.id)).await?;
    webhooks::renew(connection, job.id).await?;
    let job = rows::transition(connection, &job, Transition::to(JobState::Queued), now).await?;
    Ok(ChangeReply { job, by_this_call: true })
}

/// Changes the priority of a queued job.
pub(super) async fn set_priority(
    connection: &mut dyn Connection,
    name: &JobName,
    etag: Option<&str>,
    priority: i32,
) -> Result<Job, Error> {
    let job = locked_job(connection, name).await?;
    check_etag(connection, name, etag).await?;
    if job.state != JobState::Queued {
        return Err(Error::NotQueued(name.clone(), job.state));
    }
    let update = Statement::new(returning_job!("UPDATE jobs SET priority = $1 WHERE id = $2"));
    rows::job(&connection.row(update.bind(priority).bind(job.id)).await?)
}

/// Pauses or resumes the queue.
pub(super) async fn set_paused(connection: &mut dyn Connection, paused: bool, now: SystemTime) -> Result<(), Error> {
    if paused {
        let pause = Statement::new("UPDATE queue SET pause_time = COALESCE(pause_time, $1)").bind(micros(now));
        return connection.execute(pause).await;
    }
    connection.execute(Statement::new("UPDATE queue SET pause_time = NULL")).await?;
    connection.notify(Notification::Queued).await
}

/// The queue as its administrator sees it.
pub(super) async fn queue(connection: &mut dyn Connection, tenants: u32) -> Result<QueueReport, Error> {
    let pause = connection.row(Statement::new("SELECT pause_time FROM queue")).await?;
    // One look, so that the counts of tenants add up to those of all. Each half is answered by an index alone.
    let counts = Statement::new(
        "SELECT state, tenant, COUNT(*) AS jobs FROM jobs WHERE state IN ('QUEUED', 'RUNNING') GROUP BY state, tenant \
         UNION ALL SELECT state, '' AS tenant, COUNT(*) AS jobs FROM jobs WHERE end_time IS NOT NULL GROUP BY state",
    );
    let mut jobs = JobState::ALL.map(|state| (state, 0));
    let mut by_tenant: BTreeMap<String, TenantQueue> = BTreeMap::new();
    for row in connection.rows(counts).await? {
        let (state, found) = (rows::state(&row)?, number(&row, "jobs")?);
        if let Some((_, count)) = jobs.iter_mut().find(|(known, _)| *known == state) {
            *count += found;
        }
        if state.is_terminal() {
            continue;
        }
        let tenant = row.text("tenant")?;
        let queue = by_tenant.entry(tenant.clone()).or_insert(TenantQueue { tenant, queued: 0, running: 0 });
        match state {
            JobState::Queued => queue.queued = found,
            _ => queue.running = found,
        }
    }
    let mut by_tenant: Vec<TenantQueue> = by_tenant.into_values().collect();
    by_tenant.sort_by_key(|of| (Reverse(of.queued), Reverse(of.running)));
    by_tenant.truncate(tenants as usize);
    let oldest = Statement::new(
        "SELECT tenant, job, queue_time FROM jobs WHERE state = 'QUEUED' ORDER BY queue_time, id LIMIT 1",
    );
    let oldest = connection.optional_row(oldest).await?;
    let oldest = oldest.map(|row| Ok::<_, Error>((rows::name(&row)?, rows::time(row.integer("queue_time")?))));
    let pause_time = pause.optional_integer("pause_time")?.map(rows::time);
    Ok(QueueReport { pause_time, jobs, oldest: oldest.transpose()?, tenants: by_tenant })
}
