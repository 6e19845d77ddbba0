//! Between rows and domain types, and the one place where a job's state changes together with its event.

use std::time::{Duration, SystemTime};

use super::{Connection, Row, Statement, webhooks};
use crate::domain::InputName;
use crate::domain::job::{AttachedCalls, AttemptEnd, EventBody, Failure, Job, JobName, JobState, Summary};
use crate::domain::progress::Progress;
use crate::store::query::{Cursor, Page, Paged};
use crate::store::record::Lease;
use crate::store::{Error, Notification, payload};

/// Columns that [`job`] reads.
macro_rules! job_columns {
    () => {
        "id, tenant, job, state, attempt, settings, view_count, track_count, observation_count, labels, priority, \
         create_time, start_time, end_time, deadline, progress, last_sequence, summary, failure, cancel_requested, \
         trace_parent, queue_time, uploaded_input, attached_calls, detached_calls, \
         (SELECT webhook FROM webhooks WHERE job_id = jobs.id) AS webhook"
    };
}
pub(super) use job_columns;

/// `SELECT` of all that [`job`] reads; the clauses follow.
macro_rules! select_jobs {
    ($clauses:literal) => {
        concat!("SELECT ", $crate::store::sql::rows::job_columns!(), " FROM jobs ", $clauses)
    };
}
pub(super) use select_jobs;

/// A statement that changes one job and returns all that [`job`] reads of it.
macro_rules! returning_job {
    ($change:literal) => {
        concat!($change, " RETURNING ", $crate::store::sql::rows::job_columns!())
    };
}
pub(super) use returning_job;

/// Microseconds since the epoch; times outside of what an `i64` holds are clamped.
pub(in crate::store) fn micros(time: SystemTime) -> i64 {
    match time.duration_since(SystemTime::UNIX_EPOCH) {
        Ok(since) => as_micros(since),
        Err(before) => -as_micros(before.duration()),
    }
}

/// Microseconds of a duration, clamped likewise.
pub(in crate::store) fn as_micros(duration: Duration) -> i64 {
    i64::try_from(duration.as_micros()).unwrap_or(i64::MAX)
}

/// The time of [`micros`].
pub(in crate::store) fn time(micros: i64) -> SystemTime {
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

/// A column that holds a number of this type.
pub(super) fn number<T: TryFrom<i64>>(row: &Row, column: &str) -> Result<T, Error> {
    let value = row.integer(column)?;
    T::try_from(value).map_err(|_| Error::Corrupt(format!("{column} {value} is out of range")))
}

fn optional_time(row: &Row, column: &str) -> Result<Option<SystemTime>, Error> {
    Ok(row.optional_integer(column)?.map(time))
}

fn optional_record<T: serde::de::DeserializeOwned>(row: &Row, column: &str) -> Result<Option<T>, Error> {
    row.optional_bytes(column)?.map(|bytes| payload::decode(bytes, column)).transpose()
}

pub(super) fn state(row: &Row) -> Result<JobState, Error> {
    let name = row.text("state")?;
    JobState::from_name(&name).ok_or_else(|| Error::Corrupt(format!("unknown state {name:?}")))
}

pub(super) fn name(row: &Row) -> Result<JobName, Error> {
    Ok(JobName { tenant: row.text("tenant")?, job: row.text("job")? })
}

fn attached_calls(row: &Row) -> Result<Option<AttachedCalls>, Error> {
    let Some(_) = row.optional_integer("attached_calls")? else { return Ok(None) };
    Ok(Some(AttachedCalls { attached: number(row, "attached_calls")?, detached: number(row, "detached_calls")? }))
}

/// A job from a row of `select_jobs!`.
pub(super) fn job(row: &Row) -> Result<Job, Error> {
    let name = name(row)?;
    let input = row.optional_text("uploaded_input")?.map(|input| InputName { tenant: name.tenant.clone(), input });
    Ok(Job {
        name,
        input,
        state: state(row)?,
        attempt: number(row, "attempt")?,
        settings: payload::decode(row.bytes("settings")?, "settings")?,
        view_count: number(row, "view_count")?,
        track_count: number(row, "track_count")?,
        observation_count: number(row, "observation_count")?,
        labels: payload::decode(row.bytes("labels")?, "labels")?,
        priority: number(row, "priority")?,
        create_time: time(row.integer("create_time")?),
        start_time: optional_time(row, "start_time")?,
        end_time: optional_time(row, "end_time")?,
        deadline: optional_time(row, "deadline")?,
        progress: optional_record(row, "progress")?,
        last_sequence: number(row, "last_sequence")?,
        summary: optional_record(row, "summary")?,
        failure: optional_record(row, "failure")?,
        cancel_requested: row.flag("cancel_requested")?,
        attached_calls: attached_calls(row)?,
        // Retention is the engine's; it says until when.
        expire_time: None,
        webhook: optional_record(row, "webhook")?,
    })
}

/// What the state machine needs to know of a job whose row the transaction has locked.
#[derive(Debug, Clone)]
pub(super) struct LockedJob {
    pub id: i64,
    pub name: JobName,
    pub state: JobState,
    pub attempt: u32,
    pub lost_attempts: u32,
    pub cancel_requested: bool,
    pub deadline: Option<SystemTime>,
    /// Number of its latest event.
    pub last_sequence: u64,
    pub observation_count: u32,
}

impl LockedJob {
    /// From a row of `select_locked_job!`.
    pub(super) fn from_row(row: &Row) -> Result<Self, Error> {
        Ok(Self {
            id: row.integer("id")?,
            name: name(row)?,
            state: state(row)?,
            attempt: number(row, "attempt")?,
            lost_attempts: number(row, "lost_attempts")?,
            cancel_requested: row.flag("cancel_requested")?,
            deadline: optional_time(row, "deadline")?,
            last_sequence: number(row, "last_sequence")?,
            observation_count: number(row, "observation_count")?,
        })
    }
}

/// `SELECT` of all that [`LockedJob::from_row`] reads; the clauses follow.
macro_rules! select_locked_job {
    ($clauses:literal) => {
        concat!(
            "SELECT id, tenant, job, state, attempt, lost_attempts, cancel_requested, deadline, last_sequence, ",
            "observation_count FROM jobs ",
            $clauses
        )
    };
}
pub(super) use select_locked_job;

/// Stores an event of a job of this row; whoever runs it counts it in the row.
pub(super) fn insert_event(
    id: i64,
    sequence: u64,
    attempt: u32,
    body: &EventBody,
    now: SystemTime,
) -> Result<Statement, Error> {
    let insert = "INSERT INTO events (job_id, sequence, attempt, time, body) VALUES ($1, $2, $3, $4, $5)";
    let insert = Statement::new(insert).bind(id).bind(integer(sequence)).bind(attempt).bind(micros(now));
    Ok(insert.bind(payload::encode(body)?))
}

/// Notes how the latest attempt of a job ended.
pub(super) fn end_attempt(job: &LockedJob, end: AttemptEnd, now: SystemTime) -> Statement {
    Statement::new("UPDATE attempts SET end_time = $1, ending = $2 WHERE job_id = $3 AND attempt = $4")
        .bind(micros(now))
        .bind(end.name())
        .bind(job.id)
        .bind(job.attempt)
}

/// The next state of a job, and what is stored with it.
#[derive(Debug)]
pub(super) struct Transition<'a> {
    pub next: JobState,
    pub failure: Option<Failure>,
    /// Of a success: it has an event of its own.
    pub summary: Option<&'a Summary>,
    pub result_sha256: Option<&'a [u8; 32]>,
    /// The last progress, where it is newer than what is stored.
    pub progress: Option<&'a Progress>,
    /// How its attempt ended, where that is not noted yet.
    pub attempt_end: Option<AttemptEnd>,
}

impl Transition<'_> {
    /// One with which nothing else is stored.
    pub(super) fn to(next: JobState) -> Self {
        Self { next, failure: None, summary: None, result_sha256: None, progress: None, attempt_end: None }
    }
}

impl dyn Connection + '_ {
    /// The page that a query asks for, of what `select` finds beyond its cursor, in order. `id` is the column that
    /// tells those of one time apart.
    pub(super) async fn page<T>(
        &mut self,
        query: &(impl Paged + Sync),
        select: Statement,
        id: &str,
        item: impl Fn(&Row) -> Result<T, Error>,
    ) -> Result<Page<T>, Error> {
        let size = query.effective_page_size();
        // One more tells whether there is a next page.
        let mut rows = self.rows(select.then(" LIMIT ").then_bind(i64::from(size) + 1)).await?;
        let more = rows.len() > size as usize;
        rows.truncate(size as usize);
        let next_page_token = match rows.last() {
            Some(last) if more => {
                let cursor = Cursor { create_micros: last.integer("create_time")?, id: last.text(id)? };
                Some(query.token_after(&cursor))
            }
            _ => None,
        };
        Ok(Page { items: rows.iter().map(item).collect::<Result<_, _>>()?, next_page_token })
    }

    /// Locks a job: it does not change until the transaction ends. With an `etag`, refuses where the caller saw the job
    /// in another shape.
    pub(super) async fn locked_job(&mut self, name: &JobName, etag: Option<&str>) -> Result<LockedJob, Error> {
        let select = Statement::new(select_locked_job!("WHERE tenant = $1 AND job = $2"))
            .bind(&name.tenant)
            .bind(&name.job)
            .then(self.for_update());
        let row = self.optional_row(select).await?.ok_or_else(|| Error::NotFound(name.clone()))?;
        if let Some(etag) = etag
            && self.job(name).await?.etag() != etag
        {
            return Err(Error::EtagMismatch(name.clone()));
        }
        LockedJob::from_row(&row)
    }

    /// Locks a job that this lease still holds: what every write of a worker begins with.
    pub(super) async fn held(&mut self, lease: &Lease) -> Result<LockedJob, Error> {
        match self.locked_job(&lease.name, None).await {
            Ok(job) if job.state == JobState::Running && job.attempt == lease.attempt => Ok(job),
            Ok(_) | Err(Error::NotFound(_)) => Err(Error::Fenced(lease.clone())),
            Err(error) => Err(error),
        }
    }

    /// Moves a job out of its state, with the event that says so: to the queue, or to an end. Its lease ends with it.
    /// Returns the job as it stands then.
    pub(super) async fn transition(
        &mut self,
        job: &LockedJob,
        transition: Transition<'_>,
        now: SystemTime,
    ) -> Result<Job, Error> {
        let Transition { next, failure, summary, result_sha256, progress, attempt_end } = transition;
        if !job.state.may_become(next) || next == JobState::Running {
            let (from, to) = (job.state.name(), next.name());
            return Err(Error::Corrupt(format!("{} cannot go from {from} to {to} here", job.name)));
        }
        let end = attempt_end.map(|end| end_attempt(job, end, now));
        let mut batch: Vec<Statement> = end.into_iter().collect();
        let mut sequence = job.last_sequence;
        if let Some(summary) = summary {
            sequence += 1;
            batch.push(insert_event(job.id, sequence, job.attempt, &EventBody::Summary(summary.clone()), now)?);
        }
        sequence += 1;
        let encoded_failure = failure.as_ref().map(payload::encode).transpose()?;
        batch.push(insert_event(job.id, sequence, job.attempt, &EventBody::State { state: next, failure }, now)?);
        let update = Statement::new(returning_job!(
            "UPDATE jobs SET state = $1, lease_worker = NULL, lease_expires = NULL, cancel_requested = FALSE, \
             queue_time = COALESCE($2, queue_time), end_time = $3, failure = $4, summary = COALESCE($5, summary), \
             progress = COALESCE($6, progress), last_sequence = $7, result_sha256 = $8 WHERE id = $9"
        ))
        .bind(next.name())
        .bind((next == JobState::Queued).then(|| micros(now)))
        .bind(next.is_terminal().then(|| micros(now)))
        .bind(encoded_failure)
        .bind(summary.map(payload::encode).transpose()?)
        .bind(progress.map(payload::encode).transpose()?)
        .bind(integer(sequence))
        .bind(result_sha256.map(|sha256| sha256.to_vec()))
        .bind(job.id);
        batch.push(update);
        let changed = match self.batch(batch).await?.first() {
            Some(row) => self::job(row)?,
            None => return Err(Error::Corrupt("a job that was just changed is not there".into())),
        };
        if changed.webhook.is_some() && next.is_terminal() {
            self.execute(webhooks::due(job.id)).await?;
        }
        self.notify(Notification::Events(job.name.clone())).await?;
        if next == JobState::Queued {
            self.notify(Notification::Queued).await?;
        }
        Ok(changed)
    }
}
