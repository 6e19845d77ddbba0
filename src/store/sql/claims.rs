//! Claims: the next job is begun, and the one after it prefetched.
//!
//! A prefetched job is queued and has a lease. It is begun by whoever comes first: the worker that has it in its hands,
//! one that finds no other job, or anyone once the lease has expired.
//!
//! A suspect, which lost attempts before, is begun only by a process in which nothing else runs. Other claims lease it
//! as a prefetched job, so that it stays with one process until that is idle, and extend this lease.

use std::time::{Duration, SystemTime};

use super::Size::Small;
use super::WriteIntent::Begins;
use super::operation::writes;
use super::rows::{self, LockedJob, insert_event, integer, micros, returning_job, select_locked_job};
use super::{Connection, Database, Lock, Row, Statement};
use crate::domain::job::{EventBody, JobState};
use crate::store::record::{Claim, Claimed, Claims, Lease, Prefetch};
use crate::store::{Error, Notification};
use crate::telemetry::metrics::store_operation;

impl dyn Database {
    /// Leases the next job in the queue and begins it; nothing where none waits, or the queue is paused. Tenants take
    /// turns, by their weights; within a tenant jobs go by priority, then age. Jobs past their deadline are left to
    /// `sweep`.
    ///
    /// The claim may also prefetch: it leases the job after it, which stays queued until a later claim begins it. Other
    /// claims pass over a prefetched job until that lease expires, but for those that find no other job. Nothing need
    /// be given back: a prefetched job that is not begun in time is any worker's, and no attempt was made.
    ///
    /// A suspect ([`Claim::suspect_after`]) is leased as long as a job that is begun, and not begun; a claim that is to
    /// begin it extends that lease, or ends it with a `lease_for` of zero. Where nothing else runs in the process, the
    /// claim begins it; the same claim once more, for want of an answer, gives the attempt that was begun.
    pub async fn claim(&self, claim: &Claim, now: SystemTime) -> Result<Claims, Error> {
        let _timer = store_operation("claim");
        // At once: `now` is what the wall clock showed at the call, and it may be set before the database answers.
        let lease_now = self.lease_clock(now);
        // Idle workers look for jobs again and again: a read is one question over the network, a transaction is three.
        let waits = "SELECT EXISTS \
                     (SELECT 1 FROM jobs WHERE state = 'QUEUED' AND (SELECT pause_time FROM queue) IS NULL) AS found";
        if self.is_shared() && claim.begin.is_none() && !self.finds(Statement::new(waits)).await? {
            return Ok(Claims::default());
        }
        writes!(self, Small, Begins(0), [claim], |connection| {
            Claiming { connection, claim: &claim, now, lease_now }.run().await
        })
    }
}

/// A claim under way.
struct Claiming<'a> {
    connection: &'a mut dyn Connection,
    claim: &'a Claim,
    now: SystemTime,
    /// Now, on the clock of leases.
    lease_now: SystemTime,
}

impl Claiming<'_> {
    async fn run(mut self) -> Result<Claims, Error> {
        if self.claim.shares.max_running.is_some() {
            // Two that count at once would pass the bound together.
            self.connection.take_lock(Lock::Claims).await?;
        }
        let job = match &self.claim.begin {
            Some((lease, created)) => self.prefetched(lease, *created).await?,
            None => match self.next(|_| true).await? {
                Some(job) => Some(job),
                None => self.prefetched_by_any().await?,
            },
        };
        let Some(job) = job else {
            return Ok(Claims { begun: self.begun_before().await?, ..Claims::default() });
        };
        if is_suspect(self.claim, &job) {
            let suspect = self.lease(&job, self.claim.lease_for).await?;
            return Ok(Claims { suspect: Some(suspect), ..Claims::default() });
        }
        let begun = self.begin(&job).await?;
        let prefetched = match self.claim.prefetch {
            Some(terms) => self.prefetch(terms).await?,
            None => None,
        };
        Ok(Claims { begun: Some(begun), prefetched, suspect: None })
    }

    /// The job whose turn it is among those that nobody has a lease on, counted for its tenant; none where it is not
    /// `wanted`.
    async fn next(&mut self, wanted: impl Fn(&LockedJob) -> bool) -> Result<Option<LockedJob>, Error> {
        for tenant in self.connection.turns(self.claim, self.lease_now).await? {
            let first = Statement::new(select_locked_job!(
                "WHERE state = 'QUEUED' AND tenant = $1 AND (deadline IS NULL OR deadline > $2) \
                 AND (lease_expires IS NULL OR lease_expires <= $3) ORDER BY priority DESC, create_time, id LIMIT 1"
            ))
            .bind(&tenant)
            .bind(micros(self.now))
            .bind(micros(self.lease_now))
            .then(self.connection.skip_locked());
            if let Some(row) = self.connection.optional_row(first).await? {
                let job = LockedJob::from_row(&row)?;
                if !wanted(&job) {
                    break;
                }
                self.connection.count_turn(&self.claim.shares, &tenant).await?;
                return Ok(Some(job));
            }
        }
        Ok(None)
    }

    /// The job that an earlier claim of this worker prefetched, if nobody else has leased it since.
    async fn prefetched(&mut self, lease: &Lease, created: SystemTime) -> Result<Option<LockedJob>, Error> {
        // One whose lease has expired is not among those that are counted for the bound.
        let expires_after = self.claim.shares.max_running.map_or(i64::MIN, |_| micros(self.lease_now));
        let same = Statement::new(select_locked_job!(
            "WHERE tenant = $1 AND job = $2 AND attempt = $3 AND create_time = $4 AND state = 'QUEUED' \
             AND (deadline IS NULL OR deadline > $5) AND lease_worker = $6 AND lease_expires > $7 \
             AND (SELECT pause_time FROM queue) IS NULL"
        ))
        .bind(&lease.name.tenant)
        .bind(&lease.name.job)
        .bind(lease.attempt.saturating_sub(1))
        .bind(micros(created))
        .bind(micros(self.now))
        .bind(&self.claim.worker)
        .bind(expires_after)
        .then(self.connection.for_update());
        self.one_locked(same).await
    }

    /// The job that an earlier claim of this process has begun, where the answer was lost: its lease is extended. Of a
    /// process in which nothing else runs; in another one a worker has it.
    async fn begun_before(&mut self) -> Result<Option<Claimed>, Error> {
        let (Some((lease, created)), None) = (&self.claim.begin, self.claim.suspect_after) else { return Ok(None) };
        let extend = Statement::new(returning_job!(
            "UPDATE jobs SET lease_expires = $1 WHERE tenant = $2 AND job = $3 AND attempt = $4 AND create_time = $5 \
             AND state = 'RUNNING' AND lease_worker = $6"
        ))
        .bind(micros(self.lease_now + self.claim.lease_for))
        .bind(&lease.name.tenant)
        .bind(&lease.name.job)
        .bind(lease.attempt)
        .bind(micros(*created))
        .bind(&self.claim.worker);
        self.connection.optional_row(extend).await?.map(|row| claimed(&row, 0)).transpose()
    }

    /// A job that any worker has prefetched: it would wait for that worker, and this one is idle. There are as many as
    /// workers at most, and their tenants' turns have come. A suspect stays with the process that waits to be idle.
    async fn prefetched_by_any(&mut self) -> Result<Option<LockedJob>, Error> {
        let first = Statement::new(select_locked_job!(
            "WHERE state = 'QUEUED' AND lease_expires IS NOT NULL AND lease_expires > $1 \
             AND (deadline IS NULL OR deadline > $2) AND lost_attempts < $3 \
             AND (SELECT pause_time FROM queue) IS NULL \
             ORDER BY priority DESC, create_time, id LIMIT 1"
        ))
        .bind(micros(self.lease_now))
        .bind(micros(self.now))
        .bind(self.claim.suspect_after.map_or(i64::MAX, i64::from))
        .then(self.connection.skip_locked());
        self.one_locked(first).await
    }

    async fn one_locked(&mut self, select: Statement) -> Result<Option<LockedJob>, Error> {
        self.connection.optional_row(select).await?.as_ref().map(LockedJob::from_row).transpose()
    }

    /// Begins an attempt at a queued job.
    async fn begin(&mut self, job: &LockedJob) -> Result<Claimed, Error> {
        let (attempt, sequence) = (job.attempt + 1, job.last_sequence + 1);
        let lease = Statement::new(returning_job!(
            "UPDATE jobs SET state = 'RUNNING', attempt = $1, start_time = COALESCE(start_time, $2), lease_worker = $3, \
             lease_expires = $4, progress = NULL, last_sequence = $5 WHERE id = $6"
        ))
        .bind(attempt)
        .bind(micros(self.now))
        .bind(&self.claim.worker)
        .bind(micros(self.lease_now + self.claim.lease_for))
        .bind(integer(sequence))
        .bind(job.id);
        let begin =
            Statement::new("INSERT INTO attempts (job_id, attempt, server, start_time) VALUES ($1, $2, $3, $4)")
                .bind(job.id)
                .bind(attempt)
                .bind(&self.claim.worker)
                .bind(micros(self.now));
        let event = EventBody::State { state: JobState::Running, failure: None };
        let event = insert_event(job.id, sequence, attempt, &event, self.now)?;
        let rows = self.connection.batch(vec![lease, begin, event]).await?;
        self.connection.notify(Notification::Events(job.name.clone())).await?;
        let changed = rows.first().ok_or_else(|| Error::Corrupt("a job that was just leased is not there".into()))?;
        claimed(changed, 0)
    }

    /// Leases the next job without a word to anyone: it is not begun.
    async fn prefetch(&mut self, terms: Prefetch) -> Result<Option<Claimed>, Error> {
        let claim = self.claim;
        let wanted = |job: &LockedJob| job.observation_count <= terms.max_observations && !is_suspect(claim, job);
        let Some(job) = self.next(wanted).await? else { return Ok(None) };
        self.lease(&job, terms.lease_for).await.map(Some)
    }

    /// Leases a queued job that is not begun.
    async fn lease(&mut self, job: &LockedJob, lease_for: Duration) -> Result<Claimed, Error> {
        let lease =
            Statement::new(returning_job!("UPDATE jobs SET lease_worker = $1, lease_expires = $2 WHERE id = $3"))
                .bind(&self.claim.worker)
                .bind(micros(self.lease_now + lease_for))
                .bind(job.id);
        claimed(&self.connection.row(lease).await?, 1)
    }
}

/// Whether a job is to be begun once nothing else runs in the process.
fn is_suspect(claim: &Claim, job: &LockedJob) -> bool {
    claim.suspect_after.is_some_and(|lost| job.lost_attempts >= lost)
}

/// A job with its lease, from a row of all its columns. `earlier`: attempts that are to be begun before the lease's.
fn claimed(row: &Row, earlier: u32) -> Result<Claimed, Error> {
    let job = rows::job(row)?;
    Ok(Claimed {
        lease: Lease { name: job.name.clone(), attempt: job.attempt + earlier },
        job,
        trace_parent: row.optional_text("trace_parent")?,
        queue_time: rows::time(row.integer("queue_time")?),
    })
}
