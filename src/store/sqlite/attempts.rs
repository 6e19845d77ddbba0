//! Leases: claiming, keeping, ending and losing them.

use std::time::{Duration, SystemTime};

use sqlx::{Row, SqliteConnection};

use super::jobs;
use super::rows::{self, Standing, append, held, leave, micros, select_jobs, standing};
use crate::domain::job::{EventBody, Failure, Job, JobName, JobState};
use crate::domain::progress::Progress;
use crate::store::record::{CancelReply, Claimed, Ending, Heartbeat, Lease, Outcome};
use crate::store::{ATTEMPTS_EXHAUSTED, Error, payload};

/// Whether anything is queued.
pub(super) async fn may_claim(connection: &mut SqliteConnection) -> Result<bool, Error> {
    Ok(sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM jobs WHERE state = 'QUEUED')").fetch_one(connection).await?)
}

/// Leases the next queued job.
pub(super) async fn claim(
    connection: &mut SqliteConnection,
    worker: &str,
    now: SystemTime,
    lease_for: Duration,
) -> Result<Option<Claimed>, Error> {
    let id: Option<i64> = sqlx::query_scalar(
        "UPDATE jobs SET state = 'RUNNING', attempt = attempt + 1, start_time = COALESCE(start_time, ?1), \
         lease_worker = ?2, lease_expires = ?3, progress = NULL \
         WHERE id = (SELECT id FROM jobs WHERE state = 'QUEUED' AND (deadline IS NULL OR deadline > ?1) \
                     ORDER BY priority DESC, create_time, id LIMIT 1) RETURNING id",
    )
    .bind(micros(now))
    .bind(worker)
    .bind(micros(now + lease_for))
    .fetch_optional(&mut *connection)
    .await?;
    let Some(id) = id else { return Ok(None) };
    let attempt: u32 =
        sqlx::query_scalar("SELECT attempt FROM jobs WHERE id = ?").bind(id).fetch_one(&mut *connection).await?;
    append(connection, id, attempt, &EventBody::State { state: JobState::Running, failure: None }, now).await?;
    let row = sqlx::query(select_jobs!("WHERE id = ?")).bind(id).fetch_one(connection).await?;
    let job = rows::job(&row)?;
    let lease = Lease { name: job.name.clone(), attempt };
    Ok(Some(Claimed {
        job,
        lease,
        trace_parent: row.try_get("trace_parent")?,
        queue_time: rows::time(row.try_get("queue_time")?),
    }))
}

/// Extends a lease.
pub(super) async fn heartbeat(
    connection: &mut SqliteConnection,
    lease: &Lease,
    now: SystemTime,
    lease_for: Duration,
) -> Result<Heartbeat, Error> {
    let job = held(connection, lease).await?;
    sqlx::query("UPDATE jobs SET lease_expires = ? WHERE id = ?")
        .bind(micros(now + lease_for))
        .bind(job.id)
        .execute(connection)
        .await?;
    Ok(Heartbeat { cancel_requested: job.cancel_requested, deadline: job.deadline })
}

/// Appends a progress event.
pub(super) async fn record(
    connection: &mut SqliteConnection,
    lease: &Lease,
    progress: &Progress,
    now: SystemTime,
) -> Result<u64, Error> {
    let job = held(connection, lease).await?;
    keep_progress(connection, job.id, progress).await?;
    append(connection, job.id, job.attempt, &EventBody::Progress(*progress), now).await
}

async fn keep_progress(connection: &mut SqliteConnection, id: i64, progress: &Progress) -> Result<(), Error> {
    sqlx::query("UPDATE jobs SET progress = ? WHERE id = ?")
        .bind(payload::encode(progress)?)
        .bind(id)
        .execute(connection)
        .await?;
    Ok(())
}

/// Ends an attempt and its job.
pub(super) async fn finish(
    connection: &mut SqliteConnection,
    lease: &Lease,
    ending: &Ending,
    now: SystemTime,
) -> Result<Job, Error> {
    let job = held(connection, lease).await?;
    if let Some(progress) = &ending.progress {
        keep_progress(connection, job.id, progress).await?;
    }
    match &ending.outcome {
        Outcome::Succeeded { summary, result } => {
            insert_result(connection, job.id, result).await?;
            sqlx::query("UPDATE jobs SET summary = ? WHERE id = ?")
                .bind(payload::encode(summary)?)
                .bind(job.id)
                .execute(&mut *connection)
                .await?;
            append(connection, job.id, job.attempt, &EventBody::Result(summary.clone()), now).await?;
            leave(connection, &job, JobState::Succeeded, None, now).await?;
        }
        Outcome::Failed(failure) => leave(connection, &job, JobState::Failed, Some(failure.clone()), now).await?,
        Outcome::Cancelled => leave(connection, &job, JobState::Cancelled, None, now).await?,
        Outcome::Expired => leave(connection, &job, JobState::Expired, None, now).await?,
    }
    jobs::get(connection, &lease.name).await
}

async fn insert_result(connection: &mut SqliteConnection, id: i64, bytes: &[u8]) -> Result<(), Error> {
    for (chunk, data) in (0_i64..).zip(bytes.chunks(payload::CHUNK_BYTES)) {
        sqlx::query("INSERT INTO result_chunks (job_id, chunk, data) VALUES (?, ?, ?)")
            .bind(id)
            .bind(chunk)
            .bind(data.to_vec())
            .execute(&mut *connection)
            .await?;
    }
    Ok(())
}

/// Gives a lease back.
pub(super) async fn release(connection: &mut SqliteConnection, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
    let job = held(connection, lease).await?;
    let next = if job.cancel_requested { JobState::Cancelled } else { JobState::Queued };
    leave(connection, &job, next, None, now).await?;
    jobs::get(connection, &lease.name).await
}

/// Asks for the end of a job.
pub(super) async fn request_cancel(
    connection: &mut SqliteConnection,
    name: &JobName,
    now: SystemTime,
) -> Result<CancelReply, Error> {
    let job = standing(connection, name).await?;
    let ended_now = job.state == JobState::Queued;
    if ended_now {
        leave(connection, &job, JobState::Cancelled, None, now).await?;
    } else if job.state == JobState::Running {
        sqlx::query("UPDATE jobs SET cancel_requested = 1 WHERE id = ?").bind(job.id).execute(&mut *connection).await?;
    }
    Ok(CancelReply { job: jobs::get(connection, name).await?, ended_now })
}

/// Takes back the leases that ran out at `expired_at`, or all of them.
pub(super) async fn take_back(
    connection: &mut SqliteConnection,
    expired_at: Option<SystemTime>,
    now: SystemTime,
    max_attempts: u32,
) -> Result<Vec<Job>, Error> {
    let rows = sqlx::query(
        "SELECT id, tenant, job, state, attempt, lost_attempts, cancel_requested, deadline FROM jobs \
         WHERE state = 'RUNNING' AND lease_expires <= ? ORDER BY id",
    )
    .bind(expired_at.map_or(i64::MAX, micros))
    .fetch_all(&mut *connection)
    .await?;
    let mut changed = Vec::with_capacity(rows.len());
    for row in &rows {
        let job = Standing::from_row(row)?;
        let lost_attempts = job.lost_attempts + 1;
        sqlx::query("UPDATE jobs SET lost_attempts = ? WHERE id = ?")
            .bind(lost_attempts)
            .bind(job.id)
            .execute(&mut *connection)
            .await?;
        let (next, failure) = after_loss(&job, lost_attempts, now, max_attempts);
        leave(connection, &job, next, failure, now).await?;
        changed.push(jobs::get(connection, &job.name).await?);
    }
    Ok(changed)
}

/// Where a job goes whose worker vanished.
fn after_loss(job: &Standing, lost_attempts: u32, now: SystemTime, max_attempts: u32) -> (JobState, Option<Failure>) {
    if job.cancel_requested {
        (JobState::Cancelled, None)
    } else if job.deadline.is_some_and(|deadline| deadline <= now) {
        (JobState::Expired, None)
    } else if lost_attempts >= max_attempts {
        let message =
            format!("{lost_attempts} attempts ended without a word from their worker, at most {max_attempts} are made");
        (JobState::Failed, Some(Failure { reason: ATTEMPTS_EXHAUSTED.into(), message }))
    } else {
        (JobState::Queued, None)
    }
}

/// Whether a sweep would find anything.
pub(super) async fn needs_sweep(connection: &mut SqliteConnection, now: SystemTime) -> Result<bool, Error> {
    let found: bool = sqlx::query_scalar(
        "SELECT EXISTS (SELECT 1 FROM jobs WHERE state = 'RUNNING' AND lease_expires <= ?1) \
         OR EXISTS (SELECT 1 FROM jobs WHERE state = 'QUEUED' AND deadline IS NOT NULL AND deadline <= ?1)",
    )
    .bind(micros(now))
    .fetch_one(connection)
    .await?;
    Ok(found)
}

/// Ends the queued jobs that are past their deadline.
pub(super) async fn expire_queued(connection: &mut SqliteConnection, now: SystemTime) -> Result<Vec<Job>, Error> {
    let rows = sqlx::query(
        "SELECT id, tenant, job, state, attempt, lost_attempts, cancel_requested, deadline FROM jobs \
         WHERE state = 'QUEUED' AND deadline IS NOT NULL AND deadline <= ? ORDER BY id",
    )
    .bind(micros(now))
    .fetch_all(&mut *connection)
    .await?;
    let mut changed = Vec::with_capacity(rows.len());
    for row in &rows {
        let job = Standing::from_row(row)?;
        leave(connection, &job, JobState::Expired, None, now).await?;
        changed.push(jobs::get(connection, &job.name).await?);
    }
    Ok(changed)
}
