//! The store that every database makes: one transaction an operation, within a bound of time.

use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use futures_util::FutureExt;

use super::{Database, Size, WriteIntent, admin, attempts, claims, jobs, operation, removal, uploads, webhooks};
use crate::domain::InputName;
use crate::domain::job::{Job, JobEvent, JobName};
use crate::domain::progress::Progress;
use crate::store::record::{
    CancelReply, Claim, Claims, Created, EncodedResult, Ending, Heartbeat, JobInput, JobPayload, Lease, NewRecord,
    Outcome, PassedOver, QueueBounds, QueueReport, QueueStats, Request, RetryReply, StoreStats, Swept, WebhookOutcome,
    WebhookQueue,
};
use crate::store::upload::{
    BegunUpload, NewInput, NewUpload, PurgedUploads, StoredInput, UploadBounds, UploadLease, UploadStatus,
};
use crate::store::{Error, InputPage, InputQuery, JobPage, JobQuery, Notification, Store};

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

/// Reads through a connection of its own.
macro_rules! reads {
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
/// are cloned for each run of it; what is large is in an [`Arc`].
macro_rules! writes {
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
        writes!(self, Size::Payload, WriteIntent::Begins(stored.sum()), [new, bounds], |connection| jobs::create(
            connection, &new, &bounds, now
        ))
    }

    async fn requested_job(&self, tenant: &str, request: &Request) -> Result<Option<Job>, Error> {
        reads!(self, Size::Small, |connection| jobs::earlier(connection, tenant, request))
    }

    async fn job(&self, name: &JobName) -> Result<Job, Error> {
        reads!(self, Size::Small, |connection| jobs::get(connection, name))
    }

    async fn jobs(&self, query: &JobQuery) -> Result<JobPage, Error> {
        reads!(self, Size::Small, |connection| jobs::list(connection, query))
    }

    async fn events_after(&self, name: &JobName, after: u64, limit: u32) -> Result<Vec<JobEvent>, Error> {
        reads!(self, Size::Small, |connection| jobs::events_after(connection, name, after, limit))
    }

    async fn claim(&self, claim: &Claim, now: SystemTime) -> Result<Claims, Error> {
        // At once: `now` is what the wall clock showed at the call, and it may be set before the database answers.
        let lease_now = self.lease_clock(now);
        // Idle workers look for jobs again and again: a read is one question over the network, a transaction is three.
        if D::SHARED && claim.begin.is_none() && !reads!(self, Size::Small, |connection| claims::may_claim(connection))?
        {
            return Ok(Claims::default());
        }
        writes!(self, Size::Small, WriteIntent::Begins(0), [claim], |connection| claims::claim(
            connection, &claim, now, lease_now
        ))
    }

    async fn job_payload(&self, name: &JobName) -> Result<JobPayload, Error> {
        reads!(self, Size::Payload, |connection| jobs::job_payload(connection, name))
    }

    async fn heartbeat(&self, lease: &Lease, now: SystemTime, lease_for: Duration) -> Result<Heartbeat, Error> {
        let expires = self.lease_clock(now) + lease_for;
        writes!(self, Size::Small, WriteIntent::Ends(0), [lease], |connection| attempts::heartbeat(
            connection, &lease, expires
        ))
    }

    async fn record(&self, lease: &Lease, progress: &Progress, now: SystemTime) -> Result<u64, Error> {
        let progress = *progress;
        writes!(self, Size::Small, WriteIntent::Little, [lease], |connection| attempts::record(
            connection, &lease, &progress, now
        ))
    }

    async fn finish(&self, lease: &Lease, ending: &Arc<Ending>, now: SystemTime) -> Result<Job, Error> {
        let bytes = match &ending.outcome {
            Outcome::Succeeded { result, .. } => result.bytes.len() as u64,
            Outcome::Failed(_) | Outcome::Cancelled | Outcome::DeadlineExceeded => 0,
        };
        writes!(self, Size::Outcome, WriteIntent::Ends(bytes), [lease, ending], |connection| {
            attempts::finish(connection, &lease, &ending, now)
        })
    }

    async fn release(&self, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
        writes!(self, Size::Small, WriteIntent::Ends(0), [lease], |connection| attempts::release(
            connection, &lease, now
        ))
    }

    async fn request_cancel(&self, name: &JobName, etag: Option<&str>, now: SystemTime) -> Result<CancelReply, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, Size::Small, WriteIntent::Ends(0), [name, etag], |connection| {
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
        writes!(self, Size::Small, WriteIntent::Begins(0), [name, etag, bounds], |connection| {
            admin::retry(connection, &name, etag.as_deref(), &bounds, now)
        })
    }

    async fn set_priority(&self, name: &JobName, etag: Option<&str>, priority: i32) -> Result<Job, Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, Size::Small, WriteIntent::Little, [name, etag], |connection| {
            admin::set_priority(connection, &name, etag.as_deref(), priority)
        })
    }

    async fn set_paused(&self, paused: bool, now: SystemTime) -> Result<(), Error> {
        writes!(self, Size::Small, WriteIntent::Ends(0), [], |connection| admin::set_paused(connection, paused, now))
    }

    async fn queue(&self, tenants: u32) -> Result<QueueReport, Error> {
        // Counts every job that is kept.
        reads!(self, Size::Payload, |connection| admin::queue(connection, tenants))
    }

    async fn detach(&self, name: &JobName, created: SystemTime) -> Result<Job, Error> {
        writes!(self, Size::Small, WriteIntent::Ends(0), [name], |connection| jobs::detach(connection, &name, created))
    }

    async fn delete_job(&self, name: &JobName, etag: Option<&str>) -> Result<(), Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, Size::Payload, WriteIntent::Ends(ANY_BYTES), [name, etag], |connection| {
            removal::delete(connection, &name, etag.as_deref())
        })
    }

    async fn purge(&self, ended_by: SystemTime, limit: u32) -> Result<u32, Error> {
        if !reads!(self, Size::Small, |connection| removal::needs_purge(connection, ended_by))? {
            return Ok(0);
        }
        writes!(self, Size::Payload, WriteIntent::Ends(ANY_BYTES), [], |connection| removal::purge(
            connection, ended_by, limit
        ))
    }

    async fn reclaim(&self) -> Result<(), Error> {
        bounded(self, Size::Small, Database::reclaim(self)).await
    }

    async fn recover(&self, now: SystemTime, max_attempts: u32) -> Result<Vec<Job>, Error> {
        // Where no other process can be at work, every lease is a dead one's.
        let expired_at = D::SHARED.then(|| self.lease_clock(now));
        writes!(self, Size::Small, WriteIntent::Ends(0), [], |connection| attempts::take_back(
            connection,
            expired_at,
            now,
            max_attempts
        ))
    }

    async fn sweep(&self, now: SystemTime, max_attempts: u32) -> Result<Swept, Error> {
        // Before the clocks are compared: see `claim`.
        let expired_at = self.lease_clock(now);
        bounded(self, Size::Small, self.set_lease_clock()).await?;
        // Most sweeps find nothing: a look spares the writer, and the disk, a transaction.
        if !reads!(self, Size::Small, |connection| attempts::needs_sweep(connection, expired_at, now))? {
            return Ok(Swept::default());
        }
        writes!(self, Size::Small, WriteIntent::Ends(0), [], |connection| async {
            let lost = attempts::take_back(connection, Some(expired_at), now, max_attempts).await?;
            let expired = attempts::expire_queued(connection, now).await?;
            Ok::<_, Error>(Swept { lost, expired })
        })
    }

    async fn result(&self, name: &JobName) -> Result<Option<EncodedResult>, Error> {
        reads!(self, Size::Payload, |connection| jobs::result(connection, name))
    }

    async fn begin_upload(
        &self,
        new: &NewUpload,
        bounds: &UploadBounds,
        now: SystemTime,
    ) -> Result<BegunUpload, Error> {
        let bounds = *bounds;
        writes!(self, Size::Small, WriteIntent::Begins(0), [new], |connection| uploads::begin(
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
        writes!(self, Size::Payload, WriteIntent::Begins(data.len() as u64), [lease, data], |connection| {
            uploads::append(connection, &lease, at_byte, &data, now)
        })
    }

    async fn read_upload(&self, lease: &UploadLease, at_byte: u64) -> Result<Vec<u8>, Error> {
        reads!(self, Size::Payload, |connection| uploads::read(connection, lease, at_byte))
    }

    async fn finish_upload(
        &self,
        lease: &UploadLease,
        new: &Arc<NewInput>,
        now: SystemTime,
    ) -> Result<StoredInput, Error> {
        let intent = WriteIntent::Begins(new.payload.len() as u64);
        writes!(self, Size::Payload, intent, [lease, new], |connection| {
            uploads::finish(connection, &lease, &new, now)
        })
    }

    async fn give_up_upload(&self, lease: &UploadLease) -> Result<(), Error> {
        writes!(self, Size::Small, WriteIntent::Ends(0), [lease], |connection| uploads::give_up(connection, &lease))
    }

    async fn upload(&self, name: &InputName) -> Result<UploadStatus, Error> {
        reads!(self, Size::Small, |connection| uploads::status(connection, name))
    }

    async fn uploaded_input(&self, name: &InputName) -> Result<StoredInput, Error> {
        reads!(self, Size::Small, |connection| uploads::input(connection, name))
    }

    async fn inputs(&self, query: &InputQuery) -> Result<InputPage, Error> {
        reads!(self, Size::Small, |connection| uploads::list(connection, query))
    }

    async fn delete_input(&self, name: &InputName) -> Result<(), Error> {
        writes!(self, Size::Payload, WriteIntent::Ends(ANY_BYTES), [name], |connection| uploads::delete(
            connection, &name
        ))
    }

    async fn purge_uploads(
        &self,
        abandoned_by: Option<SystemTime>,
        unused_since: Option<SystemTime>,
    ) -> Result<PurgedUploads, Error> {
        if !reads!(self, Size::Small, |connection| uploads::needs_purge(connection, abandoned_by, unused_since))? {
            return Ok(PurgedUploads::default());
        }
        writes!(self, Size::Payload, WriteIntent::Ends(ANY_BYTES), [], |connection| {
            uploads::purge(connection, abandoned_by, unused_since)
        })
    }

    async fn queue_stats(&self) -> Result<QueueStats, Error> {
        reads!(self, Size::Small, |connection| jobs::queue_stats(connection))
    }

    async fn webhook_queue(&self, now: SystemTime) -> Result<WebhookQueue, Error> {
        let due_by = self.lease_clock(now);
        reads!(self, Size::Small, |connection| webhooks::queue(connection, due_by))
    }

    async fn claim_webhook(
        &self,
        passed: &PassedOver,
        now: SystemTime,
        lease_for: Duration,
    ) -> Result<Option<Job>, Error> {
        let due_by = self.lease_clock(now);
        writes!(self, Size::Small, WriteIntent::Begins(0), [passed], |connection| webhooks::claim(
            connection,
            &passed,
            due_by,
            due_by + lease_for
        ))
    }

    async fn settle_webhook(&self, claimed: &Job, outcome: &WebhookOutcome, now: SystemTime) -> Result<bool, Error> {
        let now = self.lease_clock(now);
        let claimed = Arc::new(claimed.clone());
        writes!(self, Size::Small, WriteIntent::Ends(0), [claimed, outcome], |connection| webhooks::settle(
            connection, &claimed, &outcome, now
        ))
    }

    async fn stats(&self) -> Result<StoreStats, Error> {
        let (tenants, oldest_queue_time) = reads!(self, Size::Small, |connection| jobs::by_tenant(connection))?;
        let bytes = bounded(self, Size::Small, self.bytes()).await?;
        Ok(StoreStats { bytes, oldest_queue_time, tenants })
    }

    fn is_shared(&self) -> bool {
        D::SHARED
    }

    fn has_room(&self) -> bool {
        Database::has_room(self)
    }

    async fn notification(&self) -> Notification {
        self.next_notification().await
    }

    async fn close(&self) {
        self.disconnect().await;
    }
}
