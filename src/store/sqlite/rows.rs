//! Between rows and domain types, and the one place where a job's state changes together with its event.

use std::time::{Duration, SystemTime};

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::domain::job::{EventBody, Failure, Job, JobName, JobState};
use crate::store::record::Lease;
use crate::store::{Error, payload};

/// `SELECT` of all that [`job`] reads; the clauses follow.
macro_rules! select_jobs {
    ($clauses:literal) => {
        concat!(
            "SELECT id, tenant, job, state, attempt, settings, view_count, track_count, observation_count, labels, ",
            "priority, create_time, start_time, end_time, deadline, progress, last_sequence, summary, failure, ",
            "cancel_requested, trace_parent, queue_time FROM jobs ",
            $clauses
        )
    };
}
pub(super) use select_jobs;

/// Microseconds since the epoch; times outside of what an `i64` holds are clamped.
pub(super) fn micros(time: SystemTime) -> i64 {
    let after = |duration: Duration| i64::try_from(duration.as_micros()).unwrap_or(i64::MAX);
    match time.duration_since(SystemTime::UNIX_EPOCH) {
        Ok(since) => after(since),
        Err(before) => -after(before.duration()),
    }
}

/// The time of [`micros`].
pub(super) fn time(micros: i64) -> SystemTime {
    let distance = Duration::from_micros(micros.unsigned_abs());
    let there = if micros < 0 {
        SystemTime::UNIX_EPOCH.checked_sub(distance)
    } else {
        SystemTime::UNIX_EPOCH.checked_add(distance)
    };
    there.unwrap_or(SystemTime::UNIX_EPOCH)
}

/// A size or count as a column; nothing that exists comes near the largest.
pub(super) fn integer(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// A column that holds an unsigned number.
pub(super) fn unsigned<T: TryFrom<i64>>(row: &SqliteRow, column: &str) -> Result<T, Error> {
    let value: i64 = row.try_get(column)?;
    T::try_from(value).map_err(|_| Error::Corrupt(format!("{column} {value} is out of range")))
}

fn optional_time(row: &SqliteRow, column: &str) -> Result<Option<SystemTime>, Error> {
    Ok(row.try_get::<Option<i64>, _>(column)?.map(time))
}

fn optional_record<T: serde::de::DeserializeOwned>(row: &SqliteRow, column: &str) -> Result<Option<T>, Error> {
    let bytes: Option<Vec<u8>> = row.try_get(column)?;
    bytes.map(|bytes| payload::decode(&bytes, column)).transpose()
}

fn state(row: &SqliteRow) -> Result<JobState, Error> {
    let name: String = row.try_get("state")?;
    JobState::from_name(&name).ok_or_else(|| Error::Corrupt(format!("unknown state {name:?}")))
}

fn name(row: &SqliteRow) -> Result<JobName, Error> {
    Ok(JobName { tenant: row.try_get("tenant")?, job: row.try_get("job")? })
}

/// A job from a row of `select_jobs!`.
pub(super) fn job(row: &SqliteRow) -> Result<Job, Error> {
    let settings: Vec<u8> = row.try_get("settings")?;
    let labels: Vec<u8> = row.try_get("labels")?;
    Ok(Job {
        name: name(row)?,
        state: state(row)?,
        attempt: unsigned(row, "attempt")?,
        settings: payload::decode(&settings, "settings")?,
        view_count: unsigned(row, "view_count")?,
        track_count: unsigned(row, "track_count")?,
        observation_count: unsigned(row, "observation_count")?,
        labels: payload::decode(&labels, "labels")?,
        priority: row.try_get("priority")?,
        create_time: time(row.try_get("create_time")?),
        start_time: optional_time(row, "start_time")?,
        end_time: optional_time(row, "end_time")?,
        deadline: optional_time(row, "deadline")?,
        progress: optional_record(row, "progress")?,
        last_sequence: unsigned(row, "last_sequence")?,
        summary: optional_record(row, "summary")?,
        failure: optional_record(row, "failure")?,
        cancel_requested: row.try_get("cancel_requested")?,
    })
}

/// What the state machine needs to know of a job.
#[derive(Debug, Clone)]
pub(super) struct Standing {
    pub id: i64,
    pub name: JobName,
    pub state: JobState,
    pub attempt: u32,
    pub lost_attempts: u32,
    pub cancel_requested: bool,
    pub deadline: Option<SystemTime>,
}

impl Standing {
    /// From a row with `id, tenant, job, state, attempt, lost_attempts, cancel_requested, deadline`.
    pub(super) fn from_row(row: &SqliteRow) -> Result<Self, Error> {
        Ok(Self {
            id: row.try_get("id")?,
            name: name(row)?,
            state: state(row)?,
            attempt: unsigned(row, "attempt")?,
            lost_attempts: unsigned(row, "lost_attempts")?,
            cancel_requested: row.try_get("cancel_requested")?,
            deadline: optional_time(row, "deadline")?,
        })
    }
}

/// How a job stands.
pub(super) async fn standing(connection: &mut SqliteConnection, name: &JobName) -> Result<Standing, Error> {
    let row = sqlx::query(
        "SELECT id, tenant, job, state, attempt, lost_attempts, cancel_requested, deadline FROM jobs \
         WHERE tenant = ? AND job = ?",
    )
    .bind(&name.tenant)
    .bind(&name.job)
    .fetch_optional(connection)
    .await?;
    row.as_ref().map_or_else(|| Err(Error::NotFound(name.clone())), Standing::from_row)
}

/// How a job stands that this lease still holds: what every write of a worker begins with.
pub(super) async fn held(connection: &mut SqliteConnection, lease: &Lease) -> Result<Standing, Error> {
    match standing(connection, &lease.name).await {
        Ok(job) if job.state == JobState::Running && job.attempt == lease.attempt => Ok(job),
        Ok(_) | Err(Error::NotFound(_)) => Err(Error::Fenced(lease.clone())),
        Err(error) => Err(error),
    }
}

/// Appends an event and returns its sequence number.
pub(super) async fn append(
    connection: &mut SqliteConnection,
    id: i64,
    attempt: u32,
    body: &EventBody,
    now: SystemTime,
) -> Result<u64, Error> {
    let sequence: i64 =
        sqlx::query_scalar("UPDATE jobs SET last_sequence = last_sequence + 1 WHERE id = ? RETURNING last_sequence")
            .bind(id)
            .fetch_one(&mut *connection)
            .await?;
    sqlx::query("INSERT INTO events (job_id, sequence, attempt, time, body) VALUES (?, ?, ?, ?, ?)")
        .bind(id)
        .bind(sequence)
        .bind(attempt)
        .bind(micros(now))
        .bind(payload::encode(body)?)
        .execute(connection)
        .await?;
    Ok(sequence.unsigned_abs())
}

/// Moves a job out of its state, with the event that says so: to the queue, or to an end. Its lease ends with it.
pub(super) async fn leave(
    connection: &mut SqliteConnection,
    job: &Standing,
    next: JobState,
    failure: Option<Failure>,
    now: SystemTime,
) -> Result<(), Error> {
    if !job.state.may_become(next) || next == JobState::Running {
        let (from, to) = (job.state.name(), next.name());
        return Err(Error::Corrupt(format!("{} cannot go from {from} to {to} here", job.name)));
    }
    sqlx::query(
        "UPDATE jobs SET state = ?, lease_worker = NULL, lease_expires = NULL, cancel_requested = 0, \
         queue_time = COALESCE(?, queue_time), end_time = ?, failure = ? WHERE id = ?",
    )
    .bind(next.name())
    .bind((next == JobState::Queued).then(|| micros(now)))
    .bind(next.is_terminal().then(|| micros(now)))
    .bind(failure.as_ref().map(payload::encode).transpose()?)
    .bind(job.id)
    .execute(&mut *connection)
    .await?;
    append(connection, job.id, job.attempt, &EventBody::State { state: next, failure }, now).await?;
    Ok(())
}
