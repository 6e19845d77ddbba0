//! Leases: keeping, ending and losing them. `claims` is where they begin.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use super::Size::Small;
use super::WriteIntent::{Ends, Little};
use super::operation::{bounded, writes};
use super::rows::{self, LockedJob, Transition, end_attempt, insert_event, integer, micros, number, select_locked_job};
use super::{Connection, Database, Row, Size, Statement};
use crate::domain::job::{AttemptEnd, EventBody, Failure, Job, JobName, JobState, PastAttempt};
use crate::domain::progress::Progress;
use crate::store::record::{ChangeReply, Ending, Heartbeat, Lease, Outcome, Swept};
use crate::store::{ATTEMPTS_EXHAUSTED, Error, Notification, payload};
use crate::telemetry::metrics::store_operation;

/// Attempts that a failure tells of, the latest ones: those given back at a drain do not count against the cap, and
/// there is no bound on them.
const MOST_PAST_ATTEMPTS: u32 = 16;

impl dyn Database {
    /// Extends a lease and brings back what its holder must know.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    pub async fn heartbeat(&self, lease: &Lease, now: SystemTime, lease_for: Duration) -> Result<Heartbeat, Error> {
        let expires = self.lease_clock(now) + lease_for;
        writes!(self, "heartbeat", Small, Ends(0), [lease], |connection| {
            let job = connection.held(&lease).await?;
            let extend = Statement::new("UPDATE jobs SET lease_expires = $1 WHERE id = $2").bind(micros(expires));
            connection.execute(extend.bind(job.id)).await?;
            Ok(Heartbeat { cancel_requested: job.cancel_requested, deadline: job.deadline })
        })
    }

    /// Appends a progress event; returns its sequence number.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    pub async fn record(&self, lease: &Lease, progress: &Progress, now: SystemTime) -> Result<u64, Error> {
        let progress = *progress;
        writes!(self, "record", Small, Little, [lease], |connection| {
            let job = connection.held(&lease).await?;
            let sequence = job.last_sequence + 1;
            let update = Statement::new("UPDATE jobs SET progress = $1, last_sequence = $2 WHERE id = $3")
                .bind(payload::encode(&progress)?)
                .bind(integer(sequence))
                .bind(job.id);
            let event = insert_event(job.id, sequence, job.attempt, &EventBody::Progress(progress), now)?;
            connection.batch(vec![update, event]).await?;
            connection.notify(Notification::Events(job.name.clone())).await?;
            Ok(sequence)
        })
    }

    /// Ends an attempt and its job, with the result where there is one. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    pub async fn finish(&self, lease: &Lease, ending: &Arc<Ending>, now: SystemTime) -> Result<Job, Error> {
        let bytes = match &ending.outcome {
            Outcome::Succeeded { result, .. } => result.bytes.len() as u64,
            Outcome::Failed(_) | Outcome::Cancelled | Outcome::DeadlineExceeded => 0,
        };
        writes!(self, "finish", Size::Outcome, Ends(bytes), [lease, ending], |connection| {
            let job = connection.held(&lease).await?;
            let mut transition = Transition::to(ending.outcome.state());
            transition.progress = ending.progress.as_ref();
            transition.attempt_end = Some(AttemptEnd::Ended);
            match &ending.outcome {
                Outcome::Succeeded { summary, result } => {
                    for (chunk, data) in (0_i64..).zip(result.bytes.chunks(payload::CHUNK_BYTES)) {
                        let insert = "INSERT INTO result_chunks (job_id, chunk, data) VALUES ($1, $2, $3)";
                        connection.execute(Statement::new(insert).bind(job.id).bind(chunk).bind(data)).await?;
                    }
                    transition.summary = Some(summary);
                    transition.result_sha256 = Some(&result.sha256);
                }
                Outcome::Failed(failure) => transition.failure = Some(failure.clone()),
                Outcome::Cancelled | Outcome::DeadlineExceeded => {}
            }
            connection.transition(&job, transition, now).await
        })
    }

    /// Gives a lease back. The job returns to the queue, or ends if its cancel was asked for; the attempt does not
    /// count against the cap. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    pub async fn release(&self, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
        writes!(self, "release", Small, Ends(0), [lease], |connection| {
            let job = connection.held(&lease).await?;
            let next = if job.cancel_requested { JobState::Cancelled } else { JobState::Queued };
            let transition = Transition { attempt_end: Some(AttemptEnd::GivenBack), ..Transition::to(next) };
            connection.transition(&job, transition, now).await
        })
    }

    /// Asks for the end of a job: a queued one ends at once, a running one is flagged for its worker, an ended one is
    /// left as it is. With an `etag`, only where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`].
    pub async fn request_cancel(
        &self,
        name: &JobName,
        etag: Option<&str>,
        now: SystemTime,
    ) -> Result<ChangeReply, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "request_cancel", Small, Ends(0), [name, etag], |connection| {
            let job = connection.locked_job(&name, etag.as_deref()).await?;
            let ended_now = job.state == JobState::Queued;
            if ended_now {
                connection.transition(&job, Transition::to(JobState::Cancelled), now).await?;
            } else if job.state == JobState::Running {
                let update = Statement::new("UPDATE jobs SET cancel_requested = TRUE WHERE id = $1");
                connection.execute(update.bind(job.id)).await?;
                connection.notify(Notification::Cancel(name.clone())).await?;
            }
            Ok(ChangeReply { job: connection.job(&name).await?, by_this_call: ended_now })
        })
    }

    /// Takes back every lease that no living process can hold: all of them where one process has the store to itself,
    /// those that ran out where it is shared. Called once, before the first claim. A job that lost `max_attempts`
    /// attempts this way fails with `ATTEMPTS_EXHAUSTED`. Returns the jobs that changed.
    pub async fn recover(&self, now: SystemTime, max_attempts: u32) -> Result<Vec<Job>, Error> {
        // Where no other process can be at work, every lease is a dead one's.
        let expired_at = self.is_shared().then(|| self.lease_clock(now));
        writes!(self, "recover", Small, Ends(0), [], |connection| {
            connection.take_back(expired_at, now, max_attempts).await
        })
    }

    /// Takes back leases that ran out, as `recover` does, and ends queued jobs that are past their deadline.
    pub async fn sweep(&self, now: SystemTime, max_attempts: u32) -> Result<Swept, Error> {
        let _timer = store_operation("sweep");
        // Before the clocks are compared: see `claim`.
        let expired_at = self.lease_clock(now);
        bounded(self, Small, self.set_lease_clock()).await?;
        // Most sweeps find nothing: a look spares the writer, and the disk, a transaction.
        let select = Statement::new(
            "SELECT (EXISTS (SELECT 1 FROM jobs WHERE state = 'RUNNING' AND lease_expires <= $1) OR EXISTS \
             (SELECT 1 FROM jobs WHERE state = 'QUEUED' AND deadline IS NOT NULL AND deadline <= $2)) AS found",
        );
        if !self.finds(select.bind(micros(expired_at)).bind(micros(now))).await? {
            return Ok(Swept::default());
        }
        writes!(self, Small, Ends(0), [], |connection| {
            let lost = connection.take_back(Some(expired_at), now, max_attempts).await?;
            let expired = connection.expire_queued(now).await?;
            Ok(Swept { lost, expired })
        })
    }
}

impl dyn Connection + '_ {
    /// Takes back the leases that ran out at `expired_at`, or all of them.
    async fn take_back(
        &mut self,
        expired_at: Option<SystemTime>,
        now: SystemTime,
        max_attempts: u32,
    ) -> Result<Vec<Job>, Error> {
        let select = Statement::new(select_locked_job!("WHERE state = 'RUNNING' AND lease_expires <= $1 ORDER BY id"))
            .bind(expired_at.map_or(i64::MAX, micros))
            .then(self.skip_locked());
        if expired_at.is_none() {
            // Nor is anything prefetched that a process of before had leased.
            let free = "UPDATE jobs SET lease_worker = NULL, lease_expires = NULL \
                        WHERE state = 'QUEUED' AND lease_expires IS NOT NULL";
            self.execute(Statement::new(free)).await?;
        }
        let mut changed = Vec::new();
        for row in self.rows(select).await? {
            let job = LockedJob::from_row(&row)?;
            let lost_attempts = job.lost_attempts + 1;
            let update = Statement::new("UPDATE jobs SET lost_attempts = $1 WHERE id = $2");
            self.execute(update.bind(lost_attempts).bind(job.id)).await?;
            self.execute(end_attempt(&job, AttemptEnd::Lost, now)).await?;
            let next = after_loss(&job, lost_attempts, now, max_attempts);
            let failure = match next {
                JobState::Failed => Some(self.exhausted(&job, lost_attempts, max_attempts).await?),
                _ => None,
            };
            let transition = Transition { failure, ..Transition::to(next) };
            changed.push(self.transition(&job, transition, now).await?);
        }
        Ok(changed)
    }

    /// Why a job failed that lost too many attempts, and what became of each.
    async fn exhausted(&mut self, job: &LockedJob, lost_attempts: u32, max_attempts: u32) -> Result<Failure, Error> {
        let select = Statement::new(
            "SELECT attempt, server, start_time, end_time, ending FROM attempts WHERE job_id = $1 \
             ORDER BY attempt DESC LIMIT $2",
        );
        let rows = self.rows(select.bind(job.id).bind(MOST_PAST_ATTEMPTS)).await?;
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

    /// Ends queued jobs that are past their deadline, at most a hundred: the next sweep, a second later, takes the
    /// others, and none takes longer than an operation may.
    async fn expire_queued(&mut self, now: SystemTime) -> Result<Vec<Job>, Error> {
        let select = Statement::new(select_locked_job!(
            "WHERE state = 'QUEUED' AND deadline IS NOT NULL AND deadline <= $1 ORDER BY id LIMIT 100"
        ))
        .bind(micros(now))
        .then(self.skip_locked());
        let mut changed = Vec::new();
        for row in self.rows(select).await? {
            let job = LockedJob::from_row(&row)?;
            changed.push(self.transition(&job, Transition::to(JobState::DeadlineExceeded), now).await?);
        }
        Ok(changed)
    }
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
