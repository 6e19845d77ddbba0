//! The store that every database makes: one transaction an operation, within a bound of time, and measured.

use std::future::Future;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use futures_util::FutureExt;

use super::Size::{Payload, Small};
use super::WriteIntent::{Begins, Ends, Little};
use super::{Connection, Database, Operation, Size, WriteIntent, admin, attempts, claims, jobs, operation, removal};
use crate::domain::InputName;
use crate::domain::job::{Job, JobEvent, JobName};
use crate::domain::progress::Progress;
use crate::store::record::{
    ChangeReply, Claim, Claims, EncodedResult, Ending, Heartbeat, JobInput, JobPayload, Lease, NewRecord, Outcome,
    PassedOver, QueueReport, QueueStats, Request, StoreStats, Swept, WebhookOutcome, WebhookQueue,
};
use crate::store::upload::{BegunUpload, NewInput, NewUpload, PurgedUploads, StoredInput, UploadLease, UploadStatus};
use crate::store::{Error, InputQuery, JobQuery, Page, QueueBounds, UploadBounds};
use crate::telemetry::metrics::{store_operation, write_fenced};

/// Waits for an operation as long as the database allows it. One that is broken off changed nothing, or all that it was
/// to change: a commit may have been on its way.
async fn bounded<T>(
    database: &dyn Database,
    size: Size,
    operation: impl Future<Output = Result<T, Error>> + Send,
) -> Result<T, Error> {
    let Some(bound) = database.bound(size) else { return operation.await };
    match tokio::time::timeout(bound, operation).await {
        Ok(result) => result,
        Err(_) => Err(Error::Unavailable(format!("no answer within {} s", bound.as_secs_f64()))),
    }
}

/// Times an operation, failed ones too: a slow failure is still slow. Counts the writes whose lease was gone.
async fn measured<T>(operation: &'static str, run: impl Future<Output = Result<T, Error>> + Send) -> Result<T, Error> {
    let _timer = store_operation(operation);
    let result = run.await;
    if let Err(Error::Fenced(_)) = &result {
        write_fenced(operation);
    }
    result
}

/// Reads through a connection of its own; measured where the operation is named.
macro_rules! reads {
    ($database:expr, $operation:literal, $size:expr, |$connection:ident| $body:expr) => {
        measured($operation, async { reads!($database, $size, |$connection| $body) }).await
    };
    ($database:expr, $size:expr, |$connection:ident| $body:expr) => {
        bounded($database, $size, async {
            let mut reader = $database.reader($size).await?;
            let $connection = &mut *reader;
            $body.await
        })
        .await
    };
}

/// What an operation gave in the transaction that was committed.
async fn written<T: Send + 'static>(
    database: &dyn Database,
    size: Size,
    intent: WriteIntent,
    run: Operation<dyn Connection, T>,
) -> Result<T, Error> {
    let latest = Arc::new(Mutex::new(None));
    let keep = latest.clone();
    let run_and_keep = operation::<dyn Connection, _>(move |connection| {
        let (running, keep) = (run(connection), keep.clone());
        async move {
            let value = running.await?;
            *keep.lock().unwrap_or_else(PoisonError::into_inner) = Some(value);
            Ok(())
        }
        .boxed()
    });
    database.write(size, intent, run_and_keep).await?;
    let value = latest.lock().unwrap_or_else(PoisonError::into_inner).take();
    value.ok_or_else(|| Error::Corrupt("an operation was committed without an answer".into()))
}

/// Bytes of what removes as much as there is.
const ANY_BYTES: u64 = u64::MAX;

/// Writes in one transaction, which has the values in brackets to itself: a caller that goes away leaves it whole. They
/// are cloned for each run of it; what is large is in an [`Arc`]. Measured where the operation is named.
macro_rules! writes {
    ($database:expr, $operation:literal, $size:expr, $intent:expr, $owned:tt, |$connection:ident| $body:expr) => {
        measured($operation, async { writes!($database, $size, $intent, $owned, |$connection| $body) }).await
    };
    ($database:expr, $size:expr, $intent:expr, [$($owned:ident),*], |$connection:ident| $body:expr) => {{
        let intent: WriteIntent = $intent;
        $(let $owned = $owned.clone();)*
        let run = operation::<dyn Connection, _>(move |$connection| {
            $(let $owned = $owned.clone();)*
            async move { $body.await }.boxed()
        });
        bounded($database, $size, written($database, $size, intent, run)).await
    }};
}

// After the macros, which they use.
mod uploads;
mod webhooks;

/// A store of jobs. Every operation is one transaction: state, event and lease change together or not at all.
///
/// `now` is the caller's clock, so that tests need not wait; times are kept to the microsecond.
impl dyn Database {
    /// Stores queued jobs with their inputs and their first events, all or none, unless the request id of one is known
    /// or admission refuses; the answers are in their order. A request id that comes twice with the same body is one
    /// job: with [`NewRecord::cancel_on_disconnect`] the call attaches to it, as far as it depends on its calls
    /// ([`Job::attached_calls`]), and without it does not depend on any from then on.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`], [`Error::QueueFull`], [`Error::BatchTooLarge`], of the first job that is refused.
    pub async fn create_jobs(
        &self,
        new: Vec<NewRecord>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<Vec<ChangeReply>, Error> {
        let new: Arc<[NewRecord]> = new.into();
        let stored = new.iter().map(|new| match &new.input {
            JobInput::Inline(bytes) => bytes.len() as u64,
            JobInput::Uploaded { .. } => 0,
        });
        writes!(self, "create_jobs", Payload, Begins(stored.sum()), [new, bounds], |connection| jobs::create(
            connection, &new, &bounds, now
        ))
    }

    /// The job that a tenant's request made before; `None` where it made none, or the job is gone.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`] for a request id with another body.
    pub async fn requested_job(&self, tenant: &str, request: &Request) -> Result<Option<Job>, Error> {
        reads!(self, "requested_job", Small, |connection| jobs::earlier(connection, tenant, request))
    }

    /// # Errors
    /// [`Error::NotFound`].
    pub async fn job(&self, name: &JobName) -> Result<Job, Error> {
        reads!(self, "job", Small, |connection| jobs::get(connection, name))
    }

    /// One page of a tenant's jobs.
    ///
    /// # Errors
    /// [`Error::PageToken`].
    pub async fn jobs(&self, query: &JobQuery) -> Result<Page<Job>, Error> {
        reads!(self, "jobs", Small, |connection| jobs::list(connection, query))
    }

    /// At most `limit` events with a sequence number above `after`, in order.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn events_after(&self, name: &JobName, after: u64, limit: u32) -> Result<Vec<JobEvent>, Error> {
        reads!(self, "events_after", Small, |connection| jobs::events_after(connection, name, after, limit))
    }

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
        if self.is_shared()
            && claim.begin.is_none()
            && !reads!(self, Small, |connection| claims::may_claim(connection))?
        {
            return Ok(Claims::default());
        }
        writes!(self, Small, Begins(0), [claim], |connection| claims::claim(connection, &claim, now, lease_now))
    }

    /// The encoded input of a job, and whether its cancel has been asked for.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn job_payload(&self, name: &JobName) -> Result<JobPayload, Error> {
        reads!(self, "work", Payload, |connection| jobs::job_payload(connection, name))
    }

    /// Extends a lease and brings back what its holder must know.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    pub async fn heartbeat(&self, lease: &Lease, now: SystemTime, lease_for: Duration) -> Result<Heartbeat, Error> {
        let expires = self.lease_clock(now) + lease_for;
        writes!(self, "heartbeat", Small, Ends(0), [lease], |connection| attempts::heartbeat(
            connection, &lease, expires
        ))
    }

    /// Appends a progress event; returns its sequence number.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    pub async fn record(&self, lease: &Lease, progress: &Progress, now: SystemTime) -> Result<u64, Error> {
        let progress = *progress;
        writes!(self, "record", Small, Little, [lease], |connection| attempts::record(
            connection, &lease, &progress, now
        ))
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
            attempts::finish(connection, &lease, &ending, now)
        })
    }

    /// Gives a lease back. The job returns to the queue, or ends if its cancel was asked for; the attempt does not
    /// count against the cap. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::Fenced`].
    pub async fn release(&self, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
        writes!(self, "release", Small, Ends(0), [lease], |connection| attempts::release(connection, &lease, now))
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
            attempts::request_cancel(connection, &name, etag.as_deref(), now)
        })
    }

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
            admin::retry(connection, &name, etag.as_deref(), &bounds, now)
        })
    }

    /// Changes the priority of a queued job. With an `etag`, only where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::NotQueued`].
    pub async fn set_priority(&self, name: &JobName, etag: Option<&str>, priority: i32) -> Result<Job, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "set_priority", Small, Little, [name, etag], |connection| {
            admin::set_priority(connection, &name, etag.as_deref(), priority)
        })
    }

    /// Pauses the queue, in which no claim finds a job from then on, or resumes it; for every process and over
    /// restarts. What is so already stays as it is.
    pub async fn set_paused(&self, paused: bool, now: SystemTime) -> Result<(), Error> {
        writes!(self, "set_paused", Small, Ends(0), [], |connection| admin::set_paused(connection, paused, now))
    }

    /// The queue as its administrator sees it, with at most `tenants` tenants.
    pub async fn queue(&self, tenants: u32) -> Result<QueueReport, Error> {
        // Counts every job that is kept.
        reads!(self, "queue", Payload, |connection| admin::queue(connection, tenants))
    }

    /// Counts that a call was disconnected that had attached to the job, unless it no longer depends on its calls or is
    /// another one of the same name, which was not `created` then. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn detach(&self, name: &JobName, created: SystemTime) -> Result<Job, Error> {
        writes!(self, "detach", Small, Ends(0), [name], |connection| jobs::detach(connection, &name, created))
    }

    /// Removes an ended job with its events, attempts, input, result, request ids and webhook. With an `etag`, only
    /// where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::NotEnded`].
    pub async fn delete_job(&self, name: &JobName, etag: Option<&str>) -> Result<(), Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "delete_job", Payload, Ends(ANY_BYTES), [name, etag], |connection| {
            removal::delete(connection, &name, etag.as_deref())
        })
    }

    /// Removes at most `limit` of the jobs that ended at that time or before, the oldest first. Returns how many.
    pub async fn purge(&self, ended_by: SystemTime, limit: u32) -> Result<u32, Error> {
        let _timer = store_operation("purge");
        if !reads!(self, Small, |connection| removal::needs_purge(connection, ended_by))? {
            return Ok(0);
        }
        writes!(self, Payload, Ends(ANY_BYTES), [], |connection| removal::purge(connection, ended_by, limit))
    }

    /// Gives some of the space that removed jobs took back to the file system, where the database does not do so by
    /// itself.
    pub async fn reclaim(&self) -> Result<(), Error> {
        measured("reclaim", bounded(self, Small, self.vacuum())).await
    }

    /// Takes back every lease that no living process can hold: all of them where one process has the store to itself,
    /// those that ran out where it is shared. Called once, before the first claim. A job that lost `max_attempts`
    /// attempts this way fails with `ATTEMPTS_EXHAUSTED`. Returns the jobs that changed.
    pub async fn recover(&self, now: SystemTime, max_attempts: u32) -> Result<Vec<Job>, Error> {
        // Where no other process can be at work, every lease is a dead one's.
        let expired_at = self.is_shared().then(|| self.lease_clock(now));
        writes!(self, "recover", Small, Ends(0), [], |connection| attempts::take_back(
            connection,
            expired_at,
            now,
            max_attempts
        ))
    }

    /// Takes back leases that ran out, as `recover` does, and ends queued jobs that are past their deadline.
    pub async fn sweep(&self, now: SystemTime, max_attempts: u32) -> Result<Swept, Error> {
        let _timer = store_operation("sweep");
        // Before the clocks are compared: see `claim`.
        let expired_at = self.lease_clock(now);
        bounded(self, Small, self.set_lease_clock()).await?;
        // Most sweeps find nothing: a look spares the writer, and the disk, a transaction.
        if !reads!(self, Small, |connection| attempts::needs_sweep(connection, expired_at, now))? {
            return Ok(Swept::default());
        }
        writes!(self, Small, Ends(0), [], |connection| async {
            let lost = attempts::take_back(connection, Some(expired_at), now, max_attempts).await?;
            let expired = attempts::expire_queued(connection, now).await?;
            Ok::<_, Error>(Swept { lost, expired })
        })
    }

    /// The encoded result of a job; `None` where there is none. Whether it is intact is for the caller to ask: it takes
    /// long.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn result(&self, name: &JobName) -> Result<Option<EncodedResult>, Error> {
        reads!(self, "result", Payload, |connection| jobs::result(connection, name))
    }

    /// What waits and what runs.
    pub async fn queue_stats(&self) -> Result<QueueStats, Error> {
        reads!(self, "load", Small, |connection| jobs::queue_stats(connection))
    }

    /// What operators watch.
    pub async fn stats(&self) -> Result<StoreStats, Error> {
        let _timer = store_operation("stats");
        let (tenants, oldest_queue_time) = reads!(self, Small, |connection| jobs::by_tenant(connection))?;
        let bytes = bounded(self, Small, self.bytes()).await?;
        Ok(StoreStats { bytes, oldest_queue_time, tenants })
    }

    /// Closes every connection; what was acknowledged is durable without it.
    pub async fn close(&self) {
        let _timer = store_operation("close");
        self.disconnect().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::contract;
    use crate::store::sqlite::Sqlite;
    use crate::telemetry::metrics::tests::page_after;
    use crate::telemetry::scrape::Page;

    #[test]
    fn writes_that_come_too_late_are_counted() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let late = async {
            let directory = tempfile::tempdir().expect("a temporary directory");
            let store = Sqlite::open(directory.path()).await.expect("opens");
            store.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
            let claim = Claim::one("w", Duration::from_secs(1));
            let claims = store.claim(&claim, contract::time(0)).await.expect("claims");
            let lease = claims.begun.expect("a job").lease;
            store.heartbeat(&lease, contract::time(0), Duration::from_secs(1)).await.expect("holds");
            store.sweep(contract::time(2), 3).await.expect("takes it back");
            store.heartbeat(&lease, contract::time(3), Duration::from_secs(1)).await.expect_err("too late");
            store.release(&lease, contract::time(3)).await.expect_err("too late");
        };
        let page = Page::parse(&page_after(|| runtime.block_on(late)));
        for (operation, count) in [("heartbeat", 1.0), ("release", 1.0), ("finish", 0.0), ("record", 0.0)] {
            let series = format!("scpsfm_fenced_writes_total{{operation=\"{operation}\"}}");
            assert_eq!(page.value(&series), count, "{operation}");
        }
    }
}
