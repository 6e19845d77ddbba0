//! The store that every database makes: one transaction an operation, within a bound of time, and measured.

use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use futures_util::FutureExt;

use super::Size::{Payload, Small};
use super::WriteIntent::{Begins, Ends, Little};
use super::{Database, Size, WriteIntent, admin, attempts, claims, jobs, operation, removal, uploads, webhooks};
use crate::domain::InputName;
use crate::domain::job::{Job, JobEvent, JobName};
use crate::domain::progress::Progress;
use crate::store::record::{
    CancelReply, Claim, Claims, Created, EncodedResult, Ending, Heartbeat, JobInput, JobPayload, Lease, NewRecord,
    Outcome, PassedOver, QueueReport, QueueStats, Request, RetryReply, StoreStats, Swept, WebhookOutcome, WebhookQueue,
};
use crate::store::upload::{BegunUpload, NewInput, NewUpload, PurgedUploads, StoredInput, UploadLease, UploadStatus};
use crate::store::{Error, InputPage, InputQuery, JobPage, JobQuery, Notification, QueueBounds, Store, UploadBounds};
use crate::telemetry::metrics::{store_operation, write_fenced};

/// Waits for an operation as long as the database allows it. One that is broken off changed nothing, or all that it was
/// to change: a commit may have been on its way.
async fn bounded<D: Database, T>(
    database: &D,
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
        let run = operation::<D::Writing, _>(move |$connection| {
            $(let $owned = $owned.clone();)*
            async move { $body.await }.boxed()
        });
        bounded($database, $size, $database.write($size, intent, run)).await
    }};
}

#[async_trait::async_trait]
impl<D: Database> Store for D {
    async fn create_jobs(
        &self,
        new: Vec<NewRecord>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<Vec<Created>, Error> {
        let new: Arc<[NewRecord]> = new.into();
        let stored = new.iter().map(|new| match &new.input {
            JobInput::Inline(bytes) => bytes.len() as u64,
            JobInput::Uploaded { .. } => 0,
        });
        writes!(self, "create_jobs", Payload, Begins(stored.sum()), [new, bounds], |connection| jobs::create(
            connection, &new, &bounds, now
        ))
    }

    async fn requested_job(&self, tenant: &str, request: &Request) -> Result<Option<Job>, Error> {
        reads!(self, "requested_job", Small, |connection| jobs::earlier(connection, tenant, request))
    }

    async fn job(&self, name: &JobName) -> Result<Job, Error> {
        reads!(self, "job", Small, |connection| jobs::get(connection, name))
    }

    async fn jobs(&self, query: &JobQuery) -> Result<JobPage, Error> {
        reads!(self, "jobs", Small, |connection| jobs::list(connection, query))
    }

    async fn events_after(&self, name: &JobName, after: u64, limit: u32) -> Result<Vec<JobEvent>, Error> {
        reads!(self, "events_after", Small, |connection| jobs::events_after(connection, name, after, limit))
    }

    async fn claim(&self, claim: &Claim, now: SystemTime) -> Result<Claims, Error> {
        let _timer = store_operation("claim");
        // At once: `now` is what the wall clock showed at the call, and it may be set before the database answers.
        let lease_now = self.lease_clock(now);
        // Idle workers look for jobs again and again: a read is one question over the network, a transaction is three.
        if D::SHARED && claim.begin.is_none() && !reads!(self, Small, |connection| claims::may_claim(connection))? {
            return Ok(Claims::default());
        }
        writes!(self, Small, Begins(0), [claim], |connection| claims::claim(connection, &claim, now, lease_now))
    }

    async fn job_payload(&self, name: &JobName) -> Result<JobPayload, Error> {
        reads!(self, "work", Payload, |connection| jobs::job_payload(connection, name))
    }

    async fn heartbeat(&self, lease: &Lease, now: SystemTime, lease_for: Duration) -> Result<Heartbeat, Error> {
        let expires = self.lease_clock(now) + lease_for;
        writes!(self, "heartbeat", Small, Ends(0), [lease], |connection| attempts::heartbeat(
            connection, &lease, expires
        ))
    }

    async fn record(&self, lease: &Lease, progress: &Progress, now: SystemTime) -> Result<u64, Error> {
        let progress = *progress;
        writes!(self, "record", Small, Little, [lease], |connection| attempts::record(
            connection, &lease, &progress, now
        ))
    }

    async fn finish(&self, lease: &Lease, ending: &Arc<Ending>, now: SystemTime) -> Result<Job, Error> {
        let bytes = match &ending.outcome {
            Outcome::Succeeded { result, .. } => result.bytes.len() as u64,
            Outcome::Failed(_) | Outcome::Cancelled | Outcome::DeadlineExceeded => 0,
        };
        writes!(self, "finish", Size::Outcome, Ends(bytes), [lease, ending], |connection| {
            attempts::finish(connection, &lease, &ending, now)
        })
    }

    async fn release(&self, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
        writes!(self, "release", Small, Ends(0), [lease], |connection| attempts::release(connection, &lease, now))
    }

    async fn request_cancel(&self, name: &JobName, etag: Option<&str>, now: SystemTime) -> Result<CancelReply, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "request_cancel", Small, Ends(0), [name, etag], |connection| {
            attempts::request_cancel(connection, &name, etag.as_deref(), now)
        })
    }

    async fn retry_job(
        &self,
        name: &JobName,
        etag: Option<&str>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<RetryReply, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "retry_job", Small, Begins(0), [name, etag, bounds], |connection| {
            admin::retry(connection, &name, etag.as_deref(), &bounds, now)
        })
    }

    async fn set_priority(&self, name: &JobName, etag: Option<&str>, priority: i32) -> Result<Job, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "set_priority", Small, Little, [name, etag], |connection| {
            admin::set_priority(connection, &name, etag.as_deref(), priority)
        })
    }

    async fn set_paused(&self, paused: bool, now: SystemTime) -> Result<(), Error> {
        writes!(self, "set_paused", Small, Ends(0), [], |connection| admin::set_paused(connection, paused, now))
    }

    async fn queue(&self, tenants: u32) -> Result<QueueReport, Error> {
        // Counts every job that is kept.
        reads!(self, "queue", Payload, |connection| admin::queue(connection, tenants))
    }

    async fn detach(&self, name: &JobName, created: SystemTime) -> Result<Job, Error> {
        writes!(self, "detach", Small, Ends(0), [name], |connection| jobs::detach(connection, &name, created))
    }

    async fn delete_job(&self, name: &JobName, etag: Option<&str>) -> Result<(), Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "delete_job", Payload, Ends(ANY_BYTES), [name, etag], |connection| {
            removal::delete(connection, &name, etag.as_deref())
        })
    }

    async fn purge(&self, ended_by: SystemTime, limit: u32) -> Result<u32, Error> {
        let _timer = store_operation("purge");
        if !reads!(self, Small, |connection| removal::needs_purge(connection, ended_by))? {
            return Ok(0);
        }
        writes!(self, Payload, Ends(ANY_BYTES), [], |connection| removal::purge(connection, ended_by, limit))
    }

    async fn reclaim(&self) -> Result<(), Error> {
        measured("reclaim", bounded(self, Small, Database::reclaim(self))).await
    }

    async fn recover(&self, now: SystemTime, max_attempts: u32) -> Result<Vec<Job>, Error> {
        // Where no other process can be at work, every lease is a dead one's.
        let expired_at = D::SHARED.then(|| self.lease_clock(now));
        writes!(self, "recover", Small, Ends(0), [], |connection| attempts::take_back(
            connection,
            expired_at,
            now,
            max_attempts
        ))
    }

    async fn sweep(&self, now: SystemTime, max_attempts: u32) -> Result<Swept, Error> {
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

    async fn result(&self, name: &JobName) -> Result<Option<EncodedResult>, Error> {
        reads!(self, "result", Payload, |connection| jobs::result(connection, name))
    }

    async fn begin_upload(
        &self,
        new: &NewUpload,
        bounds: &UploadBounds,
        now: SystemTime,
    ) -> Result<BegunUpload, Error> {
        let bounds = *bounds;
        writes!(self, "begin_upload", Small, Begins(0), [new], |connection| uploads::begin(
            connection, &new, &bounds, now
        ))
    }

    async fn append_upload(
        &self,
        lease: &UploadLease,
        at_byte: u64,
        data: &[u8],
        now: SystemTime,
    ) -> Result<(), Error> {
        let data: Arc<[u8]> = data.into();
        writes!(self, "append_upload", Payload, Begins(data.len() as u64), [lease, data], |connection| {
            uploads::append(connection, &lease, at_byte, &data, now)
        })
    }

    async fn read_upload(&self, lease: &UploadLease, at_byte: u64) -> Result<Vec<u8>, Error> {
        reads!(self, "read_upload", Payload, |connection| uploads::read(connection, lease, at_byte))
    }

    async fn finish_upload(
        &self,
        lease: &UploadLease,
        new: &Arc<NewInput>,
        now: SystemTime,
    ) -> Result<StoredInput, Error> {
        let intent = Begins(new.payload.len() as u64);
        writes!(self, "finish_upload", Payload, intent, [lease, new], |connection| {
            uploads::finish(connection, &lease, &new, now)
        })
    }

    async fn give_up_upload(&self, lease: &UploadLease) -> Result<(), Error> {
        writes!(self, "give_up_upload", Small, Ends(0), [lease], |connection| uploads::give_up(connection, &lease))
    }

    async fn upload(&self, name: &InputName) -> Result<UploadStatus, Error> {
        reads!(self, "upload", Small, |connection| uploads::status(connection, name))
    }

    async fn uploaded_input(&self, name: &InputName) -> Result<StoredInput, Error> {
        reads!(self, "uploaded_input", Small, |connection| uploads::input(connection, name))
    }

    async fn inputs(&self, query: &InputQuery) -> Result<InputPage, Error> {
        reads!(self, "inputs", Small, |connection| uploads::list(connection, query))
    }

    async fn delete_input(&self, name: &InputName) -> Result<(), Error> {
        writes!(self, "delete_input", Payload, Ends(ANY_BYTES), [name], |connection| uploads::delete(connection, &name))
    }

    async fn purge_uploads(
        &self,
        abandoned_by: Option<SystemTime>,
        unused_since: Option<SystemTime>,
    ) -> Result<PurgedUploads, Error> {
        let _timer = store_operation("purge_uploads");
        if !reads!(self, Small, |connection| uploads::needs_purge(connection, abandoned_by, unused_since))? {
            return Ok(PurgedUploads::default());
        }
        writes!(self, Payload, Ends(ANY_BYTES), [], |connection| {
            uploads::purge(connection, abandoned_by, unused_since)
        })
    }

    async fn queue_stats(&self) -> Result<QueueStats, Error> {
        reads!(self, "load", Small, |connection| jobs::queue_stats(connection))
    }

    async fn webhook_queue(&self, now: SystemTime) -> Result<WebhookQueue, Error> {
        let due_by = self.lease_clock(now);
        reads!(self, "webhook_queue", Small, |connection| webhooks::queue(connection, due_by))
    }

    async fn claim_webhook(
        &self,
        passed: &PassedOver,
        now: SystemTime,
        lease_for: Duration,
    ) -> Result<Option<Job>, Error> {
        let due_by = self.lease_clock(now);
        writes!(self, "claim_webhook", Small, Begins(0), [passed], |connection| webhooks::claim(
            connection,
            &passed,
            due_by,
            due_by + lease_for
        ))
    }

    async fn settle_webhook(&self, claimed: &Job, outcome: &WebhookOutcome, now: SystemTime) -> Result<bool, Error> {
        let now = self.lease_clock(now);
        let claimed = Arc::new(claimed.clone());
        writes!(self, "settle_webhook", Small, Ends(0), [claimed, outcome], |connection| webhooks::settle(
            connection, &claimed, &outcome, now
        ))
    }

    async fn stats(&self) -> Result<StoreStats, Error> {
        let _timer = store_operation("stats");
        let (tenants, oldest_queue_time) = reads!(self, Small, |connection| jobs::by_tenant(connection))?;
        let bytes = bounded(self, Small, self.bytes()).await?;
        Ok(StoreStats { bytes, oldest_queue_time, tenants })
    }

    fn is_shared(&self) -> bool {
        D::SHARED
    }

    fn has_room(&self) -> bool {
        Database::has_room(self)
    }

    /// Not measured: it waits for others.
    async fn notification(&self) -> Notification {
        self.next_notification().await
    }

    async fn close(&self) {
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
