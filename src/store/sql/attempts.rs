//! Leases: keeping, ending and losing them. `claims` is where they begin.

use std::time::SystemTime;

use super::rows::{
    self, LockedJob, Transition, end_attempt, held, insert_event, integer, locked_job, micros, number,
    select_locked_job,
};
use super::{Connection, Row, Statement, jobs, removal};
use crate::domain::job::{AttemptEnd, EventBody, Failure, Job, JobName, JobState, PastAttempt};
use crate::domain::progress::Progress;
use crate::store::record::{ChangeReply, Ending, Heartbeat, Lease, Outcome};
use crate::store::{ATTEMPTS_EXHAUSTED, Error, Notification, payload};

/// Attempts that a failure tells of, the latest ones: those given back at a drain do not count against the cap, and
/// there is no bound on them.
const MOST_PAST_ATTEMPTS: u32 = 16;

/// Extends a lease until `expires`.
pub(super) async fn heartbeat(
    connection: &mut dyn Connection,
    lease: &Lease,
    expires: SystemTime,
) -> Result<Heartbeat, Error> {
    let job = held(connection, lease).await?;
    let extend = Statement::new("UPDATE jobs SET lease_expires = $1 WHERE id = $2").bind(micros(expires));
    connection.execute(extend.bind(job.id)).await?;
    Ok(Heartbeat { cancel_requested: job.cancel_requested, deadline: job.deadline })
}

/// Appends a progress event.
pub(super) async fn record(
    connection: &mut dyn Connection,
    lease: &Lease,
    progress: &Progress,
    now: SystemTime,
) -> Result<u64, Error> {
    let job = held(connection, lease).await?;
    let sequence = job.last_sequence + 1;
    let update = Statement::new("UPDATE jobs SET progress = $1, last_sequence = $2 WHERE id = $3")
        .bind(payload::encode(progress)?)
        .bind(integer(sequence))
        .bind(job.id);
    let event = insert_event(job.id, sequence, job.attempt, &EventBody::Progress(*progress), now)?;
    connection.batch(vec![update, event]).await?;
    connection.notify(Notification::Events(job.name.clone())).await?;
    Ok(sequence)
}

/// Ends an attempt and its job.
pub(super) async fn finish(
    connection: &mut dyn Connection,
    lease: &Lease,
    ending: &Ending,
    now: SystemTime,
) -> Result<Job, Error> {
    let job = held(connection, lease).await?;
    let mut transition = match &ending.outcome {
        Outcome::Succeeded { summary, result } => {
            for chunk in result_chunks(job.id, &result.bytes) {
                connection.execute(chunk).await?;
            }
            Transition {
                summary: Some(summary),
                result_sha256: Some(&result.sha256),
                ..Transition::to(JobState::Succeeded)
            }
        }
        Outcome::Failed(failure) => Transition { failure: Some(failure.clone()), ..Transition::to(JobState::Failed) },
        Outcome::Cancelled => Transition::to(JobState::Cancelled),
        Outcome::DeadlineExceeded => Transition::to(JobState::DeadlineExceeded),
    };
    transition.progress = ending.progress.as_ref();
    transition.attempt_end = Some(AttemptEnd::Ended);
    rows::transition(connection, &job, transition, now).await
}

/// What stores a result, chunk by chunk.
fn result_chunks(id: i64, bytes: &[u8]) -> impl Iterator<Item = Statement> + Send {
    (0_i64..).zip(bytes.chunks(payload::CHUNK_BYTES)).map(move |(chunk, data)| {
        let insert = Statement::new("INSERT INTO result_chunks (job_id, chunk, data) VALUES ($1, $2, $3)");
        insert.bind(id).bind(chunk).bind(data)
    })
}

/// Gives a lease back.
pub(super) async fn release(connection: &mut dyn Connection, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
    let job = held(connection, lease).await?;
    let next = if job.cancel_requested { JobState::Cancelled } else { JobState::Queued };
    let transition = Transition { attempt_end: Some(AttemptEnd::GivenBack), ..Transition::to(next) };
    rows::transition(connection, &job, transition, now).await
}

/// Asks for the end of a job.
pub(super) async fn request_cancel(
    connection: &mut dyn Connection,
    name: &JobName,
    etag: Option<&str>,
    now: SystemTime,
) -> Result<ChangeReply, Error> {
    let job = locked_job(connection, name).await?;
    removal::check_etag(connection, name, etag).await?;
    let ended_now = job.state == JobState::Queued;
    if ended_now {
        rows::transition(connection, &job, Transition::to(JobState::Cancelled), now).await?;
    } else if job.state == JobState::Running {
        connection
            .execute(Statement::new("UPDATE jobs SET cancel_requested = TRUE WHERE id = $1").bind(job.id))
            .await?;
        connection.notify(Notification::Cancel(name.clone())).await?;
    }
    Ok(ChangeReply { job: jobs::get(connection, name).await?, by_this_call: ended_now })
}

/// Takes back the leases that ran out at `expired_at`, or all of them.
pub(super) async fn take_back(
    connection: &mut dyn Connection,
    expired_at: Option<SystemTime>,
    now: SystemTime,
    max_attempts: u32,
) -> Result<Vec<Job>, Error> {
    let select = Statement::new(select_locked_job!("WHERE state = 'RUNNING' AND lease_expires <= $1 ORDER BY id"))
        .bind(expired_at.map_or(i64::MAX, micros))
        .then(connection.skip_locked());
    if expired_at.is_none() {
        // Nor is anything prefetched that a process of before had leased.
        let free = "UPDATE jobs SET lease_worker = NULL, lease_expires = NULL \
                    WHERE state = 'QUEUED' AND lease_expires IS NOT NULL";
        connection.execute(Statement::new(free)).await?;
    }
    let mut changed = Vec::new();
    for row in connection.rows(select).await? {
        let job = LockedJob::from_row(&row)?;
        let lost_attempts = job.lost_attempts + 1;
        let update = Statement::new("UPDATE jobs SET lost_attempts = $1 WHERE id = $2");
        connection.execute(update.bind(lost_attempts).bind(job.id)).await?;
        connection.execute(end_attempt(&job, AttemptEnd::Lost, now)).await?;
        let next = after_loss(&job, lost_attempts, now, max_attempts);
        let failure = match next {
            JobState::Failed => Some(exhausted(connection, &job, lost_attempts, max_attempts).await?),
            _ => None,
        };
        let transition = Transition { failure, ..Transition::to(next) };
        changed.push(rows::transition(connection, &job, transition, now).await?);
    }
    Ok(changed)
}

/// Where a job goes whose worker vanished.
fn after_loss(job: &LockedJob, lost_attempts: u32, now: SystemTime, max_attempts: u32) -> JobState {
    if job.cancel_requested {
        JobState::Cancelled
    } else if job.deadline.is_some_and(|deadline| deadline <= now) {
        JobState::DeadlineExceeded
    } else if lost_attempts >= max_attempts {
        JobState::Failed
    } else {
        JobState::Queued
    }
}

/// Why a job failed that lost too many attempts, and what became of each.
async fn exhausted(
    connection: &mut dyn Connection,
    job: &LockedJob,
    lost_attempts: u32,
    max_attempts: u32,
) -> Result<Failure, Error> {
    let select = Statement::new(
        "SELECT attempt, server, start_time, end_time, ending FROM attempts WHERE job_id = $1 \
         ORDER BY attempt DESC LIMIT $2",
    );
    let rows = connection.rows(select.bind(job.id).bind(MOST_PAST_ATTEMPTS)).await?;
    let past = |row: &Row| {
        let ending = row.optional_text("ending")?.unwrap_or_default();
        Ok(PastAttempt {
            attempt: number(row, "attempt")?,
            server: row.text("server")?,
            start_time: rows::time(row.integer("start_time")?),
            // One that is followed by another has ended, whatever is known of how.
            end_time: rows::time(row.optional_integer("end_time")?.unwrap_or(row.integer("start_time")?)),
            end: AttemptEnd::from_name(&ending).unwrap_or(AttemptEnd::Lost),
        })
    };
    let attempts: Vec<_> = rows.iter().rev().map(past).collect::<Result<_, Error>>()?;
    let told: Vec<String> = attempts
        .iter()
        .filter(|past| past.end == AttemptEnd::Lost)
        .map(|past| format!("{} by {}", past.attempt, past.server))
        .collect();
    let message = format!(
        "{lost_attempts} attempts ended without a word from their server, at most {max_attempts} are made: {}",
        told.join(", ")
    );
    Ok(Failure { reason: ATTEMPTS_EXHAUSTED.into(), message, attempts })
}

/// Whether a sweep would find anything: leases that ran out at `expired_at`, or deadlines that have passed.
pub(super) async fn needs_sweep(
    connection: &mut dyn Connection,
    expired_at: SystemTime,
    now: SystemTime,
) -> Result<bool, Error> {
    let select = Statement::new(
        "SELECT (EXISTS (SELECT 1 FROM jobs WHERE state = 'RUNNING' AND lease_expires <= $1) \
         OR EXISTS (SELECT 1 FROM jobs WHERE state = 'QUEUED' AND deadline IS NOT NULL AND deadline <= $2)) AS found",
    );
    connection.row(select.bind(micros(expired_at)).bind(micros(now))).await?.flag("found")
}

/// Ends queued jobs that are past their deadline, at most a hundred: the next sweep, a second later, takes the others,
/// and none takes longer than an operation may.
pub(super) async fn expire_queued(connection: &mut dyn Connection, now: SystemTime) -> Result<Vec<Job>, Error> {
    let select = Statement::new(select_locked_job!(
        "WHERE state = 'QUEUED' AND deadline IS NOT NULL AND deadline <= $1 ORDER BY id LIMIT 100"
    ))
    .bind(micros(now))
    .then(connection.skip_locked());
    let mut changed = Vec::new();
    for row in connection.rows(select).await? {
        let job = LockedJob::from_row(&row)?;
        changed.push(rows::transition(connection, &job, Transition::to(JobState::DeadlineExceeded), now).await?);
    }
    Ok(changed)
}
