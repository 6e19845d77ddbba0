//! What an operator does to jobs and to the queue: retries, priorities, pauses, and a look at the whole.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::time::SystemTime;

use super::Size::{Payload, Small};
use super::WriteIntent::{Begins, Ends, Little};
use super::admission::AdmissionStats;
use super::operation::{reads, writes};
use super::rows::{self, Transition, micros, number, returning_job};
use super::{Database, Lock, Statement};
use crate::domain::job::{Job, JobName, JobState};
use crate::store::record::{ChangeReply, QueueReport, QueueStats, TenantQueue};
use crate::store::{Error, Notification, QueueBounds};

impl dyn Database {
    /// Puts a job that ended without a result into the queue again, as far as the bounds allow it: with its attempts
    /// counted anew, without a deadline that has passed, and without a caller that it depends on. One that waits or
    /// runs is left as it is. With an `etag`, only where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::Succeeded`], [`Error::QueueFull`].
    pub async fn retry_job(
        &self,
        name: &JobName,
        etag: Option<&str>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<ChangeReply, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "retry_job", Small, Begins(0), [name, etag, bounds], |connection| {
            // Before the job's row, as whoever creates jobs takes them: two in the other order would wait for each
            // other.
            connection.take_lock(Lock::Admission).await?;
            let job = connection.locked_job(&name, etag.as_deref()).await?;
            match job.state {
                JobState::Queued | JobState::Running => {
                    return Ok(ChangeReply { job: connection.job(&name).await?, by_this_call: false });
                }
                JobState::Succeeded => return Err(Error::Succeeded(name)),
                JobState::Failed | JobState::Cancelled | JobState::DeadlineExceeded => {}
            }
            let size = Statement::new("SELECT input_bytes, observation_count FROM jobs WHERE id = $1").bind(job.id);
            let size = connection.row(size).await?;
            let asked = QueueStats {
                queued: 1,
                queued_bytes: number(&size, "input_bytes")?,
                queued_observations: number(&size, "observation_count")?,
                ..QueueStats::default()
            };
            let (whole, tenant) = AdmissionStats::default().look(connection, &name.tenant, &bounds).await?;
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
            connection.renew_webhook(job.id).await?;
            let job = connection.transition(&job, Transition::to(JobState::Queued), now).await?;
            Ok(ChangeReply { job, by_this_call: true })
        })
    }

    /// Changes the priority of a queued job. With an `etag`, only where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::NotQueued`].
    pub async fn set_priority(&self, name: &JobName, etag: Option<&str>, priority: i32) -> Result<Job, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "set_priority", Small, Little, [name, etag], |connection| {
            let job = connection.locked_job(&name, etag.as_deref()).await?;
            if job.state != JobState::Queued {
                return Err(Error::NotQueued(name, job.state));
            }
            let update = Statement::new(returning_job!("UPDATE jobs SET priority = $1 WHERE id = $2"));
            rows::job(&connection.row(update.bind(priority).bind(job.id)).await?)
        })
    }

    /// Pauses the queue, in which no claim finds a job from then on, or resumes it; for every process and over
    /// restarts. What is so already stays as it is.
    pub async fn set_paused(&self, paused: bool, now: SystemTime) -> Result<(), Error> {
        writes!(self, "set_paused", Small, Ends(0), [], |connection| {
            if paused {
                let pause = Statement::new("UPDATE queue SET pause_time = COALESCE(pause_time, $1)").bind(micros(now));
                return connection.execute(pause).await;
            }
            connection.execute(Statement::new("UPDATE queue SET pause_time = NULL")).await?;
            connection.notify(Notification::Queued).await
        })
    }

    /// The queue as its administrator sees it, with at most `tenants` tenants.
    pub async fn queue(&self, tenants: u32) -> Result<QueueReport, Error> {
        // Counts every job that is kept.
        reads!(self, "queue", Payload, |connection| {
            let pause = connection.row(Statement::new("SELECT pause_time FROM queue")).await?;
            // One look, so that the counts of tenants add up to those of all. Each half is answered by an index alone.
            let counts = Statement::new(
                "SELECT state, tenant, COUNT(*) AS jobs FROM jobs WHERE state IN ('QUEUED', 'RUNNING') \
                 GROUP BY state, tenant UNION ALL \
                 SELECT state, '' AS tenant, COUNT(*) AS jobs FROM jobs WHERE end_time IS NOT NULL GROUP BY state",
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
        })
    }
}
